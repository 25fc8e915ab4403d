"""One run of the planar simulation: twists wanted in, an ordinary run log with its truth out.

Twists become speeds of wheels and steering angles that a driver would command with the described geometry;
the drives follow them with a lag and bounded rates; :func:`~terrain.simulation.planar.motion.move` tells the
motion on hilly ground, :func:`~terrain.simulation.planar.sensors.sense` what sensors without noise would show
of it; loggers add noise, bias and quantisation.  A hidden effect is a number in the same vector that a replay
has.

The hills are those along the path that the wheels would roll without slip.
"""

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
    SPEED_Y,
    TURNING_CURRENT,
    nuisances_of,
    vector_of,
)
from terrain.errors import ConfigError
from terrain.kinematics.camera import odometry_stream
from terrain.kinematics.swerve import wheel_commands
from terrain.logs.schema import IMU_CHANNELS, STEERING_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array, Label, RunLog, Stream
from terrain.robots import Robot
from terrain.simulation.planar.model import AX, VX, VY, Ground, Planar, W, make_planar
from terrain.simulation.planar.motion import move
from terrain.simulation.planar.noise import (
    CAMERA_HZ,
    IMU_HZ,
    WHEELS_HZ,
    Noise,
    Scatter,
    activity,
    coloured,
    lag_weights,
)
from terrain.simulation.planar.sensors import sense
from terrain.simulation.planar.signals import delayed
from terrain.slip import slip_ratio

COMMANDS_HZ = 50.0
"""Rate of the twists, as scenarios have them."""

STEP_S = 0.01
"""From step to step: no sensor is sampled faster."""

DRIVE_S = 0.06
"""Each of the two lags in a row by which a wheel follows its command; assumed."""

DRIVE_MPS2 = 4.0
"""The most that a wheel speeds up; assumed, 2 g of grip would be needed for more."""

STEER_S = 0.08
"""Lag by which steering follows its command; assumed."""

CRAWL_MPS = 0.25
"""Below this speed stick-slip spikes."""

SPIKE_HZ, SPIKE_S = 5.0, 0.06
"""How often, and how long."""

OUTSIDE: tuple[str, ...] = ("wheel_eccentricity_ratio", "stick_slip_a")
"""Causes that no effect of the library describes: wheel speed x (1 + e sin(wheel angle)), each wheel with its
own phase, and spikes of the current at crawling speed."""

_PURPOSES = ("scatter", "hills", "ground", "wheels", "steering", "imu", "camera", "outside", "lidar")

_SEEN_X = CHANNELS.index(SPEED_X)
assert CHANNELS[_SEEN_X + 1] == SPEED_Y


class Hills(NamedTuple):
    """The lie of the land, level by default.

    Parameters
    ----------
    grade_ratio : mean gradient along the start's heading and to its left, uphill positive
    undulation_ratio : standard deviation of what undulations add to either
    undulation_length_m : about their wave length; three of them cross in drawn directions
    """

    grade_ratio: tuple[float, float] = (0.0, 0.0)
    undulation_ratio: float = 0.0
    undulation_length_m: float = 15.0


class _Motion(NamedTuple):
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


