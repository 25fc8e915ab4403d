"""Conditions that differ from run to run explain a mean of no more than their own scatter makes."""

from dataclasses import replace

import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import hidden_runs
from studies.blind_trials.trial import simulation_of

from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.search import Problem
from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.varying import with_conditions
from terrain.discrepancy.verdict import Verdict
from terrain.effects import effect_named
from terrain.errors import ConfigError
from terrain.robots import load_robot

HUSKY = load_robot("husky")
LIBRARY = tuple(effect_named(name) for name in ("wheel_radius", "payload", "camera_yaw"))
PAYLOAD = "payload_ratio"
LOADED = replace(simulation_of(HUSKY), varied_error={PAYLOAD: 0.3}, varied_scatter={PAYLOAD: 0.2})


def runs(loads, seed=2):
    drives = rich_drives(np.random.default_rng(seed), len(loads), 30.0)
    return hidden_runs(HUSKY, drives, np.random.SeedSequence(seed), [{PAYLOAD: float(x)} for x in loads])


def error_of(logs, simulation):
    signals = tuple(signals_of(run, HUSKY) for run in logs)
    problem = Problem(signals, simulation, low_pass_of(signals), LIBRARY)
    return with_conditions(problem, problem.at(simulation.vector)).simulation.model_error


SPREAD = np.linspace(0.0, 0.5, 8)


def test_loads_that_differ_explain_a_mean_of_their_scatter_times_root_three():
    found = error_of(runs(SPREAD), LOADED)[PAYLOAD]
    assert found == pytest.approx(np.sqrt(3.0) * SPREAD.std(ddof=1), rel=0.25)
    assert error_of(runs(SPREAD), replace(LOADED, varied_error={PAYLOAD: 0.1}))[PAYLOAD] == 0.1


def test_one_load_in_all_runs_is_no_condition_that_differs():
    assert error_of(runs(np.full(8, 0.25)), LOADED)[PAYLOAD] < 0.1
    found = diagnose(runs(np.full(8, 0.25)), LOADED, LIBRARY)
    assert list(found.values) == [PAYLOAD]


def test_loads_that_differ_are_news_only_to_a_simulation_that_knows_of_none():
    assert diagnose(runs(SPREAD), LOADED, LIBRARY).verdict in (Verdict.NONE, Verdict.NOT_EXCITED)
    assert diagnose(runs(SPREAD), simulation_of(HUSKY), LIBRARY).verdict is not Verdict.NONE


@pytest.mark.parametrize("kind", ["model_error", "varied_error", "varied_scatter"])
@pytest.mark.parametrize("sizes", [{"nonsense": 1.0}, {PAYLOAD: -0.1}, {PAYLOAD: np.nan}])
def test_a_size_is_of_a_parameter_and_not_below_zero(kind, sizes):
    with pytest.raises(ConfigError, match=kind):
        replace(LOADED, **{kind: sizes})
