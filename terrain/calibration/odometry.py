"""Odometry of a tracked robot fitted to folds of runs and judged on the others, with the slip model of all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from terrain.calibration.adaptive_legs import dead_reckoning, efficiencies_before, of_point
from terrain.calibration.odometry_fit import (
    ENCODER,
    GYRODOMETRY,
    SLIP,
    FittedOdometry,
    fit_odometry,
    level,
    without_tilt,
)
from terrain.calibration.odometry_judge import LegScores, held_out_ends, score_legs
from terrain.calibration.odometry_legs import Leg, legs_of_poses, legs_of_windows
from terrain.errors import DataError
from terrain.estimation.observers.slip_model import PARAMETERS, SlipModel
from terrain.logs.drive_poses import WindowPoses
from terrain.records import Array, RunLog
from terrain.robots import TrackedRobot

SHORT_RATIO = 0.8
"""A command's leg that is so much shorter than the longest of all is left out: its windows are not whole."""

ADAPTIVE = "adaptive observer"


@dataclass(frozen=True, slots=True)
class ParameterFound:
    """A parameter of a slip model: its value and its 95 % interval, NaN where it was not fitted."""

    value: float
    low: float
    high: float


class JudgedOdometry(NamedTuple):
    """What kinds of odometry are worth, and the slip model.

    Parameters
    ----------
    n_runs : runs with poses
    scores : by length of the legs
    model : slip model of slip-compensated odometry, fitted to all runs
    parameters : of that
    observed_point_m, observed_angle_rad : where the point that poses show lies in the body, and by which the
        sensor of the poses is turned
    adaptive : scores of the last windows of commands, by the adaptive observer and others; None without
    delay_s : of the poses behind the gyro
    flat : whether no slope was driven, or no tilt measured, so that what slopes do is not fitted
    """

    n_runs: int
    scores: tuple[LegScores, ...]
    model: SlipModel
    parameters: Mapping[str, ParameterFound]
    observed_point_m: tuple[float, float]
    observed_angle_rad: float
    adaptive: LegScores | None
    delay_s: float
    flat: bool


def judge_odometry(
    runs: Sequence[RunLog],
    windows: Mapping[str, tuple[WindowPoses, ...]],
    robot: TrackedRobot,
    lengths_s: Sequence[float],
    folds: int,
    seed: int,
    count: Callable[[int, int], None] = lambda done, total: None,
) -> JudgedOdometry:
    """Fit kinds of odometry to folds of runs, judge them on the others, and fit the slip model to all.

    Parameters
    ----------
    runs : with poses, or commands of DRIVE
    windows : poses of the windows of DRIVE, by run; empty for runs with poses
    robot : whose they are
    lengths_s : after which poses are compared; windows of DRIVE have their own
    folds, seed : of whole runs
    count : gets how many fits are done, and how many there are

    Raises
    ------
    DataError
        if fewer runs than folds have poses.
    """
    delay_s = robot.identified.get("lidar_delay_s", 0.0) if windows else 0.0
    groups = (
        _window_groups(runs, windows, robot, delay_s)
        if windows
        else {f"{length:g} s": _pose_legs(runs, robot, length) for length in lengths_s}
    )
    groups = {name: legs for name, legs in groups.items() if legs}
    if not groups:
        raise DataError(
            "no run has poses of a camera or lidar, beside tracks and gyro, over "
            f"{' or '.join(f'{length:g}' for length in lengths_s)} s"
        )
    ends = held_out_ends(groups, robot, folds, seed, count)
    scores = tuple(
        score_legs(legs, {kind: by[name] for kind, by in ends.items()}, seed) for name, legs in groups.items()
    )
    every = [leg for legs in groups.values() for leg in legs]
    n_runs = len({leg.run for leg in every})
    flat = without_tilt(every)
    fitted = fit_odometry(level(SLIP) if flat else SLIP, every, robot)
    adaptive = None
    if windows:
        adaptive = _adaptive(runs, windows, groups, ends, robot, delay_s, fitted.mount, seed)
    x_m, y_m, angle_rad = map(float, fitted.mount)
    found = _parameters(fitted, n_runs)
    return JudgedOdometry(n_runs, scores, fitted.model, found, (x_m, y_m), angle_rad, adaptive, delay_s, flat)


def _window_groups(
    runs: Sequence[RunLog],
    windows: Mapping[str, tuple[WindowPoses, ...]],
    robot: TrackedRobot,
    delay_s: float,
) -> dict[str, list[Leg]]:
    single: list[Leg] = []
    chained: list[Leg] = []
    for number, run in enumerate(runs):
        own, whole = legs_of_windows(run, number, windows.get(run.run_id, ()), robot, delay_s)
        single += own
        chained += [whole] if whole is not None else []
    longest_s = max((leg.length_s for leg in chained), default=0.0)
    return {"window": single, "command": [leg for leg in chained if leg.length_s > SHORT_RATIO * longest_s]}


def _pose_legs(runs: Sequence[RunLog], robot: TrackedRobot, length_s: float) -> list[Leg]:
    return [
        leg
        for number, run in enumerate(runs)
        if "pose" in run.streams
        for leg in legs_of_poses(run, number, robot, length_s)
    ]


def _parameters(fitted: FittedOdometry, n_runs: int) -> dict[str, ParameterFound]:
    """Return the fitted parameters, with intervals by Student's t over runs: the clusters of the fit."""
    std = np.sqrt(np.diag(fitted.model.covariance))
    wide = float(student.ppf(0.975, max(n_runs - 1, 1)))
    reach = np.where(np.isin(np.arange(len(std)), fitted.kind.free), wide * std, np.nan)
    return {
        name: ParameterFound(float(value), float(value - half), float(value + half))
        for name, value, half in zip(PARAMETERS, fitted.model.vector, reach, strict=True)
        if np.isfinite(half)
    }


def _adaptive(
    runs: Sequence[RunLog],
    windows: Mapping[str, tuple[WindowPoses, ...]],
    groups: Mapping[str, Sequence[Leg]],
    ends: Mapping[str, Mapping[str, Array]],
    robot: TrackedRobot,
    delay_s: float,
    mount: Array,
    seed: int,
) -> LegScores | None:
    """Return the scores over the last windows of commands."""
    single = groups["window"]
    last_of = {leg.run: k for k, leg in enumerate(single)}
    chosen, predicted = [], []
    for number, run in enumerate(runs):
        eta = efficiencies_before(run, windows.get(run.run_id, ()), robot, delay_s, mount)
        if eta is not None and number in last_of:
            chosen.append(last_of[number])
            predicted.append(of_point(dead_reckoning(single[last_of[number]], eta, robot), mount))
    if len(chosen) < 2:
        return None
    compared = {kind.name: ends[kind.name]["window"][chosen] for kind in (ENCODER, GYRODOMETRY)}
    return score_legs([single[k] for k in chosen], compared | {ADAPTIVE: np.array(predicted)}, seed)
