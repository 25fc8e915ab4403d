"""Whether two loggers of one run keep the same clock, and the wheel stream brought onto that of the IMU.

The gyro and the wheels both see the robot turn, each on its own clock::

    t_imu = t_ref + (1 + rate) (t_wheels - t_ref) + offset
    gyro_z(t_imu) = gain (v_right - v_left)(t_wheels) / track + bias + noise

with ``t_ref`` the first wheel sample.  Both signals pass the same Gaussian low-pass, as wide as a period of
the slower stream and 0.1 s at least.  A coarse grid over (offset, rate) finds the highest correlation, least
squares refines it.
The search is bounded: the gain is positive (a skid-steer robot turns less than its wheels indicate, never
more), offset and rate lie within a range; so a periodic manoeuvre cannot lock it on to a mirror image.

Standard deviations are those of least squares under residuals as correlated as they are found to be; in
simulated runs of a minute they are right within a fifth, in runs of 15 s about a third too small.

A delay between wheel and gyro that the robot itself has (drive train, tyre, gyro filter) looks exactly like
an offset and is part of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_erosion, gaussian_filter1d, maximum_filter
from scipy.optimize import least_squares

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


MAX_OFFSET_S = 2.0
"""The loggers of a run are started together; the published runs that tell it differ by up to 1.7 s."""

MAX_RATE = 0.05
"""A sampling rate that is stated and not measured may be off by a few per cent (the published BorealTC files
of one run differ in length by up to 4 %); a quartz is 1000 times better."""

MIN_YAW_RATE_STD_RADPS = 0.02
"""Spread of the wheel difference over the track that counts as turning.

