"""What ``terrain label`` prints."""

from __future__ import annotations

from rich.console import Console
from rich.table import Column, Table

from pipelines.label.results import DoubtfulWindows, LabelledRun
from pipelines.reporting.numbers import format_known
from pipelines.reporting.terminal import number_columns, print_lines, text_column


def print_doubtful(result: DoubtfulWindows, console: Console) -> None:
    """Print a row for each window of low confidence, and what each run has of them."""
    if result.windows:
        table = Table(
            text_column("run"),
            *number_columns("from s", "to s"),
            *(text_column("classified"), Column("probability", justify="right"), text_column("label")),
            title="windows of low confidence",
        )
        for row in result.windows:
            table.add_row(
                row.run_id,
                time_text(row.start_s),
                time_text(row.end_s),
                row.terrain or (f"refused: {row.refused}" if row.refused else "unknown"),
                format_known(row.probability, "{:.2f}", ""),
                row.label or "",
            )
        console.print(table)
    for run in result.runs:
        if run.n_windows is None:
            print_lines(console, [f"{run.run_id}: no windows were recorded"])
        else:
            print_lines(
                console,
                [
                    f"{run.run_id}: {run.n_doubtful} of {run.n_windows} windows of low confidence, "
                    f"{run.n_without_label} of them without a label"
                ],
            )


def print_labelled(result: LabelledRun, console: Console) -> None:
    """Print what was set, and the labels of the run."""
    done = f"labelled {result.terrain}" if result.terrain else "without a label"
    print_lines(
        console,
        [
            f"{result.run_id}: {time_text(result.start_s)} to {time_text(result.end_s)} s {done}",
            *(f"  {time_text(a)} to {time_text(b)} s {terrain}" for a, b, terrain in result.labels),
        ],
    )


def time_text(time_s: float) -> str:
    """Return a time that can be given back to the command without loss.

    Examples
    --------
    >>> time_text(2.0), time_text(4.7300000001), time_text(-0.0)
    ('2', '4.73', '0')
    """
    return f"{time_s + 0.0:.6f}".rstrip("0").rstrip(".")
