"""Fitting of the novelty score: whether a window is of a terrain that was never learned.

The terms and their combination are those of :mod:`terrain.classify.novelty_numbers`.  Their references are
windows of known terrains whose runs took no part in fitting: inner folds of whole runs.  The threshold keeps
a given part of these windows.  Nothing is weighted, so that nothing has to be learned from terrains that are
left out.  The score needs no classifier, and stands beside any.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from sklearn.base import BaseEstimator
from sklearn.covariance import ledoit_wolf
from sklearn.svm import SVC
from sklearn.utils.validation import check_is_fitted

from terrain.classify.inner import inner_splits
from terrain.classify.novelty_numbers import (
    N_NEAR,
    N_TERMS,
    NoveltyNumbers,
    fisher_scores,
    novelty_scores,
    novelty_terms,
)
from terrain.classify.svm import f_score
from terrain.errors import DataError
from terrain.records import Array

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


class NoveltyScore(BaseEstimator):
    """How unlike all known terrains a window is.

    Parameters
    ----------
    n_inner_folds : of whole runs, whose windows are the references
    gap : rows left out beside a block, where the only run of a class is cut
    seed : deals runs into inner folds

    Attributes
    ----------
    numbers_ : :class:`~terrain.classify.novelty_numbers.NoveltyNumbers`
    """

    def __init__(self, n_inner_folds: int = N_INNER_FOLDS, gap: int = 1, seed: int = 0) -> None:
        self.n_inner_folds = n_inner_folds
        self.gap = gap
        self.seed = seed

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> NoveltyScore:
        """Fit the distances and margins, their references, and the threshold.

        Parameters
        ----------
        X : (n, f) features, NaN where not defined
        y : (n,) classes
        groups : (n,) run of each row; every row is its own run when missing

        Raises
        ------
        DataError
            if there is one class only, or rows are too few to hold some of them out.
        """
        X, y = np.asarray(X, dtype=float), np.asarray(y)
        groups = np.arange(len(y)) if groups is None else np.asarray(groups)
        classes = np.unique(y)
        if len(classes) < 2:
            raise DataError(f"all windows are {str(classes[0])!r}: a classifier needs at least two classes")
        terms = np.full((len(y), N_TERMS), np.nan)
        for train, test in inner_splits(y, groups, self.n_inner_folds, self.seed, self.gap):
            terms[test] = novelty_terms(_fit(X[train], y[train]), X[test])
        known = terms[np.isfinite(terms).all(axis=1)]
        if not len(known):
            raise DataError("the windows are too few to hold some of them out; add runs")
        reference = np.sort(known, axis=0)
        if len(reference) > MAX_REFERENCE:
            reference = np.quantile(reference, np.linspace(0.0, 1.0, MAX_REFERENCE), axis=0)
        threshold = float(np.quantile(fisher_scores(reference, known), KNOWN_KEPT))
        fitted = _fit(X, y)
        settings = np.append(fitted.settings[:3], threshold)
        self.numbers_ = fitted._replace(reference=reference, settings=settings)
        return self

    def score(self, X: Array) -> Array:
        """Return the score (n,) of features (n, f), higher for windows less like any known terrain."""
        check_is_fitted(self, "numbers_")
        return novelty_scores(self.numbers_, np.asarray(X, dtype=float))

    def is_unknown(self, X: Array) -> Array:
        """Return whether each window (n,) is unlike all known terrains; so is one without a score."""
        return ~(self.score(X) <= self.numbers_.threshold)


def _fit(X: Array, y: Array) -> NoveltyNumbers:
    """Return the numbers of the terms, without references and threshold."""
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
    return NoveltyNumbers(
        columns.astype(np.int64), fill, mean, scale, components, within, background,
        means @ within.T, background @ z.mean(axis=0), np.ascontiguousarray(z[::step, :N_NEAR]),
        *_pair_machine(scaled, y), np.zeros((0, N_TERMS)), np.array([CLIP_STD, X.shape[1], GAMMA, np.inf]),
    )  # fmt: skip


def _pair_machine(scaled: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return support vectors, their weights in each pair of classes, offsets, and squared lengths."""
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
    covariance = ledoit_wolf(residuals, assume_centered=True)[0]
    covariance += 1e-9 * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    found: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return found
