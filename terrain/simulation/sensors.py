"""Sensors of simulated robots: what a logger writes of a body's rows, with errors, latency, quantisation and loss.

A plant writes the motion of a body row by row (:data:`BODY` and what else it has); sensors read these rows alone.  A
stamp is the time at which a sample arrived; its content is older by the sensor's latency.

Those of a closed loop (:class:`Sensor`) follow the rows at :data:`STEP_S`.  All random numbers are drawn when a sensor
is made; after that it follows the motion in blocks of any length: a run in one block and a run tick by tick give the
same bytes.

A sample of an IMU is ``scale x + bias + noise`` of each quantity ``x`` (:func:`imu_values`).  The plants differ in the
errors that they draw: the dynamic plant draws biases anew for each power-on and lets those of the gyro walk
(:func:`draw_imu_errors`), the planar one adds coloured vibration while the robot moves, tracks and car white noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.effects import bent_rate, on_samples
from terrain.kernels import inner, njit, numbers, record
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import to_camera
from terrain.kinematics.wheels import point_velocity
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS, POSE_CHANNELS, TWIST
from terrain.records import Array, Reading, Stream, read_only
from terrain.robots import Antenna, Robot, Sensors, SwerveRobot
from terrain.simulation.scenario import Faults

# Step of the rows in a closed loop and of the dynamic plant, whose fastest mode is that of the contact, near 170
# rad/s: a sixth of a radian a step.
STEP_S = 0.001

MAX_WHEELS = (
    4  # for which the rows of the dynamic plant have room; of a robot with fewer the first ones count
)

BODY = record(
    numbers(
        "position_x_m position_y_m yaw_rad roll_rad pitch_rad speed_x_mps speed_y_mps yaw_rate_radps accel_x_mps2 "
        "accel_y_mps2"
    )
)
"""What every plant writes of its body, and every log has as its truth."""

WHEEL_ROW = record(
    numbers(
        "wheel_radps steer_rad slip_ratio slip_angle_rad normal_n traction_n torque_nm sinkage_m "
        "reported_radps patch_ratio side_n"
    )
)
"""A wheel.  Steering angles are true headings in the body; traction and side force are those of the contact, along the
wheel and to its left, so that it takes up ``traction (w r - v_along) - side v_across``."""

BODY_ROW = record(
    dict.fromkeys(BODY.names or (), float)
    | numbers(
        "grade_x_ratio grade_y_ratio ride_z_mps2 ride_roll_rad ride_pitch_rad ride_roll_radps2 ride_pitch_radps2 "
        "path_m leg_rad"
    )
    | {"wheels": (WHEEL_ROW, MAX_WHEELS), "encoder_rad": (float, MAX_WHEELS)}
)
"""What the dynamic plant writes each step at the body's origin, of each wheel, and of the angles that encoders see,
which differ from the headings where a linkage or a leg has play."""


def generators(seed: int | np.random.SeedSequence, purposes: Sequence[str]) -> dict[str, np.random.Generator]:
    """Return a generator for each purpose: one sensor more or less does not change the others."""
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return {
        purpose: np.random.default_rng(np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, i)))
        for i, purpose in enumerate(purposes)
    }


class Motion:
    """What happened in one run, every :data:`STEP_S`, as far as it has happened.

    Parameters
    ----------
    record : (n,) of :data:`BODY_ROW` for a plant to write, all but the tilt
    n_rows : rows that are written; all by default

    Attributes
    ----------
    up : (n, 3) the vertical in the axes of the body
    """

    def __init__(self, record: Array, n_rows: int | None = None) -> None:
        self.record = record
        self.up = np.empty((len(record), 3))
        self.n_rows = 0
        self.grow(len(record) if n_rows is None else n_rows)

    def grow(self, n_rows: int) -> None:
        """Take note that so many rows are written, and add roll and pitch: the slope and the ride over it."""
        rows, up = self.record[self.n_rows : n_rows], self.up[self.n_rows : n_rows]
        grade_x, grade_y = rows["grade_x_ratio"], rows["grade_y_ratio"]
        # up is (grade_x, grade_y, 1) = (-sin pitch, sin roll cos pitch, cos roll cos pitch)
        rows["roll_rad"] = roll = np.arctan(grade_y) + rows["ride_roll_rad"]
        rows["pitch_rad"] = pitch = -np.arctan(grade_x / np.hypot(1.0, grade_y)) + rows["ride_pitch_rad"]
        up[:, 0], up[:, 1] = -np.sin(pitch), np.sin(roll) * np.cos(pitch)
        up[:, 2] = np.cos(roll) * np.cos(pitch)
        self.n_rows = n_rows

    def at(self, rate_hz: float, latency_s: float = 0.0) -> tuple[Array, Array]:
        """Stamps (k,) of a sensor of that rate, and the rows (k,) it measures."""
        time_s = np.arange(math.floor(len(self.record) * STEP_S * rate_hz + 1e-6)) / rate_hz
        return time_s, np.maximum(np.round((time_s - latency_s) / STEP_S).astype(int), 0)


class Sensor:
    """One sensor of one run, and the samples it has written so far.

    Parameters
    ----------
    motion : the recorded motion; its last rows may not be written yet
    channels : of its stream
    stamps : (n,) when its samples arrive, and (n,) rows of the motion that they measure, none later than the sample
    write : from samples (k), their rows (k,) and low-passed signals there to their values (k, channels)
    signals : writes signals (m, c) of the motion's rows from a first one on; none by default
    lags_s : (c,) time constants of their low-passes, which start at rest at the first values
    ahead : rows beyond its own that a signal needs

    Attributes
    ----------
    stamp_s : (n,) by its logger's clock, by default when its samples arrive
    """

    def __init__(
        self,
        motion: Motion,
        channels: tuple[str, ...],
        stamps: tuple[Array, Array],
        write: Callable[[slice, Array, Array], Array],
        signals: Callable[[int, Array], None] | None = None,
        lags_s: Sequence[float] = (),
        ahead: int = 0,
    ) -> None:
        self.motion, self.channels, self.time_s, self.rows = motion, channels, read_only(stamps[0]), stamps[1]
        self.values = np.empty((len(self.time_s), len(channels)))
        self._write, self._signals, self._ahead = write, signals, ahead
        self._keep = np.array([math.exp(-STEP_S / tau) if tau > 0.0 else 0.0 for tau in lags_s])
        self._start, self._state = np.empty(0), np.zeros(len(self._keep))
        self._first, self._seen = 0, np.empty((0, 0))
        self._n_written = self._n_given = 0
        self._shown = self.values.view()
        self._shown.flags.writeable = False
        self.stamp_s = self.time_s

    def update(self) -> None:
        """Write the samples of all rows of the motion that are written."""
        n_rows = self.motion.n_rows
        end = max(n_rows - self._ahead, min(n_rows, 1))
        if self._signals is not None:
            self._first += len(self._seen)
            self._seen = np.empty((end - self._first, len(self._keep)))
            self._signals(self._first, self._seen)
            if len(self._seen):
                self._start = self._start if self._start.size else self._seen[0].copy()
                _low_pass(self._seen, self._keep, self._start, self._state)
        new = slice(self._n_written, int(self.rows.searchsorted(end)))
        if new.start < new.stop:
            rows = self.rows[new]
            seen = self._seen if self._signals is None else self._seen[rows - self._first]
            self.values[new] = self._write(new, rows, seen)
            self._n_written = new.stop

    def arrived(self, time_s: float) -> Reading | None:
        """Return the samples that arrived since the last call, up to and with ``time_s``; None for none."""
        new = slice(self._n_given, int(self.time_s.searchsorted(time_s, side="right")))
        self._n_given = new.stop
        return Reading(self.stamp_s[new], self._shown[new]) if new.start < new.stop else None

    def stream(self) -> Stream:
        """Return all samples, once the motion is complete."""
        return Stream(self.stamp_s, self._shown, self.channels)


@njit
def _low_pass(values: Array, keep: Array, start: Array, state: Array) -> None:
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            if keep[j] > 0.0:
                state[j] = keep[j] * state[j] + (1.0 - keep[j]) * (values[i, j] - start[j])
                values[i, j] = state[j] + start[j]


def is_lost(time_s: Array, intervals_s: Sequence[tuple[float, float]]) -> Array:
    """Return which samples (n,) fall in one of the intervals (start, end); the end is not in it.

    Examples
    --------
    >>> is_lost(np.arange(4.0), [(1.0, 3.0)])
    array([False,  True,  True, False])
    """
    lost = np.zeros(len(time_s), dtype=bool)
    for start_s, end_s in intervals_s:
        lost |= (time_s >= start_s) & (time_s < end_s)
    return lost


STANDSTILL_RADPS = 1e-3  # motor rate below which the Hall sensors count no step


def wheel_sensor(motion: Motion, robot: Robot, rng: np.random.Generator) -> Sensor:
    """Return motor rates after the motor driver's low-pass on quantised Hall steps, and motor currents.

    Effects act before the noise.
    """
    sensors, n = robot.sensors, len(robot.wheels)
    time_s, rows = motion.at(sensors.wheels_rate_hz)
    logged = np.isin(robot.wheels, robot.logged_wheels)  # rates, and currents of the motors
    driven = [name for name, is_logged in zip(robot.wheels, logged, strict=True) if is_logged]
    per_radps = robot.motors.reduction_ratio if robot.by_motor else robot.wheel_radius_m
    std = sensors.motor_std_radps * per_radps / robot.motors.reduction_ratio
    rate_noise = std * rng.standard_normal((len(rows), len(driven)))
    current_noise = sensors.current_std_a * rng.standard_normal((len(rows), len(driven)))
    channels = (*robot.rate_channels, *wheel_channels("current_a", driven))
    changed = on_samples("wheels", channels, robot.effects)

    def write(new: slice, rows: Array, _: Array) -> Array:
        wheels = motion.record["wheels"][rows][:, :n][:, logged]
        true = wheels["reported_radps"] * per_radps, wheels["torque_nm"] / robot.motors.nm_per_a
        rates, current_a = np.hsplit(changed(time_s[new], np.hstack(true))[1], 2)
        counts = np.abs(rates) > STANDSTILL_RADPS  # an encoder that counts no step has no noise
        return np.hstack([rates + rate_noise[new] * counts, current_a + current_noise[new]])

    return Sensor(motion, channels, (time_s, rows), write)


def encoder_angle(steer_rad: Array, zeros_rad: Array, noise_rad: Array | float, step_rad: float) -> Array:
    """Return the angles (n, wheels) that absolute encoders report: in whole steps, where a step is not 0.

    Parameters
    ----------
    steer_rad : (n, wheels) angles of the steering
    zeros_rad : (wheels,) angles that encoders report at 0
    """
    angle = steer_rad + zeros_rad + noise_rad
    if step_rad > 0.0:
        angle = np.floor(angle / step_rad) * step_rad + step_rad / 2
    return np.asarray(wrapped(angle))


def steering_sensor(motion: Motion, robot: Robot, rng: np.random.Generator) -> Sensor:
    """Return absolute encoders: whole steps a turn (Gray code errs by one at most), with their zero offset.

    The third one sits below the hinge of its leg and does not measure its swing; none measures the linkage to its
    wheel.
    """
    sensors = robot.sensors
    stamps = motion.at(sensors.steering_rate_hz)
    zeros, step_rad = robot.steering_zeros_rad, 2 * math.pi / sensors.steering_steps_ratio
    n = len(robot.steered_wheels)
    noise = sensors.steering_std_rad * rng.standard_normal((len(stamps[0]), n))

    def write(new: slice, rows: Array, _: Array) -> Array:
        return encoder_angle(motion.record["encoder_rad"][rows, :n], zeros[:n], noise[new], step_rad)

    return Sensor(motion, robot.steer_channels, stamps, write)


TILT_NOISE_RAD = 0.001  # noise of an IMU's fused roll and pitch; assumed


def described_imu(sensors: Sensors) -> tuple[Array, Array]:
    """Return a description's factors (9,) and biases (9,) of the channels of an IMU."""
    scale, bias = np.ones(9), np.zeros(9)
    for i, axis in enumerate("xyz"):
        scale[3 + i] = getattr(sensors, f"accel_scale_{axis}_ratio")
        bias[i] = getattr(sensors, f"gyro_bias_{axis}_radps")
        bias[3 + i] = getattr(sensors, f"accel_bias_{axis}_mps2")
    return scale, bias


