"""Conformal sets of classes: as many classes as are needed to hold the true one at a given level.

The score of a window is ``s = 1 - p_y``, with the probability of its true class by a classifier that its run
did not train; a class belongs to the set of a new window if ``1 - p_c <= q`` (Sadinle, Lei, Wasserman 2019;
Angelopoulos and Bates 2021, 1.1).  Windows of a run resemble each other, so that windows are not
exchangeable, but runs are, given that they were recorded alike.  With R runs, q is the smallest score with

    sum_r F_r(q) / (R + 1) >= level,

F_r the empirical distribution of run r (Dunn, Wasserman, Ramdas 2022, Distribution-free prediction sets for
two-layer hierarchical models, section 3.1, pooled distributions): all windows of a run weigh together as much
as those of another.  Coverage holds on average over windows of a new run, not in each run.  The most probable
class is always in the set, which can only raise the coverage.  With scores of inner folds in place of a
single calibration part (cross-conformal, Vovk 2015) the level is not guaranteed, and is therefore measured.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from terrain.errors import DataError
from terrain.records import Array

LEVEL = 0.9


def held_out_scores(classifier: Any, terrain: Array) -> Array:
    """Return ``1 - p`` of the true class (n,) of each row when its run was held out; NaN where it was not.

    Parameters
    ----------
    classifier : fitted on the rows, with its out-of-fold probabilities (n, k) as ``inner_probability_``
    terrain : (n,) true class of each row
    """
    truth = np.searchsorted(classifier.classes_, terrain)
    return np.asarray(1.0 - classifier.inner_probability_[np.arange(len(terrain)), truth])


def conformal_threshold(scores: Array, runs: Array, level: float = LEVEL) -> float:
    """Return q; 1, with which every class is in every set, where the runs are too few for the level.

    Parameters
    ----------
    scores : (n,) ``1 - p`` of the true class of held-out windows; NaN is left out
    runs : (n,) run of each window
    level : from 0 to 1

    Raises
    ------
    DataError
        if no score is finite.

    Examples
    --------
    >>> scores, runs = np.arange(100) / 100, np.arange(100).astype(str)
    >>> conformal_threshold(scores, runs, 0.9), conformal_threshold(scores[:5], runs[:5], 0.9)
    (0.9, 1.0)
    """
    kept = np.isfinite(scores)
    if not kept.any():
        raise DataError("there is no held-out window to calibrate the sets of classes with")
    scores, runs = scores[kept], runs[kept]
    _, run_of, n_windows = np.unique(runs.astype(str), return_inverse=True, return_counts=True)
    order = np.argsort(scores, kind="stable")
    weight = 1.0 / (n_windows[run_of] * (len(n_windows) + 1.0))
    reached = np.cumsum(weight[order]) >= level - 1e-12
    return float(scores[order][reached.argmax()]) if reached.any() else 1.0


def conformal_sets(probability: Array, threshold: float) -> Array:
    """Return which classes are in the set of each window (n, k), from probabilities (n, k).

    Examples
    --------
    >>> conformal_sets(np.array([[0.6, 0.3, 0.1], [0.4, 0.3, 0.3]]), 0.7)
    array([[ True,  True, False],
           [ True,  True,  True]])
    """
    found: Array = 1.0 - probability <= threshold + 1e-12
    found[np.arange(len(found)), probability.argmax(axis=1)] = True
    return found
