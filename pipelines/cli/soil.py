"""The command fit-soil."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.data.settings import load
from pipelines.soil.settings import FitSoilSettings

app = typer.Typer()


@command(app, "fit-soil")
def fit_soil_command(settings: FitSoilSettings, json_file: Json = None) -> None:
    """Fit laws of a wheel in sand to trials of a testbed, and judge them on slips and angles left out."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar
    from pipelines.soil.fit_soil import fit_soil
    from pipelines.soil.screen import print_soil

    runs, skipped = load(settings)
    with progress_bar() as progress:
        result = fit_soil(runs, settings, skipped, progress)
    print_soil(result, output_console())
    write_json(json_file, result)
