"""Sensors of the simulator: what loggers write of a motion, with noise, drops, counts, delays and warm motors.

Sensors share no equation with the package.  Noise that moves with the robot is a first-order process; a lidar's twist
is a mean over its scan, stamped when it has been matched; encoders count.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from studies.foreign.physics import G_MPS2, SAMPLE_S, Motion
from terrain.records import Array, Stream

WHEELS_HZ, IMU_HZ, LIDAR_HZ = 50, 100, 20
SCAN_S = 0.08  #: a lidar's twist is the mean over so much time before its scan ends
DROPPED_RATIO = 0.03  #: scans that are lost
COUNTS = 8192  #: of an encoder, a turn of the wheel
MOVING_MPS = 0.2  #: speed at which vibration has half its size
MAGNET_PK = 0.0012  #: torque constant that is lost by the kelvin (ferrite 0.2 %, neodymium 0.1 %)


class Sensing(NamedTuple):
    """Sensors as they are: where they sit, how they err, how late they are."""

    lidar_m: tuple[float, float] = (0.0, 0.0)  #: its place ahead and left of the middle
    lidar_yaw_rad: float = 0.0  #: turned to the left
    lidar_late_s: float = 0.03
    lidar_late_s2pm: float = 0.0  #: more of it, by the speed
    imu_late_s: float = 0.0
    gyro_ratio: float = 1.0  #: reading over yaw rate
    gyro_cubic_s2: float = 0.0  #: reading w (1 - k w^2)
    gyro_warming_radps: float = 0.0  #: bias that the gyro has gained when it is warm
    squat_radpmps2: float = 0.0  #: pitch of the body on its springs by its acceleration
    lost_ratio: float = 0.0  #: counts that an encoder loses of what it turns above ``lost_from_radps``
    lost_from_radps: float = 0.0
    encoder_lag_s: float = 0.0  #: low-pass of the motor driver, which the description states
    steering_std_rad: float = 0.0008


class Motor(NamedTuple):
    """Motors of the wheels, at the wheel."""

    nm_per_a: float
    friction_nm: float
    inertia_kgm2: float
    crawl_ratio: float = 0.0  #: friction that a wheel has more as it begins to turn (Stribeck)
    weak_ratio: float = 0.0  #: torque constant that is lost
    heats_kps_a2: float = 2e-4  #: heating by the square of the current


def coloured(
    rng: np.random.Generator, std: float, memory_s: float, shape: tuple[int, ...], dt_s: float
) -> Array:
    """Return a first-order process (n, ...) of a standard deviation and a memory."""
    keep = math.exp(-dt_s / memory_s)
    white = rng.standard_normal(shape)
    white[1:] *= math.sqrt(1.0 - keep**2)
    return np.asarray(std * lfilter([1.0], [1.0, -keep], white, axis=0))


def delayed(values: Array, late_s: float | Array) -> Array:
    """Return samples (n, runs) as they were so long ago."""
    n = len(values)
    at = np.arange(n)[:, None] - np.broadcast_to(np.asarray(late_s) / SAMPLE_S, values.shape)
    low = np.clip(np.floor(at).astype(int), 0, n - 2)
    part = np.clip(at - low, 0.0, 1.0)
    column = np.arange(values.shape[1])
    return np.asarray(values[low, column] * (1.0 - part) + values[low + 1, column] * part)


def imu_of(motion: Motion, sensing: Sensing, rng: np.random.Generator) -> list[Stream]:
    """Return the streams of the IMU: rates, specific force, and roll and pitch as it fuses them."""
    n, runs = motion.yaw_rate_radps.shape
    moving = np.abs(motion.speed_x_mps) + np.abs(motion.speed_y_mps) + 0.2 * np.abs(motion.yaw_rate_radps)
    active = moving / (moving + MOVING_MPS)
    rate, time = motion.yaw_rate_radps, motion.time_s[:, None]
    gyro = sensing.gyro_ratio * rate * (1.0 - sensing.gyro_cubic_s2 * rate**2)
    warm = sensing.gyro_warming_radps * (1.0 - np.exp(-time / 6.0))
    gyro = gyro + warm + 0.0015 * rng.standard_normal(runs)
    gyro = gyro + active * coloured(rng, 0.008, 0.04, (n, runs), SAMPLE_S)
    pitch, roll = np.arctan(motion.slope_x), np.arctan(motion.slope_y)
    sprung = sensing.squat_radpmps2 * (motion.accel_x_mps2 - G_MPS2 * motion.slope_x)
    ahead = motion.accel_x_mps2 + G_MPS2 * sprung + 0.015 * rng.standard_normal(runs)
    ahead = ahead + active * coloured(rng, 0.12, 0.06, (n, runs), SAMPLE_S)
    left = motion.accel_y_mps2 + active * coloured(rng, 0.12, 0.06, (n, runs), SAMPLE_S)
    tilt = [
        angle + 0.0015 * rng.standard_normal(runs) + coloured(rng, 0.001, 1.0, (n, runs), SAMPLE_S)
        for angle in (roll, -pitch)
    ]
    late = [delayed(each, sensing.imu_late_s) for each in (gyro, ahead, left, *tilt)]
    late[0] = late[0] + 0.0015 * rng.standard_normal((n, runs))
    late[1] = late[1] + 0.012 * rng.standard_normal((n, runs))
    names = ("gyro_z_radps", "accel_x_mps2", "accel_y_mps2", "accel_z_mps2", "roll_rad", "pitch_rad")
    columns = [late[0], late[1], late[2], np.full((n, runs), G_MPS2), late[3], late[4]]
    return [Stream(motion.time_s, np.column_stack([c[:, i] for c in columns]), names) for i in range(runs)]


def lidar_of(motion: Motion, sensing: Sensing, rng: np.random.Generator) -> list[Stream]:
    """Return the streams of a lidar's scan matching: its twist, in its own axes."""
    runs = motion.yaw_rate_radps.shape[1]
    l_x, l_y = sensing.lidar_m
    v_x = motion.speed_x_mps - l_y * motion.yaw_rate_radps
    v_y = motion.speed_y_mps + l_x * motion.yaw_rate_radps
    cos, sin = math.cos(sensing.lidar_yaw_rad), math.sin(sensing.lidar_yaw_rad)
    ahead, left = v_x * cos + v_y * sin, v_y * cos - v_x * sin
    if motion.seen_x_mps is not None and motion.seen_y_mps is not None:
        ahead, left = motion.seen_x_mps, motion.seen_y_mps
    late_s = sensing.lidar_late_s + sensing.lidar_late_s2pm * np.hypot(v_x, v_y)
    width = round(SCAN_S / SAMPLE_S)
    window = np.ones(width) / width
    every = round(1.0 / (LIDAR_HZ * SAMPLE_S))
    columns = []
    for values, size in ((ahead, 0.006), (left, 0.006), (motion.yaw_rate_radps, 0.008)):
        scan = lfilter(window, [1.0], values, axis=0)
        seen = delayed(scan, late_s)[::every]
        columns.append(seen + coloured(rng, size, 0.05, seen.shape, 1.0 / LIDAR_HZ))
    kept = rng.uniform(size=columns[0].shape) >= DROPPED_RATIO
    kept[[0, -1]] = True
    names, time_s = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps"), motion.time_s[::every]
    out = []
    for i in range(runs):
        values = np.column_stack([c[:, i] for c in columns])
        out.append(Stream(time_s[kept[:, i]], values[kept[:, i]], names))
    return out


