"""From a planar motion to the streams of a run log: what each logger writes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.effects import (
    CHANNELS,
    CURRENT,
    HEADING,
    INDEX,
    SPEED_X,
    TURNING_CURRENT,
)
from terrain.kinematics.camera import odometry_stream
from terrain.logs.schema import IMU_CHANNELS, STEERING_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array, Stream
from terrain.robots import Robot
from terrain.simulation.planar.model import AX, VX, VY, Planar, W
from terrain.simulation.planar.noise import (
    CAMERA_HZ,
    IMU_HZ,
    WHEELS_HZ,
    Noise,
    coloured,
    lag_weights,
)
from terrain.simulation.planar.signals import delayed
from terrain.slip import slip_ratio

CRAWL_MPS = 0.25
"""Below this speed stick-slip spikes."""

SPIKE_HZ, SPIKE_S = 5.0, 0.06
"""How often, and how long."""

_SEEN_X = CHANNELS.index(SPEED_X)


class PlanarMotion(NamedTuple):
    """What happened, every step.

    Rims and steering are as encoders without error show them, ``rolled_mps`` is how fast rims are with the
    radii that the wheels have, and ``active`` how much of the noise of a moving robot there is.
    """

    truth: Array
    pose: Array
    grade_rad: Array
    roll_rad: Array
    wheel_speed_mps: Array
    rolled_mps: Array
    steer_rad: Array
    active: Array


def sample_rows(motion: PlanarMotion, rate_hz: float, dt: float) -> tuple[Array, Array]:
    """Return steps and stamps (k,) of a logger."""
    rows = np.arange(0, len(motion.truth), round(1.0 / (rate_hz * dt)))
    return rows, np.arange(len(rows)) / rate_hz


def wheels_stream(
    robot: Robot,
    p: Array,
    dt: float,
    motion: PlanarMotion,
    shown: Array,
    noise: Noise | None,
    outside: Mapping[str, float],
    rngs: Mapping[str, np.random.Generator],
) -> Stream:
    """Return the stream of wheel speeds and motor currents."""
    motors, sensors = robot.motors, robot.sensors
    assert motors is not None
    assert sensors is not None
    rng, wheels = rngs["wheels"], len(robot.wheels)
    every = round(1.0 / (WHEELS_HZ * dt))
    rows, time_s = sample_rows(motion, WHEELS_HZ, dt)
    n = len(rows)
    active = motion.active[rows]
    step_m, jitter, told = 0.0, np.zeros((n + 1, wheels)), np.zeros((n, wheels))
    current = shown[rows, CHANNELS.index(CURRENT)]
    turning = shown[rows, CHANNELS.index(TURNING_CURRENT)]
    if outside.get("stick_slip_a", 0.0):
        current = current + _spikes(motion, rows, dt, outside["stick_slip_a"], rngs["outside"])
    parts = np.column_stack([current - turning, current + turning]) / 2.0
    if robot.drive == "swerve":
        parts = np.repeat(current[:, None] / wheels, wheels, axis=1)
    if noise is not None:
        step_m = 2.0 * math.pi * robot.wheel_radius_m / (sensors.hall_steps_ratio * motors.reduction_ratio)
        jitter = (
            rng.standard_normal((n + 1, wheels)) * noise.encoder_m * np.append(active, active[-1])[:, None]
        )
        white_mps = sensors.motor_std_radps / motors.reduction_ratio * robot.wheel_radius_m
        told = white_mps * rng.standard_normal((n, wheels))
        size = np.full(wheels, noise.current_a(robot.drive) / math.sqrt(wheels))
        white = rng.standard_normal((wheels, n))
        drawn = coloured(white, size, np.full(wheels, noise.current_s), dt * every).T * active[:, None]
        parts = parts + drawn + sensors.current_std_a * rng.standard_normal((n, wheels))
    lag_s = sensors.encoder_time_constant_s + p[INDEX["encoder_lag_s"]]
    rate = _counted(motion.wheel_speed_mps, every, dt, step_m, jitter, lag_s)
    rate = np.where(np.abs(rate) > 1e-6, rate + told, 0.0)  # an encoder that counts nothing says zero
    channels = (*(f"speed_{wheel}_mps" for wheel in robot.wheels), *(f"current_{w}_a" for w in robot.wheels))
    if robot.drive == "swerve":
        rate, channels = rate / robot.wheel_radius_m * motors.reduction_ratio, WHEELS_CHANNELS
    return Stream(time_s, np.hstack([rate, parts]), channels)


@njit(cache=True)
def _counted(
    wheel_speed_mps: Array, every: int, dt: float, step_m: float, jitter_m: Array, lag_s: float
) -> Array:
    """Return wheel speeds (n, wheels) as encoders count them: ways over a sample, its stamp in the middle.

    Parameters
    ----------
    wheel_speed_mps : (m, wheels)
    every, dt : steps a sample, and their length
    step_m : of the encoder at the rim; 0 does not quantise
    jitter_m : (n + 1, wheels) errors of the ways read
    lag_s : of the low-pass behind
    """
    m, wheels = wheel_speed_mps.shape
    n = (m - 1) // every + 1
    out = np.empty((n, wheels))
    ways = np.empty(m)
    period = every * dt
    for i in range(wheels):
        ways[0] = 0.0
        for k in range(1, m):
            ways[k] = ways[k - 1] + 0.5 * dt * (wheel_speed_mps[k - 1, i] + wheel_speed_mps[k, i])
        before = 0.0
        for k in range(n + 1):
            at = k * every - every // 2
            inside = min(max(at, 0), m - 1)
            way = ways[inside] + (at - inside) * dt * wheel_speed_mps[inside, i] + jitter_m[k, i]
            if step_m > 0.0:
                way = math.floor(way / step_m) * step_m
            if k > 0:
                out[k - 1, i] = (way - before) / period
            before = way
        if lag_s > 0.0:
            now, earlier, keep = lag_weights(lag_s, period)
            last_in = last_out = out[0, i]
            for k in range(n):
                value = now * out[k, i] + earlier * last_in + keep * last_out
                last_in, last_out = out[k, i], value
                out[k, i] = value
    return out


def _spikes(motion: PlanarMotion, rows: Array, dt: float, size_a: float, rng: np.random.Generator) -> Array:
    """Return spikes (n,) of the sum of the currents while the wheels crawl."""
    speed = motion.wheel_speed_mps.mean(axis=1)
    crawls = (np.abs(speed) < CRAWL_MPS) & (np.abs(speed) > 0.02)
    starts = rng.random(len(speed)) < SPIKE_HZ * dt
    length = max(1, round(SPIKE_S / dt))
    lasting = np.convolve(starts & crawls, np.ones(length))[: len(speed)] > 0
    return np.asarray((size_a * np.sign(speed) * lasting)[rows])


def steering_stream(
    robot: Robot, dt: float, motion: PlanarMotion, noise: Noise | None, rng: np.random.Generator
) -> Stream:
    """Return the stream of steering angles."""
    steering, sensors = robot.steering, robot.sensors
    assert steering is not None
    assert sensors is not None
    rows, time_s = sample_rows(motion, WHEELS_HZ, dt)
    angle = motion.steer_rad[rows] + [steering.zero_1_rad, steering.zero_2_rad, steering.zero_3_rad]
    if noise is not None:
        step = 2.0 * math.pi / sensors.steering_steps_ratio
        angle = angle + sensors.steering_std_rad * rng.standard_normal(angle.shape)
        angle = np.floor(angle / step) * step + step / 2.0
    return Stream(time_s, wrapped(angle), STEERING_CHANNELS)


def _clocked(values: Array, p: Array, dt: float, late_s: float) -> Array:
    """Return a signal (n,) as the IMU's and camera's logger stamps it, so much later than it was."""
    late, rate = (p[INDEX["clock_offset_s"]] + late_s) / dt, p[INDEX["clock_rate_ratio"]]
    return delayed(values, late, rate) if late != 0.0 or rate != 0.0 else values


def imu_stream(
    robot: Robot,
    p: Array,
    dt: float,
    motion: PlanarMotion,
    shown: Array,
    noise: Noise | None,
    rng: np.random.Generator,
) -> Stream:
    """Return the stream of the IMU."""
    sensors = robot.sensors
    assert sensors is not None
    rows, time_s = sample_rows(motion, IMU_HZ, dt)
    n, late_s = len(rows), sensors.imu_latency_s
    cos = np.cos(motion.grade_rad)
    turn, v_x, v_y = (motion.truth[:, column] for column in (W, VX, VY))
    roll, pitch = (
        _clocked(motion.roll_rad, p, dt, late_s)[rows],
        -_clocked(motion.grade_rad, p, dt, late_s)[rows],
    )
    aside = np.gradient(v_y, dt) + turn * v_x + GRAVITY_MPS2 * np.sin(motion.roll_rad) * cos
    values = np.empty((n, 9))
    values[:, 0], values[:, 1] = np.gradient(roll, 1.0 / IMU_HZ), np.gradient(pitch, 1.0 / IMU_HZ)
    for column, channel in ((2, "yaw_rate_radps"), (3, "accel_x_mps2")):  # with clock and latency already
        values[:, column] = shown[rows, CHANNELS.index(channel)]
    values[:, 4] = _clocked(aside, p, dt, late_s)[rows]
    values[:, 5] = _clocked(GRAVITY_MPS2 * np.cos(motion.roll_rad) * cos, p, dt, late_s)[rows]
    values[:, :3] += [sensors.gyro_bias_x_radps, sensors.gyro_bias_y_radps, sensors.gyro_bias_z_radps]
    values[:, 3:6] *= [sensors.accel_scale_x_ratio, sensors.accel_scale_y_ratio, sensors.accel_scale_z_ratio]
    values[:, 3:6] += [sensors.accel_bias_x_mps2, sensors.accel_bias_y_mps2, sensors.accel_bias_z_mps2]
    values[:, 6], values[:, 7] = roll + p[INDEX["roll_offset_rad"]], pitch - p[INDEX["pitch_offset_rad"]]
    if noise is not None:
        active = _clocked(motion.active, p, dt, late_s)[rows]
        std = np.repeat([noise.gyro_radps, noise.accel_mps2], 3)
        tau = np.repeat([noise.gyro_s, noise.accel_s], 3)
        shaking = coloured(rng.standard_normal((6, n)), std, tau, 1.0 / IMU_HZ)
        white = np.repeat([sensors.gyro_std_radps, sensors.accel_std_mps2], 3)
        values[:, :6] += shaking.T * active[:, None] + white * rng.standard_normal((n, 6))
        values[:, 6:8] += noise.tilt_rad * rng.standard_normal((n, 2))
    values[:, 8] = (np.cumsum(values[:, 2]) - values[0, 2]) / IMU_HZ
    if noise is not None:
        values[:, 8] += sensors.yaw_std_rad * rng.standard_normal(n)
    values[:, 8] = wrapped(values[:, 8])
    return Stream(time_s, values, IMU_CHANNELS)


def camera_stream(
    robot: Robot,
    planar: Planar,
    p: Array,
    dt: float,
    motion: PlanarMotion,
    shown: Array,
    noise: Noise | None,
    rng: np.random.Generator,
) -> Stream:
    """Return the stream of the tracking camera: poses of a swerve robot, else body speeds."""
    camera = robot.camera
    assert camera is not None
    rows, time_s = sample_rows(motion, CAMERA_HZ, dt)
    n = len(rows)
    seen = shown[rows, _SEEN_X : _SEEN_X + 2].copy()
    late_s = planar.latency_s + p[INDEX["camera_latency_s"]]
    if noise is not None:
        active = _clocked(motion.active, p, dt, late_s)[rows]
        std, tau = np.full(2, noise.camera_mps), np.full(2, noise.camera_s)
        seen += coloured(rng.standard_normal((2, n)), std, tau, 1.0 / CAMERA_HZ).T * active[:, None]
        seen += camera.speed_std_mps * rng.standard_normal((n, 2))
    if robot.drive != "swerve":
        return Stream(time_s, seen, ("speed_x_mps", "speed_y_mps"))
    turn = shown[:, CHANNELS.index(HEADING)]
    yaw = ((np.cumsum(turn) - 0.5 * (turn + turn[0])) * dt)[rows]
    rate = turn[rows]
    place_noise = np.zeros((n, 2))
    if noise is not None:
        yaw = yaw + camera.yaw_std_rad * rng.standard_normal(n)
        rate = rate + camera.yaw_rate_std_radps * rng.standard_normal(n)
        place_noise = camera.position_std_m * rng.standard_normal((n, 2))
    origin = seen + np.column_stack([camera.lever_y_m * rate, -camera.lever_x_m * rate])
    cos, sin = np.cos(yaw), np.sin(yaw)
    ground = np.column_stack(
        [origin[:, 0] * cos - origin[:, 1] * sin, origin[:, 0] * sin + origin[:, 1] * cos]
    )
    place = np.cumsum(ground, axis=0) / CAMERA_HZ
    roll = _clocked(motion.roll_rad, p, dt, late_s)[rows]
    pitch = -_clocked(motion.grade_rad, p, dt, late_s)[rows]
    return odometry_stream(time_s, place + place_noise, yaw, roll, pitch, origin, rate, camera, 0.0)


def lidar_stream(
    dt: float, motion: PlanarMotion, shown: Array, noise: Noise | None, rng: np.random.Generator
) -> Stream:
    """Rate of a heading that no gyro has told, from central differences of it."""
    rows, time_s = sample_rows(motion, CAMERA_HZ, dt)
    rate = shown[rows, CHANNELS.index(HEADING)]
    if noise is not None:
        rate = rate + np.gradient(noise.heading_rad * rng.standard_normal(len(rows)), 1.0 / CAMERA_HZ)
    return Stream(time_s, rate[:, None], ("yaw_rate_radps",))


def planar_truth(robot: Robot, p: Array, dt: float, motion: PlanarMotion) -> Stream:
    """Return the stream of true quantities."""
    assert robot.sensors is not None
    rows, time_s = sample_rows(motion, IMU_HZ, dt)
    n = len(rows)
    v_x, v_y, turn = (motion.truth[rows, column] for column in (VX, VY, W))
    accel_x = motion.truth[rows, AX] - GRAVITY_MPS2 * np.sin(motion.grade_rad[rows])
    accel_y = np.gradient(v_y, 1.0 / IMU_HZ) + turn * v_x
    wheel_speed, steer = motion.wheel_speed_mps[rows], motion.steer_rad[rows]
    x, y = robot.wheel_positions_m.T
    along = (v_x[:, None] - y * turn[:, None]) * np.cos(steer) + (v_y[:, None] + x * turn[:, None]) * np.sin(
        steer
    )
    columns = [
        motion.pose[rows],
        np.column_stack([motion.roll_rad[rows], -motion.grade_rad[rows], v_x, v_y, turn, accel_x, accel_y]),
        wheel_speed / robot.wheel_radius_m,
        steer,
        slip_ratio(motion.rolled_mps[rows], along),
        np.full((n, 1), p[INDEX["gyro_bias_radps"]] + robot.sensors.gyro_bias_z_radps),
    ]
    channels = (
        *("position_x_m", "position_y_m", "yaw_rad", "roll_rad", "pitch_rad"),
        *("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2"),
        *(f"wheel_{wheel}_radps" for wheel in robot.wheels),
        *(f"steer_{wheel}_rad" for wheel in robot.wheels),
        *(f"slip_{wheel}_ratio" for wheel in robot.wheels),
        "gyro_bias_z_radps",
    )
    return Stream(time_s, np.hstack(columns), channels)
