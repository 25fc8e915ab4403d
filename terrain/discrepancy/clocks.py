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
from scipy.interpolate import CubicSpline

from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.residuals import Rows
from terrain.effects import CHANNELS, GYRO, HEADING, SPEED_X
from terrain.errors import DataError
from terrain.records import Array
from terrain.signals import MIN_ROWS, DelayFit, Pair, has_rival, refine_delay

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

RIVAL_FLOOR = 0.02
"""A peak elsewhere is no rival if it leaves so much more of the variance, beside the relative margin."""

SAME_PEAK_S = 0.5
"""Two shifts closer than this are of one peak."""

MAX_STD_S = 0.1
"""Largest standard deviation of a clock that is used."""

EVENT_S, EVENT_RATIO = 3.0, 0.7
"""A clock is not used if that ratio of its information comes from so short a time: from one event."""

FURTHEST = 1.5
"""A rate is refused that is so many times out of the bounds."""


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


_Pairs = dict[tuple[int, int], Pair]
"""By run and place in CLOCKED."""


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
        fit: DelayFit | None = free
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


def _pairs(run: Rows) -> dict[int, Pair]:
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
        c: Pair(time_s, np.ascontiguousarray(measured), FINE_S, values[k], slopes[k], 0.5 * time_s[-1])
        for k, (c, (measured, _)) in enumerate(compared.items())
    }


def _search_rates(pairs: _Pairs, rates: Sequence[float]) -> tuple[float, dict[tuple[int, int], Array]]:
    """Return the rate that fits all best, and under it the correlations (lags,) of each."""
    rate, least = 0.0, np.inf
    best: dict[tuple[int, int], Array] = {}
    for tried in rates:
        found = {at: pair.correlations(LAGS_S, tried) for at, pair in pairs.items()}
        peaks = np.array([min(max(column.max(), 0.0), 0.9999) for column in found.values()])
        loss = float(np.log1p(-(peaks**2)).sum())  # minus a log-likelihood, gains and constants free
        if loss < least:
            rate, least, best = tried, loss, found
        if not pairs or np.median(peaks) > CLEAR_CORRELATION:
            break
    return rate, best


def _fit_lags(
    pairs: _Pairs, tables: dict[tuple[int, int], Array], rate: float
) -> dict[tuple[int, int], DelayFit]:
    """Return the fits from the best lags, of the channels that have one best."""
    fits = {}
    for at, column in tables.items():
        best = int(np.argmax(column))
        if column[best] > MIN_CORRELATION and not has_rival(LAGS_S, column, best, SAME_PEAK_S, RIVAL_FLOOR):
            fit = _refine_lag(pairs[at], float(LAGS_S[best]), rate)
            if fit is not None:
                fits[at] = fit
    return fits


def _shared_rate(fits: dict[tuple[int, int], DelayFit]) -> float:
    """Return the median of the rates, weighted by their information."""
    if not fits:
        return 0.0
    rates = sorted((fit.rate, 1.0 / float(fit.cov[1, 1])) for fit in fits.values())
    total = np.cumsum([weight for _, weight in rates])
    return rates[int(np.searchsorted(total, 0.5 * total[-1]))][0]


def _fits_further(pair: Pair, best: float) -> bool:
    """Whether a channel that fits at no shift within the search fits well at one beyond it."""
    if pair.time_s[-1] < 2 * FAR_LAG_S:
        return False
    lags_s = np.arange(-FAR_LAG_S, FAR_LAG_S + 1e-9, LAG_STEP_S)
    beyond = float(pair.correlations(lags_s, 0.0).max())
    return beyond > MIN_CORRELATION and beyond > best + 0.15


def _refine_lag(pair: Pair, lag_s: float, rate: float, rate_stays: bool = False) -> DelayFit | None:
    """Return lag and rate, or the lag alone, by least squares from a start, or None if they diverge."""
    return refine_delay(
        pair,
        lag_s,
        rate,
        near_s=SAME_PEAK_S,
        rate_max=FURTHEST * max(RATES),
        rate_stays=rate_stays,
        event=(EVENT_S, EVENT_RATIO),
    )
