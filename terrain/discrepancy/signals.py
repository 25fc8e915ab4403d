"""From streams to signals on one clock: the inputs of the simulation, and what it is compared with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from terrain.angles import unwrapped
from terrain.effects import (
    ACCEL,
    CHANNELS,
    CURRENT,
    GYRO,
    HEADING,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
)
from terrain.errors import DataError
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import body_motion
from terrain.logs.schema import POSE_CHANNELS
from terrain.records import Array, RunLog, Stream, read_only
from terrain.robots import Robot
from terrain.slip_learning.measured import travelled

MAX_RATE_HZ = 50.0
"""Clock of the replay, unless the wheels are logged slower."""

MAX_GAP_PERIODS = 3.5
"""Longest hole of a stream that is bridged by a straight line, in its own periods."""

MIN_LENGTH_S = 4.0
"""Of a shorter run nothing is left once filters have settled."""

JUMP_S, JUMP_MPS, JUMP_SIGMAS = 0.05, 0.1, 8.0
"""A camera speed is a jump of its map if it differs from the median over the first before and after by the
second, and by so many times the usual deviation."""

BACKWARD_MPS, MIN_BACKWARD = 0.02, 5
"""A wheel turns backward if it is faster than that on at least so many samples."""

PARALLEL = 0.95
"""Least norm of the mean of the wheels' unit vectors at which the sum of currents measures traction: wheels
within 18 degrees of each other."""


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """A run on one clock.

    Parameters
    ----------
    run_id, terrain : of the run; the terrain is empty where it has no label or several
    dt_s : period of the clock
    start_s : first instant on the run's own clock
    wheel_speed_mps : (n, wheels) wheel speeds with the nominal radius, of a car-like robot (n, 1) that of
        the rear axle; NaN where a logger was silent
    steer_rad : (n, steered wheels) steering angles, zeros taken off; (n, wheels) zeros of a robot without
    grade_rad, roll_rad : (n,) measured tilt, uphill and left side up positive; 0 where none is measured
    measured : (n, len(CHANNELS)) what the simulation is compared with; NaN where nothing was measured
    session : that the run is part of; empty where that is not known
    """

    run_id: str
    terrain: str
    dt_s: float
    start_s: float
    wheel_speed_mps: Array
    steer_rad: Array
    grade_rad: Array
    roll_rad: Array
    measured: Array
    session: str = ""

    def __post_init__(self) -> None:
        for name in ("wheel_speed_mps", "steer_rad", "grade_rad", "roll_rad", "measured"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        return len(self.measured)

    @property
    def time_s(self) -> Array:
        """Time (n,) on the run's own clock."""
        return self.start_s + self.dt_s * np.arange(len(self))


def signals_of(run: RunLog, robot: Robot) -> Signals:
    """Return the signals of a run, resampled to one clock.

    Raises
    ------
    DataError
        if the run is of another robot or lacks inputs of the simulation, if none of its channels is
        simulated, or if it is too short.
    """
    if run.robot != robot.name:
        raise DataError(
            f"run {run.run_id} is of the robot {run.robot!r}, the simulation is of {robot.name!r}"
        )
    if "wheels" not in run.streams:
        raise DataError(f"run {run.run_id}: it has no stream 'wheels', which drives the simulation")
    if robot.steered and "steering" not in run.streams:
        raise DataError(f"run {run.run_id}: it has no stream 'steering', which drives the simulation")
    wheels = run.streams["wheels"]
    wheel_speeds = _wheel_speeds(run, wheels, robot)
    time_s, dt_s = _clock(run, robot, ("wheels", "steering") if robot.steered else ("wheels",))
    steer = _steering(run, robot, time_s) if robot.steered else np.zeros((time_s.size, len(robot.wheels)))
    grade, roll = _tilt(run, time_s)
    measured = np.full((time_s.size, len(CHANNELS)), np.nan)
    _put_imu(measured, run, time_s)
    _put_motion(measured, run, robot, time_s)
    _put_currents(measured, wheels, wheel_speeds, steer, robot, time_s)
    if not np.isfinite(measured).any():
        raise DataError(
            f"run {run.run_id}: none of its channels is simulated; a gyro, currents of all wheels, a speed "
            "over ground or an accelerometer with its tilt is required"
        )
    columns = [_resample(time_s, wheels.time_s, wheel_speeds[:, i]) for i in range(wheel_speeds.shape[1])]
    return Signals(
        run_id=run.run_id,
        terrain=run.terrains[0] if len(run.terrains) == 1 else "",
        dt_s=dt_s,
        start_s=float(time_s[0]),
        wheel_speed_mps=np.column_stack(columns),
        steer_rad=steer,
        grade_rad=grade,
        roll_rad=roll,
        measured=measured,
        session=run.session,
    )


