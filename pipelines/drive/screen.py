"""Terminal output of ``terrain drive``."""

from __future__ import annotations

from rich.console import Console
from rich.table import Column, Table

from pipelines.drive.belief import belief_notes
from pipelines.drive.results import DriveResult
from pipelines.reporting.terminal import print_lines, text_column
from terrain.control.comparison import MeanInterval


def print_drive(result: DriveResult, console: Console) -> None:
    """Print the metrics of each controller with their 95 % intervals over seeds."""
    ramp = "" if result.ramp_mps2 is None else f", ramp {result.ramp_mps2:.2f} m/s^2"
    print_lines(
        console,
        [
            f"{result.robot}, {result.scenario} on {result.terrain}, seeds: {len(result.seeds)}, "
            f"table {result.table}, delay {result.delay_s:g} s{ramp}"
        ],
    )
    columns = [Column("", no_wrap=True), *map(text_column, result.controllers)]
    table = Table(*columns, title="mean over seeds, with its 95 % interval")
    for key in next(iter(result.controllers.values())):
        values = [metrics[key] for metrics in result.controllers.values()]
        if any(value.mean is not None for value in values):
            table.add_row(key, *map(_with_interval, values))
    console.print(table)
    print_lines(console, belief_notes(result))


def _with_interval(value: MeanInterval) -> str:
    if value.mean is None:
        return "-"
    half = f" ± {(value.ci[1] - value.ci[0]) / 2:.2g}" if value.ci else ""
    return f"{value.mean:.4g}{half}"
