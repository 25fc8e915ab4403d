"""Yaw rates of gyro and wheels, low-passed alike, as the comparison of their clocks takes them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_erosion, gaussian_filter1d

from terrain.errors import DataError
from terrain.records import Array, RunLog, Stream

MIN_SAMPLES = 30
"""Fewer samples of the slower stream tell no correlation from chance."""

EDGE_SIGMAS = 3.0
"""So close to an end or a gap, in widths of the low-pass, it has too little to average: not used."""

MIN_SIGMA_S = 0.1
"""Width of the low-pass under fast streams: no robot turns faster, and a finer search only takes longer."""

MAX_GAP_SAMPLES = 3.0
"""Across a longer gap, in widths of the low-pass, nothing is interpolated."""

MAX_GAP_SHARE = 20.0
"""A stream that lasts this many times as long as its samples do is mostly gap, and is not compared."""

MIN_GYRO_STEPS = 8
"""Grid of the smooth gyro, in steps a period of the slower stream: fine enough for straight lines between."""


class YawRatePair(NamedTuple):
    """Both signals, low-passed alike: the wheels on their own times, the gyro on a fine even grid."""

    time_s: Array
    wheels_radps: Array
    sigma_s: float
    gyro_start_s: float
    gyro_step_s: float
    gyro_radps: Array
    gyro_slope: Array
    gyro_valid: Array


def low_passed_pair(run: RunLog, track_m: float) -> YawRatePair | None:
    """Return the yaw rates of a run, or None where too few samples support them."""
    try:
        wheels, imu = run.streams["wheels"], run.streams["imu"]
        left_mps, right_mps = wheels.channel("speed_left_mps"), wheels.channel("speed_right_mps")
        gyro_radps = imu.channel("gyro_z_radps")
    except KeyError as error:
        raise DataError(f"{run.run_id}: clocks cannot be compared without {error.args[0]}") from error
    if any(len(stream) * MAX_GAP_SHARE * _period_s(stream) < stream.duration_s for stream in (wheels, imu)):
        return None
    slow_s = max(_period_s(wheels), _period_s(imu), MIN_SIGMA_S)
    n_steps = int(np.ceil(slow_s / _period_s(wheels)))
    wheels_s, wheels_radps, wheels_valid = _low_pass(
        wheels.time_s, (right_mps - left_mps) / track_m, slow_s, n_steps
    )
    kept = np.flatnonzero(wheels_valid)[::n_steps]
    n_steps = max(int(np.ceil(slow_s / _period_s(imu))), MIN_GYRO_STEPS)
    gyro_s, gyro_radps, gyro_valid = _low_pass(imu.time_s, gyro_radps, slow_s, n_steps)
    if kept.size < MIN_SAMPLES or gyro_valid.sum() < MIN_SAMPLES:
        return None
    return YawRatePair(
        wheels_s[kept],
        wheels_radps[kept],
        slow_s,
        float(gyro_s[0]),
        slow_s / n_steps,
        gyro_radps,
        np.gradient(gyro_radps, slow_s / n_steps),
        gyro_valid,
    )


def _period_s(stream: Stream) -> float:
    return float(np.median(np.diff(stream.time_s)))


def _low_pass(time_s: Array, values: Array, sigma_s: float, n_steps: int) -> tuple[Array, Array, Array]:
    """Return an even grid of ``n_steps`` a sigma, the smooth values on it, and where samples support them."""
    finite = np.isfinite(values)
    step_s = sigma_s / n_steps
    grid_s = np.arange(time_s[0], time_s[-1] + 1e-6 * step_s, step_s)
    if finite.sum() < MIN_SAMPLES:
        return grid_s, np.zeros(grid_s.size), np.zeros(grid_s.size, dtype=bool)
    time_s, values = time_s[finite], values[finite]
    after = np.clip(np.searchsorted(time_s, grid_s), 1, time_s.size - 1)
    near = time_s[after] - time_s[after - 1] <= MAX_GAP_SAMPLES * sigma_s
    inside = (grid_s >= time_s[0] - step_s) & (grid_s <= time_s[-1] + step_s)
    supported = binary_erosion(near & inside, iterations=int(EDGE_SIGMAS * n_steps))
    return grid_s, gaussian_filter1d(np.interp(grid_s, time_s, values), n_steps, mode="nearest"), supported


def imu_time_s(pair: YawRatePair, centre_s: float, shift_s: float, rate: float) -> Array:
    """Return the times (n,) on the clock of the IMU of what the wheels show."""
    return pair.time_s + shift_s + rate * (pair.time_s - centre_s)


def gyro_at(pair: YawRatePair, imu_s: Array, grid: Array) -> tuple[Array, Array]:
    """Return what is on the grid of the gyro at some times of the IMU, and where there is anything."""
    place = (imu_s - pair.gyro_start_s) / pair.gyro_step_s
    before = np.clip(place.astype(np.intp), 0, grid.size - 2)
    part = place - before
    there = (part >= 0.0) & (part <= 1.0) & pair.gyro_valid[before] & pair.gyro_valid[before + 1]
    return grid[before] * (1.0 - part) + grid[before + 1] * part, there


def correlation_of(pair: YawRatePair, imu_s: Array) -> float:
    """Return the correlation of gyro and wheels, NaN where less than half of the run overlaps."""
    gyro, there = gyro_at(pair, imu_s, pair.gyro_radps)
    if there.sum() < max(MIN_SAMPLES, 0.5 * there.size):
        return np.nan
    gyro = gyro[there] - np.mean(gyro[there])
    wheels = pair.wheels_radps[there] - np.mean(pair.wheels_radps[there])
    power = float(np.sqrt((gyro @ gyro) * (wheels @ wheels)))
    return float(gyro @ wheels) / power if power > 0.0 else np.nan
