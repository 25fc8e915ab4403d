"""Delay of the logger of IMU and camera behind that of the wheels, run by run.

Each of its channels is compared with the shifted prediction from the wheel speeds.  The search is bounded,
because a free one locks on to mirror images of the manoeuvres; gain and offset are free, because they may be
wrong.  The rate between the two clocks is common to all runs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.residuals import Rows, low_pass_of, prepare_inputs
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import CHANNELS, GYRO, HEADING, SPEED_X
from terrain.errors import DataError
from terrain.records import Array
from terrain.signals import MIN_ROWS, DelayFit, Pair, common_delay, has_rival, refine_delay
from terrain.simulation.planar.replay import replay

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


# -- Lag of each sensor behind the wheels, from all runs together, and its parts: a clock, and latencies ---
# A short run measures no clock: it holds one change of the command, of which a camera may see a half.  A lag
# that is common to all runs is measured by all of them: the likelihood of each run, its gain and constant free,
# is a function of the lag, and their sum has one peak.  Signs are free too, since a turned sign is found later.

FINE_LAGS_S = np.arange(MIN_LAG_S, MAX_LAG_S + 1e-9, FINE_S)

EDGE_S = MAX_LAG_S + 10 * FINE_S
"""Before and after a run its first and last prediction are held: commands are."""

SMOOTH = np.hanning(27)[1:-1] / np.hanning(27).sum()
"""Window of half a second over the prediction: encoders that are read a few times a second are held, and the
likelihood of a lag has kinks where edges meet samples."""

NO_LAG_S = np.zeros(1)

MIN_KNOWN = 10
"""Samples of a channel in a run, below which gain and constant leave nothing to compare."""

INDEPENDENT_HZ = 5.0
"""Samples a second that count as independent: what a robot does changes within 2 Hz."""

MIN_RUNS = 3
"""Least number of runs for a standard deviation."""

MIN_GAIN = 30.0
"""Twice the log-likelihood that a lag has to gain over the median of all lags, to be one: a channel that
follows the wheels gains hundreds, one that does not follows them nowhere."""

MIN_STD_S = 0.002
"""A tenth of the grid's step: runs that agree to less are limited by it."""

SIGMAS, GROSS_S = 3.0, 0.1
"""A search starts from a lag beyond so many standard deviations, and beyond the second: what is less, a
search that is linear about no lag finds by itself and names by its shape, and slip that follows the traction
looks like 0.08 s."""

SHAPE_GAIN = 10.0
"""Twice the log-likelihood by which a delay has to fit better than a low-pass of the encoders."""


class Latency(NamedTuple):
    """How far a channel is behind what the wheels predict, common to all runs.

    Parameters
    ----------
    channel : of :data:`~terrain.discrepancy.clocks.CLOCKED`
    lag_s, std_s : over what the simulation has of it already, and its standard deviation by bootstrap over
        runs; negative where the wheels are late
    n_runs : that measure it
    """

    channel: str
    lag_s: float
    std_s: float
    n_runs: int


class Latencies(NamedTuple):
    """Lags of all channels, and their parts.

    Parameters
    ----------
    channels : those of which a lag is measured
    clock_s, clock_std_s : of the earlier of IMU and camera behind the wheels; NaN if neither is measured
    imu_s, imu_std_s : of the IMU behind that; NaN where it is not measured, or where a delay of the
        yaw motion looks the same
    camera_s, camera_std_s : of the camera behind that; NaN where it is not measured
    is_delay : whether the wheels are late by a delay, and not by a low-pass of their encoders
    """

    channels: tuple[Latency, ...]
    clock_s: float
    clock_std_s: float
    imu_s: float
    imu_std_s: float
    camera_s: float
    camera_std_s: float
    is_delay: bool


class _RunPair(NamedTuple):
    """A channel of a run beside what is expected of it, and how many of its samples are independent."""

    pair: Pair
    n_independent: float


def latencies_of(signals: Sequence[Signals], simulation: Simulation, seed: int = 0) -> Latencies:
    """Return the lag of each channel behind the wheels, common to all runs.

    The gyro measures the IMU; heading rate and speed measure the camera, which is the earlier of the two: a
    body may move late, and no channel can be early.  A gyro that is late behind the speed alone may be that
    of a body that turns late; only a heading distinguishes the two.

    Parameters
    ----------
    signals : of all runs
    simulation : its prediction may be wrong in size and in sign
    seed : of the bootstrap
    """
    pairs = [_run_pairs(run, simulation) for run in signals]
    lags = {}
    for c, name in enumerate(CLOCKED):
        own = [pair[c] for pair in pairs if c in pair]
        if len(own) < MIN_RUNS:
            continue
        table = np.array([_gain(pair, FINE_LAGS_S) for pair in own])
        total = table.sum(axis=0)
        if total.max() - np.median(total) < MIN_GAIN:
            continue
        found = common_delay(FINE_LAGS_S, list(table), seed=seed)
        lags[name] = Latency(name, found.delay_s, max(found.std_s, MIN_STD_S), len(own))
    return Latencies(tuple(lags.values()), *_parts(lags), is_delay=_is_delay(pairs, lags))


