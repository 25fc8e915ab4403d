r"""Reader of the logs of DRIVE: random wheel commands in, lidar pose out.

A session is a folder with ``samples.csv.gz``, windows of 40 samples at 20 Hz (Baril et al., DRIVE:
Data-driven Robot Input Vector Exploration, ICRA 2024; repositories norlab-ulaval/DRIVE, ``calib_data``, and
norlab-ulaval/doughnut_calib).  Three windows belong to a command, one while the
robot changes its speed (``steady`` 0) and two after (``steady`` 1): they become a run ``step_000``,
``step_001``, ...  The file does not name its robot, which has to be given.

Folders of sessions are read as one data set: runs are ``asphalt_1_step_000``, ..., and name their session.  A
session's folder that is named ``<terrain>_<number>`` labels its runs; other runs have no label.

============  ==========================================  ===============================================
stream        channels                                    from
============  ==========================================  ===============================================
``wheels``    ``speed_left_mps speed_right_mps``          ``wheel_left wheel_right`` (rad/s) times the
                                                          nominal wheel radius
``imu``       ``gyro_z_radps``                            ``imu_yaw``, a rate and no angle
\             ``accel_x_mps2 accel_y_mps2 accel_z_mps2``  ``-imu_ax -imu_ay imu_az``, specific force
``lidar``     ``speed_x_mps speed_y_mps yaw_rate_radps``  ``icp_x icp_y icp_yaw``, see
                                                          :func:`~terrain.logs.held.body_twists`
``commands``  ``wheel_left_radps wheel_right_radps``      ``cmd_left cmd_right`` as published
============  ==========================================  ===============================================

Little of the files is documented.  What is assumed here was compared with the other columns, first of the
Husky's log, then of six sessions of a Warthog and one of a Marmotte:

- *Windows* follow on one another, and so do commands.  The one after a change of speed begins a sample
  late (wheel speeds, which are new every second sample of the Husky's, repeat across that edge in 15 % of the
  cases, and in 50 % elsewhere; every fifth of the Warthog's, in 60 % and 80 %); into the last one of five
  begins with the sample before it, which is read once.
  Within a window the clock is the nominal one; at its edge it is accurate to one sample.
- *Runs* begin where ``steady`` falls to 0.  ``step`` of such a window may still be the one before (62 of
  201), so that the windows after it number the run.
- ``imu_yaw`` is the rate of ``icp_yaw`` (of the Husky slope 1.00, offset 2 mrad/s); on a few sessions its
  sign is turned.  The Husky's accelerometer is turned by half a turn about z: speeding up and turning left
  both read negative, and the tilt of the lidar pose agrees.  The Warthog's is not, the Marmotte's lies upside
  down: what differs from the Husky's is found for each session by :mod:`terrain.logs.imu_axes`, turned and
  counted.
- ``icp_yaw`` is a difference of two wrapped angles, and the position of a window is turned by the mean of
  the first five of them, not by the first: ``icp_x`` points along the mean heading of the first 0.25 s.  The
  Marmotte's, of another repository, are in the frame of the first: :mod:`terrain.logs.held` finds it.
  Where the heading wraps within these (11 windows) that mean is no direction that the robot ever had.
- *Late*: the Husky's lidar lags the gyro by 0.16 s; after that their yaw rates agree to 0.03 rad/s rms.  Its
  wheel speeds lag the gyro by 0.26 s while speeds change.  The Warthog's lidar lags by 0.4 to 0.7 s, its
  wheels by 0.05 s.  Times are as logged; nothing is shifted, but poses that took longer than usual.
- *Held*: values are held from one message to the next.  A wheel speed that is usually held for over
  :data:`~terrain.logs.held.MAX_HELD_S` is read as a measurement at the sample where it is new, and as a
  straight line to the next one: held, the Warthog's wheels (4 Hz) would lag by 0.1 s more, in steps.
- ``cmd_*`` are no wheel speeds: below its limits the Husky drives 1.8 times as fast forward and turns its
  wheels 0.8 times as fast against each other.  Commands go up to 14.7 rad/s, steady wheels to 6.1 rad/s.
- ``steady``, ``icp_z``, ``icp_roll`` and ``icp_pitch`` are left out: the first says which window of a
  command it is, the others are relative to each window's own start.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from terrain.errors import LogError
from terrain.files.names import normal_name
from terrain.logs.held import CHANNELS as TWIST_CHANNELS
from terrain.logs.held import (
    N_FRAME,
    body_twists,
    dated,
    frame_coefficient,
    is_first_pose,
    new_poses,
    undo_hold,
    usual_hold,
    usual_wait,
)
from terrain.logs.imu_axes import ImuAxes, find_axes
from terrain.logs.samples import check_log_file, checked_names, checked_stream, short_name
from terrain.logs.tables import data_row, read_columns
from terrain.records import Array, Label, RunLog

FILE_NAME = "samples.csv.gz"

STREAMS: dict[str, dict[str, tuple[str, float]]] = {
    "wheels": {
        "speed_left_mps": ("wheel_left", 1.0),
        "speed_right_mps": ("wheel_right", 1.0),
    },
    "imu": {
        "gyro_z_radps": ("imu_yaw", 1.0),
        "accel_x_mps2": ("imu_ax", -1.0),
        "accel_y_mps2": ("imu_ay", -1.0),
        "accel_z_mps2": ("imu_az", 1.0),
    },
    "commands": {
        "wheel_left_radps": ("cmd_left", 1.0),
        "wheel_right_radps": ("cmd_right", 1.0),
    },
}
"""Column and factor of each channel that is read as it stands; those of the wheels are times the radius."""

MAX_OVERSPEED = 1.5
"""Wheels that turn so many times as fast as the robot's own ever do are those of another robot; downhill, or
with a measurement's noise, they turn 1.1 times as fast."""

