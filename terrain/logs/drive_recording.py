r"""Reader of whole recordings of DRIVE: the topics of a robot at 20 Hz, with motor currents and lidar poses.

``<robot>_<terrain>/<recording>.csv.gz`` (Baril et al., DRIVE, ICRA 2024; repositories norlab-ulaval/DRIVE and
norlab-ulaval/doughnut_calib, ``raw_dataframe``).  The folder names robot and terrain, as ``husky_wet_grass``;
a recording is the session of its runs.  A step is one command: what was driven under it is a run
``<folder>_<recording>_step_001``; an operator drives before the first one and between them, which makes the
runs ``..._hand_000``.  Terrain is taken to be that of the folder
throughout.

Streams are ``wheels`` (:data:`WHEELS`, times the nominal radius), ``imu`` (:data:`IMU`), ``commands``
(:data:`COMMANDS`), and of ``icp_pos_*`` and ``icp_quat_*`` ``lidar`` (:mod:`~terrain.logs.held`) and ``pose``.

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
  0.15 s; they are read as straight lines between (:mod:`terrain.logs.held`).
- *Currents* of the Husky are never negative: magnitudes, which stay as they are and are counted.  The
  Warthog's are positive where a side drives, forwards or backwards, and negative where it brakes: the sign of
  the power, which is turned into that of the torque (forward positive) by the rotation of the wheel, and
  counted.  Voltages are the supply's, not the motors'.
- *Missing*: a column that holds nothing but 0 was not recorded (the Husky's imu), and the imu is 0 before its
  first message.  Both are left out.
- *Lost*: on the wet grass poses jump by up to 12 m.  Where they scatter too much for a speed they are NaN.

A recording is cut into runs: one a command, and what an operator drove between them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from terrain.errors import LogError
from terrain.files.names import normal_name
from terrain.logs.drive import FILE_NAME as SAMPLES_FILE
from terrain.logs.drive import DriveRobot, refuse_other_robot
from terrain.logs.held import CHANNELS as TWIST_CHANNELS
from terrain.logs.held import MAX_STD, body_twists, dated_poses, new_poses, undo_hold, usual_hold, usual_wait
from terrain.logs.imu_axes import MIN_MOVING_RADPS, POWER_SIGN, current_sign, find_axes, with_sign_of_torque
from terrain.logs.samples import (
    BAD_TIME,
    check_log_file,
    checked_names,
    checked_stream,
    longest_rise,
    short_name,
)
from terrain.logs.schema import POSE_CHANNELS
from terrain.logs.tables import read_table, row_number, text_rows
from terrain.records import Array, Label, RunLog

MIN_RUN_S = 2.0  #: Shorter stretches hold no window and no steady speed
STANDING_S = 2.0  #: So long without motion ends what an operator drove
MARGIN_S = 0.5  #: What is kept of the standing before and after it: starts and stops are whole
BREAK_PERIODS = 2.5  #: A longer wait between two rows ends a run: samples are lost

SUFFIX = ".csv.gz"

COMMANDED = "calib"  #: State in which the logged command drives

WHEELS: dict[str, str] = {
    "speed_left_mps": "meas_left_vel",
    "speed_right_mps": "meas_right_vel",
    "current_left_a": "left_wheel_current",
    "current_right_a": "right_wheel_current",
    "voltage_left_v": "left_wheel_voltage",
    "voltage_right_v": "right_wheel_voltage",
}
IMU: dict[str, str] = {
    **{f"gyro_{axis}_radps": f"imu_{axis}" for axis in "xyz"},
    **{f"accel_{axis}_mps2": f"imu_acceleration_{axis}" for axis in "xyz"},
}
COMMANDS: dict[str, str] = {"speed_x_mps": "cmd_vel_x", "yaw_rate_radps": "cmd_vel_omega"}
POSE: tuple[str, ...] = ("icp_pos_x", "icp_pos_y", "icp_quat_x", "icp_quat_y", "icp_quat_z", "icp_quat_w")
STATE, STEP, TIME = "calib_state", "calib_step", "time"

NOT_RECORDED = "columns that were not recorded"
LOST = "poses where the lidar lost the robot"
STILL = "commands under which nothing moved"


class Cut(NamedTuple):
    """Rows ``first`` to ``end`` (not included) of a recording that make one run, driven by a command or by hand."""

    name: str  # step_003, or hand_000
    first: int
    end: int
    commanded: bool


def cut_recording(
    step: Array, commanded: Array, moving: Array, breaks: Array, period_s: float
) -> tuple[tuple[Cut, ...], int]:
    """Return the runs of a recording, and how many commands were left out because nothing moved.

    A run is what follows without a break in one step under the logged command (``step_003``; where an
    operator intervened, so that it was begun anew, ``step_003_2``), or what was driven otherwise, between two
    times of standing (``hand_000``, ``hand_001``).  The arrays (n,) are number of the command, and whether the logged
    command drives, a wheel turns, and samples are lost before a row.

    Examples
    --------
    >>> step = np.repeat([0, 1, 2], 60)
    >>> moving = np.repeat([False, True, True, False], 45)
    >>> cut_recording(step, step > 0, moving, np.zeros(180, bool), 0.05)[0][:2]
    (Cut(name='step_001', first=60, end=120, commanded=True),
     Cut(name='step_002', first=120, end=180, commanded=True))
    """
    n_min = round(MIN_RUN_S / period_s)
    runs: list[Cut] = []
    seen: Counter[int] = Counter()
    n_still = 0
    for first, end in _stretches(np.column_stack([step, commanded]), breaks):
        if not commanded[first] or end - first < n_min:
            continue
        if not moving[first:end].any():
            n_still += 1
            continue
        number = int(step[first])
        seen[number] += 1
        again = f"_{seen[number]}" if seen[number] > 1 else ""
        runs.append(Cut(f"step_{number:03d}{again}", first, end, True))
    n_hand = 0
    for first, end in _stretches(np.asarray(commanded)[:, None], breaks):
        for start, stop in () if commanded[first] else _driven(moving[first:end], period_s):
            if stop - start >= n_min:
                runs.append(Cut(f"hand_{n_hand:03d}", first + start, first + stop, False))
                n_hand += 1
    return tuple(sorted(runs, key=lambda cut: cut.first)), n_still


def _stretches(keys: Array, breaks: Array) -> Iterator[tuple[int, int]]:
    """Return first row and end of each stretch of equal keys (n, k) without a break."""
    changes = (keys[1:] != keys[:-1]).any(axis=1) | breaks[1:].astype(bool)
    starts = np.flatnonzero(np.r_[len(keys) > 0, changes]).tolist()
    return zip(starts, [*starts[1:], len(keys)], strict=False)


def _driven(moving: Array, period_s: float) -> list[tuple[int, int]]:
    """Return what lies between two times of standing, with a margin on both sides."""
    rows = np.flatnonzero(moving)
    if not rows.size:
        return []
    apart = np.flatnonzero(np.diff(rows) * period_s > STANDING_S)
    margin = round(MARGIN_S / period_s)
    firsts = np.maximum(rows[np.r_[0, apart + 1]] - margin, 0).tolist()
    ends = np.minimum(rows[np.r_[apart, rows.size - 1]] + 1 + margin, len(moving)).tolist()
    return list(zip(firsts, ends, strict=True))


def find_recordings(folder: Path) -> list[Path]:
    """Return the recordings in a folder, or in the folders in it, sorted; hidden ones are passed over."""
    for pattern in (f"*{SUFFIX}", f"*/*{SUFFIX}"):
        if paths := [
            path for path in folder.glob(pattern) if path.name != SAMPLES_FILE and not _is_hidden(path)
        ]:
            return sorted(paths)
    return []


def _is_hidden(path: Path) -> bool:
    return path.name.startswith(".") or path.parent.name.startswith(".")


def find_runs(folder: Path, robot_of: Callable[[str], DriveRobot]) -> list[Callable[..., RunLog]]:
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
            recording = _Recording(path, robot, terrain, repair=False)
        except LogError as error:
            fault = error
            try:
                recording = _Recording(path, robot, terrain, repair=True)
            except LogError:
                readers.append(partial(_refuse, error))
                continue
        readers += [partial(recording.run, cut, fault) for cut in recording.cuts]
    return readers


def _refuse(fault: LogError, *, repair: bool = False) -> RunLog:
    raise fault


class _Recording:
    """A whole recording, row by row, cut into runs; streams that it lacks are missing."""

    def __init__(self, path: Path, robot: DriveRobot, terrain: str, *, repair: bool) -> None:
        self.name, self.robot, self.terrain = short_name(check_log_file(path, path.parent)), robot, terrain
        self.session = normal_name(f"{path.resolve().parent.name}_{path.name.removesuffix(SUFFIX)}")
        self.dropped: Counter[str] = Counter()
        repairs = self.dropped if repair else None
        columns = [TIME, STEP, *WHEELS.values(), *IMU.values(), *COMMANDS.values(), *POSE]
        table = read_table(path, columns, repairs=repairs)
        state = np.array([cells[0] for _, cells in text_rows(path, [STATE]) if cells is not None])
        if len(table) < 2:
            raise LogError(f"{self.name}: has {len(table)} rows of data, at least 2 are needed")
        table, state = _with_rising_time(path, table, state, repairs)
        column = dict(zip(columns, table.T, strict=True))
        self.time_s, step = column[TIME], column[STEP]
        for row in np.flatnonzero(~((step >= 0) & (step == np.floor(step)))):
            raise LogError(
                f"{self.name}: {STEP} at row {row + 2} is {step[row]:.15g}; it must be a whole number from 0 up"
            )
        wheels, imu, pose, commands = (
            np.column_stack([column[name] for name in names])
            for names in (WHEELS.values(), IMU.values(), POSE, COMMANDS.values())
        )
        refuse_other_robot(self.name, wheels[:, :2], robot)
        self.period_s = float(np.median(np.diff(self.time_s)))
        moving = (np.abs(wheels[:, :2]) >= MIN_MOVING_RADPS).any(axis=1)
        breaks = np.diff(self.time_s, prepend=self.time_s[0]) > BREAK_PERIODS * self.period_s
        self.cuts, n_still = cut_recording(step, state == COMMANDED, moving, breaks, self.period_s)
        if not self.cuts:
            raise LogError(f"{self.name}: its wheels turn for no more than a moment: it holds no run")
        channels, wheels = self._wheels(wheels)
        self.streams = {"wheels": (channels, wheels)}
        if imu.any():
            self.streams["imu"] = tuple(IMU), self._imu(imu, wheels[:, :2])
        else:
            self.dropped[NOT_RECORDED] += imu.shape[1]
        poses, self.posed, twist = self._lidar(pose)
        if not np.isfinite(twist).any():
            raise LogError(f"{self.name}: its lidar has lost the robot throughout: no pose gives a speed")
        self.streams |= {"lidar": (TWIST_CHANNELS, twist), "pose": (POSE_CHANNELS, poses)}
        self.streams["commands"] = tuple(COMMANDS), commands
        self.dropped[STILL] += n_still

    def run(self, cut: Cut, fault: LogError | None, *, repair: bool = False) -> RunLog:
        """Return one run; what concerns the whole recording is counted with its first one."""
        if fault is not None and not repair:
            raise fault
        dropped: Counter[str] = Counter(self.dropped if cut == self.cuts[0] else {})
        rows = slice(cut.first, cut.end)
        run_id = f"{self.session}_{cut.name}"
        time_s = self.time_s[rows] - self.time_s[cut.first]
        streams = {}
        for name, (channels, logged) in self.streams.items():
            values, kept = logged[rows], np.ones(len(time_s), dtype=bool)
            if name == "pose":
                kept = self.posed[rows]
            elif name == "imu":
                kept = np.asarray(~np.isnan(values).all(axis=1))
            if (name == "commands" and not cut.commanded) or (name == "pose" and kept.sum() < 2):
                continue
            streams[name] = checked_stream(
                f"{self.name}, {run_id}",
                time_s[kept],
                values[kept],
                channels,
                row_of=lambda row: row + cut.first + 2,
                repairs=dropped if repair else None,
                unknown_is_a_value=name in ("lidar", "pose"),
            )
        if "pose" in streams:
            dropped[LOST] += int(np.isnan(streams["pose"].values[:, 0]).sum())
        labels = (Label(0.0, float(time_s[-1]) + self.period_s, self.terrain),)
        source = f"{self.name}, rows {cut.first + 2} to {cut.end + 1}, recording of DRIVE"
        run = RunLog(run_id, self.robot.name, streams, labels, source, +dropped, self.session)
        return checked_names(self.name, run)

    def _wheels(self, logged: Array) -> tuple[tuple[str, ...], Array]:
        """Return what was recorded of the wheels, as it really changes, and its channels."""
        recorded = [i for i, values in enumerate(logged.T) if i < 2 or np.nan_to_num(values).any()]
        self.dropped[NOT_RECORDED] += logged.shape[1] - len(recorded)
        currents = [i for i in (2, 3) if i in recorded]
        if currents:
            kind = current_sign(logged[:, currents], logged[:, [i - 2 for i in currents]])
            self.dropped[kind] += len(currents) if kind else 0
            for i in currents if kind == POWER_SIGN else ():
                logged[:, i] = with_sign_of_torque(logged[:, i], logged[:, i - 2], self.period_s)
        values = logged[:, recorded]
        holds = [usual_hold(column[None], self.period_s) for column in values.T]
        values = undo_hold(values, self.time_s, holds)
        values[:, :2] *= self.robot.wheel_radius_m
        return tuple(tuple(WHEELS)[i] for i in recorded), values

    def _imu(self, imu: Array, wheels_mps: Array) -> Array:
        """Return gyro and accelerometer in the robot's axes; NaN before the first message."""
        imu[: int(np.flatnonzero(imu.any(axis=1))[0])] = np.nan
        rows = [slice(cut.first, cut.end) for cut in self.cuts]
        axes = find_axes([(*wheels_mps[each].T, imu[each, 2], imu[each, 3:]) for each in rows], self.period_s)
        self.dropped.update(axes.repairs())
        return np.asarray(imu * (*axes.gyro(), *axes.accel))

    def _lidar(self, logged: Array) -> tuple[Array, Array, Array]:
        """Return poses (n, 3), which rows (n,) they are of, and the twist (n, 3) at each row."""
        x, y, z, w = logged[:, 2:].T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        pose = np.column_stack([logged[:, :2], np.where(x * x + y * y + z * z + w * w > 0.5, yaw, np.nan)])
        place = np.round((self.time_s - self.time_s[0]) / self.period_s).astype(np.intp)  # on an even grid
        even = pose[np.searchsorted(place, np.arange(place[-1] + 1), side="right") - 1]
        twists, stds = body_twists(even[None], self.period_s, np.zeros(1))
        twist, std = twists[0], stds[0]
        twist[~(std <= MAX_STD).all(axis=1)] = np.nan
        new = new_poses(even[None])
        at, _, arrival = dated_poses(even, new[0], usual_wait(new))
        came = even[arrival]
        came[:, 2] = np.unwrap(
            came[:, 2]
        )  # without what is left out, which may be a registration that jumped
        came[(std[at] > MAX_STD).any(axis=1)] = np.nan
        poses, posed = np.full((len(even), 3), np.nan), np.zeros(len(even), dtype=bool)
        poses[at], posed[at] = came, True
        return poses[place], posed[place], twist[place]


def _with_rising_time(
    path: Path, table: Array, state: Array, repairs: Counter[str] | None
) -> tuple[Array, Array]:
    """Return the rows whose time rises, or refuse; a repairing read drops the others and counts them."""
    time_s = table[:, 0]
    if len(state) != len(table):  # rows of another length, which both readers leave out alike
        raise LogError(f"{short_name(path)}: its rows do not have one state each")
    fallen = np.flatnonzero(~(np.diff(time_s) > 0.0))
    if not fallen.size and np.isfinite(time_s).all():
        return table, state
    if repairs is None:
        row = int(fallen[0]) + 1 if fallen.size else int(np.flatnonzero(~np.isfinite(time_s))[0])
        raise LogError(
            f"{short_name(path)}: time does not rise at row {row_number(path, row)} "
            f"({time_s[row]:.15g} s after {time_s[row - 1]:.15g} s): a clock that restarts?"
        )
    finite = np.flatnonzero(np.isfinite(time_s))
    kept = finite[longest_rise(time_s[finite])]
    repairs[BAD_TIME] += len(table) - len(kept)
    return table[kept], state[kept]
