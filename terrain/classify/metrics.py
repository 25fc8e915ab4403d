"""Figures of merit of held-out predictions: accuracy, calibration, votes, and an interval over runs.

Windows of one run are not independent: intervals are those of a bootstrap that draws whole runs, within their
classes, and computes each figure again from the windows of the runs drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from sklearn.metrics import confusion_matrix, precision_recall_fscore_support

from terrain.bootstrap import bootstrap_rows, percentile_interval, stratified_counts
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


COVERAGES = (0.8, 0.5)
"""Fractions of the windows, the most confident first, of which the accuracy is given."""

N_DRAWS = 1000
CALIBRATION_BINS = 15
DRAWS_AT_ONCE_VALUES = 4_000_000
"""Bootstrap draws are computed in blocks of at most so many weights: 32 MB."""

Interval = tuple[float, float]


class CoverageFigures(NamedTuple):
    """Accuracy of the most confident windows.

    Parameters
    ----------
    coverage : their fraction of all windows
    accuracy, accuracy_ci : of them, with its 95 % interval over runs
    confidence_least : of them, the least
    """

    coverage: float
    accuracy: float
    accuracy_ci: Interval
    confidence_least: float


class ReliabilityBin(NamedTuple):
    """Mean confidence and accuracy of a bin of windows, with the 95 % interval of the accuracy over runs."""

    confidence: float
    accuracy: float
    n_windows: int
    accuracy_ci: Interval


class Confidence(NamedTuple):
    """How confidence relates to correctness; intervals are of 95 % over runs.

    Parameters
    ----------
    auc, auc_ci : probability that a window that is right has a higher confidence than one that is wrong; NaN
        where all are right or all are wrong
    at_coverage : accuracy of the most confident windows
    ece, ece_ci : expected calibration error of the top label over bins of equal mass
    reliability : the bins
    """

    auc: float
    auc_ci: Interval
    at_coverage: tuple[CoverageFigures, ...]
    ece: float
    ece_ci: Interval
    reliability: tuple[ReliabilityBin, ...]


def run_weights(run_id: Array, terrain: Array, n_draws: int, rng: np.random.Generator) -> Array:
    """Return how often each window's run is drawn (n_draws, n), runs being drawn within their classes.

    Parameters
    ----------
    run_id, terrain : (n,) run and class of each window; a run of several classes counts for each
    n_draws : bootstrap samples
    rng : source of the draws

    Examples
    --------
    >>> run_weights(np.array(["a", "a", "b"]), np.array(["ice"] * 3), 1, np.random.default_rng(1))
    array([[1., 1., 1.]])
    """
    class_of, place = runs_of_classes(run_id, terrain)
    return np.asarray(stratified_counts(class_of, n_draws, rng)[:, place])


def runs_of_classes(run_id: Array, terrain: Array) -> tuple[Array, Array]:
    """Return the class (runs,) of each run, one of several classes once for each, and the run (n,) of each window."""
    names = np.char.add(np.char.add(terrain.astype(str), "\n"), run_id.astype(str))
    _, first, place = np.unique(names, return_index=True, return_inverse=True)
    return terrain[first], place


def confidence_auc(confidence: Array, correct: Array, weights: Array) -> Array:
    """Return the area under the curve from confidence to correctness under each set of weights (d,).

    ``P(c_right > c_wrong) + P(c_right = c_wrong) / 2`` over weighted pairs of a window that is right and one
    that is wrong (Mann and Whitney); NaN where there are no such pairs.

    Parameters
    ----------
    confidence : (n,) probability of the predicted class
    correct : (n,) whether, or in which fraction of repeats, the prediction is right
    weights : (d, n)

    Examples
    --------
    >>> confidence_auc(np.array([0.9, 0.8, 0.6]), np.array([1, 0, 1]), np.ones((1, 3)))
    array([0.5])
    """
    order = np.argsort(confidence, kind="stable")
    first = np.unique(confidence[order], return_index=True)[1]
    right = np.add.reduceat(weights[:, order] * correct[order], first, axis=1)
    wrong = np.add.reduceat(weights[:, order] * (1.0 - correct[order]), first, axis=1)
    below = np.cumsum(wrong, axis=1) - wrong
    pairs = right.sum(axis=1) * wrong.sum(axis=1)
    area: Array = np.full(len(weights), np.nan)
    np.divide((right * (below + wrong / 2)).sum(axis=1), pairs, out=area, where=pairs > 0)
    return area


def accuracy_at_coverage(confidence: Array, correct: Array, weights: Array, coverage: float) -> Array:
    """Return the accuracy of the most confident windows that hold a fraction of the weight (d,).

    Examples
    --------
    >>> accuracy_at_coverage(np.array([0.9, 0.8, 0.6, 0.5]), np.array([1, 1, 0, 0]), np.ones((1, 4)), 0.75)
    array([0.66666667])
    """
    order = np.argsort(-confidence, kind="stable")
    upto = np.cumsum(weights[:, order], axis=1)
    kept = np.diff(np.minimum(upto, coverage * upto[:, -1:]), axis=1, prepend=0.0)
    total = kept.sum(axis=1)
    found: Array = np.full(len(weights), np.nan)
    np.divide(kept @ correct[order], total, out=found, where=total > 0)
    return found


def calibration_error(confidence: Array, correct: Array, weights: Array, n_bins: int) -> Array:
    """Return the expected calibration error over bins of equal count under each set of weights (d,).

    ``ece = sum_b w_b |accuracy_b - confidence_b|`` with the windows sorted by confidence and cut into
    ``n_bins`` bins of equal count (Guo et al. 2017, equation 3, equal mass instead of equal width).

    Examples
    --------
    >>> calibration_error(np.full(100, 0.9), np.arange(100) < 60, np.ones((1, 100)), 1).round(9)
    array([0.3])
    """
    order = np.argsort(confidence, kind="stable")
    first = bin_starts(len(order), n_bins)
    gaps = np.add.reduceat(weights[:, order] * (correct[order] - confidence[order]), first, axis=1)
    found: Array = np.abs(gaps).sum(axis=1) / weights.sum(axis=1)
    return found


def bin_starts(n: int, n_bins: int) -> Array:
    """Return where bins of equal count begin; fewer bins where there are fewer windows.

    Examples
    --------
    >>> bin_starts(5, 2), bin_starts(2, 3)
    (array([0, 3]), array([0, 1]))
    """
    sizes = [len(part) for part in np.array_split(np.arange(n), n_bins) if len(part)]
    return np.cumsum([0, *sizes[:-1]])


def reliability_bins(
    confidence: Array, correct: Array, weights: Array, n_bins: int
) -> tuple[ReliabilityBin, ...]:
    """Return mean confidence and accuracy of bins of equal count over all repeats together.

    Parameters
    ----------
    confidence, correct : (repeats, n)
    weights : (d, n) of the windows in each bootstrap sample, for the intervals
    n_bins : number of bins; fewer where there are fewer windows
    """
    n = confidence.shape[1]
    confidence, correct = confidence.ravel(), correct.ravel().astype(float)
    order = np.argsort(confidence, kind="stable")
    edges = [*bin_starts(len(order), n_bins).tolist(), len(order)]
    found = []
    for start, end in pairwise(edges):
        rows = order[start:end]
        drawn = weights[:, rows % n]
        total = drawn.sum(axis=1)
        accuracies = np.full(len(weights), np.nan)
        np.divide(drawn @ correct[rows], total, out=accuracies, where=total > 0)
        known = np.isfinite(accuracies).any()
        interval = percentile_interval(accuracies) if known else (np.nan, np.nan)
        accuracy = float(correct[rows].mean())
        found.append(ReliabilityBin(float(confidence[rows].mean()), accuracy, len(rows), interval))
    return tuple(found)


def confidence_figures(
    confidence: Array,
    correct: Array,
    run_id: Array,
    terrain: Array,
    rng: np.random.Generator,
    n_bins: int = CALIBRATION_BINS,
) -> Confidence:
    """Return how the confidence of held-out windows relates to their correctness.

    Parameters
    ----------
    confidence, correct : (repeats, n) probability of the predicted class, and whether it is right; figures
        are means over the repeats, bins hold all repeats
    run_id, terrain : (n,) run and class of each window
    rng : source of the bootstrap
    n_bins : of the calibration error

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> confidence = rng.uniform(0.5, 1.0, (1, 400))
    >>> correct = rng.random((1, 400)) < confidence
    >>> runs = np.repeat(np.arange(40), 10)
    >>> found = confidence_figures(confidence, correct, runs, np.zeros(400), rng)
    >>> found.auc_ci[0] < found.auc < found.auc_ci[1], found.ece < 0.1
    (True, True)
    """
    weights = run_weights(run_id, terrain, N_DRAWS, rng)

    def figure(of: Callable[[Array, Array, Array], Array]) -> tuple[float, Interval]:
        value = float(np.mean([of(c, r, np.ones((1, len(c))))[0] for c, r in _pairs(confidence, correct)]))
        at_once = max(1, DRAWS_AT_ONCE_VALUES // weights.shape[1])
        draws = np.zeros(len(weights))
        for c, r in _pairs(confidence, correct):
            blocks = [of(c, r, weights[i : i + at_once]) for i in range(0, len(weights), at_once)]
            draws += np.concatenate(blocks) / len(confidence)
        return value, percentile_interval(draws) if np.isfinite(draws).any() else (np.nan, np.nan)

    auc, auc_ci = figure(confidence_auc)
    ece, ece_ci = figure(partial(calibration_error, n_bins=n_bins))
    at_coverage = []
    for coverage in COVERAGES:
        accuracy, interval = figure(partial(accuracy_at_coverage, coverage=coverage))
        least = float(np.mean(np.quantile(confidence, 1.0 - coverage, axis=1)))
        at_coverage.append(CoverageFigures(coverage, accuracy, interval, least))
    bins = reliability_bins(confidence, correct, weights, n_bins)
    return Confidence(auc, auc_ci, tuple(at_coverage), round(ece, 12), ece_ci, bins)


def _pairs(confidence: Array, correct: Array) -> list[tuple[Array, Array]]:
    return list(zip(confidence, correct.astype(float), strict=True))
