"""Class probabilities from the margins of pairs of classes.

One support vector machine separates each pair of classes (a, b), a before b, by a margin ``f_ab``, positive
for a.  With one scale s for all pairs, ``r_ab = 1 / (1 + exp(-s f_ab))`` estimates the probability of a where
the truth is a or b, and the class probabilities p are those that agree best with all pairs (Wu, Lin and Weng
2004, "Probability estimates for multi-class classification by pairwise coupling", JMLR 5, equations 15, 18):

    minimise  sum_a sum_{b != a} (r_ba p_a - r_ab p_b)^2   subject to  sum_a p_a = 1

which is one linear system: with ``Q_aa = sum_{b != a} r_ba^2`` and ``Q_ab = -r_ba r_ab``, the solution of
``(Q + 1 1') z = 1`` divided by its sum.

One-vs-rest decision values that count the votes of the pairs, as scikit-learn's do, saturate at the number of
classes and rank windows hardly by how often they are right; the margins themselves do.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numba import njit
from scipy.optimize import minimize_scalar

from terrain.records import Array

LOG_SCALE_BOUNDS = (-4.0, 5.0)
"""Margins of support vectors are 1: beyond these bounds probabilities of the pairs are flat or 0 and 1."""

MIN_PAIR_PROBABILITY = 1e-7
"""Probabilities of pairs are kept from 0 and 1 by this, as in LIBSVM: the linear system is regular then."""


def pairs_of(n_classes: int) -> list[tuple[int, int]]:
    """Return the pairs of classes in the order of their margins.

    Examples
    --------
    >>> pairs_of(3)
    [(0, 1), (0, 2), (1, 2)]
    """
    return list(combinations(range(n_classes), 2))


def class_probabilities(margins: Array, n_classes: int, scale: float) -> Array:
    """Return the probabilities (n, k) that agree best with the margins of all pairs.

    Parameters
    ----------
    margins : (n, k (k - 1) / 2) of the pairs in the order of :func:`pairs_of`
    n_classes : k, at least 2
    scale : of the margins, above zero

    Examples
    --------
    >>> class_probabilities(np.array([[2.0, 2.0, 0.0]]), 3, 1.0).round(2)
    array([[0.79, 0.11, 0.11]])
    >>> class_probabilities(np.array([[0.0]]), 2, 1.0)
    array([[0.5, 0.5]])
    """
    found: Array = _coupled(np.ascontiguousarray(margins, dtype=np.float64), n_classes, float(scale))
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _coupled(margins: Array, k: int, scale: float) -> Array:
    probability = np.empty((margins.shape[0], k))
    ratio = np.empty((k, k))
    system = np.empty((k, k))
    for n in range(margins.shape[0]):
        pair = 0
        for a in range(k):
            for b in range(a + 1, k):
                r = 1.0 / (1.0 + np.exp(-scale * margins[n, pair]))
                r = min(max(r, MIN_PAIR_PROBABILITY), 1.0 - MIN_PAIR_PROBABILITY)
                ratio[a, b], ratio[b, a] = r, 1.0 - r
                pair += 1
        for a in range(k):
            system[a, a] = 1.0
            for b in range(k):
                if b != a:
                    system[a, a] += ratio[b, a] * ratio[b, a]
                    system[a, b] = 1.0 - ratio[b, a] * ratio[a, b]
        _solve_ones(system, probability[n])
        total = 0.0
        for a in range(k):
            probability[n, a] = max(probability[n, a], 0.0)  # -1e-17 of rounding
            total += probability[n, a]
        probability[n] /= total
    return probability


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_ones(system: Array, solution: Array) -> None:
    """Solve ``system z = 1``, symmetric and positive definite, by Cholesky's ``L L'`` in its place."""
    k = solution.size
    for i in range(k):
        for j in range(i + 1):
            total = system[i, j]
            for m in range(j):
                total -= system[i, m] * system[j, m]
            system[i, j] = np.sqrt(total) if i == j else total / system[j, j]
    for i in range(k):
        total = 1.0
        for m in range(i):
            total -= system[i, m] * solution[m]
        solution[i] = total / system[i, i]
    for i in range(k - 1, -1, -1):
        total = solution[i]
        for m in range(i + 1, k):
            total -= system[m, i] * solution[m]
        solution[i] = total / system[i, i]


def fit_scale(margins: Array, class_index: Array, n_classes: int) -> float:
    """Return the scale under which the true classes of held-out windows are most likely.

    Parameters
    ----------
    margins : (n, k (k - 1) / 2), NaN in the pairs of a class that was not there to train on
    class_index : (n,) true class of each row
    n_classes : k

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> margin = rng.normal(size=(4000, 1))
    >>> drawn = (rng.random(4000) > 1.0 / (1.0 + np.exp(-3.0 * margin[:, 0]))).astype(int)
    >>> abs(fit_scale(margin, drawn, 2) - 3.0) < 0.3
    True
    """
    groups = []
    for rows, classes in _present_classes(margins, n_classes):
        known = rows[np.isin(class_index[rows], classes)]
        kept = margins[np.ix_(known, _pairs_among(classes, n_classes))]
        groups.append((kept, len(classes), np.searchsorted(classes, class_index[known])))

    def loss(log_scale: float) -> float:
        total = 0.0
        for kept, columns, truth in groups:
            found = class_probabilities(kept, columns, float(np.exp(log_scale)))
            total -= float(np.log(found[np.arange(len(truth)), truth] + MIN_PAIR_PROBABILITY).sum())
        return total

    return float(np.exp(minimize_scalar(loss, bounds=LOG_SCALE_BOUNDS, method="bounded").x))


def probabilities_of_known(margins: Array, n_classes: int, scale: float) -> Array:
    """Return probabilities (n, k); a class whose pairs are all NaN has none in that row.

    Parameters
    ----------
    margins, n_classes, scale : as :func:`class_probabilities`, NaN in the pairs of a class that was not there
        to train on

    Examples
    --------
    >>> probabilities_of_known(np.array([[np.nan, 0.0, np.nan]]), 3, 1.0)
    array([[0.5, 0. , 0.5]])
    """
    found = np.zeros((len(margins), n_classes))
    for rows, classes in _present_classes(margins, n_classes):
        kept = margins[np.ix_(rows, _pairs_among(classes, n_classes))]
        found[np.ix_(rows, classes)] = class_probabilities(kept, len(classes), scale)
    return found


def _present_classes(margins: Array, n_classes: int) -> list[tuple[Array, Array]]:
    """Return rows that have the same pairs, and the classes of these pairs."""
    patterns, number = np.unique(np.isnan(margins), axis=0, return_inverse=True)
    pairs = np.array(pairs_of(n_classes))
    return [
        (np.flatnonzero(number.ravel() == i), np.unique(pairs[~lacking]))
        for i, lacking in enumerate(patterns)
    ]


def _pairs_among(classes: Array, n_classes: int) -> Array:
    """Return the columns of the pairs of which both are among some classes."""
    return np.flatnonzero(np.isin(pairs_of(n_classes), classes).all(axis=1))
