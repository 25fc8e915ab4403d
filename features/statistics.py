"""Statistics of one channel over one window, for all windows at once.

Symbols: x the n samples of a channel, m their mean, s their standard deviation (1/n).
"""

from __future__ import annotations

import math

import numpy as np

from terrain.kernels import njit
from terrain.records import Array

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)

STATISTICS: tuple[tuple[str, str], ...] = (
    ("mean", "x"),
    ("std", "x"),
    ("log_std", "1"),
    ("skewness", "1"),
    ("kurtosis", "1"),
    ("min", "x"),
    ("max", "x"),
    ("q05", "x"),
    ("q25", "x"),
    ("median", "x"),
    ("q75", "x"),
    ("q95", "x"),
    ("iqr", "x"),
    ("rms", "x"),
    ("mean_abs", "x"),
    ("crest", "1"),
    ("zero_crossings", "1/s"),
    ("mean_abs_step", "x"),
    ("log_step_ratio", "1"),
    ("autocorrelation_1", "1"),
    ("autocorrelation_2", "1"),
    ("autocorrelation_4", "1"),
    ("autocorrelation_8", "1"),
)
"""Name and unit of each column; ``x`` is the unit of the channel."""

_LAGS = (1, 2, 4, 8)
_FLAT = 1e-9  # a standard deviation under this is rounding, not a signal
_FLOOR = 1e-4  # SI unit, under a logarithm: the resolution of a good sensor; a constant signal is no outlier


@njit
def _quantile(ordered: Array, q: float) -> float:
    position = q * (ordered.size - 1)
    low = int(position)
    high = min(low + 1, ordered.size - 1)
    return ordered[low] + (position - low) * (ordered[high] - ordered[low])  # type: ignore[no-any-return]


@njit
def _statistics(values: Array, in_order: Array, rate_hz: float, out: Array) -> None:
    n_windows, n_channels, n = values.shape
    for i in range(n_windows):
        for c in range(n_channels):
            x = values[i, c]
            mean = 0.0
            square = 0.0
            absolute = 0.0
            for k in range(n):
                mean += x[k]
                square += x[k] * x[k]
                absolute += abs(x[k])
            mean /= n
            m2 = 0.0
            m3 = 0.0
            m4 = 0.0
            peak = 0.0
            crossings = 0
            steps = 0.0
            for k in range(n):
                d = x[k] - mean
                m2 += d * d
                m3 += d * d * d
                m4 += d * d * d * d
                peak = max(peak, abs(d))
                if k > 0:
                    previous = x[k - 1] - mean
                    steps += abs(d - previous)
                    if (d >= 0.0) != (previous >= 0.0):
                        crossings += 1
            m2 /= n
            std = math.sqrt(m2)
            flat = std <= _FLAT
            ordered = in_order[i, c]
            row = out[i, c]
            row[0] = mean
            row[1] = std
            row[2] = math.log10(std + _FLOOR)
            row[3] = 0.0 if flat else m3 / n / (m2 * std)
            row[4] = 0.0 if flat else m4 / n / (m2 * m2) - 3.0
            row[5] = ordered[0]
            row[6] = ordered[n - 1]
            row[7] = _quantile(ordered, 0.05)
            row[8] = _quantile(ordered, 0.25)
            row[9] = _quantile(ordered, 0.5)
            row[10] = _quantile(ordered, 0.75)
            row[11] = _quantile(ordered, 0.95)
            row[12] = row[10] - row[8]
            row[13] = math.sqrt(square / n)
            row[14] = absolute / n
            row[15] = 0.0 if flat else peak / std
            row[16] = crossings * rate_hz / n
            row[17] = steps / (n - 1)
            row[18] = 0.0 if flat else math.log10((row[17] + _FLOOR) / std)
            for j in range(len(_LAGS)):
                lag = _LAGS[j]
                total = 0.0
                for k in range(n - lag):
                    total += (x[k] - mean) * (x[k + lag] - mean)
                row[19 + j] = 0.0 if flat or lag >= n else total / n / m2


def channel_statistics(values: Array, rate_hz: float) -> Array:
    """Return the statistics of every channel in every window.

    A flat channel (standard deviation 0) has shape statistics of 0.

    Parameters
    ----------
    values : (n_windows, n_channels, n_samples), finite
    rate_hz : sampling rate, for zero crossings per second (about the mean)

    Returns
    -------
    (n_windows, n_channels, len(STATISTICS))

    Examples
    --------
    >>> names = [name for name, _ in STATISTICS]
    >>> row = channel_statistics(np.array([[[1.0, -1.0, 1.0, -1.0]]]), 10.0)[0, 0]
    >>> row[names.index("rms")], row[names.index("zero_crossings")]
    (np.float64(1.0), np.float64(7.5))
    """
    out = np.empty((*values.shape[:2], len(STATISTICS)))
    values = np.ascontiguousarray(values, dtype=np.float64)
    _statistics(values, np.sort(values, axis=2), float(rate_hz), out)  # numpy sorts faster than numba does
    return out


@njit
def _correlations(values: Array, out: Array) -> None:
    n_windows, n_channels, n = values.shape
    centred = np.empty((n_channels, n))
    norm = np.empty(n_channels)
    for i in range(n_windows):
        for c in range(n_channels):
            mean = 0.0
            for k in range(n):
                mean += values[i, c, k]
            mean /= n
            norm[c] = 0.0
            for k in range(n):
                centred[c, k] = values[i, c, k] - mean
                norm[c] += centred[c, k] * centred[c, k]
            norm[c] = math.sqrt(norm[c])
        j = 0
        for a in range(n_channels):
            for b in range(a + 1, n_channels):
                total = 0.0
                for k in range(n):
                    total += centred[a, k] * centred[b, k]
                scale = norm[a] * norm[b]
                out[i, j] = total / scale if scale > _FLAT * _FLAT else 0.0
                j += 1


def channel_correlations(values: Array) -> Array:
    """Return the correlation of each pair of channels; 0 where one of them is flat.

    Parameters
    ----------
    values : (n_windows, n_channels, n_samples), finite

    Returns
    -------
    (n_windows, n_channels (n_channels - 1) / 2), pairs in the order (0, 1), (0, 2), ...
    """
    n_channels = values.shape[1]
    out = np.empty((values.shape[0], n_channels * (n_channels - 1) // 2))
    _correlations(np.ascontiguousarray(values, dtype=np.float64), out)
    return out
