"""What ``terrain compare`` prints."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from pipelines.compare.results import CompareReport
from pipelines.reporting.numbers import percent
from pipelines.reporting.terminal import print_lines
from terrain.classify.paired import Difference

MAX_RUNS = 8


def print_compare(report: CompareReport, console: Console) -> None:
    """Print the differences, of all windows and by class, and the runs that differ most."""
    repeats = f", {report.repeats} fold assignments" if report.kind == "recipes" else ""
    console.print(
        f"{report.dataset}: {report.n_windows} windows of {report.n_runs} held-out runs{repeats}; "
        f"A is {report.a}, B is {report.b}"
    )
    table = Table("figure", "A", "B", "B - A", "95 % over runs, paired", "B is", "runs")
    found = report.comparison
    for name, row in (
        ("accuracy", found.accuracy),
        ("mean over classes then runs", found.macro_run_accuracy),
        ("from confidence to correctness", found.confidence_auc),
        *((f"accuracy on {terrain}", row) for terrain, row in found.by_class.items()),
        *((f"accuracy, {level}", row) for level, row in report.by_support.items()),
    ):
        table.add_row(name, *_cells(row))
    console.print(table)
    print_lines(console, _lines(report))


def _cells(row: Difference) -> tuple[str, ...]:
    if row.difference != row.difference:
        return "-", "-", "-", "-", str(row.verdict), str(row.n_runs)
    low, high = row.interval
    interval = f"{100 * low:+.1f} to {100 * high:+.1f} points" if low == low else "too few runs"
    difference = f"{100 * row.difference:+.1f}"
    return percent(row.a), percent(row.b), difference, interval, str(row.verdict), str(row.n_runs)


def _lines(report: CompareReport) -> Iterator[str]:
    differing = sorted(report.comparison.by_run, key=lambda run: -abs(run.b - run.a))
    for run in differing[:MAX_RUNS]:
        if run.a != run.b:
            yield f"run {run.run_id} ({run.terrain}): A {percent(run.a)}, B {percent(run.b)}"
    if report.excluded_runs:
        yield f"{len(report.excluded_runs)} runs left out: one of the models was trained on them"
    yield from (f"note: {note}" for note in report.notes)
