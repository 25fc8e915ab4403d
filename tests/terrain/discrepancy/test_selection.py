"""Evidence of linear problems whose answer is known."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import norm
from scipy.stats import t as student

from terrain.discrepancy.evidence import N_BLOCKS, Evidence, fit_change, grams_of
from terrain.discrepancy.selection import TRUST_DOF, held_out_gain, pooled_variance, wald_test, z_of, z_of_t
from terrain.effects import INDEX, effect_named

PARAMETERS = ("payload_ratio", "gyro_bias_radps", "lever_x_m", "lever_y_m", "wheel_radius_ratio")
N_RUNS, N_ROWS = 8, 120
STD = 1 / (100.0 * np.sqrt(N_RUNS * N_ROWS))
"""Of an estimate."""

PAYLOAD, LEVER, RADIUS = map(effect_named, ("payload", "lever_arm", "wheel_radius"))


def problem(payload=0.0, seed=0, n_runs=N_RUNS, scatter=0.0, alike=0.0, model_std=0.0, lever=0.0):
    """Return a linear problem with white noise of size one, as evidence.

    Parameters
    ----------
    payload, lever : what is there, in standard deviations
    scatter : standard deviation from run to run of the first parameter
    alike : correlation of the sensitivities of the first and the last parameter
    model_std : the simulation's own error in units of the first parameter
    """
    rng = np.random.default_rng(seed)
    k, true = len(PARAMETERS), np.array([payload * STD, 0.0, lever * STD, 0.0, 0.0])
    grams = np.empty((n_runs, N_BLOCKS, k + 1, k + 1))
    for i in range(n_runs):
        j = rng.standard_normal((k, N_ROWS)) * 100.0
        j[-1] = alike * j[0] + np.sqrt(1 - alike**2) * j[-1]
        own = true + np.eye(k)[0] * scatter * rng.standard_normal()
        r = own @ j + rng.standard_normal(N_ROWS)
        grams[i] = grams_of(np.vstack([j, r])[:, :, None])
    point, none = np.zeros(len(INDEX)), np.zeros(0, dtype=int)
    return Evidence(
        PARAMETERS, point, point, grams, none, np.zeros(0), (), None, (), np.eye(k)[0] * model_std
    )


def test_evidence_is_the_fit_over_its_noise():
    z = np.array([wald_test(problem(10.0, seed), (), PAYLOAD).z for seed in range(60)])
    # a t statistic of ten or so, as a normal number, is less: its variance is uncertain
    assert np.median(z) == pytest.approx(z_of_t(10.0, TRUST_DOF + N_RUNS - 1), rel=0.1)
    test = wald_test(problem(10.0), (), PAYLOAD)
    assert test.significant
    assert abs(test.change[0] - 10 * STD) < 4 * STD
    assert_allclose(test.change, fit_change(problem(10.0), ["payload_ratio"])[0])
    assert wald_test(problem(10.0, n_runs=3), (), PAYLOAD).significant  # thirds of runs are the clusters
    assert wald_test(problem(lever=12.0), (), LEVER).significant


@pytest.mark.parametrize(("effect", "selected"), [(PAYLOAD, ("gyro_bias_radps",)), (LEVER, ())])
def test_without_a_hidden_effect_evidence_has_its_nominal_rate(effect, selected):
    z = np.array([wald_test(problem(seed=seed), selected, effect).z for seed in range(200)])
    for limit in (1.0, 2.0, 3.0):
        expected = 2 * norm.sf(limit)
        assert (z > limit).mean() < expected + 3 * np.sqrt(expected / 200)
    assert (z > 1.0).mean() > 0.2


def test_differences_from_run_to_run_reduce_evidence():
    same, other = (wald_test(problem(40.0, scatter=scatter), (), PAYLOAD) for scatter in (0.0, 100 * STD))
    assert same.dispersion == pytest.approx(1.0, abs=0.6)
    assert other.inflation == other.dispersion > 10.0
    assert other.z < 0.3 * same.z


def test_out_of_bounds_or_without_information_nothing_is_significant():
    far = wald_test(problem(1.2 * PAYLOAD.parameters[0].high / STD), (), PAYLOAD)
    assert (far.inside, far.significant) == (False, False)
    blind = problem()
    blind.grams[:, :, 0] = blind.grams[:, :, :, 0] = 0.0
    test = wald_test(blind, (), PAYLOAD)
    assert (test.z, test.significant) == (0.0, False)


@pytest.mark.parametrize("n_runs", [3, N_RUNS])
def test_held_out_gain_is_that_of_fits_without_each_run(n_runs):
    info = problem(5.0, n_runs=n_runs)
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
    fraction, size = np.full(12, 1 / 12), 50.0
    fits = (
        (1 - fraction) * np.sqrt(size / 12) * np.sqrt(12 / 11)
    )  # clusters that scatter as the noise lets them
    variance, dof = pooled_variance(fits, fraction, size)
    assert variance == pytest.approx(1.0)
    assert dof == pytest.approx(TRUST_DOF + 11)
    none, _ = pooled_variance(np.zeros(12), fraction, size)
    assert none == pytest.approx(TRUST_DOF / (TRUST_DOF + 11))  # noise alone is believed so far
    large, dof = pooled_variance(1000 * fits, fraction, size)
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
    # what is seen a hundred times over has a number too, and it grows with what is seen
    z = [wald_test(problem(lever=size), (), LEVER).z for size in (30.0, 100.0, 300.0)]
    assert np.isfinite(z).all()
    assert z == sorted(z)


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_the_simulations_own_error_adds_to_the_variance_of_a_value(ratio):
    infos = [problem(500.0, model_std=std) for std in (0.0, ratio * STD)]
    std = float(np.sqrt(fit_change(infos[0], ["payload_ratio"])[1][0, 0]))
    plain, doubtful = (wald_test(info, (), PAYLOAD) for info in infos)
    assert doubtful.change == pytest.approx(plain.change)
    assert doubtful.dispersion == pytest.approx(plain.dispersion + (ratio * STD / std) ** 2, rel=1e-6)
    assert doubtful.z < plain.z
    # what payload may be off by does not touch an effect beside it
    assert wald_test(infos[0], (), RADIUS).z == wald_test(infos[1], (), RADIUS).z