def pose_of(motion: Motion, sensing: Sensing, rng: np.random.Generator) -> list[Stream]:
    """Return the streams of a camera above that follows a marker on the body."""
    runs = motion.yaw_rate_radps.shape[1]
    cos, sin = np.cos(motion.yaw_rad), np.sin(motion.yaw_rad)
    east = motion.speed_x_mps * cos - motion.speed_y_mps * sin
    north = motion.speed_x_mps * sin + motion.speed_y_mps * cos
    l_x, l_y = sensing.lidar_m
    x = np.cumsum(east, axis=0) * SAMPLE_S + l_x * cos - l_y * sin
    y = np.cumsum(north, axis=0) * SAMPLE_S + l_x * sin + l_y * cos
    if motion.seen_m is not None:
        x, y = motion.seen_m[..., 0], motion.seen_m[..., 1]
    every = 3
    late_s = sensing.lidar_late_s + sensing.lidar_late_s2pm * np.hypot(east, north)
    seen = [delayed(each, late_s)[::every] for each in (x, y, motion.yaw_rad + sensing.lidar_yaw_rad)]
    sizes = 0.0004, 0.0004, 0.003
    columns = [each + size * rng.standard_normal(each.shape) for each, size in zip(seen, sizes, strict=True)]
    kept = rng.uniform(size=columns[0].shape) >= DROPPED_RATIO
    kept[[0, -1]] = True
    names, time_s = ("position_x_m", "position_y_m", "yaw_rad"), motion.time_s[::every]
    out = []
    for i in range(runs):
        values = np.column_stack([c[:, i] for c in columns])
        out.append(Stream(time_s[kept[:, i]], values[kept[:, i]], names))
    return out


def counted(angle_rad: Array, sensing: Sensing) -> Array:
    """Return rates (k, ...) of encoders of angles (n, ...): counts over a period of the wheels' logger."""
    every = round(1.0 / (WHEELS_HZ * SAMPLE_S))
    rate = np.gradient(angle_rad, SAMPLE_S, axis=0)
    over = np.sign(rate) * np.maximum(np.abs(rate) - sensing.lost_from_radps, 0.0)
    seen = angle_rad - sensing.lost_ratio * np.cumsum(over, axis=0) * SAMPLE_S
    counts = np.floor(seen[::every] * COUNTS / (2.0 * math.pi))
    steps = np.diff(counts, axis=0, prepend=counts[:1])
    rate = steps * (2.0 * math.pi / COUNTS) * WHEELS_HZ
    if sensing.encoder_lag_s:
        keep = math.exp(-1.0 / (WHEELS_HZ * sensing.encoder_lag_s))
        rate = lfilter([1.0 - keep], [1.0, -keep], rate, axis=0)
    return np.asarray(rate)


def torque_of(pull_n: Array, rate: Array, radius_m: Array, motor: Motor) -> Array:
    """Return what motors (n, runs, wheels) give: for the pull of their wheels, friction and inertia."""
    turning = np.tanh(rate / 0.15)
    friction = motor.friction_nm * (1.0 + motor.crawl_ratio * np.exp(-((rate / 0.8) ** 2)))
    spin = motor.inertia_kgm2 * np.gradient(rate, SAMPLE_S, axis=0)
    return np.asarray(radius_m * pull_n + friction * turning + spin)


def currents_of(torque_nm: Array, motor: Motor) -> Array:
    """Return currents (n, runs, wheels) of motors that warm: torque over a constant that falls."""
    current = torque_nm / motor.nm_per_a
    warmth = np.cumsum(current**2, axis=0) * SAMPLE_S * motor.heats_kps_a2
    return np.asarray(current / ((1.0 - motor.weak_ratio) * (1.0 - MAGNET_PK * warmth)))
