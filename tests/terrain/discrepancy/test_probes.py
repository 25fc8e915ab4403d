"""Probes: what the residual depends on is seen where it acts in short events, and chance is not."""

from dataclasses import replace

import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import hidden_runs
from studies.blind_trials.trial import simulation_of

from terrain.discrepancy.evidence import evidence_at, grams_of
from terrain.discrepancy.probes import probe_residuals
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.signals import signals_of
from terrain.effects import CHANNELS, library_of, vector_of
from terrain.robots import load_robot

HUSKY = load_robot("husky")
N_RUNS = 8
CRAWLING = ("current_a", "crawling direction")


def information_of_drives(**outside):
    drives = rich_drives(np.random.default_rng(4), N_RUNS)
    runs = hidden_runs(HUSKY, drives, np.random.SeedSequence(5), {}, outside)
    signals = [signals_of(run, HUSKY) for run in runs]
    names = [p.name for effect in library_of(HUSKY.drive) for p in effect.parameters]
    return evidence_at(signals, simulation_of(HUSKY), vector_of({}), names, low_pass_of(signals))


@pytest.fixture(scope="module")
def plain():
    return information_of_drives()


def probed(info):
    return probe_residuals(info, (), np.zeros(0))


def with_residual(info, white):
    grams = np.array([grams_of(r, j) for r, j in zip(white, info.white_change, strict=True)])
    return replace(info, white_residual=white, grams=grams)


def test_spikes_at_random_times_in_eight_runs_are_seen(plain):
    with_spikes = probed(information_of_drives(stick_slip_a=5.0))
    # a t statistic of 8 runs is no clearer than 5, however large the spikes
    assert with_spikes[CRAWLING].z > 5.5
    assert not any(result.significant for result in probed(plain).values())


def test_what_the_simulation_is_known_to_get_wrong_by_is_no_news():
    """Its error counts as a standard deviation of what the channel depends on, and in that channel alone."""
    info = information_of_drives(stick_slip_a=5.0)
    before = probed(info)
    known = probe_residuals(info, (), np.zeros(0), {CRAWLING: 10.0})
    assert before[CRAWLING].significant
    assert known[CRAWLING].z < 1.0
    assert known[CRAWLING].gain == before[CRAWLING].gain
    assert {at for at in before if known[at] != before[at]} == {CRAWLING}


def test_noise_is_as_significant_as_chance_has_it(plain):
    rng = np.random.default_rng(6)
    z = []
    for _ in range(8):
        noise = tuple(
            np.where(white != 0.0, rng.standard_normal(white.shape), 0.0) for white in plain.white_residual
        )
        found = probed(with_residual(plain, noise))
        z += [result.z for (_, name), result in found.items() if "wheel" not in name]
    z = np.array(z)
    # a twentieth above 1.96; inputs are alike, so that of 8 x 150 some hundreds count
    assert 0.02 < (z > 1.96).mean() < 0.09
    assert z.max() < 4.5


def test_a_dependence_of_another_sign_in_each_run_is_none_of_all_runs(plain):
    speed = [run.inputs[:, 0] for run in plain.rows]
    c = CHANNELS.index("yaw_rate_radps")
    signs = np.array([1, 1, 1, -1, 1, 1, -1, 1])
    for size in (3.0, 30.0):
        left = []
        for white, v, sign in zip(plain.white_residual, speed, signs, strict=True):
            more = white.copy()
            more[:, c] += size * sign * v * (white[:, c] != 0.0)
            left.append(more)
        z = probed(with_residual(plain, tuple(left)))["yaw_rate_radps", "speed"].z
        assert z < 3.0
