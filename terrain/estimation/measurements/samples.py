"""From one sample of a sensor to the rows that it measures: calibration, gravity, axes and turns removed.

Compiled for single samples, and used alike on a whole log and live.  ``turns`` keeps the last angle and the
turns of each unwrapped angle, ``lines`` and ``limits`` each row's :mod:`memory
<terrain.estimation.measurements.sample_hold>`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numba import njit

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.estimation.measurements.derived import REST_SEEN_MPS, derive_rows, is_moving, take_vibration
from terrain.estimation.measurements.frozen import (
    OF_CAMERA,
    OF_IMU,
    OF_SPEED,
    OF_WHEELS,
    REPEATED_CAMERA,
    REPEATED_IMU,
    REPEATED_SPEED,
    find_frozen_wheels,
    still_lives,
)
from terrain.estimation.measurements.sample_hold import (
    LATCHED,
    LEAPS,
    LEAPT_BY,
    LEAPT_SINCE,
    N_LINE,
    NO_LEAP,
    RAW,
    at_tick,
    leaps,
    limits_of,
    take,
)
from terrain.estimation.measurements.table import (
    DERIVED_ROWS,
    GNSS_SPEED_STD_MPS,
    GNSS_STD_M,
    MAX_RATE_FACTOR,
    ROWS_OF_DRIVE,
)
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import QUATERNION_TOLERANCE
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS, STEERING_CHANNELS
from terrain.records import Array
from terrain.robots import Robot

ROWS = ROWS_OF_DRIVE["swerve"]
"""Rows that the kernels fill, in their order; other robots use some of them."""

STREAMS = {
    "steering": STEERING_CHANNELS,
    "imu": IMU_CHANNELS,
    "odometry": CAMERA_CHANNELS,
    "gnss": GNSS_CHANNELS,
}
"""Channels of each stream but the wheels, in the order in which the kernels know streams and channels."""

STEERING, IMU, ODOMETRY, GNSS = range(len(STREAMS))
"""Number of each stream."""

STREAM_OF_ROW = (
    *("wheels",) * 3,
    *("imu",) * 4,
    *("steering",) * 3,
    *("odometry",) * 4,
    *("gnss",) * 4,
    *("derived",) * len(DERIVED_ROWS),
)
"""Which stream each row is measured by."""

PARAMS = (
    *("reduction_ratio", "fastest_radps", "wheel_radius_m", "initial_yaw_rad"),
    *("gyro_bias_z_radps", "accel_bias_x_mps2", "accel_bias_y_mps2"),
    *("accel_scale_x_ratio", "accel_scale_y_ratio", "zero_1_rad", "zero_2_rad", "zero_3_rad"),
    *("accel_bias_z_mps2", "accel_scale_z_ratio"),
)
"""Parameters of the robot that the kernels use, in the order of ``params``."""

TILT = 18
"""Lines of roll and pitch: the derived rows have no samples, and their lines are free."""

TILT_LIMITS = limits_of(0.0, 0.02, 0.0, (0.05, 3.0, LATCHED))
"""Roll and pitch turn by 3 rad/s at the most; a leap tilts gravity."""

N_FATES = 3
TAKEN, LEAPT, NO_ROTATION = range(N_FATES)
"""What became of a sample."""

N_TURNS, N_GNSS = 5, 3
"""Angles in ``turns``; columns of ``gnss``: the origin of positions and the variance of the last one."""

ACCEL_X, GYRO_Z, IMU_YAW, STEER = 3, 5, 6, 7
CAMERA, CAMERA_YAW, POSITION, DERIVED, REST = 10, 13, 14, 18, 26
_REDUCTION, _FASTEST, RADIUS, YAW_0, _GYRO_BIAS, _BIAS_X, _BIAS_Y, _SCALE_X, _SCALE_Y, _ZERO = range(10)
_BIAS_Z, _SCALE_Z = 12, 13
_IMU_TURNS, _CAMERA_TURNS = 3, 4
_FIX_STD, _FLOAT_STD = GNSS_STD_M[True], GNSS_STD_M[False]
_inline = njit(cache=True, error_model="numpy")


def params_of(robot: Robot, initial_yaw_rad: float) -> Array:
    """Return the parameters (14,) of a robot, neutral ones for what it does not have."""
    motors, sensors = robot.completed.motors, robot.completed.sensors
    zeros = {f"zero_{i}_rad": zero for i, zero in enumerate(robot.steering_zeros_rad.tolist(), 1)}
    values: dict[str, float] = dict.fromkeys(PARAMS, 0.0)
    values |= {"wheel_radius_m": robot.wheel_radius_m, "initial_yaw_rad": initial_yaw_rad}
    values["reduction_ratio"] = motors.reduction_ratio
    values["fastest_radps"] = MAX_RATE_FACTOR * motors.speed_max_radps
    values |= {name: getattr(sensors, name) for name in PARAMS if hasattr(sensors, name)} | zeros
    return np.array([values[name] for name in PARAMS])


def limits_of_rows(
    lag_s: Mapping[str, float],
    period_s: Mapping[str, float],
    tick_s: float,
    judged: Sequence[str] = ROWS,
) -> Array:
    """Return the limits (29, 7) of the rows.

    Parameters
    ----------
    lag_s, period_s : time constant of the low-pass on each stream, and its period; NaN without one
    tick_s : period of the wheels
    judged : rows whose leaps are left out
    """
    limits = []
    for row, stream in zip(ROWS, STREAM_OF_ROW, strict=True):
        leap = LEAPS.get(row, NO_LEAP) if row in judged else NO_LEAP
        period = period_s.get(stream, math.nan)
        limits.append(limits_of(lag_s.get(stream, 0.0), period, tick_s, leap))
    return np.array(limits)


def row_memory() -> tuple[Array, Array, Array]:
    """Return ``lines``, ``turns`` and ``gnss`` before the first sample."""
    return np.full((len(ROWS), N_LINE), np.nan), np.full((N_TURNS, 3), np.nan), np.full(N_GNSS, np.nan)


@_inline
def _unwrap(angle_rad: float, memory: Array) -> float:
    """Return the angle without jumps of a turn; ``memory`` holds the last one and the turns so far."""
    if math.isnan(angle_rad):
        return np.nan
    step = angle_rad - memory[0]
    if math.isnan(step):
        memory[1] = 0.0
    elif abs(step) >= np.pi:
        short = (step + np.pi) % (2 * np.pi) - np.pi
        if short == -np.pi and step > 0:
            short = np.pi
        memory[1] += short - step
    memory[0] = angle_rad
    return float(angle_rad + memory[1])


@_inline
def take_steering(
    sample: Array, came_s: float, params: Array, turns: Array, lines: Array, limits: Array
) -> bool:
    """Steering angles without their zeros; the first one lies within half a turn."""
    leapt = False
    for i in range(3):
        angle = wrapped(sample[i] - params[_ZERO + i])
        leapt |= take(STEER + i, _unwrap(angle, turns[i]), came_s, came_s, lines, limits)
    return bool(leapt)


@_inline
def take_imu(
    sample: Array,
    instant_s: float,
    came_s: float,
    params: Array,
    turns: Array,
    lines: Array,
    limits: Array,
    derived: Array,
) -> bool:
    """Calibrated yaw rate, acceleration of the body without gravity, and yaw.

    A sample is ``scale * truth + bias``.  The specific force at rest is g times the world's vertical in body
    axes, ``g (-sin pitch, sin roll cos pitch, cos roll cos pitch)``: with the nose up (pitch negative) it
    points forward too, with the left side up (roll positive) to the left.
    """
    gyro_z, force_x, force_y = sample[2], sample[3], sample[4]
    roll, pitch, yaw = sample[6], sample[7], sample[8]
    for i in range(2):
        if (
            not math.isnan(sample[6 + i])
            and leaps(sample[6 + i], instant_s, lines[TILT + i], TILT_LIMITS) != 0.0
        ):
            roll = pitch = np.nan
    accel_x = (force_x - params[_BIAS_X]) / params[_SCALE_X] + GRAVITY_MPS2 * math.sin(pitch)
    level_y = GRAVITY_MPS2 * math.sin(roll) * math.cos(pitch)
    accel_y = (force_y - params[_BIAS_Y]) / params[_SCALE_Y] - level_y
    leapt = take(ACCEL_X, accel_x, instant_s, came_s, lines, limits)
    leapt |= take(ACCEL_X + 1, accel_y, instant_s, came_s, lines, limits)
    leapt |= take(GYRO_Z, gyro_z - params[_GYRO_BIAS], instant_s, came_s, lines, limits)
    leapt |= take(IMU_YAW, _unwrap(yaw, turns[_IMU_TURNS]), instant_s, came_s, lines, limits)
    level_z = GRAVITY_MPS2 * math.cos(roll) * math.cos(pitch)
    take_vibration((sample[5] - params[_BIAS_Z]) / params[_SCALE_Z] - level_z, instant_s, derived)
    return bool(leapt)


@_inline
def take_odometry(
    sample: Array,
    instant_s: float,
    came_s: float,
    turns: Array,
    lines: Array,
    limits: Array,
    moving: bool,
    frozen: Array,
) -> int:
    """Speed of the camera point, yaw rate and yaw: ``kinematics.camera.body_motion`` of one sample."""
    # the camera's axes renamed to the body's: (-z, -x, y), of vectors and of the quaternion's vector alike
    x, y, z, w = -sample[5], -sample[3], sample[4], sample[6]
    v_x, v_y, v_z = -sample[9], -sample[7], sample[8]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not abs(norm - 1.0) <= QUATERNION_TOLERANCE:
        return TAKEN if math.isnan(norm) else NO_ROTATION
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    r_00, r_11 = x * x - y * y - z * z + w * w, -x * x + y * y - z * z + w * w
    r_01, r_10 = 2.0 * (x * y - z * w), 2.0 * (x * y + z * w)
    r_20, r_21 = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w)
    angle = turns[_CAMERA_TURNS]
    yaw = _unwrap(math.atan2(r_10, r_00), angle)
    if math.isnan(angle[2]):
        angle[2] = yaw
    speed_x = r_00 * v_x + r_10 * v_y + r_20 * v_z
    speed_y = r_01 * v_x + r_11 * v_y + r_21 * v_z
    speed = still_lives(np.array([speed_x, speed_y]), REPEATED_SPEED, moving, frozen)
    turned_by = lines[CAMERA_YAW, LEAPT_BY]
    leapt = take(CAMERA_YAW, yaw - angle[2], instant_s, came_s, lines, limits)
    if lines[CAMERA_YAW, LEAPT_BY] != turned_by:  # its leap turns the speeds: they have not leapt themselves
        lines[CAMERA, RAW], lines[CAMERA + 1, RAW] = speed[0], speed[1]
    leapt |= take(CAMERA, speed[0], instant_s, came_s, lines, limits)
    leapt |= take(CAMERA + 1, speed[1], instant_s, came_s, lines, limits)
    leapt |= take(CAMERA + 2, sample[11], instant_s, came_s, lines, limits)
    return LEAPT if leapt else TAKEN


@_inline
def take_gnss(
    sample: Array, instant_s: float, came_s: float, lines: Array, limits: Array, gnss: Array
) -> None:
    """Position from the origin, by default the first one, and speed; the position's variance is kept."""
    east, north = sample[0], sample[1]
    std = sample[4]
    if not std > 0.0:
        std = _FIX_STD if sample[5] >= 0.5 else _FLOAT_STD
    if not (math.isnan(east) or math.isnan(north)):
        if math.isnan(gnss[0]):
            gnss[0], gnss[1] = east, north
        gnss[2] = std * std
        take(POSITION, east - gnss[0], instant_s, came_s, lines, limits)
        take(POSITION + 1, north - gnss[1], instant_s, came_s, lines, limits)
    take(POSITION + 2, sample[2], instant_s, came_s, lines, limits)
    take(POSITION + 3, sample[3], instant_s, came_s, lines, limits)


