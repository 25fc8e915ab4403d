"""Whether a window is of a terrain that was never learned: how unlike all known ones it is.

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

The references are windows of known terrains whose runs took no part in fitting: inner folds of whole runs.  The
threshold keeps a given part of these windows.  Nothing is weighted, so that nothing has to be learned from
terrains that are left out.  The score needs no classifier, and stands beside any.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from terrain.classify.folds import inner_splits, two_classes
from terrain.errors import DataError
from terrain.records import Array

N_TERMS = 3
N_NEAR = 10
"""Neighbours are sought in so many leading components: in more, all distances become alike."""
KNOWN_KEPT = 0.95
"""Part of the windows of known terrains that is not to be called unknown."""
N_COMPONENTS = 40
MAX_PROTOTYPES = 1500
"""Neighbours are sought among at most so many training windows, thinned evenly: 15 us a window."""
MAX_REFERENCE = 2000
CLIP_STD = 5.0
"""Scaled features are clipped here, as those of the classifier."""
SELECTED = 0.8
"""Part of the features that an F test between classes keeps, as the classifier's."""
N_INNER_FOLDS = 5
PENALTY, GAMMA = 10.0, 1.0
"""Of the support vector machine; gamma is relative to 1 / number of features.  The kernel is narrower than
what classifies best."""


class Novelty(NamedTuple):
    """A fitted score of novelty.

    Parameters
    ----------
    n_features : before selection
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
    threshold : of the score, above which a window is unknown
    """

    n_features: int
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
    threshold: float

    def score(self, features: Array) -> Array:
        """Return the score (n,) of features (n, f), NaN where not defined; NaN where one is infinite.

        Raises
        ------
        DataError
            if there are not as many features.
        """
        return fisher_scores(self.reference, self.terms(features))

    def is_unknown(self, features: Array) -> Array:
        """Return whether each window (n,) is unlike all known terrains; so is one without a score."""
        return ~(self.score(features) <= self.threshold)

    def terms(self, features: Array) -> Array:
        """Return the three terms (n, 3) of each window; arguments and errors as :meth:`score`."""
        features = np.asarray(features, dtype=float)
        if features.ndim != 2 or features.shape[1] != self.n_features:
            raise DataError(f"features have the shape {features.shape}, (n, {self.n_features}) is needed")
        used = features[:, self.columns]
        used = np.where(np.isfinite(used), used, self.fill)
        scaled = np.clip((used - self.mean) / self.scale, -CLIP_STD, CLIP_STD)
        components = scaled @ self.components.T
        terms = np.empty((len(features), N_TERMS))
        terms[:, 0] = -largest_margin(self._pair_margins(scaled), len(self.means))
        terms[:, 1] = cdist(components @ self.within.T, self.means, "sqeuclidean").min(axis=1)
        terms[:, 1] -= np.square(components @ self.background.T - self.centre).sum(axis=1)
        terms[:, 2] = cdist(components[:, : self.prototypes.shape[1]], self.prototypes).min(axis=1)
        terms[np.isinf(features).any(axis=1)] = np.nan
        return terms

    def _pair_margins(self, rows: Array) -> Array:
        products = rows.astype(self.vectors.dtype) @ self.vectors.T
        squares = np.square(rows).sum(axis=1)[:, np.newaxis] + self.squares - 2.0 * products
        gamma = GAMMA / len(self.columns)
        return np.asarray(np.exp(-gamma * np.maximum(squares, 0.0)) @ self.weights + self.offsets)


def check_novelty(novelty: Novelty, n_classes: int) -> None:
    """Refuse a score whose numbers do not fit each other.

    Raises
    ------
    DataError
        if a shape is another, a number is not finite, or a place is none.
    """
    m, q, s, n = (
        len(part) for part in (novelty.columns, novelty.components, novelty.prototypes, novelty.reference)
    )
    near, v, p = min(q, N_NEAR), len(novelty.vectors), n_classes * (n_classes - 1) // 2
    shapes = (
        (), (m,), (m,), (m,), (m,), (q, m), (q, q), (q, q), (n_classes, q), (q,), (s, near),
        (v, m), (v, p), (p,), (v,), (n, N_TERMS), ()
    )  # fmt: skip
    for name, array, shape in zip(novelty._fields, map(np.asarray, novelty), shapes, strict=True):
        kind = "iu" if name in ("columns", "n_features") else "f"
        if array.shape != shape or array.dtype.kind not in kind or not np.isfinite(array).all():
            raise DataError(f"the novelty score's {name} are not {shape} finite numbers")
    if min(m, q, s, n) == 0 or novelty.columns.min() < 0 or novelty.columns.max() >= novelty.n_features:
        raise DataError("the novelty score's columns are none of its features")
    if (novelty.scale <= 0.0).any():
        raise DataError("the novelty score's scales are not above zero")


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


