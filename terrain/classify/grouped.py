"""Classifiers whose ``fit`` takes the run of each row: what they share, and one around a user's own."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from sklearn.base import BaseEstimator, ClassifierMixin, clone
from sklearn.feature_selection import SelectPercentile, f_classif
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from terrain.classify.folds import inner_splits, two_classes
from terrain.errors import DataError
from terrain.records import Array

#: Scaled features are clipped here, so that one faulty sample cannot move a window far from all others.
CLIP_STD = 5.0
N_INNER_FOLDS = 3


class GroupedClassifier(ClassifierMixin, BaseEstimator):
    """A classifier that keeps runs whole; missing values are NaN.

    Subclasses have ``fit(X, y, groups)``, where X is (n, f), y (n,) classes and ``groups`` the run (n,), or session and
    run (n, 2), of each row, each row its own when missing, and ``predict_proba``; fitted ones have ``classes_`` (k,)
    and, for thresholds and calibration, ``inner_probability_`` (n, k) of the training rows when their session or run
    was held out, NaN where it never was.  All raise ``DataError`` where there is one class only.
    """

    def _training_rows(self, X: Array, y: Array, groups: Array | None) -> tuple[Array, Array, Array]:
        """Return rows, classes and runs, and set ``classes_``."""
        X, y = validate_data(self, X, y, ensure_all_finite="allow-nan")
        check_classification_targets(y)
        self.classes_ = two_classes(y)
        return X, y, np.arange(len(y)) if groups is None else np.asarray(groups)

    def _rows(self, X: Array) -> Array:
        check_is_fitted(self)
        return np.asarray(validate_data(self, X, reset=False, ensure_all_finite="allow-nan"))

    def predict(self, X: Array) -> Array:
        """Return the class of the highest probability (n,)."""
        best = self.predict_proba(X).argmax(axis=1)
        return np.asarray(self.classes_[best])

    def __sklearn_tags__(self) -> Any:
        """Declare that NaN is accepted."""
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = True
        return tags


class Preparation(NamedTuple):
    """What features become first: ``columns`` (m,) of them, missing ones filled, then scaled and clipped.

    ``fill``, ``mean`` and ``scale`` (m,) are median, mean and standard deviation of each in training.
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


def f_score(X: Array, y: Array) -> tuple[Array, Array]:
    """Return the F test of each feature; a feature that is constant within every class divides by zero."""
    with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        scores: tuple[Array, Array] = f_classif(X, y)
    return scores


def fit_preparation(X: Array, y: Array, percentile: float) -> Preparation:
    """Return the preparation (of rows (n, f)) by a percentage of the features that vary: those an F test keeps."""
    fill, filled = filled_by_median(X, np.isfinite(X))
    columns = np.flatnonzero(np.minimum(filled.var(axis=0), np.ptp(filled, axis=0)) > 0.0)
    scaler = StandardScaler().fit(filled[:, columns])
    every = Preparation(columns, fill[columns], scaler.mean_, scaler.scale_)
    if percentile >= 100.0:
        return every
    kept = SelectPercentile(f_score, percentile=percentile).fit(every.of(X), y).get_support()
    return Preparation(*(each[kept] for each in every))


def filled_by_median(X: Array, known: Array) -> tuple[Array, Array]:
    """Return the median (f,) of the known values of each feature, 0 without any, and rows (n, f) filled with it."""
    fill = np.zeros(X.shape[1])
    whole, some = known.all(axis=0), known.any(axis=0)
    fill[whole] = np.median(X[:, whole], axis=0)  # much faster than what has to leave values out
    for column in np.flatnonzero(some & ~whole):
        fill[column] = np.median(X[known[:, column], column])
    return fill, np.where(known, X, fill)


@dataclass(eq=False, repr=False)
class OwnClassifier(GroupedClassifier):
    """A user's own classifier behind imputation and scaling, with probabilities whatever it gives.

    Held-out outputs of inner folds of whole runs give the thresholds of sets of classes, and, where the
    classifier has margins only, a logistic regression of the classes on these margins (Platt, 1999, for more
    than two classes).  A classifier that has neither gives its class the probability 1.

    Examples
    --------
    >>> from sklearn.linear_model import RidgeClassifier
    >>> rng = np.random.default_rng(0)
    >>> y = np.repeat(["ice", "mud"], 40)
    >>> X, runs = rng.normal(size=(80, 2)) + (y == "mud")[:, None], np.repeat(np.arange(8), 10)
    >>> own = OwnClassifier(RidgeClassifier()).fit(X, y, groups=runs)
    >>> own.outputs, own.predict_proba(X).shape
    ('decision_function', (80, 2))
    """

    estimator: Any  #: with ``fit`` and ``predict``; a clone of it is fitted
    gap: int = 1  #: windows left out beside an inner test block, where the only run of a class is cut
    seed: int = 0  #: deals runs into inner folds

    @property
    def outputs(self) -> str:
        """The method that probabilities come from."""
        names = ("predict_proba", "decision_function", "predict")
        return next(name for name in names if hasattr(self.estimator, name))

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> OwnClassifier:
        """Fit clones on inner folds and on all rows."""
        X, y, groups = self._training_rows(X, y, groups)
        held_out = []
        try:
            for train, test in inner_splits(y, groups, N_INNER_FOLDS, self.seed, self.gap):
                if len(test):
                    held_out.append((test, self._outputs(self._fitted(X[train], y[train]), X[test])))
        except DataError:
            pass  # rows too few to hold some of them out
        self.calibration_ = None
        if held_out and self.outputs == "decision_function":
            margins = np.concatenate([each for _, each in held_out])
            truth = y[np.concatenate([rows for rows, _ in held_out])]
            self.margin_std_ = float(margins.std()) or 1.0  # whatever the unit of margins is
            if np.array_equal(
                np.unique(truth), self.classes_
            ):  # else it would give the others no probability
                self.calibration_ = LogisticRegression().fit(margins / self.margin_std_, truth)
        self.inner_probability_ = np.full((len(y), len(self.classes_)), np.nan)
        for rows, each in held_out:
            self.inner_probability_[rows] = self._probability(each)
        self.fitted_ = self._fitted(X, y)
        return self

    def predict_proba(self, X: Array) -> Array:
        """Return probabilities (n, k) in the order of ``classes_``."""
        return self._probability(self._outputs(self.fitted_, self._rows(X)))

    def _fitted(self, X: Array, y: Array) -> tuple[Preparation, Any]:
        preparation = fit_preparation(X, y, 100.0)
        return preparation, clone(self.estimator).fit(preparation.of(X), y)

    def _outputs(self, fitted: tuple[Preparation, Any], X: Array) -> Array:
        preparation, classifier = fitted
        found = getattr(classifier, self.outputs)(preparation.of(X))
        if self.outputs == "predict":
            return np.asarray(found[:, None] == self.classes_, dtype=float)
        values = np.asarray(found, dtype=float)
        order = np.argsort(getattr(classifier, "classes_", self.classes_))  # of a user's own, any
        if values.ndim == 1:
            return values[:, None] if order[0] == 0 else -values[:, None]
        return values[:, order] if values.shape[1] == len(order) else values

    def _probability(self, outputs: Array) -> Array:
        if self.outputs != "decision_function":
            return outputs
        if self.calibration_ is not None:
            return np.asarray(self.calibration_.predict_proba(outputs / self.margin_std_))
        best = outputs.argmax(axis=1) if outputs.shape[1] > 1 else (outputs[:, 0] > 0).astype(int)
        return np.asarray(best[:, None] == np.arange(len(self.classes_)), dtype=float)
