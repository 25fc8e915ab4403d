r"""Reader of the logs of DRIVE: random wheel commands in, lidar pose out.

A session is a folder with ``samples.csv.gz``, windows of 40 samples at 20 Hz (Baril et al., DRIVE:
Data-driven Robot Input Vector Exploration, ICRA 2024; repositories norlab-ulaval/DRIVE, ``calib_data``, and
norlab-ulaval/doughnut_calib).  Three windows belong to a command, one while the
robot changes its speed (``steady`` 0) and two after (``steady`` 1): they become a run ``step_000``,
``step_001``, ...  The file does not name its robot, which has to be given.

Folders of sessions are read as one data set: runs are ``asphalt_1_step_000``, ..., and name their session.  A
session's folder that is named ``<terrain>_<number>`` labels its runs; other runs have no label.

Streams are ``wheels``, ``imu`` and ``commands`` (:data:`STREAMS`), in which ``imu_yaw`` is a rate and no angle, and
``lidar`` of ``icp_x icp_y icp_yaw`` (:func:`~terrain.logs.held.body_twists`).

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
    dated_poses,
    frame_coefficient,
    is_first_pose,
    new_poses,
    undo_hold,
    usual_hold,
    usual_wait,
)
from terrain.logs.imu_axes import find_axes
from terrain.logs.samples import check_log_file, checked_names, checked_stream, short_name
from terrain.logs.tables import read_table, row_number
from terrain.records import Array, Label, RunLog

FILE_NAME = "samples.csv.gz"

STREAMS: dict[str, dict[str, tuple[str, float]]] = {
    "wheels": {"speed_left_mps": ("wheel_left", 1.0), "speed_right_mps": ("wheel_right", 1.0)},
    "imu": {
        "gyro_z_radps": ("imu_yaw", 1.0),
        "accel_x_mps2": ("imu_ax", -1.0),
        "accel_y_mps2": ("imu_ay", -1.0),
        "accel_z_mps2": ("imu_az", 1.0),
    },
    "commands": {"wheel_left_radps": ("cmd_left", 1.0), "wheel_right_radps": ("cmd_right", 1.0)},
}
"""Column and factor of each channel that is read as it stands; those of the wheels are times the radius."""

MAX_OVERSPEED = 1.5
"""Wheels that turn so many times as fast as the robot's own ever do are those of another robot; downhill, or
with a measurement's noise, they turn 1.1 times as fast."""

_KEYS, _POSE = ("step", "window", "steady", "time"), ("icp_x", "icp_y", "icp_yaw")
_MAX_OVERLAP = 5  # samples; 3 is the most that is there


class DriveRobot(NamedTuple):
    """What a reader has to know of the robot that a log does not name; its fastest wheel rate may be infinite."""

    name: str
    wheel_radius_m: float
    wheel_rate_max_radps: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class _Session:
    """A whole session: n windows of k samples."""

    file: str
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


class _Command(NamedTuple):
    """The windows ``start`` to ``end``, not included, of a session that make a run."""

    windows: _Session
    start: int
    end: int

    def name(self) -> tuple[str, int]:
        """Return the id of the run and the step of the command."""
        windows, steps = self.windows, np.unique(self.windows.step[self.start + 1 : self.end])
        if not steps.size:
            raise LogError(
                f"{windows.file}: the command of step {windows.step[self.start]} has one window only, "
                "at least one with steady 1 must follow it"
            )
        if steps.size > 1:
            listed = ", ".join(map(str, steps))
            raise LogError(f"{windows.file}: the windows of one command have the steps {listed}")
        return "_".join([*filter(None, [windows.session]), f"step_{steps[0]:03d}"]), int(steps[0])

    def clock(self) -> tuple[Array, Array]:
        """Return which samples (windows, k) to keep, and the time of these from the first one of the run."""
        time_s, steady = self.windows.time_s, self.windows.steady[self.start : self.end]
        period_s = float(time_s[1] - time_s[0])
        logged = [self.windows.values[name][self.start : self.end] for name in ("wheels", "imu")]
        logged_all = np.concatenate(logged, axis=-1)
        kept, at_s = np.ones(logged_all.shape[:2], dtype=bool), np.zeros(len(steady))
        for i in range(1, len(steady)):
            before, after = logged_all[i - 1], logged_all[i]
            lengths = range(1, _MAX_OVERLAP + 1)
            if np.array_equal(before[-2], before[-1], equal_nan=True):
                lengths = range(0)  # a row that was held shows nothing
            again = max(
                (n for n in lengths if np.array_equal(before[-n:], after[:n], equal_nan=True)), default=0
            )
            kept[i, :again] = False
            lost = 1 if steady[i - 1] == 0 and not again else 0
            at_s[i] = at_s[i - 1] + (time_s.size - again + lost) * period_s
        return kept, (at_s[:, None] + time_s - time_s[0])[kept]

    def run(self, *, repair: bool = False) -> RunLog:
        windows = self.windows
        run_id, step = self.name()
        kept, time_s = self.clock()
        dropped: Counter[str] = Counter(windows.repairs)
        streams = {}
        for name, logged in windows.values.items():
            values = logged[self.start : self.end][kept]
            if name == "wheels":
                values = undo_hold(values, time_s, windows.held)
            sources = STREAMS.get(name, {})
            streams[name] = checked_stream(
                f"{windows.file}, {run_id}",
                time_s,
                values,
                list(sources) or TWIST_CHANNELS,
                columns=[column for column, _ in sources.values()],
                repairs=dropped if repair else None,
                unknown_is_a_value=name == "lidar",
            )
        until_s = float(time_s[-1] + windows.time_s[1] - windows.time_s[0])
        labels = (Label(0.0, until_s, windows.terrain),) if windows.terrain else ()
        source = f"{windows.file}, step {step}, DRIVE layout"
        run = RunLog(run_id, windows.robot, streams, labels, source, dropped, windows.session)
        return checked_names(windows.file, run)


