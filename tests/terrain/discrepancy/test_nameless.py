"""A nameless learner finds what depends on the inputs, no more than is there, and stands beside the names."""

import math

import numpy as np
import pytest

from pipelines.report.results import as_json
from terrain.discrepancy.compared import (
    ComparedRun,
    example_stretch,
    strongest_input,
    telling_runs,
    without_levels,
)
from terrain.discrepancy.nameless import DRIVEN, nameless_gain
from terrain.discrepancy.noise import Noise
from terrain.effects import CHANNELS

C, CHANNEL = CHANNELS.index("speed_x_mps"), "speed_x_mps"
STD = 0.05


def a_run(seed, hidden=0.0, named=None, late=0, n=300):
    """Measured minus simulated is ``hidden speed turn`` of some rows ago; ``named`` of it is built in."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(n) / 6.25
    inputs = {name: np.zeros(n) for name in DRIVEN} | {"time_s": time_s}
    inputs["speed_mps"] = np.sin(0.7 * time_s + seed)
    inputs["turn_mps"] = np.sin(1.1 * time_s + 2.0 * seed)
    shape = np.roll(inputs["speed_mps"] * inputs["turn_mps"], late)
    empty = np.full((n, len(CHANNELS)), np.nan)
    before, measured = empty.copy(), empty.copy()
    before[:, C] = 0.0
    measured[:, C] = hidden * shape + STD * rng.standard_normal(n)
    after = None
    if named is not None:
        after = before.copy()
        after[:, C] = named * shape
    return ComparedRun(f"r{seed}", "", False, time_s, np.ones(n), measured, before, after, inputs)


def learned(hidden, named, late=0, n_used=12, n_judged=8):
    used, judged = (
        [a_run(s, hidden, named, late) for s in seeds] for seeds in (range(n_used), range(50, 50 + n_judged))
    )
    found = nameless_gain(used, judged, {CHANNEL: STD})
    return found, found.channels[CHANNEL]


@pytest.mark.parametrize("late", [-1, 0, 1])
def test_it_finds_what_depends_on_the_inputs_also_if_sensors_are_late(late):
    found, channel = learned(0.5, named=0.0, late=late)
    assert channel.rms_after == pytest.approx(STD, rel=0.15)
    assert channel.ratio > 0.85
    assert found.sentence.endswith("more is left to find in speed ahead.")


def test_where_the_names_are_right_little_is_left():
    found, channel = learned(0.5, named=0.5)
    assert channel.named_ratio == pytest.approx(channel.ratio, abs=0.03)
    assert found.named_ratio == pytest.approx(channel.named_ratio)
    assert found.sentence.endswith("little is left to find.")


def test_of_noise_it_learns_nothing():
    found, channel = learned(0.0, named=None)
    assert abs(channel.ratio) < 0.05
    assert math.isnan(channel.named_ratio)
    assert found.sentence.startswith("Nothing was named")
    assert found.sentence.endswith("little is left to find.")


def test_of_few_runs_no_more_is_stated_than_they_hold():
    found, channel = learned(0.5, named=0.0, n_judged=2)
    assert math.isnan(channel.left_low)
    assert found.sentence.endswith("2 runs are too few to state more.")


def test_without_runs_held_out_there_is_no_comparison_and_json_has_no_nan():
    assert nameless_gain([a_run(1)], [], {}) is None
    found, _ = learned(0.0, named=None)
    assert as_json(found)["channels"][CHANNEL]["named_reduction"] is None


def test_the_strongest_input_is_the_one_that_acts():
    runs = [a_run(seed) for seed in range(6)]
    for name in ("speed_mps", "turn_mps"):
        acted = []
        for run in runs:
            measured = run.measured.copy()
            measured[:, C] += run.inputs[name]
            acted.append(run._replace(measured=measured))
        assert strongest_input(acted, CHANNEL) == name


def a_noise(runs):
    """Noise that was fitted to residuals with a level, as growth has it, and its size without."""
    growth, filters = np.full((len(CHANNELS), 3), np.nan), np.full((len(CHANNELS), 7), np.nan)
    residual = np.concatenate([run.residual(False)[:, C] for run in runs])
    growth[C], filters[C] = (np.mean(residual**2), 0.0, 0.0), (1.0, *np.zeros(6))
    std = np.full(len(CHANNELS), np.nan)
    std[C] = np.std(residual)
    return Noise(growth, filters, std)


def test_the_band_of_the_noise_does_not_grow_with_an_offset():
    runs = [a_run(seed) for seed in range(4)]
    offset = [run._replace(measured=run.measured + 2.0) for run in runs]
    sizes = [without_levels(a_noise(each), each).size(runs[0].pace_mps)[:, C] for each in (runs, offset)]
    np.testing.assert_allclose(sizes[1], sizes[0], rtol=1e-3)
    assert a_noise(offset).size(runs[0].pace_mps)[0, C] > 30 * sizes[0][0]


def test_telling_runs_go_from_the_largest_residual_to_the_smallest():
    runs = [a_run(seed, hidden=hidden) for seed, hidden in enumerate((0.2, 0.8, 0.4, 0.6, 0.0))]
    noise = a_noise(runs)
    assert [run.run_id for run in telling_runs(runs, noise, 3)] == ["r1", "r2", "r4"]
    assert telling_runs(runs, noise, 0) == []
    assert len(telling_runs(runs, noise, 9)) == 5
    example = example_stretch(runs, noise)
    assert example.run_id == "r3"  # larger than most, not the largest
    assert 19.0 < example.time_s[-1] - example.time_s[0] <= 20.0
    assert len(example_stretch([runs[0].part(0.0, 7.0)], noise).time_s) == 44
