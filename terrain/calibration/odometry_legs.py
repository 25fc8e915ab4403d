"""Legs of a drive: where a robot was after some seconds, by lidar or cameras, beside its own sensors.

A leg begins and ends at a pose.  Poses of one fixed frame are cut into legs one after the other; those of the
windows of DRIVE are legs as they are, and chained over a whole command: what was driven from the last pose of
a window to the first of the next, some tenths of a second, is bridged by the speeds that the lidar shows
there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.angles import unwrapped
from terrain.calibration.track_motion import odometry_rows
from terrain.errors import DataError
from terrain.logs.drive_poses import WindowPoses
from terrain.records import Array, RunLog
from terrain.robots import TrackedRobot

STEP_S = 0.05
"""Longest step within a leg: that of the logs of DRIVE."""

GAP_S = 0.25
"""Longest time without a sample within a leg, and without a pose at its ends."""

MAX_BRIDGE_S = 0.5
"""Longest gap between two windows that is bridged."""


class Leg(NamedTuple):
    """A stretch of a run.

    Parameters
    ----------
    run : number of the run
    moved : (3,) measured change of pose of the observed point, in the frame of its first pose
    step_s : from sample to sample
    speeds_mps : (n, 2) of the tracks
    yaw_rate_radps : (n,) of the gyro
    tilt_rad : (n, 2) roll and pitch; 0 where they are not measured
    length_s : of the leg
    """

    run: int
    moved: Array
    step_s: float
    speeds_mps: Array
    yaw_rate_radps: Array
    tilt_rad: Array
    length_s: float


def legs_of_windows(
    run: RunLog, number: int, windows: Sequence[WindowPoses], robot: TrackedRobot, delay_s: float
) -> tuple[list[Leg], Leg | None]:
    """Return the legs of a command's windows, and that of all of them in a row; None where they have gaps.

    Parameters
    ----------
    run : of the command
    number : of the run
    windows : its poses
    robot : that drove
    delay_s : of the poses behind the gyro and the tracks

    Notes
    -----
    Poses are of an earlier time than their stamps by the delay; before its first sample a run is taken to
    have driven as at that.
    """
    found = (
        _leg(run, number, window.pose[-1], (window.time_s[0], window.time_s[-1]), robot, delay_s)
        for window in windows
    )
    single = [leg for leg in found if leg is not None]
    moved = np.zeros(3)
    for k, window in enumerate(windows):
        if k > 0:
            bridge = window_bridge(run, windows[k - 1].time_s[-1], window.time_s[0])
            if bridge is None:
                return single, None
            moved = composed(moved, bridge)
        moved = composed(moved, window.pose[-1])
    if len(windows) < 2:
        return single, None
    ends = windows[0].time_s[0], windows[-1].time_s[-1]
    return single, _leg(run, number, moved, ends, robot, delay_s)


def legs_of_poses(
    run: RunLog, number: int, robot: TrackedRobot, length_s: float, delay_s: float = 0.0
) -> list[Leg]:
    """Return legs of a run with poses in one frame, one after the other.

    Parameters
    ----------
    run : with the stream pose
    number : of the run
    robot : that drove
    length_s : of each leg
    delay_s : of the poses behind the gyro and the tracks
    """
    pose = run.streams["pose"]
    values = pose.values.copy()
    values[:, 2] = unwrapped(values[:, 2])
    known = np.isfinite(values).all(axis=1)
    time_s, values = pose.time_s[known], values[known]
    legs: list[Leg] = []
    if not len(time_s):
        return legs
    for begin_s in np.arange(time_s[0], time_s[-1] - length_s + 1e-9, length_s):
        first, last = np.searchsorted(time_s, [begin_s - 1e-9, begin_s + length_s - 1e-9]).tolist()
        last = min(last, len(time_s) - 1)
        late_s = max(time_s[first] - begin_s, abs(time_s[last] - begin_s - length_s))
        if late_s > GAP_S:  # no pose there
            continue
        moved = relative(values[first], values[last])
        leg = _leg(run, number, moved, (time_s[first], time_s[last]), robot, delay_s)
        legs += [leg] if leg is not None else []
    return legs


def composed(first: Array, then: Array) -> Array:
    """Return the pose (3,) after one change of pose and another in its frame.

    Examples
    --------
    >>> composed(np.array([1.0, 0.0, np.pi / 2]), np.array([1.0, 0.0, 0.0])).round(6).tolist()
    [1.0, 1.0, 1.570796]
    """
    cos, sin = np.cos(first[2]), np.sin(first[2])
    x, y = cos * then[0] - sin * then[1], sin * then[0] + cos * then[1]
    return np.array([first[0] + x, first[1] + y, first[2] + then[2]])


def relative(first: Array, last: Array) -> Array:
    """Return a pose (3,) in the frame of another.

    Examples
    --------
    >>> start, change = np.array([1.0, 2.0, 0.3]), np.array([0.5, -0.2, 0.1])
    >>> relative(start, composed(start, change)).round(6).tolist()
    [0.5, -0.2, 0.1]
    """
    cos, sin = np.cos(first[2]), np.sin(first[2])
    x, y = last[0] - first[0], last[1] - first[1]
    return np.array([cos * x + sin * y, cos * y - sin * x, last[2] - first[2]])


def _leg(
    run: RunLog, number: int, moved: Array, ends_s: tuple[float, float], robot: TrackedRobot, delay_s: float
) -> Leg | None:
    """Return a leg; None where tracks or gyro were not measured in a part of it."""
    time_s, rows = odometry_rows(run, robot)
    if not np.isfinite(rows[:, 2]).any():
        raise DataError(f"run {run.run_id!r} has no gyro_z_radps, which odometry with slip needs")
    for column in (0, 1, 2):
        if _has_gap(time_s[np.isfinite(rows[:, column])], ends_s[0] - delay_s, ends_s[1] - delay_s):
            return None
    length_s = ends_s[1] - ends_s[0]
    n = max(int(np.ceil(length_s / STEP_S)), 1)
    step_s = length_s / n
    at_s = ends_s[0] - delay_s + (np.arange(n) + 0.5) * step_s
    known = np.isfinite(rows)
    left, right, rate, roll, pitch = (
        np.interp(at_s, time_s[known[:, k]], rows[known[:, k], k]) if known[:, k].any() else np.zeros(n)
        for k in range(5)
    )
    return Leg(
        number, moved, step_s, np.column_stack([left, right]), rate, np.column_stack([roll, pitch]), length_s
    )


def _has_gap(time_s: Array, from_s: float, to_s: float) -> bool:
    """Return whether samples leave a gap between two times; a run may begin a delay after the first."""
    inside = time_s[(time_s > from_s - GAP_S) & (time_s < to_s + GAP_S)]
    if len(inside) < 2:
        return True
    return bool(
        np.diff(inside).max() > GAP_S or inside[-1] < to_s - GAP_S or inside[0] > from_s + MAX_BRIDGE_S
    )


def window_bridge(run: RunLog, from_s: float, to_s: float) -> Array | None:
    """Return the change of pose between two times by the speeds that a lidar shows around them."""
    lidar = run.streams.get("lidar")
    if lidar is None or not 0.0 <= to_s - from_s <= MAX_BRIDGE_S:
        return None
    known = np.isfinite(lidar.values).all(axis=1)
    near = known & (np.abs(lidar.time_s - 0.5 * (from_s + to_s)) < 2.0 * MAX_BRIDGE_S)
    if near.sum() < 3:
        return None
    speed_x, speed_y, rate = lidar.values[near].mean(axis=0) * (to_s - from_s)
    half = 0.5 * rate
    return composed(np.array([0.0, 0.0, half]), np.array([speed_x, speed_y, half]))
