"""One blind trial: what it depends on, and what it counts when the diagnosis refuses the runs."""

import doctest
from dataclasses import replace
from importlib import import_module

import pytest

from studies.blind_trials.hidden import Row, cases_of
from studies.blind_trials.scoring import table_of
from studies.blind_trials.trial import run_trial
from terrain.discrepancy.verdict import Verdict
from terrain.effects import library_of
from terrain.errors import DataError


def test_cases_take_the_robots_in_turn_and_row_found_every_effect():
    cases = cases_of(Row.FOUND, 70, 7, 8)
    assert [case.robot for case in cases[:4]] == ["agrimaro", "husky"] * 2
    for robot, drive in (("agrimaro", "swerve"), ("husky", "skid_steer")):
        library = [effect for effect in library_of(drive) if not effect.modifies]
        own = [case for case in cases if case.robot == robot]
        assert {case.number // 2 % len(library) for case in own} == set(range(len(library)))


@pytest.mark.slow
def test_a_trial_depends_on_its_seed_and_number_alone():
    cases = cases_of(Row.STRONG, 4, 3, 3)
    one, other = run_trial(cases[1]), run_trial(cases[1])
    assert replace(one, seconds=0.0) == replace(other, seconds=0.0)
    assert run_trial(cases[3]).hidden != one.hidden


def test_refused_runs_count_as_a_false_alarm(monkeypatch):
    def refuse(*_):
        raise DataError("runs: only 2 of 8 are fit to be compared")

    monkeypatch.setattr("studies.blind_trials.trial.diagnose", refuse)
    found = run_trial(cases_of(Row.NONE, 1, 0, 3)[0])
    assert (found.verdict, found.named, found.right) == (Verdict.REFUSED, (), True)
    assert table_of([found])["none: false alarms"].hits == 1


@pytest.mark.parametrize("name", ["drives", "hidden", "limits", "scoring", "trial"])
def test_examples_in_docstrings_hold(name):
    assert doctest.testmod(import_module(f"studies.blind_trials.{name}")).failed == 0