def _clock(run: RunLog, robot: Robot, inputs: Sequence[str]) -> tuple[Array, float]:
    """Return the instants (n,) that all streams have in common, and their period."""
    used = [*inputs, *(name for name in ("imu", "odometry", "lidar") if name in run.streams)]
    used += ["pose"] if _by_pose(run, robot) else []
    start_s = max(float(run.streams[name].time_s[0]) for name in used)
    end_s = min(float(run.streams[name].time_s[-1]) for name in used)
    rate_hz = min(MAX_RATE_HZ, run.streams["wheels"].rate_hz)
    n = math.floor((end_s - start_s) * rate_hz + 1e-6) + 1 if end_s > start_s else 0
    if n < MIN_LENGTH_S * rate_hz:
        raise DataError(
            f"run {run.run_id}: its streams have {max(end_s - start_s, 0.0):.1f} s in common, "
            f"at least {MIN_LENGTH_S:g} s are required"
        )
    return start_s + np.arange(n) / rate_hz, 1 / rate_hz


def _steering(run: RunLog, robot: Robot, time_s: Array) -> Array:
    """Return the steering angles (n, steered wheels), zeros and whole turns subtracted."""
    stream = run.streams["steering"]
    steer = np.zeros((time_s.size, len(robot.steer_channels)))
    for i, (name, zero) in enumerate(zip(robot.steer_channels, robot.steering_zeros_rad, strict=False)):
        raw = unwrapped(stream.channel(name))
        turn = 2 * math.pi * np.round((raw[np.isfinite(raw)][:1].sum() - zero) / (2 * math.pi))
        steer[:, i] = _resample(time_s, stream.time_s, raw - zero - turn)
    return steer


def _has_tilt(run: RunLog) -> bool:
    return "imu" in run.streams and {"roll_rad", "pitch_rad"} <= set(run.streams["imu"].channels)


def _tilt(run: RunLog, time_s: Array) -> tuple[Array, Array]:
    """Return grade and roll (n,), 0 where none is measured."""
    if not _has_tilt(run):
        return np.zeros(time_s.size), np.zeros(time_s.size)
    imu = run.streams["imu"]
    grade = -_resample(time_s, imu.time_s, imu.channel("pitch_rad"))
    return grade, _resample(time_s, imu.time_s, imu.channel("roll_rad"))


def _put_imu(measured: Array, run: RunLog, time_s: Array) -> None:
    if (imu := run.streams.get("imu")) is not None:
        _put(measured, GYRO, time_s, imu, "gyro_z_radps")
        if _has_tilt(run):
            _put(measured, ACCEL, time_s, imu, "accel_x_mps2")


def _put_motion(measured: Array, run: RunLog, robot: Robot, time_s: Array) -> None:
    """Put in speeds over ground and the heading rate, from a camera's poses, its speeds, or a lidar.

    Poses of an omni robot's body (of a camera above, motion capture) count where there is neither.
    """
    if _by_pose(run, robot):
        _put_pose(measured, run, robot, time_s)
    if (seen := run.streams.get("odometry")) is not None:
        if set(CAMERA_CHANNELS) <= set(seen.channels):
            speed = _without_jumps(seen, body_motion(seen, robot.camera).speed_mps)
            measured[:, CHANNELS.index(SPEED_X)] = _resample(time_s, seen.time_s, speed[:, 0])
            measured[:, CHANNELS.index(SPEED_Y)] = _resample(time_s, seen.time_s, speed[:, 1])
        else:
            _put(measured, SPEED_X, time_s, seen, "speed_x_mps")
            _put(measured, SPEED_Y, time_s, seen, "speed_y_mps")
    if (lidar := run.streams.get("lidar")) is not None:
        _put(measured, SPEED_X, time_s, lidar, "speed_x_mps")
        _put(measured, SPEED_Y, time_s, lidar, "speed_y_mps")
        _put(measured, HEADING, time_s, lidar, "yaw_rate_radps")


def _by_pose(run: RunLog, robot: Robot) -> bool:
    """Return whether poses of an omni robot's body are what measured its speed from outside."""
    pose, lidar = run.streams.get("pose"), run.streams.get("lidar")
    others = "odometry" in run.streams or (lidar is not None and "speed_x_mps" in lidar.channels)
    return (
        robot.on_omni_wheels and pose is not None and set(POSE_CHANNELS) <= set(pose.channels) and not others
    )


