r"""Readers of the logs of DRIVE, random wheel commands in, lidar pose out: sessions of windows, and whole recordings.

**Sessions.**  A session is a folder with ``samples.csv.gz``, windows of 40 samples at 20 Hz (Baril et al., DRIVE:
Data-driven Robot Input Vector Exploration, ICRA 2024; repositories norlab-ulaval/DRIVE, ``calib_data``, and
norlab-ulaval/doughnut_calib).  Three windows belong to a command, one while the
robot changes its speed (``steady`` 0) and two after (``steady`` 1): they become a run ``step_000``,
``step_001``, ...  The file does not name its robot, which has to be given.

Folders of sessions are read as one data set: runs are ``asphalt_1_step_000``, ..., and name their session.  A
session's folder that is named ``<terrain>_<number>`` labels its runs; other runs have no label.

Streams are ``wheels``, ``imu`` and ``commands`` (:data:`STREAMS`), in which ``imu_yaw`` is a rate and no angle, and
``lidar`` of ``icp_x icp_y icp_yaw`` (:func:`body_twists`).

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
  Marmotte's, of another repository, are in the frame of the first: :func:`frame_coefficient` finds it.
  Where the heading wraps within these (11 windows) that mean is no direction that the robot ever had.
- *Late*: the Husky's lidar lags the gyro by 0.16 s; after that their yaw rates agree to 0.03 rad/s rms.  Its
  wheel speeds lag the gyro by 0.26 s while speeds change.  The Warthog's lidar lags by 0.4 to 0.7 s, its
  wheels by 0.05 s.  Times are as logged; nothing is shifted, but poses that took longer than usual.
- *Held*: values are held from one message to the next.  A wheel speed that is usually held for over
  :data:`MAX_HELD_S` is read as a measurement at the sample where it is new, and as a
  straight line to the next one: held, the Warthog's wheels (4 Hz) would lag by 0.1 s more, in steps.
- ``cmd_*`` are no wheel speeds: below its limits the Husky drives 1.8 times as fast forward and turns its
  wheels 0.8 times as fast against each other.  Commands go up to 14.7 rad/s, steady wheels to 6.1 rad/s.
- ``steady``, ``icp_z``, ``icp_roll`` and ``icp_pitch`` are left out: the first says which window of a
  command it is, the others are relative to each window's own start.

**Recordings**, with motor currents and lidar poses, the topics of a robot at 20 Hz:
``<robot>_<terrain>/<recording>.csv.gz`` (in both repositories, ``raw_dataframe``).  The folder names robot and
terrain, as ``husky_wet_grass``; a recording is the session of its runs.  A step is one command: what was driven under
it is a run ``<folder>_<recording>_step_001``; an operator drives before the first one and between them, which makes
the runs ``..._hand_000``.  Terrain is taken to be that of the folder throughout.

Streams are ``wheels`` (:data:`WHEELS`, times the nominal radius), ``imu`` (:data:`IMU`), ``commands``
(:data:`DESIRED`), and of ``icp_pos_*`` and ``icp_quat_*`` ``lidar`` (:func:`body_twists`) and ``pose``.

Nothing of this is documented by the authors.  Compared with one another, the columns of four recordings of a
Warthog and one of a Husky show:

- *State*: ``calib`` while a command drives, ``idle`` while an operator does, who then lets the command begin
  anew; empty before the first command, ``drive_finished`` after the last.  ``cmd_*`` of what an operator
  drives is not logged (it is 0, or that of the step): these runs have no ``commands``.
- *Signs*: the imu is a gyro in rad/s and a specific force, with the axes of the robot on the Warthog
  (:mod:`terrain.logs.imu_axes` finds others).  It agrees with the lidar's yaw rate to 2 % and with the
  wheels' at r = 0.998.
- *Poses* are of one fixed frame, that of the first scan, and head where the robot does: turned by their yaw
  their speed sideways is 0.02 m/s rms.
- *Late*: lidar poses lag the gyro by 0.25 to 0.5 s, the wheels by 0.05 to 0.1 s.  Times are as logged.
- *Held*: the Warthog's wheels are new every 0.25 s, its currents and voltages every second, the Husky's every
  0.15 s; they are read as straight lines between (:func:`undo_hold`).
- *Currents* of the Husky are never negative: magnitudes, which stay as they are and are counted.  The
  Warthog's are positive where a side drives, forwards or backwards, and negative where it brakes: the sign of
  the power, which is turned into that of the torque (forward positive) by the rotation of the wheel, and
  counted.  Voltages are the supply's, not the motors'.
- *Missing*: a column that holds nothing but 0 was not recorded (the Husky's imu), and the imu is 0 before its
  first message.  Both are left out.
- *Lost*: on the wet grass poses jump by up to 12 m.  Where they scatter too much for a speed they are NaN.

**Held values.**  What is held is read at the rate at which it really changes; poses give speeds of the body, and the
frame that the positions of windows are in: that of the first pose, or the mean of the first five.  The authors turned
the positions of each window by the mean heading of its first five samples; in other sets of theirs they are in the
frame of the first pose.  Nothing in the files says which.  While a robot
turns the two differ, and a path that is laid out by lidar headings and wheel directions shows it: with the
chords :math:`\Delta p_k` between the poses of a window and the middle headings :math:`\bar\psi_k`,

.. math:: \rho = \arg \sum_k \pm \Delta p_k e^{-i \bar\psi_k} = a\, \bar\psi_{1..5} - c\, w + b ,

where a is -1 for the mean of five and 0 for the first pose, c is the side slip in turns, which turns all of a
window's path alike, and w its mean yaw rate.  A robot that changes its turning distinguishes a from c.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from terrain.angles import arcs
from terrain.errors import LogError
from terrain.files.names import normal_name
from terrain.logs.imu_axes import MIN_MOVING_RADPS, POWER_SIGN, current_sign, find_axes, with_sign_of_torque
from terrain.logs.samples import (
    check_log_file,
    checked_names,
    checked_stream,
    rising_rows,
    short_name,
)
from terrain.logs.schema import POSE_CHANNELS, TWIST
from terrain.logs.tables import read_groups, row_number, text_rows
from terrain.records import Array, Label, RunLog

FILE_NAME = "samples.csv.gz"
SUFFIX = ".csv.gz"

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
"""Column of a session and factor of each channel; those of the wheels are times the radius."""

WHEELS: dict[str, str] = {
    **{f"speed_{side}_mps": f"meas_{side}_vel" for side in ("left", "right")},
    **{f"current_{side}_a": f"{side}_wheel_current" for side in ("left", "right")},
    **{f"voltage_{side}_v": f"{side}_wheel_voltage" for side in ("left", "right")},
}
IMU: dict[str, str] = {
    **{f"gyro_{axis}_radps": f"imu_{axis}" for axis in "xyz"},
    **{f"accel_{axis}_mps2": f"imu_acceleration_{axis}" for axis in "xyz"},
}
DESIRED: dict[str, str] = {"speed_x_mps": "cmd_vel_x", "yaw_rate_radps": "cmd_vel_omega"}
"""Column of a recording for each channel."""

MAX_OVERSPEED = 1.5
"""Wheels that turn so many times as fast as the robot's own ever do are those of another robot; downhill, or
with a measurement's noise, they turn 1.1 times as fast."""

