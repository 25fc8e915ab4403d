"""NEES of the filter by terrain and group of states, as the page shows it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from pipelines.estimate.consistency import COVERAGE_HEADING, GROUPS, SCENARIOS, TerrainConsistency
from pipelines.reporting.numbers import NOT_KNOWN, format_number
from terrain.control.comparison import MeanInterval


class ConsistencyTable(NamedTuple):
    """NEES by terrain and group of states: headings, and rows of a terrain with (mean, interval) cells."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]
    scenarios: str


def consistency_table(rows: Sequence[TerrainConsistency]) -> ConsistencyTable:
    """Return the table of a result."""
    groups = [key for key in GROUPS if key in rows[0].nees]

    def cell(value: MeanInterval) -> tuple[str, str]:
        if value.mean is None:
            return NOT_KNOWN, ""
        return format_number(value.mean), " to ".join(map(format_number, value.ci or ()))

    def cells(row: TerrainConsistency) -> tuple[tuple[str, str], ...]:
        means = (*(row.nees[key] for key in groups), row.slip_coverage)
        return ((str(row.n_runs), ""), *map(cell, means))

    return ConsistencyTable(
        ("terrain", "runs", *(GROUPS[key] for key in groups), COVERAGE_HEADING),
        tuple((row.terrain, cells(row)) for row in rows),
        f"{', '.join(SCENARIOS[:-1])} and {SCENARIOS[-1]}",
    )