def simulate_planar(
    robot: Robot,
    twist: Array,
    seed: int | np.random.SeedSequence,
    *,
    ground: Ground | None = None,
    effects: Mapping[str, float] | None = None,
    scatter: Scatter | None = None,
    hills: Hills | None = None,
    noise: Noise | None = None,
    outside: Mapping[str, float] | None = None,
    heading: bool = False,
    run_id: str = "run",
    terrain: str = "",
    step_s: float = STEP_S,
) -> RunLog:
    """Drive twists and return what the loggers wrote, with the truth beside it.

    Parameters
    ----------
    robot : with body, motors, camera and sensors; a swerve robot with steering
    twist : (n, 3) wanted ``(speed_x_mps, speed_y_mps, yaw_rate_radps)`` at 50 Hz, from rest
    seed : of everything that is drawn; the same gives the same bytes, and a sequence is left as it is
    ground : a firm one by default
    effects : parameters of :mod:`terrain.effects.catalogue`, beside or in place of the description's own
    scatter : of this run's own parameters; by default they do not
    hills : level by default
    noise : of ground and sensors; by default there is none, and encoders do not quantise
    outside : amplitudes of :data:`OUTSIDE`
    heading : add the stream lidar, with the rate of a heading that no gyro has told
    run_id, terrain : of the run; without a terrain it has no label
    step_s : from step to step; a half, a third... of it changes little

    Returns
    -------
    RunLog
        streams wheels, imu, odometry, commands, truth, and steering of a swerve robot, whose odometry is a
        tracking camera's pose.  That of a skid-steer robot is the speed of the camera's point in body axes.

    Raises
    ------
    ConfigError
        if the robot lacks a section, or a parameter or an outside cause is unknown or not finite.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> twist = np.zeros((501, 3))
    >>> twist[50:, 0] = 0.5
    >>> run = simulate_planar(load_robot("husky"), twist, 0, effects={"wheel_radius_ratio": -0.1})
    >>> sorted(run.streams)
    ['commands', 'imu', 'odometry', 'truth', 'wheels']
    >>> run.streams["wheels"].values[-1, :2].round(3), run.streams["odometry"].values[-1].round(3)
    (array([0.5, 0.5]), array([0.443, 0.   ]))
    """
    _check(robot, twist, outside or {}, step_s)
    planar = make_planar(robot, ground or Ground())
    rngs = _generators(seed)
    p = vector_of({**robot.effects, **(effects or {})})
    if scatter is not None:
        for name in nuisances_of(robot.drive):
            p[INDEX[name]] += getattr(scatter, name) * rngs["scatter"].standard_normal()
    commands, channels, desired_mps, desired_rad = _commands(robot, twist)
    motion = _moved(
        robot, planar, p, step_s, desired_mps, desired_rad, hills or Hills(), noise, outside or {}, rngs
    )
    shown = sense(planar, p, step_s, motion.truth)
    streams = {
        "wheels": _wheels(robot, p, step_s, motion, shown, noise, outside or {}, rngs),
        "imu": _imu(robot, p, step_s, motion, shown, noise, rngs["imu"]),
        "odometry": _odometry(robot, planar, p, step_s, motion, shown, noise, rngs["camera"]),
        "commands": Stream(np.arange(len(twist)) / COMMANDS_HZ, commands, channels),
        "truth": _truth(robot, p, step_s, motion),
    }
    if robot.drive == "swerve":
        streams["steering"] = _steering(robot, step_s, motion, noise, rngs["steering"])
    if heading:
        streams["lidar"] = _lidar(step_s, motion, shown, noise, rngs["lidar"])
    end_s = (len(twist) - 1) / COMMANDS_HZ
    labels = (Label(0.0, end_s, terrain),) if terrain else ()
    return RunLog(run_id, robot.name, streams, labels, source="simulated, planar")


def _check(robot: Robot, twist: Array, outside: Mapping[str, float], step_s: float) -> None:
    robot.has("body", "motors", "camera", "sensors", *(["steering"] if robot.drive == "swerve" else []))
    if twist.ndim != 2 or twist.shape[1] != 3 or len(twist) < 2 or not np.isfinite(twist).all():
        raise ConfigError(f"twist has shape {twist.shape}, (n, 3) finite numbers with two rows are required")
    if robot.drive != "swerve" and twist[:, 1].any():
        raise ConfigError(f"twist drives robot {robot.name} sideways, which needs steered wheels")
    for name, value in outside.items():
        if name not in OUTSIDE or not math.isfinite(value):
            raise ConfigError(
                f"outside: {name} is {value!r}; finite numbers of {', '.join(OUTSIDE)} are required"
            )
    parts = STEP_S / step_s if step_s > 0 else 0.0
    if parts < 0.5 or abs(parts - round(parts)) > 1e-9:
        raise ConfigError(f"step_s is {step_s:g}, {STEP_S:g} s or a whole part of it is required")