MIN_RUN_S = 2.0  #: Shorter stretches hold no window and no steady speed
STANDING_S = 2.0  #: So long without motion ends what an operator drove
MARGIN_S = 0.5  #: What is kept of the standing before and after it: starts and stops are whole
BREAK_PERIODS = 2.5  #: A longer wait between two rows ends a run: samples are lost
COMMANDED = "calib"  #: State in which the logged command drives

NOT_RECORDED = "columns that were not recorded"
LOST = "poses where the lidar lost the robot"
STILL = "commands under which nothing moved"

_KEYS, _POSE = ("step", "window", "steady", "time"), ("icp_x", "icp_y", "icp_yaw")
_POSITION, _QUATERNION = ("icp_pos_x", "icp_pos_y"), tuple(f"icp_quat_{part}" for part in "xyzw")
_MAX_OVERLAP = 5  # samples; 3 is the most that is there


class DriveRobot(NamedTuple):
    """What a reader has to know of the robot that a log does not name; its fastest wheel rate may be infinite."""

    name: str
    wheel_radius_m: float
    wheel_rate_max_radps: float = math.inf

    def check(self, file: str, wheel_radps: Array) -> None:
        """Refuse wheels (..., 2) of a file that turn much faster than this robot's ever do; ``LogError``."""
        fastest = float(np.nanmax(np.abs(wheel_radps), initial=0.0))
        if fastest > MAX_OVERSPEED * self.wheel_rate_max_radps:
            raise LogError(
                f"{file}: its wheels turn at up to {fastest:.1f} rad/s, those of robot {self.name} at up to "
                f"{self.wheel_rate_max_radps:.1f} rad/s: name the robot that drove it (--robot)"
            )


def _refuse(fault: LogError, *, repair: bool = False) -> RunLog:
    raise fault


# -- Sessions of windows --------------------------------------------------------------------------------------


