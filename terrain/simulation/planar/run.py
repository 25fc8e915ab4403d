"""One run of the planar simulation: desired twists in, an ordinary run log with its truth out.

Twists become the wheel speeds and steering angles that a controller would command with the described
geometry; the motors follow them with a lag and bounded rates; :func:`~terrain.simulation.planar.motion.move`
gives the motion on hilly terrain, :func:`~terrain.simulation.planar.replay.sense` the measurements of sensors
without noise; loggers add noise, bias and quantisation.  A hidden effect is a number in the same vector that
a replay has.

The hills are those along the path that the wheels would roll without slip.

The measurement models are those of :mod:`terrain.simulation.sensors`.  The loggers of the planar simulation
differ from those of the dynamic plant in three respects, so that a replay of the log can undo them exactly:
latency and clock errors are interpolated delays on a fixed grid, the wheel encoders report the distance over
a period, and the noise of a moving robot is coloured and grows with speed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.effects import (
    CHANNELS,
    CURRENT,
    EFFECTS,
    HEADING,
    INDEX,
    SPEED_X,
    TURNING_CURRENT,
    nuisances_of,
    vector_of,
)
from terrain.errors import ConfigError
from terrain.kernels import njit
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.commands import WheelMotion, wheel_motion
from terrain.kinematics.wheels import point_velocity, wheel_frame_velocities
from terrain.logs.schema import IMU_CHANNELS, POSE_CHANNELS
from terrain.records import Array, Label, RunLog, Stream
from terrain.robots import BicycleRobot, Part, Robot, SwerveRobot
from terrain.simulation.planar.model import AX, SLIP, VX, VY, Ground, Planar, W, delayed, make_planar
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
from terrain.simulation.planar.omni import currents_of
from terrain.simulation.planar.replay import sense
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

COMMANDS_HZ = 50.0
"""Rate of the twists, as scenarios have them."""

DRIVE_S = 0.06
"""Each of the two lags in a row by which a wheel follows its command; assumed."""

DRIVE_MPS2 = 4.0
"""The most that a wheel speeds up; assumed, 2 g of grip would be needed for more."""

STEER_S = 0.08
"""Lag by which steering follows its command; assumed."""

STEP_S = 0.01
"""From step to step: no sensor is sampled faster."""

OUTSIDE: tuple[str, ...] = ("wheel_eccentricity_ratio", "stick_slip_a")
"""Causes that no effect of the library describes: wheel speed x (1 + e sin(wheel angle)), each wheel with its
own phase, and spikes of the current at crawling speed."""

_PURPOSES = ("scatter", "hills", "ground", "wheels", "steering", "imu", "camera", "outside", "lidar")

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
    robot : a swerve robot with all its sections; of other robots those that are missing do not act
        (:func:`~terrain.simulation.planar.model.make_planar`); without motors there are no currents
    twist : (n, 3) desired ``(speed_x_mps, speed_y_mps, yaw_rate_radps)`` at 50 Hz, from rest
    seed : of everything that is drawn; the same gives the same bytes, and a sequence is left as it is
    ground : a firm one by default
    effects : parameters of :mod:`terrain.effects`, beside or in place of the description's own
    scatter : of this run's own parameters; by default they do not
    hills, noise : level and without noise by default; then encoders do not quantise
    outside : amplitudes of :data:`OUTSIDE`
    heading : add the stream lidar, with the rate of a heading that does not depend on the gyro
    run_id, terrain, step_s : of the run, from step to step; without a terrain it has no label

    Returns
    -------
    RunLog
        streams wheels, imu, odometry, commands, truth, and steering of a robot that has it.  The odometry of
        a swerve robot is a tracking camera's pose, that of others the speed of the camera's point in body
        axes.
        An omni robot has wheels, commands, truth (with the slip of its body, ``slip_body_ratio``), and pose
        of a camera above, as its measured runs.

    Raises
    ------
    ConfigError
        if a swerve robot lacks a section, or a parameter or an outside cause is unknown or not finite.

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
    outside = outside or {}
    _check(robot, twist, outside, step_s)
    currents = robot.describes("motors") and "motors" in robot.sections
    robot = with_silent_parts(robot)
    planar = make_planar(robot, ground or Ground())
    rngs = _generators(seed)
    vector = vector_of({**robot.effects, **(effects or {})})
    if scatter is not None:
        for name in nuisances_of(robot.drive):
            vector[INDEX[name]] += getattr(scatter, name) * rngs["scatter"].standard_normal()
    desired = wheel_motion(robot, twist, 1.0 / COMMANDS_HZ)
    setup = PlanarSetup(robot, planar, vector, step_s, noise)
    motion = _motion(setup, desired, hills or Hills(), outside, rngs)
    run = PlanarRun(*setup, motion, sense(planar, vector, step_s, motion.truth))
    streams = _streams(run, commands_stream(robot, desired), rngs, outside, currents)
    if heading:
        streams["lidar"] = lidar_stream(run, rngs["lidar"])
    labels = (Label(0.0, (len(twist) - 1) / COMMANDS_HZ, terrain),) if terrain else ()
    return RunLog(run_id, robot.name, streams, labels, source="simulated, planar")


def _streams(
    run: PlanarRun, commands: Stream, rngs: Generators, outside: Mapping[str, float], currents: bool
) -> dict[str, Stream]:
    """Return what the loggers of a robot's drive wrote, and the truth."""
    streams = {"wheels": wheels_stream(run, outside.get("stick_slip_a", 0.0), rngs, currents)}
    if run.planar.omni:
        streams["pose"] = pose_stream(run, rngs["camera"])
    else:
        streams["imu"] = imu_stream(run, rngs["imu"])
        streams["odometry"] = camera_stream(run, rngs["camera"])
    streams |= {"commands": commands, "truth": planar_truth(run)}
    if run.robot.steered:
        streams["steering"] = steering_stream(run, rngs["steering"])
    return streams


