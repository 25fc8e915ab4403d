"""Scatter from run to run: hidden and found, by two routes, and one rogue run is none."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from terrain.discrepancy import evidence as scatter
from terrain.discrepancy.evidence import PRIOR_RUNS, scatter_of

ASSUMED = np.array([0.02, 0.05])


def runs(std, n_runs, seed=0, rows=200, noise=0.3):
    """Return gram and score of runs whose two parameters, of correlated sensitivities, deviate at random.

    Of a run, a parameter is known within ``noise / sqrt(rows)`` or so.
    """
    rng = np.random.default_rng(seed)
    deviations = rng.standard_normal((n_runs, 2)) * std
    gram, score = np.empty((n_runs, 2, 2)), np.empty((n_runs, 2))
    for i, own in enumerate(deviations):
        j = rng.standard_normal((2, rows))
        j[1] += 0.5 * j[0]
        j /= noise
        gram[i], score[i] = j @ j.T, j @ (own @ j + rng.standard_normal(rows))
    return gram, score, deviations


def test_a_scatter_of_ten_times_what_was_assumed_is_found():
    hidden = np.array([0.2, 0.5])
    found = np.array([scatter_of(*runs(hidden, 40, seed)[:2], ASSUMED) for seed in range(30)])
    # the few runs that were assumed pull it down
    expected = hidden * np.sqrt(40 / (40 + PRIOR_RUNS))
    of_one = hidden / np.sqrt(2 * 40)
    assert_allclose(found.mean(axis=0), expected, atol=4 * of_one.max() / np.sqrt(30), rtol=0.05)
    assert (np.abs(found - expected) < 5 * of_one).all()


def test_it_is_the_maximum_of_the_likelihood_of_normal_deviations(monkeypatch):
    """Values of each run scatter by both about a weighted mean, and a simplex finds the maximum."""
    gram, score, _ = runs(np.array([0.15, 0.3]), 60, seed=3)

    value = np.linalg.solve(gram, score[:, :, None])[:, :, 0]  # of each run by itself

    def loss(log_variance):
        variance = np.exp(log_variance)
        weight = np.linalg.inv(np.linalg.inv(gram) + np.diag(variance))
        mean = np.linalg.solve(weight.sum(axis=0), np.einsum("iqp,ip->q", weight, value))
        off = value - mean
        total = np.einsum("iq,iqp,ip->", off, weight, off) - np.linalg.slogdet(weight)[1].sum()
        return total + PRIOR_RUNS * (log_variance + ASSUMED**2 / variance).sum()

    best = minimize(loss, np.log(ASSUMED**2), method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-8})
    expected = np.exp(best.x / 2)
    usual = scatter_of(gram, score, ASSUMED)
    assert_allclose(usual, expected, rtol=0.15)
    monkeypatch.setattr(scatter, "TAIL_DOF", 1e12)
    monkeypatch.setattr(scatter, "NORMAL_RATIO", 1.0)
    assert_allclose(scatter_of(gram, score, ASSUMED), expected, rtol=1e-3)


def test_one_rogue_of_twenty_is_no_scatter():
    hidden = np.array([0.1, 0.1])
    grown = []
    for seed in range(10):
        gram, score, deviations = runs(hidden, 20, seed)
        plain = scatter_of(gram, score, ASSUMED)
        score[7] += gram[7] @ (np.array([2.0, 0.0]) - deviations[7])  # as if of another robot
        grown.append(scatter_of(gram, score, ASSUMED)[0] / plain[0])
    assert np.median(grown) < 1.3
    assert max(grown) < 1.5


def test_a_rogue_that_has_moved_the_common_fit_is_no_scatter_of_the_others():
    """A fit to six runs, one of another robot, is off by a sixth of it in all of them."""
    hidden = np.array([0.02, 0.05])
    gram, score, deviations = runs(hidden, 6, noise=0.1)
    deviations[2] = [1.0, 0.0]
    score = np.einsum("iqp,ip->iq", gram, deviations - deviations.mean(axis=0))
    assert scatter_of(gram, score, ASSUMED)[0] < 2 * hidden[0]


@pytest.mark.parametrize("n_runs", [3, 80])
def test_it_is_never_less_than_what_was_assumed(n_runs):
    gram, score, _ = runs(np.zeros(2), n_runs)
    assert (scatter_of(gram, score, ASSUMED) >= ASSUMED).all()
    assert_allclose(scatter_of(gram, 0.0 * score, ASSUMED), ASSUMED)
    # and what runs do not show stays as assumed
    assert_allclose(scatter_of(0.0 * gram, 0.0 * score, ASSUMED), ASSUMED)
