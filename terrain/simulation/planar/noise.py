"""Noise of a run of the planar simulation: scatter of parameters, coloured noise, and the simulation's own error.

Coloured noise is ``x_k = a x_(k-1) + sqrt(1 - a^2) std e_k`` with ``a = exp(-dt / tau)``; every second sample of it is
again such a noise.  The numbers travel with the package, in ``data/spread/planar.yaml``.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from terrain.files.documents import number, read_yaml
from terrain.files.names import data_folder
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import Robot

WHEELS_HZ, IMU_HZ, CAMERA_HZ = 50.0, 100.0, 50.0  # rates of the loggers


class Scatter(NamedTuple):
    """Standard deviations of what differs from run to run by itself."""

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

    All but white noise is that of a robot fast enough; at the speed ``moving_mps`` it has half its size, and at rest
    none.
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

    def current_a(self, robot: Robot) -> float:
        """Return the noise of the sum of a robot's currents; that of an omni robot is in its description."""
        if robot.on_omni_wheels:
            return 0.0
        return self.current_skid_a if robot.skids else self.current_swerve_a


def load_scatter() -> Scatter:
    """Return the scatter that travels with the package."""
    return Scatter(**_numbers("scatter", Scatter._fields))


def load_noise() -> Noise:
    """Return the noise that travels with the package.

    Examples
    --------
    >>> load_noise().along_s
    0.3
    """
    return Noise(**_numbers("noise", Noise._fields))


class ModelError(NamedTuple):
    """How far the planar simulation on a soil of the package is off the dynamic plant, by parameter."""

    common: dict[str, float]  # value that each parameter seems to have where nothing is hidden
    varied: dict[str, float]  # the same of the mean over runs whose conditions differ
    scatter: dict[str, float]  # of single runs whose conditions differ
    probes: dict[tuple[str, str], float]  # what the residual depends on, by channel and input


def load_model_error() -> ModelError:
    """Return the simulation's own error; ``data/spread/planar.yaml`` says how it was measured."""
    common, varied, scatter = (
        _numbers(part, tuple(_described()[part]))
        for part in ("model_error", "varied_error", "varied_scatter")
    )
    probes = {
        (channel, name): float(size)
        for channel, entry in _described()["probe_error"].items()
        for name, size in entry["sizes"].items()
    }
    return ModelError(common, varied, scatter, probes)


@cache
def _described() -> Any:
    return read_yaml(data_folder("spread") / "planar.yaml")


def _numbers(part: str, names: tuple[str, ...]) -> dict[str, float]:
    described = _described()[part]
    return {
        name: number(f"planar.yaml: {part}: {name}", described[name], name.rpartition("_")[2], 0.0)
        for name in names
    }


@njit
def coloured(white: Array, std: Array, tau_s: Array, dt: float) -> Array:
    """Return noise (c, n) of sizes and memories (c,) from white noise (c, n) of size 1, sampled every ``dt`` s."""
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


@njit
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
