"""A robot of known truth in short runs, and one of which nothing is wrong."""

import numpy as np
import pytest

from studies.blind_trials.drives import command_drives
from studies.blind_trials.hidden import (
    KNOWN,
    SHORT_RUNS,
    TRACK,
    TRACK_ERROR,
    TRACK_RATIO,
    Case,
    Row,
    as_command_log,
    hidden_runs,
    value_is_right,
)
from studies.blind_trials.trial import run_trial, simulation_of
from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.verdict import Verdict
from terrain.robots import load_robot

HUSKY = load_robot("husky")


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(KNOWN)), ids=[known.name for known in KNOWN])
def test_a_track_that_is_two_and_a_half_times_as_wide_is_named_in_short_runs(number):
    known = KNOWN[number]
    trial = run_trial(Case(Row.KNOWN, number, "husky", SHORT_RUNS, 0))
    assert TRACK in trial.named
    assert trial.right
    assert value_is_right(trial.intervals)
    _, low, high = trial.intervals[TRACK_RATIO]
    if not known.scatters:  # the mean of runs that scatter is no constant to be met
        assert low < TRACK_ERROR < high
    assert set(trial.stalled) <= set(trial.excluded)
    assert len(trial.excluded) <= len(trial.stalled) + 1


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_short_runs_in_which_nothing_is_hidden_have_no_cause(seed):
    drives = command_drives(np.random.default_rng(seed), HUSKY, SHORT_RUNS)
    runs = hidden_runs(HUSKY, drives, np.random.SeedSequence(seed), {}, heading=True)
    found = diagnose(tuple(map(as_command_log, runs)), simulation_of(HUSKY))
    assert found.verdict in (Verdict.NONE, Verdict.NOT_EXCITED)
    assert (found.causes, found.ambiguous_sets, found.varying, found.faults) == ((), (), (), ())
    assert len(found.excluded_runs) <= 3  # a command may leave a wheel as fast as the one before
