"""One run of the planar plant: wheels that follow a drive, their motion over hills, and what the loggers wrote.

Twists become the wheel speeds and steering angles that a controller would command with the described geometry; the
motors follow them with a lag and bounded rates; :func:`~terrain.simulation.planar.motion.move` gives the motion,
:func:`~terrain.simulation.planar.replay.sense` the measurements of sensors without noise; loggers add noise, bias and
quantisation.  A hidden effect is a number in the same vector that a replay has.  The hills are those along the path
that the wheels would roll without slip.

The measurement models are those of :mod:`terrain.simulation.sensors`.  The loggers differ from those of the dynamic
plant in three respects, so that a replay of the log can undo them exactly: latency and clock errors are interpolated
delays on a fixed grid, the wheel encoders report the distance over a period, and the noise of a moving robot is
coloured and grows with speed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

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
from terrain.records import Array, Label, Stream
from terrain.robots import BicycleRobot, Part, Robot, SwerveRobot
from terrain.simulation.conditions import Conditions
from terrain.simulation.planar.model import Ground, delayed
from terrain.simulation.planar.motion import Planar, make_planar, move
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
from terrain.simulation.scenario import RATE_HZ, Scenario
from terrain.simulation.sensors import (
    BODY,
    GYRO_BIAS,
    N_ERRORS,
    RAW_HZ,
    ImuErrors,
    add_rate_noise,
    camera_samples,
    described_calibration,
    encoder_angle,
    generators,
    imu_values,
    raw_fixes,
    truth_stream,
    wheel_channels,
)
from terrain.slip import slip_angle, slip_ratio

# Each of the two lags in a row by which a wheel follows its command, and that of the steering; assumed.
DRIVE_S, STEER_S = 0.06, 0.08
DRIVE_MPS2 = 4.0  # the most that a wheel speeds up; assumed, 2 g of grip would be needed for more
STEP_S = 0.01  # from step to step: no sensor is sampled faster
# Causes that no effect of the library describes: wheel speed x (1 + e sin(wheel angle)), each wheel with its own
# phase, and spikes of the current at crawling speed.
OUTSIDE: tuple[str, ...] = ("wheel_eccentricity_ratio", "stick_slip_a")
# Speed below which stick-slip shows as spikes of the current, their mean rate, and the length of each.
CRAWL_MPS, SPIKE_HZ, SPIKE_S = 0.25, 5.0, 0.06
STANDSTILL_MPS = 1e-6  # speed below which an encoder counts nothing: its low-pass ends there
# Channel of the truth of an omni robot, whose body slips otherwise than any of its wheels.
BODY_SLIP = "slip_body_ratio"

_PURPOSES = ("scatter", "hills", "ground", "wheels", "steering", "imu", "camera", "outside", "lidar")


class _Drive:
    """A drive before its loggers.

    ``p`` are the effects by name, ``truth`` and ``pose`` the motion at each step of ``dt``, ``wheel_speed_mps`` and
    ``steer_rad`` as encoders without error show them, ``true_speed_mps`` circumferential speeds with the true radii,
    ``active`` the factor on the noise of a moving robot, and ``ideal`` the channels of sensors without noise.
    """

    def __init__(
        self,
        planar: Planar,
        vector: Array,
        dt: float,
        noise: Noise | None,
        rngs: Mapping[str, np.random.Generator],
    ) -> None:
        self.robot, self.planar, self.vector, self.p = planar.robot, planar, vector, vector.view(EFFECTS)[0]
        self.dt, self.noise, self.rngs = dt, noise, rngs

    def follow(self, desired: WheelMotion, conditions: Conditions, eccentric: float) -> None:
        """Let the robot follow commands over hills."""
        robot, p, dt, noise, rngs = self.robot, self.p, self.dt, self.noise, self.rngs
        parts, fastest = round(1.0 / (RATE_HZ * dt)), robot.steering_rate_max_radps
        speed, steer = follow_commands(desired.wheel_speed_mps, desired.steer_rad, parts, dt, fastest)
        n, wheels = speed.shape
        active, disturbance = np.zeros(n), np.zeros((0, 3))
        if noise is not None:
            active = activity(np.abs(speed).mean(axis=1), noise)
            std = np.array([noise.along_ratio, noise.across_ratio, noise.yaw_radps])
            tau_s = np.array([noise.along_s, noise.across_s, noise.yaw_s])
            disturbance = coloured(rngs["ground"].standard_normal((3, n)), std, tau_s, dt).T.copy()
            disturbance[:, 2] *= active
        turned = speed
        if eccentric:
            phase = rngs["outside"].uniform(0.0, 2.0 * math.pi, wheels)
            angle = np.cumsum(speed, axis=0) * dt / robot.wheel_radius_m
            turned = speed * (1.0 + eccentric * np.sin(angle + phase))
        grade = roll = np.zeros(n)
        truth = move(self.planar, self.vector, dt, turned, steer, grade, roll, disturbance)
        pose, slope = _path(truth, dt), np.array(conditions.grade_ratio)
        grade, roll = _tilt_along(pose, slope, _undulations(conditions, rngs["hills"]))
        if grade.any() or roll.any():
            truth = move(self.planar, self.vector, dt, turned, steer, grade, roll, disturbance)
            pose = _path(truth, dt)
        sides = np.full(wheels, 1.0 - 0.5 * p["one_sided_radius_ratio"])
        sides[-1] = 1.0 + 0.5 * p["one_sided_radius_ratio"]
        self.true_speed_mps = turned * (1.0 + p["wheel_radius_ratio"]) * sides * _encoder_scales(robot, p)
        self.truth, self.pose, self.grade_rad, self.roll_rad = truth, pose, grade, roll
        self.wheel_speed_mps, self.steer_rad, self.active = speed, steer, active
        self.ideal = sense(self.planar, self.vector, dt, truth)

    def samples(self, rate_hz: float) -> tuple[Array, Array]:
        """Return steps and stamps (k,) of a logger."""
        rows = np.arange(0, len(self.ideal), round(1.0 / (rate_hz * self.dt)))
        return rows, np.arange(len(rows)) / rate_hz

    def channel(self, name: str) -> Array:
        """Return one channel (n,) of sensors without noise."""
        return self.ideal[:, CHANNELS.index(name)]

    def delayed(self, values: Array, latency_s: float) -> Array:
        """Return a signal (n,) as the logger of IMU and camera stamps it, behind a latency."""
        late = (self.p["clock_offset_s"] + latency_s) / self.dt
        rate = self.p["clock_rate_ratio"]
        return np.asarray(delayed(values, late, rate)) if late != 0.0 or rate != 0.0 else values


def run_planar(
    robot: Robot,
    drive: Scenario | Array,
    ground: Ground,
    seed: int | np.random.SeedSequence,
    *,
    conditions: Conditions,
    effects: Mapping[str, float],
    scatter: Scatter | None = None,
    noise: Noise | None = None,
    outside: Mapping[str, float] | None = None,
    heading: bool = False,
    fixes: bool = False,
    terrain: str = "",
    step_s: float = STEP_S,
) -> tuple[dict[str, Stream], tuple[Label, ...]]:
    """Return streams and labels of a drive, for :func:`terrain.simulation.run.simulate`, which describes the rest.

    Parameters
    ----------
    drive : a scenario on one terrain, or twists (n, 3) at 50 Hz, from rest
    conditions : load, and the lie of the land along the start's heading and to its left; of undulations, the
        standard deviation of what three waves that cross in drawn directions add to either
    effects : parameters of :mod:`terrain.effects`, beside or in place of the description's own
    scatter : of this run's own parameters; by default they do not
    noise : none by default; then encoders do not quantise
    outside : amplitudes of :data:`OUTSIDE`
    heading : add the stream lidar, with the rate of a heading that does not depend on the gyro
    fixes : add the streams gnss and compass
    terrain : label of a drive that is no scenario; without one it has none
    step_s : from step to step
    """
    outside = outside or {}
    twist = drive.twist if isinstance(drive, Scenario) else np.asarray(drive)
    terrain = drive.patches[0].terrain if isinstance(drive, Scenario) else terrain
    _check(robot, twist, outside, step_s)
    logs_currents = robot.describes("motors") and "motors" in robot.sections
    robot = with_silent_parts(robot)
    rngs = generators(seed, _PURPOSES)
    vector = vector_of({**robot.effects, **effects})
    vector[INDEX["payload_ratio"]] += conditions.payload_kg / robot.mass_kg
    if scatter is not None:
        for name in nuisances_of(robot.drive):
            vector[INDEX[name]] += getattr(scatter, name) * rngs["scatter"].standard_normal()
    desired = wheel_motion(robot, twist, 1.0 / RATE_HZ)
    run = _Drive(make_planar(robot, ground), vector, step_s, noise, rngs)
    run.follow(desired, conditions, outside.get("wheel_eccentricity_ratio", 0.0))
    rows = [*("speed_x_mps", "speed_y_mps", "yaw_rate_radps"), *wheel_channels("wheel_radps", robot.wheels)]
    commands = [desired.twist, desired.wheel_radps, desired.steer_rad[:, : len(robot.steer_rows)]]
    streams = {"wheels": _wheels(run, outside.get("stick_slip_a", 0.0), logs_currents)}
    if robot.on_omni_wheels:
        streams["pose"] = _pose(run)
    else:
        streams |= {"imu": _imu(run), "odometry": _camera(run)}
    streams["commands"] = Stream(
        np.arange(len(twist)) / RATE_HZ, np.hstack(commands), (*rows, *robot.steer_rows)
    )
    time_s, body = _body(run)
    streams["truth"] = _truth(run, time_s, body)
    if robot.steered:
        streams["steering"] = _steering(run)
    if heading:
        streams["lidar"] = _lidar(run)
    if fixes:
        at_s, every = np.arange(0.0, time_s[-1] + 1e-9, 1.0 / RAW_HZ), round(IMU_HZ / RAW_HZ)
        streams |= raw_fixes(at_s, body[::every], generators(seed, ("fixes",))["fixes"])
    return streams, (Label(0.0, (len(twist) - 1) / RATE_HZ, terrain),) if terrain else ()


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


def _undulations(conditions: Conditions, rng: np.random.Generator) -> Array:
    """Return (3, 4) of the undulations: amplitude along their two axes' direction, wave numbers, phase."""
    if not conditions.undulation_ratio:
        return np.zeros((0, 4))
    direction = rng.uniform(0.0, math.pi, 3)
    phase = rng.uniform(0.0, 2.0 * math.pi, 3)
    size = np.full(3, conditions.undulation_ratio * math.sqrt(4.0 / 3.0))
    number = 2.0 * math.pi / (conditions.undulation_length_m * np.array([0.7, 1.0, 1.4]))
    return np.column_stack([size, number, direction, phase])


