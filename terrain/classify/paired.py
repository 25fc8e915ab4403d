"""Two classifiers on the same runs: differences of their figures, paired by run.

Both are judged on the same runs, and a run that is hard for one is mostly hard for the other.  A bootstrap
that draws whole runs, within their classes, and takes the figures of both from the same draw leaves this
common part out of the interval of the difference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple, Self

import numpy as np

from terrain.bootstrap import percentile_interval, stratified_counts
from terrain.classify.held_out import HeldOut
from terrain.classify.metrics import Interval, confidence_auc
from terrain.classify.support import SupportLevel
from terrain.errors import DataError
from terrain.records import Array

N_DRAWS = 2000

MIN_RUNS = 3
"""With fewer runs a bootstrap over runs gives no interval: that of one run would have no width."""


class Verdict(StrEnum):
    """Whether the interval of a difference leaves zero out."""

    BETTER = "better"
    WORSE = "worse"
    NOT_DISTINGUISHED = "not distinguished"


class Outcome(NamedTuple):
    """What a classifier made of held-out windows.

    Parameters
    ----------
    run_id, terrain : (n,) run and true class of each window
    correct, confidence : (repeats, n) whether the predicted class is right, and its probability
    """

    run_id: Array
    terrain: Array
    correct: Array
    confidence: Array

    @classmethod
    def of(cls, held_out: HeldOut, run_id: Array) -> Self:
        """Return what was made of the windows that were held out."""
        rows = np.flatnonzero(held_out.tested)
        confidence = held_out.probability.max(axis=2)
        return cls(run_id[rows], held_out.truth[rows], held_out.correct[:, rows], confidence[:, rows])

    def at(self, rows: Array) -> Outcome:
        """Return some of the windows."""
        run_id, terrain, correct, confidence = self
        return Outcome(run_id[rows], terrain[rows], correct[:, rows], confidence[:, rows])


class Difference(NamedTuple):
    """A figure of two classifiers; ``difference`` is b minus a, with its ``interval`` of 95 % over runs.

    The interval is NaN where there are fewer runs than :data:`MIN_RUNS`.
    """

    a: float
    b: float
    difference: float
    interval: Interval
    verdict: Verdict
    n_runs: int


class RunDifference(NamedTuple):
    """Accuracies of two classifiers on the windows of one run."""

    run_id: str
    terrain: str
    a: float
    b: float


class Comparison(NamedTuple):
    """Differences between two classifiers, b minus a.

    Those of each class are of accuracy, as are those ``by_support``: by how many training runs drove the true
    terrain with the motion of a window, where that is known.
    """

    accuracy: Difference
    macro_run_accuracy: Difference
    confidence_auc: Difference
    by_class: dict[str, Difference]
    by_run: tuple[RunDifference, ...]
    by_support: Mapping[str, Difference] = MappingProxyType({})
    a: str = ""
    b: str = ""


def compare_with_first(
    names: Sequence[str], outcomes: Sequence[Outcome], seed: int, levels: Array | None = None
) -> tuple[Comparison, ...]:
    """Return how each of the other classifiers differs from the first.

    Parameters
    ----------
    names, outcomes : of the classifiers
    seed : of each bootstrap
    levels : (n,) :class:`~terrain.classify.support.SupportLevel` of each window, the same of all outcomes
    """
    first, found = outcomes[0], []
    for name, other in zip(names[1:], outcomes[1:], strict=True):
        by_support = {}
        for level in SupportLevel if levels is not None else ():
            rows = np.flatnonzero(levels == level.value)
            if len(rows):
                parts = compare_outcomes(first.at(rows), other.at(rows), np.random.default_rng(seed))
                by_support[level.value] = parts.accuracy
        compared = compare_outcomes(first, other, np.random.default_rng(seed))
        found.append(compared._replace(by_support=by_support, a=names[0], b=name))
    return tuple(found)


def compare_outcomes(a: Outcome, b: Outcome, rng: np.random.Generator) -> Comparison:
    """Return the differences between two classifiers, paired by run.

    Parameters
    ----------
    a, b : of the same runs; their windows may differ
    rng : source of the bootstrap

    Raises
    ------
    DataError
        if they were not judged on the same runs and classes.

    Examples
    --------
    >>> run, terrain = np.repeat(np.arange(8).astype(str), 10), np.repeat(["ice", "mud"], 40)
    >>> half, all_right = np.tile([True, False], (1, 40)), np.ones((1, 80), dtype=bool)
    >>> worse, better = (Outcome(run, terrain, right, np.full((1, 80), 0.9)) for right in (half, all_right))
    >>> found = compare_outcomes(worse, better, np.random.default_rng(0))
    >>> found.accuracy.difference, found.accuracy.verdict.value, found.by_class["ice"].n_runs
    (0.5, 'better', 4)
    """
    cells, places = _common_cells(a, b)
    terrain = np.array([name for _, name in cells])
    counts = stratified_counts(terrain, N_DRAWS, rng)

    def compared(figure: Callable[[Outcome, Array, Array], Array], kept: Array) -> Difference:
        weights = np.vstack([np.ones(len(cells)), counts]) * kept
        of_a, of_b = (figure(each, place, weights) for each, place in zip((a, b), places, strict=True))
        return _difference(of_a, of_b, int(kept.sum()))

    everything = np.ones(len(cells))
    hits = [_cell_accuracies(each, place, len(cells)) for each, place in zip((a, b), places, strict=True)]
    return Comparison(
        compared(_accuracy, everything),
        compared(lambda each, place, w: _macro_accuracy(each, place, w, terrain), everything),
        compared(_area, everything),
        {str(name): compared(_accuracy, (terrain == name).astype(float)) for name in np.unique(terrain)},
        tuple(
            RunDifference(run, name, float(of_a), float(of_b))
            for (run, name), of_a, of_b in zip(cells, *hits, strict=True)
        ),
    )


def paired_accuracy(
    terrain: Array, n_windows: Array, a: Array, b: Array, rng: np.random.Generator
) -> Difference:
    """Return the difference of two accuracies over runs, which are drawn within their classes.

    Parameters
    ----------
    terrain, n_windows : (n,) class of each run, and by how many windows it counts
    a, b : (n,) accuracy of both on each run
    rng : source of the bootstrap

    Examples
    --------
    >>> terrain, n_windows = np.repeat(["ice", "mud"], 4), np.full(8, 10)
    >>> paired_accuracy(terrain, n_windows, np.full(8, 0.5), np.full(8, 0.75), np.random.default_rng(0)).interval
    (0.25, 0.25)
    """
    weights = np.vstack([np.ones(len(terrain)), stratified_counts(terrain, N_DRAWS, rng)]) * n_windows
    of_a, of_b = (weights @ each / weights.sum(axis=1) for each in (a, b))
    return _difference(of_a, of_b, len(terrain))


def _common_cells(a: Outcome, b: Outcome) -> tuple[list[tuple[str, str]], list[Array]]:
    """Return the runs with their classes, and of each classifier's windows which of them they belong to."""
    pairs = [list(zip(each.run_id.astype(str), each.terrain.astype(str), strict=True)) for each in (a, b)]
    cells = sorted(set(pairs[0]))
    if cells != sorted(set(pairs[1])):
        other = sorted(set(pairs[0]) ^ set(pairs[1]))[0]
        raise DataError(f"run {other[0]} ({other[1]}) was judged by one of the two only")
    number = {cell: i for i, cell in enumerate(cells)}
    return cells, [np.array([number[pair] for pair in each]) for each in pairs]