def draw_imu_errors(
    sensors: Sensors, n: int, rng: np.random.Generator, gyro_scale_ratio: float = 0.0
) -> tuple[Array, Array, Array]:
    """Return factors (9,), biases (n, 9) and noise (n, 9) of one power-on: about those described, the gyro's walk."""
    scale, described = described_imu(sensors)
    scale[[2, 8]] += gyro_scale_ratio
    bias, noise, period_s = np.tile(described, (n, 1)), np.empty((n, 9)), 1 / sensors.imu_rate_hz
    bias[:, 3:6] += sensors.accel_bias_std_mps2 * rng.standard_normal(3)
    bias[:, :3] += sensors.gyro_bias_std_radps * rng.standard_normal(3)
    bias[:, :3] += sensors.gyro_walk_radps * math.sqrt(period_s) * rng.standard_normal((n, 3)).cumsum(axis=0)
    noise[:, 3:6] = sensors.accel_std_mps2 * rng.standard_normal((n, 3))
    noise[:, :3] = sensors.gyro_std_radps * rng.standard_normal((n, 3))
    bias[:, 6:8] = sensors.tilt_std_rad * rng.standard_normal(2)
    noise[:, 6:8] = TILT_NOISE_RAD * rng.standard_normal((n, 2))
    bias[1:, 8] = np.cumsum(bias[1:, 2]) * period_s  # the fused yaw sums the errors of the yaw rate
    noise[:, 8] = sensors.yaw_std_rad * rng.standard_normal(n)
    return scale, bias, noise