_KEYS = ("step", "window", "steady", "time")
_POSE = ("icp_x", "icp_y", "icp_yaw")
_MAX_OVERLAP = 5  # samples; 3 is the most that is there
_SESSION_NAME = re.compile(r"(.+)_\d+")


class DriveRobot(NamedTuple):
    """What a reader has to know of the robot that a log does not name.

    Parameters
    ----------
    name : as run logs have it
    wheel_radius_m : nominal
    wheel_rate_max_radps : fastest that its wheels turn; infinite where unknown
    """

    name: str
    wheel_radius_m: float
    wheel_rate_max_radps: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class DriveWindows:
    """A whole session: n windows of k samples."""

    name: str
    robot: str
    session: str  # empty where it has no name
    terrain: str  # empty where unknown
    step: Array  # (n,)
    steady: Array  # (n,)
    time_s: Array  # (k,) within a window
    values: dict[str, Array]  # by stream (n, k, channels)
    held: tuple[int, ...]  # usual samples from one new value of a wheel to the next; 1 where not to be undone
    repairs: dict[str, int]  # of signs, as counts by kind
    pose: Array  # (n, k, 3) as published
    frame_yaw: Array  # (n,) heading of the frame of a window's positions


def find_sessions(folder: Path) -> list[Path]:
    """Return the folders of the sessions: ``folder`` itself, or, if any in it has a log, all those in it.

    Hidden folders are passed over.

    Raises
    ------
    LogError
        if there is a log in ``folder`` and in a folder in it.
    """
    inside = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    logged = [path for path in inside if (path / FILE_NAME).is_file()]
    if not (folder / FILE_NAME).is_file():
        return inside if logged else []
    if logged:
        raise LogError(
            f"{folder}: holds {FILE_NAME} itself and in {logged[0].name}; give the folder of one session, or "
            "one that holds the folders of sessions only"
        )
    return [folder]


def find_runs(folder: Path, robot: DriveRobot) -> list[Callable[..., RunLog]]:
    """Return one reader per command of the sessions in ``folder``; call it with ``repair=``.

    The list is empty when there is none.  The files are read at once, for all runs.  A folder beside sessions
    that has no log has a reader too: it raises :class:`LogError`.

    Parameters
    ----------
    folder : of a session, with the file ``samples.csv.gz``, or of folders of sessions
    robot : that drove them

    Raises
    ------
    LogError
        if a file is broken or lacks a column, holds a cell that is no number, windows that are not
        all sampled alike, or wheels that turn faster than the robot's can.
    """
    readers: list[Callable[..., RunLog]] = []
    for path in find_sessions(folder):
        if not (path / FILE_NAME).is_file():
            readers.append(partial(_refuse, path))
            continue
        readers += [partial(_run, *command) for command in commands_of(path, path != folder, robot)]
    return readers


