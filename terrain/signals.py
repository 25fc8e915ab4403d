"""Signals in time: one low-pass, one resampling, and by how much one signal is behind another.

*A pair.*  A sampled signal y follows a reference x, known on a fine even grid, late by a lag, on a clock of another
rate, with a gain and a constant that are free because they may be wrong::

    y(t) = gain x(t - lag - rate (t - middle)) + constant + noise

:func:`delay` looks at correlations over a bounded grid of lags and rates (a free search locks on to mirror images of
manoeuvres), refines the best by least squares, and calls it ambiguous where a second peak explains nearly as much.

*Many runs.*  A lag that is common to them is measured by all: each gives a curve over the lags, a likelihood say, and
their sum has one peak (:func:`common_delay`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import StrEnum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_rows
from terrain.kernels import njit
from terrain.records import Array

#: A peak elsewhere is no rival if it leaves so much more of the variance, relative; absolute is an argument.
RIVAL_MARGIN = 0.15

MEMORY_S = 2.0  #: Assumed correlation time of what a fit leaves.
MAX_STEPS, CONVERGED_S = 12, 0.003  #: Of least squares.
MIN_ROWS = 30  #: Samples of a pair, below which nothing is fitted.
MIN_SUPPORT = 30  #: Finite samples, below which a signal is not laid out on a grid.
#: So close to an end or a gap, in widths of the low-pass, it has too little to average: not used.
EDGE_SIGMAS = 3.0
MAX_GAP_SIGMAS = 3.0  #: Across a longer gap, in widths of the low-pass, nothing is interpolated.
#: A search looks at this many instants of a long run; least squares at all of them.
MAX_SEARCH_SAMPLES = 1500
N_DRAWS = 200
LOBES = 16  #: Zeros of a resampling's sinc on either side: its low-pass falls within 6 % of the Nyquist frequency.


class DelayStatus(StrEnum):
    """Whether a delay was found, and why not.

    ``offset only``: a delay whose change over time, by the rate of a clock, is not to be seen; ``not excited``: the
    signals hardly vary, or not alike; ``ambiguous``: another delay, or a mirrored gain, fits about as well; ``at
    bound``: the best fit lies on the edge of the search; ``undetermined``: too few runs show it, or too differently.
    """

    ESTIMATED = "estimated"
    OFFSET_ONLY = "offset only"
    NOT_EXCITED = "not excited"
    AMBIGUOUS = "ambiguous"
    AT_BOUND = "at bound"
    UNDETERMINED = "undetermined"


class DelayFit(NamedTuple):
    """Lag at the middle of a pair and rate, their covariance (2, 2), gain with its deviation, and correlation."""

    lag_s: float
    rate: float
    cov: Array
    gain: float
    gain_std: float
    correlation: float


class Delay(NamedTuple):
    """How late a signal is, its standard deviation, the number of runs that it is from, and the fit of a pair."""

    delay_s: float
    std_s: float
    n_runs: int
    status: DelayStatus
    fit: DelayFit | None = None

    def as_json(self) -> dict[str, Any]:
        """Return what is written of it: all but the fit."""
        return {name: value for name, value in self._asdict().items() if name != "fit"}

    @property
    def applied_s(self) -> float:
        """The delay where it was found, else 0."""
        return self.delay_s if self.status is DelayStatus.ESTIMATED else 0.0


class Pair(NamedTuple):
    """A sampled signal beside its reference."""

    time_s: Array  #: (n,) of the samples, from the first point of the grid
    measured: Array  #: (n,) NaN where a sample is missing
    step_s: float  #: of the grid
    reference: Array  #: (m,) on the grid, and its derivative; NaN where nothing supports it
    slope: Array
    middle_s: float  #: time about which a rate stretches

    def at(self, time_s: Array) -> Array:
        """Return the reference at some times; NaN outside."""
        grid_s = self.step_s * np.arange(self.reference.size)
        return np.interp(time_s, grid_s, self.reference, left=np.nan, right=np.nan)

    def correlations(self, lags_s: Array, rate: float) -> Array:
        """Return the correlation (lags,) at each lag; 0 where fewer than half of the samples have a reference."""
        return np.asarray(
            correlations(self.time_s, self.measured, self.reference, self.step_s, self.middle_s, lags_s, rate)
        )


def agreement(measured: Array, reference: Array) -> tuple[Array, Array]:
    """Return correlation about zero and gain (c,) of columns (n, c) over their reference, of rows where both are known.

    The correlation counts the level of a steady motion.  They are 0 and NaN where the reference, or both, is 0.

    Examples
    --------
    >>> agreement(np.array([[2.0], [-4.0], [np.nan]]), np.array([[1.0], [-2.0], [3.0]]))
    (array([1.]), array([2.]))
    """
    known = np.isfinite(measured) & np.isfinite(reference)
    m, p = np.where(known, measured, 0.0), np.where(known, reference, 0.0)
    product, power = (m * p).sum(axis=0), (p * p).sum(axis=0)
    norm = np.sqrt(power * (m * m).sum(axis=0))
    none = np.full(len(power), np.nan)
    correlation = np.divide(product, norm, out=np.zeros(len(norm)), where=norm > 0.0)
    return correlation, np.divide(product, power, out=none, where=power > 0.0)


def low_pass(values: Array, step_s: float, time_constant_s: float, at_first: bool = False) -> Array:
    """Return values (n, ...) at even steps behind a first-order low-pass, which starts at 0 or at the first value.

    Examples
    --------
    >>> low_pass(np.ones(3), 0.1, 0.1).round(3).tolist()
    [0.632, 0.865, 0.95]
    """
    from scipy.signal import lfilter  # half a second of import

    keep = math.exp(-step_s / time_constant_s) if time_constant_s > 0.0 else 0.0
    start = keep * values[:1] if at_first else np.zeros_like(values[:1])
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], values, axis=0, zi=start)[0])


@njit
def low_pass_step(value: float, before: float, smooth: float, step_s: float, time_constant_s: float) -> float:
    """Return what is behind a low-pass after a step: from x_0 = ``before`` and y_0 = ``smooth`` to x_1 = ``value``.

    With m the slope of the input it is ``tau y' + y = x``, exact for an input that is straight from sample to sample,
    so that a ramp is delayed by tau at any rate: with ``a = exp(-dt/tau)``::

        y_1 = x_1 - tau m + a (y_0 - x_0 + tau m)

    (The usual ``y_1 = a y_0 + (1 - a) x_1`` falls short of it by half a step: 10 ms at 50 Hz.)
    """
    lead = time_constant_s * (value - before) / step_s
    return value - lead + math.exp(-step_s / time_constant_s) * (smooth - before + lead)


def low_passed(time_s: Array, value: Array, time_constant_s: float, gap_s: float) -> Array:
    """Return a signal (n,) at any steps behind :func:`low_pass_step`.

    Parameters
    ----------
    time_s, value : (n,) strictly increasing, and finite
    time_constant_s : tau; 0 gives the signal back
    gap_s : it starts anew at the first sample, and after every longer step

    Examples
    --------
    >>> time_s = np.array([0.0, 0.1, 0.3, 0.9])
    >>> (2.0 * time_s - low_passed(time_s, 2.0 * time_s, 0.05, 1.0)).round(4)  # tends to 2.0 * 0.05
    array([0.    , 0.0865, 0.0998, 0.1   ])
    """
    return _low_passed(time_s, value, time_constant_s, gap_s) if time_constant_s > 0 else value


@njit
def _low_passed(time_s: Array, value: Array, time_constant_s: float, gap_s: float) -> Array:
    out = np.empty_like(value)
    for k in range(value.size):
        step_s = time_s[k] - time_s[k - 1]
        out[k] = value[k]
        if k > 0 and not step_s > gap_s:
            out[k] = low_pass_step(value[k], value[k - 1], out[k - 1], step_s, time_constant_s)
    return out


@lru_cache(maxsize=64)
def _resampling(n_from: int, n_to: int, step: float) -> Array:
    """Return weights (n_to, n_from) of even samples for instants ``step`` samples apart, the first at the first."""
    cutoff = min(1.0, 1.0 / step)  # over the Nyquist frequency of the samples
    reach = min(math.ceil(LOBES / cutoff), n_from - 1)
    apart = step * np.arange(n_to)[:, None] - np.arange(-reach, n_from + reach)
    taper = np.where(np.abs(apart) <= reach, np.cos(0.5 * np.pi * apart / (reach + 1)) ** 2, 0.0)
    wide = np.sinc(cutoff * apart) * taper
    wide /= wide.sum(axis=1, keepdims=True)
    weights: Array = wide[:, reach : reach + n_from].copy()
    for k in range(1, reach + 1):  # x_-k = 2 x_0 - x_k, so that a ramp goes on
        for mirrored, edge, inside in ((reach - k, 0, k), (reach + n_from - 1 + k, -1, -1 - k)):
            weights[:, edge] += 2.0 * wide[:, mirrored]
            weights[:, inside] -= wide[:, mirrored]
    return weights


def resampled(values: Array, from_hz: float, n: int, to_hz: float) -> Array:
    """Return ``n`` samples (..., n) at another rate, from the instant of the first, of even samples (..., m).

    They are behind a low-pass at the lower of the two Nyquist frequencies: a sinc of :data:`LOBES` zeros on either
    side under a cosine squared (Smith, Digital Audio Resampling), mirrored at the ends through the last sample.  One
    is NaN where those that are known carry less than half of the weight.

    Examples
    --------
    >>> resampled(np.arange(6.0), 2.0, 3, 1.0).round(6).tolist()
    [0.0, 2.0, 4.0]
    >>> resampled(np.arange(3.0), 1.0, 5, 2.0).round(6).tolist()
    [0.0, 0.5, 1.0, 1.5, 2.0]
    """
    weights = _resampling(values.shape[-1], n, from_hz / to_hz).T
    known = np.isfinite(values)
    if known.all():
        return np.asarray(values @ weights)
    weight = known @ weights
    found = np.where(known, values, 0.0) @ weights
    return np.asarray(np.divide(found, weight, out=np.full(found.shape, np.nan), where=weight >= 0.5))


def true_stretches(mask: Array) -> Array:
    """Return first and end (k, 2) of the stretches of a mask (n,), the end exclusive.

    Examples
    --------
    >>> true_stretches(np.array([True, False, True, True])).tolist()
    [[0, 1], [2, 4]]
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(mask).astype(int), [0]])))
    return edges.reshape(-1, 2)


