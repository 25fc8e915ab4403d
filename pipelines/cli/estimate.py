"""Commands of state estimation: estimate."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.estimate.settings import EstimateSettings
from pipelines.runs.settings import RunsSettings, load

app = typer.Typer()


@command(app, "estimate")
def estimate_command(source: RunsSettings, settings: EstimateSettings, json_file: Json = None) -> None:
    """Estimate motion and slip, with their uncertainty."""
    from pipelines.estimate.estimate import estimate
    from pipelines.estimate.screen import print_estimates
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    runs, skipped = load(source)
    with progress_bar() as progress:
        result = estimate(runs, settings, skipped, progress)
    print_estimates(result, output_console())
    write_json(json_file, result)