def find_sessions(folder: Path) -> list[Path]:
    """Return the folders of the sessions: ``folder`` itself, or, if any in it has a log, all those in it.

    Hidden folders are passed over.  ``LogError`` where there is a log in ``folder`` and in a folder in it.
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

    The list is empty when there is none.  The files are read at once, for all runs; ``LogError`` where one is broken
    or lacks a column, holds a cell that is no number, windows that are not all sampled alike, or wheels that turn
    faster than the robot's can.  A folder beside sessions that has no log has a reader too, which raises it.
    """
    readers: list[Callable[..., RunLog]] = []
    for path in find_sessions(folder):
        if (path / FILE_NAME).is_file():
            readers += [partial(_Command.run, command) for command in _commands_of(path, folder, robot)]
        else:
            readers.append(partial(_refuse, path))
    return readers


def _refuse(folder: Path, *, repair: bool = False) -> RunLog:
    raise LogError(f"{folder}: has no {FILE_NAME}, which the other sessions beside it have")


def _commands_of(path: Path, data: Path, robot: DriveRobot) -> list[_Command]:
    """Return the commands of a session; the name of its folder is that of the session if it has a number."""
    name = normal_name(path.resolve().name)
    numbered = re.fullmatch(r"(.+)_\d+", name)
    session = name if numbered or path != data else ""
    terrain = numbered[1] if numbered else ""
    windows = _read_session(check_log_file(path / FILE_NAME, path), robot, session, terrain)
    starts = np.flatnonzero(windows.steady == 0).tolist()
    if not starts or starts[0] != 0:
        raise LogError(f"{windows.file}: the first window has steady 1; a command begins with steady 0")
    ends = [*starts[1:], len(windows.steady)]
    return [_Command(windows, start, end) for start, end in zip(starts, ends, strict=True)]


def _read_session(path: Path, robot: DriveRobot, session: str, terrain: str) -> _Session:
    sources = {name: list(columns.values()) for name, columns in STREAMS.items()}
    read = [*_KEYS, *_POSE, *(column for pairs in sources.values() for column, _ in pairs)]
    table = read_table(path, read)
    keys = _checked_keys(path, table[:, : len(_KEYS)])
    n, k, _ = keys.shape
    time_s = keys[0, :, 3]
    period_s = round(float(time_s[-1] - time_s[0]) / (k - 1), 9)
    columns = dict(zip(read, table.T.reshape(-1, n, k), strict=True))
    values = {
        name: np.stack([columns[column] * factor for column, factor in pairs], axis=-1)
        for name, pairs in sources.items()
    }
    wheels, imu = values["wheels"], values["imu"]
    held = tuple(usual_hold(wheel, period_s) for wheel in np.moveaxis(wheels, -1, 0))
    refuse_other_robot(short_name(path), wheels, robot)
    wheels *= robot.wheel_radius_m
    axes = find_axes([(*w.T, i[:, 0], i[:, 1:]) for w, i in zip(wheels, imu, strict=True)], period_s)
    imu *= (axes.gyro_z, *axes.accel)
    repairs = axes.repairs()
    pose = np.stack([columns[name] for name in _POSE], axis=-1)
    frame_yaw = pose[:, :N_FRAME, 2].mean(axis=1)
    if is_first_pose(*frame_coefficient(pose, wheels, period_s)):
        frame_yaw = pose[:, 0, 2]
        repairs["lidar: positions in the frame of the first pose"] = len(pose)
    values["lidar"], _ = body_twists(pose, period_s, frame_yaw)
    step, steady = (keys[:, 0, i].astype(np.int64) for i in (0, 2))
    about = (short_name(path), robot.name, session, terrain, step, steady, np.arange(k) * period_s)
    return _Session(*about, values, held, repairs, pose, frame_yaw)


def refuse_other_robot(name: str, wheel_radps: Array, robot: DriveRobot) -> None:
    """Refuse wheels (..., 2) of a file that turn much faster than those of a robot ever do; ``LogError``."""
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
            f"{name}: {_KEYS[key]} at row {row_number(path, int(row))} is not finite ({keys[row, key]})"
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
    """Poses (m, 3) of a window in the frame of the first, x, y, yaw of the lidar's point, by time (m,) of the run."""

    time_s: Array
    pose: Array


def read_window_poses(folder: Path, robot: DriveRobot) -> dict[str, tuple[WindowPoses, ...]]:
    """Return the lidar poses of each run's windows, as far as their time is known.

    A window without two such poses is left out; ``folder`` and ``robot`` are as :func:`find_runs` takes them.
    """
    runs: dict[str, tuple[WindowPoses, ...]] = {}
    for path in find_sessions(folder):
        for command in _commands_of(path, folder, robot):
            session = command.windows
            kept, time_s = command.clock()
            begins_s = time_s[np.cumsum(kept.sum(axis=1)) - 1] - session.time_s[-1]
            new = new_poses(session.pose)
            scan = usual_wait(new)
            windows = []
            for i, begin_s in enumerate(begins_s, command.start):
                at, pose, _ = dated_poses(session.pose[i], new[i], scan)
                if len(pose) < 2:
                    continue
                turn = np.exp(-1j * (pose[0, 2] - session.frame_yaw[i]))
                place = (pose[:, 0] - pose[0, 0] + 1j * (pose[:, 1] - pose[0, 1])) * turn
                at_first = np.column_stack([place.real, place.imag, pose[:, 2] - pose[0, 2]])
                windows.append(WindowPoses(begin_s + session.time_s[at], at_first))
            runs[command.name()[0]] = tuple(windows)
    return runs
