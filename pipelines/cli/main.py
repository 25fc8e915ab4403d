"""The command ``terrain``.  Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import os
import sys
import warnings
from difflib import get_close_matches
from itertools import groupby
from operator import attrgetter
from typing import Any

import click

from pipelines.cli.table import COMMANDS, FORMER
from terrain import __version__
from terrain.errors import NotTakenWarning, OutsideRegionWarning, TerrainError
from terrain.files.names import printable

MAX_MESSAGE = 1000  #: Characters of an error's message on the screen; of a longer one the middle is left out

HELP = {"help_option_names": ["-h", "--help"], "max_content_width": 110}


class Terrain(click.Group):
    """All commands, by group; a command's module is imported when the command is asked for."""

    def list_commands(self, context: click.Context) -> list[str]:
        """Return the names in the order of help."""
        return [each.name for each in COMMANDS]

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        """Return a command.

        Raises
        ------
        click.UsageError
            if there is none: of a former one the message names the successor, else the nearest command.
        """
        for each in COMMANDS:
            if each.name == name:
                from pipelines.cli.options import OneFile

                return OneFile(each)
        if name in FORMER:
            raise click.UsageError(f"there is no command {name!r} any more: {FORMER[name]}")
        near = get_close_matches(name, [*(each.name for each in COMMANDS), *FORMER], 1)
        raise click.UsageError(
            f"there is no command {name!r}" + (f"; the nearest is {near[0]!r}" if near else "")
        )

    def format_help(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """Write all commands on one screen, by group."""
        formatter.write(
            "Usage: terrain COMMAND [OPTIONS]\n\n"
            "Terrain classification and slip learning for off-road robots.\n"
            "terrain COMMAND -h begins with an example; every command takes --json, --report, --details.\n"
        )
        for group, commands in groupby(COMMANDS, attrgetter("group")):
            formatter.write(f"\n{group}\n")
            for each in commands:
                formatter.write(f"  {each.name:<12}{each.text}\n")


app = click.version_option(__version__, prog_name="terrain")(Terrain(context_settings=HELP))


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
    usual = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if not issubclass(category, OutsideRegionWarning | NotTakenWarning):
            usual(message, category, *place, **more)
            return
        warnings.simplefilter("ignore", category)  # of such drives the first alone is a note
        click.echo(f"note: {message}", err=True)

    warnings.showwarning = show
    try:
        code = app(standalone_mode=False, prog_name="terrain")
        if getattr(code, "interrupted", False):  # it shows what was found until the command was stopped
            code = 130
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        code = 2
    except (TerrainError, click.ClickException) as error:
        text = error.format_message() if isinstance(error, click.ClickException) else str(error)
        click.echo(f"error: {one_line(text)}", err=True)
        code = 2
    except (KeyboardInterrupt, click.Abort):
        click.echo("stopped", err=True)
        code = 130
    except BrokenPipeError:  # the reader of a pipe has gone, as of `terrain ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    sys.exit(code if isinstance(code, int) else 0)
