"""The streams of a planar run: what each logger writes of the motion and of the ideal measurements.

The measurement models are those of :mod:`terrain.simulation.sensors`.  The loggers of the planar simulation
differ from those of the dynamic plant in three respects, so that a replay of the log can undo them exactly:
latency and clock errors are interpolated delays on a fixed grid, the wheel encoders report the distance over
a period, and the noise of a moving robot is coloured and grows with speed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.effects import CHANNELS, CURRENT, HEADING, INDEX, SPEED_X, TURNING_CURRENT
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.wheel_velocity import point_velocity, wheel_frame_velocities
from terrain.logs.schema import IMU_CHANNELS, POSE_CHANNELS
from terrain.records import Array, Stream
from terrain.robots import BicycleRobot, Robot, SwerveRobot
from terrain.simulation.planar.model import AX, SLIP, VX, VY, Planar, W
from terrain.simulation.planar.motion import move
from terrain.simulation.planar.noise import CAMERA_HZ, IMU_HZ, WHEELS_HZ, Noise, coloured, lag_weights
from terrain.simulation.planar.omni import currents_of
from terrain.simulation.planar.signals import delayed
from terrain.simulation.sensors import (
    BODY_TRUTH,
    GYRO_BIAS,
    N_ERRORS,
    ImuErrors,
    add_rate_noise,
    camera_samples,
    described_calibration,
    encoder_angle,
    imu_values,
    wheel_channels,
)
from terrain.slip import slip_angle, slip_ratio

CRAWL_MPS = 0.25
"""Speed below which stick-slip shows as spikes of the current."""

SPIKE_HZ, SPIKE_S = 5.0, 0.06
"""Mean rate of the spikes, and the length of each."""

STANDSTILL_MPS = 1e-6
"""Speed below which an encoder counts nothing: its low-pass ends there."""

BODY_SLIP = "slip_body_ratio"
"""Channel of the truth of an omni robot, whose body slips otherwise than any of its wheels."""

_SEEN_X = CHANNELS.index(SPEED_X)

Generators = Mapping[str, np.random.Generator]
"""A generator for each purpose."""


class PlanarMotion(NamedTuple):
    """Motion at each step.

    Wheel speeds and steering are as encoders without error show them, ``rolled_mps`` is the circumferential
    speed with the true radii, and ``active`` the factor on the noise of a moving robot.
    """

    truth: Array
    pose: Array
    grade_rad: Array
    roll_rad: Array
    wheel_speed_mps: Array
    rolled_mps: Array
    steer_rad: Array
    active: Array


class PlanarRun(NamedTuple):
    """A run before its loggers.

    Parameters
    ----------
    robot : of the run
    planar, p, dt : numbers of the robot on its terrain, parameters of effects, and step in s
    motion : at each step
    ideal : (n, len(CHANNELS)) measurements of sensors without noise
    noise : of terrain and sensors, or None
    """

    robot: Robot
    planar: Planar
    p: Array
    dt: float
    motion: PlanarMotion
    ideal: Array
    noise: Noise | None

    def samples(self, rate_hz: float) -> tuple[Array, Array]:
        """Return steps and stamps (k,) of a logger."""
        rows = np.arange(0, len(self.ideal), round(1.0 / (rate_hz * self.dt)))
        return rows, np.arange(len(rows)) / rate_hz

    def delayed(self, values: Array, latency_s: float) -> Array:
        """Return a signal (n,) as the logger of IMU and camera stamps it, behind a latency."""
        late = (self.p[INDEX["clock_offset_s"]] + latency_s) / self.dt
        rate = self.p[INDEX["clock_rate_ratio"]]
        return delayed(values, late, rate) if late != 0.0 or rate != 0.0 else values


def wheels_stream(run: PlanarRun, stick_slip_a: float, rngs: Generators, logs_currents: bool) -> Stream:
    """Return the stream of wheel speeds and, where they are logged, motor currents."""
    robot, motion = run.robot, run.motion
    rows, time_s = run.samples(WHEELS_HZ)
    current = run.ideal[rows, CHANNELS.index(CURRENT)]
    turning = run.ideal[rows, CHANNELS.index(TURNING_CURRENT)]
    if stick_slip_a:
        current = current + _spikes(motion, rows, run.dt, stick_slip_a, rngs["outside"])
    wheels = len(robot.wheels)
    if run.planar.omni:
        currents = _omni_currents(run, rows)
    elif robot.skids:
        currents = np.column_stack([current - turning, current + turning]) / 2.0
    else:
        currents = np.repeat(current[:, None] / wheels, wheels, axis=1)
    speed, currents = _measured(run, rows, currents, rngs["wheels"])
    if run.planar.omni:
        currents = np.abs(currents)  # as its logs have them
    if not logs_currents:
        return Stream(time_s, robot.logged_rates(speed), robot.rate_channels)
    channels = (*robot.rate_channels, *wheel_channels("current_a", robot.wheels))
    return Stream(time_s, np.hstack([robot.logged_rates(speed), currents]), channels)


def _measured(
    run: PlanarRun, rows: Array, currents_a: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return measured wheel speeds and currents (n, wheels)."""
    robot, motion, noise = run.robot, run.motion, run.noise
    motors, sensors = robot.motors, robot.sensors
    n, wheels = currents_a.shape
    every = round(1.0 / (WHEELS_HZ * run.dt))
    lag_s = sensors.encoder_time_constant_s + run.p[INDEX["encoder_lag_s"]]
    step_m, jitter, white = 0.0, np.zeros((n + 1, wheels)), np.zeros((n, wheels))
    if noise is not None:
        active = motion.active[rows]
        if sensors.hall_steps_ratio > 0.0:
            turns = sensors.hall_steps_ratio * motors.reduction_ratio
            step_m = 2.0 * math.pi * robot.wheel_radius_m / turns
        jitter = rng.standard_normal((n + 1, wheels)) * noise.encoder_m
        jitter *= np.append(active, active[-1])[:, None]
        white_mps = sensors.motor_std_radps / motors.reduction_ratio * robot.wheel_radius_m
        white = white_mps * rng.standard_normal((n, wheels))
        std_a = np.full(wheels, noise.current_a(robot) / math.sqrt(wheels))
        tau_s = np.full(wheels, noise.current_s)
        drawn = coloured(rng.standard_normal((wheels, n)), std_a, tau_s, run.dt * every).T * active[:, None]
        currents_a = currents_a + drawn + sensors.current_std_a * rng.standard_normal((n, wheels))
    speed = encoder_speed(motion.wheel_speed_mps, every, run.dt, step_m, jitter, lag_s)
    speed[np.abs(speed) <= STANDSTILL_MPS] = 0.0
    return add_rate_noise(speed, white, STANDSTILL_MPS), currents_a


