"""Slip of a surface from the windows of its runs: medians with their interval, how they carry over, operating points.

Windows of one run are not independent: a run counts by the median of its windows, and intervals are those of
draws of whole runs.  How well a median carries over is what that of a fifth of the runs, held out, differs by
from that of the others; every fifth run is held out in the order of how they were driven (speed, then
direction), so that slip that depends on the direction is compared over the same directions.

The operating point of wheels at constant speed is their slip beside the current and, where motors are known, the
thrust.  Of a wheel with the current I (its magnitude, or positive where it drives),

    F = (kt n eta I - T_friction) / r,    F / N with N = m g / wheels

is the thrust over its share of the weight.  A run at constant speed has one such point; points that differ in
slip on one surface differ in how the robot was driven, and are no curve of thrust over slip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.constants import GRAVITY_MPS2
from terrain.measured_slip.slips import MeasuredSlip, spinning_wheels
from terrain.records import Array, RunLog
from terrain.robots import Robot

N_FOLDS = 5
N_DRAWS = 1000

MIN_TURN_RADPS = 0.2
"""Of wheels, from which their yaw rate is compared with that measured from outside."""


@dataclass(frozen=True, slots=True)
class SurfaceSlip:
    """Slip of a robot on a surface; NaN where it is not known.

    Parameters
    ----------
    terrain : name of the surface; empty for runs without a label
    n_runs, n_windows : with a slip in steady motion
    n_standing : windows without a slip because the robot stood, or because it was too uncertain
    slip_ratio, interval : median over runs of the slip of the body, and its 95 % interval over runs
    spread : quartiles of the windows
    std : median standard deviation of a window's slip
    held_out : largest difference of the median of a fifth of the runs from that of the others
    wheel_slip : median of each wheel, positive in traction whichever direction it rolls in
    turn_ratio : median yaw rate measured from outside over that of wheels without slip
    spinning : runs with a wheel that spins or lifts, and which
    """

    terrain: str
    n_runs: int
    n_windows: int
    n_standing: int
    slip_ratio: float
    interval: tuple[float, float]
    spread: tuple[float, float]
    std: float
    held_out: float
    wheel_slip: tuple[float, ...]
    turn_ratio: float
    spinning: tuple[str, ...]


def surface_slip(terrain: str, runs: Sequence[MeasuredSlip], rng: np.random.Generator) -> SurfaceSlip:
    """Return what runs on one surface measured, of their windows in steady motion."""
    steady = [run.steady for run in runs]
    slips = [run.body_slip[run.known] for run in runs]
    known = [i for i, slip in enumerate(slips) if slip.size]
    all_slips = np.concatenate(slips)
    medians = np.array([np.median(slips[i]) for i in known])
    stds = np.concatenate([run.body_slip_std[rows] for run, rows in zip(runs, steady, strict=True)])
    interval = (np.nan, np.nan)
    if medians.size > 1:
        draws = medians[bootstrap_rows(medians.size, N_DRAWS, rng)]
        interval = percentile_interval(np.median(draws, axis=1))
    quartiles = np.quantile(all_slips, [0.25, 0.75]) if all_slips.size else (np.nan, np.nan)
    return SurfaceSlip(
        terrain=terrain,
        n_runs=len(known),
        n_windows=int(all_slips.size),
        n_standing=int(sum((~np.isfinite(run.body_slip)).sum() for run in runs)),
        slip_ratio=_median(medians),
        interval=interval,
        spread=(float(quartiles[0]), float(quartiles[1])),
        std=_median(stds),
        held_out=_held_out(medians, _order([runs[i] for i in known])),
        wheel_slip=tuple(_wheel_medians(runs, steady).tolist()),
        turn_ratio=_turn_ratio(runs, steady),
        spinning=tuple(
            f"{run.run_id} ({', '.join(wheels)})" for run in runs if (wheels := spinning_wheels(run))
        ),
    )


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _order(runs: Sequence[MeasuredSlip]) -> Array:
    """Return the order of runs by the speed that their wheels roll at, then by direction."""
    twist = np.array([np.nanmedian(run.rolled_twist, axis=0) for run in runs]).reshape(-1, 3)
    speed = np.round(np.linalg.norm(twist[:, :2], axis=1), 1)
    return np.lexsort((np.arctan2(twist[:, 1], twist[:, 0]), speed))


def _held_out(medians: Array, order: Array) -> float:
    """Return the largest difference of a fold's median from that of the rest; NaN with too few runs."""
    if medians.size < N_FOLDS:
        return float("nan")
    folds = (order[k::N_FOLDS] for k in range(N_FOLDS))
    return max(float(abs(np.median(medians[fold]) - np.median(np.delete(medians, fold)))) for fold in folds)


def _wheel_medians(runs: Sequence[MeasuredSlip], steady: Sequence[Array]) -> Array:
    slips = np.concatenate(
        [
            (run.slip_ratio * np.where(run.wheel_speed_mps < 0.0, -1.0, 1.0))[rows]
            for run, rows in zip(runs, steady, strict=True)
        ]
    )
    return np.array([_median(wheel) for wheel in slips.T])


def _turn_ratio(runs: Sequence[MeasuredSlip], steady: Sequence[Array]) -> float:
    ratios = []
    for run, rows in zip(runs, steady, strict=True):
        by_wheels, seen = run.rolled_twist[rows, 2], run.twist[rows, 2]
        with np.errstate(invalid="ignore"):
            turns = np.abs(by_wheels) >= MIN_TURN_RADPS
        ratios.append(seen[turns] / by_wheels[turns])
    return _median(np.concatenate(ratios))


class OperatingPoints(NamedTuple):
    """Points of runs, (n,) each; NaN where it is not known.

    Parameters
    ----------
    slip_ratio : median of the body over a run's windows in steady motion
    current_a : median over these of the mean of the wheels
    thrust_ratio : mean thrust of a wheel over its share of the weight
    """

    slip_ratio: Array
    current_a: Array
    thrust_ratio: Array


def operating_points(runs: Sequence[RunLog], slips: Sequence[MeasuredSlip], robot: Robot) -> OperatingPoints:
    """Return the operating point of each run."""
    rows = [_point(run, slip, robot) for run, slip in zip(runs, slips, strict=True)]
    return OperatingPoints(*np.array(rows).reshape(-1, 3).T)


def _point(run: RunLog, slip: MeasuredSlip, robot: Robot) -> tuple[float, float, float]:
    rows = slip.known
    if not rows.size:
        return np.nan, np.nan, np.nan
    ratio = float(np.median(slip.body_slip[rows]))
    names = [f"current_{wheel}_a" for wheel in robot.wheels]
    wheels = run.streams["wheels"]
    if not set(names) <= set(wheels.channels):
        return ratio, np.nan, np.nan
    current = np.abs(np.column_stack([wheels.channel(name) for name in names]))
    inside = np.zeros(len(wheels), dtype=bool)
    for row in rows:
        inside |= (wheels.time_s >= slip.start_s[row]) & (wheels.time_s <= slip.end_s[row])
    known = np.isfinite(current).all(axis=1) & inside
    if not known.any():
        return ratio, np.nan, np.nan
    mean_a = float(current[known].mean())
    if not robot.describes("motors"):
        return ratio, mean_a, np.nan
    load_n = robot.mass_kg * GRAVITY_MPS2 / len(robot.wheels)
    return (
        ratio,
        mean_a,
        (mean_a * robot.motors.nm_per_a - robot.motors.friction_nm) / robot.wheel_radius_m / load_n,
    )
