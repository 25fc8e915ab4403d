"""One row of measurements from sample to tick: leaps left out, a low-pass, the value held until it is old.

The same compiled steps serve a whole log (``batch``, ``resampling``) and the live chain
(:mod:`terrain.estimation.live.rows`).  A row has a line of ``lines`` as its memory and a line of ``limits``
with what is constant.  With x the samples and m the slope between two of them, dt apart, the low-pass is
``tau y' + y = x``, exact for an input that is straight from sample to sample: with ``a = exp(-dt/tau)``::

    y_1 = x_1 - tau m + a (y_0 - x_0 + tau m)

so that a ramp is delayed by tau at any rate.  (The usual ``y_1 = a y_0 + (1 - a) x_1`` falls short of it by
half a step: 10 ms at 50 Hz.)
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.records import Array

TICK_S = 1e-9
"""Stamps that differ by less are the same instant, rounded differently by two clocks."""

MAX_AGE_PERIODS = 1.5
"""A value is held until the next one is due and half a period more, of the slower of sensor and clock."""

GAP_PERIODS = 5.5
"""After a longer gap the low-pass starts anew: its memory is not the recent past of the next sample.  Steps
are whole periods, so that half of one between two of them leaves nothing to how stamps are rounded, nor to
whether the period is that of a description (live) or the median of a log (batch)."""

BELIEVED_S = 0.1
"""A value that has leapt and stays is accepted after this long: it is left to the filter's gate."""

PASSING, LATCHED, BRIDGED = 0.0, 1.0, 2.0
"""What becomes of a value that leapt: it is accepted after a while; it is left out until it leaps back, as a
speed over ground cannot have leapt; its leap is taken off, as a heading counts from anywhere."""

LEAPS: dict[str, tuple[float, float, float]] = {
    "accel_x_mps2": (20.0, 1000.0, PASSING),
    "accel_y_mps2": (20.0, 1000.0, PASSING),
    "gyro_z_radps": (0.5, 20.0, PASSING),
    "imu_yaw_rad": (0.1, 4.0, PASSING),
    **dict.fromkeys((f"steer_{i}_rad" for i in (1, 2, 3)), (0.1, 5.0, PASSING)),
    "camera_speed_x_mps": (0.1, 5.0, LATCHED),
    "camera_speed_y_mps": (0.1, 5.0, LATCHED),
    "camera_yaw_rate_radps": (0.2, 20.0, PASSING),
    "camera_yaw_rad": (0.1, 4.0, BRIDGED),
}
"""Largest change of a row between two samples: noise, and a second what a robot can do: half a g of speed,
two thirds of a turn, twice the fastest steering; an accelerometer on rough terrain sees several g.  Then
what becomes of a value that leapt."""

NO_LEAP = (math.inf, math.inf, PASSING)
"""Of a row whose changes are not judged."""

LIMITS = ("time_constant_s", "gap_s", "age_s", "once", "leap", "leap_per_s", "fate")
"""Columns of ``limits``: low-pass, longest step, oldest value, whether a sample is given at one tick only,
the largest change between two samples, a constant and a part per second, and what becomes of a leap."""

N_LINE = 13
"""Columns of ``lines``: value, instant, arrival and low-pass output of the last sample, whether it was given
at a tick, value and instant that leaps are judged against, since when values have been leaping, and of a
row that is not passing the last sample, taken or not, its instant, the sum of its leaps, since
when that is not 0, and whether a sample before it is known to be right."""

_TAU, _GAP, _AGE, _ONCE, _LEAP, _LEAP_PER_S, _FATE = range(len(LIMITS))
_VALUE, _INSTANT, CAME, _SMOOTH, _GIVEN, _LAST, _LAST_INSTANT, SINCE = range(8)
RAW, _RAW_INSTANT, LEAPT_BY, LEAPT_SINCE, _FOLLOWED = range(8, N_LINE)


def limits_of(
    time_constant_s: float, period_s: float, tick_s: float, leap: tuple[float, float, float] = NO_LEAP
) -> Array:
    """Return the limits (7,) of a row: columns :data:`LIMITS`.

    Parameters
    ----------
    time_constant_s : of its low-pass; 0 for none
    period_s, tick_s : of its sensor, and of the clock
    leap : largest change between two samples: a constant, a part per second, and what becomes of a leap
    """
    age_s = MAX_AGE_PERIODS * np.fmax(period_s, tick_s)
    once = period_s > MAX_AGE_PERIODS * tick_s + TICK_S
    return np.array([time_constant_s, GAP_PERIODS * period_s, age_s, once, *leap])