def _generators(seed: int | np.random.SeedSequence) -> dict[str, np.random.Generator]:
    """One generator a purpose: a sensor more or less changes nothing about the others."""
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return {
        purpose: np.random.default_rng(np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, i)))
        for i, purpose in enumerate(_PURPOSES)
    }


def _commands(robot: Robot, twist: Array) -> tuple[Array, tuple[str, ...], Array, Array]:
    """Return values and channels of the stream, and speeds of rims and steering angles (n, wheels) wanted."""
    names = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    radius_m = robot.wheel_radius_m
    assert robot.motors is not None
    wheels = tuple(f"wheel_{wheel}_radps" for wheel in robot.wheels)
    if robot.drive == "swerve":
        assert robot.steering is not None
        admitted, wheel_radps, steer_rad = wheel_commands(
            robot.wheel_positions_m,
            radius_m,
            robot.motors.speed_max_radps,
            robot.steering.rate_max_radps,
            1.0 / COMMANDS_HZ,
            twist,
            np.zeros(3),
        )
        steers = tuple(f"steer_{wheel}_rad" for wheel in robot.wheels)
        values = np.hstack([admitted, wheel_radps, steer_rad])
        return values, (*names, *wheels, *steers), wheel_radps * radius_m, steer_rad
    turn = 0.5 * robot.track_m * twist[:, 2]
    limit = radius_m * robot.motors.speed_max_radps
    wheel_speeds = np.clip(np.column_stack([twist[:, 0] - turn, twist[:, 0] + turn]), -limit, limit)
    return (
        np.hstack([twist, wheel_speeds / radius_m]),
        (*names, *wheels),
        wheel_speeds,
        np.zeros((len(twist), 2)),
    )


def _moved(
    robot: Robot,
    planar: Planar,
    p: Array,
    dt: float,
    desired_mps: Array,
    desired_rad: Array,
    hills: Hills,
    noise: Noise | None,
    outside: Mapping[str, float],
    rngs: Mapping[str, np.random.Generator],
) -> _Motion:
    parts = round(1.0 / (COMMANDS_HZ * dt))
    rate_max = robot.steering.rate_max_radps if robot.steering is not None else 0.0
    wheel_speed, steer = _drive(desired_mps, desired_rad, parts, dt, rate_max)
    n = len(wheel_speed)
    active = np.zeros(n) if noise is None else activity(np.abs(wheel_speed).mean(axis=1), noise)
    disturbance = np.zeros((0, 3))
    if noise is not None:
        white = rngs["ground"].standard_normal((3, n))
        std = np.array([noise.along_ratio, noise.across_ratio, noise.yaw_radps])
        disturbance = coloured(
            white, std, np.array([noise.along_s, noise.across_s, noise.yaw_s]), dt
        ).T.copy()
        disturbance[:, 2] *= active
    rolled = wheel_speed
    if eccentric := outside.get("wheel_eccentricity_ratio", 0.0):
        phase = rngs["outside"].uniform(0.0, 2.0 * math.pi, wheel_speed.shape[1])
        angle = np.cumsum(wheel_speed, axis=0) * dt / robot.wheel_radius_m
        rolled = wheel_speed * (1.0 + eccentric * np.sin(angle + phase))
    level = np.zeros(n)
    waves = _waves(hills, rngs["hills"])
    flat = move(planar, p, dt, rolled, steer, level, level, disturbance)
    pose = _pose(flat, dt)
    grade, roll = _tilt(pose, np.array(hills.grade_ratio), waves)
    if grade.any() or roll.any():
        truth = move(planar, p, dt, rolled, steer, grade, roll, disturbance)
        pose = _pose(truth, dt)
    else:
        truth = flat
    sides = np.full(wheel_speed.shape[1], 1.0 - 0.5 * p[INDEX["one_sided_radius_ratio"]])
    sides[-1] = 1.0 + 0.5 * p[INDEX["one_sided_radius_ratio"]]
    rolled = rolled * (1.0 + p[INDEX["wheel_radius_ratio"]]) * sides
    return _Motion(truth, pose, grade, roll, wheel_speed, rolled, steer, active)


