"""Commands on runs themselves: import."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.data.settings import ImportSettings

app = typer.Typer()


@command(app, "import")
def import_command(settings: ImportSettings, json_file: Json = None) -> None:
    """Turn logs of any readable layout into run folders."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console
    from pipelines.runs.import_logs import import_logs
    from pipelines.runs.screen import print_import

    result = import_logs(settings)
    print_import(result, output_console())
    write_json(json_file, result)
