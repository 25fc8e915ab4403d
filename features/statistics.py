"""Statistics, spectra and correlations of the channels of windows, for all windows at once.

Symbols: x the n samples of a channel, m their mean, s their standard deviation (1/n).

For spectra the window is centred and tapered (Hann); ``P(f)`` is its one-sided periodogram without the line at 0 Hz.
Bands divide the range from the first line to Nyquist evenly, so that at every rate a band covers the same
fraction of the range that the sensor resolves.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import fft

from terrain.kernels import njit
from terrain.records import Array

#: Name and unit of each column; ``x`` is the unit of the channel.
STATISTICS: tuple[tuple[str, str], ...] = (
    *(("mean", "x"), ("std", "x"), ("log_std", "1"), ("skewness", "1"), ("kurtosis", "1"), ("min", "x")),
    *(("max", "x"), ("q05", "x"), ("q25", "x"), ("median", "x"), ("q75", "x"), ("q95", "x"), ("iqr", "x")),
    *(("rms", "x"), ("mean_abs", "x"), ("crest", "1"), ("zero_crossings", "1/s"), ("mean_abs_step", "x")),
    *(("log_step_ratio", "1"), ("autocorrelation_1", "1"), ("autocorrelation_2", "1")),
    *(("autocorrelation_4", "1"), ("autocorrelation_8", "1")),
)

MOMENTS: tuple[tuple[str, str], ...] = (
    *(("log_power", "1"), ("centroid", "Hz"), ("spread", "Hz"), ("spectral_skewness", "1")),
    *(("spectral_kurtosis", "1"), ("entropy", "1"), ("flatness", "1"), ("rolloff", "Hz"), ("peak", "Hz")),
    ("peak_ratio", "1"),
)

SLIP_STATISTICS: tuple[tuple[str, str], ...] = tuple(
    (name, "1") for name in ("mean", "std", "min", "max", "mean_abs", "median")
)

MIN_DEFINED_FRACTION = 0.2  #: With a smaller fraction of the window defined, its slip statistics are NaN.
MAX_BANDS, MIN_BINS_PER_BAND = 20, 2
MIN_SAMPLES = 48  #: A spectrum of fewer samples has too few lines to add anything to the autocorrelation.
ROLLOFF = 0.85

_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_LAGS = (1, 2, 4, 8)
_FLAT = 1e-9  # a standard deviation under this is rounding, not a signal
_FLOOR = 1e-4  # SI unit, under a logarithm: the resolution of a good sensor; a constant signal is no outlier
_POWER_FLOOR = 1e-10  # squared SI unit per Hz, under a logarithm: the noise density of a good sensor


@njit
def _statistics(values: Array, in_order: Array, rate_hz: float, out: Array) -> None:
    n_windows, n_channels, n = values.shape
    for i in range(n_windows):
        for c in range(n_channels):
            x = values[i, c]
            mean = square = absolute = 0.0
            for k in range(n):
                mean += x[k]
                square += x[k] * x[k]
                absolute += abs(x[k])
            mean /= n
            m2 = m3 = m4 = peak = steps = 0.0
            crossings = 0
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
            for j in range(len(_QUANTILES)):
                position = _QUANTILES[j] * (n - 1)
                low = int(position)
                high = min(low + 1, n - 1)
                row[7 + j] = ordered[low] + (position - low) * (ordered[high] - ordered[low])
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
    """Return the :data:`STATISTICS` (n_windows, n_channels, 23) of finite values (n_windows, n_channels, n_samples).

    Zero crossings are about the mean.  A flat channel (standard deviation 0) has shape statistics of 0.

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
    """Return the correlation of each pair of channels (0, 1), (0, 2), ... (n_windows, pairs); 0 where one is flat."""
    n_channels = values.shape[1]
    out = np.empty((values.shape[0], n_channels * (n_channels - 1) // 2))
    _correlations(np.ascontiguousarray(values, dtype=np.float64), out)
    return out


def n_bands(n_samples: int) -> int:
    """Return the number of bands of a window of ``n_samples``.

    Examples
    --------
    >>> n_bands(200), n_bands(50)
    (20, 12)
    """
    return int(np.clip((n_samples // 2) // MIN_BINS_PER_BAND, 1, MAX_BANDS))


def spectrum_names(n_samples: int) -> list[tuple[str, str]]:
    """Return name and unit of each column of :func:`channel_spectra`."""
    bands = n_bands(n_samples)
    return [(f"log_band_{b + 1}of{bands}", "1") for b in range(bands)] + list(MOMENTS)


def channel_spectra(values: Array, rate_hz: float) -> Array:
    """Return log10 band powers and :data:`MOMENTS` of finite values (n_windows, n_channels, n_samples).

    They are (n_windows, n_channels, n_bands + 10); a channel without power has moments of 0.

    Examples
    --------
    >>> time = np.arange(200) / 100
    >>> row = channel_spectra(np.sin(2 * np.pi * 20 * time)[None, None], 100.0)[0, 0]
    >>> names = [name for name, _ in spectrum_names(200)]
    >>> round(float(row[names.index("peak")]), 2), round(float(row[names.index("centroid")]), 1)
    (20.0, 20.0)
    """
    n = values.shape[2]
    taper = 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(n) + 0.5) / n)
    centred = (values - values.mean(axis=2, keepdims=True)) * taper
    lines = fft.rfft(centred, axis=2)[:, :, 1:]
    power = (lines.real**2 + lines.imag**2) * (2.0 / (rate_hz * np.sum(taper**2)))
    if n % 2 == 0:
        power[:, :, -1] /= 2  # Nyquist is its own mirror image
    bands = n_bands(n)
    edges = np.linspace(0, power.shape[2], bands + 1).round().astype(np.int64)
    out = np.empty((*values.shape[:2], bands + len(MOMENTS)))
    _describe(power, np.log(power + _POWER_FLOOR), edges, rate_hz / n, out)
    out[:, :, : bands + 1] = np.log10(out[:, :, : bands + 1] + _POWER_FLOOR)
    return out


@njit
def _describe(power: Array, log_power: Array, edges: Array, resolution_hz: float, out: Array) -> None:
    """Fill in mean band powers, total power (both not yet under a logarithm) and the other moments."""
    n_windows, n_channels, n_lines = power.shape
    bands = edges.size - 1
    for i in range(n_windows):
        for c in range(n_channels):
            p, log_p, row = power[i, c], log_power[i, c], out[i, c]
            total = 0.0
            for b in range(bands):
                band = 0.0
                for k in range(edges[b], edges[b + 1]):
                    band += p[k]
                row[b] = band / (edges[b + 1] - edges[b])
                total += band
            row[bands] = total * resolution_hz
            if total <= _POWER_FLOOR:
                row[bands + 1 :] = 0.0
                continue
            centroid = log_mean = log_weighted = 0.0
            peak = 0
            for k in range(n_lines):
                centroid += p[k] / total * (k + 1)
                log_mean += log_p[k]
                log_weighted += p[k] / total * log_p[k]
                if p[k] > p[peak]:
                    peak = k
            m2 = m3 = m4 = sum_so_far = 0.0
            rolloff = n_lines
            for k in range(n_lines):
                d = k + 1 - centroid
                weight = p[k] / total
                m2 += weight * d * d
                m3 += weight * d * d * d
                m4 += weight * d * d * d * d
                sum_so_far += p[k]
                if rolloff == n_lines and sum_so_far >= ROLLOFF * total:
                    rolloff = k + 1
            width = max(math.sqrt(m2), 1.0)  # not under the resolution
            row[bands + 1] = centroid * resolution_hz
            row[bands + 2] = math.sqrt(m2) * resolution_hz
            row[bands + 3] = m3 / width**3
            row[bands + 4] = m4 / width**4
            row[bands + 5] = (math.log(total + _POWER_FLOOR) - log_weighted) / math.log(n_lines)
            row[bands + 6] = math.exp(log_mean / n_lines) / (total / n_lines + _POWER_FLOOR)
            row[bands + 7] = rolloff * resolution_hz
            row[bands + 8] = (peak + 1) * resolution_hz
            row[bands + 9] = p[peak] / total


def slip_statistics(slip_ratio: Array) -> Array:
    """Return the :data:`SLIP_STATISTICS` (n_windows, wheels, 6) of slip (n_windows, wheels, n_samples).

    Slip is not finite where it is undefined; of a window of which under a fifth is defined, all are NaN.

    Examples
    --------
    >>> slip_statistics(np.array([[[0.1, np.nan, 0.3]], [[np.nan] * 3]]))[:, 0, 0].round(3)
    array([0.2, nan])
    """
    slip_ratio = np.where(np.isfinite(slip_ratio), slip_ratio, np.nan)
    out = np.full((*slip_ratio.shape[:2], len(SLIP_STATISTICS)), np.nan)
    known = (~np.isnan(slip_ratio)).mean(axis=2) >= MIN_DEFINED_FRACTION
    if known.any():
        x = slip_ratio[known]
        plain = [of(x, axis=1) for of in (np.nanmean, np.nanstd, np.nanmin, np.nanmax)]
        out[known] = np.stack([*plain, np.nanmean(np.abs(x), axis=1), np.nanmedian(x, axis=1)], axis=1)
    return out