def _waves(hills: Hills, rng: np.random.Generator) -> Array:
    """Return (3, 4) of the undulations: amplitude along their two axes' direction, wave numbers, phase."""
    waves = np.zeros((0, 4))
    if hills.undulation_ratio:
        direction = rng.uniform(0.0, math.pi, 3)
        phase = rng.uniform(0.0, 2.0 * math.pi, 3)
        size = np.full(3, hills.undulation_ratio * math.sqrt(4.0 / 3.0))
        number = 2.0 * math.pi / (hills.undulation_length_m * np.array([0.7, 1.0, 1.4]))
        waves = np.column_stack([size, number, direction, phase])
    return waves


@njit(cache=True)
def _drive(
    desired_mps: Array, desired_rad: Array, parts: int, dt: float, rate_max: float
) -> tuple[Array, Array]:
    """Return wheel speeds and steering (m, wheels) that follow desired (n, wheels), ``parts`` steps a row."""
    n, wheels = desired_mps.shape
    m = (n - 1) * parts + 1
    wheel_speed, steer = np.empty((m, wheels)), np.empty((m, wheels))
    quick, turn = 1.0 - math.exp(-dt / DRIVE_S), 1.0 - math.exp(-dt / STEER_S)
    fastest, furthest = DRIVE_MPS2 * dt, rate_max * dt
    for i in range(wheels):
        first, second, angle = 0.0, 0.0, desired_rad[0, i]
        for k in range(m):
            row = k // parts
            part = (k - row * parts) / parts
            after = min(row + 1, n - 1)
            goal = desired_mps[row, i] + part * (desired_mps[after, i] - desired_mps[row, i])
            first += min(max(quick * (goal - first), -fastest), fastest)
            second += quick * (first - second)
            wheel_speed[k, i] = second
            aim = desired_rad[row, i] + part * (desired_rad[after, i] - desired_rad[row, i])
            angle += min(max(turn * (aim - angle), -furthest), furthest)
            steer[k, i] = angle
    return wheel_speed, steer


@njit(cache=True)
def _pose(truth: Array, dt: float) -> Array:
    """Return east, north and heading (n, 3) of the body's origin, from 0."""
    n = truth.shape[0]
    pose = np.zeros((n, 3))
    for k in range(1, n):
        yaw = pose[k - 1, 2] + 0.5 * dt * (truth[k - 1, W] + truth[k, W])
        middle = 0.5 * (yaw + pose[k - 1, 2])
        x, y = 0.5 * (truth[k - 1, VX] + truth[k, VX]), 0.5 * (truth[k - 1, VY] + truth[k, VY])
        cos, sin = math.cos(middle), math.sin(middle)
        pose[k, 0] = pose[k - 1, 0] + dt * (x * cos - y * sin)
        pose[k, 1] = pose[k - 1, 1] + dt * (x * sin + y * cos)
        pose[k, 2] = yaw
    return pose