def learn_novelty(
    X: Array,
    y: Array,
    groups: Array | None = None,
    *,
    n_inner_folds: int = N_INNER_FOLDS,
    gap: int = 1,
    seed: int = 0,
) -> Novelty:
    """Return the score of novelty that training windows give.

    Parameters
    ----------
    X : (n, f) features, NaN where not defined
    y : (n,) classes
    groups : (n,) run of each row; every row is its own run when missing
    n_inner_folds : of whole runs, whose windows are the references
    gap : rows left out beside a block, where the only run of a class is cut
    seed : deals runs into inner folds

    Raises
    ------
    DataError
        if there is one class only, or rows are too few to hold some of them out.
    """
    X, y = np.asarray(X, dtype=float), np.asarray(y)
    groups = np.arange(len(y)) if groups is None else np.asarray(groups)
    two_classes(y)
    terms = np.full((len(y), N_TERMS), np.nan)
    for train, test in inner_splits(y, groups, n_inner_folds, seed, gap):
        terms[test] = _fitted(X[train], y[train]).terms(X[test])
    known = terms[np.isfinite(terms).all(axis=1)]
    if not len(known):
        raise DataError("the windows are too few to hold some of them out; add runs")
    reference = np.sort(known, axis=0)
    if len(reference) > MAX_REFERENCE:
        reference = np.quantile(reference, np.linspace(0.0, 1.0, MAX_REFERENCE), axis=0)
    threshold = float(np.quantile(fisher_scores(reference, known), KNOWN_KEPT))
    return _fitted(X, y)._replace(reference=reference, threshold=threshold)


def _fitted(X: Array, y: Array) -> Novelty:
    """Return the score without references and threshold."""
    from terrain.classify.svm import f_score

    valid = np.isfinite(X)
    some = valid.any(axis=0)
    fill = np.zeros(X.shape[1])
    fill[some] = np.nanmedian(np.where(valid, X, np.nan)[:, some], axis=0)
    filled = np.where(valid, X, fill)
    mean, scale = filled.mean(axis=0), filled.std(axis=0)
    columns = np.flatnonzero(scale > 1e-12 * np.abs(mean))
    if not len(columns):
        raise DataError("no feature varies: windows cannot be compared")
    with np.errstate(divide="ignore", invalid="ignore"):
        f_test = np.nan_to_num(f_score(filled[:, columns], y)[0], posinf=np.inf)
    columns = columns[f_test >= np.quantile(f_test, 1.0 - SELECTED)]
    fill, mean, scale = fill[columns], mean[columns], scale[columns]
    scaled = np.clip((filled[:, columns] - mean) / scale, -CLIP_STD, CLIP_STD)
    directions = np.linalg.eigh(np.cov(scaled, rowvar=False).reshape(len(columns), -1))[1][:, ::-1]
    n_components = min(N_COMPONENTS, len(columns), len(X) - 1)
    components = np.ascontiguousarray(directions[:, :n_components].T) / np.sqrt(len(columns))
    z = scaled @ components.T
    classes, class_of = np.unique(y, return_inverse=True)
    means = np.stack([z[class_of == c].mean(axis=0) for c in range(len(classes))])
    within, background = _whitening(z - means[class_of]), _whitening(z - z.mean(axis=0))
    step = -(-len(z) // MAX_PROTOTYPES)
    return Novelty(
        X.shape[1], columns.astype(np.int64), fill, mean, scale, components, within, background,
        means @ within.T, background @ z.mean(axis=0), np.ascontiguousarray(z[::step, :N_NEAR]),
        *_pair_machine(scaled, y), np.zeros((0, N_TERMS)), np.inf,
    )  # fmt: skip


def _pair_machine(scaled: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return support vectors, their weights in each pair of classes, offsets, and squared lengths."""
    from sklearn.svm import SVC

    svc = SVC(C=PENALTY, gamma=GAMMA / scaled.shape[1], cache_size=500).fit(scaled, y)
    sign = -1.0 if len(svc.classes_) == 2 else 1.0  # scikit-learn turns the two-class decision around
    bounds = np.concatenate(([0], np.cumsum(svc.n_support_)))
    pairs = list(combinations(range(len(svc.classes_)), 2))
    weights = np.zeros((len(svc.support_vectors_), len(pairs)))
    for pair, (a, b) in enumerate(pairs):
        of_a, of_b = slice(bounds[a], bounds[a + 1]), slice(bounds[b], bounds[b + 1])
        weights[of_a, pair] = sign * svc.dual_coef_[b - 1, of_a]
        weights[of_b, pair] = sign * svc.dual_coef_[a, of_b]
    vectors = svc.support_vectors_.astype(np.float32)  # half the memory that a window has to go through
    return vectors, weights, sign * svc.intercept_, np.square(vectors, dtype=float).sum(axis=1)


def _whitening(residuals: Array) -> Array:
    """Return W (q, q) with ``W'W`` the inverse of the shrunk covariance (Ledoit and Wolf 2004) of rows."""
    from sklearn.covariance import ledoit_wolf

    covariance = ledoit_wolf(residuals, assume_centered=True)[0]
    covariance += 1e-9 * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    found: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return found