def imu_values(true: Array, scale: Array | float, bias: Array | float, noise: Array) -> Array:
    """Return the values (k, 9) of samples, in the order of ``IMU_CHANNELS``.

    Parameters
    ----------
    true : (k, 9) body rates, specific force, roll, pitch and the yaw from the start of the run, behind the low-pass
    scale, bias, noise : of each quantity
    """
    values = true * scale + bias + noise
    values[:, 8] = wrapped(values[:, 8])
    return np.asarray(values)


def imu_sensor(motion: Motion, robot: Robot, rng: np.random.Generator) -> tuple[Sensor, Array]:
    """Return an IMU without magnetometer, and the true bias (n,) of its yaw gyro at each stamp.

    It sits above the body's origin, at the height of the centre of mass.  The specific force is acceleration minus
    gravity: +g on z at rest, ``+g sin`` on x with the nose up.  Rates are those of the body: turning on an even slope
    shows no roll rate.  They are central differences of the attitude, so the latency is one step at least; in the first
    row, which has no row before it, the rates of roll and pitch are 0.  Of the robot's effects it applies gyro_scale
    and gyro_nonlinearity, also to the fused yaw.
    """
    sensors, height_m, record = robot.sensors, robot.body.com_height_m, motion.record
    stamps = motion.at(sensors.imu_rate_hz, max(sensors.imu_latency_s, STEP_S))
    scale, bias, noise = draw_imu_errors(
        sensors, len(stamps[0]), rng, robot.effects.get("gyro_scale_ratio", 0.0)
    )
    lags_s = np.repeat(sensors.imu_time_constants_s, 3).tolist()

    def fill(first: int, out: Array) -> None:
        _rates_and_force(record, motion.up, first, height_m, out)

    bend, lost_rad = robot.effects.get("gyro_nonlinearity_s2", 0.0), np.zeros(1)

    def write(new: slice, rows: Array, seen: Array) -> Array:
        at = record[rows]
        true = np.column_stack([seen, at["roll_rad"], at["pitch_rad"], at["yaw_rad"] - record["yaw_rad"][0]])
        if bend and len(true):
            lost = true[:, 2] - bent_rate(true[:, 2], bend)
            true[:, 2] -= lost
            summed = np.cumsum(np.concatenate([lost_rad, lost / sensors.imu_rate_hz]))
            true[:, 8] -= summed[1:]
            lost_rad[0] = summed[-1]
        return imu_values(true, scale, bias[new], noise[new])

    return Sensor(motion, IMU_CHANNELS, stamps, write, fill, lags_s, ahead=1), bias[:, 2]


