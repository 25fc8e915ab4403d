"""The filter of the terrain over time by its plain form, in which a refused window only lets time pass."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from terrain.classify import terrain_filter as constants
from terrain.classify.terrain_filter import check_prior, filter_run
from terrain.errors import ConfigError, DataError

THREE = np.array([0.5, 0.3, 0.2])


def draw(seed, n=40, k=3, refused_ratio=0.2):
    """Return class probabilities with refused windows, times with gaps, and scores of novelty."""
    rng = np.random.default_rng(seed)
    probability = rng.dirichlet(np.full(k, 0.3), n)
    probability[rng.random(n) < refused_ratio] = np.nan
    return probability, np.cumsum(rng.choice([0.0, 0.25, 0.25, 2.0, 30.0], n)), rng.normal(0.0, 1.0, n)


def dense_filter(probability, time_s, prior, novelty):
    """Return the beliefs by a full generator matrix and logarithms."""
    k = len(prior)
    shares = np.append(np.full(k, (1 - constants.UNKNOWN_RATIO) / k), constants.UNKNOWN_RATIO)
    rate = 1.0 / (constants.DWELL_S * (1.0 - shares[0]))
    generator = rate * (np.tile(shares, (k + 1, 1)) - np.eye(k + 1))
    belief, before_s, output_s, found = shares, time_s[0], -np.inf, []
    for p, now_s, score in zip(probability, time_s, novelty, strict=True):
        belief = belief @ expm(generator * (now_s - before_s))
        before_s = now_s
        if not np.isnan(p).any():
            power = min((now_s - output_s) / constants.EVIDENCE_S, 1.0)
            output_s = now_s
            mixed = (1 - constants.OUTLIER_RATIO) * p / prior + constants.OUTLIER_RATIO
            log_belief = np.log(belief) + power * np.append(np.log(mixed), score)
            belief = np.exp(log_belief - log_belief.max())
            belief = belief / belief.sum()
        found.append(belief)
    return np.array(found)


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_filter_agrees_with_a_dense_matrix_exponential(seed):
    probability, time_s, novelty = draw(seed)
    found = filter_run(probability, time_s, THREE, novelty)
    np.testing.assert_allclose(found, dense_filter(probability, time_s, THREE, novelty), atol=1e-9)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-12)


def test_what_means_nothing_or_does_not_fit_is_refused():
    for prior, message in (((1.0,), "1 classes, at least 2"), ((0.0, 1.0), "prior of class 1 is 0.0")):
        with pytest.raises(ConfigError, match=message):
            check_prior(prior)
    with pytest.raises(DataError, match=r"shape \(4, 2\), \(4, 3\) is needed"):
        filter_run(np.ones((4, 2)), np.arange(4.0), THREE)
    with pytest.raises(DataError, match="in order of time"):
        filter_run(np.ones((2, 3)), np.array([1.0, 0.0]), THREE)
    with pytest.raises(DataError, match="1 scores of novelty do not fit 2 windows"):
        filter_run(np.ones((2, 3)), np.array([0.0, 1.0]), THREE, np.zeros(1))
