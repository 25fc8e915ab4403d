"""The command that runs a pilot on a CAN bus: can."""

from __future__ import annotations

import typer

from pipelines.can_bridge.settings import CanSettings
from pipelines.cli.command import Json, command

app = typer.Typer()


@command(app, "can")
def can_command(settings: CanSettings, json_file: Json = None) -> None:
    """Run the live chain on a CAN bus: sensors in, corrections of the wheels' speeds out."""
    from pipelines.can_bridge.run import run_can
    from pipelines.can_bridge.screen import print_report
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console

    result = run_can(settings)
    print_report(result, output_console())
    write_json(json_file, result)