def tilted_imu(rate_radps: Array, accel_mps2: Array, attitude_rad: Array) -> Array:
    """Return what an IMU without errors measures (n, 9).

    Parameters
    ----------
    rate_radps : (n, 3) of the body
    accel_mps2 : (n, 2) of the IMU's place along the axes of the body, in the plane of the ground
    attitude_rad : (n, 3) roll, pitch and yaw
    """
    roll, pitch, _ = attitude_rad.T
    force = np.column_stack([-np.sin(pitch), np.sin(roll), np.cos(roll)]) * GRAVITY_MPS2
    force[:, 1:] *= np.cos(pitch)[:, None]
    force[:, :2] += accel_mps2
    return np.hstack([rate_radps, force, attitude_rad])


@njit
def _rates_and_force(record: Array, up: Array, first: int, height_m: float, out: Array) -> None:
    """Write body rates and specific force (n, 6) of the rows from ``first`` on."""
    for i in range(out.shape[0]):
        k = first + i
        row = record[k]
        x, y, z = up[k, 0], up[k, 1], up[k, 2]
        out[i, 3] = GRAVITY_MPS2 * x + (row.accel_x_mps2 + height_m * row.ride_pitch_radps2)
        out[i, 4] = GRAVITY_MPS2 * y + (row.accel_y_mps2 - height_m * row.ride_roll_radps2)
        out[i, 5] = GRAVITY_MPS2 * z + row.ride_z_mps2
        out[i, 0], out[i, 1], out[i, 2] = 0.0, 0.0, row.yaw_rate_radps
        if k > 0:  # up is constant in the world: d(up)/dt = up x rate
            change_x = (up[k + 1, 0] - up[k - 1, 0]) / (2.0 * STEP_S)
            change_y = (up[k + 1, 1] - up[k - 1, 1]) / (2.0 * STEP_S)
            out[i, 0] = (change_y + row.yaw_rate_radps * x) / z
            out[i, 1] = (row.yaw_rate_radps * y - change_x) / z


