"""Accuracy by support: by the true terrain, and by the mark that needs no label.

Each held-out window is judged by a table of the training windows of its own fold.  Figures are ratios of sums
over windows, their intervals those of a bootstrap that draws whole runs within their classes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.bootstrap import percentile_interval, stratified_counts
from terrain.classify.confidence import Interval, confidence_auc, runs_of_classes
from terrain.classify.held_out import HeldOut
from terrain.classify.metrics import N_BOOTSTRAP
from terrain.classify.regimes import Motion
from terrain.classify.support import SupportLevel, learn_support, support_levels, support_of
from terrain.records import Array


class HeldOutSupport(NamedTuple):
    """Support of held-out windows by the training runs of their folds, each (repeats, n).

    Parameters
    ----------
    correct : whether the prediction is right
    true_runs : training runs of the true terrain near the motion of the window
    predicted_runs : of the predicted terrain
    probability : supported probability of the predicted terrain
    supported : whether the prediction is marked supported
    """

    correct: Array
    true_runs: Array
    predicted_runs: Array
    probability: Array
    supported: Array


def held_out_support(held_out: HeldOut, run_id: Array, motion: Motion) -> HeldOutSupport:
    """Return the support of each window (repeats, n) by the training windows of the fold that held it out.

    Parameters
    ----------
    held_out : probabilities of the windows
    run_id, motion : run of each window, and how the robot moved in it
    """
    shape, terrain = held_out.probability.shape[:2], held_out.truth
    true_runs, predicted_runs = np.zeros((2, *shape), dtype=int)
    probability, supported = np.full(shape, np.nan), np.zeros(shape, dtype=bool)
    classes = [str(name) for name in held_out.classes]
    true = np.searchsorted(held_out.classes, terrain)
    for (repeat, _, train, test), stated, *_ in held_out.results:
        driven, there = motion.of(train), motion.of(test)
        table = learn_support(driven.speed_mps, driven.yaw_rate_radps, terrain[train], run_id[train], classes)
        near = table.near_runs(there.speed_mps, there.yaw_rate_radps)
        true_runs[repeat, test] = near[np.arange(len(test)), true[test]]
        predicted_runs[repeat, test], probability[repeat, test], supported[repeat, test] = support_of(
            stated, near
        )
    return HeldOutSupport(held_out.correct, true_runs, predicted_runs, probability, supported)


class PartFigures(NamedTuple):
    """A part of the held-out windows; intervals are of 95 % over runs, None where it holds no window.

    Parameters
    ----------
    windows_ratio, windows_ratio_ci : of all windows
    accuracy, accuracy_ci : of the part
    errors_ratio, errors_ratio_ci : of all errors, those in the part; None where there is no error
    """

    windows_ratio: float
    windows_ratio_ci: Interval
    accuracy: float | None
    accuracy_ci: Interval | None
    errors_ratio: float | None
    errors_ratio_ci: Interval | None


class SupportAccuracy(NamedTuple):
    """Accuracy by support.

    Parameters
    ----------
    by_true_terrain : by :class:`~terrain.classify.support.SupportLevel` of the true terrain: needs labels
    unsupported, supported : by the mark of the prediction, without a label
    auc : area from the supported probability to correctness; None where all are right
    """

    by_true_terrain: dict[str, PartFigures]
    unsupported: PartFigures
    supported: PartFigures
    auc: float | None


def support_accuracy(
    held_out: HeldOutSupport, run_id: Array, terrain: Array, rng: np.random.Generator
) -> SupportAccuracy:
    """Return the accuracy of held-out windows by their support.

    Parameters
    ----------
    held_out : of n windows
    run_id, terrain : (n,) run and true terrain of each window
    rng : source of the bootstrap

    Examples
    --------
    >>> right, runs = np.array([[True, True, False, True]]), np.array([[5, 5, 0, 2]])
    >>> held_out = HeldOutSupport(right, runs, runs, 0.9 * runs / (1 + runs), runs > 1)
    >>> run, terrain = np.array(list("aabb")), np.array(["ice"] * 4)
    >>> found = support_accuracy(held_out, run, terrain, np.random.default_rng(0))
    >>> found.unsupported.windows_ratio, found.unsupported.errors_ratio, found.supported.accuracy
    (0.25, 1.0, 1.0)
    >>> found.by_true_terrain["1 to 3 runs"].accuracy, found.auc
    (1.0, 1.0)
    """
    class_of, place = runs_of_classes(run_id, terrain)
    drawn = stratified_counts(class_of, N_BOOTSTRAP, rng)
    weights = np.vstack([np.ones(len(class_of)), drawn])  # the first as they are
    level = support_levels(held_out.true_runs)

    def part(inside: Array) -> PartFigures:
        return _part(inside, held_out.correct, place, weights)

    areas = [
        confidence_auc(probability, right.astype(float), np.ones((1, right.size)))[0]
        for probability, right in zip(held_out.probability, held_out.correct, strict=True)
    ]
    known = np.isfinite(areas)
    return SupportAccuracy(
        {each.value: part(level == each.value) for each in SupportLevel},
        part(~held_out.supported),
        part(held_out.supported),
        float(np.mean(np.array(areas)[known])) if known.any() else None,
    )


def _part(inside: Array, correct: Array, place: Array, weights: Array) -> PartFigures:
    def total(values: Array) -> Array:
        return np.asarray(weights @ np.bincount(place, values.sum(axis=0), weights.shape[1]))

    n, errors = total(np.ones(correct.shape)), total((~correct).astype(float))
    n_inside, wrong_inside = total(inside.astype(float)), total((inside & ~correct).astype(float))
    ratio, interval = _ratio(n_inside, n)
    return PartFigures(
        ratio or 0.0,
        interval or (0.0, 0.0),
        *_ratio(n_inside - wrong_inside, n_inside),
        *_ratio(wrong_inside, errors),
    )


def _ratio(numerator: Array, denominator: Array) -> tuple[float | None, Interval | None]:
    """Return the first ratio, and the interval of the others; None where the first has no denominator."""
    if not denominator[0]:
        return None, None
    ratio: Array = np.full(len(numerator), np.nan)
    np.divide(numerator, denominator, out=ratio, where=denominator > 0)
    return float(ratio[0]), percentile_interval(ratio[1:]) if np.isfinite(ratio[1:]).any() else None
