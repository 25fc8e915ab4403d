"""RBF support vector machine that chooses and calibrates itself on folds which keep runs whole.

Windows of one run resemble each other more than they resemble windows of the same terrain in another run.
Hyper-parameters chosen, or probabilities calibrated, on folds that split runs are therefore too optimistic;
here the inner folds are made of whole groups wherever a class has more than one.

Steps of ``fit``: scale and select on each inner training part, fit every candidate there, keep the
candidate with the best accuracy on the held-out parts; its held-out decision values d give the
temperature T of ``p = softmax(d / T)`` that makes them most likely (Guo et al. 2017, section 4.2), which
sets the confidence and never changes the predicted class; scale, select and fit once more on everything.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax, softmax
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.feature_selection import SelectPercentile, VarianceThreshold, f_classif
from sklearn.impute import SimpleImputer
from sklearn.metrics import accuracy_score
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import SVC
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from terrain.classify.folds import block_groups, split_runs
from terrain.classify.svm_numbers import SvmNumbers
from terrain.errors import DataError
from terrain.records import Array

CLIP_STD = 5.0
"""Scaled features are clipped here, so that one faulty sample cannot move a window far from all others."""

LOG_TEMPERATURE_BOUNDS = (-4.0, 4.0)
"""Decision values lie within about +-k for k classes: beyond these bounds probabilities are 0, 1 or flat."""

MAX_INNER_ROWS = 4000
"""Hyper-parameters are chosen on at most so many rows, thinned evenly: overlapping windows repeat each other,
and the cost of an SVM grows with the square of their number.  The last fit uses all rows."""


class Candidate(NamedTuple):
    """One choice of hyper-parameters.

    ``gamma`` is relative to 1 / number of selected features, so that it means the same distance whatever
    the number; ``percentile`` is the percentage of the features that an F test keeps.
    """

    C: float
    gamma: float
    percentile: float


CANDIDATES: tuple[Candidate, ...] = (
    Candidate(10.0, 1.0, 80.0),
    Candidate(10.0, 1.0, 100.0),
    Candidate(10.0, 0.4, 80.0),
    Candidate(10.0, 0.4, 100.0),
    Candidate(3.0, 0.15, 100.0),
    Candidate(30.0, 0.15, 100.0),
)


class GroupedSVC(ClassifierMixin, BaseEstimator):
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
        X, y = validate_data(self, X, y, ensure_all_finite="allow-nan")
        check_classification_targets(y)
        self.classes_, counts = np.unique(y, return_counts=True)
        if len(self.classes_) < 2:
            raise DataError(
                f"all windows are {str(self.classes_[0])!r}: a classifier needs at least two classes"
            )
        if counts.min() < 2:
            rare = str(self.classes_[counts.argmin()])
            raise DataError(f"there is one window of class {rare!r}; at least 2 are needed")
        groups = np.arange(len(y)) if groups is None else np.asarray(groups)
        candidates = [Candidate(*candidate) for candidate in self.candidates]
        step = -(-len(y) // MAX_INNER_ROWS)
        inner_y, gap = y[::step], -(-self.gap // step)
        held_out, decisions = self._inner_decisions(
            X[::step], inner_y, groups[::step], gap, np.random.default_rng(self.seed), candidates
        )
        self.inner_scores_ = np.array(
            [
                accuracy_score(inner_y[held_out], self.classes_[decision[held_out].argmax(axis=1)])
                for decision in decisions
            ]
        )
        best = int(np.argmax(self.inner_scores_))
        self.best_ = candidates[best]
        self.temperature_ = fit_temperature(
            decisions[best][held_out], np.searchsorted(self.classes_, inner_y[held_out])
        )
        self.preparation_ = _preparation(self.best_.percentile)
        self.svc_ = _fit_svc(self.best_, self.preparation_.fit_transform(X, y), y)
        return self

    def _inner_decisions(
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
        decisions = np.zeros((len(candidates), len(y), len(self.classes_)))
        held_out = np.zeros(len(y), dtype=bool)
        self.n_inner_fits_ = 0
        for train, test in split_runs(y, groups, n_folds, rng, gap):
            if len(np.unique(y[train])) < 2:
                continue  # the gap beside a short block has left out all windows of a class
            held_out[test] = True
            for percentile in dict.fromkeys(candidate.percentile for candidate in candidates):
                preparation = _preparation(percentile)
                prepared = preparation.fit_transform(X[train], y[train])
                prepared_test = preparation.transform(X[test])
                for i, candidate in enumerate(candidates):
                    if candidate.percentile == percentile:
                        svc = _fit_svc(candidate, prepared, y[train])
                        decisions[i, test] = _decision(svc, prepared_test, self.classes_)
                        self.n_inner_fits_ += 1
        if not held_out.any():
            raise DataError("the windows are too few to hold some of them out; add runs")
        return held_out, decisions

    def decision_function(self, X: Array) -> Array:
        """Return one decision value a class (n, k), of which the largest wins.

        As in all of scikit-learn, two classes have one value (n,), positive for the second.
        """
        decisions = self._decisions(X)
        return decisions[:, 1] if len(self.classes_) == 2 else decisions

    def _decisions(self, X: Array) -> Array:
        check_is_fitted(self)
        X = validate_data(self, X, reset=False, ensure_all_finite="allow-nan")
        return _decision(self.svc_, self.preparation_.transform(X), self.classes_)

    def predict_proba(self, X: Array) -> Array:
        """Return calibrated probabilities (n, k) in the order of ``classes_``."""
        return np.asarray(softmax(self._decisions(X) / self.temperature_, axis=1))

    def predict(self, X: Array) -> Array:
        """Return the class of the highest probability (n,)."""
        best = self._decisions(X).argmax(axis=1)
        return np.asarray(self.classes_[best])

    def numbers(self) -> SvmNumbers:
        """Return all that the fitted classifier computes with, for :mod:`terrain.classify.svm_numbers`."""
        check_is_fitted(self)
        steps, svc = self.preparation_.named_steps, self.svc_
        varying = np.flatnonzero(steps["constant"].get_support())
        selected = steps["select"].get_support()
        columns = varying[selected]
        sign = -1.0 if len(svc.classes_) == 2 else 1.0  # scikit-learn turns the two-class decision around
        bounds = np.concatenate(([0], np.cumsum(svc.n_support_)))
        pairs = [(a, b) for a in range(len(svc.classes_)) for b in range(a + 1, len(svc.classes_))]
        weights = np.zeros((len(svc.support_vectors_), len(pairs)))
        for pair, (a, b) in enumerate(pairs):
            of_a, of_b = slice(bounds[a], bounds[a + 1]), slice(bounds[b], bounds[b + 1])
            weights[of_a, pair] = sign * svc.dual_coef_[b - 1, of_a]
            weights[of_b, pair] = sign * svc.dual_coef_[a, of_b]
        return SvmNumbers(
            columns.astype(np.int64),
            np.nan_to_num(steps["impute"].statistics_[columns]),  # of a feature without any value
            steps["scale"].mean_[selected],
            steps["scale"].scale_[selected],
            svc.support_vectors_,
            weights,
            sign * svc.intercept_,
            np.array([CLIP_STD, float(svc.gamma), self.temperature_, self.n_features_in_]),
        )

    def __sklearn_tags__(self) -> Any:
        """Declare that NaN is accepted."""
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = True
        return tags


def fit_temperature(decisions: Array, class_index: Array) -> float:
    """Return the temperature under which held-out decisions are most likely.

    Parameters
    ----------
    decisions : (n, k) decision values
    class_index : (n,) true column of each row

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> logits = rng.normal(size=(5000, 3))
    >>> chances = softmax(logits, axis=1).cumsum(axis=1)
    >>> drawn = (rng.random((5000, 1)) > chances).sum(axis=1)
    >>> abs(fit_temperature(4.0 * logits, drawn) - 4.0) < 0.2
    True
    """

    def loss(log_temperature: float) -> float:
        likelihood = log_softmax(decisions / np.exp(log_temperature), axis=1)
        return float(-likelihood[np.arange(len(class_index)), class_index].mean())

    found = minimize_scalar(loss, bounds=LOG_TEMPERATURE_BOUNDS, method="bounded")
    return float(np.exp(found.x))


def f_score(X: Array, y: Array) -> tuple[Array, Array]:
    """Return the F test of each feature; a feature that is constant within every class divides by zero."""
    with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        scores: tuple[Array, Array] = f_classif(X, y)
    return scores


def _preparation(percentile: float) -> Pipeline:
    return Pipeline(
        [
            ("impute", SimpleImputer(strategy="median", keep_empty_features=True)),
            ("constant", VarianceThreshold()),
            ("scale", StandardScaler()),
            ("clip", FunctionTransformer(np.clip, kw_args={"a_min": -CLIP_STD, "a_max": CLIP_STD})),
            ("select", SelectPercentile(f_score, percentile=percentile)),
        ]
    )


def _fit_svc(candidate: Candidate, prepared: Array, y: Array) -> SVC:
    return SVC(C=candidate.C, gamma=candidate.gamma / prepared.shape[1], cache_size=500).fit(prepared, y)


def _decision(svc: SVC, prepared: Array, classes: Array) -> Array:
    values = svc.decision_function(prepared)
    if values.ndim == 1:
        values = np.stack([-values, values], axis=1)
    decision = np.full((len(prepared), len(classes)), values.min(initial=0.0) - 1.0)
    decision[:, np.searchsorted(classes, svc.classes_)] = values
    return decision
