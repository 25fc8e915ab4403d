"""A fitted novelty score as plain numbers: how unlike all known terrains a window is, without scikit-learn.

Three terms, each larger for a window that is less like the training windows:

- margin: ``-max_a min_b f_ab`` of a support vector machine for each pair of classes, whose kernel is narrow,
  so that the margins of windows far from all others fall towards a constant;
- relative Mahalanobis distance ``min_c |W (z - m_c)|^2 - |B (z - m_0)|^2`` of the principal components z,
  with the within-class covariance ``(W'W)^-1`` and that of all windows ``(B'B)^-1`` (Ren et al. 2021, A
  simple fix to Mahalanobis distance for improving near-OOD detection, eq. 3);
- distance to the nearest training window in the first components.

Each term has its rank among the terms of held-out known windows, ``P = (n_above + 1) / (n + 1)``, and the
score is ``-(log P_1 + log P_2 + log P_3)`` (Fisher 1932, combination of independent tests; the terms depend
on each other, so that the score is compared with a threshold of held-out windows and not with a chi-square).
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.errors import DataError
from terrain.records import Array

N_TERMS = 3
N_NEAR = 10
"""Neighbours are sought in so many leading components: in more, all distances become alike."""


class NoveltyNumbers(NamedTuple):
    """What a fitted novelty score computes with.

    Parameters
    ----------
    columns : (m,) places of the features that are used
    fill, mean, scale : (m,) median, mean and standard deviation of each
    components : (q, m) principal directions, divided by the square root of m
    within, background : (q, q) W and B
    means, centre : (k, q) and (q,) means of the classes and of all windows, multiplied by W and by B
    prototypes : (s, at most 10) training windows in the leading components
    vectors, weights, offsets : (v, m), (v, p) and (p,) of the pairs' margins
        ``f = sum_i w_i exp(-gamma / m |x - v_i|^2) + c``, positive for the first class of a pair
    squares : (v,) squared lengths of the vectors
    reference : (n, 3) ascending terms of held-out known windows
    settings : (4,) clip in standard deviations, number of features before selection, gamma, threshold of the
        score
    """

    columns: Array
    fill: Array
    mean: Array
    scale: Array
    components: Array
    within: Array
    background: Array
    means: Array
    centre: Array
    prototypes: Array
    vectors: Array
    weights: Array
    offsets: Array
    squares: Array
    reference: Array
    settings: Array

    @property
    def threshold(self) -> float:
        """Score above which a window is unknown."""
        return float(self.settings[3])


def check_novelty(numbers: NoveltyNumbers, n_classes: int) -> None:
    """Refuse numbers that do not fit each other.

    Raises
    ------
    DataError
        if a shape is another, a number is not finite, or a place is none.
    """
    m, q, s, n = (
        len(numbers.columns),
        len(numbers.components),
        len(numbers.prototypes),
        len(numbers.reference),
    )
    near, v, p = min(q, N_NEAR), len(numbers.vectors), n_classes * (n_classes - 1) // 2
    shapes = (
        (m,), (m,), (m,), (m,), (q, m), (q, q), (q, q), (n_classes, q), (q,), (s, near),
        (v, m), (v, p), (p,), (v,), (n, N_TERMS), (4,)
    )  # fmt: skip
    for name, array, shape in zip(numbers._fields, numbers, shapes, strict=True):
        kind = "iu" if name == "columns" else "f"
        if array.shape != shape or array.dtype.kind not in kind or not np.isfinite(array).all():
            raise DataError(f"the novelty score's {name} are not {shape} finite numbers")
    if min(m, q, s, n) == 0 or numbers.columns.min() < 0 or numbers.columns.max() >= numbers.settings[1]:
        raise DataError("the novelty score's columns are none of its features")
    if (numbers.scale <= 0.0).any() or (numbers.settings[:3] <= 0.0).any():
        raise DataError("the novelty score's scales are not above zero")


def novelty_scores(numbers: NoveltyNumbers, features: Array) -> Array:
    """Return the score (n,) of each window; NaN where a feature is infinite.

    Parameters
    ----------
    numbers : of the fitted score
    features : (n, f), NaN where not defined

    Raises
    ------
    DataError
        if there are not as many features.
    """
    return fisher_scores(numbers.reference, novelty_terms(numbers, features))


def novelty_terms(numbers: NoveltyNumbers, features: Array) -> Array:
    """Return the three terms (n, 3) of each window; arguments and errors as :func:`novelty_scores`."""
    clip, n_features, gamma, _ = numbers.settings.tolist()
    if features.ndim != 2 or features.shape[1] != n_features:
        raise DataError(f"features have the shape {features.shape}, (n, {n_features:.0f}) is needed")
    used = features[:, numbers.columns]
    used = np.where(np.isfinite(used), used, numbers.fill)
    scaled = np.clip((used - numbers.mean) / numbers.scale, -clip, clip)
    components = scaled @ numbers.components.T
    terms = np.empty((len(features), N_TERMS))
    margins = pair_margins(numbers, gamma / len(numbers.columns), scaled)
    terms[:, 0] = -largest_margin(margins, len(numbers.means))
    terms[:, 1] = _least_squares(components @ numbers.within.T, numbers.means)
    terms[:, 1] -= np.square(components @ numbers.background.T - numbers.centre).sum(axis=1)
    near = np.ascontiguousarray(components[:, : numbers.prototypes.shape[1]])
    terms[:, 2] = np.sqrt(_least_squares(near, numbers.prototypes))
    terms[np.isinf(features).any(axis=1)] = np.nan
    return terms


def largest_margin(margins: Array, n_classes: int) -> Array:
    """Return ``max_a min_b f_ab`` (n,) of the margins of pairs (n, p): by how much the best class wins.

    Examples
    --------
    >>> largest_margin(np.array([[2.0, 0.5, -1.0], [-1.0, 1.0, 1.0]]), 3)
    array([0.5, 1. ])
    """
    least = np.full((len(margins), n_classes), np.inf)
    for pair, (a, b) in enumerate(combinations(range(n_classes), 2)):
        least[:, a] = np.minimum(least[:, a], margins[:, pair])
        least[:, b] = np.minimum(least[:, b], -margins[:, pair])
    found: Array = least.max(axis=1)
    return found


def fisher_scores(reference: Array, terms: Array) -> Array:
    """Return the score (n,) of terms (n, j) by their ranks in ascending references (r, j).

    Examples
    --------
    >>> reference = np.arange(9.0)[:, np.newaxis]
    >>> fisher_scores(reference, np.array([[-1.0], [100.0]])).round(3) + 0.0
    array([0.   , 2.303])
    """
    n = len(reference)
    score = np.zeros(len(terms))
    for j in range(terms.shape[1]):
        n_above = n - np.searchsorted(reference[:, j], terms[:, j])
        score -= np.log((n_above + 1) / (n + 1))
    score[~np.isfinite(terms).all(axis=1)] = np.nan
    return score


@njit(cache=True, nogil=True, error_model="numpy")
def _least_squares(rows: Array, points: Array) -> Array:
    """Return the squared distance (n,) from each row to the nearest point."""
    found = np.empty(rows.shape[0])
    for n in range(rows.shape[0]):
        least = np.inf
        for i in range(points.shape[0]):
            squares = 0.0
            for j in range(points.shape[1]):
                difference = rows[n, j] - points[i, j]
                squares += difference * difference
            least = min(least, squares)
        found[n] = least
    return found


def pair_margins(numbers: NoveltyNumbers, gamma: float, rows: Array) -> Array:
    """Return the margin (n, p) of each pair of classes of each row (n, m)."""
    products = rows.astype(numbers.vectors.dtype) @ numbers.vectors.T
    squares = np.square(rows).sum(axis=1)[:, np.newaxis] + numbers.squares - 2.0 * products
    found: Array = np.exp(-gamma * np.maximum(squares, 0.0)) @ numbers.weights + numbers.offsets
    return found
