"""Values that one simulation has for all runs: the least square over all of them."""

from dataclasses import replace

import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import hidden_runs
from studies.blind_trials.trial import simulation_of

from terrain.discrepancy.evidence import Statistics
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.search import Problem, _found, pooled, relinearize
from terrain.discrepancy.signals import signals_of
from terrain.effects import effect_named, vector_of
from terrain.robots import load_robot

HUSKY = load_robot("husky")
SIMULATION = simulation_of(HUSKY)
TRACK = "effective_track_ratio"


def fitted(values):
    """Return a problem of runs with a track each, and the fit of one track to them."""
    (track,) = library = (effect_named("effective_track"),)
    logs = []
    for i, value in enumerate(values):
        drives = rich_drives(np.random.default_rng(i), 1, 30.0)
        (run,) = hidden_runs(HUSKY, drives, np.random.SeedSequence(i), {TRACK: value})
        logs.append(replace(run, run_id=f"run_{i}"))
    signals = tuple(signals_of(run, HUSKY) for run in logs)
    problem = Problem(signals, SIMULATION, low_pass_of(signals), library)
    start = problem.at(SIMULATION.vector)
    return problem, _found(problem, relinearize(problem, start, start.vector, [track]), [track])


@pytest.fixture(scope="module")
def scattered():
    return fitted([0.3, 1.2, 0.4, 1.3, 0.5, 1.0])


def test_it_leaves_the_least_square_where_runs_differ(scattered):
    problem, found = scattered
    one = pooled(problem, found)
    assert found.names == (TRACK,)
    statistics = Statistics(found.info.noise, SIMULATION.scatter)

    def square(value):
        info = problem.at(vector_of({TRACK: value}), (TRACK,), statistics)
        return sum(float((white**2).sum()) for white in info.white_residual)

    best = float(one.change[0])
    assert square(best) < min(square(0.93 * best), square(1.07 * best))
    assert square(best) <= square(float(found.change[0]))
    # six runs determine a mean to 0.41 of their scatter, 0.4, at the best
    assert 0.08 < float(np.sqrt(one.cov[0, 0])) < 0.4


def test_runs_that_are_alike_keep_their_value():
    problem, found = fitted([0.5] * 4)
    assert pooled(problem, found) is found
