"""Windows to the matrix of their samples, as a scikit-learn transformer; on request beside their features."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from features.extractor import FeatureExtractor
from features.samples import columns_of, window_samples
from terrain.logs.schema import SIGNAL_SETS, UNIT_SYMBOLS, unit_of
from terrain.records import Array, Windows


class SampleExtractor(FeatureExtractor):
    """Turn windows into the matrix of their samples, with or without their features before them.

    Parameters
    ----------
    signal_sets, level_sets : as :class:`~features.extractor.FeatureExtractor`
    with_features : whether the features come before the samples

    Attributes
    ----------
    columns_ : :class:`SampleColumns` of each stream, the last columns of the matrix

    Examples
    --------
    >>> values = np.random.default_rng(0).normal(size=(3, 1, 200))
    >>> windows = Windows({"imu": values}, {"imu": ("accel_z_mps2",)}, {"imu": 100.0}, 2.0,
    ...                   np.arange(3.0), np.array(["a"] * 3), np.array(["grass"] * 3))
    >>> samples = SampleExtractor().fit(windows)
    >>> samples.columns_
    (SampleColumns(stream='imu', channels=('accel_z_mps2',), rate_hz=100.0, n_samples=200),)
    >>> samples.transform(windows).shape, SampleExtractor(with_features=True).fit_transform(windows).shape
    ((3, 200), (3, 251))
    """

    def __init__(
        self,
        signal_sets: Iterable[str] = SIGNAL_SETS,
        level_sets: Iterable[str] = (),
        with_features: bool = False,
    ) -> None:
        super().__init__(signal_sets, level_sets)
        self.with_features = with_features

    def fit(self, X: Windows, y: Any = None) -> SampleExtractor:
        """Learn which channels and rates the windows have; errors as of the features."""
        super().fit(X, y)
        self.columns_ = columns_of(self.matrix)
        return self

    def transform(self, X: Windows | Mapping[str, Array]) -> Array:
        """Return the matrix (n_windows, n_columns); errors as of the features."""
        windows = X if isinstance(X, Windows) else self._as_windows(X)
        samples = window_samples(self.matrix, windows)
        return np.concatenate([self.matrix.of(windows), samples], axis=1) if self.with_features else samples

    def get_feature_names_out(self, input_features: Any = None) -> Array:
        """Return the name of each column with its unit."""
        names = [
            f"{each.stream}.{channel.rpartition('_')[0]}.sample [{UNIT_SYMBOLS[unit_of(channel)]}]"
            for each in self.columns_
            for channel in each.channels
            for _ in range(each.n_samples)
        ]
        features = super().get_feature_names_out().tolist() if self.with_features else []
        return np.array([*features, *names], dtype=object)
