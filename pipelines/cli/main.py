"""The command ``terrain``.  Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import sys
import warnings
from typing import Any

import typer

from pipelines.cli import (
    bench,
    can,
    classify,
    drive,
    estimate,
    explain,
    export,
    faults,
    features,
    label,
    quickstart,
    replay,
    reproduce,
    runs,
    serve,
    slip,
    soil,
    track,
)
from terrain.errors import OutsideRegionWarning, TerrainError
from terrain.files.names import printable

app = typer.Typer(
    name="terrain",
    help="Terrain classification and slip learning for off-road robots.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
)

GROUPS = (
    *(runs.app, export.app, estimate.app, features.app, classify.app, slip.app, soil.app, drive.app),
    *(replay.app, serve.app, can.app, label.app),
    *(faults.app, explain.app, reproduce.app, quickstart.app, track.app),
)
"""Files of commands, in the order of help."""

for group in GROUPS:
    app.add_typer(group)
app.add_typer(bench.app, name="bench")


MAX_MESSAGE = 1000
"""Characters of an error's message on the screen; of a longer one the middle is left out."""


class _Notes:
    """Shows warnings of drives outside a robot's region in a sentence, the first of a command."""

    def __init__(self) -> None:
        self._usual, self._shown = warnings.showwarning, False

    def __call__(self, message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if not issubclass(category, OutsideRegionWarning):
            self._usual(message, category, *place, **more)
        elif not self._shown:
            self._shown = True
            typer.echo(f"note: {message}", err=True)


def one_line(message: str) -> str:
    r"""Return a message as one line of a bounded length: files of strangers are quoted in messages.

    Control characters, which a terminal would act on, are written as escapes.

    Examples
    --------
    >>> print(one_line("run 'a\nb'"))
    run 'a\nb'
    """
    line = printable(message)
    return line if len(line) <= MAX_MESSAGE else f"{line[: MAX_MESSAGE - 200]} ... {line[-195:]}"


def main() -> None:
    """Run the command line: a user's mistake is one sentence and exit code 2, a fault keeps its traceback."""
    warnings.showwarning = _Notes()
    try:
        app()
    except TerrainError as error:
        typer.echo(f"error: {one_line(str(error))}", err=True)
        sys.exit(2)
    except KeyboardInterrupt:
        typer.echo("stopped", err=True)
        sys.exit(130)
