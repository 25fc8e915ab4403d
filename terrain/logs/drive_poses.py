"""Lidar poses of the commands of DRIVE, window by window, to judge where a robot was after some seconds."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from terrain.logs.drive import (
    DriveRobot,
    DriveWindows,
    commands_of,
    find_sessions,
    named_run,
    on_one_clock,
)
from terrain.logs.lidar_twist import dated, new_poses, usual_wait
from terrain.records import Array


class WindowPoses(NamedTuple):
    """Poses of a window of a command, in the frame of the first of them.

    Parameters
    ----------
    time_s : (m,) on the clock of the run
    pose : (m, 3) x, y and yaw of the lidar's point
    """

    time_s: Array
    pose: Array


def read_window_poses(folder: Path, robot: DriveRobot) -> dict[str, tuple[WindowPoses, ...]]:
    """Return the lidar poses of each run's windows, as far as their time is known.

    A window without two such poses is left out.

    Parameters
    ----------
    folder, robot : as :func:`terrain.logs.drive.find_runs` takes them

    Raises
    ------
    LogError
        as that does.
    """
    found: dict[str, tuple[WindowPoses, ...]] = {}
    for path in find_sessions(folder):
        for windows, start, end in commands_of(path, path != folder, robot):
            run_id, _ = named_run(windows, start, end)
            kept, time_s = on_one_clock(windows, start, end)
            begins_s = time_s[np.cumsum(kept.sum(axis=1)) - 1] - windows.time_s[-1]
            scan = usual_wait(new_poses(windows.pose))
            poses = (_window_poses(windows, start + i, begins_s[i], scan) for i in range(end - start))
            found[run_id] = tuple(window for window in poses if len(window.time_s) > 1)
    return found


def _window_poses(windows: DriveWindows, which: int, begins_s: float, scan: int) -> WindowPoses:
    """Return the poses of one window whose time is known, in the frame of the first."""
    published = windows.pose[which]
    arrival = np.flatnonzero(new_poses(published[None])[0])
    at, usable = dated(arrival, len(published), scan)
    pose = published[arrival[usable]].copy()
    pose[:, 2] = np.unwrap(pose[:, 2])
    if not len(pose):
        return WindowPoses(np.empty(0), pose)
    heading = pose[0, 2] - windows.frame_yaw[which]
    offset = (pose[:, 0] - pose[0, 0] + 1j * (pose[:, 1] - pose[0, 1])) * np.exp(-1j * heading)
    moved = np.column_stack([offset.real, offset.imag, pose[:, 2] - pose[0, 2]])
    return WindowPoses(begins_s + windows.time_s[at[usable]], moved)
