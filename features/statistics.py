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

MIN_DEFINED_FRACTION = 0.5  #: With a smaller fraction of the window defined, its slip statistics are NaN.
MAX_BANDS, MIN_BINS_PER_BAND = 20, 2
MIN_SAMPLES = 48  #: A spectrum of fewer samples has too few lines to add anything to the autocorrelation.
ROLLOFF = 0.85

_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_LAGS = (1, 2, 4, 8)
_FLAT = 1e-9  # a standard deviation under this is rounding, not a signal
_FLOOR = 1e-4  # SI unit, under a logarithm: the resolution of a good sensor; a constant signal is no outlier
_POWER_FLOOR = 1e-10  # squared SI unit per Hz, under a logarithm: the noise density of a good sensor


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
    x = np.ascontiguousarray(values, dtype=np.float64)
    n = x.shape[2]
    mean, ordered = x.mean(axis=2), np.sort(x, axis=2)
    d = x - mean[:, :, None]
    square = d * d
    m2, m3, m4 = (each.mean(axis=2) for each in (square, square * d, square * square))
    std = np.sqrt(m2)
    flat = std <= _FLAT
    unit = np.where(flat, 1.0, std)  # of what has no shape
    position = np.array(_QUANTILES) * (n - 1)
    low = position.astype(int)
    below, above = ordered[:, :, low], ordered[:, :, np.minimum(low + 1, n - 1)]
    quantiles = np.moveaxis(below + (position - low) * (above - below), 2, 0)
    step = np.abs(np.diff(x, axis=2)).mean(axis=2)
    lags = [(d[:, :, lag:] * d[:, :, :-lag]).sum(axis=2) / n if lag < n else 0.0 * mean for lag in _LAGS]
    shapes = [
        m3 / (unit * unit * unit),
        m4 / (unit * unit) ** 2 - 3.0,
        np.abs(d).max(axis=2) / unit,
        np.log10((step + _FLOOR) / unit),
        *(lag / (unit * unit) for lag in lags),
    ]
    skewness, kurtosis, crest, step_ratio, *correlations = (np.where(flat, 0.0, each) for each in shapes)
    crossings = np.diff(d >= 0.0, axis=2).sum(axis=2) * rate_hz / n
    columns = (
        *(mean, std, np.log10(std + _FLOOR), skewness, kurtosis, ordered[:, :, 0], ordered[:, :, -1]),
        *(*quantiles, quantiles[3] - quantiles[1], np.sqrt((x * x).mean(axis=2)), np.abs(x).mean(axis=2)),
        *(crest, crossings, step, step_ratio, *correlations),
    )
    return np.stack(columns, axis=2)


def channel_correlations(values: Array) -> Array:
    """Return the correlation of each pair of channels (0, 1), (0, 2), ... (n_windows, pairs); 0 where one is flat."""
    d = np.ascontiguousarray(values, dtype=np.float64)
    d = d - d.mean(axis=2, keepdims=True)
    norm = np.sqrt((d * d).sum(axis=2))
    a, b = np.triu_indices(values.shape[1], 1)
    scale = norm[:, a] * norm[:, b]
    varies = scale > _FLAT**2
    return np.where(varies, (d @ d.swapaxes(1, 2))[:, a, b] / np.where(varies, scale, 1.0), 0.0)


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
    edges = np.linspace(0, power.shape[2], n_bands(n) + 1).round().astype(np.int64)
    bands, total = np.add.reduceat(power, edges[:-1], axis=2), power.sum(axis=2)
    silent, n_lines, resolution_hz = total <= _POWER_FLOOR, power.shape[2], rate_hz / n
    weight, line = power / np.where(silent, 1.0, total)[:, :, None], np.arange(1, n_lines + 1)
    centroid, log_power = (weight * line).sum(axis=2), np.log(power + _POWER_FLOOR)
    away = line - centroid[:, :, None]
    square = weight * away * away
    m2, m3, m4 = (each.sum(axis=2) for each in (square, square * away, square * away * away))
    width = np.maximum(np.sqrt(m2), 1.0)  # not under the resolution
    reached = np.cumsum(power, axis=2) >= ROLLOFF * total[:, :, None]
    moments = (
        centroid * resolution_hz,
        np.sqrt(m2) * resolution_hz,
        m3 / width**3,
        m4 / width**4,
        (np.log(total + _POWER_FLOOR) - (weight * log_power).sum(axis=2)) / math.log(n_lines),
        np.exp(log_power.mean(axis=2)) / (total / n_lines + _POWER_FLOOR),
        np.where(reached.any(axis=2), reached.argmax(axis=2) + 1, n_lines) * resolution_hz,
        (power.argmax(axis=2) + 1) * resolution_hz,
        weight.max(axis=2),
    )
    powers = np.concatenate([bands / np.diff(edges), total[:, :, None] * resolution_hz], axis=2)
    shape = np.where(silent[:, :, None], 0.0, np.stack(moments, axis=2))
    return np.concatenate([np.log10(powers + _POWER_FLOOR), shape], axis=2)


def slip_statistics(slip_ratio: Array) -> Array:
    """Return the :data:`SLIP_STATISTICS` (n_windows, wheels, 6) of slip (n_windows, wheels, n_samples).

    Slip is not finite where it is undefined; of a window of which over half is, all are NaN.

    Examples
    --------
    >>> slip_statistics(np.array([[[0.1, np.nan, 0.3]], [[np.nan, np.nan, 0.3]]]))[:, 0, 0].round(3)
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
