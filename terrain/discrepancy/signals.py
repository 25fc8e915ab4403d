"""From streams to signals on one clock: the inputs of the simulation, and what it is compared with."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from terrain.angles import unwrapped
from terrain.effects import ACCEL, CHANNELS, CURRENT, GYRO, HEADING, SPEED_X, SPEED_Y, TURNING_CURRENT
from terrain.errors import DataError
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import body_motion
from terrain.logs.schema import POSE_CHANNELS
from terrain.records import Array, RunLog, read_only
from terrain.robots import Robot
from terrain.slip_learning.measured import travelled

MAX_RATE_HZ = 50.0  #: Clock of the replay, unless the wheels are logged slower.
MAX_GAP_PERIODS = 3.5  #: Longest hole of a stream that is bridged by a straight line, in its own periods.
MIN_LENGTH_S = 4.0  #: Of a shorter run nothing is left once filters have settled.
#: A camera speed is a jump of its map if it differs from the median over the first before and after by the second,
#: and by so many times the usual deviation.
JUMP_S, JUMP_MPS, JUMP_SIGMAS = 0.05, 0.1, 8.0

#: A wheel turns backward if it is faster than that on at least so many samples.
BACKWARD_MPS, MIN_BACKWARD = 0.02, 5
#: Least norm of the mean of the wheels' unit vectors at which the sum of currents measures traction: wheels within 18
#: degrees of each other.
PARALLEL = 0.95


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """A run on one clock."""

    run_id: str  #: of the run; the terrain is empty where it has no label or several
    terrain: str
    dt_s: float  #: period of the clock
    start_s: float  #: first instant on the run's own clock
    #: (n, wheels) wheel speeds with the nominal radius, of a car-like robot (n, 1) that of the rear axle; NaN where a
    #: logger was silent
    wheel_speed_mps: Array
    #: (n, steered wheels) steering angles, zeros taken off; (n, wheels) zeros of a robot without
    steer_rad: Array
    grade_rad: Array  #: (n,) measured tilt, uphill and left side up positive; 0 where none is measured
    roll_rad: Array
    #: (n, len(CHANNELS)) what the simulation is compared with; NaN where nothing was measured
    measured: Array
    session: str = ""  #: that the run is part of; empty where that is not known

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

    Currents of omni wheels, which drive in three directions, are magnitudes.  Others get the sign of the wheel speed
    where the motor driver logs magnitudes only: if a wheel turns backward and its current is never negative.  Braking
    cannot be seen in such a log.

    Raises
    ------
    DataError
        if the run is of another robot or lacks inputs of the simulation, if none of its channels is
        simulated, or if it is too short.
    """
    name = f"run {run.run_id}"
    if run.robot != robot.name:
        raise DataError(f"{name} is of the robot {run.robot!r}, the simulation is of {robot.name!r}")
    inputs = ("wheels", "steering") if robot.steered else ("wheels",)
    for stream in inputs:
        if stream not in run.streams:
            raise DataError(f"{name}: it has no stream {stream!r}, which drives the simulation")
    wheels, imu = run.streams["wheels"], run.streams.get("imu")
    # a robot whose motors are not described logs speeds
    for pattern in ("motor_{}_radps", "speed_{}_mps"):
        names = [pattern.format(wheel) for wheel in robot.logged_wheels]
        if set(names) <= set(wheels.channels):
            break
    else:
        raise DataError(
            f"{name}: its wheels have the channels {', '.join(wheels.channels)}; a speed of each of "
            f"{', '.join(robot.logged_wheels)} is required"
        )
    is_motor = names[0].startswith("motor")
    scale = robot.wheel_radius_m / robot.motors.reduction_ratio if is_motor else 1.0
    speeds = np.column_stack([wheels.channel(channel) for channel in names]) * scale
    # poses of an omni robot's body (of a camera above, motion capture) count where nothing else measures its speed
    pose, lidar = run.streams.get("pose"), run.streams.get("lidar")
    others = "odometry" in run.streams or (lidar is not None and "speed_x_mps" in lidar.channels)
    by_pose = (
        robot.on_omni_wheels and pose is not None and set(POSE_CHANNELS) <= set(pose.channels) and not others
    )

    used = [*inputs, *(each for each in ("imu", "odometry", "lidar") if each in run.streams)]
    spans_s = np.array([run.streams[each].time_s[[0, -1]] for each in [*used, "pose"][: len(used) + by_pose]])
    start_s, end_s = float(spans_s[:, 0].max()), float(spans_s[:, 1].min())
    rate_hz = min(MAX_RATE_HZ, wheels.rate_hz)
    n = math.floor((end_s - start_s) * rate_hz + 1e-6) + 1 if end_s > start_s else 0
    if n < MIN_LENGTH_S * rate_hz:
        raise DataError(
            f"{name}: its streams have {max(end_s - start_s, 0.0):.1f} s in common, "
            f"at least {MIN_LENGTH_S:g} s are required"
        )
    time_s = start_s + np.arange(n) / rate_hz

    def resampled(stamps_s: Array, columns: Array) -> Array:
        return np.column_stack([_resample(time_s, stamps_s, column) for column in columns.T])

    steer = np.zeros((n, len(robot.steer_channels) or len(robot.wheels)))
    if robot.steered:
        steering, angles = run.streams["steering"], []
        for channel, zero in zip(robot.steer_channels, robot.steering_zeros_rad, strict=False):
            raw = unwrapped(steering.channel(channel))
            turn = 2 * math.pi * np.round((raw[np.isfinite(raw)][:1].sum() - zero) / (2 * math.pi))
            angles.append(raw - zero - turn)
        steer = resampled(steering.time_s, np.column_stack(angles))
    tilt, has_tilt = np.zeros((n, 2)), imu is not None and {"roll_rad", "pitch_rad"} <= set(imu.channels)
    if imu is not None and has_tilt:
        tilt = resampled(imu.time_s, np.column_stack([-imu.channel("pitch_rad"), imu.channel("roll_rad")]))
    measured = np.full((n, len(CHANNELS)), np.nan)
    for channel, stamps_s, values in _measurements(run, robot, has_tilt, by_pose):
        measured[:, CHANNELS.index(channel)] = _resample(time_s, stamps_s, values)
    names = [f"current_{wheel}_a" for wheel in robot.wheels]
    if set(names) <= set(wheels.channels):
        currents = np.column_stack([wheels.channel(channel) for channel in names])
        if robot.on_omni_wheels:
            currents = np.abs(currents)
        else:
            for current, speed in zip(currents.T, speeds.T, strict=False):
                if (speed < -BACKWARD_MPS).sum() >= MIN_BACKWARD and not np.nanmin(current) < 0:
                    current *= np.sign(speed)
        each = resampled(wheels.time_s, currents)
        measured[:, CHANNELS.index(CURRENT)] = np.sum(list(each.T), axis=0)
        parallel = np.abs(np.exp(1j * steer).mean(axis=1)) > PARALLEL
        measured[~parallel, CHANNELS.index(CURRENT)] = np.nan
        if robot.skids:
            measured[:, CHANNELS.index(TURNING_CURRENT)] = each[:, 1] - each[:, 0]
    if not np.isfinite(measured).any():
        raise DataError(
            f"{name}: none of its channels is simulated; a gyro, currents of all wheels, a speed "
            "over ground or an accelerometer with its tilt is required"
        )
    terrain = run.terrains[0] if len(run.terrains) == 1 else ""
    on_clock = resampled(wheels.time_s, speeds), steer, tilt[:, 0], tilt[:, 1], measured
    return Signals(run.run_id, terrain, 1 / rate_hz, float(time_s[0]), *on_clock, run.session)