class _Session:
    """A whole session: n windows of k samples, of which those of a command, from one to another, make a run."""

    def __init__(self, path: Path, data: Path, robot: DriveRobot) -> None:
        """Read the session in a folder, whose name is that of the session if it has a number."""
        name = normal_name(path.resolve().name)
        numbered = re.fullmatch(r"(.+)_\d+", name)
        self.session = name if numbered or path != data else ""
        self.terrain = numbered[1] if numbered else ""
        file = check_log_file(path / FILE_NAME, path)
        self.file, self.robot = short_name(file), robot.name
        sources = {name: list(pairs.values()) for name, pairs in STREAMS.items()}
        groups = {name: [column for column, _ in pairs] for name, pairs in sources.items()}
        log = read_groups(file, {"keys": _KEYS, "pose": _POSE, **groups})
        keys = _checked_keys(file, log["keys"])
        n, k, _ = keys.shape
        self.step, self.steady = (keys[:, 0, i].astype(np.int64) for i in (0, 2))
        self.period_s = round(float(keys[0, -1, 3] - keys[0, 0, 3]) / (k - 1), 9)
        self.values = {
            name: log[name].reshape(n, k, -1) * [factor for _, factor in pairs]
            for name, pairs in sources.items()
        }
        wheels, imu = self.values["wheels"], self.values["imu"]
        self.holds = [usual_hold(wheel, self.period_s) for wheel in np.moveaxis(wheels, -1, 0)]
        robot.check(self.file, wheels)
        wheels *= robot.wheel_radius_m
        axes = find_axes([(*w.T, i[:, 0], i[:, 1:]) for w, i in zip(wheels, imu, strict=True)], self.period_s)
        imu *= (axes.gyro_z, *axes.accel)
        self.repairs = axes.repairs()
        self.pose = log["pose"].reshape(n, k, 3)  # as published
        self.frame_yaw = self.pose[:, :N_FRAME, 2].mean(axis=1)  # of the frame of a window's positions
        if is_first_pose(self.pose, wheels, self.period_s):
            self.frame_yaw = self.pose[:, 0, 2]
            self.repairs["lidar: positions in the frame of the first pose"] = n
        self.values["lidar"], _ = body_twists(self.pose, self.period_s, self.frame_yaw)

    def commands(self) -> Iterator[slice]:
        """Return the windows of each command."""
        starts = np.flatnonzero(self.steady == 0).tolist()
        if not starts or starts[0] != 0:
            raise LogError(f"{self.file}: the first window has steady 1; a command begins with steady 0")
        return map(slice, starts, [*starts[1:], len(self.steady)])

    def name(self, windows: slice) -> tuple[str, int]:
        """Return the id of the run and the step of a command."""
        steps = np.unique(self.step[windows][1:])
        if not steps.size:
            raise LogError(
                f"{self.file}: the command of step {self.step[windows.start]} has one window only, "
                "at least one with steady 1 must follow it"
            )
        if steps.size > 1:
            listed = ", ".join(map(str, steps))
            raise LogError(f"{self.file}: the windows of one command have the steps {listed}")
        return "_".join([*filter(None, [self.session]), f"step_{steps[0]:03d}"]), int(steps[0])

    def clock(self, windows: slice) -> tuple[Array, Array]:
        """Return which samples (windows, k) to keep, and the time of these from the first one of the run."""
        steady = self.steady[windows]
        logged = np.concatenate([self.values[name][windows] for name in ("wheels", "imu")], axis=-1)
        n_samples, at_s = logged.shape[1], np.zeros(len(steady))
        kept: Array = np.ones(logged.shape[:2], dtype=bool)
        for i in range(1, len(steady)):
            before, after = logged[i - 1], logged[i]
            again = 0
            if not np.array_equal(before[-2], before[-1], equal_nan=True):  # a held row shows nothing
                for n in range(1, _MAX_OVERLAP + 1):
                    again = n if np.array_equal(before[-n:], after[:n], equal_nan=True) else again
            kept[i, :again] = False
            lost = 1 if steady[i - 1] == 0 and not again else 0
            at_s[i] = at_s[i - 1] + (n_samples - again + lost) * self.period_s
        return kept, (at_s[:, None] + self.period_s * np.arange(n_samples))[kept]

    def run(self, windows: slice, *, repair: bool = False) -> RunLog:
        """Return the run of a command."""
        run_id, step = self.name(windows)
        kept, time_s = self.clock(windows)
        dropped: Counter[str] = Counter(self.repairs)
        streams = {}
        for name, logged in self.values.items():
            values = logged[windows][kept]
            if name == "lidar" and not np.isfinite(values).any():
                continue
            sources = STREAMS.get(name, {})
            streams[name] = checked_stream(
                f"{self.file}, {run_id}",
                time_s,
                undo_hold(values, time_s, self.holds) if name == "wheels" else values,
                list(sources) or TWIST,
                columns=[column for column, _ in sources.values()],
                repairs=dropped if repair else None,
                unknown_is_a_value=name == "lidar",
            )
        labels = (Label(0.0, float(time_s[-1]) + self.period_s, self.terrain),) if self.terrain else ()
        source = f"{self.file}, step {step}, DRIVE layout"
        run = RunLog(run_id, self.robot, streams, labels, source, dropped, self.session)
        return checked_names(self.file, run)


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
            session = _Session(path, folder, robot)
            readers += [partial(session.run, windows) for windows in session.commands()]
        else:
            fault = f"{path}: has no {FILE_NAME}, which the other sessions beside it have"
            readers.append(partial(_refuse, LogError(fault)))
    return readers


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
        session = _Session(path, folder, robot)
        new = new_poses(session.pose)
        scan, until_s = usual_wait(new), session.period_s * (new.shape[1] - 1)
        for command in session.commands():
            kept, time_s = session.clock(command)
            begins_s = time_s[np.cumsum(kept.sum(axis=1)) - 1] - until_s
            windows = []
            for i, begin_s in enumerate(begins_s, command.start):
                at, pose, _ = dated_poses(session.pose[i], new[i], scan)
                if len(pose) < 2:
                    continue
                turn = np.exp(-1j * (pose[0, 2] - session.frame_yaw[i]))
                place = (pose[:, 0] - pose[0, 0] + 1j * (pose[:, 1] - pose[0, 1])) * turn
                at_first = np.column_stack([place.real, place.imag, pose[:, 2] - pose[0, 2]])
                windows.append(WindowPoses(begin_s + session.period_s * at, at_first))
            runs[session.name(command)[0]] = tuple(windows)
    return runs