def at_times(time_s: Array, values: Array, at_s: Array, max_gap_s: float) -> Array:
    """Return samples (n, c) at other times (m,), on straight lines; NaN outside, and within longer gaps."""
    after = np.searchsorted(time_s, at_s)
    inside = (after > 0) & (after < len(time_s))
    inside[inside] = time_s[after[inside]] - time_s[after[inside] - 1] <= max_gap_s
    found = np.full((len(at_s), values.shape[1]), np.nan)
    for i, column in enumerate(values.T):
        found[inside, i] = np.interp(at_s[inside], time_s, column)
    return found


def smooth_on_grid(time_s: Array, values: Array, sigma_s: float, n_steps: int) -> tuple[Array, Array]:
    """Return an even grid (m,) of ``n_steps`` a sigma, and samples (n,) behind a Gaussian low-pass on it.

    NaN near an end or a gap, where samples do not support it.
    """
    from scipy.ndimage import binary_erosion, gaussian_filter1d

    finite = np.isfinite(values)
    step_s = sigma_s / n_steps
    grid_s = np.arange(time_s[0], time_s[-1] + 1e-6 * step_s, step_s)
    if finite.sum() < MIN_SUPPORT:
        return grid_s, np.full(grid_s.size, np.nan)
    time_s, values = time_s[finite], values[finite]
    after = np.clip(np.searchsorted(time_s, grid_s), 1, time_s.size - 1)
    near = time_s[after] - time_s[after - 1] <= MAX_GAP_SIGMAS * sigma_s
    inside = (grid_s >= time_s[0] - step_s) & (grid_s <= time_s[-1] + step_s)
    supported = binary_erosion(near & inside, iterations=int(EDGE_SIGMAS * n_steps))
    smooth = gaussian_filter1d(np.interp(grid_s, time_s, values), n_steps, mode="nearest")
    return grid_s, np.where(supported, smooth, np.nan)


