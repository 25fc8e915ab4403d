"""The command ``terrain``.  Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import sys

import typer

from pipelines.cli import classify, drive, estimate, explain, quickstart, reproduce, runs, slip
from terrain.errors import TerrainError

GROUPS = (runs, estimate, classify, slip, drive, explain, reproduce, quickstart)
"""Files of commands, in the order of help."""

app = typer.Typer(
    name="terrain",
    help="Terrain classification and slip learning for off-road robots.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
)
for group in GROUPS:
    app.add_typer(group.app)


def main() -> None:
    """Run the command line: a user's mistake is one sentence and exit code 2, a fault keeps its traceback."""
    try:
        app()
    except TerrainError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(2)
    except KeyboardInterrupt:
        typer.echo("stopped", err=True)
        sys.exit(130)