JUMP_SAMPLES = 4  # number of samples with a wrong speed at a relocalisation of the camera; assumed
_SEEN = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "roll_rad", "pitch_rad", "yaw_rad")


def camera_sensor(motion: Motion, robot: Robot, rng: np.random.Generator, faults: Faults) -> Sensor:
    """Return a tracking camera in its own frames: drifting pose, noisy speed, dropouts and relocalisation jumps.

    Of other than swerve robots it gives the speed of its place in the axes of the body alone.

    Without noise its samples are those of :func:`terrain.kinematics.camera.odometry_stream`; lost samples are left out.
    Effects act on samples with their noise.
    """
    camera, record = robot.camera, motion.record
    time_s, rows = motion.at(camera.rate_hz, camera.latency_s)
    n = len(rows)
    yaw_noise = camera.yaw_std_rad * rng.standard_normal(n)
    drift = camera.speed_std_mps * rng.standard_normal((n, 2)).cumsum(axis=0) / camera.rate_hz
    position_noise = camera.position_std_m * rng.standard_normal((n, 2))
    speed_noise = camera.speed_std_mps * rng.standard_normal((n, 3))  # in the camera's axes
    lost = is_lost(time_s, faults.camera_lost_s)
    chance = rng.random((n, 2)) * camera.rate_hz
    lengths = rng.exponential(camera.dropout_length_s, n)
    jumps, jumped = camera.jump_std_m * rng.standard_normal((n, 2)), np.zeros((n, 2))
    if faults.by_chance:
        for i in np.flatnonzero(chance[:, 0] < camera.dropout_rate_hz):
            lost |= (time_s >= time_s[i]) & (time_s < time_s[i] + lengths[i])
        for i in np.flatnonzero(chance[:, 1] < camera.jump_rate_hz):
            jumped[i:] += jumps[i]
            shown = to_camera(np.append(jumps[i], 0.0)) * camera.rate_hz / JUMP_SAMPLES
            speed_noise[i : i + JUMP_SAMPLES] += shown
    rate_noise = camera.yaw_rate_std_radps * rng.standard_normal((n, 3))
    place_error = (drift + position_noise + jumped)[~lost]
    lever_m = np.array([camera.lever_x_m, camera.lever_y_m, camera.lever_z_m])
    yaw_noise_0, changed = yaw_noise[0] if n else 0.0, on_samples("odometry", CAMERA_CHANNELS, robot.effects)
    yaw_noise, speed_noise, rate_noise = yaw_noise[~lost], speed_noise[~lost], rate_noise[~lost]

    def fill(first: int, out: Array) -> None:
        for i, name in enumerate(_SEEN):
            out[:, i] = record[name][first : first + len(out)]

    def write(new: slice, rows: Array, seen: Array) -> Array:
        place = np.column_stack([record["position_x_m"][rows], record["position_y_m"][rows]])
        seen[:, 5] += yaw_noise[new]
        values = camera_values(place + place_error[new], seen, lever_m, record["yaw_rad"][0] + yaw_noise_0)
        values[:, 7:10] += speed_noise[new]
        values[:, 10:13] += rate_noise[new]
        if not isinstance(robot, SwerveRobot):
            ahead, left = point_velocity(*seen[:, :3].T, *lever_m[:2])
            return np.column_stack([ahead, left]) + speed_noise[new, :2]
        return changed(time_s[~lost][new], values)[1]

    stamps, swerve = (time_s[~lost], rows[~lost]), isinstance(robot, SwerveRobot)
    return Sensor(
        motion,
        CAMERA_CHANNELS if swerve else TWIST[:2],
        stamps,
        write,
        fill,
        [camera.time_constant_s] * len(_SEEN),
    )


