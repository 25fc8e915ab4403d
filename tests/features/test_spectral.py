from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from features.spectral import MOMENTS, channel_spectra, n_bands, spectrum_names

FLOOR = 1e-10


def table(values, rate_hz):
    """Return the band powers (n_windows, n_channels, bands) and the moments by name."""
    found = channel_spectra(values, rate_hz)
    bands = n_bands(values.shape[2])
    moments = np.moveaxis(found[:, :, bands:], 2, 0)
    return found[:, :, :bands], dict(zip([name for name, _ in MOMENTS], moments, strict=True))


def noise(seed, n_samples, shape=(4, 2)):
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((*shape, n_samples))
    # Loud, so that the floor under the logarithms is far away.
    return signal.lfilter([1e3], [1.0, -rng.uniform(-0.9, 0.9)], white, axis=2)


def density(values, rate_hz):
    """Return the one-sided periodogram by scipy: frequencies and densities without the line at 0 Hz."""
    n = values.shape[2]
    taper = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2
    frequency_hz, power = signal.periodogram(values, rate_hz, window=taper, detrend="constant", axis=2)
    return frequency_hz[1:], power[:, :, 1:]


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(48, 220), st.floats(10.0, 500.0))
def test_spectrum_agrees_with_scipy_and_its_definitions(seed, n_samples, rate_hz):
    values = noise(seed, n_samples)
    bands, moments = table(values, rate_hz)
    f, p = density(values, rate_hz)
    edges = np.linspace(0, f.size, n_bands(n_samples) + 1).round().astype(int)
    expected = [p[:, :, a:b].mean(axis=2) for a, b in pairwise(edges)]
    np.testing.assert_allclose(10.0**bands, np.stack(expected, axis=2) + FLOOR, rtol=1e-9)
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


@pytest.mark.parametrize("n_samples", [50, 100, 127, 200])
@pytest.mark.parametrize("rate_hz", [25.0, 100.0])
def test_total_power_is_the_variance_of_the_tapered_signal(n_samples, rate_hz):
    values = noise(n_samples, n_samples) + 30.0
    taper = 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(n_samples) + 0.5) / n_samples)
    tapered = (values - values.mean(axis=2, keepdims=True)) * taper
    expected = tapered.var(axis=2) / np.mean(taper**2)  # var leaves out the line at 0 Hz
    np.testing.assert_allclose(10.0 ** table(values, rate_hz)[1]["log_power"], expected, rtol=1e-6)


@settings(deadline=None, max_examples=60)
@given(
    rate_hz=st.sampled_from([25.0, 50.0, 100.0, 187.0]),
    n_samples=st.sampled_from([50, 100, 200, 201]),
    fraction_of_nyquist=st.floats(0.1, 0.9),
    amplitude=st.floats(0.01, 30.0),
)
def test_a_tone_lands_in_its_band(rate_hz, n_samples, fraction_of_nyquist, amplitude):
    tone_hz = fraction_of_nyquist * rate_hz / 2
    time_s = np.arange(n_samples) / rate_hz
    bands, moments = table(amplitude * np.sin(2 * np.pi * tone_hz * time_s)[None, None], rate_hz)
    resolution_hz = rate_hz / n_samples
    assert abs(moments["peak"][0, 0] - tone_hz) <= 0.51 * resolution_hz
    assert abs(moments["centroid"][0, 0] - tone_hz) < resolution_hz
    assert moments["spread"][0, 0] < 2 * resolution_hz
    band = fraction_of_nyquist * bands.shape[2]
    assert abs(int(bands[0, 0].argmax()) + 0.5 - band) <= 0.5 + bands.shape[2] / (n_samples / 2)
    power = 10.0 ** moments["log_power"][0, 0]
    assert power == pytest.approx(amplitude**2 / 2, rel=0.05)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(48, 220), st.floats(1.1, 5.0))
def test_a_faster_clock_stretches_what_is_in_hertz_and_leaves_the_rest(seed, n_samples, factor):
    values = noise(seed, n_samples)
    slow_bands, slow = table(values, 40.0)
    fast_bands, fast = table(values, 40.0 * factor)
    np.testing.assert_allclose(fast_bands, slow_bands - np.log10(factor), atol=1e-5)
    for name, unit in MOMENTS:
        expected = slow[name] * (factor if unit == "Hz" else 1.0)
        np.testing.assert_allclose(fast[name], expected, rtol=1e-5, atol=1e-6, err_msg=name)


def test_white_noise_is_flat_and_a_tone_is_not():
    rng = np.random.default_rng(3)
    bands, white = table(rng.standard_normal((400, 1, 200)), 100.0)
    np.testing.assert_allclose(10.0 ** bands.mean(axis=0), 10.0 ** bands.mean(), rtol=0.25)
    np.testing.assert_allclose((10.0**bands).mean(axis=0)[0], 2 / 100.0, rtol=0.2)  # variance over Nyquist
    tone = table(np.sin(np.arange(200.0))[None, None], 100.0)[1]
    assert white["entropy"].min() > 2 * tone["entropy"][0, 0]
    assert white["flatness"].min() > 10 * tone["flatness"][0, 0]


def test_a_silent_channel_has_no_moments():
    bands, moments = table(np.full((1, 1, 100), 3.0), 50.0)
    assert (bands == -10.0).all()
    assert moments.pop("log_power")[0, 0] == -10.0
    assert all(value[0, 0] == 0.0 for value in moments.values())


def test_names_are_as_many_as_columns():
    for n_samples in (48, 49, 200):
        found = channel_spectra(noise(0, n_samples), 100.0)
        assert found.shape[2] == len(spectrum_names(n_samples))
