"""The command that puts sensor faults into the closed loop: faults."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.faults.settings import FaultsSettings

app = typer.Typer()


@command(app, "faults")
def faults_command(settings: FaultsSettings, json_file: Json = None) -> None:
    """Drive with each sensor fault in the closed loop, and show which bars the controller meets."""
    from pipelines.faults.faults import drawn_cases, faults, faults_inputs, faults_robot
    from pipelines.faults.screen import print_faults
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar
    from terrain.files.atomic import ensure_writable

    robot = faults_robot(settings)
    if settings.out is not None:
        ensure_writable(settings.out)
    with progress_bar() as progress:
        inputs = faults_inputs(settings, robot, progress)
        result = faults(settings, inputs, progress)
        if settings.out is not None:
            from pipelines.faults.page import fault_drawings, write_faults_page

            figures = fault_drawings(inputs, drawn_cases(settings, result), progress)
            page = write_faults_page(settings.out, result, figures)
    print_faults(result, output_console())
    if settings.out is not None:
        typer.echo(f"page: {page}")
    write_json(json_file, result)