@njit(cache=True, error_model="numpy")
def low_pass_step(value: float, before: float, smooth: float, step_s: float, time_constant_s: float) -> float:
    """Return y_1 of the equation above: from x_0 = ``before`` and y_0 = ``smooth`` to x_1 = ``value``."""
    lead = time_constant_s * (value - before) / step_s
    return value - lead + math.exp(-step_s / time_constant_s) * (smooth - before + lead)


@njit(cache=True, error_model="numpy")
def leaps(value: float, instant_s: float, line: Array, limit: Array) -> float:
    """Return the sum of a row's leaps: 0 after one that leapt back, and for a latched row after a gap."""
    step_s, change = instant_s - line[_RAW_INSTANT], value - line[RAW]
    line[RAW], line[_RAW_INSTANT] = value, instant_s
    before = line[LEAPT_BY]
    if math.isnan(step_s) or (limit[_FATE] == LATCHED and step_s > limit[_GAP]):
        line[LEAPT_BY], line[_FOLLOWED] = 0.0, 0.0
    else:
        if abs(change) > limit[_LEAP] + limit[_LEAP_PER_S] * step_s and line[_FOLLOWED] > 0.0:
            line[LEAPT_BY] += change  # of the first sample after a gap it was that one that was wrong
            if abs(line[LEAPT_BY]) <= 0.5 * limit[_LEAP]:
                line[LEAPT_BY] = 0.0
        line[_FOLLOWED] = 1.0
    if line[LEAPT_BY] == 0.0:
        line[LEAPT_SINCE] = np.nan
    elif before == 0.0:
        line[LEAPT_SINCE] = instant_s
    return float(line[LEAPT_BY])


@njit(cache=True, error_model="numpy")
def take(row: int, value: float, instant_s: float, came_s: float, lines: Array, limits: Array) -> bool:
    """Put a sample behind the low-pass of its row; return True, and do not, where it leapt."""
    if math.isnan(value):
        return False
    line, limit = lines[row], limits[row]
    if limit[_FATE] != PASSING:
        leapt_by = leaps(value, instant_s, line, limit)
        if limit[_FATE] == LATCHED and leapt_by != 0.0:
            return True
        value -= leapt_by
    elif abs(value - line[_LAST]) > limit[_LEAP] + limit[_LEAP_PER_S] * (instant_s - line[_LAST_INSTANT]):
        if math.isnan(line[SINCE]):
            line[SINCE] = instant_s
        if instant_s - line[SINCE] < BELIEVED_S - TICK_S:
            return True
    line[_LAST], line[_LAST_INSTANT], line[SINCE] = value, instant_s, np.nan
    step_s, smooth = instant_s - line[_INSTANT], value
    if limit[_TAU] > 0.0 and step_s <= limit[_GAP]:
        smooth = low_pass_step(value, line[_VALUE], line[_SMOOTH], step_s, limit[_TAU])
    line[_VALUE], line[_INSTANT], line[CAME], line[_SMOOTH] = value, instant_s, came_s, smooth
    line[_GIVEN] = 0.0
    return False


@njit(cache=True, error_model="numpy")
def at_tick(row: int, time_s: float, lines: Array, limits: Array) -> float:
    """Return a row's value at a tick, the low-pass run on to it; NaN where too old or given before.

    From the sample to the tick its input is held, and the held value adds no delay: the tick's value is the
    sample's plus what the low-pass is still behind it, ``(y - x) exp(-dt/tau)``.
    """
    line, limit = lines[row], limits[row]
    given = limit[_ONCE] > 0.0 and line[_GIVEN] > 0.0
    line[_GIVEN] = 1.0
    if given or not time_s - line[CAME] <= limit[_AGE] + TICK_S:
        return np.nan
    behind = line[_SMOOTH] - line[_VALUE]
    if limit[_TAU] > 0.0:
        behind *= math.exp((line[_INSTANT] - time_s) / limit[_TAU])
    return float(line[_VALUE] + behind)
