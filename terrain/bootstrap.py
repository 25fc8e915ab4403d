"""Bootstrap over runs or sessions: samples of one are not independent, so whole ones are drawn, with replacement.

Sources: Efron and Tibshirani, An Introduction to the Bootstrap (1993), 13.3 (percentile interval).  Of few units a
bootstrap within strata is too narrow twice: drawing n of n gives (n - 1) / n of the variance, which n - 1 draws of
weight n / (n - 1) mend (Rao and Wu 1988, Resampling inference with complex survey data), and percentiles are those of
a normal distribution, not Student's t, which percentiles further out mend (Hesterberg 2015,
The American Statistician 69, 371, 4.2).  No percentile reaches beyond the units themselves, and the range of three has
the next mean in three of four cases only: of very few, the interval is Student's t of the deviation of the draws.
"""

from __future__ import annotations

import numpy as np
from scipy.special import betaincinv, ndtr, stdtrit

from terrain.records import Array

LEVEL = 0.95  #: Probability of an interval unless another is given
#: With fewer degrees of freedom percentiles do not reach: of five units the range has 94 %, of two of each of three
#: classes 74 %.
MIN_PERCENTILE_FREEDOM = 6


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
    """Return the weight of each unit (n_draws, units), which add up to their number in each stratum.

    Parameters
    ----------
    stratum : (units,) that each run or session belongs to, as its class; the only one of a stratum counts once
    n_draws : bootstrap samples
    rng : source of the draws

    Examples
    --------
    >>> stratified_counts(np.array(["ice", "ice", "mud"]), 2, np.random.default_rng(0)).tolist()
    [[2.0, 0.0, 1.0], [0.0, 2.0, 1.0]]
    """
    counts = np.zeros((n_draws, len(stratum)))
    for name in np.unique(stratum):
        members = np.flatnonzero(stratum == name)
        n = len(members)
        drawn = rng.multinomial(n - 1, np.full(n, 1 / n), n_draws) * n / (n - 1) if n > 1 else 1.0
        counts[:, members] = drawn
    return counts


def shared_strata(unit: Array, terrain: Array) -> Array:
    """Return the stratum (n,) of units (n,): their class (n,) or, where units hold several, all that these link.

    What a session shares is shared by all of its classes, so that it is one unit of all of them together.

    Examples
    --------
    >>> shared_strata(np.array(["a", "a", "b", "c"]), np.array(["ice", "mud", "mud", "sand"])).tolist()
    ['ice, mud', 'ice, mud', 'ice, mud', 'sand']
    """
    names, row = np.unique(unit, return_inverse=True)
    classes, column = np.unique(terrain.astype(str), return_inverse=True)
    holds = np.zeros((len(names), len(classes)), dtype=bool)
    holds[row, column] = True
    linked = holds.T @ holds
    for _ in classes:
        linked = linked @ linked
    return np.array([", ".join(classes[each]) for each in linked])[column]


def freedom_of(unit: Array, stratum: Array) -> int:
    """Return the degrees of freedom of a figure over units (n,) of strata (n,): those that their means leave."""
    return len(np.unique(unit)) - len(np.unique(stratum))


def bootstrap_rows(n: int, n_draws: int, rng: np.random.Generator) -> Array:
    """Return which of ``n`` runs are drawn in each bootstrap sample (n_draws, n).

    For one stratum; draw each stratum of its own runs to keep their numbers.
    """
    return rng.integers(n, size=(n_draws, n))


def percentile_interval(
    draws: Array,
    level: float = LEVEL,
    freedom: float = np.inf,
    ends: tuple[float, float] = (-np.inf, np.inf),
) -> tuple[float, float]:
    """Return the interval of a given probability from bootstrap draws (n_draws,); NaN is skipped.

    Percentiles are those at which Student's t of so many degrees of freedom has that probability; of fewer than
    :data:`MIN_PERCENTILE_FREEDOM` it is Student's own about their mean, within the ``ends`` of what is possible, and
    with none NaN.

    Examples
    --------
    >>> percentile_interval(np.arange(101.0), 0.5)
    (25.0, 75.0)
    >>> [round(end, 2) for end in percentile_interval(np.array([0.6, 0.8]), 0.95, 2, (0.0, 1.0))]
    [0.27, 1.0]
    """
    if not freedom > 0 or not np.isfinite(draws).any():
        return np.nan, np.nan
    if freedom < MIN_PERCENTILE_FREEDOM:
        middle, half = np.nanmean(draws), stdtrit(freedom, (1 + level) / 2) * np.nanstd(draws)
        return max(float(middle - half), ends[0]), min(float(middle + half), ends[1])
    below = ndtr(-stdtrit(freedom, (1 + level) / 2)) if np.isfinite(freedom) else (1 - level) / 2
    low, high = np.nanquantile(draws, [below, 1 - below])
    return float(low), float(high)


def proportion_interval(k: float, n: float, level: float = LEVEL) -> tuple[float, float]:
    """Return the interval of a proportion of which k of n units are; both may be fractions, of units that are in part.

    Source: Clopper and Pearson, Biometrika 26 (1934).

    Examples
    --------
    >>> [round(end, 3) for end in proportion_interval(0, 59, 0.9)]
    [0.0, 0.05]
    """
    if not k >= 0.0:
        return np.nan, np.nan
    below = betaincinv(k, n - k + 1, (1 - level) / 2) if k > 0 else 0.0
    return float(below), float(betaincinv(k + 1, n - k, (1 + level) / 2)) if k < n else 1.0
