"""A user's own classifier behind imputation and scaling, with probabilities whatever it gives."""

from __future__ import annotations

from typing import Any

import numpy as np
from sklearn.base import clone
from sklearn.linear_model import LogisticRegression

from terrain.classify.folds import block_groups, split_runs
from terrain.classify.grouped import GroupedClassifier
from terrain.classify.svm import Preparation, fit_preparation
from terrain.records import Array

N_INNER_FOLDS = 3


class OwnClassifier(GroupedClassifier):
    """A user's own classifier behind imputation and scaling, with probabilities whatever it gives.

    Held-out outputs of inner folds of whole runs give the thresholds of sets of classes, and, where the
    classifier has margins only, a logistic regression of the classes on these margins (Platt, 1999, for more
    than two classes).  A classifier that has neither gives its class the probability 1.

    Parameters
    ----------
    estimator : with ``fit`` and ``predict``; a clone of it is fitted
    gap : windows left out beside an inner test block, where the only run of a class is cut
    seed : deals runs into inner folds

    Attributes
    ----------
    classes_ : (k,) class names
    inner_probability_ : (n, k) of training rows when their run was held out; NaN where it never was

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

    def __init__(self, estimator: Any, gap: int = 1, seed: int = 0) -> None:
        self.estimator = estimator
        self.gap = gap
        self.seed = seed

    @property
    def outputs(self) -> str:
        """The method that probabilities come from."""
        names = ("predict_proba", "decision_function", "predict")
        return next(name for name in names if hasattr(self.estimator, name))

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> OwnClassifier:
        """Fit clones on inner folds and on all rows.

        Parameters
        ----------
        X : (n, f) features, NaN where not defined
        y : (n,) classes
        groups : (n,) run of each row; every row is its own run when missing
        """
        X, y = np.asarray(X, dtype=float), np.asarray(y)
        groups = np.arange(len(y)) if groups is None else np.asarray(groups)
        self.classes_, counts = np.unique(y, return_counts=True)
        n_groups = len(np.unique(block_groups(y, groups, N_INNER_FOLDS).astype(str)))
        n_folds = min(N_INNER_FOLDS, n_groups, counts.min())
        self.inner_probability_ = np.full((len(y), len(self.classes_)), np.nan)
        held_out: list[tuple[Array, Array]] = []
        if n_folds >= 2:
            rng = np.random.default_rng(self.seed)
            for train, test in split_runs(y, groups, n_folds, rng, self.gap):
                if np.array_equal(np.unique(y[train]), self.classes_) and len(test):
                    held_out.append((test, self._outputs(self._fitted(X[train], y[train]), X[test])))
        self.calibration_ = None
        if held_out and self.outputs == "decision_function":
            margins = np.concatenate([each for _, each in held_out])
            self.calibration_ = LogisticRegression().fit(
                margins, y[np.concatenate([rows for rows, _ in held_out])]
            )
        for rows, each in held_out:
            self.inner_probability_[rows] = self._probability(each)
        self.fitted_ = self._fitted(X, y)
        return self

    def predict_proba(self, X: Array) -> Array:
        """Return probabilities (n, k) in the order of ``classes_``."""
        return self._probability(self._outputs(self.fitted_, np.asarray(X, dtype=float)))

    def _fitted(self, X: Array, y: Array) -> tuple[Preparation, Any]:
        preparation = fit_preparation(X, y, 100.0)
        return preparation, clone(self.estimator).fit(preparation.of(X), y)

    def _outputs(self, fitted: tuple[Preparation, Any], X: Array) -> Array:
        preparation, classifier = fitted
        found = getattr(classifier, self.outputs)(preparation.of(X))
        if self.outputs == "predict":
            return np.asarray(found[:, None] == self.classes_, dtype=float)
        values = np.asarray(found, dtype=float)
        return values[:, None] if values.ndim == 1 else values

    def _probability(self, outputs: Array) -> Array:
        if self.outputs != "decision_function":
            return outputs
        if self.calibration_ is not None:
            return np.asarray(self.calibration_.predict_proba(outputs))
        best = outputs.argmax(axis=1) if outputs.shape[1] > 1 else (outputs[:, 0] > 0).astype(int)
        return np.asarray(best[:, None] == np.arange(len(self.classes_)), dtype=float)
