"""What pictures of a diagnosis are made from: spectra, means with intervals, and the telling stretch."""

import numpy as np
import pytest

from pipelines.explain.figures import (
    Shown,
    binned,
    dependence_figure,
    noise_spectrum,
    run_figure,
    run_means,
    share_figure,
    spectra_figure,
    spectrum,
    telling,
)
from pipelines.reporting.drawing import png_bytes
from terrain.discrepancy.noise import Noise, noise_of
from terrain.effects import CHANNELS

RATE_HZ = 6.25
C = CHANNELS.index("speed_x_mps")


def coloured(n, seed, keep=0.7):
    white = np.random.default_rng(seed).standard_normal(n)
    for i in range(1, n):
        white[i] += keep * white[i - 1]
    return white


def a_noise(std=0.01):
    """White noise of that size at any speed, in two channels."""
    growth = np.full((len(CHANNELS), 3), np.nan)
    filters = np.full((len(CHANNELS), 7), np.nan)
    for c in (0, C):
        growth[c] = std**2, 0.0, 0.0
        filters[c] = 1.0, *np.zeros(6)
    return Noise(growth, filters, np.full(len(CHANNELS), std))


def a_run(name="r", off=0.0, seed=0, n=300, held_out=False, after=True):
    rng = np.random.default_rng(seed)
    measured = np.full((n, len(CHANNELS)), np.nan)
    measured[:, [0, C]] = 0.01 * rng.standard_normal((n, 2))
    measured[:, C] += off
    before = np.zeros_like(measured)
    fixed = before.copy()
    fixed[:, C] = off
    time_s = np.arange(n) / RATE_HZ
    inputs = {"speed [m/s]": np.sin(time_s), "roll [rad]": np.zeros(n), "time [s]": time_s}
    return Shown(
        name, "grass", held_out, time_s, np.ones(n), measured, before, fixed if after else None, inputs
    )


def test_the_spectrum_of_coloured_noise_is_that_of_the_filter_that_whitens_it():
    """Two routes: averaged periodograms, and the fitted autoregression; both hold the variance."""
    residuals = [coloured(4000, seed) for seed in range(8)]
    noise = noise_of([r[:, None] for r in residuals], [np.ones(4000)] * 8, 0)
    frequency, power = spectrum(residuals, RATE_HZ)
    fitted = noise.size(np.ones(1))[0, 0] ** 2 * noise_spectrum(noise.filters[0], frequency, RATE_HZ)
    inner = slice(1, -1)
    # 8 x 124 segments, half of them overlapping: 5 % of scatter in a bin, four times that allowed
    np.testing.assert_allclose(power[inner], fitted[inner], rtol=0.2)
    fine = np.linspace(0, RATE_HZ / 2, 4000)
    held = noise_spectrum(noise.filters[0], fine, RATE_HZ).mean() * RATE_HZ / 2
    assert held == pytest.approx(1.0, rel=0.05)


def test_a_hole_parts_a_spectrum_and_the_shortest_stretches_have_none():
    whole = coloured(2000, 1)
    holed = np.concatenate([whole[:1000], [np.nan], whole[1000:]])
    np.testing.assert_allclose(
        spectrum([holed], RATE_HZ)[1], spectrum([whole[:1000], whole[1000:]], RATE_HZ)[1]
    )
    assert np.isnan(spectrum([whole[:7]], RATE_HZ)[1]).all()


def test_of_short_runs_a_spectrum_is_taken_over_short_segments():
    white = np.random.default_rng(3).standard_normal(40 * 300)
    frequency, power = spectrum([*np.split(white, 300), np.full(5, np.nan)], RATE_HZ)
    np.testing.assert_allclose(frequency, np.fft.rfftfreq(32, 1 / RATE_HZ)[1:])
    np.testing.assert_allclose(power[:-1], 2.0 / RATE_HZ, rtol=0.3)
    frequency, _ = spectrum([*np.split(white, 300), white], RATE_HZ)  # half of it is in one run
    assert frequency[0] == pytest.approx(RATE_HZ / 64)


def test_intervals_hold_the_mean_of_nothing_as_often_as_they_say():
    n_seeds, missed_runs, missed_bins = 60, [], []
    for day in range(n_seeds):
        residuals = [coloured(400, 1000 * day + i) for i in range(6)]
        mean, half = run_means(residuals, [np.ones(400)] * 6, np.array([1.0, -0.7]))
        missed_runs.extend(np.abs(mean) > half)
        ramps = [np.linspace(0, 1, 400)] * 6
        _, means, halves = binned(ramps, residuals)
        missed_bins.extend(np.abs(means) > halves)
    # 360 of either; bins of one day have little in common
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


def test_bins_want_rows_and_intervals_want_runs():
    x = np.linspace(0, 1, 200)
    centres, means, halves = binned([x, x], [np.ones(200), np.full(200, np.nan)])
    assert len(centres) == 6
    assert np.isnan(halves).all()
    np.testing.assert_allclose(means, 1.0)
    assert binned([np.full(9, np.nan)], [np.ones(9)])[0].size == 0


def test_the_telling_stretch_is_of_a_run_with_more_to_explain_than_most():
    runs = [a_run(f"r{i}", off=0.02 * i, seed=i) for i in (3, 0, 2, 4, 1)]
    found = telling(runs, a_noise())
    assert found.run_id == "r3"
    assert 19.0 < found.time_s[-1] - found.time_s[0] <= 20.0
    short = telling([a_run(n=50)], a_noise())
    assert len(short.time_s) == 50


@pytest.mark.parametrize("after", [True, False])
def test_pictures_of_runs_are_the_same_bytes_again(after):
    runs = [a_run(f"run$_{i}^", off=0.05, seed=i, after=after) for i in range(3)]
    noise = a_noise()
    residual = {"speed_x_mps": {"rms": 0.05, "noise": None, "systematic": None}}
    for figure in (
        lambda: run_figure(runs[0], noise, "a $title^"),
        lambda: spectra_figure(runs, noise, 2.5),
        lambda: dependence_figure(runs, noise),
        lambda: share_figure(residual, residual, after),
    ):
        assert png_bytes(figure()) == png_bytes(figure())