@_inline
def take_sample(
    stream: int,
    sample: Array,
    stamps_s: tuple[float, float],
    params: Array,
    turns: Array,
    lines: Array,
    limits: Array,
    memories: tuple[Array, Array, Array],
) -> int:
    """Take a sample of any stream; return :data:`TAKEN`, :data:`LEAPT` or :data:`NO_ROTATION`.

    ``stamps_s`` are the instant of the measurement and that of its arrival; ``memories`` are those of the
    GNSS, of the derived rows and of frozen channels.
    """
    instant_s, came_s = stamps_s
    gnss, derived, frozen = memories
    if stream == ODOMETRY:
        moving = is_moving(derived)
        lives = still_lives(sample, REPEATED_CAMERA, moving, frozen[OF_CAMERA])
        fate: int = take_odometry(lives, instant_s, came_s, turns, lines, limits, moving, frozen[OF_SPEED])
        return fate
    leapt = False
    if stream == STEERING:
        leapt = take_steering(sample, came_s, params, turns, lines, limits)
    elif stream == IMU:
        lives = still_lives(sample, REPEATED_IMU, is_moving(derived), frozen[OF_IMU])
        leapt = take_imu(lives, instant_s, came_s, params, turns, lines, limits, derived)
    else:
        take_gnss(sample, instant_s, came_s, lines, limits, gnss)
    return LEAPT if leapt else TAKEN


