"""What is drawn of compared runs: the strongest input, a band without levels, telling runs, spectra, means."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lfilter

from terrain.discrepancy.compared import (
    ComparedRun,
    binned_means,
    example_stretch,
    noise_spectrum,
    run_means,
    spectrum,
    strongest_input,
    telling_runs,
    without_levels,
)
from terrain.discrepancy.noise import Noise, noise_of
from terrain.effects import CHANNELS

C = CHANNELS.index("speed_x_mps")


def a_run(seed, size=0.0, level=0.0, name="speed_mps", n=300):
    """Measured minus simulated is noise, a size of an input, and a level."""
    time_s = np.arange(n) / 6.25
    speed, turn = np.sin(0.7 * time_s + seed), np.sin(1.1 * time_s + 2.0 * seed)
    inputs = {"speed_mps": speed, "turn_mps": turn, "time_s": time_s}
    before, measured = np.full((2, n, len(CHANNELS)), np.nan)
    before[:, C] = 0.0
    measured[:, C] = size * inputs[name] + level + 0.05 * np.random.default_rng(seed).standard_normal(n)
    return ComparedRun(f"r{seed}", "", False, time_s, np.ones(n), measured, before, None, inputs)


def noise_with_levels(runs):
    """Noise that was fitted to residuals with a level, as growth has it, and its size without."""
    growth, filters = np.full((len(CHANNELS), 3), np.nan), np.full((len(CHANNELS), 7), np.nan)
    residual, std = (
        np.concatenate([run.residual(False)[:, C] for run in runs]),
        np.full(len(CHANNELS), np.nan),
    )
    growth[C], filters[C], std[C] = (np.mean(residual**2), 0.0, 0.0), (1.0, *np.zeros(6)), np.std(residual)
    return Noise(growth, filters, std)


@pytest.mark.parametrize("name", ["speed_mps", "turn_mps"])
def test_the_strongest_input_is_the_one_that_acts(name):
    assert strongest_input([a_run(seed, 1.0, name=name) for seed in range(6)], "speed_x_mps") == name


def test_the_band_of_the_noise_does_not_grow_with_an_offset():
    sets = [[a_run(seed, level=level) for seed in range(4)] for level in (0.0, 2.0)]
    pace_mps = sets[0][0].pace_mps
    sizes = [without_levels(noise_with_levels(runs), runs).size(pace_mps)[:, C] for runs in sets]
    np.testing.assert_allclose(sizes[1], sizes[0], rtol=1e-3)
    assert noise_with_levels(sets[1]).size(pace_mps)[0, C] > 30 * sizes[0][0]


def test_telling_runs_go_from_the_largest_residual_to_the_smallest():
    runs = [a_run(seed, size) for seed, size in enumerate((0.2, 0.8, 0.4, 0.6, 0.0))]
    noise = noise_with_levels(runs)
    assert [run.run_id for run in telling_runs(runs, noise, 3)] == ["r1", "r2", "r4"]
    assert telling_runs(runs, noise, 0) == []
    assert len(telling_runs(runs, noise, 9)) == 5
    example = example_stretch(runs, noise)
    assert example.run_id == "r3"  # larger than most, not the largest
    assert 19.0 < example.time_s[-1] - example.time_s[0] <= 20.0
    assert len(example_stretch([runs[0].part(0.0, 7.0)], noise).time_s) == 44


# -- Spectra of residuals, and their means with intervals --------------------------------------------------

RATE_HZ = 6.25


def coloured(n, seed, keep=0.7):
    return lfilter([1.0], [1.0, -keep], np.random.default_rng(seed).standard_normal(n))


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


def test_a_hole_splits_a_spectrum_and_short_runs_use_short_segments():
    whole = coloured(2000, 1)
    holed = np.concatenate([whole[:1000], [np.nan], whole[1000:]])
    parts = spectrum([whole[:1000], whole[1000:]], RATE_HZ)
    assert_allclose(spectrum([holed], RATE_HZ)[1], parts[1])
    assert np.isnan(spectrum([whole[:7]], RATE_HZ)[1]).all()
    white = np.random.default_rng(3).standard_normal(40 * 300)
    frequency, power = spectrum([*np.split(white, 300), np.full(5, np.nan)], RATE_HZ)
    assert_allclose(frequency, np.fft.rfftfreq(32, 1 / RATE_HZ)[1:])
    assert_allclose(power[:-1], 2.0 / RATE_HZ, rtol=0.3)
    assert spectrum([*np.split(white, 300), white], RATE_HZ)[0][0] == pytest.approx(RATE_HZ / 64)


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
