"""Evaluation: a classifier is fitted on every fold, and its figures are those of windows that were held out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from sklearn.base import clone

from pipelines.learn.parallel import parallel
from pipelines.learn.protocols import Fold, Samples
from pipelines.report import Progress, format_value, interval, silent
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

WIDE_INTERVAL = 0.2
"""Accuracies that differ by half of this cannot be distinguished where the 95 % interval is wider."""


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
    """Held-out probabilities of every repeat, and the folds that they come from.

    Parameters
    ----------
    classes : (k,) sorted
    probability : (repeats, n, k); NaN of a window that was not held out
    fold_number : (repeats, n); -1 of such a window
    truth : (n,) class of each window
    results : fold by fold; empty of a model that was fitted before
    fitted : on all windows, where that was asked for
    """

    classes: Array
    probability: Array
    fold_number: Array
    truth: Array
    results: list[FoldResult]
    fitted: Any = None

    @property
    def tested(self) -> Array:
        """Whether each window (n,) was held out in every repeat."""
        return np.asarray(np.isfinite(self.probability).all(axis=(0, 2)))

    @property
    def accuracies(self) -> list[float]:
        """Part of the held-out windows that are classified correctly, repeat by repeat."""
        found = []
        for probability in self.probability:
            rows = np.flatnonzero(np.isfinite(probability).all(axis=1))
            predicted = self.classes[probability[rows].argmax(axis=1)]
            found.append(float((predicted == self.truth[rows]).mean()))
        return found


def evaluate(
    classifier: Any,
    examples: Examples,
    folds: Sequence[Fold],
    n_jobs: int = 1,
    task: str = "folds",
    progress: Progress = silent,
    asks: Sequence[Callable[[Any], Any] | None] | None = None,
    on_all: bool = False,
) -> HeldOut:
    """Fit a clone of a classifier on each fold, and return what it makes of the windows that are held out.

    Parameters
    ----------
    classifier : estimator with ``fit(X, y, groups)`` and ``predict_proba``
    examples : rows that the folds number
    folds : train and test rows
    n_jobs : processes at once on this machine, see :func:`pipelines.learn.parallel.parallel`
    task, progress : name of the work, and what is called as it goes on
    asks : for each fold, what is called with its fitted classifier, where it is fitted
    on_all : whether a clone is fitted on all rows, too, beside the folds

    Examples
    --------
    >>> from terrain.classify.svm import GroupedSVC
    >>> rng, runs = np.random.default_rng(0), np.repeat(np.arange(8), 10)
    >>> y = np.where(runs % 2, "ice", "mud")
    >>> examples = Examples(rng.normal(size=(80, 3)) + 9.0 * (y == "ice")[:, None], y, runs)
    >>> evaluate(GroupedSVC(), examples, [Fold(0, 0, np.flatnonzero(runs > 1), np.flatnonzero(runs < 2))]).accuracies
    [1.0]
    """
    classes, n = np.unique(examples.terrain), len(examples.terrain)
    n_repeats = 1 + max(fold.repeat for fold in folds)
    probability = np.full((n_repeats, n, len(classes)), np.nan)
    number = np.full((n_repeats, n), -1)
    results: list[FoldResult] = []
    each = [*zip(folds, [None] * len(folds) if asks is None else asks, strict=True)]
    fitted = None
    if on_all:  # first, as it takes longest
        each.insert(0, (Fold(0, 0, np.arange(n), np.zeros(0, dtype=int)), _itself))
    progress(task, 0, len(each))
    done = 0
    for result in parallel(_fit_fold, (classifier, examples, classes), each, min(n_jobs, len(each))):
        done += 1
        progress(task, done, len(each))
        if not len(result.fold.test):
            fitted = result.found
            continue
        probability[result.fold.repeat, result.fold.test] = result.probability
        number[result.fold.repeat, result.fold.test] = result.fold.number
        results.append(result)
    return HeldOut(classes, probability, number, examples.terrain, results, fitted)


def _itself(fitted: Any) -> Any:
    return fitted


def fit_on(classifier: Any, examples: Examples, rows: Array) -> Any:
    """Return a clone of the classifier, fitted on some rows."""
    features, terrain, group = examples
    return clone(classifier).fit(features[rows], terrain[rows], groups=group[rows])


def _fit_fold(
    classifier: Any,
    examples: Examples,
    classes: Array,
    fold: Fold,
    ask: Callable[[Any], Any] | None = None,
) -> FoldResult:
    fitted = fit_on(classifier, examples, fold.train)
    probability = np.zeros((len(fold.test), len(classes)))
    columns = np.searchsorted(classes, fitted.classes_)
    if len(fold.test):
        probability[:, columns] = fitted.predict_proba(examples.features[fold.test])
    best = getattr(fitted, "best_", None)
    chosen = dict(best._asdict()) if best is not None else {}
    threshold = math.nan
    if hasattr(fitted, "inner_probability_"):
        try:
            scores = held_out_scores(fitted, examples.terrain[fold.train])
            threshold = conformal_threshold(scores, np.asarray(examples.group)[fold.train].astype(str))
        except DataError:
            pass
    return FoldResult(fold, probability, chosen, None if ask is None else ask(fitted), threshold)


class FoldFigures(NamedTuple):
    """One fold: how many windows train and test, its accuracy, and what the inner folds chose."""

    repeat: int
    fold: int
    n_train: int
    n_test: int
    accuracy: float
    chosen: Mapping[str, Any]


def figures_of(held_out: HeldOut, samples: Samples, seed: int) -> dict[str, Any]:
    """Return the figures of merit of held-out windows, by the fields of ``pipelines.learn.crossval.Figures``.

    Parameters
    ----------
    held_out : probabilities of the windows
    samples : the windows
    seed : of the bootstrap over runs
    """
    rows, classes = np.flatnonzero(held_out.tested), held_out.classes
    windows, group, terrain = samples.windows, samples.group.astype(str)[rows], samples.terrain[rows]
    start_s, run_id = windows.start_s[rows], runs_by_terrain(samples.run_id[rows], terrain)
    probability, fold_number = held_out.probability[:, rows], held_out.fold_number[:, rows]
    predicted = classes[probability.argmax(axis=2)]
    correct = predicted == terrain
    # a vote is taken among windows of one group that one fold tested
    group_of = np.unique(group, return_inverse=True)[1]
    segments = group_of * (fold_number.max() + 1) + fold_number
    voted = np.stack(
        [
            classes[vote(p, segment, start_s, windows.length_s)] == terrain
            for p, segment in zip(probability, segments, strict=True)
        ]
    )
    repeats = [class_figures(terrain, each, classes) for each in predicted]
    pooled = class_figures(np.tile(terrain, len(predicted)), predicted.ravel(), classes)
    accuracies = np.array([repeat.accuracy for repeat in repeats])
    stated = confidence_figures(
        probability.max(axis=2), correct, run_id, terrain, np.random.default_rng(seed)
    )
    per_run = per_run_figures(correct, predicted[0], voted, run_id, terrain)
    accuracy_of = np.full(held_out.fold_number.shape, np.nan)
    accuracy_of[:, rows] = correct
    return {
        "classes": tuple(str(name) for name in classes),
        "n_windows": len(terrain),
        "n_runs": len(np.unique(windows.run_id[rows])),
        "repeats": len(repeats),
        "accuracy": float(accuracies.mean()),
        "accuracy_spread": float(accuracies.std(ddof=1)) if len(repeats) > 1 else None,
        "accuracy_per_repeat": tuple(accuracies.tolist()),
        "accuracy_ci": run_bootstrap(correct.mean(axis=0), run_id, terrain, np.random.default_rng(seed)),
        "balanced_accuracy": float(np.mean([repeat.balanced_accuracy for repeat in repeats])),
        "macro_f1": float(np.mean([repeat.macro_f1 for repeat in repeats])),
        "macro_run_accuracy": macro_run_accuracy(per_run),
        "per_class": pooled.per_class,
        "confusion": pooled.confusion,
        "vote_accuracy": float(np.mean(voted)),
        "vote_windows": float(np.mean([vote_sizes(each, start_s, windows.length_s) for each in segments])),
        "ece": stated.ece,
        "ece_ci": stated.ece_ci,
        "confidence_auc": stated.auc,
        "confidence_auc_ci": stated.auc_ci,
        "accuracy_at_coverage": stated.at_coverage,
        "reliability": stated.reliability,
        "per_run": per_run,
        "folds": tuple(
            FoldFigures(
                fold.repeat,
                fold.number,
                len(fold.train),
                len(fold.test),
                float(np.nanmean(accuracy_of[fold.repeat, fold.test])),
                chosen,
            )
            for fold, _, chosen, *_ in held_out.results
        ),
    }


def sets_of(held_out: HeldOut, samples: Samples, seed: int) -> ConformalFigures | None:
    """Return the figures of the sets of classes; None where a fold has no threshold."""
    if not held_out.results or any(math.isnan(result.conformal) for result in held_out.results):
        return None
    member = np.zeros(held_out.probability.shape, dtype=bool)
    for result in held_out.results:
        repeat, test = result.fold.repeat, result.fold.test
        member[repeat, test] = conformal_sets(result.probability, result.conformal)
    rows = np.flatnonzero(held_out.tested)
    terrain = samples.terrain[rows]
    run_id = runs_by_terrain(samples.run_id[rows], terrain)
    truth = np.searchsorted(held_out.classes, terrain)
    return conformal_figures(member[:, rows], truth, run_id, terrain, np.random.default_rng(seed))


def weaknesses(accuracy_ci: tuple[float, float], chance: float) -> tuple[str, ...]:
    r"""Return in sentences why a figure must not be relied on, none where it may.

    Examples
    --------
    >>> for text in weaknesses((0.31, 0.48), 0.4):
    ...     print(text.replace("\N{NO-BREAK SPACE}", " "))
    the accuracy (95 % over runs: 31.0 to 48.0 %) is not above chance,
        40.0 % (always the most frequent class)
    >>> weaknesses((0.85, 0.95), 0.4)
    ()
    """
    low, high = accuracy_ci
    found = []
    if not low > chance:
        found.append(
            f"the accuracy (95 % over runs: {interval(low, high, '.1%')}) is not above chance, "
            f"{format_value(chance, '.1%')} (always the most frequent class)"
        )
    if not high - low <= WIDE_INTERVAL:
        found.append(
            f"the interval of the accuracy is {100 * (high - low):.0f} points wide: more runs are needed to "
            "rely on it"
        )
    return tuple(found)
