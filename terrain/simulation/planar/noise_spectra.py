"""Spectra of the noise in each channel of a log of the planar simulation.

Spectra are one-sided: their integral from 0 to the Nyquist frequency is the variance.  Steps of an encoder
count as white noise of its position, which they are once speeds change.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

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

    Noise of the terrain counts in each channel in which it shows.  Noise of the wheels shows in a log of the
    wheels alone; a replay that takes a log of the wheels carries it into every channel, which the caller
    adds.

    Parameters
    ----------
    noise : of the runs
    robot, planar : of the runs
    channel : one of ``effects.CHANNELS``, or ``wheel_speed_mps`` (of one wheel), ``grade_rad`` or
    ``roll_rad``
    frequency_hz : from 0 to the logger's Nyquist frequency: 25 Hz, of the IMU's channels 50 Hz
    speed_mps : of the wheels
    encoder_lag_s : beside the lag of the robot's description

    Raises
    ------
    ConfigError
        for another channel, or a robot without motors, camera or sensors.
    """
    f = np.asarray(frequency_hz, dtype=np.float64)
    model = _Spectra(noise, robot, planar, abs(speed_mps), float(activity(speed_mps, noise)), encoder_lag_s)
    densities: dict[str, Callable[[Array], Array]] = {
        GYRO: model.yaw_rate,
        SPEED_X: model.speed_ahead,
        SPEED_Y: model.speed_sideways,
        ACCEL: model.accel,
        CURRENT: model.current,
        TURNING_CURRENT: model.turning_current,
        WHEEL_SPEED: model.wheel_speed,
        HEADING: model.heading_rate,
        GRADE: model.tilt,
        ROLL: model.tilt,
    }
    if channel not in densities:
        raise ConfigError(f"noise of channel {channel!r} is not known")
    return densities[channel](f)


def _folded(density: Callable[[Array], Array], f: Array) -> Array:
    """Return the density of every second sample of a signal at the IMU's rate."""
    return density(f) + density(IMU_HZ / 2.0 - f)


class _Spectra(NamedTuple):
    """Densities of the noise of one robot at a steady speed, each from frequencies (n,) to (n,).

    ``moving`` is the activity of the noise at that speed, 0 to 1.
    """

    noise: Noise
    robot: Robot
    planar: Planar
    speed_mps: float
    moving: float
    encoder_lag_s: float

    def yaw_rate(self, f: Array) -> Array:
        sensors, noise = self.robot.sensors, self.noise
        vibration = coloured_psd(f, noise.gyro_radps * self.moving, noise.gyro_s, IMU_HZ)
        return self._turning(f, IMU_HZ) + vibration + white_psd(f, sensors.gyro_std_radps, IMU_HZ)

    def speed_ahead(self, f: Array) -> Array:
        turning = self._turning(f, CAMERA_HZ) * self.planar.lever_y_m**2
        return self._seen(f) + _folded(self._along, f) + turning

    def speed_sideways(self, f: Array) -> Array:
        noise = self.noise
        sideways = coloured_psd(f, noise.across_ratio * self.speed_mps, noise.across_s, CAMERA_HZ)
        return self._seen(f) + sideways + self._turning(f, CAMERA_HZ) * self.planar.lever_x_m**2

    def accel(self, f: Array) -> Array:
        sensors, noise = self.robot.sensors, self.noise
        vibration = coloured_psd(f, noise.accel_mps2 * self.moving, noise.accel_s, IMU_HZ)
        return vibration + self._along_rate(f) + white_psd(f, sensors.accel_std_mps2, IMU_HZ)

    def current(self, f: Array) -> Array:
        planar = self.planar
        amps_per_accel = planar.mass_kg * planar.radius_m / planar.nm_per_a
        return self.turning_current(f) + amps_per_accel**2 * _folded(self._along_rate, f)

    def turning_current(self, f: Array) -> Array:
        robot, noise = self.robot, self.noise
        drawn = coloured_psd(f, noise.current_a(robot) * self.moving, noise.current_s, WHEELS_HZ)
        return drawn + white_psd(f, robot.sensors.current_std_a * math.sqrt(len(robot.wheels)), WHEELS_HZ)

    def wheel_speed(self, f: Array) -> Array:
        robot, motors, sensors = self.robot, self.robot.motors, self.robot.sensors
        turns = sensors.hall_steps_ratio * motors.reduction_ratio
        step_m = 2.0 * math.pi * robot.wheel_radius_m / turns if turns > 0.0 else 0.0
        std_m = math.hypot(self.noise.encoder_m * self.moving, step_m / math.sqrt(12.0))
        rate = white_psd(f, std_m, WHEELS_HZ) * (2.0 * np.sin(math.pi * f / WHEELS_HZ) * WHEELS_HZ) ** 2
        rate = rate * lag_gain(f, sensors.encoder_time_constant_s + self.encoder_lag_s, WHEELS_HZ)
        white_mps = sensors.motor_std_radps / motors.reduction_ratio * robot.wheel_radius_m
        return np.asarray(rate + white_psd(f, white_mps, WHEELS_HZ))

    def heading_rate(self, f: Array) -> Array:
        angle = white_psd(f, self.noise.heading_rad, CAMERA_HZ)
        rate = angle * (np.sin(2.0 * math.pi * f / CAMERA_HZ) * CAMERA_HZ) ** 2
        return np.asarray(rate + self._turning(f, CAMERA_HZ))

    def tilt(self, f: Array) -> Array:
        return white_psd(f, self.noise.tilt_rad, IMU_HZ)

    def _turning(self, f: Array, rate_hz: float) -> Array:
        return coloured_psd(f, self.noise.yaw_radps * self.moving, self.noise.yaw_s, rate_hz)

    def _seen(self, f: Array) -> Array:
        camera, noise = self.robot.camera, self.noise
        vibration = coloured_psd(f, noise.camera_mps * self.moving, noise.camera_s, CAMERA_HZ)
        return vibration + white_psd(f, camera.speed_std_mps, CAMERA_HZ)

    def _along(self, f: Array) -> Array:
        """Return the density of the speed ahead, at the IMU's rate."""
        noise, planar = self.noise, self.planar
        lag = self.speed_mps * planar.slip_ratio / GRAVITY_MPS2
        terrain = coloured_psd(f, noise.along_ratio * self.speed_mps, noise.along_s, IMU_HZ)
        if planar.n_wheels != SWERVE_WHEELS:
            return terrain * lag_gain(f, lag, IMU_HZ)
        w = 2.0 * math.pi * f  # a contact with a relaxation length swings
        sprung = w**2 * planar.relaxation_m * planar.slip_ratio / GRAVITY_MPS2
        return np.asarray(terrain / ((1.0 - sprung) ** 2 + (w * lag) ** 2))

    def _along_rate(self, f: Array) -> Array:
        """Return the density of its rate by differences as the simulation takes them, at the IMU's rate."""
        angle = 2.0 * math.pi * f / IMU_HZ
        return self._along(f) * ((8.0 * np.sin(angle) - np.sin(2.0 * angle)) / 6.0 * IMU_HZ) ** 2
