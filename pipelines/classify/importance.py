"""Permutation importance of whole channels, on windows that were held out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sklearn.base import BaseEstimator

from pipelines.crossval.evaluation import Examples, fit_on
from pipelines.crossval.results import ChannelImportance
from pipelines.crossval.splits import Fold
from pipelines.learn.parallel import parallel
from pipelines.reporting.progress import Progress, silent
from terrain.records import Array

N_PERMUTATIONS = 3


def channel_of(feature: str) -> str:
    """Return the stream and channel that a feature is made of.

    Examples
    --------
    >>> channel_of("imu.accel_z.std [m/s^2]"), channel_of("wheels.log_drive_effort [log10 A m/s]")
    ('imu.accel_z', 'wheels.log_drive_effort')
    >>> channel_of("imu.gyro_x~accel_y.correlation [1]")
    'imu.correlations'
    """
    name = feature.partition(" [")[0]
    stream, channel = name.split(".")[:2]
    return f"{stream}.correlations" if "~" in channel else f"{stream}.{channel}"


def channel_importance(
    classifier: BaseEstimator,
    examples: Examples,
    names: Sequence[str],
    folds: Sequence[Fold],
    seed: int,
    n_jobs: int,
    progress: Progress = silent,
) -> tuple[ChannelImportance, ...]:
    """Return by how much balanced accuracy drops when all features of a channel are shuffled together.

    Shuffling a single feature hardly lowers it, since the features of a channel carry much the same
    information.  Each fold's classifier is tested on that fold's test windows; drops are means over folds and
    shuffles.

    Parameters
    ----------
    classifier : unfitted, with ``fit(X, y, groups)``
    examples : n rows of f features
    names : (f,) name of each feature
    folds : the folds of one repeat
    seed : of the permutations
    n_jobs : processes at once
    progress : called as folds are done

    Returns
    -------
    one a channel, the largest drop first
    """
    channels = np.array([channel_of(name) for name in names])
    drops = []
    progress("importance", 0, len(folds))
    each = ((fold, seed) for fold in folds)
    for drop in parallel(_fold_drops, (classifier, examples, channels), each, min(n_jobs, len(folds))):
        drops.append(drop)
        progress("importance", len(drops), len(folds))
    table = np.array(drops)
    unique = np.unique(channels)
    order = np.argsort(-table.mean(axis=0), kind="stable")
    return tuple(
        ChannelImportance(str(unique[i]), float(table[:, i].mean()), float(table[:, i].std(ddof=1)))
        for i in order
    )


def _fold_drops(
    classifier: BaseEstimator, examples: Examples, channels: Array, fold: Fold, seed: int
) -> list[float]:
    fitted = fit_on(classifier, examples, fold.train)
    test, truth = examples.features[fold.test], examples.terrain[fold.test]
    present = np.isin(truth, fitted.classes_)
    test, truth = test[present], truth[present]
    baseline = _balanced_accuracy(truth, fitted.predict(test))
    rng = np.random.default_rng((seed, fold.number))
    drops = []
    for channel in np.unique(channels):
        columns = np.flatnonzero(channels == channel)
        scores = []
        for _ in range(N_PERMUTATIONS):
            shuffled = test.copy()
            shuffled[:, columns] = test[rng.permutation(len(test))][:, columns]
            scores.append(_balanced_accuracy(truth, fitted.predict(shuffled)))
        drops.append(float(baseline - np.mean(scores)))
    return drops


def _balanced_accuracy(truth: Array, predicted: Array) -> float:
    """Return the mean recall of the classes that are there; a fold need not hold all that are predicted."""
    return float(np.mean([np.mean(predicted[truth == name] == name) for name in np.unique(truth)]))
