"""What ``terrain learn-slip`` prints."""

from __future__ import annotations

from rich.console import Console

from pipelines.reporting.numbers import format_known
from pipelines.reporting.terminal import compact_table, number_columns, print_lines, text_column
from pipelines.slip.results import LearnSlipResult, TerrainRow
from terrain.control.slip_table import DRIVE_STATES
from terrain.records import TargetStatus
from terrain.slip_learning.peak import PeakStatus

NO_PEAK_NOTE = "* no peak within the observed slips: the slip at 95 % of the largest net traction observed"


def print_learned_slip(result: LearnSlipResult, console: Console) -> None:
    """Print curve and targets a terrain, and why some are not learned."""
    table = compact_table(
        text_column("terrain"),
        "status",
        *number_columns("runs", "slips", "peak", "90 %", *DRIVE_STATES, "effic.", "J/m"),
        title=f"target slip of {result.robot}, learned from {result.n_runs} runs",
    )
    for terrain, row in result.terrains.items():
        table.add_row(terrain, *_cells(row))
    console.print(table)
    print_lines(console, _lines(result))


def _cells(row: TerrainRow) -> tuple[str, ...]:
    curve = row.curve
    starred = "*" if curve is not None and curve.peak_status is PeakStatus.NO_PEAK else ""
    return (
        row.status.value,
        str(row.n_runs),
        "-" if row.slip_range is None else "{:.2f}-{:.2f}".format(*row.slip_range),
        format_known(None if curve is None else curve.peak_slip_ratio, "{:.3f}") + starred,
        "-" if curve is None else "{:.3f}-{:.3f}".format(*curve.peak_interval_ratio),
        *(f"{row.targets[state].slip_ratio:+.3f}" for state in DRIVE_STATES),
        format_known(None if curve is None else curve.traction_efficiency_ratio, "{:.2f}"),
        format_known(None if curve is None else curve.traction_energy_jpm, "{:.0f}"),
    )


def _lines(result: LearnSlipResult) -> list[str]:
    curves = [row.curve for row in result.terrains.values() if row.curve is not None]
    lines = [NO_PEAK_NOTE] if any(curve.peak_status is PeakStatus.NO_PEAK for curve in curves) else []
    lines += [
        f"{terrain} is {row.status.value}: {row.reason}; its numbers are assumed "
        f"({row.targets['traction'].source})"
        for terrain, row in result.terrains.items()
        if row.status is not TargetStatus.ESTIMATED
    ]
    if result.n_unlabelled:
        lines.append(f"runs without a label, left out: {result.n_unlabelled}")
    return [*lines, f"table written to {result.table}", *result.skipped]
