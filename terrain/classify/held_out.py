"""Windows that were held out: what a classifier that is fitted on every fold makes of them, and its figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from sklearn.base import clone

from terrain.classify.conformal import LEVEL, conformal_sets, conformal_threshold, held_out_scores
from terrain.classify.folds import Fold
from terrain.classify.metrics import (
    class_figures,
    confidence_figures,
    macro_run_accuracy,
    per_run_figures,
    run_bootstrap,
    runs_by_terrain,
    vote,
    vote_sizes,
)
from terrain.errors import DataError
from terrain.records import Array, Windows


class ConformalFigures(NamedTuple):
    """What sets of classes hold, of windows whose runs were held out.

    Parameters
    ----------
    level : that they were calibrated for
    coverage, coverage_ci : fraction of windows whose set holds their class, with its 95 % interval over runs
    coverage_per_run : mean over runs of the fraction of their windows, the level's own measure
    coverage_worst_run : least of a run
    set_size : mean number of classes in a set
    single_ratio : fraction of the sets that name one class
    """

    level: float
    coverage: float
    coverage_ci: tuple[float, float]
    coverage_per_run: float
    coverage_worst_run: float
    set_size: float
    single_ratio: float


def conformal_figures(
    member: Array, class_index: Array, run_id: Array, terrain: Array, rng: np.random.Generator
) -> ConformalFigures:
    """Return the figures of sets of classes.

    Parameters
    ----------
    member : (repeats, n, k) whether a class is in the set of a window
    class_index, run_id, terrain : (n,) true class by number, run, and true class by name
    rng : draws runs for the interval

    Examples
    --------
    >>> member = np.array([[[True, False], [True, True], [True, False], [True, False]]])
    >>> found = conformal_figures(member, np.array([0, 1, 1, 0]), np.array(list("aabb")),
    ...                           np.array(["ice", "mud", "mud", "ice"]), np.random.default_rng(0))
    >>> found.coverage, found.coverage_worst_run, found.set_size, found.single_ratio
    (0.75, 0.5, 1.25, 0.75)
    """
    held = member[:, np.arange(len(class_index)), class_index].mean(axis=0)
    _, run_of = np.unique(run_id, return_inverse=True)
    per_run = np.bincount(run_of, weights=held) / np.bincount(run_of)
    sizes = member.sum(axis=2)
    return ConformalFigures(
        LEVEL,
        float(held.mean()),
        run_bootstrap(held, run_id, terrain, rng),
        float(per_run.mean()),
        float(per_run.min()),
        float(sizes.mean()),
        float((sizes == 1).mean()),
    )


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


def fit_on(classifier: Any, examples: Examples, rows: Array) -> Any:
    """Return a clone of the classifier, fitted on some rows."""
    features, terrain, group = examples
    return clone(classifier).fit(features[rows], terrain[rows], groups=group[rows])


def fit_fold(
    classifier: Any,
    examples: Examples,
    classes: Array,
    fold: Fold,
    ask: Callable[[Any], Any] | None = None,
) -> FoldResult:
    """Fit a clone of the classifier on the training rows of a fold, and apply it to its test rows.

    Parameters
    ----------
    classifier : estimator with ``fit(X, y, groups)`` and ``predict_proba``
    examples : rows that the fold numbers
    classes : (k,) of all rows, sorted
    fold : train and test rows
    ask : what is called with the fitted classifier
    """
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


def itself(fitted: Any) -> Any:
    """Return the classifier: asks a fold for it."""
    return fitted


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
    results: Sequence[FoldResult] = ()
    fitted: Any = None

    @classmethod
    def of_folds(cls, results: Sequence[FoldResult], truth: Array) -> Self:
        """Return what folds hold out together; a fold without test rows gives its classifier, if asked for it."""
        classes, fitted = np.unique(truth), [each.found for each in results if not len(each.fold.test)]
        results = [each for each in results if len(each.fold.test)]
        shape = 1 + max(result.fold.repeat for result in results), len(truth)
        probability, number = np.full((*shape, len(classes)), np.nan), np.full(shape, -1)
        for result in results:
            probability[result.fold.repeat, result.fold.test] = result.probability
            number[result.fold.repeat, result.fold.test] = result.fold.number
        return cls(classes, probability, number, truth, results, *fitted)

    @classmethod
    def of_model(cls, classes: Array, probability: Array, truth: Array) -> Self:
        """Return what a model makes (n, k) of windows that it was not trained on."""
        return cls(classes, probability[None], np.zeros((1, len(truth)), dtype=int), truth)

    @property
    def tested(self) -> Array:
        """Whether each window (n,) was held out in every repeat."""
        return np.asarray(np.isfinite(self.probability).all(axis=(0, 2)))

    @property
    def correct(self) -> Array:
        """Whether each window (repeats, n) is classified correctly; not where it was not held out."""
        held_out = np.isfinite(self.probability).all(axis=2)
        return np.asarray(held_out & (self.classes[self.probability.argmax(axis=2)] == self.truth))

    @property
    def accuracies(self) -> list[float]:
        """Part of the held-out windows that are classified correctly, repeat by repeat."""
        held_out = np.asarray(np.isfinite(self.probability).all(axis=2))
        return [float(right[rows].mean()) for right, rows in zip(self.correct, held_out, strict=True)]


class FoldFigures(NamedTuple):
    """One fold: how many windows train and test, its accuracy, and what the inner folds chose."""

    repeat: int
    fold: int
    n_train: int
    n_test: int
    accuracy: float
    chosen: Mapping[str, Any]


def held_out_figures(held_out: HeldOut, windows: Windows, group: Array, seed: int) -> dict[str, Any]:
    """Return the figures of merit of held-out windows, by name.

    Figures are means over the repeats, intervals of 95 % over runs within classes; ``per_class`` and
    ``confusion`` are of all repeats together.

    Parameters
    ----------
    held_out : probabilities of the windows
    windows : of n windows
    group : (n,) among whose windows votes are taken, as far as one fold tested them
    seed : of the bootstrap over runs
    """
    rows, classes = np.flatnonzero(held_out.tested), held_out.classes
    terrain, start_s = held_out.truth[rows], windows.start_s[rows]
    run_id = runs_by_terrain(windows.run_id.astype(str)[rows], terrain)
    probability, fold_number = held_out.probability[:, rows], held_out.fold_number[:, rows]
    predicted = classes[probability.argmax(axis=2)]
    correct = predicted == terrain
    group_of = np.unique(group.astype(str)[rows], return_inverse=True)[1]
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
    right = np.where(held_out.tested, held_out.correct, np.nan)
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
                float(np.nanmean(right[fold.repeat, fold.test])),
                chosen,
            )
            for fold, _, chosen, *_ in held_out.results
        ),
    }


def set_figures(held_out: HeldOut, windows: Windows, seed: int) -> ConformalFigures | None:
    """Return the figures of the sets of classes; None where a fold has no threshold."""
    if not held_out.results or any(math.isnan(result.conformal) for result in held_out.results):
        return None
    member = np.zeros(held_out.probability.shape, dtype=bool)
    for result in held_out.results:
        member[result.fold.repeat, result.fold.test] = conformal_sets(result.probability, result.conformal)
    rows = np.flatnonzero(held_out.tested)
    terrain = held_out.truth[rows]
    run_id = runs_by_terrain(windows.run_id.astype(str)[rows], terrain)
    truth = np.searchsorted(held_out.classes, terrain)
    return conformal_figures(member[:, rows], truth, run_id, terrain, np.random.default_rng(seed))