def _cell_accuracies(each: Outcome, place: Array, n_cells: int) -> Array:
    hits = np.bincount(place, weights=each.correct.mean(axis=0), minlength=n_cells)
    return np.asarray(hits / np.bincount(place, minlength=n_cells))


def _accuracy(each: Outcome, place: Array, weights: Array) -> Array:
    sizes = np.bincount(place, minlength=weights.shape[1])
    hits = _cell_accuracies(each, place, weights.shape[1]) * sizes
    return np.asarray((weights @ hits) / (weights @ sizes))


def _macro_accuracy(each: Outcome, place: Array, weights: Array, terrain: Array) -> Array:
    accuracies = _cell_accuracies(each, place, weights.shape[1])
    of_class = [
        weights[:, terrain == name] @ accuracies[terrain == name] / weights[:, terrain == name].sum(axis=1)
        for name in np.unique(terrain)
    ]
    return np.asarray(np.mean(of_class, axis=0))


def _area(each: Outcome, place: Array, weights: Array) -> Array:
    pairs: Sequence[tuple[Array, Array]] = list(zip(each.confidence, each.correct.astype(float), strict=True))
    return np.asarray(np.mean([confidence_auc(c, right, weights[:, place]) for c, right in pairs], axis=0))


def _difference(of_a: Array, of_b: Array, n_runs: int) -> Difference:
    """Return the difference of figures of which the first is of all runs, the others of bootstrap samples."""
    draws = of_b[1:] - of_a[1:]
    known = n_runs >= MIN_RUNS and np.isfinite(draws).any()
    low, high = percentile_interval(draws) if known else (np.nan, np.nan)
    verdict = Verdict.BETTER if low > 0 else Verdict.WORSE if high < 0 else Verdict.NOT_DISTINGUISHED
    return Difference(float(of_a[0]), float(of_b[0]), float(of_b[0] - of_a[0]), (low, high), verdict, n_runs)