@njit
def correlations(
    time_s: Array,
    measured: Array,
    reference: Array,
    step_s: float,
    middle_s: float,
    lags_s: Array,
    rate: float,
) -> Array:
    """Return the correlation (lags,) of a signal with a reference on a fine grid; 0 where few samples meet."""
    out = np.zeros(lags_s.size)
    known = np.isfinite(measured)
    n = known.sum()
    for a in range(lags_s.size):
        met = 0
        x, y, xx, yy, xy = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(time_s.size):
            at = (time_s[k] - lags_s[a] - rate * (time_s[k] - middle_s)) / step_s
            if not known[k] or at < 0.0 or at >= reference.size - 1:
                continue
            i = int(at)
            value = reference[i] + (at - i) * (reference[i + 1] - reference[i])
            if math.isnan(value):
                continue
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


def delay(
    pair: Pair,
    lags_s: Array,
    rates: Sequence[float] = (0.0,),
    *,
    same_peak_s: float,
    floor: float,
    min_correlation: float = 0.0,
    within: Callable[[Array, Array], Array] | None = None,
    mirrored: bool = False,
    near_s: float | None = None,
    **refine: Any,
) -> Delay:
    """Return by how much a signal is behind its reference, at the middle of the pair.

    The status is ``not excited`` where no lag fits, ``ambiguous`` where another does about as well.

    Parameters
    ----------
    pair : signal and reference
    lags_s, rates : grid of the search
    same_peak_s : peaks that shift no sample further apart are one
    floor : of the variance, by which a rival must leave more, beside a relative margin
    min_correlation : at the best point of the grid
    within : of lags (lags, 1) and rates (rates,), which points of the grid count; by default all
    mirrored : whether the most negative correlation is a rival too: a gain may be mirrored
    near_s, refine : of :func:`refine_delay`
    """
    every = -(-pair.time_s.size // MAX_SEARCH_SAMPLES)
    few = pair._replace(time_s=pair.time_s[::every].copy(), measured=pair.measured[::every].copy())
    table = np.stack([few.correlations(lags_s, rate) for rate in rates], axis=1)
    if within is not None:
        table[~within(lags_s[:, None], np.asarray(rates))] = 0.0
    reach_s = float(np.max(np.abs(few.time_s - few.middle_s)))

    def refined(seen: Pair, heights: Array) -> DelayFit | None:
        row, column = map(int, np.unravel_index(np.argmax(heights), heights.shape))
        if not heights[row, column] > 0.0:
            return None
        return refine_delay(
            seen, float(lags_s[row]), float(rates[column]), near_s=near_s or same_peak_s, **refine
        )

    row, column = map(int, np.unravel_index(np.argmax(table), table.shape))
    fit = refined(pair, table) if table[row, column] > min_correlation else None
    if fit is None:
        return Delay(math.nan, math.nan, 1, DelayStatus.NOT_EXCITED)
    # A ridge askew to the grid has several points above their neighbours: they are one peak.
    apart_s = np.abs(lags_s[:, None] - lags_s[row]) + np.abs(np.asarray(rates) - rates[column]) * reach_s
    around = np.pad(table, 1, constant_values=-np.inf)
    top = table == np.max(
        [around[i:, j:][: table.shape[0], : table.shape[1]] for i in range(3) for j in range(3)], axis=0
    )
    rivals = [(pair, np.where(top & (apart_s > same_peak_s), table, -1.0))]
    rivals += [(pair._replace(measured=-pair.measured), -table)] if mirrored else []
    status = DelayStatus.ESTIMATED
    for seen, heights in rivals:
        rival = refined(seen, heights)
        if rival is None:
            continue
        moved_s = abs(rival.lag_s - fit.lag_s) + abs(rival.rate - fit.rate) * reach_s
        left, rival_left = (1.0 - min(max(each.correlation, 0.0), 1.0) ** 2 for each in (fit, rival))
        if (seen is not pair or moved_s > same_peak_s) and rival_left < (1 + RIVAL_MARGIN) * left + floor:
            status = DelayStatus.AMBIGUOUS
    return Delay(fit.lag_s, math.sqrt(fit.cov[0, 0]), 1, status, fit)


def refine_delay(
    pair: Pair,
    lag_s: float,
    rate: float,
    *,
    near_s: float,
    rate_max: float,
    rate_stays: bool = False,
    at_bounds: bool = False,
    memory_s: float | None = MEMORY_S,
    min_rows: int = MIN_ROWS,
    event: tuple[float, float] | None = None,
) -> DelayFit | None:
    """Return lag and rate, or the lag alone, by least squares from a start, or None if they diverge.

    Gain and constant are fitted beside them.  The covariance is ``(J'J)^-1 J'R J (J'J)^-1`` with the
    autocovariance ``R`` of what is left.

    Parameters
    ----------
    pair : signal and reference
    lag_s, rate : start
    near_s, rate_max : how far the lag may go from there, and how large the rate may be
    rate_stays : keep the rate, and fit a drift in its place
    at_bounds : steps end at these bounds, and the last one is a fit; by default what leaves them or does not come
        to rest is none
    memory_s : over which what is left is correlated, each regressor by itself; None: as it is found to be
    min_rows : samples that have a reference, at least
    event : a time and a ratio: no delay is found if so much of its information comes from so short a time
    """
    start_s, centred_s = lag_s, pair.time_s - pair.middle_s
    fine_s = pair.step_s * np.arange(pair.reference.size)
    for _ in range(MAX_STEPS):
        at_s = pair.time_s - lag_s - rate * centred_s
        value, slope = np.interp(at_s, fine_s, pair.reference), np.interp(at_s, fine_s, pair.slope)
        use = np.isfinite(pair.measured + value + slope) & (at_s > 0.0) & (at_s < fine_s[-1])
        if use.sum() < min_rows:
            return None
        value, seen = value[use], pair.measured[use]
        level = value - value.mean()
        gain = float(level @ seen) / max(float(level @ level), 1e-12)
        late = -gain * slope[use]
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
        if at_bounds:
            by_s = min(max(by_s, start_s - near_s - lag_s), start_s + near_s - lag_s)
            faster = min(max(faster, -rate_max - rate), rate_max - rate)
        lag_s, rate = lag_s + by_s, rate + faster
        if abs(by_s) + abs(faster) * centred_s[-1] < CONVERGED_S:
            break
    else:
        if not at_bounds:
            return None
    if not at_bounds and (abs(lag_s - start_s) > near_s or abs(rate) > rate_max):
        return None
    period_s = float(pair.time_s[1] - pair.time_s[0])
    power = late * late
    if event is not None:
        rows = math.ceil(event[0] / period_s)
        if np.convolve(power, np.ones(min(rows, power.size))).max() > event[1] * power.sum():
            return None
    inverse = np.linalg.inv(gram)
    every = inverse @ _spread(j, left, None if memory_s is None else math.ceil(memory_s / period_s)) @ inverse
    cov = every[:2, :2] / np.outer(size[:2], size[:2])
    if rate_stays:
        cov[0, 1] = cov[1, 0] = 0.0
    if not (cov[0, 0] > 0 and cov[1, 1] > 0):
        return None
    gain_std = math.sqrt(max(float(every[2, 2]), 0.0)) / float(size[2])
    return DelayFit(lag_s, rate, cov, gain, gain_std, float(np.corrcoef(value, seen)[0, 1]))


def _spread(j: Array, left: Array, lags: int | None) -> Array:
    """Return the covariance (k, k) of what residuals add to the normal equations of regressors (k, n).

    The autocovariance of each regressor's own products, tapered over some lags; without a number of them, that of
    the residuals by itself, cut off where it first falls to nothing, for few samples.
    """
    if lags is not None:
        scores = j * left
        spread = scores @ scores.T
        for lag in range(1, lags):
            lagged = (1.0 - lag / lags) * scores[:, lag:] @ scores[:, :-lag].T
            spread += lagged + lagged.T
        return np.asarray(spread)
    shared = [float(left @ left)]
    for lag in range(1, left.size // 4):
        product = float(left[lag:] @ left[:-lag])
        if product <= 0.0:
            break
        shared.append(product)
    n_each = 2.0 * sum(shared) / max(shared[0], 1e-300) - 1.0  # samples that say no more than one would
    n_free = max(left.size - n_each * len(j), 1.0)
    spread = j @ j.T * shared[0] / n_free
    for lag, product in enumerate(shared[1:], start=1):
        lagged = j[:, lag:] @ j[:, :-lag].T * product / n_free
        spread += lagged + lagged.T
    return np.asarray(spread)


def peak(lags_s: Array, curve: Array) -> float:
    """Return the lag of the highest point of a curve at even lags, by a parabola through it and its neighbours.

    Examples
    --------
    >>> lags_s = np.arange(5.0)
    >>> peak(lags_s, -((lags_s - 2.2) ** 2))
    2.2
    """
    i = int(np.argmax(curve))
    if i in (0, curve.size - 1):
        return float(lags_s[i])
    before, at, after = curve[i - 1 : i + 2]
    bend = before - 2.0 * at + after
    step_s = float(lags_s[1] - lags_s[0])
    return float(lags_s[i] + (0.5 * step_s * (before - after) / bend if bend < 0.0 else 0.0))


def common_delay(lags_s: Array, curves: Sequence[Array], max_std_s: float = math.inf, seed: int = 0) -> Delay:
    """Return the lag that is common to runs, and its standard deviation by bootstrap over them.

    Parameters
    ----------
    lags_s : (lags,) even
    curves : (lags,) of each run, high where it fits, as a likelihood; none is undetermined
    max_std_s : a delay that is less certain is undetermined, and so is one at an end of the lags
    seed : of the bootstrap
    """
    if not len(curves):
        return Delay(math.nan, math.nan, 0, DelayStatus.UNDETERMINED)
    table = np.asarray(curves)
    draws = bootstrap_rows(len(table), N_DRAWS, np.random.default_rng(seed))
    delay_s = peak(lags_s, table.sum(axis=0))
    std_s = float(np.std([peak(lags_s, table[draw].sum(axis=0)) for draw in draws]))
    found = lags_s[1] < delay_s < lags_s[-2] and std_s <= max_std_s
    return Delay(delay_s, std_s, len(table), DelayStatus.ESTIMATED if found else DelayStatus.UNDETERMINED)