def _omni_currents(run: PlanarRun, rows: Array) -> Array:
    """Return the current (k, wheels) of each motor: of the motion before the ground disturbs it."""
    motion, p = run.motion, run.p
    wheels = np.ascontiguousarray(motion.rolled_mps / (1.0 + p[INDEX["wheel_radius_ratio"]]))
    still = np.zeros((0, 3))
    truth = move(run.planar, p, run.dt, wheels, motion.steer_rad, motion.grade_rad, motion.roll_rad, still)
    return np.asarray(currents_of(run.planar, p, run.dt, wheels, truth)[rows])


def pose_stream(run: PlanarRun, rng: np.random.Generator) -> Stream:
    """Return the poses that a camera above measures of an omni robot: the world's axes, its own noise."""
    camera = run.robot.camera
    rows, time_s = run.samples(CAMERA_HZ)
    latency_s = run.planar.latency_s + run.p[INDEX["camera_latency_s"]]
    x_m, y_m, yaw_rad = (run.delayed(column, latency_s)[rows] for column in run.motion.pose.T)
    lever_m = [
        at + run.p[INDEX[f"lever_{axis}_m"]]
        for axis, at in zip("xy", (camera.lever_x_m, camera.lever_y_m), strict=True)
    ]
    marker = x_m + 1j * y_m + np.exp(1j * yaw_rad) * complex(*lever_m)
    marker = marker * (1.0 + run.p[INDEX["camera_scale_ratio"]])
    seen = np.column_stack([marker.real, marker.imag, yaw_rad - run.p[INDEX["camera_yaw_rad"]]])
    if run.noise is not None:
        std = np.array([camera.position_std_m, camera.position_std_m, camera.yaw_std_rad])
        seen = seen + std * rng.standard_normal(seen.shape)
    return Stream(time_s, seen, POSE_CHANNELS)