def commands_of(path: Path, named: bool, robot: DriveRobot) -> list[tuple[DriveWindows, int, int]]:
    """Return the commands of a session: all its windows, and which of them are the command's.

    Parameters
    ----------
    path : folder of the session
    named : whether the name of its folder is that of the session, even without a number
    robot : that drove it
    """
    name = normal_name(path.resolve().name)
    numbered = _SESSION_NAME.fullmatch(name)
    session = name if numbered or named else ""
    windows = _read_windows(
        check_log_file(path / FILE_NAME, path), robot, session, numbered[1] if numbered else ""
    )
    starts = np.flatnonzero(windows.steady == 0)
    if starts.size == 0 or starts[0] != 0:
        raise LogError(f"{windows.name}: the first window has steady 1; a command begins with steady 0")
    ends = [*starts[1:].tolist(), len(windows.steady)]
    return [(windows, start, end) for start, end in zip(starts.tolist(), ends, strict=True)]


def _refuse(folder: Path, *, repair: bool = False) -> RunLog:
    raise LogError(f"{folder}: has no {FILE_NAME}, which the other sessions beside it have")


def _run(windows: DriveWindows, start: int, end: int, *, repair: bool = False) -> RunLog:
    """Return the run of the windows ``start`` to ``end``, the last not included."""
    run_id, step = named_run(windows, start, end)
    kept, time_s = on_one_clock(windows, start, end)
    dropped: Counter[str] = Counter(windows.repairs)
    streams = {}
    for name, logged in windows.values.items():
        is_lidar = name == "lidar"
        values = logged[start:end][kept]
        if name == "wheels":
            values = undo_hold(values, time_s, windows.held)
        columns = () if is_lidar else [column for column, _ in STREAMS[name].values()]
        streams[name] = checked_stream(
            f"{windows.name}, {run_id}",
            time_s,
            values,
            TWIST_CHANNELS if is_lidar else list(STREAMS[name]),
            row_of=int,  # times are made here: no row is at fault
            columns=columns,
            repairs=dropped if repair else None,
            unknown_is_a_value=is_lidar,
        )
    until_s = float(time_s[-1] + windows.time_s[1] - windows.time_s[0])
    run = RunLog(
        run_id,
        windows.robot,
        streams,
        (Label(0.0, until_s, windows.terrain),) if windows.terrain else (),
        source=f"{windows.name}, step {step}, DRIVE layout",
        dropped=dropped,
        session=windows.session,
    )
    return checked_names(windows.name, run)


def named_run(windows: DriveWindows, start: int, end: int) -> tuple[str, int]:
    """Return the name and the step of the run of some windows."""
    if end - start < 2:
        raise LogError(
            f"{windows.name}: the command of step {windows.step[start]} has one window only, "
            f"at least one with steady 1 must follow it"
        )
    steps = np.unique(windows.step[start + 1 : end])
    if steps.size > 1:
        raise LogError(
            f"{windows.name}: the windows of one command have the steps {', '.join(map(str, steps))}"
        )
    return "_".join([*filter(None, [windows.session]), f"step_{steps[0]:03d}"]), int(steps[0])


def on_one_clock(windows: DriveWindows, start: int, end: int) -> tuple[Array, Array]:
    """Return which samples (windows, k) to keep, and the time of these from the first one of the run."""
    time_s = windows.time_s
    period_s = float(time_s[1] - time_s[0])
    logged = np.concatenate([windows.values[name][start:end] for name in ("wheels", "imu")], axis=-1)
    kept = np.ones(logged.shape[:2], dtype=bool)
    at_s = np.zeros(end - start)
    for i in range(1, end - start):
        before, after = logged[i - 1], logged[i]
        lengths = range(1, _MAX_OVERLAP + 1)
        if np.array_equal(before[-2], before[-1], equal_nan=True):
            lengths = range(0)  # a row that was held says nothing
        again = max((n for n in lengths if np.array_equal(before[-n:], after[:n], equal_nan=True)), default=0)
        kept[i, :again] = False
        lost = 1 if windows.steady[start + i - 1] == 0 and not again else 0
        at_s[i] = at_s[i - 1] + (time_s.size - again + lost) * period_s
    return kept, (at_s[:, None] + time_s - time_s[0])[kept]


