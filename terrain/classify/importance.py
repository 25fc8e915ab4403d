"""What a channel is worth to a classifier: how much balanced accuracy drops when its features are shuffled.

All features of a channel are shuffled together: a single one hardly lowers the accuracy, since the others carry
much the same information.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from sklearn.metrics import recall_score

from terrain.records import Array

N_PERMUTATIONS = 3


class ChannelImportance(NamedTuple):
    """By how much balanced accuracy drops when a channel is shuffled; ``std`` over folds."""

    feature: str
    drop: float
    std: float


def channel_of(feature: str) -> str:
    """Return the stream and channel that a feature is made of.

    Examples
    --------
    >>> channel_of("imu.accel_z.std [m/s^2]"), channel_of("wheels.log_drive_effort [log10 A m/s]")
    ('imu.accel_z', 'wheels.log_drive_effort')
    >>> channel_of("imu.gyro_x~accel_y.correlation [1]"), channel_of("roughness")
    ('imu.correlations', 'roughness')
    """
    name = feature.partition(" [")[0]
    stream, separator, rest = name.partition(".")
    channel = rest.split(".")[0]
    return f"{stream}.correlations" if "~" in channel else f"{stream}{separator}{channel}"


class ChannelDrops(NamedTuple):
    """Called with the classifier of a fold, it returns a drop a channel, means over shuffles.

    Parameters
    ----------
    features, truth : (n, f) and (n,) of the windows that the fold holds out
    channels : (f,) channel of each feature
    seed, number : of the permutations, and of the fold
    """

    features: Array
    truth: Array
    channels: Sequence[str]
    seed: int
    number: int

    def __call__(self, fitted: Any, /) -> list[float]:
        """Return the drop of each channel, in the order of their names."""
        present = np.isin(self.truth, fitted.classes_)
        test, truth = self.features[present], self.truth[present]
        labels, channels = np.unique(truth), np.array(self.channels)

        def balanced_accuracy(features: Array) -> float:
            return float(recall_score(truth, fitted.predict(features), labels=labels, average="macro"))

        baseline = balanced_accuracy(test)
        rng = np.random.default_rng((self.seed, self.number))
        drops = []
        for channel in np.unique(channels):
            columns = np.flatnonzero(channels == channel)
            scores = []
            for _ in range(N_PERMUTATIONS):
                shuffled = test.copy()
                shuffled[:, columns] = test[rng.permutation(len(test))][:, columns]
                scores.append(balanced_accuracy(shuffled))
            drops.append(float(baseline - np.mean(scores)))
        return drops


def channel_importance(
    channels: Sequence[str], drops: Sequence[Sequence[float]]
) -> tuple[ChannelImportance, ...]:
    """Return means and standard deviations over folds of their drops, the largest drop first."""
    table, names = np.array(drops), np.unique(np.array(channels))
    mean, std = table.mean(axis=0), table.std(axis=0, ddof=1)
    order = np.argsort(-mean, kind="stable")
    return tuple(ChannelImportance(str(names[i]), float(mean[i]), float(std[i])) for i in order)
