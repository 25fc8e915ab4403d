"""What is drawn of compared runs: the strongest input, a band without levels, and telling runs."""

import numpy as np
import pytest

from terrain.discrepancy.compared import (
    ComparedRun,
    example_stretch,
    strongest_input,
    telling_runs,
    without_levels,
)
from terrain.discrepancy.noise import Noise
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


def noise_of(runs):
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
    sizes = [without_levels(noise_of(runs), runs).size(pace_mps)[:, C] for runs in sets]
    np.testing.assert_allclose(sizes[1], sizes[0], rtol=1e-3)
    assert noise_of(sets[1]).size(pace_mps)[0, C] > 30 * sizes[0][0]


def test_telling_runs_go_from_the_largest_residual_to_the_smallest():
    runs = [a_run(seed, size) for seed, size in enumerate((0.2, 0.8, 0.4, 0.6, 0.0))]
    noise = noise_of(runs)
    assert [run.run_id for run in telling_runs(runs, noise, 3)] == ["r1", "r2", "r4"]
    assert telling_runs(runs, noise, 0) == []
    assert len(telling_runs(runs, noise, 9)) == 5
    example = example_stretch(runs, noise)
    assert example.run_id == "r3"  # larger than most, not the largest
    assert 19.0 < example.time_s[-1] - example.time_s[0] <= 20.0
    assert len(example_stretch([runs[0].part(0.0, 7.0)], noise).time_s) == 44
