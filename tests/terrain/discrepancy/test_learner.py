"""What a learner reaches where no name fits, and what of it goes into the extended robot."""

import math

import numpy as np
import pytest

from pipelines.report.results import as_json
from terrain.discrepancy.compared import ComparedRun
from terrain.discrepancy.gain import gain_of
from terrain.discrepancy.learner import DRIVEN, predicted_residuals
from terrain.effects import CHANNELS

# -- A black-box reference finds what depends on the inputs, no more than is there, beside the names -----------

C, CHANNEL, STD = CHANNELS.index("speed_x_mps"), "speed_x_mps", 0.05


def a_run(seed, hidden=0.0, named=None, late=0, n=300):
    """Measured minus simulated is ``hidden speed turn`` of some rows ago; ``named`` of it is built in."""
    rng, time_s = np.random.default_rng(seed), np.arange(n) / 6.25
    inputs = {name: np.zeros(n) for name in DRIVEN} | {"time_s": time_s}
    inputs["speed_mps"], inputs["turn_mps"] = np.sin(0.7 * time_s + seed), np.sin(1.1 * time_s + 2.0 * seed)
    shape = np.roll(inputs["speed_mps"] * inputs["turn_mps"], late)
    before, after, measured = np.full((3, n, len(CHANNELS)), np.nan)
    before[:, C], after[:, C] = 0.0, (named or 0.0) * shape
    measured[:, C] = hidden * shape + STD * rng.standard_normal(n)
    compared = measured, before, None if named is None else after
    return ComparedRun(f"r{seed}", "", False, time_s, np.ones(n), *compared, inputs)


def judged(hidden, named, late=0, n_judged=8):
    used, runs = (
        [a_run(seed, hidden, named, late) for seed in seeds]
        for seeds in (range(12), range(50, 50 + n_judged))
    )
    gain = gain_of(runs, predicted_residuals(used, runs), {CHANNEL: STD}, 0, "8 runs held out")
    return gain.channels[CHANNEL], gain


@pytest.mark.parametrize("late", [-1, 0, 1])
def test_it_finds_what_depends_on_the_inputs_also_if_sensors_are_late(late):
    channel, gain = judged(0.5, named=0.0, late=late)
    assert channel.learner_rms == pytest.approx(STD, rel=0.15)
    assert channel.learner_ci[0] > 0.85
    assert channel.left_ci[0] > 0.85
    assert gain.learner_reduction == pytest.approx(channel.learner_reduction)


def test_where_the_names_are_right_and_in_noise_little_is_left_and_one_run_has_no_interval():
    channel, _ = judged(0.5, named=0.5)
    assert channel.reduction == pytest.approx(channel.learner_reduction, abs=0.03)
    assert channel.left_ci[1] < 0.05
    channel, gain = judged(0.0, named=None)
    assert abs(channel.learner_reduction) < 0.05
    assert math.isnan(channel.reduction)
    assert (gain.refused, as_json(channel)["reduction"]) == (True, None)
    predicted = predicted_residuals([a_run(1)], [a_run(2)])
    assert np.isnan(np.delete(predicted[0], C, axis=1)).all()
    assert np.isnan(predicted_residuals([], [a_run(2)])[0]).all()
