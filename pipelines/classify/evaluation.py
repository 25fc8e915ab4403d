"""Fit a classifier on every fold and pool what it says of windows it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed
from sklearn.base import BaseEstimator, clone

from pipelines.classify.metrics import (
    calibration,
    class_figures,
    per_run_figures,
    run_bootstrap,
    runs_by_terrain,
    vote,
)
from pipelines.classify.splits import Fold, Samples
from pipelines.reporting.progress import Progress, silent
from terrain.records import Array


class FoldResult(NamedTuple):
    """Held-out class probabilities of one fold."""

    fold: Fold
    probability: Array
    fit_info: dict[str, Any]


class HeldOut(NamedTuple):
    """Held-out probabilities of every repeat, ``(repeats, n_windows, k)``, and the folds they come from."""

    classes: Array
    probability: Array
    fold_number: Array
    results: list[FoldResult]


def _fit_fold(
    classifier: BaseEstimator, features: Array, y: Array, group: Array, classes: Array, fold: Fold
) -> FoldResult:
    fitted = clone(classifier).fit(features[fold.train], y[fold.train], groups=group[fold.train])
    probability = np.zeros((len(fold.test), len(classes)))
    probability[:, np.searchsorted(classes, fitted.classes_)] = fitted.predict_proba(features[fold.test])
    best = getattr(fitted, "best_", None)
    return FoldResult(fold, probability, dict(best._asdict()) if best is not None else {})


def fit_folds(
    classifier: BaseEstimator,
    features: Array,
    y: Array,
    group: Array,
    folds: Sequence[Fold],
    n_jobs: int,
    task: str,
    progress: Progress = silent,
) -> list[FoldResult]:
    """Fit a clone of the classifier on each fold and return its held-out probabilities in order.

    Parameters
    ----------
    classifier : estimator with ``fit(X, y, groups)`` and ``predict_proba``
    features : (n, f)
    y, group : (n,) class and group of each row
    folds : train and test rows
    n_jobs : processes at once
    task, progress : what to tell while it goes on
    """
    classes = np.unique(y)
    jobs = (delayed(_fit_fold)(classifier, features, y, group, classes, fold) for fold in folds)
    results = []
    progress(task, 0, len(folds))
    for result in Parallel(n_jobs=max(min(n_jobs, len(folds)), 1), return_as="generator")(jobs):
        results.append(result)
        progress(task, len(results), len(folds))
    return results


def pool(results: Sequence[FoldResult], y: Array) -> HeldOut:
    """Lay the held-out probabilities of all folds beside the windows they belong to."""
    classes = np.unique(y)
    n_repeats = 1 + max(result.fold.repeat for result in results)
    probability = np.full((n_repeats, len(y), len(classes)), np.nan)
    fold_number = np.full((n_repeats, len(y)), -1)
    for result in results:
        probability[result.fold.repeat, result.fold.test] = result.probability
        fold_number[result.fold.repeat, result.fold.test] = result.fold.number
    return HeldOut(classes, probability, fold_number, list(results))


def _segments(group: Array, fold_number: Array) -> Array:
    """Return a number for each stretch that one fold tested of one group."""
    group_of = np.unique(group.astype(str), return_inverse=True)[1]
    return np.asarray(group_of * (fold_number.max() + 1) + fold_number)


def summarise(held_out: HeldOut, samples: Samples, seed: int) -> dict[str, Any]:
    """Return every figure of a cross-validation as a dict that JSON can hold.

    Figures are means over the repeats, ``accuracy_spread`` the standard deviation over them (None with a
    single repeat); ``confusion`` and ``per_class`` count all repeats together; ``accuracy_ci`` is the
    bootstrap over runs within classes.
    """
    windows = samples.cut.windows
    y, classes = windows.terrain.astype(str), held_out.classes
    run_id = runs_by_terrain(windows.run_id.astype(str), y)
    predicted = classes[held_out.probability.argmax(axis=2)]
    correct = predicted == y
    voted = np.stack(
        [
            classes[vote(p, _segments(samples.group, number), windows.start_s, windows.length_s)]
            for p, number in zip(held_out.probability, held_out.fold_number, strict=True)
        ]
    )  # fmt: skip
    repeats = [class_figures(y, p, classes) for p in predicted]
    pooled = class_figures(np.tile(y, len(predicted)), predicted.ravel(), classes)
    accuracies = np.array([repeat["accuracy"] for repeat in repeats])
    confidence = held_out.probability.max(axis=2)
    n_windows, n_repeats = len(y), len(repeats)
    calibrated = [calibration(c, right) for c, right in zip(confidence, correct, strict=True)]
    return {
        "classes": [str(name) for name in classes],
        "n_windows": n_windows,
        "n_runs": len(np.unique(windows.run_id)),
        "repeats": n_repeats,
        "accuracy": float(accuracies.mean()),
        "accuracy_spread": float(accuracies.std(ddof=1)) if n_repeats > 1 else None,
        "accuracy_per_repeat": accuracies.tolist(),
        "accuracy_ci": list(run_bootstrap(correct.mean(axis=0), run_id, y, np.random.default_rng(seed))),
        "balanced_accuracy": float(np.mean([repeat["balanced_accuracy"] for repeat in repeats])),
        "macro_f1": float(np.mean([repeat["macro_f1"] for repeat in repeats])),
        "per_class": pooled["per_class"],
        "confusion": pooled["confusion"],
        "vote_accuracy": float(np.mean(voted == y)),
        "ece": float(np.mean([figures["ece"] for figures in calibrated])),
        "reliability": calibration(confidence.ravel(), correct.ravel())["reliability"],
        "per_run": per_run_figures(correct, predicted[0], voted == y, run_id, y),
        "folds": [
            {
                "repeat": result.fold.repeat,
                "fold": result.fold.number,
                "n_train": len(result.fold.train),
                "n_test": len(result.fold.test),
                "accuracy": float(correct[result.fold.repeat, result.fold.test].mean()),
                "chosen": result.fit_info,
            }
            for result in held_out.results
        ],
    }
