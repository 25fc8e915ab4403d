"""Fit a classifier on every fold, and pool its predictions for windows that were held out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from sklearn.base import BaseEstimator, clone

from features.windows import WindowCut
from pipelines.crossval.results import Figures, FoldFigures
from pipelines.crossval.splits import Fold, Samples
from pipelines.learn.parallel import parallel
from pipelines.reporting.progress import Progress, silent
from terrain.classify.confidence import confidence_figures
from terrain.classify.conformal import conformal_sets, conformal_threshold, held_out_scores
from terrain.classify.conformal_figures import ConformalFigures, conformal_figures
from terrain.classify.metrics import (
    class_figures,
    macro_run_accuracy,
    per_run_figures,
    run_bootstrap,
    runs_by_terrain,
    vote,
    vote_sizes,
)
from terrain.errors import DataError
from terrain.records import Array


class Examples(NamedTuple):
    """What a classifier learns from.

    Parameters
    ----------
    features : (n, f)
    terrain : (n,) class of each row
    group : (n,) what must not be split, the run of each row
    """

    features: Array
    terrain: Array
    group: Array


class FoldResult(NamedTuple):
    """Held-out class probabilities of one fold, and what else was asked of its classifier.

    ``conformal`` is the threshold of its sets of classes; NaN where its training part does not give one.
    """

    fold: Fold
    probability: Array
    chosen: Mapping[str, Any]
    found: Any = None
    conformal: float = math.nan


class HeldOut(NamedTuple):
    """Held-out probabilities of every repeat, ``(repeats, n_windows, k)``, and the folds they come from."""

    classes: Array
    probability: Array
    fold_number: Array
    results: list[FoldResult]


def _fit_fold(
    classifier: BaseEstimator,
    examples: Examples,
    classes: Array,
    fold: Fold,
    ask: Callable[[Any], Any] | None = None,
) -> FoldResult:
    fitted = fit_on(classifier, examples, fold.train)
    probability = np.zeros((len(fold.test), len(classes)))
    probability[:, np.searchsorted(classes, fitted.classes_)] = fitted.predict_proba(
        examples.features[fold.test]
    )
    best = getattr(fitted, "best_", None)
    chosen = dict(best._asdict()) if best is not None else {}
    found = None if ask is None else ask(fitted)
    return FoldResult(fold, probability, chosen, found, _threshold(fitted, examples, fold.train))


def _threshold(fitted: Any, examples: Examples, rows: Array) -> float:
    """Return the threshold of the sets of classes of a classifier that was fitted on some rows."""
    if not hasattr(fitted, "inner_probability_"):
        return math.nan
    try:
        scores = held_out_scores(fitted, examples.terrain[rows])
        return conformal_threshold(scores, np.asarray(examples.group)[rows].astype(str))
    except DataError:
        return math.nan


def fit_on(classifier: BaseEstimator, examples: Examples, rows: Array) -> Any:
    """Return a clone of the classifier, fitted on some rows."""
    features, terrain, group = examples
    return clone(classifier).fit(features[rows], terrain[rows], groups=group[rows])


def fit_folds(
    classifier: BaseEstimator,
    examples: Examples,
    folds: Sequence[Fold],
    n_jobs: int,
    task: str,
    progress: Progress = silent,
    asks: Sequence[Callable[[Any], Any] | None] | None = None,
) -> list[FoldResult]:
    """Fit a clone of the classifier on each fold and return its held-out probabilities in order.

    Parameters
    ----------
    classifier : estimator with ``fit(X, y, groups)`` and ``predict_proba``
    examples : rows that the folds number
    folds : train and test rows
    n_jobs : processes at once on this machine, see :func:`pipelines.learn.parallel.parallel`
    task, progress : name of the work, and what is called as it goes on
    asks : for each fold, what is called with its fitted classifier, where it is fitted
    """
    classes = np.unique(examples.terrain)
    results = []
    progress(task, 0, len(folds))
    each = zip(folds, [None] * len(folds) if asks is None else asks, strict=True)
    for result in parallel(_fit_fold, (classifier, examples, classes), each, min(n_jobs, len(folds))):
        results.append(result)
        progress(task, len(results), len(folds))
    return results


def pool(results: Sequence[FoldResult], terrain: Array) -> HeldOut:
    """Lay the held-out probabilities of all folds beside the windows (n,) that they belong to."""
    classes = np.unique(terrain)
    n_repeats = 1 + max(result.fold.repeat for result in results)
    probability = np.full((n_repeats, len(terrain), len(classes)), np.nan)
    fold_number = np.full((n_repeats, len(terrain)), -1)
    for result in results:
        probability[result.fold.repeat, result.fold.test] = result.probability
        fold_number[result.fold.repeat, result.fold.test] = result.fold.number
    return HeldOut(classes, probability, fold_number, list(results))


def sets_of(held_out: HeldOut, samples: Samples, seed: int) -> ConformalFigures | None:
    """Return the figures of the sets of classes; None where a fold has no threshold."""
    if any(math.isnan(result.conformal) for result in held_out.results):
        return None
    held_out, samples = _tested(held_out, samples)
    windows = samples.cut.windows
    terrain = windows.terrain.astype(str)
    member = np.zeros(held_out.probability.shape, dtype=bool)
    for result in held_out.results:
        repeat, test = result.fold.repeat, result.fold.test
        member[repeat, test] = conformal_sets(held_out.probability[repeat, test], result.conformal)
    run_id = runs_by_terrain(windows.run_id.astype(str), terrain)
    truth = np.searchsorted(held_out.classes, terrain)
    return conformal_figures(member, truth, run_id, terrain, np.random.default_rng(seed))


def _tested(held_out: HeldOut, samples: Samples) -> tuple[HeldOut, Samples]:
    """Return only the windows that were held out in every repeat; folds number these."""
    tested = np.isfinite(held_out.probability).all(axis=(0, 2))
    if tested.all():
        return held_out, samples
    place = np.cumsum(tested) - 1
    results = [
        result._replace(fold=result.fold._replace(test=place[result.fold.test]))
        for result in held_out.results
    ]
    cut = WindowCut(samples.cut.windows[tested], samples.cut.dropped)
    return (
        held_out._replace(
            probability=held_out.probability[:, tested],
            fold_number=held_out.fold_number[:, tested],
            results=results,
        ),
        samples._replace(cut=cut, group=samples.group[tested]),
    )


def _segments(group: Array, fold_number: Array) -> Array:
    """Return a number for each stretch of a group that was tested by one fold."""
    group_of = np.unique(group.astype(str), return_inverse=True)[1]
    return np.asarray(group_of * (fold_number.max() + 1) + fold_number)


def summarise(held_out: HeldOut, samples: Samples, seed: int) -> Figures:
    """Return the figures of merit of a cross-validation; ``seed`` is that of the bootstrap over runs."""
    held_out, samples = _tested(held_out, samples)
    windows = samples.cut.windows
    terrain, classes = windows.terrain.astype(str), held_out.classes
    run_id = runs_by_terrain(windows.run_id.astype(str), terrain)
    predicted = classes[held_out.probability.argmax(axis=2)]
    correct = predicted == terrain
    voted = np.stack(
        [
            classes[vote(p, _segments(samples.group, number), windows.start_s, windows.length_s)]
            for p, number in zip(held_out.probability, held_out.fold_number, strict=True)
        ]
    )  # fmt: skip
    sizes = [
        vote_sizes(_segments(samples.group, number), windows.start_s, windows.length_s)
        for number in held_out.fold_number
    ]
    repeats = [class_figures(terrain, p, classes) for p in predicted]
    pooled = class_figures(np.tile(terrain, len(predicted)), predicted.ravel(), classes)
    accuracies = np.array([repeat.accuracy for repeat in repeats])
    confidence = held_out.probability.max(axis=2)
    stated = confidence_figures(confidence, correct, run_id, terrain, np.random.default_rng(seed))
    per_run = per_run_figures(correct, predicted[0], voted == terrain, run_id, terrain)
    return Figures(
        classes=tuple(str(name) for name in classes),
        n_windows=len(terrain),
        n_runs=len(np.unique(windows.run_id)),
        repeats=len(repeats),
        accuracy=float(accuracies.mean()),
        accuracy_spread=float(accuracies.std(ddof=1)) if len(repeats) > 1 else None,
        accuracy_per_repeat=tuple(accuracies.tolist()),
        accuracy_ci=run_bootstrap(correct.mean(axis=0), run_id, terrain, np.random.default_rng(seed)),
        balanced_accuracy=float(np.mean([repeat.balanced_accuracy for repeat in repeats])),
        macro_f1=float(np.mean([repeat.macro_f1 for repeat in repeats])),
        macro_run_accuracy=macro_run_accuracy(per_run),
        per_class=pooled.per_class,
        confusion=pooled.confusion,
        vote_accuracy=float(np.mean(voted == terrain)),
        vote_windows=float(np.mean(sizes)),
        ece=stated.ece,
        ece_ci=stated.ece_ci,
        confidence_auc=stated.auc,
        confidence_auc_ci=stated.auc_ci,
        accuracy_at_coverage=stated.at_coverage,
        reliability=stated.reliability,
        per_run=per_run,
        folds=tuple(
            FoldFigures(
                result.fold.repeat,
                result.fold.number,
                len(result.fold.train),
                len(result.fold.test),
                float(correct[result.fold.repeat, result.fold.test].mean()),
                result.chosen,
            )
            for result in held_out.results
        ),
    )