def _measurements(
    run: RunLog, robot: Robot, has_tilt: bool, by_pose: bool
) -> Iterator[tuple[str, Array, Array]]:
    """Yield what sensors measured: channel, stamps and values; of one channel the last counts.

    Speeds over ground and the heading rate are from a camera's poses, its speeds, or a lidar, or from poses of the
    body, none where these pause or jump.
    """
    direct = [("imu", "gyro_z_radps", GYRO)] + [("imu", "accel_x_mps2", ACCEL)] * has_tilt
    if by_pose:
        seen = travelled(run, robot)
        step_s, inside = np.diff(seen.time_s), np.diff(seen.part) == 0
        rates = np.where(inside[:, None], np.diff(seen.values, axis=0), np.nan) / step_s[:, None]
        for channel, rate in zip((SPEED_X, SPEED_Y, HEADING), rates.T, strict=True):
            yield channel, seen.time_s[:-1] + 0.5 * step_s, rate
    camera = run.streams.get("odometry")
    if camera is not None and set(CAMERA_CHANNELS) <= set(camera.channels):
        speed = body_motion(camera, robot.camera).speed_mps
        width = 2 * round(JUMP_S * camera.rate_hz) + 1
        off = np.abs(speed - median_filter(speed, (width, 1), mode="nearest"))
        usual = 1.48 * np.nanmedian(off, axis=0) if len(off) else np.zeros(2)
        relocalised = (off > np.maximum(JUMP_MPS, JUMP_SIGMAS * usual)).any(axis=1)
        speed = np.where(relocalised[:, None], np.nan, speed)
        yield SPEED_X, camera.time_s, speed[:, 0]
        yield SPEED_Y, camera.time_s, speed[:, 1]
    else:
        direct += [("odometry", "speed_x_mps", SPEED_X), ("odometry", "speed_y_mps", SPEED_Y)]
    direct += [("lidar", "speed_x_mps", SPEED_X), ("lidar", "speed_y_mps", SPEED_Y)]
    for stream, name, channel in [*direct, ("lidar", "yaw_rate_radps", HEADING)]:
        if stream in run.streams and name in run.streams[stream].channels:
            yield channel, run.streams[stream].time_s, run.streams[stream].channel(name)


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
