"""``terrain learn-slip`` of robots whose slip was measured from outside: steady targets by surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipelines.measured_slip.measure import Measured, measure
from pipelines.measured_slip.settings import MeasureSlipSettings
from pipelines.reporting.progress import Progress, silent
from pipelines.runs.datasets import data_digest
from pipelines.slip.results import TargetRow, target_row
from pipelines.slip.settings import LearnSlipSettings
from terrain.control.measured_table import measured_table, reason_of
from terrain.control.slip_table import DRIVE_STATES, write_slip_table
from terrain.errors import ConfigError, DataError
from terrain.files.atomic import ensure_writable
from terrain.measured_slip.operating import operating_points
from terrain.measured_slip.surfaces import SurfaceSlip, surface_slip
from terrain.records import Array, RunLog
from terrain.robots import Robot

WINDOW_S, SHORT_WINDOW_S = 2.0, 0.5
"""Windows; short ones where the outside measurement does not cover longer ones, as a lidar's twist."""


class SurfaceTargets(NamedTuple):
    """What was learned of a surface.

    Parameters
    ----------
    slip : as measured
    current_a, thrust_ratio : medians over runs, and their quartiles; NaN where unknown
    targets : by drive state
    reason : why there are no more
    """

    slip: SurfaceSlip
    current_a: tuple[float, float, float]
    thrust_ratio: tuple[float, float, float]
    targets: dict[str, TargetRow]
    reason: str


class Transfer(NamedTuple):
    """The slip of one session taken for another of the same surface: what it costs.

    Parameters
    ----------
    terrain, learned, driven : surface, and the two sessions
    slip_learned, slip_driven : medians over runs
    interval : 95 % of their difference, by draws of runs of both
    """

    terrain: str
    learned: str
    driven: str
    slip_learned: float
    slip_driven: float
    interval: tuple[float, float]


@dataclass(frozen=True, slots=True)
class MeasuredTargets:
    """Targets of a robot by slip that was measured from outside; ``skipped`` has what was not used."""

    table: Path
    robot: str
    dataset: str
    data_digest: str
    seed: int
    window_s: float
    n_runs: int
    surfaces: dict[str, SurfaceTargets]
    transfers: tuple[Transfer, ...]
    skipped: tuple[str, ...]


def learn_measured(
    runs: Sequence[RunLog],
    robot: Robot,
    settings: LearnSlipSettings,
    skipped: Sequence[str] = (),
    progress: Progress = silent,
) -> MeasuredTargets:
    """Learn the table of steady targets, and write it.

    Raises
    ------
    ConfigError
        if ``out`` is a folder.
    DataError
        if no run has a label, a run is another robot's, or none has a slip that was measured from outside.
    """
    if settings.out.is_dir():
        raise ConfigError(f"{settings.out}: is a folder; --out names the file of the table")
    ensure_writable(settings.out.parent)
    labelled = [run for run in runs if len(run.terrains) == 1]
    if not labelled:
        raise DataError(f"none of {len(runs)} runs has a label: target slips are learned by terrain")
    others = sorted({run.robot for run in labelled} - {robot.name})
    if others:
        raise DataError(f"runs are of the robot {others[0]!r}: a table is learned for one, {robot.name!r}")
    window_s, found = _measured(labelled, robot, settings, progress)
    rng = np.random.default_rng(settings.seed)
    places: dict[str, list[int]] = {}
    for i, run in enumerate(found.runs):
        places.setdefault(run.terrains[0], []).append(i)
    slips = {name: surface_slip(name, [found.slips[i] for i in places[name]], rng) for name in sorted(places)}
    table = measured_table(list(slips.values()), robot, settings.out.stem)
    surfaces = {}
    for name, slip in slips.items():
        here = places[name]
        points = operating_points([found.runs[i] for i in here], [found.slips[i] for i in here], robot)
        surfaces[name] = SurfaceTargets(
            slip,
            _quartiles(points.current_a),
            _quartiles(points.thrust_ratio),
            {state: target_row(table.targets[name][state]) for state in DRIVE_STATES},
            reason_of(slip),
        )
    write_slip_table(table, settings.out)
    return MeasuredTargets(
        table=settings.out,
        robot=robot.name,
        dataset=settings.dataset,
        data_digest=data_digest(found.runs),
        seed=settings.seed,
        window_s=window_s,
        n_runs=len(found.runs),
        surfaces=surfaces,
        transfers=tuple(_transfers(found, rng)),
        skipped=(*skipped, *found.failed),
    )


def _measured(
    runs: Sequence[RunLog], robot: Robot, settings: LearnSlipSettings, progress: Progress
) -> tuple[float, Measured]:
    """Return slips over the longer windows, or over short ones where no longer one is covered."""
    first = ""
    for window_s in (WINDOW_S, SHORT_WINDOW_S):
        of_windows = MeasureSlipSettings(
            data=settings.data, window_s=window_s, stride_s=window_s / 2, seed=settings.seed
        )
        found = measure(runs, robot, of_windows, progress)
        if any(np.isfinite(slip.body_slip[slip.steady]).any() for slip in found.slips):
            return window_s, found
        first = first or (found.failed[0] if found.failed else "no window is driven steadily")
    raise DataError(f"none of {len(runs)} runs has a slip; the first for this: {first}")


def _quartiles(values: Array) -> tuple[float, float, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return float("nan"), float("nan"), float("nan")
    low, middle, high = np.quantile(known, [0.25, 0.5, 0.75])
    return float(middle), float(low), float(high)


def _transfers(found: Measured, rng: np.random.Generator) -> list[Transfer]:
    """Return what each session shows beside each other one of the same surface."""
    medians: dict[tuple[str, str], list[float]] = {}
    for run, slip in zip(found.runs, found.slips, strict=True):
        known = slip.body_slip[slip.steady & np.isfinite(slip.body_slip)]
        if known.size:
            medians.setdefault((run.terrains[0], run.session), []).append(float(np.median(known)))
    transfers = []
    for terrain, learned in sorted(medians):
        for other, driven in sorted(medians):
            if other == terrain and driven != learned:
                one, two = np.array(medians[terrain, learned]), np.array(medians[terrain, driven])
                draws = np.median(rng.choice(two, (1000, two.size)), axis=1) - np.median(
                    rng.choice(one, (1000, one.size)), axis=1
                )
                low, high = np.quantile(draws, [0.025, 0.975])
                transfers.append(
                    Transfer(
                        terrain,
                        learned,
                        driven,
                        float(np.median(one)),
                        float(np.median(two)),
                        (float(low), float(high)),
                    )
                )
    return transfers
