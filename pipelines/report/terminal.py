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
    console = console or Console(soft_wrap=True, markup=False, highlight=False, width=width)
    console.print(RichText(plain_line(report.answer), style="bold"))
    if report.lead:
        console.print(RichText(report.lead, style="dim"))
    _print_parts(console, report.parts)
    if details:
        _print_parts(console, report.details)
    elif report.details:
        titles = [each.title for each in report.details]
        console.print(RichText(f"--details adds: {'; '.join(titles)}", style="dim"))
    if report.next_step:
        console.print(RichText(f"next: {report.next_step}"))


def terminal_text(report: Report, *, details: bool = False, width: int = WIDTH_OF_A_FILE) -> str:
    """Return what :func:`print_report` prints.

    Examples
    --------
    >>> terminal_text(Report("Runs", "Half of them are right.", parts=[Pairs([("runs", 3)])])).split()[-2:]
    ['runs', '3']
    """
    file = io.StringIO()
    console = Console(
        file=file, width=width, soft_wrap=True, markup=False, highlight=False, color_system=None
    )
    print_report(report, console, details=details)
    return "\n".join(line.rstrip() for line in file.getvalue().rstrip().splitlines())


def _print_parts(console: Console, parts: Sequence[Part]) -> None:
    """Print parts; a figure is not drawn on a terminal: pages have it."""
    for part in parts:
        drawn: RenderableType
        if isinstance(part, Text):
            mark = {"note": "note: ", "warning": "warning: "}.get(part.kind, "")
            drawn = RichText(
                mark + (part.text if part.kind == "code" else plain_line(part.text)),
                style="yellow" if part.kind == "warning" else "",
            )
            console.print(drawn)
        elif isinstance(part, Table):
            drawn = RichTable(
                title=part.title or None, box=SIMPLE, padding=(0, 1, 0, 0), title_justify="left"
            )
            columns = part.written
            for column, heading, right, *_ in columns:
                drawn.add_column(
                    RichText(heading),
                    justify="right" if right else "left",
                    overflow="fold",
                    min_width=24 if column.long else None,
                )
            for place in range(len(part.rows)):
                drawn.add_row(*(RichText(texts[place]) for *_, texts in columns))
            console.print(drawn)
            if part.note:
                console.print(RichText(part.note, style="dim"))
        elif isinstance(part, Pairs):
            drawn = RichTable.grid(padding=(0, 2, 0, 0))
            drawn.title, drawn.title_justify = part.title or None, "left"
            for _ in ("name", "value"):
                drawn.add_column(overflow="fold")
            for row in part.cells:
                drawn.add_row(*map(RichText, row))
            console.print(drawn)
        elif isinstance(part, Section):
            if part.title:
                console.print(RichText(f"\n{part.title}", style="bold"))
            _print_parts(console, part.parts)
