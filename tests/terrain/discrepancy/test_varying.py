"""Effects that differ from run to run: in two groups, at random, in one run alone, or not at all."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from studies.blind_trials.trial import simulation_of

from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.varying import fit_mixed, run_scatter, varying_effects, with_conditions
from terrain.discrepancy.verdict import Verdict
from terrain.effects import effect_named
from terrain.robots import load_robot

SIMULATION = simulation_of(load_robot("husky"))
RADIUS, PAYLOAD = "wheel_radius_ratio", "payload_ratio"
LIBRARY = ("wheel_radius", "effective_track", "payload", "gyro_scale", "camera_yaw", "accel_bias")
N_RUNS = 8
ODD = np.arange(N_RUNS) % 2


@pytest.fixture(scope="module")
def runs(hide):
    """Return a function that makes runs, each with a value of its own."""
    return lambda values, name=RADIUS, **more: hide([{name: float(x)} for x in values], n=N_RUNS, **more)


@pytest.fixture(scope="module")
def varying(runs, pose, solve):
    """Return a function that gives what varies, and the fit, where a parameter has values by run."""

    def differs(values, name=RADIUS, library=LIBRARY, **more):
        problem = pose(runs(values, name, **more), library)
        fit = solve(problem)
        return varying_effects(problem, fit), fit

    return differs


def test_half_of_the_runs_are_a_group_and_that_is_the_answer(runs, varying):
    half = runs(0.06 * ODD)
    (effect,), _ = varying(0.06 * ODD)
    assert (effect.name, effect.rivals, effect.channel) == ("wheel_radius", (), "speed_x_mps")
    assert effect.mean == pytest.approx(0.03, abs=0.005)
    assert effect.scatter == pytest.approx(0.03 * np.sqrt(8 / 7), rel=0.3)
    one, other = effect.groups
    assert one.runs == tuple(run.run_id for run in half[::2])
    assert other.runs == tuple(run.run_id for run in half[1::2])
    assert abs(one.value) < 4 * one.std < 0.01
    assert abs(other.value - 0.06) < 4 * other.std < 0.01
    # no value of all runs is named
    diagnosis = diagnose(half, SIMULATION, tuple(map(effect_named, LIBRARY)))
    assert (diagnosis.verdict, diagnosis.causes, diagnosis.ambiguous_sets) == (Verdict.VARIES, (), ())
    assert [each.name for each in diagnosis.varying] == ["wheel_radius"]


def test_a_spread_that_is_even_has_no_groups(varying):
    values = np.linspace(-0.03, 0.09, N_RUNS)
    (effect,), fit = varying(values)
    assert (effect.name, effect.groups) == ("wheel_radius", ())
    assert effect.scatter == pytest.approx(np.std(values, ddof=1), rel=0.3)
    assert run_scatter(fit, RADIUS) == pytest.approx(effect.scatter, rel=0.02)
    assert run_scatter(fit, "camera_yaw_rad") < 0.01


@pytest.mark.parametrize("values", [np.zeros(N_RUNS), np.full(N_RUNS, 0.06), 0.06 * (np.arange(N_RUNS) == 3)])
def test_runs_that_are_alike_and_one_rogue_do_not_vary(varying, values):
    assert varying(values)[0] == ()


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
        ("lever_y_m", 0.06, "lever_arm camera_yaw gyro_scale", ("lever_arm", ()), "husky"),
        # far from where sensitivities are taken first
        ("effective_track_ratio", 0.8, "effective_track turning_slip", ("effective_track", ()), "husky"),
    ],
)
def test_what_half_of_the_runs_have_is_stated_with_its_values(varying, name, value, library, answer, robot):
    effects, _ = varying(value * ODD, name, library.split(), robot=robot)
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
    def error_of(loads, most):
        problem = pose(runs(loads, PAYLOAD), FEW, replace(LOADED, varied_error={PAYLOAD: most}))
        return with_conditions(problem, problem.at(SIMULATION.vector)).simulation.model_error[PAYLOAD]

    assert error_of(SPREAD, 0.3) == pytest.approx(np.sqrt(3.0) * SPREAD.std(ddof=1), rel=0.25)
    assert error_of(SPREAD, 0.1) == 0.1
    assert error_of(SAME, 0.3) < 0.1  # one load in all runs is no condition that differs


def test_loads_that_differ_are_news_only_to_a_simulation_that_knows_of_none(runs):
    library = tuple(map(effect_named, FEW))
    assert list(diagnose(runs(SAME, PAYLOAD), LOADED, library).values) == [PAYLOAD]
    assert diagnose(runs(SPREAD, PAYLOAD), LOADED, library).verdict in (Verdict.NONE, Verdict.NOT_EXCITED)
    assert diagnose(runs(SPREAD, PAYLOAD), SIMULATION, library).verdict is not Verdict.NONE


# -- The likelihood of runs whose parameters vary, by two routes, and its maximum ----------------------------

N, ROWS = 12, 30
SHARED, OWN = [0, 1], [1, 2]
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
    x, r = columns[:, :, SHARED], columns[:, :, 3]
    a, g = np.einsum("irk,irs,isl->kl", x, weight, x), np.einsum("irk,irs,is->k", x, weight, r)
    shared = np.linalg.solve(a, g)
    square = np.einsum("ir,irs,is->", r, weight, r) - g @ shared
    return square + np.linalg.slogdet(covariance)[1].sum(), shared


@pytest.mark.parametrize("std", [[0.5, 0.2], [1.0, 0.01], [1e-3, 2.0]])
def test_the_likelihood_is_that_of_the_rows(columns, std):
    fit = fit_mixed(gram(columns), SHARED, OWN, LEAST, np.array(std), ~FREE)
    loss, shared = direct(columns, std)
    assert fit.loss == pytest.approx(loss, rel=1e-9)
    assert_allclose(fit.shared, shared, rtol=1e-8)
    assert_allclose(fit.std, std)


def test_free_variances_are_of_greatest_likelihood_the_others_stay_and_none_is_below_the_least(columns):
    fit = fit_mixed(gram(columns), SHARED, OWN, LEAST, np.ones(2), FREE)
    best = minimize(lambda log_std: direct(columns, np.exp(log_std))[0], np.zeros(2), method="Nelder-Mead")
    assert fit.loss == pytest.approx(best.fun, abs=0.05)
    assert_allclose(fit.std, np.exp(best.x), rtol=0.1)
    held = fit_mixed(gram(columns), SHARED, OWN, LEAST, np.ones(2), np.array([True, False]))
    assert held.std[1] == 1.0
    assert fit.loss < held.loss
    columns[:, :, 3] = 2.0 * columns[:, :, 0] + columns[:, :, 1]
    still = fit_mixed(gram(columns), SHARED, OWN, np.full(2, 0.1), np.ones(2), FREE)
    assert_allclose(still.std, 0.1)
    assert_allclose(still.shared, [2.0, 1.0], rtol=1e-9)