def encoder_scales(robot: Robot, p: Array) -> Array:
    """Return true over measured wheel rates (wheels,): encoders may lose counts."""
    names = [f"wheel_scale_{wheel}_ratio" for wheel in robot.wheels]
    return np.array([1.0 + p[INDEX[name]] if name in INDEX else 1.0 for name in names])


@njit(cache=True)
def encoder_speed(
    wheel_speed_mps: Array, every: int, dt: float, step_m: float, jitter_m: Array, lag_s: float
) -> Array:
    """Return the wheel speeds (n, wheels) that encoders count: distance over a period, stamped in its middle.

    Parameters
    ----------
    wheel_speed_mps : (m, wheels)
    every, dt : steps a sample, and their length in s
    step_m : of the encoder, at the circumference; 0 does not quantise
    jitter_m : (n + 1, wheels) errors of the distances read
    lag_s : of the low-pass behind the encoder
    """
    m, wheels = wheel_speed_mps.shape
    n = (m - 1) // every + 1
    out = np.empty((n, wheels))
    distance = np.empty(m)
    period = every * dt
    for i in range(wheels):
        distance[0] = 0.0
        for k in range(1, m):
            distance[k] = distance[k - 1] + 0.5 * dt * (wheel_speed_mps[k - 1, i] + wheel_speed_mps[k, i])
        before = 0.0
        for k in range(n + 1):
            at = k * every - every // 2
            inside = min(max(at, 0), m - 1)
            reading = distance[inside] + (at - inside) * dt * wheel_speed_mps[inside, i] + jitter_m[k, i]
            if step_m > 0.0:
                reading = math.floor(reading / step_m) * step_m
            if k > 0:
                out[k - 1, i] = (reading - before) / period
            before = reading
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


def steering_stream(run: PlanarRun, rng: np.random.Generator) -> Stream:
    """Return the stream of steering angles."""
    sensors = run.robot.sensors
    rows, time_s = run.samples(WHEELS_HZ)
    channels = run.robot.steer_channels
    steer, noise, step_rad = run.motion.steer_rad[rows, : len(channels)], np.zeros(1), 0.0
    if run.noise is not None:
        noise = sensors.steering_std_rad * rng.standard_normal(steer.shape)
        if sensors.steering_steps_ratio > 0.0:
            step_rad = 2.0 * math.pi / sensors.steering_steps_ratio
    angle = encoder_angle(steer, run.robot.steering_zeros_rad[: len(channels)], noise, step_rad)
    return Stream(time_s, angle, channels)


