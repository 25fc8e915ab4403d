"""Whether a value is one number, on linear problems whose parameters change as is known."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from studies.blind_trials.trial import simulation_of

from pipelines.explain.statements import notes_of
from terrain.discrepancy.constancy import CAVEAT_RATIO, VARIES_RATIO, agreement, constancy_of
from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.evidence import Evidence, fit_change, grams_of
from terrain.effects import PARAMETERS, effect_named
from terrain.robots import load_robot

NAMES = ("payload_ratio", "gyro_bias_radps")
N_RUNS, N_ROWS, SIZE = 8, 120, 0.2


def constancy(
    value, excited=None, own=NAMES[:1], inflation=1.0, seed=0, n_runs=N_RUNS, noise=1.0, second=1.0
):
    """Return the constancy of parameters of runs; the second parameter is 0.1 throughout.

    Parameters
    ----------
    value : of the first parameter, by run (from 0) and time (rows,) from 0 to 1
    excited : factor (rows,) of its sensitivity by time
    second : factor of the sensitivity to the second parameter
    """
    rng = np.random.default_rng(seed)
    at, grams = (np.arange(N_ROWS) + 0.5) / N_ROWS, []
    for i in range(n_runs):
        j = 30.0 * rng.standard_normal((2, N_ROWS))
        j[1] = second * (j[1] + 0.2 * j[0])
        j[0] *= 1.0 if excited is None else excited(at)
        r = value(i, at) * j[0] + 0.1 * j[1] + noise * rng.standard_normal(N_ROWS)
        grams.append(grams_of(np.vstack([j, r])[:, :, None]))
    nowhere, none = np.zeros(len(PARAMETERS)), np.zeros(0, dtype=int)
    info = Evidence(NAMES, nowhere, nowhere, np.array(grams), none, np.zeros(0), (), None, (), np.zeros(2))
    return constancy_of(info, NAMES, own, fit_change(info, NAMES)[0], inflation)


def constant(i, at):
    return SIZE


def from_nothing(i, at):
    return 2 * SIZE * at


def stands_first(at):
    return np.where(at < 1 / 3, 0.0, 1.0)


def test_a_constant_value_is_one_number_within_its_own_error():
    ratios = []
    for seed in range(20):
        of = constancy(constant, seed=seed)
        assert (of.certain, of.varies, of.caveat) == (False, False, "")
        loose = constancy(constant, noise=200.0, inflation=200.0**2, seed=seed)  # far apart, by noise alone
        assert (loose.certain, loose.varies, loose.caveat) == (False, False, "")
        ratios.append(loose.ratio)
        for split, n in (("time", 3), ("runs", 2)):
            assert (np.abs(of.values[split] - SIZE) < 4.5 * of.std[split]).all()
            assert_allclose(of.std[split], np.sqrt(n / (N_RUNS * N_ROWS)) / 30.0, rtol=0.25)
    assert max(ratios) > VARIES_RATIO


def test_a_value_that_grows_from_nothing_along_a_run_is_none():
    of = constancy(from_nothing)
    assert_allclose(of.values["time"][:, 0], np.array([1, 3, 5]) / 3 * SIZE, atol=0.02)
    # 2/3 to either side of the mean in two of three
    assert of.ratio == pytest.approx(np.sqrt(2 / 3) * 2 / 3, rel=0.1)
    assert of.ratio > VARIES_RATIO
    assert (of.certain, of.varies, of.split) == (True, True, "time")
    assert of.caveat.startswith("its value depends on time: 0.0")
    # the other one stays what it is
    assert not constancy(from_nothing, own=NAMES[1:]).varies


def test_a_value_of_other_runs_is_none_and_of_few_runs_is_not_given():
    of = constancy(lambda i, at: SIZE * (0.4 if i < N_RUNS / 2 else 1.6))
    assert (of.varies, of.split) == (True, "runs")
    assert_allclose(of.values["runs"][:, 0], [0.4 * SIZE, 1.6 * SIZE], atol=0.02)
    assert "depends on the run: " in of.caveat
    few = constancy(lambda i, at: SIZE * (0.5 if i < 2 else 1.5), n_runs=4)
    assert ([*few.values], few.varies) == (["time"], False)


def test_a_value_that_differs_by_less_is_named_with_what_it_depends_on():
    of = constancy(lambda i, at: SIZE * (0.85 + 0.3 * at), noise=0.2, inflation=0.04)
    assert CAVEAT_RATIO < of.ratio < VARIES_RATIO
    assert (of.certain, of.varies) == (True, False)
    assert of.caveat != ""
    # the same difference within the noise is none
    within = constancy(lambda i, at: SIZE * (0.85 + 0.3 * at), inflation=25.0)
    assert (within.certain, within.varies, within.caveat) == (False, False, "")


def test_a_third_that_shows_nothing_or_little_does_not_count():
    """Robots stand first: a value that is the same in the rest is constant, one that is not is none."""
    one = constancy(constant, stands_first)
    assert np.isnan(one.values["time"][:, 0]).tolist() == [True, False, False]
    assert not one.certain
    other = constancy(lambda i, at: SIZE * (0.4 + 1.2 * (at > 2 / 3)), stands_first)
    assert (other.varies, other.split) == (True, "time")
    assert np.isnan(other.std["time"][0]).all()
    assert "nan" not in other.caveat
    # the start of a run, hardly excited, has another value: that is no size of the whole
    little = constancy(
        lambda i, at: SIZE * stands_first(at), lambda at: 0.1 + 0.9 * stands_first(at), noise=0.3
    )
    assert little.certain
    assert little.ratio < 0.5 * VARIES_RATIO


def test_of_two_parameters_the_one_that_is_apart_by_noise_is_no_size():
    """One differs by a hundredth, beyond doubt; the other is hardly shown in thirds."""
    of = constancy(
        lambda i, at: SIZE * (0.99 + 0.02 * at), own=NAMES, inflation=1e-4, noise=0.01, second=1e-3
    )
    assert np.ptp(of.values["time"][:, 1]) > CAVEAT_RATIO * SIZE
    assert of.certain
    assert of.ratio < CAVEAT_RATIO


# -- Values by session: what is in each is found, with the same causes, and sessions are compared ----------

TRACK = "effective_track_ratio"
SIMULATION = simulation_of(load_robot("husky"))
LIBRARY = tuple(map(effect_named, ("effective_track", "gyro_scale", "turning_slip", "payload")))


@pytest.fixture(scope="module")
def of_sessions(hide):
    """Return a function that diagnoses six runs of each session, which has an effective track of its own."""

    def diagnosed(tracks):
        runs = [
            replace(run, run_id=f"{session}_{run.run_id}", session=session.strip("_"))
            for seed, (session, track) in enumerate(tracks.items(), start=4)
            for run in hide({TRACK: track}, duration_s=25.0, seed=seed)
        ]
        return diagnose(runs, SIMULATION, LIBRARY)

    return diagnosed


def test_sessions_that_are_alike_agree_and_each_holds_the_truth(of_sessions):
    diagnosis = of_sessions({"a": 0.6, "b": 0.6, "c": 0.6})
    (table,) = diagnosis.by_session
    assert (table.name, table.unit, table.agree) == (TRACK, "ratio", True)
    assert [(own.session, own.runs) for own in table.sessions] == [("a", 6), ("b", 6), ("c", 6)]
    assert table.between_std < 0.02
    for own in table.sessions:
        low, high = own.ci
        assert abs(own.value - 0.6) < 0.75 * (high - low) < 0.12
        assert own.text.startswith("0.9")  # 1.6 times 0.5708 m
        assert " m (" in own.text
    assert notes_of(diagnosis, (), {}) == ()


def test_sessions_that_differ_are_named_with_their_values(of_sessions):
    diagnosis = of_sessions({"a": 0.5, "b": 0.5, "worn": 0.9})
    table = next(table for table in diagnosis.by_session if table.name == TRACK)
    assert not table.agree
    assert table.between_std == pytest.approx(0.23, abs=0.05)
    assert [own.value for own in table.sessions] == pytest.approx([0.5, 0.5, 0.9], abs=0.05)
    (note,) = (note for note in notes_of(diagnosis, (), {}) if "effective track" in note)
    assert "differ" in note
    assert "in worn" in note


@pytest.mark.parametrize("session", ["a", "_"])
def test_one_session_and_runs_without_one_have_no_table(of_sessions, session):
    assert of_sessions({session: 0.6}).by_session == ()


def test_of_sessions_that_agree_one_in_a_hundred_sets_is_said_to_differ():
    rng, std = np.random.default_rng(1), np.array([0.5, 1.0, 2.0])
    n_below, n_sets, dof = 0, 4000, 12
    for _ in range(n_sets):
        own = std * np.sqrt(rng.chisquare(dof, 3) / dof)
        n_below += agreement(std * rng.standard_normal(3), own, np.full(3, float(dof)))[0] < 0.01
    assert 0.004 < n_below / n_sets < 0.02