@_inline
def wheel_rates(
    motor_radps: Array, params: Array, moving: bool, frozen: Array, z: Array
) -> tuple[bool, bool]:
    """Write the rates of the wheels; return whether all are finite, and whether one is beyond the motors."""
    finite, beyond = True, False
    stuck = np.empty(3, np.bool_)
    find_frozen_wheels(motor_radps, moving, frozen[OF_WHEELS], stuck)
    for i in range(3):
        rate = motor_radps[i] / params[_REDUCTION]
        known = math.isfinite(rate)
        too_fast = known and abs(rate) > params[_FASTEST]
        finite &= known
        beyond |= too_fast
        z[i] = np.nan if too_fast or not known or stuck[i] else rate
    return finite, beyond


@_inline
def rows_at_tick(
    time_s: float,
    lines: Array,
    limits: Array,
    gnss: Array,
    params: Array,
    derived: Array,
    z: Array,
    gnss_variance: Array,
) -> None:
    """Write all rows but those of the wheels, and the variances (4,) of the GNSS rows."""
    for row in range(3, DERIVED):
        z[row] = at_tick(row, time_s, lines, limits)
    for i in range(2):
        gnss_variance[i] = np.nan if math.isnan(z[POSITION + i]) else gnss[2]
        gnss_variance[2 + i] = np.nan if math.isnan(z[POSITION + 2 + i]) else GNSS_SPEED_STD_MPS**2
    derive_rows(time_s, z, params[RADIUS], derived, DERIVED, GYRO_Z, ACCEL_X, CAMERA)
    if z[REST] == 0.0:
        for row in range(CAMERA, CAMERA + 2):  # at rest a camera that measures none is right again
            if abs(lines[row, RAW]) <= REST_SEEN_MPS:
                lines[row, LEAPT_BY], lines[row, LEAPT_SINCE] = 0.0, np.nan
