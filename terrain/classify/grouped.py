"""What classifiers share whose ``fit`` takes the run of each row: rows that are checked, and the best class."""

from __future__ import annotations

from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from terrain.classify.folds import two_classes
from terrain.records import Array


class GroupedClassifier(ClassifierMixin, BaseEstimator):
    """A classifier that keeps runs whole; missing values are NaN.

    Subclasses have ``fit(X, y, groups)``, where X is (n, f), y (n,) classes and ``groups`` (n,) the run of each row,
    each row its own when missing, and ``predict_proba``; fitted ones have ``classes_`` (k,) and, for thresholds and
    calibration, ``inner_probability_`` (n, k) of the training rows when their run was held out, NaN where it never
    was.
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
