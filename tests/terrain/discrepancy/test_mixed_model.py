"""The likelihood of runs whose parameters vary, by two routes, and its maximum."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from terrain.discrepancy.varying import fit_mixed

N_RUNS, N_ROWS = 12, 30
SHARED, OWN = [0, 1], [1, 2]
LEAST = np.full(2, 1e-6)


@pytest.fixture
def columns():
    """Return columns (runs, rows, 4) of which the second varies by 0.5 about 1, the third by 0.2 about 0."""
    rng = np.random.default_rng(4)
    x = rng.standard_normal((N_RUNS, N_ROWS, 3))
    x[:, :, 2] += 0.6 * x[:, :, 1]
    values = np.array([2.0, 1.0, 0.0]) + rng.standard_normal((N_RUNS, 3)) * [0.0, 0.5, 0.2]
    residual = np.einsum("irk,ik->ir", x, values) + rng.standard_normal((N_RUNS, N_ROWS))
    return np.concatenate([x, residual[:, :, None]], axis=2)


def gram(columns):
    return columns.transpose(0, 2, 1) @ columns


def direct(columns, std):
    """Return minus twice the log-likelihood by the covariance of the rows, and generalised least squares."""
    covariance = np.eye(N_ROWS) + columns[:, :, OWN] * np.square(std) @ columns[:, :, OWN].transpose(0, 2, 1)
    weight = np.linalg.inv(covariance)
    x, r = columns[:, :, SHARED], columns[:, :, 3]
    a, g = np.einsum("irk,irs,isl->kl", x, weight, x), np.einsum("irk,irs,is->k", x, weight, r)
    shared = np.linalg.solve(a, g)
    square = np.einsum("ir,irs,is->", r, weight, r) - g @ shared
    return square + np.linalg.slogdet(covariance)[1].sum(), shared


@pytest.mark.parametrize("std", [[0.5, 0.2], [1.0, 0.01], [1e-3, 2.0]])
def test_the_likelihood_is_that_of_the_rows(columns, std):
    fit = fit_mixed(gram(columns), SHARED, OWN, LEAST, np.array(std), np.zeros(2, dtype=bool))
    loss, shared = direct(columns, std)
    assert fit.loss == pytest.approx(loss, rel=1e-9)
    assert_allclose(fit.shared, shared, rtol=1e-8)
    assert_allclose(fit.std, std)


def test_free_variances_are_of_greatest_likelihood_and_the_others_stay(columns):
    found = fit_mixed(gram(columns), SHARED, OWN, LEAST, np.ones(2), np.ones(2, dtype=bool))
    best = minimize(lambda log_std: direct(columns, np.exp(log_std))[0], np.zeros(2), method="Nelder-Mead")
    assert found.loss == pytest.approx(best.fun, abs=0.05)
    assert_allclose(found.std, np.exp(best.x), rtol=0.1)
    held = fit_mixed(gram(columns), SHARED, OWN, LEAST, np.ones(2), np.array([True, False]))
    assert held.std[1] == 1.0
    assert found.loss < held.loss


def test_no_variance_is_less_than_the_least(columns):
    still = columns[:, :, [0, 1, 2, 3]]
    still[:, :, 3] = 2.0 * still[:, :, 0] + still[:, :, 1]
    fit = fit_mixed(gram(still), SHARED, OWN, np.full(2, 0.1), np.ones(2), np.ones(2, dtype=bool))
    assert_allclose(fit.std, 0.1)
    assert_allclose(fit.shared, [2.0, 1.0], rtol=1e-9)
