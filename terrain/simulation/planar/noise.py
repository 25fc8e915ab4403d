"""What one run of the planar simulation draws for itself: scatter of parameters, and noise that has a colour.

Coloured noise is ``x_k = a x_(k-1) + sqrt(1 - a^2) std e_k`` with ``a = exp(-dt / tau)``, of which every
second sample is again such a noise.  Spectra are one-sided: their integral from 0 to the Nyquist frequency is
the variance.  Steps of an encoder count as white noise of its position, which they are once speeds change.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.effects import ACCEL, CURRENT, GYRO, HEADING, SPEED_X, SPEED_Y, TURNING_CURRENT
from terrain.errors import ConfigError
from terrain.files.descriptions import number, read_yaml
from terrain.files.resources import data_folder
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.planar.model import SWERVE_WHEELS, Planar

WHEELS_HZ, IMU_HZ, CAMERA_HZ = 50.0, 100.0, 50.0
"""Rates of the loggers."""

WHEEL_SPEED, GRADE, ROLL = "wheel_speed_mps", "grade_rad", "roll_rad"
"""What a replay is fed with, beside the channels that are compared."""


class Scatter(NamedTuple):
    """Standard deviations of what differs from run to run by itself; ``data/spread/planar.yaml``."""

    gyro_bias_radps: float
    accel_bias_mps2: float
    pitch_offset_rad: float
    roll_offset_rad: float
    wheel_radius_ratio: float
    one_sided_radius_ratio: float
    rolling_resistance_ratio: float
    force_slip_ratio: float
    effective_track_ratio: float


class Noise(NamedTuple):
    """Noise of a run: standard deviations, and ``*_s`` the time over which it forgets itself.

    All but white noise is that of a robot fast enough; at the speed ``moving_mps`` it has half its size, and
    at rest none.
    """

    along_ratio: float
    along_s: float
    across_ratio: float
    across_s: float
    yaw_radps: float
    yaw_s: float
    gyro_radps: float
    gyro_s: float
    accel_mps2: float
    accel_s: float
    current_skid_a: float
    current_swerve_a: float
    current_s: float
    camera_mps: float
    camera_s: float
    encoder_m: float
    tilt_rad: float
    heading_rad: float
    moving_mps: float

    def current_a(self, drive: str) -> float:
        """Return the noise of the sum of the currents of robots of a drive."""
        return self.current_swerve_a if drive == "swerve" else self.current_skid_a


def load_scatter() -> Scatter:
    """Return the scatter that travels with the package.

    Examples
    --------
    >>> load_scatter().gyro_bias_radps
    0.002
    """
    return Scatter(**_numbers("scatter", Scatter._fields))


def load_noise() -> Noise:
    """Return the noise that travels with the package.

    Examples
    --------
    >>> load_noise().along_s
    0.3
    """
    return Noise(**_numbers("noise", Noise._fields))


def _numbers(part: str, names: tuple[str, ...]) -> dict[str, float]:
    described: Any = read_yaml(data_folder("spread") / "planar.yaml")[part]
    return {
        name: number(f"planar.yaml: {part}: {name}", described[name], name.rpartition("_")[2], 0.0)
        for name in names
    }


@njit(cache=True)
def coloured(white: Array, std: Array, tau_s: Array, dt: float) -> Array:
    """Return noise (c, n) of given size and memory from white noise (c, n) of size 1.

    Parameters
    ----------
    white : (c, n)
    std, tau_s : (c,)
    dt : from sample to sample in s
    """
    out = np.empty_like(white)
    for i in range(white.shape[0]):
        keep = math.exp(-dt / tau_s[i])
        push = math.sqrt(1.0 - keep * keep) * std[i]
        value = std[i] * white[i, 0]
        out[i, 0] = value
        for k in range(1, white.shape[1]):
            value = keep * value + push * white[i, k]
            out[i, k] = value
    return out


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


@njit(cache=True)
def lag_weights(time_constant_s: float, dt: float) -> tuple[float, float, float]:
    """Return weights of this sample, the one before and the last output in an exact first-order low-pass.

    Examples
    --------
    >>> [round(float(weight), 4) for weight in lag_weights(0.05, 0.02)]
    [0.1758, 0.1539, 0.6703]
    """
    keep = math.exp(-dt / time_constant_s)
    slope = time_constant_s / dt * (1.0 - keep)
    return 1.0 - slope, slope - keep, keep


def activity(speed_mps: Any, noise: Noise) -> Any:
    """Return how much of the noise of a moving robot there is at a speed of its wheels, 0 to 1."""
    return np.abs(speed_mps) / (np.abs(speed_mps) + noise.moving_mps)


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
    robot.has("motors", "camera", "sensors")
    motors, camera, sensors = robot.motors, robot.camera, robot.sensors
    assert motors is not None
    assert camera is not None
    assert sensors is not None
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
        drawn = ground(noise.current_a(robot.drive) * moving, noise.current_s, WHEELS_HZ)
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
        return np.asarray(blue) + white_psd(f, white_mps, WHEELS_HZ)
    if channel == HEADING:
        angle = white_psd(f, noise.heading_rad, CAMERA_HZ)
        told = angle * (np.sin(2.0 * math.pi * f / CAMERA_HZ) * CAMERA_HZ) ** 2
        return told + ground(noise.yaw_radps * moving, noise.yaw_s, CAMERA_HZ)
    if channel in (GRADE, ROLL):
        return white_psd(f, noise.tilt_rad, IMU_HZ)
    raise ConfigError(f"noise of channel {channel!r} is not known")
