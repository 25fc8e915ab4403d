"""Whether a classifier's confidence indicates that it is right, with intervals over runs.

Windows of one run are not independent: intervals are those of a bootstrap that draws whole runs, within their
classes, and computes each figure again from the windows of the runs drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import percentile_interval, stratified_counts
from terrain.records import Array

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