Two steps of an encoder that resolves 0.008 m/s, on a track of 0.57 m, come to 0.03 rad/s."""

MIN_GAIN_SIGMAS = 6.0
"""The gain must stand this far above its own error; the best of many shifts of mere noise reaches 4."""

MIN_CORRELATION = 0.5
"""Below this most of what the gyro sees is not in the wheels, and the model of one gain does not hold."""

RIVAL_MARGIN = 0.15
"""A second peak is a rival when it leaves at most this much more of the variance unexplained."""

RATE_KNOWN = 0.01
"""With a larger standard deviation the rate is indistinguishable from that of any stated sampling rate."""

RIVAL_FLOOR = 0.05
"""Share of the variance by which a rival must be worse even when the best peak explains nearly everything."""

SAME_PEAK_SIGMAS = 4.0
"""Two peaks of the grid that lie closer than this many widths of the low-pass are one."""

MAX_SEARCH_SAMPLES = 1500
"""The coarse search looks at this many instants of a long run; least squares at all of them."""

MAX_APART_S = 0.1
"""Between the clocks of wheels and IMU: in more, a robot that begins to turn is seen to turn without wheels,
and the effective track is wrong by as much as its turns are short."""

STATUSES = ("estimated", "offset only", "not excited", "ambiguous", "at bound")


class ClockEstimate(NamedTuple):
    """How the clock of the wheels maps to the clock of the IMU.

    ``t_imu = reference_s + (1 + rate) (t_wheels - reference_s) + offset_s``.  ``status`` is

    - ``estimated``: all numbers stand;
    - ``offset only``: the turns are too few or too close together to tell the rate, which is NaN; the offset
      is the mean shift, and its standard deviation covers the rates within the bounds;
    - ``not excited``: the robot hardly turns, or gyro and wheels do not see the same turns;
    - ``ambiguous``: another shift, or a mirrored gain, fits about as well;
    - ``at bound``: the best fit lies on the edge of the search.

    Numbers are NaN in the last three cases, except for the correlation of the best fit where there is one.
    """

    offset_s: float
    offset_std_s: float
    rate: float
    rate_std: float
    gain: float
    correlation: float
    status: str
    reference_s: float


class _Peak(NamedTuple):
    """A point of the grid."""

    shift_s: float
    rate: float


class _Search(NamedTuple):
    """What the grid found: the best peak, its best rival, and the best of the mirror image."""

    best: _Peak
    rival: _Peak | None
    mirror: _Peak | None


class _Fit(NamedTuple):
    """What least squares found; ``cov`` (4, 4) is of shift, gain, bias and rate.

    The shift refers to the centre of the turning.
    """

    shift_s: float
    rate: float
    gain: float
    cov: Array
    correlation: float


def estimate_clock(
    run: RunLog,
    *,
    track_m: float,
    max_offset_s: float = MAX_OFFSET_S,
    max_rate: float = MAX_RATE,
) -> ClockEstimate:
    """Estimate offset and rate between the clocks of the streams ``wheels`` and ``imu`` of a run.

    Parameters
    ----------
    run : run log with ``imu`` (``gyro_z_radps``) and ``wheels`` (``speed_left_mps``, ``speed_right_mps``)
    track_m : distance of the wheels of the two sides; it scales the gain and what counts as turning
    max_offset_s, max_rate : bounds of the search, either sign, above zero

    Raises
    ------
    DataError
        if the run lacks one of these channels.

    Examples
    --------
    >>> from terrain.records import Stream
    >>> time_s = np.arange(0.0, 60.0, 0.02)
    >>> yaw_rate = 0.4 * np.sin(time_s + 0.02 * time_s**2)
    >>> gyro = Stream(time_s + 0.3, yaw_rate[:, None], ("gyro_z_radps",))
    >>> speeds = np.column_stack([1 - yaw_rate / 3, 1 + yaw_rate / 3])
    >>> wheels = Stream(time_s[::5], speeds[::5], ("speed_left_mps", "speed_right_mps"))
    >>> found = estimate_clock(RunLog("SNOW_01", "husky", {"imu": gyro, "wheels": wheels}), track_m=0.57)
    >>> found.status, round(found.offset_s, 2), abs(found.rate) < 1e-3
    ('estimated', 0.3, True)
    """
    pair = low_passed_pair(run, track_m)
    reference_s = float(run.streams["wheels"].time_s[0])
    if pair is None:
        return _no_estimate("not excited", reference_s)
    turning = (pair.wheels_radps - np.mean(pair.wheels_radps)) ** 2
    if np.sqrt(np.mean(turning)) < MIN_YAW_RATE_STD_RADPS:
        return _no_estimate("not excited", reference_s)
    turning[turning < MIN_YAW_RATE_STD_RADPS**2] = 0.0
    # Shift and rate hardly trade against each other when the shift refers to the centre of the turning.
    centre_s = float(np.average(pair.time_s, weights=turning))
    lever_s = centre_s - reference_s

    # Where all rates within the bounds move the turns by less than the low-pass smears them, none is tried.
    spread_s = float(np.sqrt(np.average((pair.time_s - centre_s) ** 2, weights=turning)))
    for rate_bound in (max_rate, 0.0) if max_rate * spread_s > pair.sigma_s else (0.0,):
        found = _search(pair, centre_s, lever_s, max_offset_s, rate_bound)
        if found is None:
            return _no_estimate("not excited", reference_s)
        search = found
        fit = _refine(pair, centre_s, search.best, rate_bound)
        rate_std = float(np.sqrt(fit.cov[3, 3]))
        if rate_std <= RATE_KNOWN:
            break
    if fit.correlation < MIN_CORRELATION or fit.gain < MIN_GAIN_SIGMAS * np.sqrt(fit.cov[1, 1]):
        return _no_estimate("not excited", reference_s, fit.correlation)
    offset_s = fit.shift_s - fit.rate * lever_s
    if abs(offset_s) > 0.98 * max_offset_s or abs(fit.rate) > 0.98 * max_rate:
        return _no_estimate("at bound", reference_s, fit.correlation)
    mirrored = pair._replace(wheels_radps=-pair.wheels_radps)
    for peak, seen in ((search.rival, pair), (search.mirror, mirrored)):
        if peak is None:
            continue
        rival = _refine(seen, centre_s, peak, rate_bound)
        apart = seen is mirrored or _moved_s(pair, centre_s, rival, fit) > SAME_PEAK_SIGMAS * pair.sigma_s
        if apart and _nearly_as_good(rival, fit):
            return _no_estimate("ambiguous", reference_s, fit.correlation)
    if rate_bound == 0.0:
        std_s = float(np.hypot(np.sqrt(fit.cov[0, 0]), lever_s * max_rate / np.sqrt(3.0)))
        return ClockEstimate(
            offset_s, std_s, np.nan, np.nan, fit.gain, fit.correlation, "offset only", reference_s
        )
    to_start = np.array([1.0, 0.0, 0.0, -lever_s])
    std_s = float(np.sqrt(to_start @ fit.cov @ to_start))
    return ClockEstimate(
        offset_s, std_s, fit.rate, rate_std, fit.gain, fit.correlation, "estimated", reference_s
    )


def offsets_apart_s(runs: Sequence[RunLog], track_m: Callable[[RunLog], float]) -> dict[str, float]:
    """Return by run the offset of the clocks of wheels and IMU, of those runs where they clearly differ.

    Parameters
    ----------
    runs : logs
    track_m : of the robot of a run
    """
    offsets_s = {}
    for run in runs:
        try:
            found = estimate_clock(run, track_m=track_m(run))
        except DataError:  # no gyro, or no speeds of two sides
            continue
        known = found.status in ("estimated", "offset only")
        if known and abs(found.offset_s) > max(MAX_APART_S, 3.0 * found.offset_std_s):
            offsets_s[run.run_id] = found.offset_s
    return offsets_s


def _no_estimate(status: str, reference_s: float, correlation: float = np.nan) -> ClockEstimate:
    return ClockEstimate(np.nan, np.nan, np.nan, np.nan, np.nan, correlation, status, reference_s)


def _search(
    pair: YawRatePair, centre_s: float, lever_s: float, max_offset_s: float, max_rate: float
) -> _Search | None:
    """Return the best correlations on a grid of shift and rate, None where nothing correlates."""
    every = -(-pair.time_s.size // MAX_SEARCH_SAMPLES)
    pair = pair._replace(time_s=pair.time_s[::every], wheels_radps=pair.wheels_radps[::every])
    reach_s = float(np.max(np.abs(pair.time_s - centre_s)))
    n_rates = int(np.ceil(max_rate * reach_s / pair.sigma_s))
    rates = np.linspace(-max_rate, max_rate, 2 * n_rates + 1)
    furthest_s = max_offset_s + max_rate * lever_s
    n_shifts = int(np.ceil(furthest_s / pair.sigma_s))
    shifts_s = np.linspace(-furthest_s, furthest_s, 2 * n_shifts + 1)
    found = np.full((shifts_s.size, rates.size), np.nan)
    for row, shift_s in enumerate(shifts_s):
        for column, rate in enumerate(rates):
            if abs(shift_s - rate * lever_s) <= max_offset_s * (1.0 + 1e-9):
                found[row, column] = correlation_of(pair, imu_time_s(pair, centre_s, shift_s, rate))
    high = np.where(np.isnan(found), -1.0, found)
    row, column = (int(i) for i in np.unravel_index(np.argmax(high), high.shape))
    if high[row, column] <= 0.0:
        return None
    # A ridge askew to the grid has several points above their neighbours: they are one peak as long as no
    # sample moves by more than the low-pass smears it.
    moved_s = np.abs(shifts_s[:, None] - shifts_s[row]) + np.abs(rates - rates[column]) * reach_s
    tops = (high == maximum_filter(high, size=3)) & (moved_s > SAME_PEAK_SIGMAS * pair.sigma_s)

    def peak(heights: Array) -> _Peak | None:
        at, along = np.unravel_index(np.argmax(heights), heights.shape)
        return _Peak(float(shifts_s[at]), float(rates[along])) if heights[at, along] > 0.0 else None

    best = _Peak(float(shifts_s[row]), float(rates[column]))
    return _Search(best, peak(np.where(tops, high, -1.0)), peak(np.where(np.isnan(found), -1.0, -found)))


def _moved_s(pair: YawRatePair, centre_s: float, one: _Fit, other: _Fit) -> float:
    """Return the most that any sample moves between two fits."""
    reach_s = float(np.max(np.abs(pair.time_s - centre_s)))
    return abs(one.shift_s - other.shift_s) + abs(one.rate - other.rate) * reach_s


def _nearly_as_good(rival: _Fit, best: _Fit) -> bool:
    unexplained, rival_unexplained = (1.0 - max(fit.correlation, 0.0) ** 2 for fit in (best, rival))
    return rival_unexplained < (1.0 + RIVAL_MARGIN) * unexplained + RIVAL_FLOOR


def _refine(pair: YawRatePair, centre_s: float, peak: _Peak, max_rate: float) -> _Fit:
    """Return the least-squares fit near a peak of the grid; without a rate when ``max_rate`` is 0."""
    _, there = gyro_at(pair, imu_time_s(pair, centre_s, peak.shift_s, peak.rate), pair.gyro_radps)
    wheels = pair.wheels_radps[there]
    from_centre_s = pair.time_s[there] - centre_s
    n_params = 4 if max_rate > 0.0 else 3

    def gyro_and_slope(params: Array) -> tuple[Array, Array]:
        rate = params[3] if n_params == 4 else 0.0
        imu_s = imu_time_s(pair, centre_s, params[0], rate)
        return (
            gyro_at(pair, imu_s, pair.gyro_radps)[0][there],
            gyro_at(pair, imu_s, pair.gyro_slope)[0][there],
        )

    def residual(params: Array) -> Array:
        return np.asarray(gyro_and_slope(params)[0] - params[1] * wheels - params[2])

    def jacobian(params: Array) -> Array:
        slope = gyro_and_slope(params)[1]
        return np.column_stack([slope, -wheels, -np.ones(wheels.size), slope * from_centre_s])[:, :n_params]

    reach_s = float(np.max(np.abs(pair.time_s - centre_s)))
    start = np.array([peak.shift_s, 1.0, 0.0, peak.rate])[:n_params]
    near_s = SAME_PEAK_SIGMAS * pair.sigma_s
    lowest = np.array([peak.shift_s - near_s, 0.0, -np.inf, max(peak.rate - near_s / reach_s, -max_rate)])
    highest = np.array([peak.shift_s + near_s, np.inf, np.inf, min(peak.rate + near_s / reach_s, max_rate)])
    start[3:] = np.clip(start[3:], lowest[3] + 1e-9, highest[3] - 1e-9)
    scale = np.array([pair.sigma_s, 1.0, 0.1, pair.sigma_s / reach_s])[:n_params]
    found = least_squares(
        residual, start, jac=jacobian, bounds=(lowest[:n_params], highest[:n_params]), x_scale=scale
    )
    cov = np.zeros((4, 4))
    cov[:n_params, :n_params] = _covariance(jacobian(found.x) * scale, residual(found.x)) * np.outer(
        scale, scale
    )
    shift_s, gain, _, rate = np.pad(found.x, (0, 4 - n_params))
    correlation = float(np.corrcoef(wheels, gyro_and_slope(found.x)[0])[0, 1])
    return _Fit(float(shift_s), float(rate), float(gain), cov, correlation)


def _covariance(jacobian: Array, residual: Array) -> Array:
    """Return the covariance of least squares under residuals as correlated as they are found to be.

    ``(J'J)^-1 J'R J (J'J)^-1`` with the Toeplitz matrix ``R`` of the residuals' autocovariance, cut off
    where it first falls to nothing.
    """
    shared = [float(residual @ residual)]
    for lag in range(1, residual.size // 4):
        product = float(residual[lag:] @ residual[:-lag])
        if product <= 0.0:
            break
        shared.append(product)
    n_each = 2.0 * sum(shared) / max(shared[0], 1e-300) - 1.0  # samples that say no more than one would
    n_free = max(residual.size - n_each * jacobian.shape[1], 1.0)
    spread = jacobian.T @ jacobian * shared[0] / n_free
    for lag, product in enumerate(shared[1:], start=1):
        lagged = jacobian[lag:].T @ jacobian[:-lag] * product / n_free
        spread += lagged + lagged.T
    inverse = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    return np.asarray(inverse @ spread @ inverse)


def align(run: RunLog, estimate: ClockEstimate) -> RunLog:
    """Return the run with its wheel stream on the clock of the IMU.

    With the status ``offset only`` the times are shifted and not stretched; where the clocks could not be
    compared the run comes back as it is.  Labels and all other streams stay as they are: the clock of the
    IMU is the clock of the run.

    Parameters
    ----------
    run : run log with the streams that the estimate was made from
    estimate : as :func:`terrain.logs.clock.estimate_clock` returns it

    Examples
    --------
    >>> wheels = Stream([10.0, 11.0, 12.0], [[1.0]] * 3, ("speed_left_mps",))
    >>> estimate = ClockEstimate(0.5, 0.01, 0.02, 0.001, 0.6, 0.9, "estimated", 10.0)
    >>> align(RunLog("SNOW_01", "husky", {"wheels": wheels}), estimate).streams["wheels"].time_s
    array([10.5 , 11.52, 12.54])
    """
    if estimate.status not in ("estimated", "offset only"):
        return run
    wheels = run.streams["wheels"]
    rate = 0.0 if np.isnan(estimate.rate) else estimate.rate
    since_s = wheels.time_s - estimate.reference_s
    time_s = estimate.reference_s + estimate.offset_s + (1.0 + rate) * since_s
    return replace(run, streams={**run.streams, "wheels": Stream(time_s, wheels.values, wheels.channels)})
