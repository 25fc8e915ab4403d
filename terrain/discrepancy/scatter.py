"""Scatter from run to run of the parameters that vary by themselves, estimated from the runs.

Of each run ``i`` the whitened residual, with what all runs have in common taken out, is ``N_i (m + b_i) +
e_i`` with ``b_i ~ N(0, D)``.  The variances in ``D`` are those of greatest likelihood, by expectation and
maximisation (Laird and Ware, Biometrics 1982): with ``G = N'N`` and ``s = N'r``,

    V = (G + D^-1)^-1,   b = V (s - G m),   u = (n + 1)/(n + b^2 / D),
    D <- mean of u b^2 + V over runs,   m <- m + mean of b weighted by u.

The mean ``m`` is there since what was taken out is a fit to all runs: one run of another robot moves it, and
all others deviate from it alike.  The weight ``u`` is that of deviations with Student's distribution of ``n``
degrees (Lange et al., JASA 1989): one run of another robot is no scatter.  Variances that were assumed count
as some runs more, and are the least: a few runs that happen to be alike do not show that a robot never
varies.
"""

from __future__ import annotations

import numpy as np

from terrain.records import Array

PRIOR_RUNS = 4.0
"""What was assumed counts as so many runs: enough that three runs do not deny it."""

TAIL_DOF = 4.0
"""Degrees of freedom of deviations from run to run: few enough for a run in twenty that is far out."""

NORMAL_RATIO = 0.786
"""Mean of ``u z^2`` of normal deviations ``z``, by which estimates are divided to be right for them."""

MORE_RATIO = 1.5
"""An estimate counts from that ratio of what was assumed: eight runs determine it to a quarter, and
what is within that is no news."""

EM_STEPS = 60
"""Enough for a scatter that is ten times what was assumed; one that runs hardly show stays as assumed."""


def scatter_of(gram: Array, score: Array, assumed_std: Array) -> Array:
    """Return the standard deviation (q,) of parameters from run to run.

    Parameters
    ----------
    gram : (runs, q, q) of whitened sensitivities of each run
    score : (runs, q) of the whitened residual along them, what all runs have in common taken out
    assumed_std : (q,) the least

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> value = 0.3 * rng.standard_normal((200, 1))
    >>> bool(abs(scatter_of(np.full((200, 1, 1), 1e4), 1e4 * value, np.array([0.02]))[0] - 0.3) < 0.03)
    True
    """
    assumed = assumed_std**2
    variance, mean = assumed.copy(), np.zeros(len(assumed))
    for _ in range(EM_STEPS):
        inner = np.linalg.inv(gram + np.diag(1.0 / variance))
        own = np.einsum("iqp,ip->iq", inner, score - gram @ mean)
        weight = (TAIL_DOF + 1.0) / (TAIL_DOF + own**2 / variance)
        mean = mean + (weight * own).sum(axis=0) / weight.sum(axis=0)
        square = weight / NORMAL_RATIO * own**2 + np.einsum("iqq->iq", inner)
        variance = (PRIOR_RUNS * assumed + square.sum(axis=0)) / (PRIOR_RUNS + len(gram))
        variance = np.maximum(variance, assumed)
    std = np.sqrt(variance)
    return np.where(std > MORE_RATIO * assumed_std, std, assumed_std)
