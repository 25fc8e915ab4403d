"""What commands print: tables and progress on the terminal.  Results go to stdout, progress to stderr."""

from __future__ import annotations

from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Column, Table

from pipelines.reporting.terminal import progress_bar as progress_bar
from terrain.control.slip_table import DRIVE_STATES


def percent(value: float | None) -> str:
    """Return a share as a percentage with one decimal, ``-`` for None."""
    return "-" if value is None else f"{value:.1%}"


def print_learned_slip(result: dict[str, Any], console: Console) -> None:
    """Print curve and targets a terrain, and why some are not learned."""
    right = ("runs", "slips seen", "peak", "90 %", *DRIVE_STATES, "effic.", "J/m")
    table = Table(
        Column("terrain", overflow="fold"),
        "status",
        *(Column(name, justify="right") for name in right),
        title=f"target slip of {result['robot']}, learned from {result['n_runs']} runs",
        box=SIMPLE,
        padding=(0, 1, 0, 0),
    )
    for terrain, row in result["terrains"].items():
        reach, interval = row["slip_range"], row["peak_slip_ci"]
        peak = _figure(row["peak_slip"], "{:.3f}") + ("*" if row["peak_status"] == "no_peak" else "")
        table.add_row(
            terrain,
            row["status"],
            str(row["n_runs"]),
            "-" if reach is None else f"{reach[0]:.2f}-{reach[1]:.2f}",
            peak,
            "-" if interval is None else f"{interval[0]:.3f}-{interval[1]:.3f}",
            *(f"{row['targets'][state]['slip_ratio']:+.3f}" for state in DRIVE_STATES),
            _figure(row.get("traction_efficiency"), "{:.2f}"),
            _figure(row["energy_jpm"]["traction"] if "energy_jpm" in row else None, "{:.0f}"),
        )
    console.print(table)
    if any(row["peak_status"] == "no_peak" for row in result["terrains"].values()):
        console.print(
            "* no peak within the slips seen: the slip at 95 % of the largest net pull seen", highlight=False
        )
    for terrain, row in result["terrains"].items():
        if row["status"] != "estimated":
            source = row["targets"]["traction"]["source"]
            console.print(
                f"{terrain} is {row['status']}: {row['reason']}; its numbers are assumed ({source})",
                highlight=False,
            )
    if result["n_unlabelled"]:
        console.print(f"runs without a label, left out: {result['n_unlabelled']}", highlight=False)
    console.print(f"table written to {result['table']}", highlight=False)
    for sentence in result.get("skipped", []):
        console.print(sentence, highlight=False)


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)