def imu_stream(run: PlanarRun, rng: np.random.Generator) -> Stream:
    """Return the stream of the IMU."""
    motion, sensors = run.motion, run.robot.sensors
    rows, time_s = run.samples(IMU_HZ)
    latency_s = sensors.imu_latency_s + run.p[INDEX["imu_latency_s"]]
    v_x, v_y, turn = (motion.truth[:, column] for column in (VX, VY, W))
    level = np.cos(motion.grade_rad)
    tilt = np.column_stack(
        [run.delayed(angle, latency_s)[rows] for angle in (motion.roll_rad, -motion.grade_rad)]
    )
    rate = np.empty((len(rows), 3))
    rate[:, :2] = np.gradient(tilt, 1.0 / IMU_HZ, axis=0)
    rate[:, 2] = run.ideal[rows, CHANNELS.index("yaw_rate_radps")]  # with clock and latency already
    force = np.empty((len(rows), 3))
    force[:, 0] = run.ideal[rows, CHANNELS.index("accel_x_mps2")]
    sideways = np.gradient(v_y, run.dt) + turn * v_x + GRAVITY_MPS2 * np.sin(motion.roll_rad) * level
    force[:, 1] = run.delayed(sideways, latency_s)[rows]
    force[:, 2] = run.delayed(GRAVITY_MPS2 * np.cos(motion.roll_rad) * level, latency_s)[rows]
    active = run.delayed(motion.active, latency_s)[rows]
    yaw = (np.cumsum(rate[:, 2]) - rate[0, 2]) / IMU_HZ
    values = imu_values(_imu_errors(run, active, rng), slice(None), force, rate, tilt, yaw)
    return Stream(time_s, values, IMU_CHANNELS)


def _imu_errors(run: PlanarRun, active: Array, rng: np.random.Generator) -> ImuErrors:
    """Return the errors of the IMU: those described, and vibration while the robot moves; ``active`` (n,)."""
    sensors, noise, n = run.robot.sensors, run.noise, len(active)
    scale, accel_bias, gyro_bias = described_calibration(sensors)
    inertial, tilt, yaw = np.zeros((n, 6)), np.zeros((n, 2)), np.zeros(n)
    if noise is not None:
        std = np.repeat([noise.gyro_radps, noise.accel_mps2], 3)
        tau = np.repeat([noise.gyro_s, noise.accel_s], 3)
        vibration = coloured(rng.standard_normal((6, n)), std, tau, 1.0 / IMU_HZ)
        white = np.repeat([sensors.gyro_std_radps, sensors.accel_std_mps2], 3)
        inertial = vibration.T * active[:, None] + white * rng.standard_normal((n, 6))
        tilt = noise.tilt_rad * rng.standard_normal((n, 2))
        yaw = sensors.yaw_std_rad * rng.standard_normal(n)
    yaw_rate = gyro_bias[2] + inertial[:, 2]  # the fused yaw sums the measured rate
    return ImuErrors(
        accel_scale_ratio=scale,
        yaw_scale_ratio=1.0,
        rate_bias_radps=np.tile(gyro_bias, (n, 1)),
        rate_noise_radps=inertial[:, :3],
        accel_bias_mps2=accel_bias,
        accel_noise_mps2=inertial[:, 3:],
        tilt_bias_rad=np.array([run.p[INDEX["roll_offset_rad"]], -run.p[INDEX["pitch_offset_rad"]]]),
        tilt_noise_rad=tilt,
        yaw_bias_rad=(np.cumsum(yaw_rate) - yaw_rate[0]) / IMU_HZ,
        yaw_noise_rad=yaw,
    )


