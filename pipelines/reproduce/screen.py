"""What ``terrain reproduce`` prints."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from pipelines.reporting.numbers import format_number
from pipelines.reproduce.results import Reproduction, Row


def print_reproduction(result: Reproduction, console: Console) -> None:
    """Print the paper's figures beside the simulation's, the counts of verdicts, and where the page is."""
    table = Table("", "paper", "simulation", "verdict", title=f"{result.title}, in simulation")
    title = None
    for experiment, row in result.rows:
        if experiment != title:
            title = experiment
            table.add_section()
        table.add_row(f"{row.what} ({row.where})", row.printed, _simulated(row), row.verdict.value)
    console.print(table)
    counted = [f"{count} {verdict.value}" for verdict, count in result.verdicts.items() if count]
    console.print(", ".join(counted), highlight=False)
    console.print(f"report: {result.report}", highlight=False)


def _simulated(row: Row) -> str:
    unit = "" if row.unit == "ratio" else f" {row.unit}"
    spread = "" if row.spread is None else " ({} to {})".format(*map(format_number, row.spread))
    return f"{format_number(row.simulated)}{unit}{spread}"
