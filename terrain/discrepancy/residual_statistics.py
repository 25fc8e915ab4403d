"""Statistics of residuals: their spectra, and their means over bins of an input and over runs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import welch
from scipy.stats import t as student

from terrain.records import Array

N_BINS = 6

TAIL_RATIO = 0.01
"""Part of an input's values beyond the outer bins on either side: outliers would stretch all of them."""

MIN_IN_BIN = 3
"""Least rows of a run in a bin for a mean."""

SEGMENT_ROWS = 64
"""Longest segment of a spectrum: some 10 s."""

MIN_SEGMENT_ROWS = 8
"""Shortest segment of a spectrum."""

COVARIANCE_ROWS = 8192
"""Grid of the spectrum from which the covariance of coloured noise is taken."""


class BinnedMeans(NamedTuple):
    """Means of residuals over bins of an input: centres, means and half 95 % intervals (bins,)."""

    centre: Array
    mean: Array
    half_interval: Array


def spectrum(residuals: Sequence[Array], rate_hz: float) -> tuple[Array, Array]:
    """Return frequencies and one-sided density of residuals of several runs, of stretches without a hole.

    The segment length is halved until half of the known rows lie in stretches of that length; where no
    stretch has :data:`MIN_SEGMENT_ROWS`, the density is NaN.
    """
    parts = [part for values in residuals for part in _without_holes(values)]
    n_known = sum(map(len, parts))
    n_rows = SEGMENT_ROWS
    while n_rows > MIN_SEGMENT_ROWS and 2 * sum(len(part) for part in parts if len(part) >= n_rows) < n_known:
        n_rows //= 2
    long = [part for part in parts if len(part) >= n_rows]
    total = np.zeros(n_rows // 2 + 1) if long else np.full(n_rows // 2 + 1, np.nan)
    for part in long:
        total += len(part) * welch(part, rate_hz, nperseg=n_rows, detrend=False)[1]
    frequency = np.fft.rfftfreq(n_rows, 1.0 / rate_hz)
    return frequency[1:], total[1:] / max(sum(map(len, long)), 1)


def noise_spectrum(weights: Array, frequency_hz: Array, rate_hz: float) -> Array:
    """Return the one-sided density of the noise that a whitening filter (order + 1,) turns white."""
    turn = np.exp(-2j * np.pi * np.outer(frequency_hz / rate_hz, np.arange(len(weights))))
    density: Array = 2.0 / rate_hz / np.abs(turn @ weights) ** 2
    return density


def _without_holes(values: Array) -> Iterator[Array]:
    """Yield the stretches of a signal without a hole."""
    known = np.isfinite(values)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        yield values[start:end]


def input_range(known: Array) -> tuple[float, float]:
    """Return the range of values without outliers."""
    low, high = np.quantile(known, [TAIL_RATIO, 1.0 - TAIL_RATIO])
    return float(low), float(high)


def binned_means(inputs: Sequence[Array], residuals: Sequence[Array]) -> BinnedMeans:
    """Return the means of residuals in bins of equal width, with intervals over runs.

    Examples
    --------
    >>> x = np.linspace(-0.06, 6.06, 613)
    >>> centres, means, _ = binned_means([x, x], [2 * x, 2 * x + 2])
    >>> centres.round(1), means.round(0)
    (array([0.5, 1.5, 2.5, 3.5, 4.5, 5.5]), array([ 2.,  4.,  6.,  8., 10., 12.]))
    """
    known = np.concatenate([x[np.isfinite(x)] for x in inputs])
    nothing = np.empty(0)
    if not known.size:
        return BinnedMeans(nothing, nothing, nothing)
    edges = np.linspace(*input_range(known), N_BINS + 1)
    found = []
    for low, high in itertools.pairwise(edges):
        each = []
        for given, left in zip(inputs, residuals, strict=True):
            inside = (given >= low) & (given < high) & np.isfinite(left)
            if inside.sum() >= MIN_IN_BIN:
                each.append(float(left[inside].mean()))
        n = len(each)
        if n:
            half = student.ppf(0.975, n - 1) * np.std(each, ddof=1) / math.sqrt(n) if n > 2 else math.nan
            found.append(((low + high) / 2, float(np.mean(each)), half))
    return BinnedMeans(*np.array(found).T) if found else BinnedMeans(nothing, nothing, nothing)


def run_means(residuals: Sequence[Array], sizes: Sequence[Array], weights: Array) -> tuple[Array, Array]:
    """Return the mean of each run and half its 95 % interval, if all but the mean is coloured noise.

    Parameters
    ----------
    residuals : (m,) of each run
    sizes : (m,) of the noise
    weights : of the filter that whitens it
    """
    covariance = np.fft.irfft(1.0 / np.abs(np.fft.rfft(weights, COVARIANCE_ROWS)) ** 2)
    means, halves = [], []
    for left, size in zip(residuals, sizes, strict=True):
        known = np.isfinite(left)
        n = int(known.sum())
        if not n:
            means.append(math.nan)
            halves.append(math.nan)
            continue
        lags = np.arange(1, min(n, COVARIANCE_ROWS // 2))
        spread = (covariance[0] + 2.0 * float(((1.0 - lags / n) * covariance[lags]).sum())) / n
        means.append(float(left[known].mean()))
        halves.append(1.96 * math.sqrt(float((size[known] ** 2).mean()) * max(spread, 0.0)))
    return np.array(means), np.array(halves)
