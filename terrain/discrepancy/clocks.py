"""Delay of the logger of IMU and camera behind that of the wheels, run by run, and that common to all runs.

Each of its channels is compared with the shifted prediction from the wheel speeds, by :func:`terrain.signals.delay`:
the search is bounded, gain and offset are free, because they may be wrong, and the rate between the two clocks is
common to all runs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.runs import Signals, Simulation, low_pass_of, prepare_inputs
from terrain.effects import CHANNELS, GYRO, HEADING, SPEED_X
from terrain.errors import DataError
from terrain.records import Array
from terrain.signals import MIN_ROWS, Delay, DelayFit, DelayStatus, Pair, common_delay, delay, refine_delay
from terrain.simulation.plants.planar import replay

#: Loggers of a run are started together, the wheels' first.  The other sign is that of wheels that are late: they are
#: averaged, sent a few times a second, held, and queued, which adds up to less than a second.
MIN_LAG_S, MAX_LAG_S = -1.0, 2.0
#: Bound of a second search that only finds that a clock is out of reach, in runs of twice that length.
FAR_LAG_S = 10.0

LAG_STEP_S = 0.1  #: Of the coarse search: what a robot does takes longer.
LAGS_S = np.arange(MIN_LAG_S, MAX_LAG_S + 1e-9, LAG_STEP_S)
FAR_LAGS_S = np.arange(-FAR_LAG_S, FAR_LAG_S + 1e-9, LAG_STEP_S)

RATES = (0.0, -0.01, 0.01, -0.02, 0.02)  #: Of the coarse search, up to the bounds of ``clock_rate``.
#: Where half of the channels reach it, no other rate is tried: least squares finds it from there.
CLEAR_CORRELATION = 0.9

RATE_STEP = 0.002  #: Rates that differ by less are one to the coarse search.
FINE_S = 0.02  #: Grid on which what is expected is laid out; straight lines between.
#: Channels that measure the clock: the tilt of the accelerometer is on its own clock, and the lateral motion of a
#: skid-steer robot is in none of its wheels.
CLOCKED = (GYRO, SPEED_X, HEADING)

#: Standard deviation (rad/s, m/s) of the prediction, below which a channel measures no clock.
MIN_EXCITATION = 0.02
MIN_CORRELATION = 0.7  #: Least correlation at the best shift.
#: A peak elsewhere is no rival if it leaves so much more of the variance, beside the relative margin.
RIVAL_FLOOR = 0.02

SAME_PEAK_S = 0.5  #: Two shifts closer than this are of one peak.
MAX_STD_S = 0.1  #: Largest standard deviation of a clock that is used.
#: A clock is not used if that ratio of its information comes from so short a time: from one event.
EVENT_S, EVENT_RATIO = 3.0, 0.7

FURTHEST = 1.5  #: A rate is refused that is so many times out of the bounds.
SEARCH: dict[str, Any] = {"rate_max": FURTHEST * max(RATES), "event": (EVENT_S, EVENT_RATIO)}


class Shift(NamedTuple):
    """How far what IMU and camera saw is behind the wheels."""

    lag_s: Array  #: (runs, len(CLOCKED)) at the middle of each run; NaN where a channel measures none
    std_s: Array
    rate: float  #: common to all runs
    lost: Array  #: (runs,) whether nothing fits within the search, and something well out of it


def shifts_of(info: Evidence) -> Shift:
    """Return the shifts of all runs.

    Raises
    ------
    DataError
        if most runs fit well beyond the search, and nowhere within it.
    """
    n = len(info.rows)
    pairs: dict[tuple[int, int], Pair] = {}  # channels that are measured and of which something is expected
    for i, run in enumerate(info.rows):
        for c, name in enumerate(CLOCKED):
            measured, expected = (x[:, CHANNELS.index(name)] for x in (run.measured, run.predicted))
            known = np.isfinite(measured)
            if 2 * known.sum() > max(known.size, MIN_ROWS) and np.std(expected[known]) > MIN_EXCITATION:
                fine_s = np.arange(run.time_s[0], run.time_s[-1], FINE_S)
                curve, time_s = CubicSpline(run.time_s, expected), run.time_s - run.time_s[0]
                on_grid = np.asarray(curve(fine_s)), np.asarray(curve(fine_s, 1))
                seen = np.ascontiguousarray(measured)
                pairs[i, c] = Pair(time_s, seen, FINE_S, *on_grid, 0.5 * time_s[-1])

    searched, least = 0.0, math.inf
    for rate in RATES:
        peaks = np.array([pair.correlations(LAGS_S, rate).max() for pair in pairs.values()])
        loss = float(np.log1p(-(np.clip(peaks, 0.0, 0.9999) ** 2)).sum())  # gains and constants free
        if loss < least:
            searched, least = rate, loss
        if not pairs or np.median(peaks) > CLEAR_CORRELATION:
            break
    for last in (False, True):
        # fits of channels that have one best lag, and the median of their rates by their information
        fits: dict[tuple[int, int], DelayFit] = {}
        limits: dict[str, Any] = {"floor": RIVAL_FLOOR, "min_correlation": MIN_CORRELATION, **SEARCH}
        for at, pair in pairs.items():
            found = delay(pair, LAGS_S, (searched,), same_peak_s=SAME_PEAK_S, **limits)
            if found.fit is not None and found.status is DelayStatus.ESTIMATED:
                fits[at] = found.fit
        rates = sorted((fit.rate, 1.0 / float(fit.cov[1, 1])) for fit in fits.values())
        total = np.cumsum([weight for _, weight in rates])
        rate = rates[int(np.searchsorted(total, 0.5 * total[-1]))][0] if rates else 0.0
        if last or abs(rate - searched) <= RATE_STEP:
            break
        searched = rate

    lag_s, std_s = np.full((2, n, len(CLOCKED)), np.nan)
    for at, free in fits.items():
        fit: DelayFit | None = free
        if abs(free.rate - rate) * 0.5 * pairs[at].time_s[-1] > LAG_STEP_S:
            start_s = float(LAGS_S[np.argmax(pairs[at].correlations(LAGS_S, searched))])
            fit = refine_delay(pairs[at], start_s, rate, near_s=SAME_PEAK_S, rate_stays=True, **SEARCH)
        if fit is not None:
            follow = fit.cov[0, 1] / fit.cov[1, 1]  # of the lag, as the rate goes to that of all
            std = math.sqrt(max(fit.cov[0, 0] - follow * fit.cov[0, 1], 1e-12))
            if std < MAX_STD_S:
                lag_s[at], std_s[at] = fit.lag_s + follow * (rate - fit.rate), std
    lost = np.zeros(n, dtype=bool)
    for (i, _), pair in pairs.items():
        if not np.isfinite(lag_s[i]).any() and pair.time_s[-1] >= 2 * FAR_LAG_S:
            best = float(pair.correlations(LAGS_S, searched).max())
            most = float(pair.correlations(FAR_LAGS_S, 0.0).max())
            lost[i] |= best < MIN_CORRELATION and most > max(MIN_CORRELATION, best + 0.15)
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
    offset_s, std_s = np.full((2, len(shift.lag_s)), np.nan)
    for i, known in enumerate(np.isfinite(shift.lag_s)):
        if known.any():
            lag_s, error_s = shift.lag_s[i][known], shift.std_s[i][known]
            least = int(np.argmin(lag_s))
            near = lag_s - lag_s[least] < 3.0 * np.hypot(error_s, error_s[least]) + FINE_S
            weight = 1.0 / error_s[near] ** 2
            offset_s[i] = np.average(lag_s[near], weights=weight)
            std_s[i] = np.sqrt(1.0 / weight.sum())
    return offset_s, std_s


# -- Lag of each sensor behind the wheels, from all runs together, and its parts: a clock, and latencies ---
# A short run measures no clock: it holds one change of the command, of which a camera may see a half.  A lag
# that is common to all runs is measured by all of them: the likelihood of each run, its gain and constant free,
# is a function of the lag, and their sum has one peak.  Signs are free too, since a turned sign is found later.

FINE_LAGS_S = np.arange(MIN_LAG_S, MAX_LAG_S + 1e-9, FINE_S)

EDGE_S = (
    MAX_LAG_S + 10 * FINE_S
)  #: Before and after a run its first and last prediction are held: commands are.
#: Window of half a second over the prediction: encoders that are read a few times a second are held, and the
#: likelihood of a lag has kinks where edges meet samples.
SMOOTH = np.hanning(27)[1:-1] / np.hanning(27).sum()

MIN_KNOWN = 10  #: Samples of a channel in a run, below which gain and constant leave nothing to compare.
INDEPENDENT_HZ = 5.0  #: Samples a second that count as independent: what a robot does changes within 2 Hz.
MIN_RUNS = 3  #: Least number of runs for a standard deviation.
#: Twice the log-likelihood that a lag has to gain over the median of all lags, to be one: a channel that follows the
#: wheels gains hundreds, one that does not follows them nowhere.
MIN_GAIN = 30.0

MIN_STD_S = 0.002  #: A tenth of the grid's step: runs that agree to less are limited by it.
#: A search starts from a lag beyond so many standard deviations, and beyond the second: what is less, a search that
#: is linear about no lag finds by itself and names by its shape, and slip that follows the traction looks like 0.08
#: s.
SIGMAS, GROSS_S = 3.0, 0.1

#: Twice the log-likelihood by which a delay has to fit better than a low-pass of the encoders.
SHAPE_GAIN = 10.0


class Latencies(NamedTuple):
    """Lags of all channels behind what the wheels predict, and the values from which a search of causes may start."""

    #: by name of :data:`CLOCKED`, those of which a lag is measured, over what the simulation has of it already;
    #: negative where the wheels are late
    channels: Mapping[str, Delay]
    #: of what is significant, by parameter: ``imu_latency_s`` and ``camera_latency_s``, of either sensor behind the
    #: earlier one, and ``clock_offset_s``, of the earlier one behind the wheels: negative where the wheels are late
    starting_values: Mapping[str, float]


def latencies_of(signals: Sequence[Signals], simulation: Simulation) -> Latencies:
    """Return the lag of each channel behind the wheels, common to all runs.

    The gyro measures the IMU; heading rate and speed measure the camera, which is the earlier of the two: a
    body may move late, and no channel can be early.  A gyro that is late behind the speed alone may be that
    of a body that turns late; only a heading distinguishes the two.  The prediction may be wrong in size and in sign.

    No search starts from a clock where a low-pass of the encoders, of time constant T, explains late wheels as well as
    a delay: what a body does is ahead of late wheels, ``x(t + T)`` by a delay, ``x + T dx/dt`` by a low-pass.
    """
    pairs: dict[str, list[Pair]] = {name: [] for name in CLOCKED}
    for run in signals:
        dt, *inputs, measured = prepare_inputs(run, low_pass_of([run]))
        predicted = np.asarray(replay(simulation.planar_on(run.terrain), simulation.vector, dt, *inputs))
        at_s, half = dt * np.arange(len(predicted)), SMOOTH.size // 2
        wide_s = np.arange(-EDGE_S - FINE_S * half, at_s[-1] + EDGE_S + FINE_S * half, FINE_S)
        for name, each in pairs.items():
            values, expected = (x[:, CHANNELS.index(name)] for x in (measured, predicted))
            known = np.isfinite(values)
            if known.sum() >= MIN_KNOWN and np.std(expected[known]) > MIN_EXCITATION:
                fine = np.convolve(np.interp(wide_s, at_s, expected), SMOOTH, mode="valid")
                seen, slope = np.ascontiguousarray(values), np.gradient(fine, FINE_S)
                each.append(Pair(at_s - wide_s[half], seen, FINE_S, fine, slope, 0.0))

    def gains(pair: Pair, lags_s: Array) -> Array:
        """Return twice the log-likelihood (lags,) that a run gains by following the prediction."""
        fit = np.minimum(pair.correlations(lags_s, 0.0) ** 2, 0.9999)
        period_s = float(pair.time_s[1] - pair.time_s[0])
        return np.asarray(-np.isfinite(pair.measured).sum() * period_s * INDEPENDENT_HZ * np.log1p(-fit))

    lags: dict[str, Delay] = {}
    for name, each in pairs.items():
        table = [gains(pair, FINE_LAGS_S) for pair in each]
        total = np.sum(table, axis=0)
        if len(table) >= MIN_RUNS and total.max() - np.median(total) >= MIN_GAIN:
            found = common_delay(FINE_LAGS_S, table)
            lags[name] = found._replace(std_s=max(found.std_s, MIN_STD_S))
    gyro, heading = lags.get(GYRO), lags.get(HEADING)
    behind = [lags[name] for name in (HEADING, SPEED_X) if name in lags]
    camera = min(behind, key=lambda lag: lag.delay_s, default=None)
    late: dict[str, tuple[float, float]] = {}  # lag and its standard deviation
    first = gyro or camera
    if gyro is not None and camera is not None:
        if gyro.delay_s <= camera.delay_s:
            late["camera_latency_s"] = camera.delay_s - gyro.delay_s, math.hypot(gyro.std_s, camera.std_s)
        else:
            first = camera
            if heading is not None:
                std_s = math.hypot(gyro.std_s, heading.std_s)
                late["imu_latency_s"] = max(gyro.delay_s - heading.delay_s, 0.0), std_s
    if first is not None:
        late["clock_offset_s"] = first.delay_s, first.std_s
    starting = {name: s for name, (s, std_s) in late.items() if abs(s) > max(SIGMAS * std_s, GROSS_S)}
    if starting.get("clock_offset_s", 0.0) < 0.0:
        late_s, gained = np.arange(0.0, -MIN_LAG_S, FINE_S), 0.0
        for name in lags:
            delayed, low_pass = np.zeros((2, late_s.size))
            for pair in pairs[name]:
                delayed += gains(pair, -late_s)
                ahead = [pair._replace(reference=pair.reference + by_s * pair.slope) for by_s in late_s]
                low_pass += [gains(each, np.zeros(1))[0] for each in ahead]
            gained += delayed.max() - low_pass.max()
        if not gained > SHAPE_GAIN:
            del starting["clock_offset_s"]
    return Latencies(lags, starting)