# -- Whole recordings -----------------------------------------------------------------------------------------


def cut_recording(
    step: Array, commanded: Array, moving: Array, breaks: Array, period_s: float
) -> tuple[list[tuple[int, int, str]], int]:
    """Return the runs of a recording, first row, end (not included) and name, and how many commands moved nothing.

    A run is what follows without a break in one step under the logged command (``step_003``; where an
    operator intervened, so that it was begun anew, ``step_003_2``), or what was driven otherwise, between two
    times of standing (``hand_000``, ``hand_001``).  The arrays (n,) are number of the command, and whether the logged
    command drives, a wheel turns, and samples are lost before a row.

    Examples
    --------
    >>> step = np.repeat([0, 1, 2], 60)
    >>> moving = np.repeat([False, True, True, False], 45)
    >>> cut_recording(step, step > 0, moving, np.zeros(180, bool), 0.05)[0][:2]
    [(60, 120, 'step_001'), (120, 180, 'step_002')]
    """

    def stretches(*keys: Array) -> Iterator[tuple[int, int]]:
        """Return first row and end of each stretch of equal keys without a break."""
        table = np.column_stack(keys)
        changes = (table[1:] != table[:-1]).any(axis=1) | breaks[1:].astype(bool)
        starts = np.flatnonzero(np.r_[len(table) > 0, changes]).tolist()
        return zip(starts, [*starts[1:], len(table)], strict=False)

    n_min, margin = round(MIN_RUN_S / period_s), round(MARGIN_S / period_s)
    cuts: list[tuple[int, int, str]] = []
    seen: Counter[int] = Counter()
    n_still = n_hand = 0
    for first, end in stretches(step, commanded):
        if commanded[first] and end - first >= n_min:
            if moving[first:end].any():
                seen[number := int(step[first])] += 1
                again = f"_{seen[number]}" if seen[number] > 1 else ""
                cuts.append((first, end, f"step_{number:03d}{again}"))
            else:
                n_still += 1
    for first, end in stretches(commanded):
        rows = first + np.flatnonzero(moving[first:end])
        if commanded[first] or not rows.size:
            continue
        apart = np.flatnonzero(np.diff(rows) * period_s > STANDING_S)
        starts = np.maximum(rows[np.r_[0, apart + 1]] - margin, first)
        stops = np.minimum(rows[np.r_[apart, rows.size - 1]] + 1 + margin, end)
        for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
            if stop - start >= n_min:
                cuts.append((start, stop, f"hand_{n_hand:03d}"))
                n_hand += 1
    return sorted(cuts), n_still


def find_recordings(folder: Path) -> list[Path]:
    """Return the recordings in a folder, or in the folders in it, sorted; hidden ones are passed over."""
    for pattern in (f"*{SUFFIX}", f"*/*{SUFFIX}"):
        paths = [path for path in folder.glob(pattern) if path.name != FILE_NAME]
        shown = [path for path in paths if not path.name.startswith(".") and path.parent.name[:1] != "."]
        if shown:
            return sorted(shown)
    return []


def find_recorded_runs(folder: Path, robot_of: Callable[[str], DriveRobot]) -> list[Callable[..., RunLog]]:
    """Return one reader per run of the recordings in ``folder``; call it with ``repair=``.

    The recordings are read at once.  One that cannot be read has a reader too, which raises
    :class:`LogError`; where a repairing read can, its runs' readers raise unless they repair.

    ``robot_of`` gives the robot of a name, or raises ``ConfigError``.
    """
    readers: list[Callable[..., RunLog]] = []
    for path in find_recordings(folder):
        name = normal_name(path.resolve().parent.name)
        robot_name, _, terrain = name.partition("_")
        if not robot_name or not terrain:
            raise LogError(
                f"{short_name(path)}: its folder is called {name!r}, which has to name robot and terrain, as "
                "husky_wet_grass"
            )
        robot = robot_of(robot_name)
        fault: LogError | None = None
        try:
            recording = _Recording(path, robot, terrain, None)
        except LogError as error:
            fault = error
            try:
                recording = _Recording(path, robot, terrain, Counter())
            except LogError:
                readers.append(partial(_refuse, error))
                continue
        readers += [partial(recording.run, number, fault) for number in range(len(recording.cuts))]
    return readers