@njit
def camera_values(position_m: Array, motion: Array, lever_m: Array, yaw_0: float) -> Array:
    """Return the camera's samples: the quaternion of yaw, pitch and roll in turn, and the vectors it rotates.

    Parameters
    ----------
    position_m : (n, 2) of the body's origin, with its error
    motion : (n, 6) speed x and y of the body's origin, yaw rate, roll, pitch and yaw
    lever_m : (3,) from the body's origin to the camera
    yaw_0 : heading at power-on

    Returns
    -------
    (n, 14) in the order of :data:`terrain.kinematics.camera.CHANNELS` and in the axes of
    :func:`terrain.kinematics.camera.to_camera`
    """
    values = np.zeros((motion.shape[0], 14))
    w_0, z_0 = math.cos(-yaw_0 / 2), math.sin(-yaw_0 / 2)
    for i in range(motion.shape[0]):
        half_roll, half_pitch, half_yaw = motion[i, 3] / 2, motion[i, 4] / 2, (motion[i, 5] - yaw_0) / 2
        cr, sr = math.cos(half_roll), math.sin(half_roll)
        cp, sp = math.cos(half_pitch), math.sin(half_pitch)
        cy, sy = math.cos(half_yaw), math.sin(half_yaw)
        w = cy * cp * cr + sy * sp * sr
        x = cy * cp * sr - sy * sp * cr
        y = cy * sp * cr + sy * cp * sr
        z = sy * cp * cr - cy * sp * sr
        place = _rotated(w_0, 0.0, 0.0, z_0, position_m[i, 0], position_m[i, 1], 0.0)
        lever = _rotated(w, x, y, z, lever_m[0], lever_m[1], lever_m[2])
        ahead, left = point_velocity(motion[i, 0], motion[i, 1], motion[i, 2], lever_m[0], lever_m[1])
        velocity = _rotated(w, x, y, z, ahead, left, 0.0)
        row = values[i]
        row[0] = -(place[1] + lever[1] - lever_m[1])
        row[1] = lever[2] - lever_m[2]
        row[2] = -(place[0] + lever[0] - lever_m[0])
        row[3], row[4], row[5], row[6] = -y, z, -x, w
        row[7], row[8], row[9] = -velocity[1], velocity[2], -velocity[0]
        row[11], row[13] = motion[i, 2], 1.0
    return values


@inner
def _rotated(
    w: float, x: float, y: float, z: float, a: float, b: float, c: float
) -> tuple[float, float, float]:
    """Return a vector (a, b, c) rotated by a quaternion."""
    return (
        (x * x - y * y - z * z + w * w) * a + 2 * (x * y - z * w) * b + 2 * (x * z + y * w) * c,
        2 * (x * y + z * w) * a + (-x * x + y * y - z * z + w * w) * b + 2 * (y * z - x * w) * c,
        2 * (x * z - y * w) * a + 2 * (y * z + x * w) * b + (-x * x - y * y + z * z + w * w) * c,
    )


SWAY_S = 0.05  # over which a receiver sees its antenna sway with the body


