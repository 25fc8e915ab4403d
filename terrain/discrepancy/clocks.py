"""Delay of the logger of IMU and camera behind that of the wheels, run by run.

Each of its channels is compared with the shifted prediction from the wheel speeds.  The search is bounded,
because a free one locks on to mirror images of the manoeuvres; gain and offset are free, because they may be
wrong.  The rate between the two clocks is common to all runs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.interpolate import CubicSpline

from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.residuals import Rows
from terrain.effects import CHANNELS, GYRO, HEADING, SPEED_X
from terrain.errors import DataError
from terrain.records import Array

MIN_LAG_S, MAX_LAG_S = -1.0, 2.0
"""Loggers of a run are started together, the wheels' first.  The other sign is that of wheels that are late:
they are averaged, sent a few times a second, held, and queued, which adds up to less than a second."""

FAR_LAG_S = 10.0
"""Bound of a second search that only finds that a clock is out of reach, in runs of twice that length."""

LAG_STEP_S = 0.1
"""Of the coarse search: what a robot does takes longer."""

LAGS_S = np.arange(MIN_LAG_S, MAX_LAG_S + 1e-9, LAG_STEP_S)

RATES = (0.0, -0.01, 0.01, -0.02, 0.02)
"""Of the coarse search, up to the bounds of ``clock_rate``."""

CLEAR_CORRELATION = 0.9
"""Where half of the channels reach it, no other rate is tried: least squares finds it from there."""

RATE_STEP = 0.002
"""Rates that differ by less are one to the coarse search."""

FINE_S = 0.02
"""Grid on which what is expected is laid out; straight lines between."""

CLOCKED = (GYRO, SPEED_X, HEADING)
"""Channels that measure the clock: the tilt of the accelerometer is on its own clock, and the lateral motion
of a skid-steer robot is in none of its wheels."""

MIN_EXCITATION = 0.02
"""Standard deviation (rad/s, m/s) of the prediction, below which a channel measures no clock."""

MIN_CORRELATION = 0.7
"""Least correlation at the best shift."""

RIVAL_MARGIN, RIVAL_FLOOR = 0.15, 0.02
"""A peak elsewhere is no rival if it leaves so much more of the variance, relative and absolute."""

SAME_PEAK_S = 0.5
"""Two shifts closer than this are of one peak."""

MAX_STD_S = 0.1
"""Largest standard deviation of a clock that is used."""

MEMORY_S = 2.0
"""Assumed correlation time of the residual."""

MAX_STEPS, CONVERGED_S = 12, 0.003
"""Of least squares."""

EVENT_S, EVENT_RATIO = 3.0, 0.7
"""A clock is not used if that ratio of its information comes from so short a time: from one event."""

FURTHEST = 1.5
"""A rate is refused that is so many times out of the bounds."""

MIN_ROWS = 30


class Shift(NamedTuple):
    """How far what IMU and camera saw is behind the wheels.

    Parameters
    ----------
    lag_s, std_s : (runs, len(CLOCKED)) at the middle of each run; NaN where a channel measures none
    rate : common to all runs
    lost : (runs,) whether nothing fits within the search, and something well out of it
    """

    lag_s: Array
    std_s: Array
    rate: float
    lost: Array


class _Pair(NamedTuple):
    """A channel of a run beside what is expected of it: rows, and a fine grid with values and slopes."""

    time_s: Array
    measured: Array
    expected: Array
    slope: Array


_Pairs = dict[tuple[int, int], _Pair]
"""By run and place in CLOCKED."""


class _Fit(NamedTuple):
    """Lag at the middle of a run and rate, with their covariance (2, 2)."""

    lag_s: float
    rate: float
    cov: Array


def shifts_of(info: Evidence) -> Shift:
    """Return the shifts of all runs.

    Raises
    ------
    DataError
        if most runs fit well beyond the search, and nowhere within it.
    """
    n = len(info.rows)
    pairs = {(i, c): pair for i, run in enumerate(info.rows) for c, pair in _pairs(run).items()}
    searched, tables = _search_rates(pairs, RATES)
    fits = _fit_lags(pairs, tables, searched)
    rate = _shared_rate(fits)
    if abs(rate - searched) > RATE_STEP:
        _, tables = _search_rates(pairs, (rate,))
        fits = _fit_lags(pairs, tables, rate)
        rate = _shared_rate(fits)
    lag_s, std_s = np.full((2, n, len(CLOCKED)), np.nan)
    for at, free in fits.items():
        fit: _Fit | None = free
        if abs(free.rate - rate) * 0.5 * pairs[at].time_s[-1] > LAG_STEP_S:
            fit = _refine_lag(pairs[at], float(LAGS_S[np.argmax(tables[at])]), rate, rate_stays=True)
        if fit is not None:
            follow = fit.cov[0, 1] / fit.cov[1, 1]  # of the lag, as the rate goes to that of all
            std = math.sqrt(max(fit.cov[0, 0] - follow * fit.cov[0, 1], 1e-12))
            if std < MAX_STD_S:
                lag_s[at], std_s[at] = fit.lag_s + follow * (rate - fit.rate), std
    beyond = np.zeros((n, len(CLOCKED)), dtype=bool)
    for at, column in tables.items():
        beyond[at] = column.max() < MIN_CORRELATION and _fits_further(pairs[at], float(column.max()))
    lost = beyond.any(axis=1) & ~np.isfinite(lag_s).any(axis=1)
    if 2 * lost.sum() > len({i for i, _ in pairs}):
        raise DataError(
            f"runs: unsynchronised clocks beyond the search in {lost.sum()} of {n}, IMU and camera are not "
            f"{MIN_LAG_S:g} to {MAX_LAG_S:g} s behind the wheels"
        )
    return Shift(lag_s, std_s, rate, lost)


def offsets_of(shift: Shift) -> tuple[Array, Array]:
    """Return the clock (runs,) of each run and its standard deviation, NaN where no channel measures it.

    It is the least lag of its channels and of those that agree with it: any of them may be late by itself.
    """
    n = len(shift.lag_s)
    offset_s, std_s = np.full((2, n), np.nan)
    for i in range(n):
        known = np.isfinite(shift.lag_s[i])
        if known.any():
            lag_s, error_s = shift.lag_s[i][known], shift.std_s[i][known]
            least = int(np.argmin(lag_s))
            near = lag_s - lag_s[least] < 3.0 * np.hypot(error_s, error_s[least]) + FINE_S
            weight = 1.0 / error_s[near] ** 2
            offset_s[i] = np.average(lag_s[near], weights=weight)
            std_s[i] = np.sqrt(1.0 / weight.sum())
    return offset_s, std_s


def _pairs(run: Rows) -> dict[int, _Pair]:
    """Return the channels that are measured and of which something is expected, by their place in CLOCKED."""
    compared = {}
    for c, name in enumerate(CLOCKED):
        measured, expected = (values[:, CHANNELS.index(name)] for values in (run.measured, run.predicted))
        known = np.isfinite(measured)
        if 2 * known.sum() > max(known.size, MIN_ROWS) and np.std(expected[known]) > MIN_EXCITATION:
            compared[c] = measured, expected
    if not compared:
        return {}
    fine_s = np.arange(run.time_s[0], run.time_s[-1], FINE_S)
    curve = CubicSpline(run.time_s, np.column_stack([expected for _, expected in compared.values()]))
    values, slopes = np.asarray(curve(fine_s)).T.copy(), np.asarray(curve(fine_s, 1)).T.copy()
    time_s = run.time_s - run.time_s[0]
    return {
        c: _Pair(time_s, np.ascontiguousarray(measured), values[k], slopes[k])
        for k, (c, (measured, _)) in enumerate(compared.items())
    }


def _search_rates(pairs: _Pairs, rates: Sequence[float]) -> tuple[float, dict[tuple[int, int], Array]]:
    """Return the rate that fits all best, and under it the correlations (lags,) of each."""
    rate, least = 0.0, np.inf
    best: dict[tuple[int, int], Array] = {}
    for tried in rates:
        found = {at: _correlations(pair, LAGS_S, tried) for at, pair in pairs.items()}
        peaks = np.array([min(max(column.max(), 0.0), 0.9999) for column in found.values()])
        loss = float(np.log1p(-(peaks**2)).sum())  # minus a log-likelihood, gains and constants free
        if loss < least:
            rate, least, best = tried, loss, found
        if not pairs or np.median(peaks) > CLEAR_CORRELATION:
            break
    return rate, best


def _fit_lags(
    pairs: _Pairs, tables: dict[tuple[int, int], Array], rate: float
) -> dict[tuple[int, int], _Fit]:
    """Return the fits from the best lags, of the channels that have one best."""
    fits = {}
    for at, column in tables.items():
        best = int(np.argmax(column))
        if column[best] > MIN_CORRELATION and not _has_rival(column, best):
            fit = _refine_lag(pairs[at], float(LAGS_S[best]), rate)
            if fit is not None:
                fits[at] = fit
    return fits


def _shared_rate(fits: dict[tuple[int, int], _Fit]) -> float:
    """Return the median of the rates, weighted by their information."""
    if not fits:
        return 0.0
    rates = sorted((fit.rate, 1.0 / float(fit.cov[1, 1])) for fit in fits.values())
    total = np.cumsum([weight for _, weight in rates])
    return rates[int(np.searchsorted(total, 0.5 * total[-1]))][0]


def _correlations(pair: _Pair, lags_s: Array, rate: float) -> Array:
    return np.asarray(correlations(pair.time_s, pair.measured, pair.expected, FINE_S, lags_s, rate))


@njit(cache=True)
def correlations(
    time_s: Array, measured: Array, expected: Array, step_s: float, lags_s: Array, rate: float
) -> Array:
    """Return the correlation (lags,) of a signal with one on a fine grid, shifted; 0 where few samples meet.

    The signal at ``t`` is compared with the prediction at ``t - lag - rate (t - middle)``.
    """
    out = np.zeros(lags_s.size)
    known = np.isfinite(measured)
    n, middle_s = known.sum(), 0.5 * time_s[-1]
    for a in range(lags_s.size):
        met = 0
        x, y, xx, yy, xy = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(time_s.size):
            at = (time_s[k] - lags_s[a] - rate * (time_s[k] - middle_s)) / step_s
            if not known[k] or at < 0.0 or at >= expected.size - 1:
                continue
            i = int(at)
            value = expected[i] + (at - i) * (expected[i + 1] - expected[i])
            met += 1
            x += value
            y += measured[k]
            xx += value * value
            yy += measured[k] * measured[k]
            xy += value * measured[k]
        if met < 10 or 2 * met < n:
            continue
        power = (xx - x * x / met) * (yy - y * y / met)
        if power > 1e-20:
            out[a] = (xy - x * y / met) / math.sqrt(power)
    return out


def _fits_further(pair: _Pair, best: float) -> bool:
    """Whether a channel that fits at no shift within the search fits well at one beyond it."""
    if pair.time_s[-1] < 2 * FAR_LAG_S:
        return False
    lags_s = np.arange(-FAR_LAG_S, FAR_LAG_S + 1e-9, LAG_STEP_S)
    beyond = float(_correlations(pair, lags_s, 0.0).max())
    return beyond > MIN_CORRELATION and beyond > best + 0.15


def _has_rival(column: Array, best: int) -> bool:
    """Whether a peak elsewhere explains nearly as much."""
    left = 1.0 - np.clip(column, 0.0, 1.0) ** 2
    rises = np.diff(column) >= 0
    top = np.append(True, rises) & np.append(~rises, True)
    elsewhere = top & (np.abs(LAGS_S - LAGS_S[best]) > SAME_PEAK_S)
    return bool((left[elsewhere] < (1 + RIVAL_MARGIN) * left[best] + RIVAL_FLOOR).any())


def _refine_lag(pair: _Pair, lag_s: float, rate: float, rate_stays: bool = False) -> _Fit | None:
    """Return lag and rate, or the lag alone, by least squares from a start, or None if they diverge.

    Gain and constant are fitted beside them.  The covariance is ``(J'J)^-1 J'R J (J'J)^-1`` with the
    autocovariance ``R`` of what is left, tapered.
    """
    start_s, centred_s = lag_s, pair.time_s - 0.5 * pair.time_s[-1]
    fine_s = FINE_S * np.arange(pair.expected.size)
    for _ in range(MAX_STEPS):
        at_s = pair.time_s - lag_s - rate * centred_s
        use = np.isfinite(pair.measured) & (at_s > 0.0) & (at_s < fine_s[-1])
        if use.sum() < MIN_ROWS:
            return None
        value, seen = np.interp(at_s[use], fine_s, pair.expected), pair.measured[use]
        level = value - value.mean()
        gain = float(level @ seen) / max(float(level @ level), 1e-12)
        late = -gain * np.interp(at_s[use], fine_s, pair.slope)
        j = np.array([late, late * centred_s[use], value, np.ones(value.size)])
        if rate_stays:
            j[1] = centred_s[use]  # a drift, in its place
        size = np.sqrt((j * j).sum(axis=1))
        if not gain > 0 or not size.min() > 1e-9:
            return None
        j /= size[:, None]
        gram = j @ j.T
        if not np.linalg.det(gram) > 1e-9:
            return None
        off = seen - gain * value
        step = np.linalg.solve(gram, j @ off)
        left = off - step @ j
        by_s, faster = float(step[0] / size[0]), 0.0 if rate_stays else float(step[1] / size[1])
        lag_s, rate = lag_s + by_s, rate + faster
        if abs(by_s) + abs(faster) * centred_s[-1] < CONVERGED_S:
            break
    else:
        return None
    if abs(lag_s - start_s) > SAME_PEAK_S or abs(rate) > FURTHEST * max(RATES):
        return None
    power = late * late
    rows = math.ceil(EVENT_S / float(pair.time_s[1] - pair.time_s[0]))
    if np.convolve(power, np.ones(min(rows, power.size))).max() > EVENT_RATIO * power.sum():
        return None
    scores = j * left
    spread = scores @ scores.T
    lags = math.ceil(MEMORY_S / float(pair.time_s[1] - pair.time_s[0]))
    for lag in range(1, lags):
        lagged = (1.0 - lag / lags) * scores[:, lag:] @ scores[:, :-lag].T
        spread += lagged + lagged.T
    inverse = np.linalg.inv(gram)[:2]
    cov = inverse @ spread @ inverse.T / np.outer(size[:2], size[:2])
    if rate_stays:
        cov[0, 1] = cov[1, 0] = 0.0
    return _Fit(lag_s, rate, cov) if cov[0, 0] > 0 and cov[1, 1] > 0 else None