@njit
def _path(truth: Array, dt: float) -> Array:
    """Return east, north and heading (n, 3) of the body's origin, from 0."""
    n = truth.shape[0]
    pose = np.zeros((n, 3))
    for k in range(1, n):
        before, now = truth[k - 1], truth[k]
        yaw = pose[k - 1, 2] + 0.5 * dt * (before.yaw_rate_radps + now.yaw_rate_radps)
        middle = 0.5 * (yaw + pose[k - 1, 2])
        x, y = 0.5 * (before.speed_x_mps + now.speed_x_mps), 0.5 * (before.speed_y_mps + now.speed_y_mps)
        cos, sin = math.cos(middle), math.sin(middle)
        pose[k, 0] = pose[k - 1, 0] + dt * (x * cos - y * sin)
        pose[k, 1] = pose[k - 1, 1] + dt * (x * sin + y * cos)
        pose[k, 2] = yaw
    return pose


@njit
def _tilt_along(pose: Array, grade_ratio: Array, waves: Array) -> tuple[Array, Array]:
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


def _wheels(run: _Drive, stick_slip_a: float, logs_currents: bool) -> Stream:
    """Return the stream of wheel speeds and, where they are logged, motor currents."""
    robot, noise, p, wheels = run.robot, run.noise, run.p, len(run.robot.wheels)
    sensors, motors, rng = robot.sensors, robot.motors, run.rngs["wheels"]
    rows, time_s = run.samples(WHEELS_HZ)
    n, every = len(rows), round(1.0 / (WHEELS_HZ * run.dt))
    total, turning = run.channel(CURRENT)[rows], run.channel(TURNING_CURRENT)[rows]
    if stick_slip_a:
        total = total + _spikes(run, stick_slip_a)[rows]
    if robot.on_omni_wheels:
        currents = _omni_currents(run)[rows]
    elif robot.skids:
        currents = np.column_stack([total - turning, total + turning]) / 2.0
    else:
        currents = np.repeat(total[:, None] / wheels, wheels, axis=1)
    lag_s = sensors.encoder_time_constant_s + p["encoder_lag_s"]
    step_m, jitter, white = 0.0, np.zeros((n + 1, wheels)), np.zeros((n, wheels))
    if noise is not None:
        active = run.active[rows]
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
        currents = currents + drawn + sensors.current_std_a * rng.standard_normal((n, wheels))
    speed = encoder_speed(run.wheel_speed_mps, every, run.dt, step_m, jitter, lag_s)
    speed[np.abs(speed) <= STANDSTILL_MPS] = 0.0
    speed = robot.logged_rates(add_rate_noise(speed, white, STANDSTILL_MPS))
    if not logs_currents:
        return Stream(time_s, speed, robot.rate_channels)
    if robot.on_omni_wheels:
        currents = np.abs(currents)  # as its logs have them
    channels = (*robot.rate_channels, *wheel_channels("current_a", robot.wheels))
    return Stream(time_s, np.hstack([speed, currents]), channels)


