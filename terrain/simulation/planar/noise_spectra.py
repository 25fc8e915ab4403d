"""Spectra of the noise in each channel of a log of the planar simulation.

Spectra are one-sided: their integral from 0 to the Nyquist frequency is the variance.  Steps of an encoder
count as white noise of its position, which they are once speeds change.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.effects import ACCEL, CURRENT, GYRO, HEADING, SPEED_X, SPEED_Y, TURNING_CURRENT
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.planar.model import SWERVE_WHEELS, Planar
from terrain.simulation.planar.noise import (
    CAMERA_HZ,
    IMU_HZ,
    WHEELS_HZ,
    Noise,
    activity,
    lag_weights,
)

WHEEL_SPEED, GRADE, ROLL = "wheel_speed_mps", "grade_rad", "roll_rad"
"""What a replay is fed with, beside the channels that are compared."""


def coloured_psd(frequency_hz: Array, std: float, tau_s: float, rate_hz: float) -> Array:
    """Return the one-sided density of :func:`coloured` noise at a rate, unit^2/Hz.

    Examples
    --------
    >>> f = np.arange(0.005, 25.0, 0.01)
    >>> round(float(coloured_psd(f, 0.3, 0.2, 50.0).sum() * 0.01), 4)
    0.09
    """
    keep = math.exp(-1.0 / (rate_hz * tau_s))
    turned = 1.0 - 2.0 * keep * np.cos(2.0 * math.pi * np.asarray(frequency_hz) / rate_hz) + keep**2
    return np.asarray(2.0 * std**2 / rate_hz * (1.0 - keep**2) / turned)


def white_psd(frequency_hz: Array, std: float, rate_hz: float) -> Array:
    """Return the one-sided density of white noise at a rate, unit^2/Hz."""
    return np.full(np.shape(frequency_hz), 2.0 * std**2 / rate_hz)


def lag_gain(frequency_hz: Array, time_constant_s: float, rate_hz: float) -> Array:
    """Return the squared gain of a low-pass that takes its samples as joined by straight lines."""
    if time_constant_s == 0.0:
        return np.ones(np.shape(frequency_hz))
    now, before, keep = lag_weights(time_constant_s, 1.0 / rate_hz)
    back = np.exp(-2j * math.pi * np.asarray(frequency_hz) / rate_hz)
    return np.asarray(np.abs((now + before * back) / (1.0 - keep * back)) ** 2)


def noise_psd(
    noise: Noise,
    robot: Robot,
    planar: Planar,
    channel: str,
    frequency_hz: Array,
    speed_mps: float,
    encoder_lag_s: float = 0.0,
) -> Array:
    """Return the one-sided density of the noise in a channel of a log at a steady speed, unit^2/Hz.

    Noise of the ground counts in each channel in which it shows.  Noise of the wheels shows in a log of
    the wheels alone, and comes into every channel of a replay that is fed with it: that is the caller's.

    Parameters
    ----------
    noise : of the runs
    robot, planar : whose
    channel : one of ``effects.CHANNELS``, or ``wheel_speed_mps`` (of one wheel), ``grade_rad`` or
        ``roll_rad``
    frequency_hz : from 0 to the logger's Nyquist frequency: 25 Hz, of the IMU's channels 50 Hz
    speed_mps : of the wheels
    encoder_lag_s : beside the lag that the robot's description knows

    Raises
    ------
    ConfigError
        for another channel, or a robot without motors, camera or sensors.
    """
    motors, camera, sensors = robot.motors, robot.camera, robot.sensors
    f = np.asarray(frequency_hz, dtype=np.float64)
    moving = float(activity(speed_mps, noise))
    speed = abs(speed_mps)

    def ground(std: float, tau_s: float, rate_hz: float) -> Array:
        return coloured_psd(f, std, tau_s, rate_hz)

    def along(at_hz: Array) -> Array:
        lag = speed * planar.slip_ratio / GRAVITY_MPS2
        told = coloured_psd(at_hz, noise.along_ratio * speed, noise.along_s, IMU_HZ)
        if planar.n_wheels != SWERVE_WHEELS:
            return told * lag_gain(at_hz, lag, IMU_HZ)
        w = 2.0 * math.pi * at_hz  # a contact that gives swings
        sprung = w**2 * planar.relaxation_m * planar.slip_ratio / GRAVITY_MPS2
        return np.asarray(told / ((1.0 - sprung) ** 2 + (w * lag) ** 2))

    def jerked(at_hz: Array) -> Array:  # by differences as the simulation takes them, at the IMU's rate
        angle = 2.0 * math.pi * at_hz / IMU_HZ
        return along(at_hz) * ((8.0 * np.sin(angle) - np.sin(2.0 * angle)) / 6.0 * IMU_HZ) ** 2

    def folded(density: Callable[[Array], Array]) -> Array:  # of every second sample
        return density(f) + density(IMU_HZ / 2.0 - f)

    if channel == GYRO:
        turning = ground(noise.yaw_radps * moving, noise.yaw_s, IMU_HZ)
        shaking = ground(noise.gyro_radps * moving, noise.gyro_s, IMU_HZ)
        return turning + shaking + white_psd(f, sensors.gyro_std_radps, IMU_HZ)
    if channel in (SPEED_X, SPEED_Y):
        seen = ground(noise.camera_mps * moving, noise.camera_s, CAMERA_HZ)
        seen += white_psd(f, camera.speed_std_mps, CAMERA_HZ)
        turning = ground(noise.yaw_radps * moving, noise.yaw_s, CAMERA_HZ)
        if channel == SPEED_X:
            return seen + folded(along) + turning * planar.lever_y_m**2
        aside = ground(noise.across_ratio * speed, noise.across_s, CAMERA_HZ)
        return seen + aside + turning * planar.lever_x_m**2
    if channel == ACCEL:
        shaking = ground(noise.accel_mps2 * moving, noise.accel_s, IMU_HZ)
        return shaking + jerked(f) + white_psd(f, sensors.accel_std_mps2, IMU_HZ)
    if channel in (CURRENT, TURNING_CURRENT):
        drawn = ground(noise.current_a(robot) * moving, noise.current_s, WHEELS_HZ)
        white = white_psd(f, sensors.current_std_a * math.sqrt(len(robot.wheels)), WHEELS_HZ)
        if channel == TURNING_CURRENT:
            return drawn + white
        pull = planar.mass_kg * planar.radius_m / planar.nm_per_a
        return drawn + white + pull**2 * folded(jerked)
    if channel == WHEEL_SPEED:
        step_m = 2.0 * math.pi * robot.wheel_radius_m / (sensors.hall_steps_ratio * motors.reduction_ratio)
        place = white_psd(f, math.hypot(noise.encoder_m * moving, step_m / math.sqrt(12.0)), WHEELS_HZ)
        blue = place * (2.0 * np.sin(math.pi * f / WHEELS_HZ) * WHEELS_HZ) ** 2
        blue = blue * lag_gain(f, sensors.encoder_time_constant_s + encoder_lag_s, WHEELS_HZ)
        white_mps = sensors.motor_std_radps / motors.reduction_ratio * robot.wheel_radius_m
        return np.asarray(blue + white_psd(f, white_mps, WHEELS_HZ))
    if channel == HEADING:
        angle = white_psd(f, noise.heading_rad, CAMERA_HZ)
        told = angle * (np.sin(2.0 * math.pi * f / CAMERA_HZ) * CAMERA_HZ) ** 2
        return told + ground(noise.yaw_radps * moving, noise.yaw_s, CAMERA_HZ)
    if channel in (GRADE, ROLL):
        return white_psd(f, noise.tilt_rad, IMU_HZ)
    raise ConfigError(f"noise of channel {channel!r} is not known")