def _check(robot: Robot, twist: Array, outside: Mapping[str, float], step_s: float) -> None:
    if isinstance(robot, SwerveRobot):
        robot.require(*robot.sections)
    if twist.ndim != 2 or twist.shape[1] != 3 or len(twist) < 2 or not np.isfinite(twist).all():
        raise ConfigError(f"twist has shape {twist.shape}, (n, 3) finite numbers with two rows are required")
    if not robot.sideways and twist[:, 1].any():
        raise ConfigError(
            f"twist drives robot {robot.name} sideways, which needs steered wheels or omni wheels"
        )
    if robot.on_omni_wheels and outside.get("stick_slip_a"):
        raise ConfigError(f"outside: stick_slip_a is not simulated of robot {robot.name} on omni wheels")
    for name, value in outside.items():
        if name not in OUTSIDE or not math.isfinite(value):
            raise ConfigError(
                f"outside: {name} is {value!r}; finite numbers of {', '.join(OUTSIDE)} are required"
            )
    parts = STEP_S / step_s if step_s > 0 else 0.0
    if parts < 0.5 or abs(parts - round(parts)) > 1e-9:
        raise ConfigError(f"step_s is {step_s:g}, {STEP_S:g} s or a whole part of it is required")


def with_silent_parts(robot: Robot) -> Robot:
    """Return the robot with parts that neither act nor are noisy for the sections that it lacks.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> with_silent_parts(load_robot("warthog")).sensors.gyro_std_radps
    0.0
    """
    silent: dict[str, Part] = {}
    for name, part in robot.completed.parts.items():
        if name not in robot.parts:
            unknown = [item.name for item in fields(part) if math.isnan(getattr(part, item.name))]
            silent[name] = replace(part, **dict.fromkeys(unknown, 0.0))  # type: ignore[arg-type]
    return robot.with_parts(**silent)


def _generators(seed: int | np.random.SeedSequence) -> dict[str, np.random.Generator]:
    """One generator a purpose: a sensor more or less changes nothing about the others."""
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return {
        purpose: np.random.default_rng(np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, i)))
        for i, purpose in enumerate(_PURPOSES)
    }