class _Recording:
    """A whole recording, row by row, cut into runs; streams that it lacks are missing."""

    def __init__(self, path: Path, robot: DriveRobot, terrain: str, repairs: Counter[str] | None) -> None:
        self.name, self.robot, self.terrain = short_name(check_log_file(path, path.parent)), robot, terrain
        self.session = normal_name(f"{path.resolve().parent.name}_{path.name.removesuffix(SUFFIX)}")
        self.dropped: Counter[str] = Counter() if repairs is None else repairs
        groups = {"keys": ("time", "calib_step"), "wheels": (*WHEELS.values(),), "imu": (*IMU.values(),)}
        groups |= {"commands": (*DESIRED.values(),), "position": _POSITION, "quaternion": _QUATERNION}
        log = read_groups(path, groups, repairs=repairs)
        time_s = log["keys"][:, 0]
        state = np.array([cells[0] for _, cells in text_rows(path, ["calib_state"]) if cells is not None])
        if len(time_s) < 2:
            raise LogError(f"{self.name}: has {len(time_s)} rows of data, at least 2 are needed")
        if len(state) != len(time_s):  # rows of another length, which both readers leave out alike
            raise LogError(f"{self.name}: its rows do not have one state each")
        kept = rising_rows(self.name, time_s, partial(row_number, path), repairs)
        keys, wheels, imu, commands, position, quaternion = (values[kept] for values in log.values())
        state, (self.time_s, step) = state[kept], keys.T
        for row in np.flatnonzero(~((step >= 0) & (step == np.floor(step)))).tolist():
            fault = f"calib_step at row {row + 2} is {step[row]:.15g}; it must be a whole number from 0 up"
            raise LogError(f"{self.name}: {fault}")
        robot.check(self.name, wheels[:, :2])
        self.period_s = float(np.median(np.diff(self.time_s)))
        moving = np.asarray((np.abs(wheels[:, :2]) >= MIN_MOVING_RADPS).any(axis=1))
        breaks = np.diff(self.time_s, prepend=self.time_s[0]) > BREAK_PERIODS * self.period_s
        self.cuts, n_still = cut_recording(step, state == COMMANDED, moving, breaks, self.period_s)
        if not self.cuts:
            raise LogError(f"{self.name}: its wheels turn for no more than a moment: it holds no run")
        recorded = [i for i, values in enumerate(wheels.T) if i < 2 or np.nan_to_num(values).any()]
        self.dropped[NOT_RECORDED] += wheels.shape[1] - len(recorded)
        if currents := [i for i in (2, 3) if i in recorded]:
            kind = current_sign(wheels[:, currents], wheels[:, [i - 2 for i in currents]])
            self.dropped[kind] += len(currents) if kind else 0
            for i in currents if kind == POWER_SIGN else ():
                wheels[:, i] = with_sign_of_torque(wheels[:, i], wheels[:, i - 2], self.period_s)
        wheels = wheels[:, recorded]
        holds = [usual_hold(values[None], self.period_s) for values in wheels.T]
        wheels = undo_hold(wheels, self.time_s, holds)
        wheels[:, :2] *= robot.wheel_radius_m
        self.streams = {"wheels": (tuple(tuple(WHEELS)[i] for i in recorded), wheels)}
        if imu.any():
            imu[: int(np.flatnonzero(imu.any(axis=1))[0])] = np.nan  # before the first message
            rows = [slice(first, end) for first, end, _ in self.cuts]
            parts = [(*wheels[each, :2].T, imu[each, 2], imu[each, 3:]) for each in rows]
            axes = find_axes(parts, self.period_s)
            self.dropped.update(axes.repairs())
            self.streams["imu"] = tuple(IMU), imu * (*axes.gyro(), *axes.accel)
        else:
            self.dropped[NOT_RECORDED] += imu.shape[1]
        poses, self.posed, twist = self._lidar(position, *quaternion.T)
        if not np.isfinite(twist).any():
            raise LogError(f"{self.name}: its lidar has lost the robot throughout: no pose gives a speed")
        self.streams |= {"lidar": (TWIST, twist), "pose": (POSE_CHANNELS, poses)}
        self.streams["commands"] = tuple(DESIRED), commands
        self.dropped[STILL] += n_still

    def run(self, number: int, fault: LogError | None, *, repair: bool = False) -> RunLog:
        """Return one run; what concerns the whole recording is counted with its first one."""
        if fault is not None and not repair:
            raise fault
        first, end, name = self.cuts[number]
        dropped: Counter[str] = Counter({} if number else self.dropped)
        run_id, rows = f"{self.session}_{name}", slice(first, end)
        time_s = self.time_s[rows] - self.time_s[first]
        streams = {}
        for stream, (channels, logged) in self.streams.items():
            values, kept = logged[rows], np.ones(len(time_s), dtype=bool)
            if stream == "pose":
                kept = self.posed[rows]
            elif stream == "imu":
                kept = np.asarray(~np.isnan(values).all(axis=1))
            if (stream == "commands" and name.startswith("hand")) or (stream == "pose" and kept.sum() < 2):
                continue
            if stream in ("lidar", "pose") and not np.isfinite(values[kept]).any():
                continue
            streams[stream] = checked_stream(
                f"{self.name}, {run_id}",
                time_s[kept],
                values[kept],
                channels,
                row_of=lambda row: row + first + 2,
                repairs=dropped if repair else None,
                unknown_is_a_value=stream in ("lidar", "pose"),
            )
        if "pose" in streams:
            dropped[LOST] += int(np.isnan(streams["pose"].values[:, 0]).sum())
        labels = (Label(0.0, float(time_s[-1]) + self.period_s, self.terrain),)
        source = f"{self.name}, rows {first + 2} to {end + 1}, recording of DRIVE"
        run = RunLog(run_id, self.robot.name, streams, labels, source, +dropped, self.session)
        return checked_names(self.name, run)

    def _lidar(self, position: Array, x: Array, y: Array, z: Array, w: Array) -> tuple[Array, Array, Array]:
        """Return poses (n, 3), which rows (n,) they are of, and the twist (n, 3) at each row."""
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        yaw = np.where(x * x + y * y + z * z + w * w > 0.5, yaw, np.nan)
        place = np.round((self.time_s - self.time_s[0]) / self.period_s).astype(np.intp)  # on an even grid
        rows = np.searchsorted(place, np.arange(place[-1] + 1), side="right") - 1
        even = np.column_stack([position, yaw])[rows]
        (twist,), (std,) = body_twists(even[None], self.period_s, np.zeros(1))
        twist[~(std <= MAX_STD).all(axis=1)] = np.nan
        new = new_poses(even[None])
        at, _, arrival = dated_poses(even, new[0], usual_wait(new))
        came = even[arrival]
        # without what is left out, which may be a registration that jumped
        came[:, 2] = np.unwrap(came[:, 2])
        came[(std[at] > MAX_STD).any(axis=1)] = np.nan
        poses, posed = np.full((len(even), 3), np.nan), np.zeros(len(even), dtype=bool)
        poses[at], posed[at] = came, True
        return poses[place], posed[place], twist[place]


