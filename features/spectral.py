"""Band powers and spectral moments of one channel over one window, relative to the stream's own rate.

The window is centred and tapered (Hann); ``P(f)`` is its one-sided periodogram without the line at 0 Hz.
Bands divide the range from the first line to Nyquist evenly, so that at every rate a band covers the same
fraction of the range that the sensor resolves.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import fft

from terrain.kernels import njit
from terrain.records import Array

MAX_BANDS = 20
MIN_BINS_PER_BAND = 2
MIN_SAMPLES = 48  #: A spectrum of fewer samples has too few lines to add anything to the autocorrelation

ROLLOFF = 0.85
_FLOOR = 1e-10  # squared SI unit per Hz, under a logarithm: the noise density of a good sensor

MOMENTS: tuple[tuple[str, str], ...] = (
    ("log_power", "1"),
    ("centroid", "Hz"),
    ("spread", "Hz"),
    ("spectral_skewness", "1"),
    ("spectral_kurtosis", "1"),
    ("entropy", "1"),
    ("flatness", "1"),
    ("rolloff", "Hz"),
    ("peak", "Hz"),
    ("peak_ratio", "1"),
)


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
    """Return log10 band powers and spectral moments of every channel in every window.

    Parameters
    ----------
    values : (n_windows, n_channels, n_samples), finite
    rate_hz : sampling rate

    Returns
    -------
    (n_windows, n_channels, n_bands + len(MOMENTS)); a channel without power has moments of 0

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
    _describe(power, np.log(power + _FLOOR), edges, rate_hz / n, out)
    out[:, :, : bands + 1] = np.log10(out[:, :, : bands + 1] + _FLOOR)
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
            if total <= _FLOOR:
                row[bands + 1 :] = 0.0
                continue
            centroid = 0.0
            log_mean = 0.0
            log_weighted = 0.0
            peak = 0
            for k in range(n_lines):
                centroid += p[k] / total * (k + 1)
                log_mean += log_p[k]
                log_weighted += p[k] / total * log_p[k]
                if p[k] > p[peak]:
                    peak = k
            m2 = 0.0
            m3 = 0.0
            m4 = 0.0
            sum_so_far = 0.0
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
            row[bands + 5] = (math.log(total + _FLOOR) - log_weighted) / math.log(n_lines)
            row[bands + 6] = math.exp(log_mean / n_lines) / (total / n_lines + _FLOOR)
            row[bands + 7] = rolloff * resolution_hz
            row[bands + 8] = (peak + 1) * resolution_hz
            row[bands + 9] = p[peak] / total
