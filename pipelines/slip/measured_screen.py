"""What ``terrain learn-slip`` prints of slip that was measured from outside."""

from __future__ import annotations

from rich.console import Console

from pipelines.reporting.numbers import format_known
from pipelines.reporting.terminal import compact_table, number_columns, print_lines, text_column
from pipelines.slip.measured import MeasuredTargets, SurfaceTargets
from terrain.control.slip_table import DRIVE_STATES


def print_measured_targets(result: MeasuredTargets, console: Console) -> None:
    """Print the operating point and the targets of each surface, and what a session costs another."""
    table = compact_table(
        text_column("terrain"),
        *number_columns("runs", "slip", "95 %", "current A", "thrust/load", *DRIVE_STATES),
        title=f"target slip of {result.robot}, measured from outside in {result.n_runs} runs",
    )
    for name, row in result.surfaces.items():
        table.add_row(name, *_cells(row))
    console.print(table)
    if result.transfers:
        console.print(_transfers(result))
    lines = [f"{name}: {row.reason}" for name, row in result.surfaces.items()]
    lines.append("* assumed, not measured")
    lines.append(f"table written to {result.table}")
    print_lines(console, [*lines, *result.skipped[:3]])


def _cells(row: SurfaceTargets) -> tuple[str, ...]:
    low, high = row.slip.interval
    return (
        str(row.slip.n_runs),
        format_known(row.slip.slip_ratio, "{:.3f}"),
        f"{format_known(low, '{:.3f}')} to {format_known(high, '{:.3f}')}",
        format_known(row.current_a[0], "{:.2f}"),
        format_known(row.thrust_ratio[0], "{:.2f}"),
        *(
            f"{target.slip_ratio:+.3f}" + ("" if target.status.value == "estimated" else "*")
            for target in (row.targets[state] for state in DRIVE_STATES)
        ),
    )


def _transfers(result: MeasuredTargets) -> object:
    table = compact_table(
        text_column("terrain"),
        text_column("learned in"),
        text_column("driven in"),
        *number_columns("target", "shown", "difference 95 %"),
        title="a target of one session in another",
    )
    for each in result.transfers:
        table.add_row(
            each.terrain,
            each.learned or "(none)",
            each.driven or "(none)",
            f"{each.slip_learned:.3f}",
            f"{each.slip_driven:.3f}",
            f"{each.interval[0]:+.3f} to {each.interval[1]:+.3f}",
        )
    return table