def _put_pose(measured: Array, run: RunLog, robot: Robot, time_s: Array) -> None:
    """Put in speeds along the body's axes and heading rate of poses, none where these pause or jump."""
    seen = travelled(run, robot)
    step_s, inside = np.diff(seen.time_s), np.diff(seen.part) == 0
    rates = np.where(inside[:, None], np.diff(seen.values, axis=0), np.nan) / step_s[:, None]
    middle_s = seen.time_s[:-1] + 0.5 * step_s
    for c, name in enumerate((SPEED_X, SPEED_Y, HEADING)):
        measured[:, CHANNELS.index(name)] = _resample(time_s, middle_s, rates[:, c])


def _put_currents(
    measured: Array, wheels: Stream, wheel_speeds: Array, steer: Array, robot: Robot, time_s: Array
) -> None:
    """Put in the sum of the motor currents, and of a skid-steer robot their difference.

    Wheels of an omni robot drive in three directions: of their currents the magnitudes are summed.
    """
    currents = [f"current_{wheel}_a" for wheel in robot.wheels]
    if not set(currents) <= set(wheels.channels):
        return
    each = []
    for i, name in enumerate(currents):
        logged = wheels.channel(name)
        current = np.abs(logged) if robot.on_omni_wheels else _signed(logged, wheel_speeds[:, i])
        each.append(_resample(time_s, wheels.time_s, current))
    measured[:, CHANNELS.index(CURRENT)] = np.sum(each, axis=0)
    parallel = np.abs(np.exp(1j * steer).mean(axis=1)) > PARALLEL
    measured[~parallel, CHANNELS.index(CURRENT)] = np.nan
    if robot.skids:
        measured[:, CHANNELS.index(TURNING_CURRENT)] = each[1] - each[0]


def _wheel_speeds(run: RunLog, wheels: Stream, robot: Robot) -> Array:
    """Wheel speeds (n, wheels that are logged), from wheel speeds or from the motors' rates."""
    for pattern in ("motor_{}_radps", "speed_{}_mps"):
        names = [pattern.format(wheel) for wheel in robot.logged_wheels]
        if set(names) <= set(wheels.channels):
            rates = np.column_stack([wheels.channel(name) for name in names])
            if pattern.startswith("speed"):
                return rates
            return rates * (robot.wheel_radius_m / robot.motors.reduction_ratio)
    raise DataError(
        f"run {run.run_id}: its wheels have the channels {', '.join(wheels.channels)}; a speed of each of "
        f"{', '.join(robot.logged_wheels)} is required"
    )


def _without_jumps(seen: Stream, speed_mps: Array) -> Array:
    """Return speeds (n, 2) with NaN where the camera relocalised."""
    width = 2 * round(JUMP_S * seen.rate_hz) + 1
    off = np.abs(speed_mps - median_filter(speed_mps, (width, 1), mode="nearest"))
    usual = 1.48 * np.nanmedian(off, axis=0) if len(off) else np.zeros(2)
    jumps = (off > np.maximum(JUMP_MPS, JUMP_SIGMAS * usual)).any(axis=1)
    return np.where(jumps[:, None], np.nan, speed_mps)


def _signed(current_a: Array, wheel_speed_mps: Array) -> Array:
    """Return currents (n,) with the sign of the wheel speed, where the motor driver logs magnitudes only.

    That is so if a wheel turns backward and its current is never negative.  Braking cannot be seen in such a
    log.
    """
    backward = wheel_speed_mps < -BACKWARD_MPS
    if backward.sum() < MIN_BACKWARD or np.nanmin(current_a) < 0:
        return current_a
    return np.asarray(current_a * np.sign(wheel_speed_mps))


def _put(measured: Array, channel: str, time_s: Array, stream: Stream, name: str) -> None:
    if name in stream.channels:
        measured[:, CHANNELS.index(channel)] = _resample(time_s, stream.time_s, stream.channel(name))


def _resample(time_s: Array, stamps_s: Array, values: Array) -> Array:
    """Return a signal on the clock by straight lines between its samples; NaN in its holes."""
    known = np.isfinite(values)
    if known.sum() < 2:
        return np.full(time_s.size, np.nan)
    stamps, samples = stamps_s[known], values[known]
    period_s = float(np.median(np.diff(stamps_s)))
    at = np.interp(time_s, stamps, samples)
    after = np.searchsorted(stamps, time_s, side="left").clip(1, stamps.size - 1)
    hole = (stamps[after] - stamps[after - 1]) > MAX_GAP_PERIODS * period_s
    inside = (time_s > stamps[after - 1]) & (time_s < stamps[after])
    outside = (time_s < stamps[0] - period_s) | (time_s > stamps[-1] + period_s)
    at[(hole & inside) | outside] = np.nan
    return at