# -- Held values and poses ------------------------------------------------------------------------------------

MAX_HELD_S = 0.1
"""A value that is usually held for longer is read as straight lines.  Held for 0.1 s it lags by 0.025 s
on samples at 20 Hz, half a sample; held for 0.25 s by 0.1 s."""

HALF_WIDTH_SCANS = 3
"""Poses to either side that a speed is fitted to: about six, enough for a parabola and its noise."""

OUTAGE_SCANS = 2
"""A pose that took so many usual waits is stale when it comes, and so are those right behind."""

QUEUE = 3
"""So many new poses in as many samples come out of a queue, since a registration takes longer than that."""

MAX_GAIN_PER_S = 4.0
"""Largest standard deviation of a speed for each unit of the pose's; 2.3 in the middle of a window of 40
samples with a pose in every second one."""

N_FRAME = 5  #: Samples whose mean heading the authors of DRIVE turned the positions of a window by

MAX_STD = (0.2, 0.2, 0.2)
"""Standard deviations, in m/s and rad/s, beyond which a recording's lidar has lost the robot: poses scatter
by 0.01 m about a parabola elsewhere, which is 0.03 m/s, and by 0.3 m where a registration jumps.  Of
recordings of a Warthog that takes 1 % of the twists, of a Husky on wet grass a sixth."""

MIN_JUDGED_SCANS = 5.0
"""So few poses at least show their scatter about a parabola, which takes three of them."""

MIN_DISTANCE_M = 0.15  #: Windows with a shorter path have no direction: poses scatter by a centimetre
MIN_WINDOWS = 20  #: So few windows show nothing of a session
STEADY_RAD = 0.1  #: Deviation from which a window counts less: wheels that spin, registrations that jump
ITERATIONS = 30  #: Of the reweighted least squares


