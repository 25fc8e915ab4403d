"""Folds that keep sessions and runs whole: one implementation for the outer evaluation and the inner choices.

What another day does is shown by a session that was held out whole: where runs name sessions, and a class has several,
the session is the unit; without, the run is.  ``groups`` is (n,) the run of each row, or (n, 2) its session and run.

Units are dealt at random, class by class, each to the fold that so far holds the fewest units of that class
and, among those, the fewest windows.  (scikit-learn's ``StratifiedGroupKFold`` sorts groups by size before
dealing; with runs of unequal length nearly every seed gives the same folds, and a spread over seeds is
meaningless.)  A class that has a single unit cannot be both held out whole and trained on: its session is divided
into parts of whole runs that follow each other; its only run into contiguous blocks, and training windows beside a test
block are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.records import Array, RunLog

ENOUGH_RUNS = 6  #: A terrain with so many runs gives one of them away: five are left, one for each fold.
FEWEST_RUNS = 3  #: Where no terrain has enough, the one with the most runs gives one away if two are left.
N_FOLDS = 5

TOO_FEW = "the windows are too few to hold some of them out; add runs"


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


def run_of(groups: Array) -> Array:
    """Return the run (n,) of each row, as text."""
    return np.asarray(groups, dtype=str).reshape(len(groups), -1)[:, -1]


def single_run_classes(y: Array, groups: Array) -> list[Any]:
    """Return the classes that have one run only, or, of a column of sessions, one session."""
    run = run_of(groups)
    return [c for c in np.unique(y).tolist() if len(np.unique(run[y == c])) == 1]


def has_sessions(y: Array, groups: Array) -> bool:
    """Return whether a class has several sessions, one of them named, of which one can be held out whole."""
    session, run = np.asarray(groups, dtype=str).reshape(len(groups), -1)[:, [0, -1]].T
    several = ~np.isin(y, single_run_classes(y, session))
    return bool((session != run)[several].any())


def units_of(y: Array, groups: Array) -> Array:
    """Return the session (n,) of each row, as text, where a class has several; otherwise the run."""
    return np.asarray(groups, dtype=str).reshape(len(groups), -1)[:, 0 if has_sessions(y, groups) else -1]


def divided_units(y: Array, groups: Array, n_parts: int) -> Array:
    """Return the unit (n,) of each row, those of classes that have one only in so many parts that follow each other.

    Parts are of whole runs, whatever else a run holds; only the single run of a class is cut.

    Examples
    --------
    >>> groups = np.array([["monday", "a"], ["monday", "b"], ["tuesday", "c"], ["tuesday", "d"]])
    >>> divided_units(np.array(["ice"] * 4), groups, 2).tolist()
    ['monday', 'monday', 'tuesday', 'tuesday']
    >>> divided_units(np.array(["ice", "mud", "ice", "ice"]), groups, 2).tolist()
    ['monday', 'b block 1', 'tuesday', 'tuesday']
    """
    unit, run = units_of(y, groups), run_of(groups)
    divided = unit.astype(object)
    alone = single_run_classes(y, run)
    for terrain in single_run_classes(y, unit):
        if terrain not in alone:
            runs = np.unique(run[y == terrain])
            rows = np.flatnonzero(np.isin(run, runs))
            part = np.searchsorted(runs, run[rows]) * min(n_parts, len(runs)) // len(runs) + 1
            divided[rows] = [f"{unit[rows[0]]} part {number}" for number in part]
    for terrain in alone:
        rows = np.flatnonzero(y == terrain)
        for number, block in enumerate(np.array_split(rows, n_parts)):
            divided[block] = f"{run[rows[0]]} block {number + 1}"
    return divided.astype(str)


def fold_numbers(y: Array, groups: Array, n_folds: int, rng: np.random.Generator) -> Array:
    """Return the fold (n,) that tests each window: whole units (n,) are dealt at random, evenly within each class.

    A unit with several classes counts for its most frequent one.  ``DataError`` where there is one class only,
    or there are fewer units than folds.
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
    """Yield training and test rows of folds that keep sessions or runs whole; errors as :func:`fold_numbers`.

    ``gap`` training windows are left out on each side of a test block, where a single run had to be cut; windows
    of a run are in order of time.

    Examples
    --------
    >>> y = np.array(["ice"] * 4 + ["sand"] * 6)
    >>> runs = np.array(["a", "a", "b", "b"] + ["c"] * 6)
    >>> for train, test in split_runs(y, runs, 2, np.random.default_rng(0)):
    ...     print(train, test)
    [2 3 8 9] [0 1 4 5 6]
    [0 1 4 5] [2 3 7 8 9]
    """
    number = fold_numbers(y, divided_units(y, groups, n_folds), n_folds, rng)
    return numbered_folds(number, [np.flatnonzero(y == name) for name in single_run_classes(y, groups)], gap)


def numbered_folds(
    number: Array, cut_runs: Sequence[Array] = (), gap: int = 0
) -> Iterator[tuple[Array, Array]]:
    """Yield training and test rows of each fold, from the fold (n,) that tests each window, -1 for none.

    Of each run that lies in several folds, ``cut_runs`` has the rows in order of time; ``gap`` of its windows on
    each side of a test window do not train.
    """
    for each in range(int(number.max()) + 1):
        testing = number == each
        training = ~testing
        for rows in cut_runs:
            near = np.flatnonzero(testing[rows])[:, None] + np.arange(-gap, gap + 1)
            training[rows[near[(near >= 0) & (near < len(rows))]]] = False
        yield np.flatnonzero(training), np.flatnonzero(testing)


def inner_splits(
    y: Array, groups: Array, n_folds: int, seed: int, gap: int = 1, *, lacking: bool = False
) -> Iterator[tuple[Array, Array]]:
    """Yield training and test rows of inner folds of whole sessions or runs, fewer folds where there are fewer.

    A gap may leave out all rows of a class: such a fold is skipped, with ``lacking`` only where one class is left.
    ``DataError`` where the rows are too few to hold some of them out.
    """
    classes, n_rows = np.unique(y, return_counts=True)
    n_groups = len(np.unique(divided_units(y, groups, n_folds)))
    n_folds = min(n_folds, n_groups, *n_rows)
    if n_folds < 2:
        raise DataError(TOO_FEW)
    for train, test in split_runs(y, groups, n_folds, np.random.default_rng(seed), gap):
        present, counts = np.unique(y[train], return_counts=True)
        if len(present) > 1 if lacking else len(present) == len(classes) and counts.min() > 1:
            yield train, test


def hold_out_runs(runs: Sequence[RunLog]) -> tuple[list[RunLog], list[RunLog]]:
    """Return runs to evaluate and train on, and the last one of each terrain that has enough runs, held out.

    The choice depends on names and numbers alone.  Nothing is held out where too little would be left, and no
    run with several terrains is.
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
