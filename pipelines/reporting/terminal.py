"""The terminal: progress bars on stderr, results on stdout, and parts of tables that all screens use."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from rich.box import SIMPLE
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column, Table

from pipelines.reporting import progress

WIDTH_OF_A_FILE = 110
"""Characters of a line where the output is no terminal, which has a width of its own."""


@contextmanager
def progress_bar() -> Iterator[progress.Progress]:
    """Show one bar a task on stderr; give the function that moves them."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    bars = Progress(*columns, console=Console(stderr=True))
    tasks: dict[str, TaskID] = {}

    def show(task: str, done: int, total: int) -> None:
        if not tasks:
            bars.start()  # not before: data that are refused at once are one line on stderr
        if task not in tasks:
            tasks[task] = bars.add_task(task, total=total)
        bars.update(tasks[task], completed=done, total=total)

    try:
        yield show
    finally:
        if tasks:
            bars.stop()


def output_console() -> Console:
    """Return the console that results are printed on."""
    # names come from the user's files: brackets in them are no markup
    return Console(soft_wrap=True, markup=False, width=None if sys.stdout.isatty() else WIDTH_OF_A_FILE)


def print_lines(console: Console, lines: Iterable[str]) -> None:
    """Print each line as it is, without colours."""
    for line in lines:
        console.print(line, highlight=False)


def number_columns(*names: str) -> list[Column]:
    """Return columns of numbers, which are aligned on the right."""
    return [Column(name, justify="right") for name in names]


def text_column(name: str) -> Column:
    """Return a column of long texts, which are folded into several lines where they have to be."""
    return Column(name, overflow="fold")


def compact_table(*columns: Column | str, title: str | None = None) -> Table:
    """Return a table with few lines, for many columns."""
    return Table(*columns, title=title, box=SIMPLE, padding=(0, 1, 0, 0))
