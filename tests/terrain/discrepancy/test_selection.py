"""Evidence of linear problems whose answer is known."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import norm
from scipy.stats import t as student

from terrain.discrepancy.evidence import N_BLOCKS, Evidence, grams_of
from terrain.discrepancy.selection import (
    N_BOOTSTRAP,
    TRUST_DOF,
    fit_change,
    gain_interval,
    held_out_gain,
    pooled_variance,
    wald_test,
    z_of,
    z_of_t,
)
from terrain.effects import INDEX, effect_named

PARAMETERS = ("payload_ratio", "gyro_bias_radps", "lever_x_m", "lever_y_m", "wheel_radius_ratio")
N_RUNS, N_ROWS = 8, 120


def problem(true, seed=0, n_runs=N_RUNS, scatter=0.0, alike=0.0, model_std=0.0):
    """Return a linear problem with white noise of size one, as evidence.

    Parameters
    ----------
    true : (k,) what is there
    scatter : standard deviation from run to run of the first parameter
    alike : correlation of the sensitivities of the first and the last parameter
    model_std : the simulation's own error in units of the first parameter
    """
    rng = np.random.default_rng(seed)
    k = len(PARAMETERS)
    grams = np.empty((n_runs, N_BLOCKS, k + 1, k + 1))
    for i in range(n_runs):
        j = rng.standard_normal((k, N_ROWS)) * 100.0
        j[-1] = alike * j[0] + np.sqrt(1 - alike**2) * j[-1]
        own = np.asarray(true) + np.eye(k)[0] * scatter * rng.standard_normal()
        r = own @ j + rng.standard_normal(N_ROWS)
        grams[i] = grams_of(r[:, None], j[:, :, None])
    point, none = np.zeros(len(INDEX)), np.zeros(0, dtype=int)
    error = np.eye(k)[0] * model_std
    return Evidence(PARAMETERS, point, point, grams, none, np.zeros(0), (), None, (), (), error)


STD = 1 / (100.0 * np.sqrt(N_RUNS * N_ROWS))
"""Of an estimate."""

PAYLOAD, LEVER = effect_named("payload"), effect_named("lever_arm")


def true(payload=0.0, lever=0.0):
    return [payload * STD, 0.0, lever * STD, 0.0, 0.0]


def test_evidence_is_the_fit_over_its_noise():
    z = np.array([wald_test(problem(true(10.0), seed), (), PAYLOAD).z for seed in range(60)])
    # a t statistic of ten or so, as a normal number, is less: its variance is uncertain
    dof = TRUST_DOF + N_RUNS - 1
    assert np.median(z) == pytest.approx(z_of_t(10.0, dof), rel=0.1)
    found = wald_test(problem(true(10.0)), (), PAYLOAD)
    assert found.significant
    assert abs(found.change[0] - 10 * STD) < 4 * STD
    assert_allclose(found.change, fit_change(problem(true(10.0)), ["payload_ratio"])[0])


def test_without_a_hidden_effect_evidence_has_its_nominal_rate():
    z = np.array([wald_test(problem(true(), seed), ("gyro_bias_radps",), PAYLOAD).z for seed in range(300)])
    for limit in (1.0, 2.0, 3.0):
        expected = 2 * norm.sf(limit)
        assert (z > limit).mean() < expected + 3 * np.sqrt(expected / 300)
    assert (z > 1.0).mean() > 0.2


def test_of_several_parameters_evidence_is_that_of_all_together():
    z = np.array([wald_test(problem(true(), seed), (), LEVER).z for seed in range(200)])
    assert (z > 2.0).mean() < 0.0455 + 3 * np.sqrt(0.0455 / 200)
    assert wald_test(problem(true(lever=12.0)), (), LEVER).significant


def test_differences_from_run_to_run_reduce_evidence():
    same, other = (problem(true(40.0), scatter=scatter) for scatter in (0.0, 100 * STD))
    assert wald_test(same, (), PAYLOAD).dispersion == pytest.approx(1.0, abs=0.6)
    found = wald_test(other, (), PAYLOAD)
    assert found.dispersion > 10.0
    assert found.inflation == found.dispersion
    assert found.z < 0.3 * wald_test(same, (), PAYLOAD).z


def test_a_selected_cause_reduces_the_evidence_of_a_similar_effect():
    info = problem(true(30.0), alike=0.98)
    radius = effect_named("wheel_radius")
    assert wald_test(info, (), radius).z > 6.0
    assert wald_test(info, ("payload_ratio",), radius).z < 4.0
    assert wald_test(info, ("wheel_radius_ratio",), PAYLOAD).z > 3.0


def test_out_of_bounds_or_without_information_nothing_is_significant():
    high = PAYLOAD.parameters[0].high
    far = problem([1.2 * high, 0.0, 0.0, 0.0, 0.0])
    found = wald_test(far, (), PAYLOAD)
    assert (found.inside, found.significant) == (False, False)
    blind = problem(true())
    blind.grams[:, :, 0] = blind.grams[:, :, :, 0] = 0.0
    found = wald_test(blind, (), PAYLOAD)
    assert (found.z, found.significant) == (0.0, False)


@pytest.mark.parametrize("n_runs", [3, N_RUNS])
def test_held_out_gain_is_that_of_fits_without_each_run(n_runs):
    info = problem(true(5.0), n_runs=n_runs)
    base, both = [1], [1, 0]

    def loss(i, at):
        rest = [k for k in range(n_runs) if k != i]
        a, g = info.a[rest].sum(axis=0)[np.ix_(at, at)], info.g[rest].sum(axis=0)[at]
        x = np.linalg.solve(a, g)
        return x @ info.a[i][np.ix_(at, at)] @ x - 2 * x @ info.g[i][at]

    expected = [loss(i, base) - loss(i, both) for i in range(n_runs)]
    assert_allclose(held_out_gain(info, base, both), expected, rtol=1e-5, atol=1e-6)
    plain = [-loss(i, both) for i in range(n_runs)]
    assert_allclose(held_out_gain(info, [], both), plain, rtol=1e-5, atol=1e-6)


def test_a_variance_is_pooled_from_noise_and_clusters():
    share = np.full(12, 1 / 12)
    size = 50.0
    fits = (1 - share) * np.sqrt(size / 12) * np.sqrt(12 / 11)  # clusters that scatter as the noise lets them
    variance, dof = pooled_variance(fits, share, size)
    assert variance == pytest.approx(1.0)
    assert dof == pytest.approx(TRUST_DOF + 11)
    none, _ = pooled_variance(np.zeros(12), share, size)
    assert none == pytest.approx(TRUST_DOF / (TRUST_DOF + 11))  # noise alone is believed so far
    large, dof = pooled_variance(1000 * fits, share, size)
    assert large == pytest.approx(1e6 * 11 / (TRUST_DOF + 11), rel=1e-3)
    assert dof == pytest.approx(11, rel=1e-3)
    one_tells = np.array([0.9, *np.full(11, 0.1 / 11)])
    _, dof = pooled_variance(1000 * (1 - one_tells) * np.sqrt(size / 12), one_tells, size)
    assert dof < 1.5


def test_z_scores_are_as_improbable_as_the_statistics_they_represent():
    for t, dof in ((2.0, 5.0), (8.0, 15.0)):
        assert 2 * norm.sf(z_of_t(t, dof)) == pytest.approx(2 * student.sf(t, dof))
    assert z_of(np.log(2 * norm.sf(3.0))) == pytest.approx(3.0)
    assert z_of(0.0) == 0.0
    assert z_of(-599.0) == pytest.approx(z_of(-601.0), rel=0.02)
    assert z_of(-1e4) > z_of(-601.0)


def test_the_interval_of_a_gain_covers_its_spread_over_runs():
    rng = np.random.default_rng(0)
    gain = 10.0 + 4.0 * rng.standard_normal(20)
    low, high = gain_interval(gain)
    half = 1.96 * np.std(gain) * np.sqrt(len(gain))
    assert low == pytest.approx(gain.sum() - half, abs=4 * half / np.sqrt(N_BOOTSTRAP) * 2)
    assert high == pytest.approx(gain.sum() + half, abs=4 * half / np.sqrt(N_BOOTSTRAP) * 2)
    assert gain_interval(gain) == (low, high)


def test_with_few_runs_thirds_of_them_are_the_clusters():
    assert wald_test(problem(true(10.0), n_runs=3), (), PAYLOAD).significant


def test_evidence_of_two_parameters_stays_finite_however_clear_they_are():
    """What is seen a hundred times over has a number too, and it grows with what is seen."""
    z = [wald_test(problem(true(lever=size)), (), LEVER).z for size in (30.0, 100.0, 300.0)]
    assert np.isfinite(z).all()
    assert z == sorted(z)


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_the_simulations_own_error_adds_to_the_variance_of_a_value(ratio):
    payload, true = effect_named("payload"), (0.02, 0.0, 0.0, 0.0, 0.0)
    plain = wald_test(problem(true), (), payload)
    std = float(np.sqrt(fit_change(problem(true), ["payload_ratio"])[1][0, 0]))
    doubtful = wald_test(problem(true, model_std=ratio * std), (), payload)
    assert doubtful.change == pytest.approx(plain.change)
    assert doubtful.dispersion == pytest.approx(plain.dispersion + ratio**2, rel=1e-6)
    assert doubtful.z < plain.z
    other = effect_named("wheel_radius")  # what payload may be off by does not touch an effect beside it
    two = [wald_test(problem(true, model_std=m), (), other) for m in (0.0, ratio * std)]
    assert two[0].z == two[1].z
