"""Bootstrap over runs: samples of one run are not independent, so whole runs are drawn, with replacement.

Source: Efron and Tibshirani, An Introduction to the Bootstrap (1993), 13.3 (percentile interval).
"""

from __future__ import annotations

import numpy as np

from terrain.records import Array

LEVEL = 0.95  #: Probability of an interval unless another is given


def bootstrap_counts(n: int, n_draws: int, seed: int) -> Array:
    """Return how often each of ``n`` runs is drawn in each bootstrap sample (n_draws, n).

    Examples
    --------
    >>> bootstrap_counts(3, 2, 0).sum(axis=1)
    array([3, 3])
    """
    counts: Array = np.random.default_rng(seed).multinomial(n, np.full(n, 1 / n), n_draws)
    return counts


def stratified_counts(stratum: Array, n_draws: int, rng: np.random.Generator) -> Array:
    """Return how often each run is drawn (n_draws, runs), of each stratum as many as it has.

    Parameters
    ----------
    stratum : (runs,) that each run belongs to, as its class
    n_draws : bootstrap samples
    rng : source of the draws

    Examples
    --------
    >>> stratified_counts(np.array(["ice", "ice", "mud"]), 2, np.random.default_rng(0))[:, 2]
    array([1., 1.])
    """
    counts = np.zeros((n_draws, len(stratum)))
    for name in np.unique(stratum):
        members = np.flatnonzero(stratum == name)
        counts[:, members] = rng.multinomial(len(members), np.full(len(members), 1 / len(members)), n_draws)
    return counts


def bootstrap_rows(n: int, n_draws: int, rng: np.random.Generator) -> Array:
    """Return which of ``n`` runs are drawn in each bootstrap sample (n_draws, n).

    For one stratum; draw each stratum of its own runs to keep their numbers.
    """
    return rng.integers(n, size=(n_draws, n))


def percentile_interval(draws: Array, level: float = LEVEL) -> tuple[float, float]:
    """Return the interval of a given probability from bootstrap draws (n_draws,); NaN is skipped.

    Examples
    --------
    >>> percentile_interval(np.arange(101.0), 0.5)
    (25.0, 75.0)
    """
    low, high = np.nanquantile(draws, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
