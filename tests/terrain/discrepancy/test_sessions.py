"""Values by session: what is in each is found, with the same causes, and sessions are compared."""

from dataclasses import replace

import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import hidden_runs
from studies.blind_trials.trial import simulation_of

from pipelines.report.results import as_json
from terrain.discrepancy.constancy import agreement
from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.statements import SESSION_COLUMNS, notes_of, session_rows
from terrain.effects import effect_named
from terrain.robots import load_robot

HUSKY = load_robot("husky")
LIBRARY = tuple(map(effect_named, ("effective_track", "gyro_scale", "turning_slip", "payload")))
N_RUNS = 6


def runs_of(tracks, terrain="grass", seed=4):
    """Return six runs of each session; a session has an effective track of its own."""
    every = []
    for session, track in tracks.items():
        drives = rich_drives(np.random.default_rng(seed), N_RUNS, 25.0)
        seed += 1
        for run in hidden_runs(HUSKY, drives, np.random.SeedSequence(seed), {"effective_track_ratio": track}):
            every.append(replace(run, run_id=f"{session}_{run.run_id}", session=session))
    return every


def found_in(tracks):
    return diagnose(runs_of(tracks), simulation_of(HUSKY), LIBRARY)


def test_sessions_that_are_alike_agree_and_each_holds_the_truth():
    found = found_in({"a": 0.6, "b": 0.6, "c": 0.6})
    (table,) = found.by_session
    assert (table.parameter, table.unit) == ("effective_track_ratio", "ratio")
    assert [each.session for each in table.sessions] == ["a", "b", "c"]
    assert [each.n_runs for each in table.sessions] == [N_RUNS] * 3
    assert table.agree
    assert table.between_std < 0.02
    for each in table.sessions:
        assert abs(each.value - 0.6) < 3 * each.std
        assert each.high - each.low < 0.15
        assert each.text.startswith("0.9")  # 1.6 times 0.5708 m
        assert " m (" in each.text
    assert notes_of(found, (), {}) == ()
    rows = session_rows(found)
    assert {len(row) for row in rows} == {len(SESSION_COLUMNS)}
    assert (rows[0][-1], rows[1][-1]) == ("agree", "")
    shown = as_json(found)["by_session"][0]
    assert shown["agree"] is True
    assert [each["runs"] for each in shown["sessions"]] == [N_RUNS] * 3


def test_sessions_that_differ_are_named_with_their_values():
    found = found_in({"a": 0.5, "b": 0.5, "worn": 0.9})
    table = next(each for each in found.by_session if each.parameter == "effective_track_ratio")
    assert not table.agree
    assert table.between_std == pytest.approx(0.23, abs=0.05)
    assert [each.value for each in table.sessions] == pytest.approx([0.5, 0.5, 0.9], abs=0.05)
    (note,) = (note for note in notes_of(found, (), {}) if "effective track" in note)
    assert "differ" in note
    assert "in worn" in note


def test_one_session_and_runs_without_one_have_no_table():
    alike = runs_of({"a": 0.6})
    simulation = simulation_of(HUSKY)
    assert diagnose(alike, simulation, LIBRARY).by_session == ()
    unnamed = [replace(run, session="") for run in alike]
    assert diagnose(unnamed, simulation, LIBRARY).by_session == ()


def test_of_sessions_that_agree_one_in_a_hundred_sets_is_said_to_differ():
    rng = np.random.default_rng(1)
    std = np.array([0.5, 1.0, 2.0])
    n_below, n_sets, dof = 0, 4000, 12
    for _ in range(n_sets):
        own = std * np.sqrt(rng.chisquare(dof, 3) / dof)
        n_below += agreement(std * rng.standard_normal(3), own, np.full(3, float(dof)))[0] < 0.01
    assert 0.004 < n_below / n_sets < 0.02
