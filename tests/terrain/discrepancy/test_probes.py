"""Probes: what the residual depends on is seen where it acts in short events, and chance is not."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.discrepancy.evidence import grams_of
from terrain.discrepancy.probes import probe_residuals
from terrain.discrepancy.runs import INPUTS
from terrain.effects import CHANNELS

CRAWLING = ("current_a", "crawling direction")


@pytest.fixture(scope="module")
def info_of(hide, pose):
    def made(**outside):
        problem = pose(hide({}, n=8, duration_s=60.0, seed=5, outside=outside))
        return problem.at(problem.simulation.vector)

    return made


@pytest.fixture(scope="module")
def plain(info_of):
    return info_of()


def probed(info, error=None):
    return probe_residuals(info, (), np.zeros(0), error or {})


def with_residuals(info, change):
    """Return the evidence with whitened residuals ``change(place, residual)``, 0 where nothing was known."""
    white = [
        np.concatenate([run[:-1], np.where(run[-1:] != 0.0, change(i, run[-1:]), 0.0)])
        for i, run in enumerate(info.white)
    ]
    return replace(info, white=tuple(white), grams=np.array([grams_of(run) for run in white]))


def test_spikes_at_random_times_are_seen_unless_the_simulation_is_known_to_lack_them(plain, info_of):
    info = info_of(stick_slip_a=5.0)
    before, known = probed(info), probed(info, {CRAWLING: 10.0})
    # a t statistic of 8 runs is no clearer than 5, however large the spikes
    assert before[CRAWLING].z > 4.8
    assert not any(result.significant for result in probed(plain).values())
    # its error counts as a standard deviation of what the channel depends on, and in that channel alone
    assert known[CRAWLING].z < 1.0
    assert known[CRAWLING].gain == before[CRAWLING].gain
    assert {at for at in before if known[at] != before[at]} == {CRAWLING}


def test_a_wheel_out_of_round_is_seen_where_the_body_drives_sideways_or_stands(plain):
    """By the speed of the wheel itself: an omni wheel rolls where the speed ahead is 0."""
    phases = [run.inputs[:, len(INPUTS) - 1] for run in plain.rows]
    c, strange = CHANNELS.index("speed_x_mps"), np.arange(len(CHANNELS)) == CHANNELS.index("speed_x_mps")
    waves = [np.gradient(phase) * np.sin(phase + i) for i, phase in enumerate(phases)]
    size = [np.nanstd(run[-1, :, c]) / np.std(wave) for run, wave in zip(plain.white, waves, strict=True)]
    turned = with_residuals(plain, lambda i, white: white + size[i] * waves[i][:, None] * strange)
    still = [run._replace(inputs=run.inputs * (np.arange(run.inputs.shape[1]) != 0)) for run in plain.rows]
    assert probed(replace(turned, rows=tuple(still)))["speed_x_mps", "wheel 1 turn"].significant


def test_noise_is_as_significant_as_chance_has_it(plain):
    rng, z = np.random.default_rng(6), []
    for _ in range(4):
        results = probed(with_residuals(plain, lambda _, white: rng.standard_normal(white.shape)))
        z += [result.z for (_, name), result in results.items() if "wheel" not in name]
    # a twentieth above 1.96; inputs are alike, so that of 4 x 150 some hundreds count
    assert 0.02 < np.mean(np.array(z) > 1.96) < 0.09
    assert max(z) < 4.5


def test_a_dependence_of_another_sign_in_each_run_is_none_of_all_runs(plain):
    signs, c = np.array([1, 1, 1, -1, 1, 1, -1, 1]), CHANNELS.index("yaw_rate_radps")

    def change(i, white):
        more = np.zeros_like(white)
        more[0, :, c] = 30.0 * signs[i] * plain.rows[i].inputs[:, 0]
        return white + more

    assert probed(with_residuals(plain, change))["yaw_rate_radps", "speed"].z < 3.0


def test_what_a_selected_parameter_explains_is_no_news(hide, pose):
    """At the fit of a camera's yaw the sideways speed depends on nothing; where it is not fitted, on the speed."""
    problem = pose(hide({"camera_yaw_rad": 0.05}), ("camera_yaw",))
    info = problem.at(problem.simulation.vector)
    before, after = probed(info), probe_residuals(info, ("camera_yaw_rad",), np.array([0.05]))
    assert before["speed_y_mps", "speed"].z > 6.0
    assert not any(result.significant for (channel, _), result in after.items() if channel == "speed_y_mps")