def _parts(lags: Mapping[str, Latency]) -> tuple[float, float, float, float, float, float]:
    """Return clock, latency of the IMU and latency of the camera, each with its standard deviation."""
    gyro, heading = lags.get(GYRO), lags.get(HEADING)
    camera = min((lags[name] for name in (HEADING, SPEED_X) if name in lags), key=_lag_s, default=None)
    if gyro is None or camera is None:
        only = gyro or camera
        clock = (math.nan, math.nan) if only is None else (only.lag_s, only.std_s)
        return (*clock, math.nan, math.nan, math.nan, math.nan)
    std_s = math.hypot(gyro.std_s, camera.std_s)
    if gyro.lag_s <= camera.lag_s:
        return gyro.lag_s, gyro.std_s, 0.0, std_s, camera.lag_s - gyro.lag_s, std_s
    imu = (math.nan, math.nan)
    if heading is not None:
        imu = max(gyro.lag_s - heading.lag_s, 0.0), math.hypot(gyro.std_s, heading.std_s)
    return camera.lag_s, camera.std_s, *imu, 0.0, std_s


def _lag_s(latency: Latency) -> float:
    return latency.lag_s


def starting_values(latencies: Latencies) -> dict[str, float]:
    """Return parameters by which a search may start, of what is significant; none where nothing is late.

    Keys are ``clock_offset_s``, which is negative where the wheels are late, ``camera_latency_s`` and
    ``imu_latency_s``.  A clock is left out where a low-pass of the encoders explains late wheels as well.
    """
    values = {}
    clock_s = latencies.clock_s
    if _is_significant(clock_s, latencies.clock_std_s) and (clock_s > 0 or latencies.is_delay):
        values["clock_offset_s"] = clock_s
    if _is_significant(latencies.camera_s, latencies.camera_std_s):
        values["camera_latency_s"] = latencies.camera_s
    if _is_significant(latencies.imu_s, latencies.imu_std_s):
        values["imu_latency_s"] = latencies.imu_s
    return values


def _is_significant(lag_s: float, std_s: float) -> bool:
    return bool(abs(lag_s) > max(SIGMAS * std_s, GROSS_S))


def _run_pairs(run: Signals, simulation: Simulation) -> dict[int, _RunPair]:
    """Return the channels of a run that are measured and of which something is expected, by place."""
    dt, wheel_speed, steer, grade, roll, measured = prepare_inputs(run, low_pass_of([run]))
    planar = simulation.planar_on(run.terrain)
    predicted = np.asarray(replay(planar, simulation.vector, dt, wheel_speed, steer, grade, roll))
    at_s = dt * np.arange(len(predicted))
    half_s = FINE_S * (SMOOTH.size // 2)
    wide_s = np.arange(-EDGE_S - half_s, at_s[-1] + EDGE_S + half_s, FINE_S)
    fine_s = wide_s[SMOOTH.size // 2 : -(SMOOTH.size // 2)]
    pairs = {}
    for c, name in enumerate(CLOCKED):
        values, expected = (each[:, CHANNELS.index(name)] for each in (measured, predicted))
        known = np.isfinite(values)
        if known.sum() >= MIN_KNOWN and np.std(expected[known]) > MIN_EXCITATION:
            fine = np.convolve(np.interp(wide_s, at_s, expected), SMOOTH, mode="valid")
            n = float(known.sum() * dt * INDEPENDENT_HZ)
            time_s = at_s - fine_s[0]
            slope = np.gradient(fine, FINE_S)
            pairs[c] = _RunPair(Pair(time_s, np.ascontiguousarray(values), FINE_S, fine, slope, 0.0), n)
    return pairs


def _gain(run: _RunPair, lags_s: Array) -> Array:
    """Return twice the log-likelihood (lags,) that a run gains by following the prediction."""
    return np.asarray(
        -run.n_independent * np.log1p(-np.minimum(run.pair.correlations(lags_s, 0.0) ** 2, 0.9999))
    )


def _is_delay(pairs: Sequence[dict[int, _RunPair]], lags: Mapping[str, Latency]) -> bool:
    """Return whether wheels that are late are so by a delay, and not by a low-pass of time constant ``T``.

    What a body does is ahead of late wheels: ``x(t + T)`` by a delay, ``x + T dx/dt`` by a low-pass.
    """
    late_s = np.arange(0.0, -MIN_LAG_S, FINE_S)
    gained = 0.0
    for name in lags:
        delay, low_pass = np.zeros((2, late_s.size))
        for run, n in (each[CLOCKED.index(name)] for each in pairs if CLOCKED.index(name) in each):
            delay += _gain(_RunPair(run, n), -late_s)
            ahead = [run._replace(reference=run.reference + late * run.slope) for late in late_s]
            low_pass += [_gain(_RunPair(each, n), NO_LAG_S)[0] for each in ahead]
        gained += delay.max() - low_pass.max()
    return bool(gained > SHAPE_GAIN)
