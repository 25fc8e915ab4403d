"""Sensors: from what happened, step by step, to what each logger wrote at its own rate.

Each sensor takes the recorded motion at :data:`~terrain.simulation.vehicle.STEP_S`, adds what it does to it
(low-pass, latency, bias, noise, quantisation, loss) and gives one stream.  A stamp is the time at which the
sample arrived; what it tells is older by the sensor's latency.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.estimation.camera import odometry_stream, to_camera
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS, STEERING_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array, Stream
from terrain.robots import Robot, Sensors
from terrain.simulation.conditions import Faults
from terrain.simulation.vehicle import BODY_RECORD, N_BODY_RECORD, STEP_S, WHEEL_RECORD

IMU_BANDWIDTH_HZ = {"accel": 62.5, "gyro": 47.0}
"""Bandwidths of the BNO055 in its fusion modes (Bosch data sheet)."""

TILT_NOISE_RAD = 0.001
"""Sample noise of the fused roll and pitch; assumed."""

JUMP_SAMPLES = 4
"""A relocalisation of the camera shows as that many samples of a wrong speed; assumed."""


@dataclass(frozen=True, slots=True)
class Gnss:
    """An RTK receiver with its antenna above the body's origin.

    Fix to 2 cm and 10 Hz: thesis 5.1.1.  A float solution of half a metre, the latency of the radio link, the
    accuracy of the Doppler speed and how long a fix lasts are assumed.
    """

    rate_hz: float = 10.0
    latency_s: float = 0.1
    fix_std_m: float = 0.02
    float_std_m: float = 0.5
    speed_std_mps: float = 0.03
    fix_length_s: float = 60.0
    float_length_s: float = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What happened in one run, every :data:`STEP_S`.

    Parameters
    ----------
    record : (n, N_RECORD) as :func:`terrain.simulation.vehicle.advance` writes it
    """

    record: Array

    @property
    def time_s(self) -> Array:
        """Time (n,) of each row."""
        return np.arange(len(self.record)) * STEP_S

    def body(self, name: str) -> Array:
        """One quantity (n,) of the body."""
        return self.record[:, BODY_RECORD.index(name)]

    def wheel(self, name: str) -> Array:
        """One quantity (n, 3) of the wheels."""
        return self.record[:, N_BODY_RECORD + WHEEL_RECORD.index(name) :: len(WHEEL_RECORD)][:, :3]

    def at(self, rate_hz: float, latency_s: float = 0.0) -> tuple[Array, Array]:
        """Stamps (k,) of a sensor of that rate, and the rows (k,) it tells of."""
        time_s = np.arange(math.floor(len(self.record) * STEP_S * rate_hz + 1e-6)) / rate_hz
        return time_s, np.maximum(np.round((time_s - latency_s) / STEP_S).astype(int), 0)


def _low_pass(values: Array, time_constant_s: float) -> Array:
    """First-order low-pass along the first axis, started at rest at the first value."""
    if time_constant_s <= 0.0:
        return values
    keep = math.exp(-STEP_S / time_constant_s)
    start = values[:1]
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], values - start, axis=0) + start)


def wheels_stream(motion: Motion, robot: Robot, rng: np.random.Generator) -> Stream:
    """Motor rates behind the driver's low-pass on quantised Hall steps, and motor currents."""
    motors, sensors = robot.equipment.motors, robot.equipment.sensors
    time_s, rows = motion.at(sensors.wheels_rate_hz)
    motor = motion.wheel("reported_radps")[rows] * motors.reduction_ratio
    moving = np.abs(motor) > 1e-3  # a Hall sensor that sees no step says nothing but zero
    motor = motor + sensors.motor_std_radps * rng.standard_normal(motor.shape) * moving
    per_amp_nm = motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio
    current = motion.wheel("torque_nm")[rows] / per_amp_nm
    current = current + sensors.current_std_a * rng.standard_normal(current.shape)
    return Stream(time_s, np.hstack([motor, current]), WHEELS_CHANNELS)


def steering_stream(motion: Motion, robot: Robot, rng: np.random.Generator) -> Stream:
    """Absolute encoders: whole steps a turn (Gray code errs by one at most), the zero not taken off."""
    steering, sensors = robot.equipment.steering, robot.equipment.sensors
    time_s, rows = motion.at(sensors.steering_rate_hz)
    zeros = np.array([steering.zero_1_rad, steering.zero_2_rad, steering.zero_3_rad])
    angle = motion.wheel("steer_rad")[rows] + zeros
    angle = angle + sensors.steering_std_rad * rng.standard_normal(angle.shape)
    step_rad = 2 * math.pi / sensors.steering_steps_ratio
    angle = np.floor(angle / step_rad) * step_rad + step_rad / 2
    return Stream(time_s, wrapped(angle), STEERING_CHANNELS)