def _omni_currents(run: _Drive) -> Array:
    """Return the current (n, wheels) of each motor: of the motion before the ground disturbs it."""
    wheels = np.ascontiguousarray(run.true_speed_mps / (1.0 + run.p["wheel_radius_ratio"]))
    truth = move(run.planar, run.vector, run.dt, wheels, run.steer_rad, run.grade_rad, run.roll_rad)
    return np.asarray(currents_of(run.planar.params, run.vector, run.dt, wheels, truth))


def _spikes(run: _Drive, size_a: float) -> Array:
    """Return spikes (n,) of the sum of the currents while the wheels crawl."""
    speed = run.wheel_speed_mps.mean(axis=1)
    crawls = (np.abs(speed) < CRAWL_MPS) & (np.abs(speed) > 0.02)
    starts = run.rngs["outside"].random(len(speed)) < SPIKE_HZ * run.dt
    length = max(1, round(SPIKE_S / run.dt))
    lasting = np.convolve(starts & crawls, np.ones(length))[: len(speed)] > 0
    return np.asarray(size_a * np.sign(speed) * lasting)


def _encoder_scales(robot: Robot, p: Any) -> Array:
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


def _steering(run: _Drive) -> Stream:
    """Return the stream of steering angles."""
    sensors, channels = run.robot.sensors, run.robot.steer_channels
    rows, time_s = run.samples(WHEELS_HZ)
    steer, noise, step_rad = run.steer_rad[rows, : len(channels)], np.zeros(1), 0.0
    if run.noise is not None:
        noise = sensors.steering_std_rad * run.rngs["steering"].standard_normal(steer.shape)
        if sensors.steering_steps_ratio > 0.0:
            step_rad = 2.0 * math.pi / sensors.steering_steps_ratio
    angle = encoder_angle(steer, run.robot.steering_zeros_rad[: len(channels)], noise, step_rad)
    return Stream(time_s, angle, channels)


