"""What ``terrain quickstart`` prints."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from pipelines.crossval.screen import print_crossval
from pipelines.estimate.consistency import print_consistency
from pipelines.quickstart.results import QuickstartResult
from pipelines.reporting.numbers import format_known
from pipelines.reporting.terminal import number_columns, print_lines
from terrain.estimation.labelled import TerrainSlip


def print_quickstart(result: QuickstartResult, console: Console) -> None:
    """Print slip, evaluation, training and predictions, and where the report is."""
    if result.slip:
        print_slip(result.slip, console)
    if result.consistency:
        print_consistency(result.consistency, console)
    print_crossval(result.crossval, console)
    print_lines(console, [result.train.report.answer])
    print_lines(console, [held_out_sentence(result.held_out)])
    print_lines(console, [result.predict.report.answer])
    print_lines(console, [f"report: {result.report}"])


def held_out_sentence(held_out: Sequence[str]) -> str:
    """Return which runs are predicted.

    Examples
    --------
    >>> held_out_sentence(["ICE_07"])
    'predictions are those of ICE_07, held out: the model was neither trained nor evaluated on them'
    """
    if not held_out:
        return "the runs are too few to hold one out: predictions are those of training runs"
    return (
        f"predictions are those of {', '.join(held_out)}, held out: the model was neither trained nor "
        "evaluated on them"
    )


def print_slip(rows: Sequence[TerrainSlip], console: Console) -> None:
    """Print estimated and true slip of each terrain."""
    columns = number_columns("runs", "slip", "true slip", "RMSE", "NEES")
    table = Table("terrain", *columns, title="steady slip of the simulated runs")
    for row in rows:
        table.add_row(
            row.terrain,
            str(row.n_runs),
            format_known(row.slip_mean, "{:+.3f}"),
            format_known(row.slip_true_mean, "{:+.3f}"),
            format_known(row.slip_rmse, "{:.4f}"),
            format_known(row.nees, "{:.2f}"),
        )
    console.print(table)
