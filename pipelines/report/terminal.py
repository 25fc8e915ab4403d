"""A report on a terminal; and bars of progress, on stderr."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.box import SIMPLE
from rich.console import Console, RenderableType
from rich.table import Table as RichTable
from rich.text import Text as RichText

from pipelines.report.numbers import plain_line
from pipelines.report.results import Progress
from pipelines.report.tree import Pairs, Part, Report, Section, Table, Text

WIDTH_OF_A_FILE = 110  #: Characters of a line where the output is no terminal, which has a width of its own


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Show one bar a task on stderr; give the function that moves them."""
    from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    bars = Bars(*columns, console=Console(stderr=True))
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


def print_report(report: Report, console: Console | None = None, *, details: bool = False) -> None:
    """Print a report: its answer, what is decided by, and with ``details`` all of it; on stdout by default."""
    # names come from the user's files: brackets in them are no markup
    width = None if sys.stdout.isatty() else WIDTH_OF_A_FILE
    console = console or Console(soft_wrap=True, markup=False, width=width)
    for part in _screen(report, details):
        console.print(part, highlight=False)


def terminal_text(report: Report, *, details: bool = False, width: int = WIDTH_OF_A_FILE) -> str:
    """Return what :func:`print_report` prints.

    Examples
    --------
    >>> terminal_text(Report("Runs", "Half of them are right.", parts=[Pairs([("runs", 3)])])).split()[-2:]
    ['runs', '3']
    """
    console = Console(file=io.StringIO(), width=width, markup=False, soft_wrap=True, color_system=None)
    print_report(report, console, details=details)
    written: str = console.file.getvalue()  # type: ignore[attr-defined]
    return "\n".join(line.rstrip() for line in written.rstrip().splitlines())


def _screen(report: Report, details: bool) -> Iterator[RenderableType]:
    yield RichText(plain_line(report.answer), style="bold")
    if report.lead:
        yield RichText(report.lead, style="dim")
    yield from _parts(report.parts)
    if details:
        yield from _parts(report.details)
    elif report.details:
        yield RichText(f"--details adds: {'; '.join(each.title for each in report.details)}", style="dim")
    if report.next_step:
        yield RichText(f"next: {report.next_step}")


def _parts(parts: Sequence[Part]) -> Iterator[RenderableType]:
    for part in parts:
        if isinstance(part, Text):
            mark = {"note": "note: ", "warning": "warning: "}.get(part.kind, "")
            yield RichText(
                mark + (part.text if part.kind == "code" else plain_line(part.text)),
                style="yellow" if part.kind == "warning" else "",
            )
        elif isinstance(part, Table):
            yield _table(part)
            if part.note:
                yield RichText(part.note, style="dim")
        elif isinstance(part, Pairs):
            yield _pairs(part)
        elif isinstance(part, Section):
            if part.title:
                yield RichText(f"\n{part.title}", style="bold")
            yield from _parts(part.parts)
        # a figure is not drawn on a terminal: pages have it


def _table(table: Table) -> RenderableType:
    drawn = RichTable(title=table.title or None, box=SIMPLE, padding=(0, 1, 0, 0), title_justify="left")
    columns = table.written
    for each in columns:
        drawn.add_column(
            RichText(each.heading),
            justify="right" if each.right else "left",
            overflow="fold",
            min_width=24 if each.column.long else None,
        )
    for texts in zip(*(each.texts for each in columns), strict=True):
        drawn.add_row(*map(RichText, texts))
    return drawn


def _pairs(pairs: Pairs) -> RenderableType:
    grid = RichTable.grid(padding=(0, 2, 0, 0))
    grid.title, grid.title_justify = pairs.title or None, "left"
    for _ in ("name", "value"):
        grid.add_column(overflow="fold")
    for row in pairs.cells:
        grid.add_row(*map(RichText, row))
    return grid
