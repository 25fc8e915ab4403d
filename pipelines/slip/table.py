"""A table of target slips with what it was learned from: the result of ``terrain learn-slip``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import field, fields
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.report.figure import Figure, Line, Mark, Strip
from pipelines.report.results import Result, described
from pipelines.report.tree import Column
from terrain.control.slip_table import DRIVE_STATES, SlipTable, write_slip_table
from terrain.records import Array
from terrain.robots import robot_argument

SLIP, TARGET = ".3f", "+.3f"

TARGETS = tuple(Column(state, TARGET, of=f"targets.{state}.slip_ratio") for state in DRIVE_STATES)
"""Columns of the target slips of a terrain."""


class LearnedSlipTable(Result, SlipTable, eq=False, kw_only=True):
    """A table of target slips, and what it was learned from."""

    table: Path | None = described("file that was written", default=None)
    robot: str = described("of the runs")
    seed: int = described("of the bootstrap")
    dataset: str = described("name of the data", default="")
    data_digest: str = described("of the runs that were used")
    n_runs: int = described("used")
    figures: tuple[str, ...] = described("files that were written", default=())
    skipped: tuple[str, ...] = described("a sentence for each run that was not used")
    pictures: Mapping[str, Figure] = field(default_factory=dict)

    def save(self, path: str | Path) -> Path:
        """Write the table as YAML; return the file."""
        write_slip_table(self, path)
        return Path(path)

    def records(self) -> Iterable[Any]:
        """Return a row a terrain and drive state."""
        return (target for by_state in self.targets.values() for target in by_state.values())

    @property
    def next_step(self) -> str:
        """The command that drives by this table."""
        terrain = next((name for name in self.targets if name != self.fallback), "TERRAIN")
        return f"terrain drive --robot {robot_argument(self.robot)} --terrain {terrain} --table {self.table or 'FILE'}"


def law_marks(
    thrust_ratio: Callable[[Array], Array],
    slip_range: tuple[float, float],
    peak_interval: tuple[float, float],
    resistance_ratio: float,
) -> list[Mark]:
    """Return the law of thrust over load, within and beyond the observed slips, with its peak and the resistance."""
    within, beyond = np.linspace(*slip_range, 60), np.linspace(slip_range[1], 1.0, 30)
    return [
        Strip([(*peak_interval, "peak slip, 90 %")]),
        Line("law, within the observed slips", within, thrust_ratio(within), 0),
        Line("beyond", beyond, thrust_ratio(beyond), 0, dashed=True),
        Line("resistance", [0.0, 1.0], [resistance_ratio] * 2, 4, dashed=True),
    ]


def fields_of(slips: SlipTable) -> dict[str, Any]:
    """Return the fields of a table, for one that also has what it was learned from."""
    return {each.name: getattr(slips, each.name) for each in fields(slips) if each.init}
