"""RBF support vector machine that chooses and calibrates itself on folds which keep runs whole.

Windows of one run resemble each other more than they resemble windows of the same terrain in another run.
Hyper-parameters chosen, or probabilities calibrated, on folds that split runs are therefore too optimistic;
here the inner folds are made of whole groups wherever a class has more than one.

Steps of ``fit``: scale and select on each inner training part, fit every candidate there, keep the
candidate with the best accuracy on the held-out parts; its held-out margins of pairs of classes give the one
scale, below, that makes the true classes most likely; scale, select and fit once
more on everything.

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

import warnings
from collections.abc import Sequence
from itertools import combinations
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field
from scipy.optimize import minimize_scalar
from sklearn.feature_selection import SelectPercentile, VarianceThreshold, f_classif
from sklearn.impute import SimpleImputer
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import SVC
from sklearn.utils.validation import check_is_fitted

from terrain.classify.folds import block_groups, split_runs
from terrain.classify.grouped import GroupedClassifier
from terrain.errors import DataError
from terrain.kernels import njit
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


@njit(nogil=True, error_model="numpy")
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


@njit(nogil=True, error_model="numpy")
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


CLIP_STD = 5.0
"""Scaled features are clipped here, so that one faulty sample cannot move a window far from all others."""

MAX_INNER_ROWS = 4000
"""Hyper-parameters are chosen on at most so many rows, thinned evenly: overlapping windows repeat each other,
and the cost of an SVM grows with the square of their number.  The last fit uses all rows."""


class Candidate(NamedTuple):
    """One choice of hyper-parameters.

    ``gamma`` is relative to 1 / number of selected features, so that it means the same distance whatever
    the number; ``percentile`` is the percentage of the features that an F test keeps.
    """

    C: Annotated[float, Field(gt=0.0, le=1e6)]
    gamma: Annotated[float, Field(gt=0.0, le=1e3)]
    percentile: Annotated[float, Field(gt=0.0, le=100.0)]


CANDIDATES: tuple[Candidate, ...] = (
    Candidate(10.0, 1.0, 80.0),
    Candidate(10.0, 1.0, 100.0),
    Candidate(10.0, 0.4, 80.0),
    Candidate(10.0, 0.4, 100.0),
    Candidate(3.0, 0.15, 100.0),
    Candidate(30.0, 0.15, 100.0),
)


class Preparation(NamedTuple):
    """What the features of a window become before the SVM: missing ones filled, then scaled, clipped, selected.

    Parameters
    ----------
    columns : (m,) places of the features that are used
    fill, mean, scale : (m,) median, mean and standard deviation of each in training
    """

    columns: Array
    fill: Array
    mean: Array
    scale: Array

    def of(self, X: Array) -> Array:
        """Return the prepared features (n, m) of rows (n, f)."""
        used = X[:, self.columns]
        used = np.where(np.isnan(used), self.fill, used)
        return np.asarray(np.clip((used - self.mean) / self.scale, -CLIP_STD, CLIP_STD))


class GroupedSVC(GroupedClassifier):
    """RBF SVM with its own scaling, selection, choice of hyper-parameters and calibration.

    Parameters
    ----------
    candidates : sequence of :class:`Candidate` to choose from
    n_inner_folds : inner folds; the number of inner fits is this times the number of candidates
    gap : windows left out beside an inner test block, where the only run of a class is cut; as many as
        share samples with a window
    seed : deals runs into inner folds

    Attributes
    ----------
    classes_ : (k,) class names
    best_ : the chosen :class:`Candidate`
    inner_scores_ : (n_candidates,) accuracy on the held-out inner parts
    inner_probability_ : (n, k) of training rows when their run was held out to choose; NaN where it never was
    n_inner_fits_ : how many SVMs were fitted to choose and to calibrate
    """

    def __init__(
        self,
        candidates: Sequence[Sequence[float]] = CANDIDATES,
        n_inner_folds: int = 3,
        gap: int = 1,
        seed: int = 0,
    ) -> None:
        self.candidates = candidates
        self.n_inner_folds = n_inner_folds
        self.gap = gap
        self.seed = seed

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> GroupedSVC:
        """Choose, calibrate and fit.

        Parameters
        ----------
        X : (n, f) features, NaN where not defined
        y : (n,) classes
        groups : (n,) run of each row; every row is its own run when missing

        Raises
        ------
        DataError
            if there is one class only, or a class has too few windows to hold some of them out.
        """
        X, y, groups = self._training_rows(X, y, groups)
        counts = np.unique(y, return_counts=True)[1]
        if counts.min() < 2:
            rare = str(self.classes_[counts.argmin()])
            raise DataError(f"there is one window of class {rare!r}; at least 2 are needed")
        candidates = [Candidate(*candidate) for candidate in self.candidates]
        step = -(-len(y) // MAX_INNER_ROWS)
        inner_y, gap = y[::step], -(-self.gap // step)
        held_out, margins = self._inner_margins(
            X[::step], inner_y, groups[::step], gap, np.random.default_rng(self.seed), candidates
        )
        truth, k = np.searchsorted(self.classes_, inner_y[held_out]), len(self.classes_)
        scales = [fit_scale(margin[held_out], truth, k) for margin in margins]
        self.inner_scores_ = np.array(
            [
                np.mean(probabilities_of_known(margin[held_out], k, scale).argmax(axis=1) == truth)
                for margin, scale in zip(margins, scales, strict=True)
            ]
        )
        best = int(np.argmax(self.inner_scores_))
        self.best_, self.scale_ = candidates[best], scales[best]
        self.inner_probability_ = np.full((len(y), k), np.nan)
        self.inner_probability_[np.arange(0, len(y), step)[held_out]] = probabilities_of_known(
            margins[best][held_out], k, self.scale_
        )
        self.preparation_ = fit_preparation(X, y, self.best_.percentile)
        self.svc_ = _fit_svc(self.best_, self.preparation_.of(X), y)
        return self

    def _inner_margins(
        self,
        X: Array,
        y: Array,
        groups: Array,
        gap: int,
        rng: np.random.Generator,
        candidates: Sequence[Candidate],
    ) -> tuple[Array, Array]:
        n_groups = len(np.unique(block_groups(y, groups, self.n_inner_folds).astype(str)))
        n_folds = min(self.n_inner_folds, n_groups, *np.unique(y, return_counts=True)[1])
        k = len(self.classes_)
        margins = np.full((len(candidates), len(y), k * (k - 1) // 2), np.nan)
        held_out = np.zeros(len(y), dtype=bool)
        self.n_inner_fits_ = 0
        for train, test in split_runs(y, groups, n_folds, rng, gap):
            if len(np.unique(y[train])) < 2:
                continue  # the gap beside a short block has left out all windows of a class
            held_out[test] = True
            for percentile in dict.fromkeys(candidate.percentile for candidate in candidates):
                preparation = fit_preparation(X[train], y[train], percentile)
                prepared, prepared_test = preparation.of(X[train]), preparation.of(X[test])
                for i, candidate in enumerate(candidates):
                    if candidate.percentile == percentile:
                        svc = _fit_svc(candidate, prepared, y[train])
                        margins[i, test] = _margins(svc, prepared_test, self.classes_)
                        self.n_inner_fits_ += 1
        if not held_out.any():
            raise DataError("the windows are too few to hold some of them out; add runs")
        return held_out, margins

    def decision_function(self, X: Array) -> Array:
        """Return the logarithm of each class's probability (n, k), of which the largest wins.

        As in all of scikit-learn, two classes have one value (n,), positive for the second.
        """
        check_is_fitted(self)
        if len(self.classes_) == 2:
            return -self.scale_ * self.margins(X)[:, 0]
        return np.asarray(np.log(np.maximum(self.predict_proba(X), np.finfo(float).tiny)))

    def margins(self, X: Array) -> Array:
        """Return the margins of the pairs of classes (n, k (k - 1) / 2), positive for the first of a pair."""
        rows = self._rows(X)
        return _margins(self.svc_, self.preparation_.of(rows), self.classes_)

    def predict_proba(self, X: Array) -> Array:
        """Return calibrated probabilities (n, k) in the order of ``classes_``."""
        return class_probabilities(self.margins(X), len(self.classes_), self.scale_)


def f_score(X: Array, y: Array) -> tuple[Array, Array]:
    """Return the F test of each feature; a feature that is constant within every class divides by zero."""
    with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        scores: tuple[Array, Array] = f_classif(X, y)
    return scores


def fit_preparation(X: Array, y: Array, percentile: float) -> Preparation:
    """Return the preparation of features that vary and that an F test keeps.

    Parameters
    ----------
    X, y : (n, f) features, NaN where not defined, and (n,) classes
    percentile : of the features that vary
    """
    clip = FunctionTransformer(np.clip, kw_args={"a_min": -CLIP_STD, "a_max": CLIP_STD})
    steps = Pipeline(
        [
            ("impute", SimpleImputer(strategy="median", keep_empty_features=True)),
            ("constant", VarianceThreshold()),
            ("scale", StandardScaler()),
            ("clip", clip),
            ("select", SelectPercentile(f_score, percentile=percentile)),
        ]
    ).fit(X, y)
    selected = steps["select"].get_support()
    columns = np.flatnonzero(steps["constant"].get_support())[selected]
    fill = np.nan_to_num(steps["impute"].statistics_[columns])  # of a feature without any value
    return Preparation(columns, fill, steps["scale"].mean_[selected], steps["scale"].scale_[selected])


def _fit_svc(candidate: Candidate, prepared: Array, y: Array) -> SVC:
    gamma = candidate.gamma / prepared.shape[1]
    return SVC(C=candidate.C, gamma=gamma, cache_size=500, decision_function_shape="ovo").fit(prepared, y)


def _margins(svc: SVC, prepared: Array, classes: Array) -> Array:
    """Return the margins of all pairs of classes; NaN in those of a class that was not there to train on."""
    values = svc.decision_function(prepared)
    if values.ndim == 1:
        values = -values[:, None]  # scikit-learn turns the two-class decision around
    places = np.searchsorted(classes, svc.classes_)
    column = {pair: i for i, pair in enumerate(pairs_of(len(classes)))}
    margins = np.full((len(prepared), len(column)), np.nan)
    margins[:, [column[places[a], places[b]] for a, b in pairs_of(len(places))]] = values
    return margins
