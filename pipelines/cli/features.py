"""The command that writes the features of many runs: features."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.data.settings import AlignedRunsSettings
from pipelines.feature_store.settings import FeaturesSettings
from pipelines.learn.parallel import ComputeSettings

app = typer.Typer()


@command(app, "features")
def features_command(
    source: AlignedRunsSettings,
    settings: FeaturesSettings,
    compute: ComputeSettings,
    json_file: Json = None,
) -> None:
    """Write the features of runs, one file a run, for crossval, train and sweep; go on where interrupted."""
    from pipelines.data.datasets import run_loaders
    from pipelines.feature_store.build import build_store
    from pipelines.feature_store.screen import print_store
    from pipelines.learn.parallel import computing
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    loaders = run_loaders(
        source.data,
        layout=source.layout,
        mapping=source.mapping,
        repair=source.repair,
        align=source.align,
        robot=source.robot,
    )
    with computing(compute.compute), progress_bar() as progress:
        report = build_store(loaders, settings, progress)
    print_store(report, output_console())
    write_json(json_file, report)
