"""The command quickstart."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.quickstart.settings import QuickstartSettings

app = typer.Typer()


@command(app, "quickstart")
def quickstart_command(settings: QuickstartSettings, json_file: Json = None) -> None:
    """Import or simulate runs, cross-validate, train, predict, and write a report."""
    from pipelines.quickstart.quickstart import quickstart
    from pipelines.quickstart.screen import print_quickstart
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    with progress_bar() as progress:
        result = quickstart(settings, progress)
    print_quickstart(result, output_console())
    write_json(json_file, result)
