"""Whether a value is one number, on linear problems whose parameters change as is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from studies.blind_trials.trial import simulation_of

from pipelines.explain.statements import notes_of
from terrain.discrepancy.constancy import (
    CAVEAT_RATIO,
    VARIES_RATIO,
    _of_thirds,
    agreement,
    constancy_of,
    fit_mixed,
    run_scatter,
    values_by_session,
    varying_effects,
    with_conditions,
)
from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.evidence import Evidence, grams_of
from terrain.discrepancy.patterns import Kind
from terrain.discrepancy.search import cause_fit
from terrain.discrepancy.verdict import Tier
from terrain.effects import PARAMETERS, effect_named
from terrain.robots import load_robot

pytestmark = pytest.mark.usefixtures("without_next_drive")
NAMES = ("payload_ratio", "gyro_bias_radps")
N_RUNS, N_ROWS, SIZE = 8, 120, 0.2
SIMULATION = simulation_of(load_robot("husky"))


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
    nowhere = np.zeros(len(PARAMETERS))
    info = Evidence(NAMES, nowhere, nowhere, np.array(grams), {}, (), None, (), np.zeros(2))
    return constancy_of(info, NAMES, own, info.fit(NAMES)[0], inflation)


def constant(i, at):
    return SIZE


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


def test_a_value_that_grows_from_nothing_along_a_run_or_of_other_runs_is_none():
    def from_nothing(i, at):
        return 2 * SIZE * at

    of = constancy(from_nothing)
    assert_allclose(of.values["time"][:, 0], np.array([1, 3, 5]) / 3 * SIZE, atol=0.02)
    # 2/3 to either side of the mean in two of three
    assert of.ratio == pytest.approx(np.sqrt(2 / 3) * 2 / 3, rel=0.1)
    assert of.ratio > VARIES_RATIO
    assert (of.certain, of.varies, of.split) == (True, True, "time")
    assert of.caveat.startswith("its value depends on time: 0.0")
    assert not constancy(from_nothing, own=NAMES[1:]).varies  # the other one stays what it is
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
LIBRARY = tuple(map(effect_named, ("effective_track", "gyro_scale", "payload")))


def test_sessions_of_a_terrain_that_are_alike_agree_and_one_that_differs_is_named(hide):
    """On grass both have one track, on gravel that of one session is worn."""
    tracks = {"a": ("grass", 0.6), "b": ("grass", 0.6), "c": ("gravel", 0.5), "worn": ("gravel", 0.9)}
    runs = []
    for seed, (session, (terrain, track)) in enumerate(tracks.items(), start=4):
        for run in hide({TRACK: track}, n=4, duration_s=20.0, seed=seed):
            label = run.labels[0]._replace(terrain=terrain)
            about = {"run_id": f"{session}_{run.run_id}", "session": session, "labels": (label,)}
            runs.append(replace(run, **about))
    diagnosis = diagnose(runs, SIMULATION, LIBRARY)
    alike, apart = (table for table in diagnosis.by_session if table.name == TRACK)
    assert (alike.terrain, alike.unit, alike.agree) == ("grass", "ratio", True)
    assert [(own.session, own.runs) for own in alike.sessions] == [("a", 4), ("b", 4)]
    assert alike.between_std < 0.02
    for own in alike.sessions:
        low, high = own.ci
        assert abs(own.value - 0.6) < 0.75 * (high - low) < 0.2
        track_m, _, unit = own.text.partition(" ")
        assert float(track_m) == pytest.approx((1.0 + own.value) * 0.5708, abs=0.006)
        assert unit.startswith("m (")
    assert (apart.terrain, apart.agree) == ("gravel", False)
    assert apart.between_std == pytest.approx(0.28, abs=0.05)
    assert [own.value for own in apart.sessions] == pytest.approx([0.5, 0.9], abs=0.05)
    (note,) = (note for note in notes_of(diagnosis, (), {}) if "effective track" in note)
    assert "Sessions of gravel differ" in note
    assert "in worn" in note
    for session in ("a", ""):  # one session, and runs without one
        signals = [SimpleNamespace(terrain="grass", session=session)] * 6
        assert values_by_session(None, signals, (), SIMULATION.robot) == ()


def test_of_sessions_that_agree_one_in_a_hundred_sets_is_said_to_differ():
    rng, std = np.random.default_rng(1), np.array([0.5, 1.0, 2.0])
    n_below, n_sets, dof = 0, 4000, 12
    for _ in range(n_sets):
        own = std * np.sqrt(rng.chisquare(dof, 3) / dof)
        n_below += agreement(std * rng.standard_normal(3), own, np.full(3, float(dof)))[0] < 0.01
    assert 0.004 < n_below / n_sets < 0.02


# -- Effects that differ from run to run: in two groups, at random, in one run alone, or not at all ------------

RADIUS, PAYLOAD = "wheel_radius_ratio", "payload_ratio"
MIXED = ("wheel_radius", "effective_track", "payload", "gyro_scale", "camera_yaw", "accel_bias")
ODD = np.arange(N_RUNS) % 2


@pytest.fixture(scope="module")
def runs(hide):
    """Return a function that makes runs, each with a value of its own."""
    return lambda values, name=RADIUS, **more: hide(
        [{name: float(x)} for x in values], n=N_RUNS, duration_s=20.0, **more
    )


@pytest.fixture(scope="module")
def varying(runs, pose, solve):
    """Return a function that gives what varies, and the fit, where a parameter has values by run."""

    def differs(values, name=RADIUS, library=MIXED, **more):
        problem = pose(runs(values, name, **more), library)
        fit = solve(problem)
        return varying_effects(problem, fit), fit, problem

    return differs


def test_half_of_the_runs_are_a_group_and_that_is_the_answer(runs):
    half = runs(0.06 * ODD)
    diagnosis = diagnose(half, SIMULATION, tuple(map(effect_named, MIXED)))
    # no value of all runs is named
    assert (diagnosis.verdict, diagnosis.causes, diagnosis.ambiguous_sets) == (Tier.CANDIDATE, (), ())
    (effect,) = diagnosis.varying
    assert (effect.name, effect.rivals, effect.channel) == ("wheel_radius", (), "speed_x_mps")
    assert effect.mean == pytest.approx(0.03, abs=0.005)
    assert effect.scatter == pytest.approx(0.03 * np.sqrt(8 / 7), rel=0.3)
    one, other = effect.groups
    assert one.runs == tuple(run.run_id for run in half[::2])
    assert other.runs == tuple(run.run_id for run in half[1::2])
    assert abs(one.value) < 4 * one.std < 0.012
    assert abs(other.value - 0.06) < 4 * other.std < 0.012


def test_a_spread_in_no_order_has_no_groups_and_runs_that_are_alike_do_not_vary(varying):
    values = np.linspace(-0.03, 0.09, N_RUNS)[[3, 6, 1, 4, 0, 7, 2, 5]]
    (effect,), fit, problem = varying(values)
    assert (effect.name, effect.groups, effect.pattern) == ("wheel_radius", (), Kind.SPREAD)
    assert effect.scatter == pytest.approx(np.std(values, ddof=1), rel=0.3)
    assert run_scatter(problem, fit, RADIUS) == pytest.approx(effect.scatter, rel=0.02)
    assert run_scatter(problem, fit, "camera_yaw_rad") < 0.01
    assert varying(np.full(N_RUNS, 0.06))[0] == ()


def test_a_tyre_that_loses_air_is_a_trend_in_its_size_and_one_rogue_run_is_named_and_left_out(runs):
    library = tuple(map(effect_named, MIXED))
    losing = runs(-0.07 * np.arange(N_RUNS) / (N_RUNS - 1))
    (effect,) = diagnose(losing, SIMULATION, library).varying
    assert (effect.name, effect.pattern, effect.n_runs, effect.groups) == (
        "wheel_radius",
        Kind.TREND,
        N_RUNS,
        (),
    )
    low, high = effect.change_ci
    assert effect.change == pytest.approx(-0.07, rel=0.2)
    assert low < -0.07 < high < -0.05
    # the extended robot has what the tyre is after the last run
    assert effect.latest.value == pytest.approx(-0.07, rel=0.2)
    assert effect.latest.low < -0.07 < effect.latest.high
    rogue = diagnose(with_rogue := runs(0.08 * (np.arange(N_RUNS) == 3)), SIMULATION, library)
    (out,) = rogue.excluded_runs
    assert (rogue.varying, out.run_id) == ((), with_rogue[3].run_id)
    assert "unlike the other 7 runs: its wheel radius differs from theirs by 8" in out.reason


@pytest.mark.parametrize("common", [0.0, 1.5])
def test_what_is_wrong_in_all_runs_does_not_decide_what_varies_between_them(hide, pose, common):
    """A slip with force that no cause has yet: in one value of all runs, it would explain most."""
    values = [{RADIUS: 0.06 * float(odd), "force_slip_ratio": common} for odd in ODD]
    problem = pose(hide(values, n=N_RUNS, duration_s=20.0), ("wheel_radius", "force_slip", "gyro_scale"))
    (effect,) = varying_effects(problem, cause_fit(problem, problem.at(SIMULATION.vector), ()))
    assert (effect.name, effect.rivals) == ("wheel_radius", ())
    assert effect.scatter == pytest.approx(0.03 * np.sqrt(8 / 7), rel=0.15)


@pytest.mark.parametrize(
    ("name", "value", "library", "answer", "robot"),
    [
        # one that is absent at its bound
        ("encoder_lag_s", 0.03, "encoder_lag clock_offset camera_latency", ("encoder_lag", ()), "husky"),
        # an offset of one sign looks like an encoder that is early, which none is; of the other, late
        ("clock_offset_s", 0.03, "encoder_lag clock_offset", ("clock_offset", ()), "husky"),
        ("clock_offset_s", 0.03, "encoder_lag", None, "husky"),
        ("clock_offset_s", -0.03, "encoder_lag", ("encoder_lag", ()), "husky"),
        # what varies by itself would take most of a wheel's scale, were its scatter estimated first
        (
            "wheel_scale_2_ratio",
            0.05,
            "wheel_scale_2 one_sided_radius wheel_radius gyro_bias steering_offset_2",
            ("wheel_scale_2", ()),
            "agrimaro",
        ),
        # of two parameters the one that differs is stated
        ("lever_y_m", 0.08, "lever_arm camera_yaw gyro_scale", ("lever_arm", ()), "husky"),
        # far from where sensitivities are taken first
        ("effective_track_ratio", 0.8, "effective_track turning_slip", ("effective_track", ()), "husky"),
    ],
)
def test_what_half_of_the_runs_have_is_stated_with_its_values(varying, name, value, library, answer, robot):
    effects, *_ = varying(value * ODD, name, library.split(), robot=robot)
    assert [(each.name, each.rivals) for each in effects] == [answer] * (answer is not None)
    if answer is not None and answer[0] == name.rpartition("_")[0]:
        assert effects[0].parameter == name
        values = [group.value for group in effects[0].groups]
        assert values == pytest.approx([0.0, value], rel=0.1, abs=0.17 * abs(value))


# -- Conditions that differ from run to run explain a mean of no more than their own scatter makes -----------

LOADED = replace(SIMULATION, varied_error={PAYLOAD: 0.3}, varied_scatter={PAYLOAD: 0.2})
FEW = ("wheel_radius", "payload", "camera_yaw")
SPREAD, SAME = np.linspace(0.0, 0.5, N_RUNS), np.full(N_RUNS, 0.25)


def test_loads_that_differ_explain_a_mean_of_their_scatter_times_root_three(runs, pose):
    spread = runs(SPREAD, PAYLOAD)

    def error_of(runs, most):
        problem = pose(runs, FEW, replace(LOADED, varied_error={PAYLOAD: most}))
        return with_conditions(problem, problem.at(SIMULATION.vector)).simulation.model_error[PAYLOAD]

    assert error_of(spread, 0.3) == pytest.approx(np.sqrt(3.0) * SPREAD.std(ddof=1), rel=0.25)
    assert error_of(spread, 0.1) == 0.1
    assert error_of(runs(SAME, PAYLOAD), 0.3) < 0.1  # one load in all runs is no condition that differs
    # they are news only to a simulation that knows of none
    library = tuple(map(effect_named, FEW))
    assert diagnose(spread, LOADED, library).verdict in (None, Tier.NOT_SHOWN)
    assert diagnose(spread, SIMULATION, library).verdict not in (None, Tier.NOT_SHOWN)


# -- The likelihood of runs whose parameters vary, by two routes, and its maximum ----------------------------

N, ROWS = 12, 30
BOTH, OWN = [0, 1], [1, 2]
LEAST, FREE = np.full(2, 1e-6), np.ones(2, dtype=bool)


@pytest.fixture
def columns():
    """Return columns (runs, rows, 4) of which the second varies by 0.5 about 1, the third by 0.2 about 0."""
    rng = np.random.default_rng(4)
    x = rng.standard_normal((N, ROWS, 3))
    x[:, :, 2] += 0.6 * x[:, :, 1]
    values = np.array([2.0, 1.0, 0.0]) + rng.standard_normal((N, 3)) * [0.0, 0.5, 0.2]
    residual = np.einsum("irk,ik->ir", x, values) + rng.standard_normal((N, ROWS))
    return np.concatenate([x, residual[:, :, None]], axis=2)


def gram(columns):
    return columns.transpose(0, 2, 1) @ columns


def direct(columns, std):
    """Return minus twice the log-likelihood by the covariance of the rows, and generalised least squares."""
    covariance = np.eye(ROWS) + columns[:, :, OWN] * np.square(std) @ columns[:, :, OWN].transpose(0, 2, 1)
    weight = np.linalg.inv(covariance)
    x, r = columns[:, :, BOTH], columns[:, :, 3]
    a, g = np.einsum("irk,irs,isl->kl", x, weight, x), np.einsum("irk,irs,is->k", x, weight, r)
    shared = np.linalg.solve(a, g)
    square = np.einsum("ir,irs,is->", r, weight, r) - g @ shared
    return square + np.linalg.slogdet(covariance)[1].sum(), shared


@pytest.mark.parametrize("std", [[0.5, 0.2], [1.0, 0.01], [1e-3, 2.0]])
def test_the_likelihood_is_that_of_the_rows(columns, std):
    fitted_loss, fitted, fitted_std = fit_mixed(gram(columns), BOTH, OWN, LEAST, np.array(std), ~FREE)
    loss, shared = direct(columns, std)
    assert fitted_loss == pytest.approx(loss, rel=1e-9)
    assert_allclose(fitted, shared, rtol=1e-8)
    assert_allclose(fitted_std, std)


def test_free_variances_are_of_greatest_likelihood_the_others_stay_and_none_is_below_the_least(columns):
    loss, _, std = fit_mixed(gram(columns), BOTH, OWN, LEAST, np.ones(2), FREE)
    best = minimize(lambda log_std: direct(columns, np.exp(log_std))[0], np.zeros(2), method="Nelder-Mead")
    assert loss == pytest.approx(best.fun, abs=0.05)
    assert_allclose(std, np.exp(best.x), rtol=0.1)
    held_loss, _, held = fit_mixed(gram(columns), BOTH, OWN, LEAST, np.ones(2), np.array([True, False]))
    assert held[1] == 1.0
    assert loss < held_loss
    columns[:, :, 3] = 2.0 * columns[:, :, 0] + columns[:, :, 1]
    _, shared, std = fit_mixed(gram(columns), BOTH, OWN, np.full(2, 0.1), np.ones(2), FREE)
    assert_allclose(std, 0.1)
    assert_allclose(shared, [2.0, 1.0], rtol=1e-9)


def test_what_the_model_gets_wrong_where_a_parameter_acts_most_makes_no_run_differ():
    """Values of thirds scatter by 0.1 beside their noise: much information does not make a third more certain."""
    rng, n = np.random.default_rng(4), 400
    precision = np.exp(rng.uniform(np.log(1e1), np.log(1e5), (n, 3)))
    third = 0.1 * rng.standard_normal((n, 3)) + rng.standard_normal((n, 3)) / np.sqrt(precision)
    weight, value, dof = _of_thirds(precision * third, precision)
    assert 0.8 < np.mean(value**2 * weight) < 1.2
    # one third of three that has all the information shows nothing of the noise
    assert n < dof < 2 * n
    assert _of_thirds(*np.array([[[1e3, 1e-3, 1e-3]] * n] * 2))[2] < 0.01
