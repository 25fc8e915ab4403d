"""Out-of-fold probabilities inside a training part: what a threshold or a calibration may be fitted to."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, clone

from terrain.classify.folds import block_groups, split_runs
from terrain.errors import DataError
from terrain.records import Array


def inner_splits(
    y: Array, groups: Array, n_folds: int, seed: int, gap: int = 1
) -> Iterator[tuple[Array, Array]]:
    """Yield training and test rows of inner folds of whole runs.

    Parameters
    ----------
    y, groups : (n,) class and run of each row
    n_folds : at least 2; fewer where there are fewer runs
    seed : deals runs into folds
    gap : rows left out beside a block, where the only run of a class is cut

    Raises
    ------
    DataError
        if the rows are too few to hold some of them out.
    """
    classes, n_rows = np.unique(y, return_counts=True)
    n_groups = len(np.unique(block_groups(y, groups, n_folds).astype(str)))
    n_folds = min(n_folds, n_groups, *n_rows)
    if n_folds < 2:
        raise DataError("the windows are too few to hold some of them out; add runs")
    for train, test in split_runs(y, groups, n_folds, np.random.default_rng(seed), gap):
        present, counts = np.unique(y[train], return_counts=True)
        if len(present) == len(classes) and counts.min() > 1:  # a gap may leave out all rows of a class
            yield train, test


def inner_probabilities(
    estimator: BaseEstimator, X: Array, y: Array, groups: Array, n_folds: int, seed: int, gap: int = 1
) -> Array:
    """Return out-of-fold probabilities (n, k) in the order of the sorted classes; NaN where none was found.

    Parameters
    ----------
    estimator : with ``fit(X, y, groups)`` and ``predict_proba``; clones of it are fitted.  Of a fitted one
        that chose hyper-parameters (``best_`` of ``candidates``) the clones take these
    X : (n, f) features
    y, groups, n_folds, seed, gap : as :func:`inner_splits`, with its errors
    """
    classes = np.unique(y)
    probability = np.full((len(y), len(classes)), np.nan)
    for train, test in inner_splits(y, groups, n_folds, seed, gap):
        fitted = _as_chosen(estimator).fit(X[train], y[train], groups=groups[train])
        probability[test] = fitted.predict_proba(X[test])
    if np.isnan(probability).all():
        raise DataError("the windows are too few to hold some of them out; add runs")
    return probability


def _as_chosen(estimator: Any) -> Any:
    """Return an unfitted clone with the hyper-parameters that a fitted estimator chose."""
    best, fresh = getattr(estimator, "best_", None), clone(estimator)
    return (
        fresh.set_params(candidates=(best,)) if best is not None and hasattr(fresh, "candidates") else fresh
    )
