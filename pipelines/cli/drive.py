"""The command that compares controllers: drive."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.drive.settings import DriveSettings

app = typer.Typer()


@command(app, "drive")
def drive_command(settings: DriveSettings, json_file: Json = None) -> None:
    """Drive controllers side by side in the closed loop, and compare what it costs."""
    from pipelines.drive.drive import check_drive, drive, example_runs, load_inputs, with_classifier
    from pipelines.drive.screen import print_drive
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar
    from terrain.files.atomic import ensure_writable

    inputs = load_inputs(settings)
    check_drive(settings, inputs)
    if settings.out is not None:
        ensure_writable(settings.out)
    with progress_bar() as progress:
        inputs = with_classifier(settings, inputs, progress)
        result = drive(settings, inputs, progress)
        if settings.out is not None:
            from pipelines.drive.page import write_drive_page

            examples = example_runs(settings, inputs, result.ramp_mps2)
            page = write_drive_page(settings.out, result, examples, inputs.table)
    print_drive(result, output_console())
    if settings.out is not None:
        typer.echo(f"page: {page}")
    write_json(json_file, result)
