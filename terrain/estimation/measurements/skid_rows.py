"""Two rows of a skid-steer robot beyond its table: the gyro's mean since the last tick, and standing still.

Wheels at 6 Hz leave 15 samples of a gyro at 100 Hz between two ticks.  One of them is the yaw rate with all
of its vibration; their mean is what the heading changed by.  So the row is the integral of what
:mod:`~terrain.estimation.measurements.sample_hold` accepts, straight from sample to sample, over its time;
and where no sample came since, the value held.

At rest the yaw rate is zero, and a gyro reads its bias.  Rest is wheels that stand for :data:`REST_S` and a
gyro that is steady all the while: that of a robot that slides, or is towed with its wheels held, is not.  The
mean over all of that time is a row once, so that a turn that just begins is a small part of it.

The compiled steps serve a whole log and the live chain alike.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
from numba import float64, njit

from terrain.estimation.measurements.cleaning import clean_stream
from terrain.estimation.measurements.resampling import median_step_s
from terrain.estimation.measurements.sample_hold import (
    LEAPS,
    LIMITS,
    N_LINE,
    TICK_S,
    at_tick,
    limits_of,
    take,
)
from terrain.estimation.measurements.table import MeasurementTable
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import Array, RunLog
from terrain.robots import Robot

WHEELS_AND_GYRO = ("wheel_left_mps", "wheel_right_mps", "gyro_z_radps")
"""Rows of the table that a skid filter takes."""

REST_ROW = "rest_gyro_radps"
"""The row that rest gives: the mean of the gyro over the last second at rest, once a second; else NaN."""

REST_S = 1.0
"""So long wheels and gyro have to be steady: a robot that stops still rocks for half of it."""

STANDING_MPS = 0.01
"""Wheel circumferential speed below which a side stands: a few steps of an encoder in a sample."""

STEADY_RADPS = 0.02
"""Largest range of a gyro that is at rest.  Measured at rest its samples scatter by 0.002 rad/s (Husky on
snow); an engine or wind that shakes the robot by more makes it unknown whether it rests."""

MAX_READING_RADPS = 0.1
"""No gyro has a larger bias: a robot on a turntable is not at rest."""

_GAP, _INSTANT, _SMOOTH = LIMITS.index("gap_s"), 1, 3  # columns of limits and of a line
_SINCE, _LOWEST, _HIGHEST, _SUM, _N = range(5)
_ANGLE, _TIME = range(2)


def gyro_memory() -> tuple[Array, Array]:
    """Return the line (1, 8) and the sums (2,) of :func:`take_gyro` before the first sample."""
    return np.full((1, N_LINE), np.nan), np.zeros(2)


def gyro_limits(time_constant_s: float, period_s: float, tick_s: float) -> Array:
    """Return the limits (1, 6) of the gyro's row: low-pass, period of the sensor and of the wheels."""
    return limits_of(time_constant_s, period_s, tick_s, LEAPS["gyro_z_radps"])[None]


@njit(cache=True, error_model="numpy")
def take_gyro(
    gyro_radps: float, instant_s: float, came_s: float, line: Array, sums: Array, limits: Array
) -> bool:
    """Add a sample to the angle and the time of ``sums``; return True, and do not, where it leapt."""
    before_s, before_radps = line[0, _INSTANT], line[0, _SMOOTH]
    if take(0, gyro_radps, instant_s, came_s, line, limits):
        return True
    step_s = line[0, _INSTANT] - before_s
    if 0.0 < step_s <= limits[0, _GAP]:
        sums[_ANGLE] += 0.5 * (before_radps + line[0, _SMOOTH]) * step_s
        sums[_TIME] += step_s
    return False


@njit(cache=True, error_model="numpy")
def gyro_at(time_s: float, line: Array, sums: Array, limits: Array) -> float:
    """Return the mean since the last tick, or the value held; NaN where the last sample is too old."""
    held = at_tick(0, time_s, line, limits)
    mean = sums[_ANGLE] / sums[_TIME] if sums[_TIME] > 0.0 else held
    sums[:] = 0.0
    return float(np.nan if math.isnan(held) else mean)


