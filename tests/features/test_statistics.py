"""Statistics, spectra and correlations of channels: definitions by numpy and scipy, and laws."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal, stats

from features.statistics import (
    MOMENTS,
    STATISTICS,
    channel_correlations,
    channel_spectra,
    channel_statistics,
    n_bands,
    slip_statistics,
)

NAMES = [name for name, _ in STATISTICS]
LEVELS = ["mean", "min", "max", "q05", "q25", "median", "q75", "q95"]
RATE_HZ = 25.0

seeds = st.integers(0, 2**32 - 1)


def table(values, rate_hz=RATE_HZ):
    """Return the statistics by name, each (n_windows, n_channels)."""
    return dict(zip(NAMES, np.moveaxis(channel_statistics(values, rate_hz), 2, 0), strict=True))


def by_numpy(x):
    """Return what each statistic of one channel in one window is defined to be."""
    d, steps = x - x.mean(), np.abs(np.diff(x)).mean()
    levels = ("q05", 0.05), ("q25", 0.25), ("median", 0.5), ("q75", 0.75), ("q95", 0.95)
    expected = {name: np.quantile(x, level) for name, level in levels} | {
        "mean": x.mean(),
        "std": x.std(),
        "log_std": np.log10(x.std() + 1e-4),
        "skewness": stats.skew(x),
        "kurtosis": stats.kurtosis(x),
        "min": x.min(),
        "max": x.max(),
        "iqr": stats.iqr(x),
        "rms": np.sqrt(np.mean(x**2)),
        "mean_abs": np.abs(x).mean(),
        "crest": np.abs(d).max() / x.std(),
        "zero_crossings": np.count_nonzero(np.diff(d >= 0)) * RATE_HZ / x.size,
        "mean_abs_step": steps,
        "log_step_ratio": np.log10((steps + 1e-4) / x.std()),
    }
    for lag in (1, 2, 4, 8):
        expected[f"autocorrelation_{lag}"] = d[lag:] @ d[:-lag] / (d @ d) if lag < x.size else 0.0
    return expected


def draw_values(seed, n_samples):
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-2, 3, (2, 2, 1))
    values = rng.standard_t(4, (2, 2, n_samples)).cumsum(axis=2) * scale
    return values + scale * rng.uniform(-3, 3, (2, 2, 1))


@settings(max_examples=25)
@given(seeds, st.integers(4, 220))
def test_kernel_agrees_with_numpy_and_scipy(seed, n_samples):
    values = draw_values(seed, n_samples)
    found = table(values)
    for i, c in np.ndindex(2, 2):
        for name, expected in by_numpy(values[i, c]).items():
            assert found[name][i, c] == pytest.approx(expected, rel=1e-9, abs=1e-9), name


@pytest.mark.parametrize("level", [0.0, 9.81, -1e3])
def test_a_constant_channel_has_no_shape_features(level):
    found = table(np.full((1, 1, 50), level))
    for name in NAMES:
        expected = {"log_std": -4.0, "rms": abs(level), "mean_abs": abs(level)}.get(
            name, level if name in LEVELS else 0.0
        )
        assert found[name][0, 0] == pytest.approx(expected, abs=1e-9), name


@settings(max_examples=30)
@given(seeds, st.integers(2, 7), st.integers(4, 100))
def test_correlations_agree_with_numpy_and_ignore_scale_and_bias(seed, n_channels, n_samples):
    rng = np.random.default_rng(seed)
    mixing = rng.standard_normal((n_channels, n_channels))
    values = mixing @ rng.standard_normal((3, n_channels, n_samples))
    pairs = np.triu_indices(n_channels, 1)
    expected = [np.corrcoef(window)[pairs] for window in values]
    np.testing.assert_allclose(channel_correlations(values), expected, atol=1e-10)
    scale, bias = rng.uniform(0.1, 10, (n_channels, 1)), rng.uniform(-5, 5, (n_channels, 1))
    np.testing.assert_allclose(channel_correlations(scale * values + bias), expected, atol=1e-10)


@settings(max_examples=30)
@given(seeds, st.integers(48, 220), st.floats(10.0, 500.0))
def test_spectrum_agrees_with_scipy_and_its_definitions(seed, n_samples, rate_hz):
    """By the one-sided periodogram of scipy, without the line at 0 Hz."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((4, 2, n_samples))
    # Loud, so that the floor under the logarithms, of 1e-10, is far away.
    values = signal.lfilter([1e3], [1.0, -rng.uniform(-0.9, 0.9)], white, axis=2)
    found, bands = channel_spectra(values, rate_hz), n_bands(n_samples)
    moments = dict(zip([name for name, _ in MOMENTS], np.moveaxis(found[:, :, bands:], 2, 0), strict=True))
    taper = np.sin(np.pi * (np.arange(n_samples) + 0.5) / n_samples) ** 2
    f, p = signal.periodogram(values, rate_hz, window=taper, detrend="constant", axis=2)
    f, p = f[1:], p[:, :, 1:]
    edges = np.linspace(0, f.size, bands + 1).round().astype(int)
    expected = [p[:, :, a:b].mean(axis=2) for a, b in pairwise(edges)]
    np.testing.assert_allclose(10.0 ** found[:, :, :bands], np.stack(expected, axis=2) + 1e-10, rtol=1e-9)
    weight = p / p.sum(axis=2, keepdims=True)
    centroid = np.sum(weight * f, axis=2)
    away = f - centroid[:, :, None]
    spread = np.sqrt(np.sum(weight * away**2, axis=2))
    for name, values_of in {
        "centroid": centroid,
        "spread": spread,
        "spectral_skewness": np.sum(weight * away**3, axis=2) / spread**3,
        "spectral_kurtosis": np.sum(weight * away**4, axis=2) / spread**4,
        "entropy": -np.sum(weight * np.log(weight), axis=2) / np.log(f.size),
        "flatness": np.exp(np.log(p).mean(axis=2)) / p.mean(axis=2),
        "rolloff": f[np.argmax(np.cumsum(weight, axis=2) >= 0.85, axis=2)],
        "peak": f[p.argmax(axis=2)],
        "peak_ratio": weight.max(axis=2),
    }.items():
        np.testing.assert_allclose(moments[name], values_of, rtol=1e-5, atol=1e-7, err_msg=name)


@pytest.mark.parametrize(("n_unknown", "unknown"), [(32, np.inf), (32, np.nan), (33, -np.inf), (40, np.nan)])
def test_with_under_a_fifth_known_the_slip_is_not_known_rather_than_zero(n_unknown, unknown):
    slip = np.random.default_rng(0).normal(0.1, 0.2, (5, 2, 40))
    slip[0, 1, :n_unknown] = unknown
    found = slip_statistics(slip)
    assert np.isnan(found[0, 1]).all() == (n_unknown > 32)
    assert np.isfinite(found[0, 0]).all()
    assert np.isfinite(found[1:]).all()
    if n_unknown <= 32:  # those of the samples that are known
        known = slip[0, 1, n_unknown:]
        expected = [
            known.mean(),
            known.std(),
            known.min(),
            known.max(),
            np.abs(known).mean(),
            np.median(known),
        ]
        np.testing.assert_allclose(found[0, 1], expected)
