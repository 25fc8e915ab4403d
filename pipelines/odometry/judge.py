"""``terrain odometry``: what slip-compensated odometry gains over others, on runs that were held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.stats import t as student

from pipelines.data.datasets import drive_robot
from pipelines.data.settings import RunsSettings
from pipelines.odometry.results import OdometryResult, ParameterFound
from pipelines.odometry.settings import OdometrySettings
from pipelines.reporting.progress import Progress, silent
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
from terrain.errors import ConfigError, DataError
from terrain.estimation.observers.slip_model import PARAMETERS
from terrain.estimation.observers.slip_model_file import check_slip_model_file, write_slip_model
from terrain.logs.drive import FILE_NAME, find_sessions
from terrain.logs.drive_poses import WindowPoses, read_window_poses
from terrain.records import Array, RunLog
from terrain.robots import TrackedRobot, as_drive, load_robot

SHORTEST_S, LONGEST_S = 0.2, 3600.0
"""Legs that are compared: the shortest has two poses of a lidar."""

SHORT_RATIO = 0.8
"""A command's leg that is so much shorter than the longest of all is left out: its windows are not whole."""

ADAPTIVE = "adaptive observer"


def judge_odometry(
    runs: Sequence[RunLog], source: RunsSettings, settings: OdometrySettings, progress: Progress = silent
) -> OdometryResult:
    """Fit kinds of odometry to folds of runs and judge them on the others; write the slip model of all.

    Parameters
    ----------
    runs : with poses, or commands of DRIVE
    source : where they were read from: poses of windows of DRIVE are read there
    settings : robot, lengths, folds

    Raises
    ------
    ConfigError
        if the robot is not tracked, a length is not accepted, or the file is there already.
    DataError
        if fewer runs than folds have poses.
    """
    refusal = "robot {name}: drive {drive!r} has no tracks; terrain odometry is for 'tracked'"
    robot = as_drive(TrackedRobot, load_robot(settings.robot), refusal)
    if not all(SHORTEST_S <= length <= LONGEST_S for length in settings.lengths) or not settings.lengths:
        raise ConfigError(f"--lengths: {SHORTEST_S:g} to {LONGEST_S:g} seconds are accepted")
    if settings.out is not None:
        check_slip_model_file(settings.out)
    delay_s = robot.identified.get("lidar_delay_s", 0.0)
    windows = _windows(source.data, robot)
    groups = (
        _window_groups(runs, windows, robot, delay_s)
        if windows
        else {f"{length:g} s": _pose_legs(runs, robot, length) for length in settings.lengths}
    )
    groups = {name: legs for name, legs in groups.items() if legs}
    if not groups:
        raise DataError(
            f"{source.data}: no run has poses of a camera or lidar, beside tracks and gyro, over "
            f"{' or '.join(f'{length:g}' for length in settings.lengths)} s"
        )
    ends = held_out_ends(
        groups, robot, settings.folds, settings.seed, lambda done, total: progress("odometry", done, total)
    )
    scores = tuple(
        score_legs(legs, {kind: by[name] for kind, by in ends.items()}, settings.seed)
        for name, legs in groups.items()
    )
    every = [leg for legs in groups.values() for leg in legs]
    n_runs = len({leg.run for leg in every})
    flat = without_tilt(every)
    fitted = fit_odometry(level(SLIP) if flat else SLIP, every, robot)
    if settings.out is not None:
        write_slip_model(settings.out, fitted.model, robot.name)
    notes = ("no slope was driven, or no tilt measured: what slopes do is not fitted",) if flat else ()
    return OdometryResult(
        robot.name,
        settings.seed,
        settings.folds,
        n_runs,
        scores,
        _parameters(fitted, n_runs),
        (float(fitted.mount[0]), float(fitted.mount[1])),
        float(fitted.mount[2]),
        delay_s if windows else 0.0,
        _adaptive(runs, windows, groups, ends, robot, delay_s, fitted.mount, settings.seed)
        if windows
        else None,
        settings.out,
        notes,
    )


def _windows(folder: Path, robot: TrackedRobot) -> Mapping[str, tuple[WindowPoses, ...]]:
    """Return the poses of the windows of DRIVE under a folder; none in another layout."""
    if not folder.is_dir() or not any((path / FILE_NAME).is_file() for path in find_sessions(folder)):
        return {}
    return read_window_poses(folder, drive_robot(robot))


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
