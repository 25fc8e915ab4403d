"""Figures of merit of held-out predictions: accuracy, calibration, votes, and an interval over runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from sklearn.metrics import confusion_matrix, precision_recall_fscore_support

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.records import Array

VOTE_SPAN_S = 5.0
INTERVAL = 0.95
N_BOOTSTRAP = 2000
TIME_TOLERANCE_S = 1e-6


class ClassFigures(NamedTuple):
    """Precision, recall and F1 of one class, and how many windows were truly of it."""

    precision: float
    recall: float
    f1: float
    n_windows: int


class Classification(NamedTuple):
    """Figures of one set of predictions; rows of ``confusion`` are true classes, columns predicted ones."""

    accuracy: float
    balanced_accuracy: float
    macro_f1: float
    per_class: dict[str, ClassFigures]
    confusion: tuple[tuple[int, ...], ...]


class RunFigures(NamedTuple):
    """Accuracy of the windows of one run, and the class that wrong ones are predicted as most often."""

    run_id: str
    terrain: str
    n_windows: int
    accuracy: float
    vote_accuracy: float
    mistaken_for: str | None


def class_figures(y: Array, predicted: Array, classes: Array) -> Classification:
    """Return accuracy, balanced accuracy, macro F1, per-class figures and the confusion matrix.

    Parameters
    ----------
    y, predicted : (n,) classes
    classes : (k,) order of rows and columns

    Examples
    --------
    >>> figures = class_figures(np.array(["a", "a", "b"]), np.array(["a", "b", "b"]), np.array(["a", "b"]))
    >>> figures.confusion, round(figures.balanced_accuracy, 2)
    (((1, 1), (0, 1)), 0.75)
    """
    precision, recall, f1, support = precision_recall_fscore_support(
        y, predicted, labels=classes, zero_division=0.0
    )
    tested = support > 0
    return Classification(
        accuracy=float(np.mean(y == predicted)),
        balanced_accuracy=float(recall[tested].mean()),
        macro_f1=float(f1[tested].mean()),
        per_class={
            str(name): ClassFigures(float(precision[i]), float(recall[i]), float(f1[i]), int(support[i]))
            for i, name in enumerate(classes)
        },
        confusion=tuple(map(tuple, confusion_matrix(y, predicted, labels=classes).tolist())),
    )


def vote(
    probability: Array, segment: Array, start_s: Array, length_s: float, span_s: float = VOTE_SPAN_S
) -> Array:
    """Return the class index voted by the windows that lie within the last ``span_s`` seconds.

    A window that ends at t votes together with the windows of its own segment that lie wholly in
    ``[t - span_s, t]``; a tie goes to the class with the higher summed probability.

    Parameters
    ----------
    probability : (n, k)
    segment : (n,) stretch of a run that was tested in one piece; votes do not cross its ends
    start_s : (n,) start of each window
    length_s : length of a window
    """
    ballots = np.eye(probability.shape[1])[probability.argmax(axis=1)]
    voted = np.empty(len(probability), dtype=int)
    for row, voters in _voters(segment, start_s, length_s, span_s):
        count, weight = ballots[voters].sum(axis=0), probability[voters].sum(axis=0)
        voted[row] = np.lexsort((weight, count))[-1]
    return voted


def vote_sizes(segment: Array, start_s: Array, length_s: float, span_s: float = VOTE_SPAN_S) -> Array:
    """Return how many windows (n,) take part in each vote; parameters as :func:`vote`.

    Two windows of 2 s lie wholly in 5 s, and one window of 5 s does: such a vote is no vote.

    Examples
    --------
    >>> vote_sizes(np.array(["a"] * 4), np.array([0.0, 2.0, 4.0, 6.0]), 2.0).tolist()
    [1, 2, 2, 2]
    """
    sizes = np.empty(len(start_s), dtype=int)
    for row, voters in _voters(segment, start_s, length_s, span_s):
        sizes[row] = len(voters)
    return sizes


def _voters(segment: Array, start_s: Array, length_s: float, span_s: float) -> Iterator[tuple[int, Array]]:
    """Yield each row with the rows that vote with it, its own among them."""
    for name in np.unique(segment):
        rows = np.flatnonzero(segment == name)
        rows = rows[np.argsort(start_s[rows], kind="stable")]
        starts = start_s[rows]
        first = np.searchsorted(starts, starts + length_s - span_s - TIME_TOLERANCE_S)
        for position, row in enumerate(rows):
            yield int(row), rows[min(first[position], position) : position + 1]


def runs_by_terrain(run_id: Array, terrain: Array) -> Array:
    """Return the run of each window, with the terrain added where a run has several.

    Examples
    --------
    >>> runs_by_terrain(np.array(["a", "a", "b"]), np.array(["ice", "snow", "ice"])).tolist()
    ['a (ice)', 'a (snow)', 'b']
    """
    mixed = [run for run in np.unique(run_id) if len(np.unique(terrain[run_id == run])) > 1]
    pairs = zip(run_id, terrain, strict=True)
    return np.array([f"{run} ({name})" if run in mixed else run for run, name in pairs])


def run_bootstrap(
    correct: Array, run_id: Array, terrain: Array, rng: np.random.Generator
) -> tuple[float, float]:
    """Return a 95 % interval of the accuracy by resampling whole runs within their classes.

    Windows of one run are not independent, so runs are drawn, with replacement, as many a class as the
    class has.  A class with one run adds no spread, and with three or four a class the interval is still
    too narrow.

    Parameters
    ----------
    correct : (n,) fraction of the repeats in which each window was classified correctly
    run_id, terrain : (n,) run and class of each window
    rng : source of the draws
    """
    runs, run_of = np.unique(run_id, return_inverse=True)
    hits = np.bincount(run_of, weights=correct)
    sizes = np.bincount(run_of)
    class_of = np.empty(len(runs), dtype=object)
    class_of[run_of] = terrain
    n_hits, n_windows = np.zeros(N_BOOTSTRAP), np.zeros(N_BOOTSTRAP)
    for name in np.unique(terrain):
        members = np.flatnonzero(class_of == name)
        drawn = members[bootstrap_rows(len(members), N_BOOTSTRAP, rng)]
        n_hits += hits[drawn].sum(axis=1)
        n_windows += sizes[drawn].sum(axis=1)
    return percentile_interval(n_hits / n_windows, INTERVAL)


def per_run_figures(
    correct: Array, predicted: Array, voted_correct: Array, run_id: Array, terrain: Array
) -> tuple[RunFigures, ...]:
    """Return the figures of each run, in the order of their ids.

    Parameters
    ----------
    correct, voted_correct : (n,) or (repeats, n) whether the prediction and the vote are right
    predicted : (n,) predictions of one repeat
    run_id, terrain : (n,) run and class of each window
    """
    figures = []
    for name in np.unique(run_id):
        rows = run_id == name
        wrong, counts = np.unique(predicted[rows & (predicted != terrain)], return_counts=True)
        figures.append(
            RunFigures(
                run_id=str(name),
                terrain=str(terrain[rows][0]),
                n_windows=int(rows.sum()),
                accuracy=float(np.mean(correct[..., rows])),
                vote_accuracy=float(np.mean(voted_correct[..., rows])),
                mistaken_for=str(wrong[counts.argmax()]) if len(wrong) else None,
            )
        )
    return tuple(figures)


def macro_run_accuracy(runs: Iterable[RunFigures]) -> float:
    """Return the mean over classes of the mean accuracy of their runs, whatever their numbers of windows.

    Examples
    --------
    >>> runs = [RunFigures("a", "ice", 90, 1.0, 1.0, None), RunFigures("b", "ice", 10, 0.5, 0.5, "snow"),
    ...         RunFigures("c", "snow", 5, 0.25, 0.25, "ice")]
    >>> macro_run_accuracy(runs)
    0.5
    """
    of_class: dict[str, list[float]] = {}
    for run in runs:
        of_class.setdefault(run.terrain, []).append(run.accuracy)
    return float(np.mean([np.mean(accuracies) for accuracies in of_class.values()]))