def undo_hold(values: Array, time_s: Array, holds: Sequence[int]) -> Array:
    """Return held columns (n, c) as straight lines between the samples where they are new, if held for several.

    A value that stays for longer than the usual number of samples, one a column, was measured again and is the
    same: it is held until the usual time before the next one.

    Examples
    --------
    >>> undo_hold(np.array([[0.0, 0.0, 0.0, 0.0, 4.0, 4.0, 8.0]]).T, np.arange(7.0), [2]).T.tolist()
    [[0.0, 0.0, 0.0, 2.0, 4.0, 6.0, 8.0]]
    """
    columns = []
    for column, held in zip(values.T, holds, strict=True):
        new = np.flatnonzero(np.diff(column, prepend=np.nan) != 0.0)
        known = np.sort(np.concatenate([new, new[1:][np.diff(new) > held] - held]))
        columns.append(np.interp(time_s, time_s[known], column[known]) if held > 1 else column)
    return np.column_stack(columns)


def usual_hold(values: Array, period_s: float) -> int:
    """Return the median samples from one new value (n stretches, k samples) to the next; 1: short or unknown.

    Examples
    --------
    >>> usual_hold(np.arange(40.0)[None] // 5, 0.05), usual_hold(np.arange(40.0)[None] // 2, 0.05)
    (5, 1)
    """
    usual = usual_wait(np.diff(values, axis=1) != 0.0)
    return usual if usual * period_s > MAX_HELD_S * (1.0 + 1e-6) else 1


def usual_wait(new: Array) -> int:
    """Return the median number of samples from one new value (n, k) to the next, at least 1."""
    stretch, sample = np.nonzero(new)
    waits = np.diff(sample)[np.diff(stretch) == 0]
    return max(int(np.median(waits)), 1) if waits.size else 1


def new_poses(pose: Array) -> Array:
    """Return (n, k) true where a pose (n, k, 3) is not the one before."""
    new = np.zeros(pose.shape[:2], dtype=bool)
    new[:, 1:] = (np.diff(pose, axis=1) != 0.0).any(axis=-1)
    return new & np.isfinite(pose).all(axis=-1)


def dated_poses(pose: Array, new: Array, scan: int) -> tuple[Array, Array, Array]:
    """Return when (m,) the usable new poses of a window (k, 3) are dated, these, yaw unwrapped, and when they came.

    A pose is of the time at which its registration began, when the one before came out: one that took longer than
    the usual wait ``scan`` is that much older.  (On sand, where a Warthog's waits are uneven, that takes the error of
    the yaw rate against the gyro from 0.44 to 0.24 rad/s.)  The first pose of a window that comes late is not used,
    since its age is unknown; nor are poses that come out of a queue or after an outage (:data:`OUTAGE_SCANS`,
    :data:`QUEUE`).
    """
    arrival = np.flatnonzero(new)
    came = pose[arrival]
    came[:, 2] = np.unwrap(came[:, 2])
    if not arrival.size:
        return arrival, came, arrival
    waited = np.diff(arrival, prepend=0)
    heads = np.concatenate([[True], waited[1:] > 1])  # of rows of poses that came sample by sample
    row = np.cumsum(heads) - 1
    queued = (waited[heads] >= OUTAGE_SCANS * scan) | (np.bincount(row) >= QUEUE)
    at = np.concatenate([arrival[:1], arrival[:-1] + scan])
    usable = ~queued[row] & (at < len(pose))
    usable[0] &= arrival[0] <= scan  # what came before the window is not known
    return at[usable], came[usable], arrival[usable]


