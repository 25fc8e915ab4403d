"""What the experiments of a paper share: seeded runs, the true slip, means over runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from terrain.estimation.estimate import Estimate, estimate_run
from terrain.estimation.reference import lagged_slip, lagged_slip_at
from terrain.estimation.slip_figures import STEADY_SPEED_MPS, slip_figures
from terrain.records import Array, RunLog
from terrain.robots import Robot
from terrain.simulation.conditions import Faults
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario.legs import STAND_S

ROBOT = "agrimaro"
RUNS, FEW_RUNS = 5, 2
"""Number of runs that a figure is averaged over, and the number with ``quick``."""
START_S = (STAND_S, STAND_S + 2.0)
"""The start of the scenario ``straight`` at 1 m/s^2, and one second to settle."""
NO_SLIP_RATIO = 0.01
"""Slip that the thesis measures on tiles and regards as zero (7.2.3)."""


class Curve(NamedTuple):
    """Times (n,) in s, slip ratio (n, wheels) and forward speed (n,) in m/s."""

    time_s: Array
    slip_ratio: Array
    speed_mps: Array


def seeded_runs(
    robot: Robot,
    terrain: str,
    scenario: str,
    seed: int,
    quick: bool,
    duration_s: float | None = None,
    faults: Faults | None = None,
) -> list[RunLog]:
    """Return runs that differ in their random draws; arguments as for ``simulate_run``."""
    numbers = range(1, 1 + (FEW_RUNS if quick else RUNS))
    return [
        simulate_run(robot, terrain, scenario, seed, number, duration_s=duration_s, faults=faults)
        for number in numbers
    ]


def estimate_with_both_filters(runs: Sequence[RunLog], robot: Robot) -> tuple[list[Estimate], list[Estimate]]:
    """Return the estimates of the thesis' filter with its own noise, and of vio15 with physical noise."""
    return (
        [estimate_run(run, robot, "vio12", tuning="thesis") for run in runs],
        [estimate_run(run, robot, "vio15", tuning="physical") for run in runs],
    )


def curve_of(estimate: Estimate) -> Curve:
    """Return the slip that a filter estimated."""
    return Curve(estimate.track.time_s, estimate.slip.slip_ratio, estimate.track.state("speed_x_mps"))


def lagged_truth(run: RunLog, robot: Robot) -> Curve:
    """Return the true slip after the low-pass filter of the encoders: the best that can be estimated."""
    truth = run.streams["truth"]
    lag_s = robot.equipment.sensors.encoder_time_constant_s
    slip, ground_speed = lagged_slip(truth, robot, lag_s)
    return Curve(truth.time_s, slip, ground_speed.mean(axis=1))


def true_slip(estimate: Estimate) -> Array:
    """Return :func:`lagged_truth` (n, wheels) at the sample times of a filter."""
    return lagged_slip_at(estimate.run, estimate.robot, estimate.track.time_s)


def steady_mean(slip: Array, estimate: Estimate) -> float:
    """Return the mean over the wheels of a slip (n, wheels) while the true speed is steady."""
    truth = estimate.run.streams["truth"]
    steady = slip_figures(estimate.blind, truth.channel("speed_x_mps"), truth.time_s).steady
    return float(np.nanmean(slip[steady]))


def mean_between(slip: Array, estimate: Estimate, start_s: float, end_s: float) -> float:
    """Return the mean over the wheels of a slip (n, wheels) between two times."""
    time_s = estimate.track.time_s
    return float(np.nanmean(slip[(time_s >= start_s) & (time_s < end_s)]))


def extreme_in_start(
    curve: Curve, extreme: Callable[[Array], float], above_mps: float = STEADY_SPEED_MPS
) -> float:
    """Return the smallest or largest slip during the start, at speeds above ``above_mps``."""
    chosen = (curve.time_s > START_S[0]) & (curve.time_s < START_S[1]) & (curve.speed_mps > above_mps)
    values = curve.slip_ratio[chosen]
    return float(extreme(values[np.isfinite(values)]))