def tilt(motion: Motion) -> tuple[Array, Array]:
    """Roll and pitch (n,) of the body: the slope and the ride over it."""
    grade_x, grade_y = motion.body("grade_x_ratio"), motion.body("grade_y_ratio")
    # up is (grade_x, grade_y, 1) in body axes, by angles (-sin pitch, sin roll cos pitch, cos roll cos pitch)
    roll = np.arctan(grade_y) + motion.body("ride_roll_rad")
    pitch = -np.arctan(grade_x / np.hypot(1.0, grade_y)) + motion.body("ride_pitch_rad")
    return roll, pitch


def imu_stream(motion: Motion, robot: Robot, rng: np.random.Generator) -> tuple[Stream, Array]:
    """IMU without magnetometer over the body's origin; also the true bias (n,) of its yaw gyro at each stamp.

    It sits as high as the centre of mass.  The specific force is acceleration minus gravity: +g on z at rest,
    ``+g sin`` on x with the nose up.  Rates are those of the body: turning on an even slope rolls nothing.
    """
    sensors, body = robot.equipment.sensors, robot.equipment.body
    time_s, rows = motion.at(sensors.imu_rate_hz, sensors.imu_latency_s)
    roll, pitch = tilt(motion)
    up = np.column_stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
    force = GRAVITY_MPS2 * up + np.column_stack(
        [
            motion.body("accel_x_mps2") + body.com_height_m * motion.body("ride_pitch_radps2"),
            motion.body("accel_y_mps2") - body.com_height_m * motion.body("ride_roll_radps2"),
            motion.body("ride_z_mps2"),
        ]
    )
    turn = motion.body("yaw_rate_radps")
    change_x, change_y, _ = np.gradient(up, STEP_S, axis=0).T  # up stands in the world: d(up)/dt = up x rate
    rate = np.column_stack(
        [(change_y + turn * up[:, 0]) / up[:, 2], (turn * up[:, 1] - change_x) / up[:, 2], turn]
    )
    force = _low_pass(force, 1 / (2 * math.pi * IMU_BANDWIDTH_HZ["accel"]))[rows]
    rate = _low_pass(rate, 1 / (2 * math.pi * IMU_BANDWIDTH_HZ["gyro"]))[rows]
    yaw = motion.body("yaw_rad")[rows] - motion.body("yaw_rad")[0]
    return imu_samples(sensors, time_s, force, rate, np.column_stack([roll, pitch])[rows], yaw, rng)


def imu_samples(
    sensors: Sensors,
    time_s: Array,
    force_mps2: Array,
    rate_radps: Array,
    tilt_rad: Array,
    yaw_rad: Array,
    rng: np.random.Generator,
) -> tuple[Stream, Array]:
    """Return what an IMU tells of a motion, and the bias (n,) of its yaw gyro.

    Each power-on has biases of its own about those described; the gyro's walk, and the fused yaw sums them.

    Parameters
    ----------
    sensors : scales, biases and noise
    time_s : (n,) evenly spaced
    force_mps2, rate_radps : (n, 3) specific force and body rates, behind the sensor's own low-pass
    tilt_rad : (n, 2) roll and pitch
    yaw_rad : (n,) counted from the start
    rng : source of biases and noise
    """
    n = len(time_s)
    scale, accel_bias, gyro_bias = (
        np.array([getattr(sensors, pattern.format(axis)) for axis in "xyz"])
        for pattern in ("accel_scale_{}_ratio", "accel_bias_{}_mps2", "gyro_bias_{}_radps")
    )
    accel_bias = accel_bias + sensors.accel_bias_std_mps2 * rng.standard_normal(3)
    gyro_bias = gyro_bias + sensors.gyro_bias_std_radps * rng.standard_normal(3)
    period_s = 1 / sensors.imu_rate_hz
    walk = sensors.gyro_walk_radps * math.sqrt(period_s) * rng.standard_normal((n, 3)).cumsum(axis=0)
    bias = gyro_bias + walk
    accel = scale * force_mps2 + accel_bias + sensors.accel_std_mps2 * rng.standard_normal((n, 3))
    gyro = rate_radps + bias + sensors.gyro_std_radps * rng.standard_normal((n, 3))
    mounting = sensors.tilt_std_rad * rng.standard_normal(2)
    fused = tilt_rad + mounting
    fused = fused + TILT_NOISE_RAD * rng.standard_normal((n, 2))
    drift = np.concatenate([[0.0], np.cumsum(bias[1:, 2]) * period_s])
    yaw = yaw_rad + drift
    yaw = yaw + sensors.yaw_std_rad * rng.standard_normal(n)
    return Stream(time_s, np.column_stack([gyro, accel, fused, wrapped(yaw)]), IMU_CHANNELS), bias[:, 2]