def _motion(
    setup: PlanarSetup, desired: WheelMotion, hills: Hills, outside: Mapping[str, float], rngs: Generators
) -> PlanarMotion:
    """Return the motion of a robot that follows its commands over hills."""
    robot, planar, vector, dt, noise = setup
    p = vector.view(EFFECTS)[0]
    parts = round(1.0 / (COMMANDS_HZ * dt))
    rate_max = robot.steering_rate_max_radps
    wheel_speed, steer = follow_commands(desired.wheel_speed_mps, desired.steer_rad, parts, dt, rate_max)
    n = len(wheel_speed)
    active = np.zeros(n) if noise is None else activity(np.abs(wheel_speed).mean(axis=1), noise)
    disturbance = _disturbance(noise, active, dt, rngs["ground"])
    rolled = wheel_speed
    if eccentric := outside.get("wheel_eccentricity_ratio", 0.0):
        phase = rngs["outside"].uniform(0.0, 2.0 * math.pi, wheel_speed.shape[1])
        angle = np.cumsum(wheel_speed, axis=0) * dt / robot.wheel_radius_m
        rolled = wheel_speed * (1.0 + eccentric * np.sin(angle + phase))
    level = np.zeros(n)
    truth = move(planar, vector, dt, rolled, steer, level, level, disturbance)
    pose = path_of(truth, dt)
    grade, roll = tilt_along(pose, np.array(hills.grade_ratio), undulations(hills, rngs["hills"]))
    if grade.any() or roll.any():
        truth = move(planar, vector, dt, rolled, steer, grade, roll, disturbance)
        pose = path_of(truth, dt)
    sides = np.full(wheel_speed.shape[1], 1.0 - 0.5 * p["one_sided_radius_ratio"])
    sides[-1] = 1.0 + 0.5 * p["one_sided_radius_ratio"]
    rolled = rolled * (1.0 + p["wheel_radius_ratio"]) * sides * encoder_scales(robot, p)
    return PlanarMotion(truth, pose, grade, roll, wheel_speed, rolled, steer, active)


def _disturbance(noise: Noise | None, active: Array, dt: float, rng: np.random.Generator) -> Array:
    """Return the disturbance (n, 3) of the terrain as :func:`move` takes it, (0, 3) without noise."""
    if noise is None:
        return np.zeros((0, 3))
    white = rng.standard_normal((3, len(active)))
    std = np.array([noise.along_ratio, noise.across_ratio, noise.yaw_radps])
    tau_s = np.array([noise.along_s, noise.across_s, noise.yaw_s])
    disturbance: Array = coloured(white, std, tau_s, dt).T.copy()
    disturbance[:, 2] *= active
    return disturbance


