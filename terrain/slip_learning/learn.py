"""What is learned of a terrain: measurements of each run, the slip curve and the target slips."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.estimation.estimate import estimate_run
from terrain.estimation.wheel_slip import wheel_speed_scatter_mps
from terrain.extension import correct
from terrain.records import RunLog, TargetStatus
from terrain.robots import Robot
from terrain.slip_learning.curve import (
    SlipCurve,
    TargetSlip,
    contradiction,
    insufficiency,
    learn_curve,
    targets_of,
)
from terrain.slip_learning.forces import (
    Balance,
    RunBins,
    body_balance,
    run_bins,
    slip_range,
    traction_samples,
    wheel_forces,
)

FILTER = "vio15"  #: Filter whose state holds the slip speed of each wheel


class TerrainRun(NamedTuple):
    """Bins of slip, mass and resistance of one run on one terrain.

    ``left_out`` is the number of samples that do not meet each condition of :class:`WheelForces`, ``n_samples`` that
    of those behind the bins.
    """

    run_id: str
    terrain: str
    bins: RunBins
    balance: Balance
    left_out: Mapping[str, int]
    n_samples: int


@dataclass(frozen=True, slots=True, eq=False)
class LearnedTerrain:
    """What was learned of one terrain."""

    terrain: str  #: its name
    runs: tuple[TerrainRun, ...]  #: on it
    status: TargetStatus  #: whether the targets are learned
    reason: str = ""  #: why ``curve`` or ``targets`` are None; empty otherwise
    curve: SlipCurve | None = None  #: None where the runs do not suffice for one
    targets: Mapping[str, TargetSlip] | None = (
        None  #: None without a curve, or where the curve contradicts itself
    )

    @property
    def runs_with_bins(self) -> tuple[TerrainRun, ...]:
        """Runs with at least one bin of slip."""
        return tuple(run for run in self.runs if len(run.bins.slip_ratio))

    @property
    def slip_range(self) -> tuple[float, float]:
        """Smallest and largest slip that two runs or more reach; NaN where no two runs have bins."""
        return slip_range([run.bins for run in self.runs_with_bins])


def terrain_runs(run: RunLog, robot: Robot) -> list[TerrainRun]:
    """Return the measurements of a run on each terrain that it is labelled with.

    Raises
    ------
    DataError
        if it is another robot's, or lacks currents or attitude.
    """
    if run.robot != robot.name:
        raise DataError(
            f"run {run.run_id} is of robot {run.robot!r}: a table is learned for one, {robot.name!r}"
        )
    run, robot = correct(run, robot)
    found = estimate_run(run, robot, FILTER)
    assert found.table is not None  # as of every filter of a swerve robot
    forces = wheel_forces(run, robot, found.track, found.table, found.slip)
    speed_std_mps = wheel_speed_scatter_mps(robot)
    measured = []
    for terrain in run.terrains:
        where = forces.on_terrain(run.labels, terrain)
        balance = body_balance(forces, robot, where)
        samples = traction_samples(forces, balance.mass_kg, where, speed_std_mps)
        left_out = {name: int((~met[where]).sum()) for name, met in forces.conditions.items()}
        bins, n = run_bins(run.run_id, samples, run.session), len(samples.slip_ratio)
        measured.append(TerrainRun(run.run_id, terrain, bins, balance, left_out, n))
    return measured


def learn_terrain(terrain: str, runs: Sequence[TerrainRun], seed: int) -> LearnedTerrain:
    """Return what runs show of one terrain; a curve is fitted only where they suffice for one."""
    with_bins = [run for run in runs if len(run.bins.slip_ratio)]
    bins = [run.bins for run in with_bins]
    ratio, std = np.array([run.balance[2:] for run in with_bins]).reshape(-1, 2).T
    why = insufficiency(bins)
    if why is None and not np.isfinite(ratio + std).any():
        why = "no run has straight driving of sufficient length for an estimate of the resistance"
    if why is not None:
        return LearnedTerrain(terrain, tuple(runs), TargetStatus.UNESTIMATED, why)
    curve = learn_curve(bins, ratio, std, np.random.default_rng(seed))
    if (why := contradiction(curve)) is not None:
        return LearnedTerrain(terrain, tuple(runs), TargetStatus.INVALID, why, curve)
    return LearnedTerrain(terrain, tuple(runs), TargetStatus.ESTIMATED, "", curve, targets_of(curve))


def learn_terrains(
    runs: Sequence[RunLog],
    robot: Robot,
    seed: int,
    *,
    skip_faulty: bool = False,
    progress: Callable[[str, int, int], None] = lambda task, done, total: None,
) -> tuple[list[RunLog], list[TerrainRun], list[LearnedTerrain], list[str]]:
    """Measure labelled runs and learn each terrain.

    Parameters
    ----------
    runs : labelled, of the robot
    robot : whose they are
    seed : of the bootstrap
    skip_faulty : leave out runs that lack something, in place of refusing them
    progress : gets the task, how many of its steps are done, and how many there are

    Returns
    -------
    used : runs that were measured
    measured : each on each of its terrains
    learned : what was learned of each terrain
    faulty : a sentence for each run left out

    Raises
    ------
    DataError
        if a run is another robot's or lacks currents or attitude, or none is left.
    """
    used: list[RunLog] = []
    measured: list[TerrainRun] = []
    faulty: list[str] = []
    for done, run in enumerate(runs, start=1):
        try:
            measured += terrain_runs(run, robot)
            used.append(run)
        except DataError as error:
            if not skip_faulty:
                raise
            faulty.append(f"run skipped: {error}")
        progress("filter", done, len(runs))
    if not used:
        raise DataError("no run has what slip curves are learned from: labels, currents and attitude")
    learned = []
    terrains = sorted({run.terrain for run in measured})
    for done, terrain in enumerate(terrains, start=1):
        learned.append(learn_terrain(terrain, [run for run in measured if run.terrain == terrain], seed))
        progress("learn", done, len(terrains))
    return used, measured, learned, faulty
