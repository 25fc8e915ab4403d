"""The compiled part of live estimation: from samples that just came to the rows of one tick.

A queue a stream holds what came and is not due.  Cleaning is that of a whole log where it need not look
ahead; from a sample to the rows the steps are the very same ones (``measurements.samples``, ``yaw``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64, njit, types, void

from terrain.errors import ConfigError
from terrain.estimation.measurements.cleaning import MIN_CONFIDENCE_RATIO, OFF_CLOCK_S
from terrain.estimation.measurements.derived import is_moving
from terrain.estimation.measurements.sample_hold import TICK_S
from terrain.estimation.measurements.samples import (
    IMU,
    LEAPT,
    NO_ROTATION,
    ODOMETRY,
    STEER,
    STREAMS,
    limits_of_rows,
    rows_at_tick,
    take_sample,
    wheel_rates,
)
from terrain.estimation.measurements.yaw import average_yaw, refer_yaw
from terrain.estimation.wheel_slip import UNMEASURED_AFTER_S
from terrain.records import Array
from terrain.robots import Robot

KINDS = (
    "stamp does not increase",
    "off the clock",
    "not finite",
    "frozen",
    "low confidence",
    "no rotation",
    "leap",
    "waited too long",
)
"""What is counted of each stream."""

WHEEL_KINDS = ("not finite", "beyond the motors")
"""What is counted of the wheels."""

GNSS_PERIOD_S = 0.1
"""Between two positions; no robot's description tells it."""

QUEUE = 1024
"""Samples of a stream that wait for the wheels; five seconds of a camera."""

_STAMP, _OFF_CLOCK, _NOT_FINITE, _FROZEN, _LOW_CONFIDENCE, _NO_ROTATION, _LEAP, _WAITED = range(len(KINDS))
_STAMP_COLUMN, _FINITE_COLUMN, _FIRST_COLUMN = 0, 1, 2  # of a queue

_V, _M, _I, _IM = float64[::1], float64[:, ::1], int64[::1], int64[:, ::1]
_VECTOR_IN = types.Array(float64, 1, "A", readonly=True)
_MATRIX_IN = types.Array(float64, 2, "A", readonly=True)


class RowArrays(NamedTuple):
    """What :func:`rows_at` is given beside the time.

    Parameters
    ----------
    motor_radps : (3,) of the sample of the wheels
    steering, imu, odometry, gnss : queues
    n_queued, last_s, latency_s : by stream
    params, limits : of the robot
    before to received_s : what is remembered of the samples
    z, gnss_variance, unmeasured : what is written
    counts, wheel_counts : of what was left out
    """

    motor_radps: Array
    steering: Array
    imu: Array
    odometry: Array
    gnss: Array
    n_queued: Array
    last_s: Array
    latency_s: Array
    params: Array
    limits: Array
    before: Array
    turns: Array
    lines: Array
    yaw: Array
    gnss_memory: Array
    derived: Array
    frozen: Array
    received_s: Array
    z: Array
    gnss_variance: Array
    unmeasured: Array
    counts: Array
    wheel_counts: Array


ROW_ARRAYS = types.NamedTuple(
    (
        *(_V, _M, _M, _M, _M, _I, _V, _V, _V, _M),
        *(_M, _M, _M, _V, _V, _V, float64[:, :, ::1], _M, _V, _V, boolean[::1], _IM, _I),
    ),
    RowArrays,
)
"""Their type in compiled code."""

_inline = njit(cache=True, error_model="numpy")


@_inline
def drop_first(queue: Array, n_gone: int, n: int) -> None:
    """Move the samples of a queue up over those that are gone."""
    for k in range(n_gone, n):
        for c in range(queue.shape[1]):
            queue[k - n_gone, c] = queue[k, c]


@njit(
    void(int64, _VECTOR_IN, _MATRIX_IN, _I, _M, _I, _V, _IM),
    cache=True,
    error_model="numpy",
)
def push(
    stream: int,
    time_s: Array,
    values: Array,
    columns: Array,
    queue: Array,
    n_queued: Array,
    last_s: Array,
    counts: Array,
) -> None:
    """Queue samples by stamp; of two that are not in order the one goes that makes the others so.

    ``columns`` says where each channel stands in ``values``, -1 where it does not; a queue holds the stamp,
    whether all channels that are there are finite, and the channels, infinite ones as NaN.
    """
    for k in range(time_s.size):
        n, stamp_s = n_queued[stream], time_s[k]
        before_s = queue[n - 1, _STAMP_COLUMN] if n > 0 else last_s[stream]
        if not (math.isfinite(stamp_s) and stamp_s > before_s):
            counts[stream, _STAMP] += 1
            earlier_s = queue[n - 2, _STAMP_COLUMN] if n > 1 else last_s[stream]
            if n == 0 or stamp_s == before_s or not stamp_s > earlier_s or stamp_s == np.inf:
                continue
            n -= 1  # the one before was the one ahead
        if n == queue.shape[0]:
            half = n // 2
            counts[stream, _WAITED] += half
            drop_first(queue, half, n)
            n -= half
        finite = True
        for c in range(columns.size):
            value = values[k, columns[c]] if columns[c] >= 0 else np.nan
            finite &= columns[c] < 0 or math.isfinite(value)
            queue[n, _FIRST_COLUMN + c] = value if math.isfinite(value) else np.nan
        queue[n, _STAMP_COLUMN], queue[n, _FINITE_COLUMN] = stamp_s, finite
        counts[stream, _NOT_FINITE] += not finite
        n_queued[stream] = n + 1


@_inline
def _repeats(sample: Array, first: int, last: int, before: Array) -> bool:
    """Say whether channels are those of the sample before to the last bit, and keep them."""
    same, n_known = True, 0
    for c in range(first, last):
        value = sample[_FIRST_COLUMN + c]
        if not math.isnan(value):
            n_known += 1
            same &= value == before[c]
        before[c] = value
    return same and n_known > 0