def _read_windows(path: Path, robot: DriveRobot, session: str, terrain: str) -> DriveWindows:
    sources = {name: list(columns.values()) for name, columns in STREAMS.items()}
    read = [*_KEYS, *_POSE, *(column for pairs in sources.values() for column, _ in pairs)]
    table = read_columns(path, read)
    keys = _checked_keys(path, table[:, : len(_KEYS)])
    n, k, _ = keys.shape
    time_s = keys[0, :, 3]
    period_s = round(float(time_s[-1] - time_s[0]) / (k - 1), 9)
    columns = dict(zip(read, table.T.reshape(-1, n, k), strict=True))
    values = {
        name: np.stack([columns[column] * factor for column, factor in pairs], axis=-1)
        for name, pairs in sources.items()
    }
    held = tuple(usual_hold(wheel, period_s) for wheel in np.moveaxis(values["wheels"], -1, 0))
    refuse_other_robot(short_name(path), values["wheels"], robot)
    values["wheels"] *= robot.wheel_radius_m
    axes = _imu_axes(values["wheels"], values["imu"], period_s)
    values["imu"] *= (axes.gyro_z, *axes.accel)
    pose = np.stack([columns[name] for name in _POSE], axis=-1)
    own_frame = is_first_pose(*frame_coefficient(pose, values["wheels"], period_s))
    frame_yaw = pose[:, 0, 2] if own_frame else pose[:, :N_FRAME, 2].mean(axis=1)
    values["lidar"], _ = body_twists(pose, period_s, frame_yaw=frame_yaw)
    step, steady = (keys[:, 0, i].astype(np.int64) for i in (0, 2))
    time_s = np.arange(k) * period_s
    name, repairs = short_name(path), axes.repairs()
    if own_frame:
        repairs["lidar: positions in the frame of the first pose"] = len(pose)
    labels = (name, robot.name, session, terrain)
    return DriveWindows(*labels, step, steady, time_s, values, held, repairs, pose, frame_yaw)


def _imu_axes(wheels_mps: Array, imu: Array, period_s: float) -> ImuAxes:
    """Return what brings the imu of a session, read as the Husky's, into the robot's axes."""
    return find_axes(
        [(each[:, 0], each[:, 1], own[:, 0], own[:, 1:]) for each, own in zip(wheels_mps, imu, strict=True)],
        period_s,
    )


def refuse_other_robot(name: str, wheel_radps: Array, robot: DriveRobot) -> None:
    """Refuse wheels that turn much faster than those of a robot ever do.

    Parameters
    ----------
    name : of the file, for the message
    wheel_radps : (..., 2)
    robot : that is taken for the one that drove
    """
    fastest = float(np.nanmax(np.abs(wheel_radps), initial=0.0))
    if fastest > MAX_OVERSPEED * robot.wheel_rate_max_radps:
        raise LogError(
            f"{name}: its wheels turn at up to {fastest:.1f} rad/s, those of robot {robot.name} at up to "
            f"{robot.wheel_rate_max_radps:.1f} rad/s: name the robot that drove it (--robot)"
        )


def _checked_keys(path: Path, keys: Array) -> Array:
    """Return step, window, steady and time as (n, k, 4), or say which window is not as the others."""
    name = short_name(path)
    if not len(keys):
        raise LogError(f"{name}: has no rows of data")
    for row, key in np.argwhere(~np.isfinite(keys)):
        raise LogError(
            f"{name}: {_KEYS[key]} at row {data_row(path, int(row))} is not finite ({keys[row, key]})"
        )
    starts = np.flatnonzero(np.diff(keys[:, 1], prepend=np.nan) != 0.0)
    sizes = np.diff(starts, append=len(keys))
    windows = [f"window {number:.15g}" for number in keys[starts, 1]]
    k = int(sizes[0])
    for i in np.flatnonzero(sizes != k):
        raise LogError(f"{name}: {windows[i]} has {sizes[i]} samples, the first one has {k}")
    if k <= N_FRAME:
        raise LogError(f"{name}: windows have {k} samples, more than {N_FRAME} are needed")
    keys = keys.reshape(-1, k, len(_KEYS))
    time_s = keys[0, :, 3]
    period_s = (time_s[-1] - time_s[0]) / (k - 1)
    if period_s <= 0.0 or np.ptp(np.diff(time_s)) > 1e-3 * period_s:
        raise LogError(f"{name}: time does not rise evenly in {windows[0]}")
    for i in np.flatnonzero(np.abs(keys[..., 3] - time_s).max(axis=1) > 1e-3 * period_s):
        raise LogError(f"{name}: time in {windows[i]} is not that of {windows[0]}")
    for key, accepted, highest in ((0, "one whole number from 0 up", np.inf), (2, "0 or 1 throughout", 1.0)):
        value = keys[..., key]
        first = value[:, :1]
        fits = (value == first) & (first == np.floor(first)) & (first >= 0.0) & (first <= highest)
        for i in np.flatnonzero(~fits.all(axis=1)):
            found = ", ".join(f"{v:.15g}" for v in np.unique(value[i]))
            raise LogError(f"{name}: {_KEYS[key]} in {windows[i]} is {found}; it must be {accepted}")
    return keys


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
