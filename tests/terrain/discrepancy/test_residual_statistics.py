"""Spectra of residuals, and their means with intervals."""

import numpy as np
import pytest

from terrain.discrepancy.noise import noise_of
from terrain.discrepancy.residuals import binned_means, noise_spectrum, run_means, spectrum

RATE_HZ = 6.25


def coloured(n, seed, keep=0.7):
    white = np.random.default_rng(seed).standard_normal(n)
    for i in range(1, n):
        white[i] += keep * white[i - 1]
    return white


def test_the_spectrum_of_coloured_noise_is_that_of_the_filter_that_whitens_it():
    """Two routes: averaged periodograms, and the fitted autoregression; both hold the variance."""
    residuals = [coloured(4000, seed) for seed in range(8)]
    noise = noise_of([r[:, None] for r in residuals], [np.ones(4000)] * 8, 0.2, 0)
    frequency, power = spectrum(residuals, RATE_HZ)
    fitted = noise.size(np.ones(1))[0, 0] ** 2 * noise_spectrum(noise.filters[0], frequency, RATE_HZ)
    inner = slice(1, -1)
    # 8 x 124 segments, half of them overlapping: 5 % of scatter in a bin, four times that allowed
    np.testing.assert_allclose(power[inner], fitted[inner], rtol=0.2)
    fine = np.linspace(0, RATE_HZ / 2, 4000)
    held = noise_spectrum(noise.filters[0], fine, RATE_HZ).mean() * RATE_HZ / 2
    assert held == pytest.approx(1.0, rel=0.05)


def test_a_hole_splits_a_spectrum_and_the_shortest_stretches_have_none():
    whole = coloured(2000, 1)
    holed = np.concatenate([whole[:1000], [np.nan], whole[1000:]])
    np.testing.assert_allclose(
        spectrum([holed], RATE_HZ)[1], spectrum([whole[:1000], whole[1000:]], RATE_HZ)[1]
    )
    assert np.isnan(spectrum([whole[:7]], RATE_HZ)[1]).all()


def test_spectra_of_short_runs_use_short_segments():
    white = np.random.default_rng(3).standard_normal(40 * 300)
    frequency, power = spectrum([*np.split(white, 300), np.full(5, np.nan)], RATE_HZ)
    np.testing.assert_allclose(frequency, np.fft.rfftfreq(32, 1 / RATE_HZ)[1:])
    np.testing.assert_allclose(power[:-1], 2.0 / RATE_HZ, rtol=0.3)
    frequency, _ = spectrum([*np.split(white, 300), white], RATE_HZ)  # half of it is in one run
    assert frequency[0] == pytest.approx(RATE_HZ / 64)


def test_intervals_of_zero_mean_noise_have_their_nominal_coverage():
    n_seeds, missed_runs, missed_bins = 60, [], []
    for seed in range(n_seeds):
        residuals = [coloured(400, 1000 * seed + i) for i in range(6)]
        mean, half = run_means(residuals, [np.ones(400)] * 6, np.array([1.0, -0.7]))
        missed_runs.extend(np.abs(mean) > half)
        ramps = [np.linspace(0, 1, 400)] * 6
        _, means, halves = binned_means(ramps, residuals)
        missed_bins.extend(np.abs(means) > halves)
    # 360 of either; bins of one seed have little in common
    assert 0.02 < np.mean(missed_runs) < 0.09
    assert 0.02 < np.mean(missed_bins) < 0.09


def test_the_mean_of_a_short_run_scatters_no_more_than_the_noise_itself():
    """25 rows of noise that remembers 33 of them: as many runs averaged would say far too much."""
    rng, n, kept = np.random.default_rng(4), 25, 0.97
    noise = np.empty((600, n))
    noise[:, 0] = rng.standard_normal(600) / np.sqrt(1 - kept**2)
    for i in range(1, n):
        noise[:, i] = kept * noise[:, i - 1] + rng.standard_normal(600)
    mean, half = run_means(list(noise), [np.ones(n)] * 600, np.array([1.0, -kept]))
    assert 0.03 < np.mean(np.abs(mean) > half) < 0.08
    assert half[0] < 1.96 / np.sqrt(1 - kept**2)


def test_bins_require_rows_and_intervals_require_runs():
    x = np.linspace(0, 1, 200)
    centres, means, halves = binned_means([x, x], [np.ones(200), np.full(200, np.nan)])
    assert len(centres) == 6
    assert np.isnan(halves).all()
    np.testing.assert_allclose(means, 1.0)
    assert binned_means([np.full(9, np.nan)], [np.ones(9)])[0].size == 0