@_inline
def refused_as(stream: int, stamped: Array, before: Array) -> int:
    """Return why a sample of a camera or IMU is left out, as a place in :data:`KINDS`; -1 where it is not."""
    complete = stamped[_FINITE_COLUMN] > 0.0
    if stream == IMU and complete and _repeats(stamped, 0, 6, before[0]):
        return _FROZEN
    if stream == ODOMETRY and complete and _repeats(stamped, 3, 13, before[1]):
        return _FROZEN
    if stream == ODOMETRY and stamped[_FIRST_COLUMN + 13] < MIN_CONFIDENCE_RATIO:
        return _LOW_CONFIDENCE
    return -1


@njit(void(float64, boolean, ROW_ARRAYS), cache=True, error_model="numpy")
def rows_at(time_s: float, set_back: bool, rows: RowArrays) -> None:
    """Take from the queues what came by a tick of the wheels; write its rows z (29,) and variances (4,).

    ``set_back`` says that the clock was: what is remembered of its other time is forgotten.  ``unmeasured``
    (3,) tells the wheels of which rate or angle was not measured for too long.
    """
    params, lines, derived, frozen, z = rows.params, rows.lines, rows.derived, rows.frozen, rows.z
    n_queued, last_s, received_s, counts = rows.n_queued, rows.last_s, rows.received_s, rows.counts
    if set_back:
        n_queued[:] = 0
        last_s[:] = -np.inf
        lines[:] = np.nan
        rows.before[:] = np.nan
        derived[:] = np.nan
        frozen[:, 1] = 0.0
        received_s[:] = -np.inf
    for stream in range(4):
        queue = (rows.steering, rows.imu, rows.odometry, rows.gnss)[stream]
        n, n_due = n_queued[stream], 0
        while n_due < n and queue[n_due, _STAMP_COLUMN] <= time_s + TICK_S:
            stamped, sample = queue[n_due], queue[n_due, _FIRST_COLUMN:]
            n_due += 1
            came_s = stamped[_STAMP_COLUMN]
            last_s[stream] = came_s
            refused = refused_as(stream, stamped, rows.before)
            if refused >= 0:
                counts[stream, refused] += 1
                if refused == _FROZEN:
                    frozen[stream - IMU, 1] += 1.0
                continue
            instant_s = came_s - rows.latency_s[stream]
            stamps_s, moved = (instant_s, came_s), (rows.gnss_memory, derived, frozen)
            fate = take_sample(stream, sample, stamps_s, params, rows.turns, lines, rows.limits, moved)
            counts[stream, _LEAP] += fate == LEAPT
            counts[stream, _NO_ROTATION] += fate == NO_ROTATION
        while n > n_due and queue[n - 1, _STAMP_COLUMN] > time_s + OFF_CLOCK_S:
            counts[stream, _OFF_CLOCK] += 1
            n -= 1
        drop_first(queue, n_due, n)
        n_queued[stream] = n - n_due

    finite, beyond = wheel_rates(rows.motor_radps, params, is_moving(derived), frozen, z)
    rows.wheel_counts[0] += not finite
    rows.wheel_counts[1] += beyond
    rows_at_tick(time_s, lines, rows.limits, rows.gnss_memory, params, derived, z, rows.gnss_variance)
    for i in range(3):
        rows.unmeasured[i] = False
        for k, row in enumerate((i, STEER + i)):
            if not math.isnan(z[row]):
                received_s[k, i] = time_s
            rows.unmeasured[i] |= time_s - received_s[k, i] > UNMEASURED_AFTER_S
    average_yaw(time_s, z, params, rows.yaw)
    refer_yaw(time_s, z, params, rows.yaw)


def described_limits(robot: Robot) -> Array:
    """Return the limits (29, 7) of the rows, by the described periods."""
    sensors = robot.sensors
    lag_s = dict.fromkeys(STREAMS, sensors.encoder_time_constant_s)
    period_s = {
        "imu": 1.0 / sensors.imu_rate_hz,
        "steering": 1.0 / sensors.steering_rate_hz,
        "gnss": GNSS_PERIOD_S,
    }
    if robot.describes("camera"):
        lag_s["odometry"] = max(sensors.encoder_time_constant_s - robot.camera.time_constant_s, 0.0)
        period_s["odometry"] = 1.0 / robot.camera.rate_hz
    return limits_of_rows(lag_s, period_s, 1.0 / sensors.wheels_rate_hz)


def counts_by_kind(wheel_counts: Array, counts: Array) -> dict[str, int]:
    """Return what was counted of the wheels (2,) and of the streams (4, 8), by stream and kind."""
    rows = [("wheels", WHEEL_KINDS, wheel_counts), *zip(STREAMS, [KINDS] * len(counts), counts, strict=True)]
    return {
        f"{name}: {kind}": n for name, kinds, row in rows for kind, n in zip(kinds, row.tolist(), strict=True)
    }


def check_numbers(initial_yaw_rad: float, gnss_latency_s: float) -> None:
    """Refuse a heading or a latency that is none; ``ConfigError``."""
    for name, value in (("initial_yaw_rad", initial_yaw_rad), ("gnss_latency_s", gnss_latency_s)):
        if not math.isfinite(value):
            raise ConfigError(f"{name} is {value}, a finite number is required")
    if gnss_latency_s < 0:
        raise ConfigError(f"gnss_latency_s is {gnss_latency_s:g}, a time from zero up is required")


def places_among(names: Sequence[str], among: Sequence[str]) -> Array:
    """Return the place of each name among others, -1 where it is not there."""
    return np.array([among.index(name) if name in among else -1 for name in names])