def _imu(run: _Drive) -> Stream:
    """Return the stream of the IMU: gyro and accelerometer along x have clock and latency already."""
    rows, time_s = run.samples(IMU_HZ)
    latency_s = run.robot.sensors.imu_latency_s + run.p["imu_latency_s"]
    v_x, v_y, turn = (run.truth[name] for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps"))
    level = np.cos(run.grade_rad)

    def measured(values: Array) -> Array:
        return run.delayed(values, latency_s)[rows]

    tilt = np.column_stack([measured(angle) for angle in (run.roll_rad, -run.grade_rad)])
    rate, force = np.empty((len(rows), 3)), np.empty((len(rows), 3))
    rate[:, :2] = np.gradient(tilt, 1.0 / IMU_HZ, axis=0)
    rate[:, 2], force[:, 0] = run.channel("yaw_rate_radps")[rows], run.channel("accel_x_mps2")[rows]
    force[:, 1] = measured(
        np.gradient(v_y, run.dt) + turn * v_x + GRAVITY_MPS2 * np.sin(run.roll_rad) * level
    )
    force[:, 2] = measured(GRAVITY_MPS2 * np.cos(run.roll_rad) * level)
    yaw = (np.cumsum(rate[:, 2]) - rate[0, 2]) / IMU_HZ
    values = imu_values(_imu_errors(run, measured(run.active)), slice(None), force, rate, tilt, yaw)
    return Stream(time_s, values, IMU_CHANNELS)


def _imu_errors(run: _Drive, active: Array) -> ImuErrors:
    """Return the errors of the IMU: those described, and vibration while the robot moves; ``active`` (n,)."""
    sensors, noise, n, rng = run.robot.sensors, run.noise, len(active), run.rngs["imu"]
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


def _pose(run: _Drive) -> Stream:
    """Return the poses that a camera above measures of an omni robot: the world's axes, its own noise."""
    camera, p = run.robot.camera, run.p
    rows, time_s = run.samples(CAMERA_HZ)
    latency_s = run.planar.body["latency_s"][0] + p["camera_latency_s"]
    x_m, y_m, yaw_rad = (run.delayed(column, latency_s)[rows] for column in run.pose.T)
    lever_m = complex(camera.lever_x_m + p["lever_x_m"], camera.lever_y_m + p["lever_y_m"])
    marker = x_m + 1j * y_m + np.exp(1j * yaw_rad) * lever_m
    marker = marker * (1.0 + p["camera_scale_ratio"])
    seen = np.column_stack([marker.real, marker.imag, yaw_rad - p["camera_yaw_rad"]])
    if run.noise is not None:
        std = np.array([camera.position_std_m, camera.position_std_m, camera.yaw_std_rad])
        seen = seen + std * run.rngs["camera"].standard_normal(seen.shape)
    return Stream(time_s, seen, POSE_CHANNELS)


def _camera(run: _Drive) -> Stream:
    """Return the stream of the camera: poses of a swerve robot, else speeds in body axes."""
    camera, noise, rng = run.robot.camera, run.noise, run.rngs["camera"]
    rows, time_s = run.samples(CAMERA_HZ)
    n, first = len(rows), CHANNELS.index(SPEED_X)
    latency_s = run.planar.body["latency_s"][0] + run.p["camera_latency_s"]
    seen = run.ideal[rows, first : first + 2].copy()
    if noise is not None:
        active = run.delayed(run.active, latency_s)[rows]
        std, tau = np.full(2, noise.camera_mps), np.full(2, noise.camera_s)
        seen += coloured(rng.standard_normal((2, n)), std, tau, 1.0 / CAMERA_HZ).T * active[:, None]
        seen += camera.speed_std_mps * rng.standard_normal((n, 2))
    if not isinstance(run.robot, SwerveRobot):
        return Stream(time_s, seen, ("speed_x_mps", "speed_y_mps"))
    turn = run.channel(HEADING)
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
    roll, pitch = (run.delayed(a, latency_s)[rows] for a in (run.roll_rad, -run.grade_rad))
    motion = np.column_stack([origin, rate, roll, pitch, yaw])
    lever_m = np.array([camera.lever_x_m, camera.lever_y_m, camera.lever_z_m])
    values = np.empty((n, len(CAMERA_CHANNELS)))
    camera_samples(position, motion, np.zeros((n, N_ERRORS)), lever_m, 0.0, values)
    return Stream(time_s, values, CAMERA_CHANNELS)


def _lidar(run: _Drive) -> Stream:
    """Return the rate of a heading that does not depend on the gyro, from central differences."""
    rows, time_s = run.samples(CAMERA_HZ)
    rate = run.channel(HEADING)[rows]
    if run.noise is not None:
        heading = run.noise.heading_rad * run.rngs["lidar"].standard_normal(len(rows))
        rate = rate + np.gradient(heading, 1.0 / CAMERA_HZ)
    return Stream(time_s, rate[:, None], ("yaw_rate_radps",))


def _body(run: _Drive) -> tuple[Array, Array]:
    """Return stamps and the body (n,) at them, of :data:`~terrain.simulation.sensors.BODY`."""
    rows, time_s = run.samples(IMU_HZ)
    at, grade, body = run.truth[rows], run.grade_rad[rows], np.zeros(len(rows), BODY)
    for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps"):
        body[name] = at[name]
    body["position_x_m"], body["position_y_m"], body["yaw_rad"] = run.pose[rows].T
    body["roll_rad"], body["pitch_rad"] = run.roll_rad[rows], -grade
    body["accel_x_mps2"] = at["accel_x_mps2"] - GRAVITY_MPS2 * np.sin(grade)
    turning = at["yaw_rate_radps"] * at["speed_x_mps"]
    body["accel_y_mps2"] = np.gradient(at["speed_y_mps"], 1.0 / IMU_HZ) + turning
    return time_s, body


def _truth(run: _Drive, time_s: Array, body: Array) -> Stream:
    """Return the stream of true quantities."""
    robot, (rows, _) = run.robot, run.samples(IMU_HZ)
    steer = run.steer_rad[rows]
    places_m = robot.wheel_positions_m * (1.0 + run.p["wheel_distance_ratio"])
    twist = np.column_stack([body[name] for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")])
    along, across = wheel_frame_velocities(twist, places_m, steer + robot.wheel_directions_rad)
    quantities = {
        "wheel_radps": run.wheel_speed_mps[rows] * _encoder_scales(robot, run.p) / robot.wheel_radius_m,
        "steer_rad": steer,
        "slip_ratio": slip_ratio(run.true_speed_mps[rows], along),
    }
    columns: dict[str, Any] = {}
    for quantity, values in quantities.items():
        columns |= zip(wheel_channels(quantity, robot.wheels), values.T, strict=True)
    columns[GYRO_BIAS] = np.full(len(rows), run.p["gyro_bias_radps"] + robot.sensors.gyro_bias_z_radps)
    if isinstance(robot, BicycleRobot):
        slips = slip_angle(along, across)
        columns |= zip(wheel_channels("slip_rad", robot.wheels), slips.T, strict=True)
    if robot.on_omni_wheels:
        columns[BODY_SLIP] = run.truth["slip_ratio"][rows]
    return truth_stream(time_s, body, columns)
