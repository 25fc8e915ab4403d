"""Commands that are not yet one file: still made by typer, until they are."""

from __future__ import annotations

import typer

from pipelines.cli import quickstart

app = typer.Typer(
    name="terrain",
    help="Terrain classification and slip learning for off-road robots.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
)

GROUPS = (quickstart.app,)
"""Files of commands, in the order of help."""

for group in GROUPS:
    app.add_typer(group)