class Gnss(NamedTuple):
    """An RTK receiver; its antenna is where the robot's description has it, by default above the body's origin.

    Fix to 2 cm and 10 Hz: thesis 5.1.1.  A float solution of half a metre, the latency of the radio link, the accuracy
    of the Doppler speed and how long a fix lasts are assumed.
    """

    rate_hz: float = 10.0
    latency_s: float = 0.1
    fix_std_m: float = 0.02
    float_std_m: float = 0.5
    speed_std_mps: float = 0.03
    fix_length_s: float = 60.0
    float_length_s: float = 5.0


def gnss_sensor(motion: Motion, robot: Robot, receiver: Gnss, rng: np.random.Generator) -> Sensor:
    """Return RTK positions and speeds in the world frame, with stretches of float."""
    time_s, rows = motion.at(receiver.rate_hz, receiver.latency_s)
    fixed, state = np.empty(len(rows), dtype=bool), True
    for i, chance in enumerate(rng.random(len(rows)) * receiver.rate_hz):
        state = state != bool(chance < 1 / (receiver.fix_length_s if state else receiver.float_length_s))
        fixed[i] = state
    std = np.where(fixed, receiver.fix_std_m, receiver.float_std_m)
    noise = std[:, None] * rng.standard_normal((len(rows), 2))
    noise = np.column_stack([noise, receiver.speed_std_mps * rng.standard_normal((len(rows), 2))])

    def write(new: slice, rows: Array, _: Array) -> Array:
        at = fixes(motion.record[rows], noise[new], std[new], fixed[new])
        if robot.describes("antenna"):
            at[:, :4] += _antenna(motion, rows, robot.antenna)
        return at

    return Sensor(motion, GNSS_CHANNELS, (time_s, rows), write)


def _antenna(motion: Motion, rows: Array, place: Antenna) -> Array:
    """Return what position and velocity (n, 4) of an antenna add to those of the body's origin that it sways over."""
    up, turn, yaw = motion.up[rows], motion.record["yaw_rate_radps"][rows], motion.record["yaw_rad"][rows]
    sway = (up - motion.up[np.maximum(rows - round(SWAY_S / STEP_S), 0)]) / SWAY_S
    x_m, y_m = place.lever_x_m - place.lever_z_m * up[:, 0], place.lever_y_m - place.lever_z_m * up[:, 1]
    ahead, left = -place.lever_z_m * sway[:, 0] - turn * y_m, -place.lever_z_m * sway[:, 1] + turn * x_m
    cos, sin = np.cos(yaw), np.sin(yaw)
    place_m = x_m * cos - y_m * sin, x_m * sin + y_m * cos
    return np.column_stack([*place_m, ahead * cos - left * sin, ahead * sin + left * cos])


def fixes(rows: Array, noise: Array, std_m: Array | float, fixed: Array | float = 1.0) -> Array:
    """Return the samples (n, 6) of a receiver from rows that have those of :data:`BODY`, with noise (n, 4)."""
    cos, sin = np.cos(rows["yaw_rad"]), np.sin(rows["yaw_rad"])
    ahead, left = rows["speed_x_mps"], rows["speed_y_mps"]
    velocity = ahead * cos - left * sin, ahead * sin + left * cos
    values = np.column_stack([rows["position_x_m"], rows["position_y_m"], *velocity]) + noise
    one = np.ones(len(rows))
    return np.column_stack([values, std_m * one, fixed * one])


class Poses(NamedTuple):
    """What sees the pose of a robot in a fixed frame: a lidar that is matched with a map, or cameras around the field.

    Rates and noise are assumed, but those that come of a description (:func:`poses_of`).
    """

    rate_hz: float = 10.0
    latency_s: float = 0.0
    position_std_m: float = 0.02
    yaw_std_rad: float = 0.005
    lever_x_m: float = 0.0  # of what is seen, from the body's origin
    lever_y_m: float = 0.0


FIELD_CAMERAS = Poses(100.0, 0.0, 0.001, 0.002)  # around a small field


def poses_of(robot: Robot) -> Poses:
    """Return a camera above a robot that its description has; without one, :class:`Poses` as they are."""
    camera = robot.parts.get("camera")
    return Poses(**{name: getattr(camera, name) for name in Poses._fields}) if camera else Poses()