def camera_stream(motion: Motion, robot: Robot, rng: np.random.Generator, faults: Faults) -> Stream:
    """Tracking camera in its own frames: drifting pose, noisy speed, dropouts and relocalisation jumps."""
    camera = robot.equipment.camera
    time_s, rows = motion.at(camera.rate_hz, camera.latency_s)
    n = len(rows)
    roll, pitch = tilt(motion)
    plain = np.column_stack(
        [
            motion.body("speed_x_mps"),
            motion.body("speed_y_mps"),
            motion.body("yaw_rate_radps"),
            roll,
            pitch,
            motion.body("yaw_rad"),
        ]
    )
    plain = _low_pass(plain, camera.time_constant_s)[rows]
    yaw = plain[:, 5] + camera.yaw_std_rad * rng.standard_normal(n)
    drift = camera.speed_std_mps * rng.standard_normal((n, 2)).cumsum(axis=0) / camera.rate_hz
    position = np.column_stack([motion.body("position_x_m"), motion.body("position_y_m")])[rows] + drift
    position = position + camera.position_std_m * rng.standard_normal((n, 2))
    speed_noise = camera.speed_std_mps * rng.standard_normal((n, 3))  # in the camera's axes
    lost = np.zeros(n, dtype=bool)
    chance = rng.random((n, 2)) * camera.rate_hz
    lengths = rng.exponential(camera.dropout_length_s, n)
    jumps = camera.jump_std_m * rng.standard_normal((n, 2))
    if faults.by_chance:
        for i in np.flatnonzero(chance[:, 0] < camera.dropout_rate_hz):
            lost |= (time_s >= time_s[i]) & (time_s < time_s[i] + lengths[i])
        for i in np.flatnonzero(chance[:, 1] < camera.jump_rate_hz):
            position[i:] += jumps[i]
            speed_noise[i : i + JUMP_SAMPLES] += (
                to_camera(np.append(jumps[i], 0.0)) * camera.rate_hz / JUMP_SAMPLES
            )
    for start_s, end_s in faults.camera_lost_s:
        lost |= (time_s >= start_s) & (time_s < end_s)
    stream = odometry_stream(
        time_s,
        position,
        yaw,
        plain[:, 3],
        plain[:, 4],
        plain[:, :2],
        plain[:, 2],
        camera,
        yaw_0=float(yaw[0]),
    )
    values = np.array(stream.values)
    names = stream.channels
    values[:, [names.index(f"velocity_{axis}_mps") for axis in "xyz"]] += speed_noise
    values[:, [names.index(f"rate_{axis}_radps") for axis in "xyz"]] += (
        camera.yaw_rate_std_radps * rng.standard_normal((n, 3))
    )
    return Stream(time_s[~lost], values[~lost], names)


def gnss_stream(motion: Motion, receiver: Gnss, rng: np.random.Generator, faults: Faults) -> Stream:
    """RTK positions and speeds in the world frame, with stretches of float."""
    time_s, rows = motion.at(receiver.rate_hz, receiver.latency_s)
    n = len(rows)
    fixed = np.empty(n, dtype=bool)
    state = True
    leave = rng.random(n) * receiver.rate_hz
    for i in range(n):
        length_s = receiver.fix_length_s if state else receiver.float_length_s
        state = state != bool(leave[i] < 1 / length_s)
        fixed[i] = state
    std = np.where(fixed, receiver.fix_std_m, receiver.float_std_m)
    yaw = motion.body("yaw_rad")[rows]
    along, across = motion.body("speed_x_mps")[rows], motion.body("speed_y_mps")[rows]
    position = np.column_stack([motion.body("position_x_m"), motion.body("position_y_m")])[rows]
    position = position + std[:, None] * rng.standard_normal((n, 2))
    velocity = np.column_stack(
        [along * np.cos(yaw) - across * np.sin(yaw), along * np.sin(yaw) + across * np.cos(yaw)]
    )
    velocity = velocity + receiver.speed_std_mps * rng.standard_normal((n, 2))
    kept = np.ones(n, dtype=bool)
    for start_s, end_s in faults.gnss_lost_s:
        kept &= ~((time_s >= start_s) & (time_s < end_s))
    return Stream(time_s[kept], np.column_stack([position, velocity, std, fixed])[kept], GNSS_CHANNELS)


def truth_stream(
    motion: Motion, gyro_bias_radps: Array, gyro_time_s: Array, rate_hz: float = 100.0
) -> Stream:
    """Return what happened, at a rate that files can bear; a slip that no instant has is no channel."""
    time_s, rows = motion.at(rate_hz)
    roll, pitch = tilt(motion)
    columns = {
        **{name: motion.body(name) for name in ("position_x_m", "position_y_m", "yaw_rad")},
        "roll_rad": roll,
        "pitch_rad": pitch,
        **{
            name: motion.body(name)
            for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2")
        },
    }
    for recorded in (
        "wheel_radps",
        "steer_rad",
        "slip_ratio",
        "slip_angle_rad",
        "normal_n",
        "traction_n",
        "torque_nm",
        "sinkage_m",
    ):
        quantity, _, unit = recorded.rpartition("_")
        for i in range(3):
            columns[f"{quantity}_{i + 1}_{unit}"] = motion.wheel(recorded)[:, i]
    kept = {name: column[rows] for name, column in columns.items() if np.isfinite(column[rows]).any()}
    kept["gyro_bias_z_radps"] = np.interp(time_s, gyro_time_s, gyro_bias_radps)
    return Stream(time_s, np.column_stack(list(kept.values())), tuple(kept))