def body_twists(pose: Array, period_s: float, frame_yaw: Array | None = None) -> tuple[Array, Array]:
    """Return speeds forward and to the left and yaw rate from poses that are held between two scans, and deviations.

    What the robot drove from one dated pose (:func:`dated_poses`) to the next, as an arc (:func:`terrain.angles.arcs`),
    is summed in its own axes.  The heading is ``yaw`` less the mean of the first five as published, with their jumps
    of a full turn.  A parabola is fitted to the sums within :data:`HALF_WIDTH_SCANS` usual waits of each sample,
    and its slope is the twist.  NaN where poses are too few or too much to one side for a slope
    (:data:`MAX_GAIN_PER_S`), as within three waits of a window's edge.

    Parameters
    ----------
    pose : (n, k, 3) x, y and yaw of n windows, as published; NaN where missing
    period_s : time from sample to sample
    frame_yaw : (n,) heading of the frame of the positions in that of the yaw; the mean over the first five
        by default, as the samples of DRIVE have it, 0 for poses in one fixed frame

    Returns
    -------
    twist : (n, k, 3) of the point that the pose is of, with the channels :data:`TWIST`
    std : (n, k, 3) its standard deviations by the scatter of the poses about the parabola; NaN where fewer than
        :data:`MIN_JUDGED_SCANS` poses show one

    Examples
    --------
    Half a metre a second, straight on:

    >>> pose = np.zeros((1, 40, 3))
    >>> pose[0, :, 0] = 0.5 * 0.1 * (np.arange(40) // 2)
    >>> body_twists(pose, 0.05)[0][0, 20].round(6).tolist()
    [0.5, 0.0, 0.0]
    """
    n, k, _ = pose.shape
    new = new_poses(pose)
    scan = usual_wait(new)
    weight, driven = np.zeros((n, k)), np.zeros((n, k, 3))
    if frame_yaw is None:
        frame_yaw = pose[:, :N_FRAME, 2].mean(axis=1)
    for window in range(n):
        at, came, _ = dated_poses(pose[window], new[window], scan)
        weight[window, at] = 1.0
        steps = arcs(came[:, :2], came[:, 2], frame_yaw[window])
        driven[window, at[1:]] = np.cumsum(steps, axis=0)
    half = HALF_WIDTH_SCANS * scan
    powers = (np.arange(-half, half + 1) / half)[:, None] ** np.arange(3)
    padding = [(0, 0), (half, half)]
    view = np.lib.stride_tricks.sliding_window_view
    width = 2 * half + 1
    products = (powers[:, :, None] * powers[:, None, :]).reshape(width, 9)
    normal = (view(np.pad(weight, padding), width, axis=1) @ products).reshape(n, k, 3, 3)
    seen = normal[..., 0, 0] >= 3.0
    inverse = np.full_like(normal, np.nan)
    inverse[seen] = np.linalg.inv(normal[seen])
    sums = np.swapaxes(view(np.pad(driven, [*padding, (0, 0)]), width, axis=1) @ powers, -1, -2)
    fitted = inverse @ sums
    slope = fitted[..., 1, :] / (half * period_s)
    with np.errstate(invalid="ignore"):
        gain_per_s = np.sqrt(inverse[..., 1, 1]) / (half * period_s)
        certain = gain_per_s <= MAX_GAIN_PER_S
        squares = view(np.pad(driven**2, [*padding, (0, 0)]), width, axis=1).sum(axis=-1)
        left = np.maximum(squares - (fitted * sums).sum(axis=-2), 0.0)
        judged = normal[..., 0, 0] >= MIN_JUDGED_SCANS
        spare = np.where(judged, normal[..., 0, 0] - 3.0, np.nan)
        std = np.sqrt(left / spare[..., None]) * gain_per_s[..., None]
    return np.where(certain[..., None], slope, np.nan), np.where(certain[..., None], std, np.nan)


def frame_coefficient(pose: Array, wheels_mps: Array, period_s: float) -> tuple[float, float]:
    """Return a, and its standard deviation; NaN where too few windows turn and move.

    Windows whose published heading jumps by a turn within its first samples are left out: their mean is no heading.

    ``pose`` is (n, k, 3), as published; of the wheels' circumferential speeds (n, k, 2) the sign of the mean is used.
    """
    new = new_poses(pose)
    scan = usual_wait(new)
    rows = []
    for window, arrived, ahead_mps in zip(pose, new, np.nanmean(wheels_mps, axis=(1, 2)), strict=True):
        at, came, _ = dated_poses(window, arrived, scan)
        if len(came) < 4 or np.abs(np.diff(window[: N_FRAME + 1, 2])).max() > np.pi / 2:
            continue
        yaw = came[:, 2]
        chords = np.diff(came[:, 0] + 1j * came[:, 1]) * np.exp(-0.5j * (yaw[1:] + yaw[:-1]))
        path = np.sign(ahead_mps) * chords.sum()
        if abs(path) >= MIN_DISTANCE_M:
            rate = (yaw[-1] - yaw[0]) / (np.ptp(at) * period_s)
            first = window[:N_FRAME, 2].mean() - window[0, 2]
            rows.append((float(np.angle(path)), first, rate, min(abs(path), 1.0)))
    if len(rows) < MIN_WINDOWS:
        return np.nan, np.nan
    direction, first, turned, weight = np.array(rows).T
    terms = np.column_stack([first, turned, np.ones(len(rows))])
    fitted, left, believed = np.zeros(3), direction, weight
    for _ in range(ITERATIONS):
        normal = (terms * believed[:, None]).T @ terms
        if np.linalg.cond(normal) > 1e12:  # nothing turned
            return np.nan, np.nan
        fitted = np.linalg.solve(normal, (terms * believed[:, None]).T @ direction)
        left = direction - terms @ fitted
        believed = weight / np.maximum(1.0, np.abs(left) / STEADY_RAD)
    variance = np.linalg.inv(normal) * np.average(left**2, weights=believed)
    return float(fitted[0]), float(np.sqrt(variance[0, 0]))


def is_first_pose(pose: Array, wheels_mps: Array, period_s: float) -> bool:
    """Return whether positions are in the frame of the first pose: a is 0 beyond doubt, and -1 is not."""
    coefficient, std = frame_coefficient(pose, wheels_mps, period_s)
    return bool(abs(coefficient) < 3.0 * std and coefficient + 1.0 > 3.0 * std)