def pose_sensor(motion: Motion, poses: Poses, rng: np.random.Generator, faults: Faults) -> Sensor:
    """Return poses (x, y, yaw) in the world frame, with white noise; lost samples are left out."""
    time_s, rows = motion.at(poses.rate_hz, poses.latency_s)
    std = np.array([poses.position_std_m, poses.position_std_m, poses.yaw_std_rad])
    noise = std * rng.standard_normal((len(rows), 3))
    seen = ~is_lost(time_s, faults.camera_lost_s)

    def write(new: slice, rows: Array, _: Array) -> Array:
        at = motion.record[rows]
        lever = (poses.lever_x_m + 1j * poses.lever_y_m) * np.exp(1j * at["yaw_rad"])
        place = at["position_x_m"] + lever.real, at["position_y_m"] + lever.imag
        values = np.column_stack([*place, at["yaw_rad"]]) + noise[seen][new]
        values[:, 2] = wrapped(values[:, 2])
        return values

    return Sensor(motion, POSE_CHANNELS, (time_s[seen], rows[seen]), write)


def compass_sensor(motion: Motion, rng: np.random.Generator) -> Sensor:
    """Return the heading of a compass, with white noise."""
    time_s, rows = motion.at(RAW_HZ)
    noise = COMPASS_STD_RAD * rng.standard_normal(len(rows))

    def write(new: slice, rows: Array, _: Array) -> Array:
        return np.asarray(wrapped(motion.record["yaw_rad"][rows] + noise[new]))[:, None]

    return Sensor(motion, ("yaw_rad",), (time_s, rows), write)


# Rate and noise of raw fixes (Deremetz et al., ICRA 2017, section VI), and of a compass (half a degree, assumed); noise
# of a velocity over that of the position, as the Doppler speed of the other receiver.
RAW_HZ, RAW_STD_M, COMPASS_STD_RAD, SPEED_FACTOR_PS = 10.0, 0.02, 0.0087, 1.5
RAW_FIXES = Gnss(RAW_HZ, 0.0, RAW_STD_M, speed_std_mps=SPEED_FACTOR_PS * RAW_STD_M, fix_length_s=math.inf)


def raw_fixes(
    time_s: Array,
    rows: Array,
    rng: np.random.Generator,
    std_m: float = RAW_STD_M,
    std_rad: float = COMPASS_STD_RAD,
) -> dict[str, Stream]:
    """Return the streams ``gnss`` and ``compass`` of rows (n,) that have those of :data:`BODY`, at stamps (n,)."""
    n = len(time_s)
    noise = std_m * rng.standard_normal((n, 2)), SPEED_FACTOR_PS * std_m * rng.standard_normal((n, 2))
    heading = wrapped(rows["yaw_rad"] + std_rad * rng.standard_normal(n))
    return {
        "gnss": Stream(time_s, fixes(rows, np.hstack(noise), std_m), GNSS_CHANNELS),
        "compass": Stream(time_s, heading[:, None], ("yaw_rad",)),
    }


TRUTH_HZ = 100.0  # rate of the stream: a compromise with the size of files
GYRO_BIAS = "gyro_bias_z_radps"  # channel of the true bias of the yaw gyro


def wheel_channels(quantity: str, wheels: Sequence[str]) -> tuple[str, ...]:
    """Return the channels of one quantity of all wheels.

    Examples
    --------
    >>> wheel_channels("slip_ratio", ("left", "right"))
    ('slip_left_ratio', 'slip_right_ratio')
    """
    name, _, unit = quantity.rpartition("_")
    return tuple(f"{name}_{wheel}_{unit}" for wheel in wheels)


def truth_stream(
    time_s: Array, rows: Array, wheels: Sequence[str], of_wheels: Mapping[str, Array], more: Mapping[str, Any]
) -> Stream:
    """Return the truth of rows (n,) that have those of :data:`BODY`.

    Parameters
    ----------
    wheels, of_wheels : names, and quantities (n, wheels) by name
    more : channels (n,), other ones or in place of those of the body
    """
    columns: dict[str, Any] = {name: rows[name] for name in BODY.names or ()}
    for quantity, values in of_wheels.items():
        columns |= zip(wheel_channels(quantity, wheels), values.T, strict=True)
    columns |= more
    return Stream(time_s, np.column_stack(list(columns.values())), tuple(columns))