def camera_stream(run: PlanarRun, rng: np.random.Generator) -> Stream:
    """Return the stream of the camera: poses of a swerve robot, else speeds in body axes."""
    camera, noise = run.robot.camera, run.noise
    rows, time_s = run.samples(CAMERA_HZ)
    n = len(rows)
    latency_s = run.planar.latency_s + run.p[INDEX["camera_latency_s"]]
    seen = run.ideal[rows, _SEEN_X : _SEEN_X + 2].copy()
    if noise is not None:
        active = run.delayed(run.motion.active, latency_s)[rows]
        std, tau = np.full(2, noise.camera_mps), np.full(2, noise.camera_s)
        seen += coloured(rng.standard_normal((2, n)), std, tau, 1.0 / CAMERA_HZ).T * active[:, None]
        seen += camera.speed_std_mps * rng.standard_normal((n, 2))
    if not isinstance(run.robot, SwerveRobot):
        return Stream(time_s, seen, ("speed_x_mps", "speed_y_mps"))
    turn = run.ideal[:, CHANNELS.index(HEADING)]
    yaw = ((np.cumsum(turn) - 0.5 * (turn + turn[0])) * run.dt)[rows]
    rate, position_noise = turn[rows], np.zeros((n, 2))
    if noise is not None:
        yaw = yaw + camera.yaw_std_rad * rng.standard_normal(n)
        rate = rate + camera.yaw_rate_std_radps * rng.standard_normal(n)
        position_noise = camera.position_std_m * rng.standard_normal((n, 2))
    origin = np.column_stack(
        point_velocity(seen[:, 0], seen[:, 1], rate, -camera.lever_x_m, -camera.lever_y_m)
    )
    cos, sin = np.cos(yaw), np.sin(yaw)
    velocity = np.column_stack(
        [origin[:, 0] * cos - origin[:, 1] * sin, origin[:, 0] * sin + origin[:, 1] * cos]
    )
    position = np.cumsum(velocity, axis=0) / CAMERA_HZ + position_noise
    roll, pitch = (run.delayed(a, latency_s)[rows] for a in (run.motion.roll_rad, -run.motion.grade_rad))
    body = np.column_stack([origin, rate, roll, pitch, yaw])
    lever_m = np.array([camera.lever_x_m, camera.lever_y_m, camera.lever_z_m])
    values = np.empty((n, len(CAMERA_CHANNELS)))
    camera_samples(position, body, np.zeros((n, N_ERRORS)), lever_m, 0.0, values)
    return Stream(time_s, values, CAMERA_CHANNELS)


def lidar_stream(run: PlanarRun, rng: np.random.Generator) -> Stream:
    """Return the rate of a heading that does not depend on the gyro, from central differences."""
    rows, time_s = run.samples(CAMERA_HZ)
    rate = run.ideal[rows, CHANNELS.index(HEADING)]
    if run.noise is not None:
        heading = run.noise.heading_rad * rng.standard_normal(len(rows))
        rate = rate + np.gradient(heading, 1.0 / CAMERA_HZ)
    return Stream(time_s, rate[:, None], ("yaw_rate_radps",))


def planar_truth(run: PlanarRun) -> Stream:
    """Return the stream of true quantities."""
    robot, motion = run.robot, run.motion
    rows, time_s = run.samples(IMU_HZ)
    v_x, v_y, turn = (motion.truth[rows, column] for column in (VX, VY, W))
    grade = motion.grade_rad[rows]
    accel_x = motion.truth[rows, AX] - GRAVITY_MPS2 * np.sin(grade)
    accel_y = np.gradient(v_y, 1.0 / IMU_HZ) + turn * v_x
    steer = motion.steer_rad[rows] + robot.wheel_directions_rad
    places_m = robot.wheel_positions_m * (1.0 + run.p[INDEX["wheel_distance_ratio"]])
    along, across = wheel_frame_velocities(np.column_stack([v_x, v_y, turn]), places_m, steer)
    columns = [
        motion.pose[rows],
        np.column_stack([motion.roll_rad[rows], -grade, v_x, v_y, turn, accel_x, accel_y]),
        motion.wheel_speed_mps[rows] * encoder_scales(robot, run.p) / robot.wheel_radius_m,
        motion.steer_rad[rows],
        slip_ratio(motion.rolled_mps[rows], along),
        np.full((len(rows), 1), run.p[INDEX["gyro_bias_radps"]] + robot.sensors.gyro_bias_z_radps),
    ]
    wheels = (wheel_channels(each, robot.wheels) for each in ("wheel_radps", "steer_rad", "slip_ratio"))
    channels = [*BODY_TRUTH, *(name for each in wheels for name in each), GYRO_BIAS]
    if isinstance(robot, BicycleRobot):
        columns.append(slip_angle(along, across))
        channels += wheel_channels("slip_rad", robot.wheels)
    if run.planar.omni:
        columns.append(motion.truth[rows, SLIP, None])
        channels.append(BODY_SLIP)
    return Stream(time_s, np.hstack(columns), tuple(channels))
