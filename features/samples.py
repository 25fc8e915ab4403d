"""The samples of windows as a matrix, for classifiers that find their own features."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from features.matrix import FeatureMatrix, left_out_of
from terrain.classify.network import SampleColumns
from terrain.logs.schema import signal_set_of
from terrain.records import Array, Windows


def columns_of(matrix: FeatureMatrix) -> tuple[SampleColumns, ...]:
    """Return what the columns of :func:`window_samples` are."""
    layout = matrix.layout
    return tuple(
        SampleColumns(stream, names, float(layout.rate_hz[stream]), matrix.n_samples[stream])
        for stream, names in layout.channels.items()
    )


def window_samples(matrix: FeatureMatrix, windows: Windows) -> Array:
    """Return the samples (n_windows, n_columns) of all channels, stream by stream.

    The mean over the window is subtracted from those channels of which it is no feature either
    (:data:`features.matrix.LEFT_OUT`): what depends on mounting, slope, or on how the robot was driven.

    Raises
    ------
    DataError
        if the windows lack a channel, or have another length, rate or number of samples.
    """
    parts = []
    for stream, values in matrix.selected(windows).items():
        names = matrix.layout.channels[stream]
        centred = np.array([is_centred(stream, name, matrix.level_sets) for name in names])[:, None]
        mean = np.where(centred, values.mean(axis=2, keepdims=True), 0.0)
        parts.append((values - mean).reshape(len(values), -1))
    return np.concatenate(parts, axis=1)


def is_centred(stream: str, channel: str, level_sets: Iterable[str]) -> bool:
    """Return whether the mean over the window is subtracted from a channel."""
    signals = signal_set_of(stream, channel) or ""
    return left_out_of(signals, channel) != frozenset() and signals not in level_sets