@njit(cache=True)
def _tilt(pose: Array, grade_ratio: Array, waves: Array) -> tuple[Array, Array]:
    """Return grade (nose up positive) and roll (left side up positive) (n,) of a body along its path."""
    n = pose.shape[0]
    grade, roll = np.zeros(n), np.zeros(n)
    for k in range(n):
        east, north = grade_ratio[0], grade_ratio[1]
        for i in range(waves.shape[0]):
            cos, sin = math.cos(waves[i, 2]), math.sin(waves[i, 2])
            value = waves[i, 0] * math.cos(waves[i, 1] * (pose[k, 0] * cos + pose[k, 1] * sin) + waves[i, 3])
            east += value * cos
            north += value * sin
        cos, sin = math.cos(pose[k, 2]), math.sin(pose[k, 2])
        ahead, left = east * cos + north * sin, -east * sin + north * cos
        grade[k] = math.atan(ahead / math.hypot(1.0, left))
        roll[k] = math.atan(left)
    return grade, roll


def _samples(motion: _Motion, rate_hz: float, dt: float) -> tuple[Array, Array]:
    """Return steps and stamps (k,) of a logger."""
    rows = np.arange(0, len(motion.truth), round(1.0 / (rate_hz * dt)))
    return rows, np.arange(len(rows)) / rate_hz


def _wheels(
    robot: Robot,
    p: Array,
    dt: float,
    motion: _Motion,
    shown: Array,
    noise: Noise | None,
    outside: Mapping[str, float],
    rngs: Mapping[str, np.random.Generator],
) -> Stream:
    motors, sensors = robot.motors, robot.sensors
    assert motors is not None
    assert sensors is not None
    rng, wheels = rngs["wheels"], len(robot.wheels)
    every = round(1.0 / (WHEELS_HZ * dt))
    rows, time_s = _samples(motion, WHEELS_HZ, dt)
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


def _spikes(motion: _Motion, rows: Array, dt: float, size_a: float, rng: np.random.Generator) -> Array:
    """Return spikes (n,) of the sum of the currents while the wheels crawl."""
    speed = motion.wheel_speed_mps.mean(axis=1)
    crawls = (np.abs(speed) < CRAWL_MPS) & (np.abs(speed) > 0.02)
    starts = rng.random(len(speed)) < SPIKE_HZ * dt
    length = max(1, round(SPIKE_S / dt))
    lasting = np.convolve(starts & crawls, np.ones(length))[: len(speed)] > 0
    return np.asarray((size_a * np.sign(speed) * lasting)[rows])


def _steering(
    robot: Robot, dt: float, motion: _Motion, noise: Noise | None, rng: np.random.Generator
) -> Stream:
    steering, sensors = robot.steering, robot.sensors
    assert steering is not None
    assert sensors is not None
    rows, time_s = _samples(motion, WHEELS_HZ, dt)
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


def _imu(
    robot: Robot,
    p: Array,
    dt: float,
    motion: _Motion,
    shown: Array,
    noise: Noise | None,
    rng: np.random.Generator,
) -> Stream:
    sensors = robot.sensors
    assert sensors is not None
    rows, time_s = _samples(motion, IMU_HZ, dt)
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


def _odometry(
    robot: Robot,
    planar: Planar,
    p: Array,
    dt: float,
    motion: _Motion,
    shown: Array,
    noise: Noise | None,
    rng: np.random.Generator,
) -> Stream:
    camera = robot.camera
    assert camera is not None
    rows, time_s = _samples(motion, CAMERA_HZ, dt)
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


def _lidar(dt: float, motion: _Motion, shown: Array, noise: Noise | None, rng: np.random.Generator) -> Stream:
    """Rate of a heading that no gyro has told, from central differences of it."""
    rows, time_s = _samples(motion, CAMERA_HZ, dt)
    rate = shown[rows, CHANNELS.index(HEADING)]
    if noise is not None:
        rate = rate + np.gradient(noise.heading_rad * rng.standard_normal(len(rows)), 1.0 / CAMERA_HZ)
    return Stream(time_s, rate[:, None], ("yaw_rate_radps",))


def _truth(robot: Robot, p: Array, dt: float, motion: _Motion) -> Stream:
    assert robot.sensors is not None
    rows, time_s = _samples(motion, IMU_HZ, dt)
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
