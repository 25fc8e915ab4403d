"""The page of ``terrain learn-slip``: what was learned of each terrain, and the curves behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from matplotlib.figure import Figure

from pipelines.reporting.numbers import format_known
from pipelines.reporting.pictures import Image, png
from pipelines.reporting.templates import render
from pipelines.slip.results import TerrainRow
from terrain.control.slip_table import DRIVE_STATES, SlipTable
from terrain.slip_learning.peak import PeakStatus

HEADINGS = ("terrain", "status", "runs", "slips", "peak", "90 %", *DRIVE_STATES, "reason or source")


@dataclass(frozen=True, slots=True)
class SlipView:
    """What the page shows.

    Parameters
    ----------
    robot, table, n_runs : name of the robot, name of its table, and runs behind it
    headings, rows : of the table of targets, as texts
    fallback : targets for a terrain without an entry
    images : by heading, in order
    """

    robot: str
    table: str
    n_runs: int
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    fallback: str
    images: Mapping[str, Image]


def slip_page(
    rows: Mapping[str, TerrainRow], figures: Mapping[str, Figure], table: SlipTable, n_runs: int
) -> str:
    """Return the page.

    Parameters
    ----------
    rows : by terrain
    figures : by name, in the order in which they are shown
    table : that was learned
    n_runs : behind it
    """
    fallback = table.targets[table.fallback].items()
    view = SlipView(
        robot=table.robot,
        table=table.name,
        n_runs=n_runs,
        headings=HEADINGS,
        rows=tuple((terrain, *_cells(row)) for terrain, row in rows.items()),
        fallback=", ".join(f"{state} {target.slip_ratio:+.3f}" for state, target in fallback),
        images={name: png(figure, name) for name, figure in figures.items()},
    )
    return render("slip/page.html.j2", view=view)


def _cells(row: TerrainRow) -> tuple[str, ...]:
    curve = row.curve
    starred = "*" if curve is not None and curve.peak_status is PeakStatus.NO_PEAK else ""
    return (
        row.status.value,
        str(row.n_runs),
        "-" if row.slip_range is None else "{:.2f} to {:.2f}".format(*row.slip_range),
        format_known(None if curve is None else curve.peak_slip_ratio, "{:.3f}") + starred,
        "-" if curve is None else "{:.3f} to {:.3f}".format(*curve.peak_interval_ratio),
        *(f"{row.targets[state].slip_ratio:+.3f}" for state in DRIVE_STATES),
        row.reason or row.targets["traction"].source,
    )
