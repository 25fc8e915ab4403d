"""What ``terrain estimate`` prints of an observer."""

from __future__ import annotations

from rich.console import Console
from rich.table import Column, Table

from pipelines.estimate.observed import ObservedResult
from pipelines.reporting.numbers import format_known
from terrain.estimation.observers.summary import ObserverSummary


def print_observed(result: ObservedResult, console: Console) -> None:
    """Print each slip of a run, its truth where it is known, and how long the observer had which status."""
    table = Table(
        Column("run", overflow="fold"),
        "slip",
        *(Column(name, justify="right") for name in ("mean", "std", "true", "RMSE", "NEES", "position RMSE")),
        title=f"observer {result.filter}",
    )
    for row in result.runs:
        for cells in _rows(row):
            table.add_row(*cells)
    console.print(table)
    for row in result.runs:
        times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in row.status_s.items())
        dropped = f"; left out: {sum(row.dropped.values())} samples" if row.dropped else ""
        missing = f"; not measured: {', '.join(row.missing)}" if row.missing else ""
        console.print(f"{row.run_id}: {times}{dropped}{missing}", highlight=False)
    if result.out is not None:
        console.print(f"runs with state and slip written to {result.out}", highlight=False)
    for sentence in result.skipped:
        console.print(sentence, highlight=False)


def _rows(row: ObserverSummary) -> list[tuple[str, ...]]:
    position = format_known(row.position_rmse_m, "{:.3f} m")
    if not row.slip:
        return [(row.run_id, "not estimated", "", "", "", "", "", position)]
    rows: list[tuple[str, ...]] = []
    for k, (name, slip) in enumerate(row.slip.items()):
        numbers = (
            format_known(slip.mean, "{:+.4f}"),
            format_known(slip.std, "{:.4f}"),
            format_known(slip.true_mean, "{:+.4f}"),
            format_known(slip.rmse, "{:.4f}"),
            format_known(slip.nees, "{:.2f}"),
        )
        first = k == 0
        rows.append((row.run_id if first else "", name, *numbers, position if first else ""))
    return rows