def rest_memory() -> Array:
    """Return the memory (5,) of :func:`rest_at` before the first sample."""
    return np.full(5, np.nan)


@njit(float64(float64, float64, float64, float64, float64[::1]), cache=True)
def rest_at(time_s: float, left_mps: float, right_mps: float, gyro_radps: float, memory: Array) -> float:
    """Return the mean of the gyro over the last :data:`REST_S` at rest, once for each such time; else NaN.

    Parameters
    ----------
    time_s : increasing; a stamp that was set back starts anew
    left_mps, right_mps, gyro_radps : measurements, NaN where there is none
    memory : (5,) of :func:`rest_memory`, which is moved
    """
    stands = abs(left_mps) < STANDING_MPS and abs(right_mps) < STANDING_MPS
    if not (stands and abs(gyro_radps) < MAX_READING_RADPS):
        memory[:] = np.nan
        return np.nan
    lowest, highest = min(memory[_LOWEST], gyro_radps), max(memory[_HIGHEST], gyro_radps)
    if not (highest - lowest <= STEADY_RADPS and time_s > memory[_SINCE]):
        memory[:] = time_s, gyro_radps, gyro_radps, gyro_radps, 1.0
        return np.nan
    memory[_LOWEST], memory[_HIGHEST] = lowest, highest
    memory[_SUM] += gyro_radps
    memory[_N] += 1.0
    if time_s - memory[_SINCE] < REST_S - TICK_S:
        return np.nan
    mean_radps = float(memory[_SUM] / memory[_N])
    memory[_SINCE], memory[_SUM], memory[_N] = time_s, 0.0, 0.0
    return mean_radps


def with_skid_rows(
    table: MeasurementTable, run: RunLog, robot: Robot, time_constant_s: float | None = None
) -> MeasurementTable:
    """Return the measurements of a skid-steer robot with the gyro's mean and the row of rest.

    Parameters
    ----------
    table : with the rows of the robot's drive
    run, robot : what it was made of
    time_constant_s : of the low-pass on the gyro; that of the encoders by default

    Returns
    -------
    MeasurementTable
        ``gyro_z_radps`` the mean since the last tick, and a last row :data:`REST_ROW`.
    """
    z = np.array(table.z)
    imu = clean_stream(run, "imu", IMU_CHANNELS, Counter(), frozen=IMU_CHANNELS[:6])
    if imu is not None:
        sensors = robot.completed.sensors
        lag_s = robot.encoder_lag_s if time_constant_s is None else time_constant_s
        limits = gyro_limits(lag_s, median_step_s(imu.time_s), median_step_s(table.time_s))
        gyro_radps = imu.channel("gyro_z_radps") - sensors.gyro_bias_z_radps
        instant_s = imu.time_s - sensors.imu_latency_s
        z[:, table.rows.index("gyro_z_radps")] = _gyro_means(table.time_s, instant_s, gyro_radps, limits)
    rest = _rest(table.time_s, z[:, [table.rows.index(row) for row in WHEELS_AND_GYRO]])
    return replace(table, rows=(*table.rows, REST_ROW), z=np.column_stack([z, rest]))


@njit(cache=True, error_model="numpy")
def _gyro_means(clock: Array, instant_s: Array, gyro_radps: Array, limits: Array) -> Array:
    """Return the row (n,) at each tick."""
    line, sums = np.full((1, N_LINE), np.nan), np.zeros(2)
    out, k = np.empty(clock.size), 0
    for n in range(clock.size):
        while k < instant_s.size and instant_s[k] <= clock[n] + TICK_S:
            take_gyro(gyro_radps[k], instant_s[k], instant_s[k], line, sums, limits)
            k += 1
        out[n] = gyro_at(clock[n], line, sums, limits)
    return out


@njit(cache=True)
def _rest(time_s: Array, wheels_and_gyro: Array) -> Array:
    memory, out = np.full(5, np.nan), np.empty(time_s.size)
    for n in range(time_s.size):
        left_mps, right_mps, gyro_radps = wheels_and_gyro[n]
        out[n] = rest_at(time_s[n], left_mps, right_mps, gyro_radps, memory)
    return out
