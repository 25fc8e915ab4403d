"""Delay of the logger of IMU and camera behind that of the wheels, run by run, and that common to all runs.

Each of its channels is compared with the shifted prediction from the wheel speeds, by :func:`terrain.signals.delay`:
the search is bounded, gain and offset are free, because they may be wrong, and the rate between the two clocks is
common to all runs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.residuals import Rows, low_pass_of, prepare_inputs
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
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


_Pairs = dict[tuple[int, int], Pair]  #: By run and place in CLOCKED.


def shifts_of(info: Evidence) -> Shift:
    """Return the shifts of all runs.

    Raises
    ------
    DataError
        if most runs fit well beyond the search, and nowhere within it.
    """
    n = len(info.rows)
    pairs = {(i, c): pair for i, run in enumerate(info.rows) for c, pair in _pairs(run).items()}
    searched = _search_rates(pairs)
    fits, rate = _fit_lags(pairs, searched)
    if abs(rate - searched) > RATE_STEP:
        searched = rate
        fits, rate = _fit_lags(pairs, searched)
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
        lost[i] |= not np.isfinite(lag_s[i]).any() and _fits_further(pair, searched)
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


def _pairs(run: Rows) -> dict[int, Pair]:
    """Return the channels that are measured and of which something is expected, by their place in CLOCKED."""
    pairs = {}
    for c, name in enumerate(CLOCKED):
        measured, expected = (values[:, CHANNELS.index(name)] for values in (run.measured, run.predicted))
        known = np.isfinite(measured)
        if 2 * known.sum() > max(known.size, MIN_ROWS) and np.std(expected[known]) > MIN_EXCITATION:
            fine_s = np.arange(run.time_s[0], run.time_s[-1], FINE_S)
            curve, time_s = CubicSpline(run.time_s, expected), run.time_s - run.time_s[0]
            values, slope = np.asarray(curve(fine_s)), np.asarray(curve(fine_s, 1))
            pairs[c] = Pair(time_s, np.ascontiguousarray(measured), FINE_S, values, slope, 0.5 * time_s[-1])
    return pairs


def _search_rates(pairs: _Pairs) -> float:
    """Return the rate of the coarse search that fits all channels best."""
    best, least = 0.0, np.inf
    for rate in RATES:
        peaks = np.array([pair.correlations(LAGS_S, rate).max() for pair in pairs.values()])
        loss = float(np.log1p(-(np.clip(peaks, 0.0, 0.9999) ** 2)).sum())  # gains and constants free
        if loss < least:
            best, least = rate, loss
        if not pairs or np.median(peaks) > CLEAR_CORRELATION:
            break
    return best


def _fit_lags(pairs: _Pairs, rate: float) -> tuple[dict[tuple[int, int], DelayFit], float]:
    """Return the fits of channels that have one best lag, and the median of their rates by their information."""
    find = partial(delay, lags_s=LAGS_S, rates=(rate,), same_peak_s=SAME_PEAK_S, floor=RIVAL_FLOOR)
    found = {at: find(pair, min_correlation=MIN_CORRELATION, **SEARCH) for at, pair in pairs.items()}
    fits = {at: each.fit for at, each in found.items() if each.fit and each.status is DelayStatus.ESTIMATED}
    if not fits:
        return {}, 0.0
    rates = sorted((fit.rate, 1.0 / float(fit.cov[1, 1])) for fit in fits.values())
    total = np.cumsum([weight for _, weight in rates])
    return fits, rates[int(np.searchsorted(total, 0.5 * total[-1]))][0]


def _fits_further(pair: Pair, rate: float) -> bool:
    """Whether a channel that fits at no shift within the search fits well at one beyond it."""
    best = float(pair.correlations(LAGS_S, rate).max())
    if best >= MIN_CORRELATION or pair.time_s[-1] < 2 * FAR_LAG_S:
        return False
    lags_s = np.arange(-FAR_LAG_S, FAR_LAG_S + 1e-9, LAG_STEP_S)
    return float(pair.correlations(lags_s, 0.0).max()) > max(MIN_CORRELATION, best + 0.15)


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
UNKNOWN = (math.nan, math.nan)


class Latencies(NamedTuple):
    """Lags of all channels behind what the wheels predict, and their parts."""

    #: by name of :data:`CLOCKED`, those of which a lag is measured, over what the simulation has of it already;
    #: negative where the wheels are late
    channels: Mapping[str, Delay]
    #: of the earlier of IMU and camera behind the wheels, and its standard deviation (s); NaN if unknown
    clock: tuple[float, float]
    #: of the IMU behind that; NaN where it is not measured, or where a delay of the yaw motion looks the same
    imu: tuple[float, float]
    camera: tuple[float, float]  #: of the camera behind that; NaN where it is not measured
    is_delay: bool  #: whether the wheels are late by a delay, and not by a low-pass of their encoders

    def starting_values(self) -> dict[str, float]:
        """Return parameters by which a search may start, of what is significant; none where nothing is late.

        Keys are ``clock_offset_s``, which is negative where the wheels are late, ``camera_latency_s`` and
        ``imu_latency_s``.  A clock is left out where a low-pass of the encoders explains late wheels as well.
        """
        values = {}
        for name, (lag_s, std_s) in (("imu", self.imu), ("camera", self.camera), ("clock", self.clock)):
            if abs(lag_s) > max(SIGMAS * std_s, GROSS_S) and (name != "clock" or lag_s > 0 or self.is_delay):
                values["clock_offset_s" if name == "clock" else f"{name}_latency_s"] = lag_s
        return values


#: Channels of a run beside what is expected of them, and how many of their samples are independent.
_RunPairs = dict[str, tuple[Pair, float]]


def latencies_of(signals: Sequence[Signals], simulation: Simulation, seed: int = 0) -> Latencies:
    """Return the lag of each channel behind the wheels, common to all runs.

    The gyro measures the IMU; heading rate and speed measure the camera, which is the earlier of the two: a
    body may move late, and no channel can be early.  A gyro that is late behind the speed alone may be that
    of a body that turns late; only a heading distinguishes the two.  The prediction may be wrong in size and in sign.
    """
    pairs, lags = [_run_pairs(run, simulation) for run in signals], {}
    for name in CLOCKED:
        table = [_gain(*run[name], FINE_LAGS_S) for run in pairs if name in run]
        total = np.sum(table, axis=0)
        if len(table) >= MIN_RUNS and total.max() - np.median(total) >= MIN_GAIN:
            found = common_delay(FINE_LAGS_S, table, seed=seed)
            lags[name] = found._replace(std_s=max(found.std_s, MIN_STD_S))
    gyro, heading = lags.get(GYRO), lags.get(HEADING)
    behind = [lags[name] for name in (HEADING, SPEED_X) if name in lags]
    camera = min(behind, key=lambda lag: lag.delay_s, default=None)
    first, imu, later = gyro or camera, UNKNOWN, UNKNOWN
    if gyro is not None and camera is not None:
        std_s = math.hypot(gyro.std_s, camera.std_s)
        if gyro.delay_s <= camera.delay_s:
            imu, later = (0.0, std_s), (camera.delay_s - gyro.delay_s, std_s)
        else:
            first, later = camera, (0.0, std_s)
            if heading is not None:
                imu = max(gyro.delay_s - heading.delay_s, 0.0), math.hypot(gyro.std_s, heading.std_s)
    clock = UNKNOWN if first is None else (first.delay_s, first.std_s)
    return Latencies(lags, clock, imu, later, _is_delay(pairs, lags))


def _run_pairs(run: Signals, simulation: Simulation) -> _RunPairs:
    """Return the channels of a run that are measured and of which something is expected."""
    dt, wheel_speed, steer, grade, roll, measured = prepare_inputs(run, low_pass_of([run]))
    planar = simulation.planar_on(run.terrain)
    predicted = np.asarray(replay(planar, simulation.vector, dt, wheel_speed, steer, grade, roll))
    at_s = dt * np.arange(len(predicted))
    half = SMOOTH.size // 2
    wide_s = np.arange(-EDGE_S - FINE_S * half, at_s[-1] + EDGE_S + FINE_S * half, FINE_S)
    pairs = {}
    for name in CLOCKED:
        values, expected = (each[:, CHANNELS.index(name)] for each in (measured, predicted))
        known = np.isfinite(values)
        if known.sum() >= MIN_KNOWN and np.std(expected[known]) > MIN_EXCITATION:
            fine = np.convolve(np.interp(wide_s, at_s, expected), SMOOTH, mode="valid")
            time_s, slope = at_s - wide_s[half], np.gradient(fine, FINE_S)
            pair = Pair(time_s, np.ascontiguousarray(values), FINE_S, fine, slope, 0.0)
            pairs[name] = pair, float(known.sum() * dt * INDEPENDENT_HZ)
    return pairs


def _gain(pair: Pair, n_independent: float, lags_s: Array) -> Array:
    """Return twice the log-likelihood (lags,) that a run gains by following the prediction."""
    fit = np.minimum(pair.correlations(lags_s, 0.0) ** 2, 0.9999)
    return np.asarray(-n_independent * np.log1p(-fit))


def _is_delay(pairs: Sequence[_RunPairs], names: Mapping[str, Delay]) -> bool:
    """Return whether wheels that are late are so by a delay, and not by a low-pass of time constant ``T``.

    What a body does is ahead of late wheels: ``x(t + T)`` by a delay, ``x + T dx/dt`` by a low-pass.
    """
    late_s, gained = np.arange(0.0, -MIN_LAG_S, FINE_S), 0.0
    for name in names:
        delayed, low_pass = np.zeros((2, late_s.size))
        for pair, n in (run[name] for run in pairs if name in run):
            delayed += _gain(pair, n, -late_s)
            ahead = [pair._replace(reference=pair.reference + late * pair.slope) for late in late_s]
            low_pass += [_gain(each, n, np.zeros(1))[0] for each in ahead]
        gained += delayed.max() - low_pass.max()
    return bool(gained > SHAPE_GAIN)
