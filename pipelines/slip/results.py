"""What ``terrain learn-slip`` finds: rows of runs and of terrains, and the table that was written."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

from terrain.control.learned_table import DIGITS
from terrain.control.slip_table import DRIVE_STATES, CurveEntry, SlipTable
from terrain.records import SlipTarget, TargetStatus
from terrain.slip_learning.learn import LearnedTerrain, TerrainRun


class RunRow(NamedTuple):
    """One run on one terrain; its fields are keys of ``--json``.

    Parameters
    ----------
    run_id, terrain : of the run
    n_samples, n_bins : of slip and thrust over load
    slip_range : of its bins; None without any
    mass_kg, mass_std_kg, resistance_ratio, resistance_std : by its force balance; NaN where not known
    left_out : number of samples that do not meet each condition of their use
    """

    run_id: str
    terrain: str
    n_samples: int
    n_bins: int
    slip_range: tuple[float, float] | None
    mass_kg: float
    mass_std_kg: float
    resistance_ratio: float
    resistance_std: float
    left_out: Mapping[str, int]


class TargetRow(NamedTuple):
    """A target slip; ``slip_std`` is NaN where it is not known."""

    slip_ratio: float
    slip_std: float
    status: TargetStatus
    source: str


@dataclass(frozen=True, slots=True)
class TerrainRow:
    """One terrain.

    Parameters
    ----------
    status : whether its targets are learned
    reason : why they are not, or empty
    n_runs, n_samples : on it
    slip_range : slips that two runs or more reach; None without any
    targets : by drive state
    curve : as in the table; None where none was learned
    scores : mean log likelihood of a left-out run, by law; empty where no curve was learned
    """

    status: TargetStatus
    reason: str
    n_runs: int
    n_samples: int
    slip_range: tuple[float, float] | None
    targets: Mapping[str, TargetRow]
    curve: CurveEntry | None
    scores: Mapping[str, float]

    def as_json(self) -> dict[str, Any]:
        """Return the keys of ``--json``; those of a curve are there only where one was learned."""
        curve = self.curve
        row = {
            "status": self.status,
            "reason": self.reason or None,
            "n_runs": self.n_runs,
            "n_samples": self.n_samples,
            "slip_range": self.slip_range,
            "peak_slip": curve and curve.peak_slip_ratio,
            "peak_slip_ci": curve and curve.peak_interval_ratio,
            "peak_status": curve and curve.peak_status,
            "targets": self.targets,
        }
        if curve is None:
            return row
        return row | {
            "law": curve.law,
            "parameters": curve.parameters,
            "resistance_ratio": curve.resistance_ratio,
            "resistance_std": curve.resistance_std,
            "balance_slip": curve.balance_slip_ratio,
            "working_slip": curve.working_slip_ratio,
            "peak_based_slip": curve.peak_based_slip_ratio,
            "traction_efficiency": curve.traction_efficiency_ratio,
            "energy_jpm": {state: getattr(curve, f"{state}_energy_jpm") for state in DRIVE_STATES},
            "scores": self.scores,
        }


@dataclass(frozen=True, slots=True)
class LearnSlipResult:
    """What ``terrain learn-slip`` found.

    Parameters
    ----------
    table : file that was written
    robot, filter, seed, dataset : of the runs and of the bootstrap
    data_digest : of the runs that were used
    n_runs, n_unlabelled : used, and left out because they have no label
    runs : each on each of its terrains
    terrains : by name
    fallback : target slip by drive state for a terrain without an entry
    figures : files that were written
    skipped : a sentence for each run that was skipped
    tracking_run_id : of MLflow
    """

    table: Path
    robot: str
    filter: str
    seed: int
    dataset: str
    data_digest: str
    n_runs: int
    n_unlabelled: int
    runs: tuple[RunRow, ...]
    terrains: Mapping[str, TerrainRow]
    fallback: Mapping[str, float]
    figures: tuple[str, ...]
    skipped: tuple[str, ...]
    tracking_run_id: str

    def as_json(self) -> dict[str, Any]:
        """Return all but the id of MLflow: the same runs and seed give the same file."""
        names = (each.name for each in fields(self) if each.name != "tracking_run_id")
        return {name: getattr(self, name) for name in names}


def run_row(run: TerrainRun) -> RunRow:
    """Return the row of a run."""
    mass_kg, mass_std_kg, ratio, std = run.balance
    slips = run.bins.slip_ratio
    return RunRow(
        run.run_id,
        run.terrain,
        run.n_samples,
        len(slips),
        _rounded(float(slips.min()), float(slips.max())) if len(slips) else None,
        round(mass_kg, 1),
        round(mass_std_kg, 1),
        round(ratio, DIGITS),
        round(std, DIGITS),
        run.left_out,
    )


def terrain_row(learned: LearnedTerrain, table: SlipTable) -> TerrainRow:
    """Return the row of a terrain.

    Parameters
    ----------
    learned : of the terrain
    table : with its targets
    """
    entry = table.curves.get(learned.terrain)
    scores = learned.curve.scores if entry is not None and learned.curve is not None else {}
    return TerrainRow(
        learned.status,
        learned.reason,
        len(learned.runs_with_bins),
        sum(run.n_samples for run in learned.runs),
        None if math.isnan(learned.slip_range[0]) else _rounded(*learned.slip_range),
        {state: target_row(target) for state, target in table.targets[learned.terrain].items()},
        entry,
        {law: round(score, 3) for law, score in scores.items()},
    )


def target_row(target: SlipTarget) -> TargetRow:
    """Return the row of a target."""
    return TargetRow(target.slip_ratio, target.slip_std, target.status, target.source)


def _rounded(low: float, high: float) -> tuple[float, float]:
    return round(low, DIGITS), round(high, DIGITS)
