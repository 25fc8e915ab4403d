"""Folds that keep runs whole: one implementation for the outer evaluation and the inner choices.

Runs are dealt at random, class by class, each to the fold that so far holds the fewest runs of that class
and, among those, the fewest windows.  (scikit-learn's ``StratifiedGroupKFold`` sorts groups by size before
dealing; with runs of unequal length nearly every seed gives the same folds, and a spread over seeds is
meaningless.)  A class that has a single run cannot be both held out whole and trained on: its run is
cut into contiguous blocks, and training windows beside a test block are left out.

Inner folds of a training part give out-of-fold probabilities, which a threshold or a calibration may be fitted to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from sklearn.base import BaseEstimator, clone

from terrain.errors import DataError
from terrain.records import Array, RunLog

ENOUGH_RUNS = 6
"""A terrain with so many runs gives one of them away: five are left, one for each fold."""

FEWEST_RUNS = 3
"""Where no terrain has enough, the one with the most runs gives one away if two are left."""

N_FOLDS = 5


class Fold(NamedTuple):
    """Rows that train and rows that test; ``repeat`` numbers the fold assignment."""

    repeat: int
    number: int
    train: Array
    test: Array


def two_classes(y: Array) -> Array:
    """Return the classes (k,) of rows (n,); ``DataError`` where there is one only."""
    classes = np.unique(y)
    if len(classes) < 2:
        raise DataError(f"all windows are {str(classes[0])!r}: a classifier needs at least two classes")
    return classes


def single_run_classes(y: Array, groups: Array) -> list[Any]:
    """Return the classes that have one run only.

    Examples
    --------
    >>> single_run_classes(np.array(["ice", "ice", "sand"]), np.array(["a", "b", "c"]))
    ['sand']
    """
    return [c for c in np.unique(y).tolist() if len(np.unique(groups[y == c])) == 1]


def block_groups(y: Array, groups: Array, n_blocks: int) -> Array:
    """Return groups in which the run of each single-run class is cut into contiguous blocks by row order."""
    cut = np.asarray(groups, dtype=object).copy()
    for terrain in single_run_classes(y, groups):
        rows = np.flatnonzero(y == terrain)
        for number, block in enumerate(np.array_split(rows, n_blocks)):
            cut[block] = f"{groups[rows[0]]} block {number + 1}"
    return cut


def fold_numbers(y: Array, groups: Array, n_folds: int, rng: np.random.Generator) -> Array:
    """Deal whole groups into folds at random, evenly within each class.

    Parameters
    ----------
    y : (n,) class of each window
    groups : (n,) group of each window; a group with several classes counts for its most frequent one
    n_folds : at least 2
    rng : source of the deal

    Returns
    -------
    (n,) int
        the fold that tests each window.

    Raises
    ------
    DataError
        if there is one class only, or fewer groups than folds.
    """
    two_classes(y)
    names, group_of = np.unique(np.asarray(groups, dtype=str), return_inverse=True)
    if len(names) < n_folds:
        raise DataError(f"{len(names)} runs are fewer than {n_folds} folds")
    classes, class_of = np.unique(y, return_inverse=True)
    table = np.zeros((len(names), len(classes)), dtype=int)
    np.add.at(table, (group_of, class_of), 1)
    sizes, main_class = table.sum(axis=1), table.argmax(axis=1)
    fold_of_group = np.empty(len(names), dtype=int)
    n_windows = np.zeros(n_folds, dtype=int)
    for c in rng.permutation(len(classes)):
        n_runs = np.zeros(n_folds, dtype=int)
        for group in rng.permutation(np.flatnonzero(main_class == c)):
            fold = np.lexsort((n_windows, n_runs))[0]
            fold_of_group[group] = fold
            n_runs[fold] += 1
            n_windows[fold] += sizes[group]
    return fold_of_group[group_of]


def split_runs(
    y: Array, groups: Array, n_folds: int, rng: np.random.Generator, gap: int = 1
) -> Iterator[tuple[Array, Array]]:
    """Yield training and test rows of folds that keep runs whole.

    Parameters
    ----------
    y, groups : (n,) class and run of each window; windows of a run are in order of time
    n_folds : at least 2
    rng : source of the deal
    gap : training windows left out on each side of a test block, where a single run had to be cut

    Examples
    --------
    >>> y = np.array(["ice"] * 4 + ["sand"] * 6)
    >>> runs = np.array(["a", "a", "b", "b"] + ["c"] * 6)
    >>> for train, test in split_runs(y, runs, 2, np.random.default_rng(0)):
    ...     print(train, test)
    [2 3 8 9] [0 1 4 5 6]
    [0 1 4 5] [2 3 7 8 9]
    """
    number = fold_numbers(y, block_groups(y, groups, n_folds), n_folds, rng)
    return numbered_folds(number, [np.flatnonzero(y == name) for name in single_run_classes(y, groups)], gap)


def numbered_folds(
    number: Array, cut_runs: Sequence[Array] = (), gap: int = 0
) -> Iterator[tuple[Array, Array]]:
    """Yield training and test rows of each fold.

    Parameters
    ----------
    number : (n,) the fold that tests each window; -1 of one that no fold tests
    cut_runs : rows, in order of time, of each run that lies in several folds
    gap : windows of such a run beside a test window that do not train

    Examples
    --------
    >>> number = np.array([0, 0, 1, 1, 1, 2])
    >>> [train.tolist() for train, _ in numbered_folds(number, [np.arange(6)], gap=1)]
    [[3, 4, 5], [0], [0, 1, 2, 3]]
    """
    for each in range(int(number.max()) + 1):
        testing = number == each
        training = ~testing
        for rows in cut_runs:
            near = np.flatnonzero(testing[rows])[:, None] + np.arange(-gap, gap + 1)
            training[rows[near[(near >= 0) & (near < len(rows))]]] = False
        yield np.flatnonzero(training), np.flatnonzero(testing)


def hold_out_runs(runs: Sequence[RunLog]) -> tuple[list[RunLog], list[RunLog]]:
    """Return runs to evaluate and train on, and the last one of each terrain that has enough runs, held out.

    The choice depends on names and numbers alone.  Nothing is held out where too little would be left, and no
    run with several terrains is.

    Examples
    --------
    >>> from terrain.records import RunLog
    >>> def run(terrain, number):
    ...     return RunLog(f"{terrain}_{number}", "husky", {}, ((0.0, 9.0, terrain),))
    >>> runs = [run("ice", i) for i in range(6)] + [run("mud", i) for i in range(2)]
    >>> [each.run_id for each in hold_out_runs(runs)[1]]
    ['ice_5']
    """
    by_terrain: dict[str, list[RunLog]] = {}
    for run in sorted(runs, key=lambda each: each.run_id):
        if len(run.terrains) == 1:
            by_terrain.setdefault(run.terrains[0], []).append(run)
    chosen = {of_one[-1].run_id for of_one in by_terrain.values() if len(of_one) >= ENOUGH_RUNS}
    if not chosen and by_terrain:
        most = max(by_terrain.values(), key=len)
        if len(most) >= FEWEST_RUNS and len(runs) > N_FOLDS:
            chosen = {most[-1].run_id}
    return [run for run in runs if run.run_id not in chosen], [run for run in runs if run.run_id in chosen]


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
