"""Whether a value is one number, on linear problems whose parameters change as is known."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import hidden_runs
from studies.blind_trials.trial import simulation_of

from pipelines.report.results import as_json
from terrain.discrepancy.constancy import CAVEAT_RATIO, VARIES_RATIO, agreement, constancy_of
from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.evidence import Evidence, grams_of
from terrain.discrepancy.statements import SESSION_COLUMNS, notes_of, session_rows
from terrain.effects import PARAMETERS, effect_named
from terrain.robots import load_robot

NAMES = ("payload_ratio", "gyro_bias_radps")
N_RUNS, N_ROWS, SIZE = 8, 120, 0.2


def problem(value, excited=None, seed=0, n_runs=N_RUNS, noise=1.0, second=1.0):
    """Return runs as evidence; the second parameter is 0.1 throughout.

    Parameters
    ----------
    value : of the first parameter, by run (from 0) and time (rows,) from 0 to 1
    excited : factor (rows,) of its sensitivity by time
    second : factor of the sensitivity to the second parameter
    """
    rng = np.random.default_rng(seed)
    at = (np.arange(N_ROWS) + 0.5) / N_ROWS
    changes, residuals = [], []
    for i in range(n_runs):
        j = 30.0 * rng.standard_normal((2, N_ROWS))
        j[1] = second * (j[1] + 0.2 * j[0])
        j[0] *= 1.0 if excited is None else excited(at)
        r = value(i, at) * j[0] + 0.1 * j[1] + noise * rng.standard_normal(N_ROWS)
        changes.append(j[:, :, None])
        residuals.append(r[:, None])
    nowhere, none = np.zeros(len(PARAMETERS)), np.zeros(0, dtype=int)
    grams = np.array([grams_of(r, j) for r, j in zip(residuals, changes, strict=True)])
    return Evidence(
        *(NAMES, nowhere, nowhere, grams, none, np.zeros(0), tuple(residuals), None, (), (), np.zeros(2)),
    )


def constancy(info, own=NAMES[:1], inflation=1.0):
    change = np.linalg.solve(info.a.sum(axis=0), info.g.sum(axis=0))
    return constancy_of(info, NAMES, own, change, inflation)


def values(groups):
    return np.array([group.values[0] for group in groups])


def constant(i, at):
    return SIZE


def from_nothing(i, at):
    return 2 * SIZE * at


def test_a_constant_value_is_one_number_within_its_own_error():
    for seed in range(20):
        found = constancy(problem(constant, seed=seed))
        assert not found.certain
        assert not found.varies
        assert found.caveat == ""
        for groups, n in ((found.thirds, 3), (found.halves, 2)):
            std = np.array([group.std[0] for group in groups])
            assert (np.abs(values(groups) - SIZE) < 4.5 * std).all()
            assert_allclose(std, np.sqrt(n / (N_RUNS * N_ROWS)) / 30.0, rtol=0.25)


def test_a_value_that_grows_from_nothing_along_a_run_is_none():
    found = constancy(problem(from_nothing))
    assert_allclose(values(found.thirds), np.array([1, 3, 5]) / 3 * SIZE, atol=0.02)
    # 2/3 to either side of the mean in two of three
    assert found.ratio == pytest.approx(np.sqrt(2 / 3) * 2 / 3, rel=0.1)
    assert found.ratio > VARIES_RATIO
    assert (found.certain, found.varies, found.split) == (True, True, "time")
    assert found.caveat.startswith("its value depends on time: 0.0")
    # the other one stays what it is
    assert not constancy(problem(from_nothing), NAMES[1:]).varies


def test_a_value_of_other_runs_is_none_and_of_few_runs_is_not_given():
    halves = constancy(problem(lambda i, at: SIZE * (0.4 if i < N_RUNS / 2 else 1.6)))
    assert (halves.varies, halves.split) == (True, "runs")
    assert_allclose(values(halves.halves), [0.4 * SIZE, 1.6 * SIZE], atol=0.02)
    assert "depends on the run: " in halves.caveat
    few = constancy(problem(lambda i, at: SIZE * (0.5 if i < 2 else 1.5), n_runs=4))
    assert (few.halves, few.varies) == ((), False)


def test_a_value_that_differs_by_less_is_named_with_what_it_depends_on():
    found = constancy(problem(lambda i, at: SIZE * (0.85 + 0.3 * at), noise=0.2), inflation=0.04)
    assert CAVEAT_RATIO < found.ratio < VARIES_RATIO
    assert (found.certain, found.varies) == (True, False)
    assert found.caveat != ""
    # the same difference within the noise is none
    assert constancy(problem(lambda i, at: SIZE * (0.85 + 0.3 * at)), inflation=25.0).caveat == ""


def test_a_third_that_shows_nothing_does_not_count():
    """Robots stand first: a value that is the same in the rest is constant, one that is not is none."""

    def stands_first(at):
        return np.where(at < 1 / 3, 0.0, 1.0)

    one = constancy(problem(constant, stands_first))
    assert np.isnan(values(one.thirds)).tolist() == [True, False, False]
    assert not one.certain
    other = constancy(problem(lambda i, at: SIZE * (0.4 + 1.2 * (at > 2 / 3)), stands_first))
    assert (other.varies, other.split) == (True, "time")
    assert not np.isfinite(other.thirds[0].std).any()
    assert "nan" not in other.caveat


def test_a_third_that_shows_little_weighs_little():
    """The start of a run, hardly excited, has another value: that is no size of the whole."""
    found = constancy(
        problem(
            lambda i, at: np.where(at < 1 / 3, 0.0, SIZE),
            lambda at: np.where(at < 1 / 3, 0.1, 1.0),
            noise=0.3,
        )
    )
    assert found.certain
    assert found.ratio < 0.5 * VARIES_RATIO


def test_of_two_parameters_the_one_that_is_apart_by_noise_is_no_size():
    """One differs by a hundredth, beyond doubt; the other is hardly shown in thirds."""
    apart = problem(lambda i, at: SIZE * (0.99 + 0.02 * at), noise=0.01, second=1e-3)
    found = constancy(apart, NAMES, 1e-4)
    off = np.ptp([group.values[1] for group in found.thirds])
    assert off > CAVEAT_RATIO * SIZE
    assert found.certain
    assert found.ratio < CAVEAT_RATIO


# -- Values by session: what is in each is found, with the same causes, and sessions are compared ----------

HUSKY = load_robot("husky")
LIBRARY = tuple(map(effect_named, ("effective_track", "gyro_scale", "turning_slip", "payload")))
SESSION_RUNS = 6


def runs_of(tracks, terrain="grass", seed=4):
    """Return six runs of each session; a session has an effective track of its own."""
    every = []
    for session, track in tracks.items():
        drives = rich_drives(np.random.default_rng(seed), SESSION_RUNS, 25.0)
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
    assert [each.n_runs for each in table.sessions] == [SESSION_RUNS] * 3
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
    assert [each["runs"] for each in shown["sessions"]] == [SESSION_RUNS] * 3


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