def commands_stream(robot: Robot, desired: WheelMotion) -> Stream:
    """Return the stream of commands."""
    channels = (
        *("speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
        *wheel_channels("wheel_radps", robot.wheels),
        *robot.steer_rows,
    )
    columns = [desired.twist, desired.wheel_radps, desired.steer_rad[:, : len(robot.steer_rows)]]
    return Stream(np.arange(len(desired.twist)) / COMMANDS_HZ, np.hstack(columns), channels)


@njit
def follow_commands(
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


def undulations(hills: Hills, rng: np.random.Generator) -> Array:
    """Return (3, 4) of the undulations: amplitude along their two axes' direction, wave numbers, phase."""
    waves = np.zeros((0, 4))
    if hills.undulation_ratio:
        direction = rng.uniform(0.0, math.pi, 3)
        phase = rng.uniform(0.0, 2.0 * math.pi, 3)
        size = np.full(3, hills.undulation_ratio * math.sqrt(4.0 / 3.0))
        number = 2.0 * math.pi / (hills.undulation_length_m * np.array([0.7, 1.0, 1.4]))
        waves = np.column_stack([size, number, direction, phase])
    return waves


@njit
def path_of(truth: Array, dt: float) -> Array:
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


@njit
def tilt_along(pose: Array, grade_ratio: Array, waves: Array) -> tuple[Array, Array]:
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


class PlanarSetup(NamedTuple):
    """A run before it is driven: robot, its numbers on the terrain, effects, step in s and noise, if any."""

    robot: Robot
    planar: Planar
    vector: Array
    dt: float
    noise: Noise | None


class PlanarRun(NamedTuple):
    """A run before its loggers: its setup, its motion, and the channels that sensors without noise measure."""

    robot: Robot
    planar: Planar
    vector: Array
    dt: float
    noise: Noise | None
    motion: PlanarMotion
    ideal: Array

    @property
    def p(self) -> Any:
        """Parameters of the effects by name."""
        return self.vector.view(EFFECTS)[0]

    def samples(self, rate_hz: float) -> tuple[Array, Array]:
        """Return steps and stamps (k,) of a logger."""
        rows = np.arange(0, len(self.ideal), round(1.0 / (rate_hz * self.dt)))
        return rows, np.arange(len(rows)) / rate_hz

    def delayed(self, values: Array, latency_s: float) -> Array:
        """Return a signal (n,) as the logger of IMU and camera stamps it, behind a latency."""
        late = (self.p["clock_offset_s"] + latency_s) / self.dt
        rate = self.p["clock_rate_ratio"]
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
    lag_s = sensors.encoder_time_constant_s + run.p["encoder_lag_s"]
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
    wheels = np.ascontiguousarray(motion.rolled_mps / (1.0 + p["wheel_radius_ratio"]))
    still = np.zeros((0, 3))
    truth = move(
        run.planar, run.vector, run.dt, wheels, motion.steer_rad, motion.grade_rad, motion.roll_rad, still
    )
    return np.asarray(currents_of(run.planar, run.vector, run.dt, wheels, truth)[rows])


def pose_stream(run: PlanarRun, rng: np.random.Generator) -> Stream:
    """Return the poses that a camera above measures of an omni robot: the world's axes, its own noise."""
    camera = run.robot.camera
    rows, time_s = run.samples(CAMERA_HZ)
    latency_s = run.planar.latency_s + run.p["camera_latency_s"]
    x_m, y_m, yaw_rad = (run.delayed(column, latency_s)[rows] for column in run.motion.pose.T)
    lever_m = [
        at + run.p[f"lever_{axis}_m"]
        for axis, at in zip("xy", (camera.lever_x_m, camera.lever_y_m), strict=True)
    ]
    marker = x_m + 1j * y_m + np.exp(1j * yaw_rad) * complex(*lever_m)
    marker = marker * (1.0 + run.p["camera_scale_ratio"])
    seen = np.column_stack([marker.real, marker.imag, yaw_rad - run.p["camera_yaw_rad"]])
    if run.noise is not None:
        std = np.array([camera.position_std_m, camera.position_std_m, camera.yaw_std_rad])
        seen = seen + std * rng.standard_normal(seen.shape)
    return Stream(time_s, seen, POSE_CHANNELS)


def encoder_scales(robot: Robot, p: Any) -> Array:
    """Return true over measured wheel rates (wheels,): encoders may lose counts."""
    names = [f"wheel_scale_{wheel}_ratio" for wheel in robot.wheels]
    return np.array([1.0 + p[name] if name in INDEX else 1.0 for name in names])


@njit
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
    latency_s = sensors.imu_latency_s + run.p["imu_latency_s"]
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
        tilt_bias_rad=np.array([run.p["roll_offset_rad"], -run.p["pitch_offset_rad"]]),
        tilt_noise_rad=tilt,
        yaw_bias_rad=(np.cumsum(yaw_rate) - yaw_rate[0]) / IMU_HZ,
        yaw_noise_rad=yaw,
    )


def camera_stream(run: PlanarRun, rng: np.random.Generator) -> Stream:
    """Return the stream of the camera: poses of a swerve robot, else speeds in body axes."""
    camera, noise = run.robot.camera, run.noise
    rows, time_s = run.samples(CAMERA_HZ)
    n = len(rows)
    latency_s = run.planar.latency_s + run.p["camera_latency_s"]
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
    places_m = robot.wheel_positions_m * (1.0 + run.p["wheel_distance_ratio"])
    along, across = wheel_frame_velocities(np.column_stack([v_x, v_y, turn]), places_m, steer)
    columns = [
        motion.pose[rows],
        np.column_stack([motion.roll_rad[rows], -grade, v_x, v_y, turn, accel_x, accel_y]),
        motion.wheel_speed_mps[rows] * encoder_scales(robot, run.p) / robot.wheel_radius_m,
        motion.steer_rad[rows],
        slip_ratio(motion.rolled_mps[rows], along),
        np.full((len(rows), 1), run.p["gyro_bias_radps"] + robot.sensors.gyro_bias_z_radps),
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
