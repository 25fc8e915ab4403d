"""What ``terrain learn-slip`` prints of slip that was measured from outside."""

from __future__ import annotations

from rich.console import Console

from pipelines.reporting.terminal import compact_table, number_columns, print_lines, text_column
from pipelines.slip.measured_rows import (
    SURFACE_COLUMNS,
    TRANSFER_COLUMNS,
    MeasuredTargets,
    surface_cells,
    transfer_cells,
)

SHOWN_SKIPPED = 3


def print_measured_targets(result: MeasuredTargets, console: Console) -> None:
    """Print the operating point and the targets of each surface, and what a session costs another."""
    n_steady = sum(row.slip.n_runs for row in result.surfaces.values())
    table = compact_table(
        text_column("terrain"),
        *number_columns(*SURFACE_COLUMNS),
        title=f"target slip of {result.robot}, measured from outside: {n_steady} of {result.n_runs} runs "
        "have steady motion",
    )
    for name, row in result.surfaces.items():
        table.add_row(name, *surface_cells(row))
    console.print(table)
    if result.transfers:
        console.print(_transfers(result))
    lines = [f"{name}: {row.reason}" for name, row in result.surfaces.items()]
    lines.append("* assumed, not measured")
    lines.append(f"table written to {result.table}")
    if result.skipped:
        lines.append(f"{len(result.skipped)} runs are not used, the first {SHOWN_SKIPPED} at most:")
    print_lines(console, [*lines, *result.skipped[:SHOWN_SKIPPED]])


def _transfers(result: MeasuredTargets) -> object:
    table = compact_table(
        *(text_column(name) for name in TRANSFER_COLUMNS[:3]),
        *number_columns(*TRANSFER_COLUMNS[3:]),
        title="a target of one session in another",
    )
    for each in result.transfers:
        table.add_row(*transfer_cells(each))
    return table
