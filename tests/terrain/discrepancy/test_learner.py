"""What a learner reaches where no name fits, and what of it goes into the extended robot."""

import math

import numpy as np
import pytest

from pipelines.explain.statements import reference_text
from pipelines.report.results import as_json
from terrain.discrepancy.compared import ComparedRun
from terrain.discrepancy.learner import DRIVEN, black_box_reference
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


def reference(hidden, named, late=0, n_judged=8):
    used, judged = (
        [a_run(seed, hidden, named, late) for seed in seeds]
        for seeds in (range(12), range(50, 50 + n_judged))
    )
    found = black_box_reference(used, judged, {CHANNEL: STD})
    return found.channels[CHANNEL], reference_text(found)


@pytest.mark.parametrize("late", [-1, 0, 1])
def test_it_finds_what_depends_on_the_inputs_also_if_sensors_are_late(late):
    channel, text = reference(0.5, named=0.0, late=late)
    assert channel.rms_after == pytest.approx(STD, rel=0.15)
    assert channel.reduction > 0.85
    assert text.endswith("more is left to find in speed ahead.")


def test_where_the_names_are_right_and_in_noise_little_is_left_and_few_runs_state_no_more():
    channel, text = reference(0.5, named=0.5)
    assert channel.named_reduction == pytest.approx(channel.reduction, abs=0.03)
    assert text.endswith("little is left to find.")
    channel, text = reference(0.0, named=None)
    assert abs(channel.reduction) < 0.05
    assert as_json(channel)["named_reduction"] is None
    assert text.startswith("Nothing was named")
    assert text.endswith("little is left to find.")
    channel, text = reference(0.5, named=0.0, n_judged=2)
    assert math.isnan(channel.left_to_find_from)
    assert text.endswith("2 runs are too few to state more.")
    assert black_box_reference([a_run(1)], [], {}) is None
