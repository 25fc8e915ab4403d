"""Windows to named feature vectors, as a scikit-learn transformer.

Every feature names the signal sets that it is computed from, and is left out when one of them is switched
off, so that the value of a set can be measured by switching it off.  What depends on the length of the
window or on the rate of a stream (bands, lags) is relative to that stream's own rate.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from features.matrix import FeatureMatrix, of_signal_sets
from terrain.errors import DataError
from terrain.logs.schema import SIGNAL_SETS, check_signal_sets
from terrain.records import Array, Windows


class FeatureExtractor(TransformerMixin, BaseEstimator):
    """Turn :class:`~terrain.records.Windows` into a feature matrix.

    Parameters
    ----------
    signal_sets : names out of :data:`~terrain.logs.schema.SIGNAL_SETS`; a feature is computed only when all
        sets it needs are named
    level_sets : sets of which the statistics in :data:`LEFT_OUT` are computed as well

    Attributes
    ----------
    layout_ : channels and rates that the windows must have
    length_s_ : window length
    n_samples_ : samples of each stream in a window
    features_ : list of :class:`~features.cross_channel.Feature`, one a column

    Examples
    --------
    >>> values = np.random.default_rng(0).normal(size=(3, 1, 200))
    >>> windows = Windows({"imu": values}, {"imu": ("accel_z_mps2",)}, {"imu": 100.0}, 2.0,
    ...                   np.arange(3.0), np.array(["a"] * 3), np.array(["grass"] * 3))
    >>> extractor = FeatureExtractor().fit(windows)
    >>> extractor.get_feature_names_out()[0], extractor.transform(windows).shape
    ('imu.accel_z.std [m/s^2]', (3, 51))
    """

    def __init__(
        self,
        signal_sets: Iterable[str] = SIGNAL_SETS,
        level_sets: Iterable[str] = (),
    ) -> None:
        self.signal_sets = signal_sets
        self.level_sets = level_sets

    def fit(self, X: Windows, y: Any = None) -> FeatureExtractor:
        """Learn which channels and rates the windows have, and so the names of the features.

        Raises
        ------
        ConfigError
            if a signal set is unknown.
        DataError
            if the windows have no channel of the chosen sets.
        """
        check_signal_sets((*self.signal_sets, *self.level_sets))
        matrix = of_signal_sets(X, self.signal_sets, self.level_sets)
        self.layout_, self.length_s_, self.n_samples_, _ = matrix
        self.features_ = matrix.named(X[:0])[0]
        if not self.features_:
            raise DataError(f"the windows hold no channel of the signal sets {', '.join(self.signal_sets)}")
        return self

    def transform(self, X: Windows | Mapping[str, Array]) -> Array:
        """Return the features (n_windows, n_features); NaN where a feature is not defined.

        Besides windows, plain arrays by stream ``(n_windows, n_channels, n_samples)`` are taken, with the
        channels and rates of ``fit``; this is the form in which a model server passes them.

        Raises
        ------
        DataError
            if the windows lack a channel, or have another length, rate or number of samples than those of
            ``fit``.
        """
        check_is_fitted(self)
        windows = X if isinstance(X, Windows) else self._as_windows(X)
        return self.matrix.of(windows)

    @property
    def matrix(self) -> FeatureMatrix:
        """What the features are computed from."""
        check_is_fitted(self)
        return FeatureMatrix(self.layout_, self.length_s_, self.n_samples_, tuple(self.level_sets))

    def get_feature_names_out(self, input_features: Any = None) -> Array:
        """Return the name of each column with its unit."""
        check_is_fitted(self)
        return np.array([feature.label for feature in self.features_], dtype=object)

    def _as_windows(self, arrays: Mapping[str, Array]) -> Windows:
        for stream, names in self.layout_.channels.items():
            n_samples = self.layout_.n_samples(stream, self.length_s_)
            shape = np.shape(arrays[stream]) if stream in arrays else None
            if shape is None or shape[1:] != (len(names), n_samples):
                raise DataError(
                    f"stream {stream!r} has the shape {shape}; (windows, {len(names)}, {n_samples}) is needed"
                )
        n = len(next(iter(arrays.values())))
        unknown = np.full(n, "", dtype=object)
        values = {stream: np.asarray(arrays[stream], dtype=float) for stream in self.layout_.channels}
        return Windows(
            values, self.layout_.channels, self.layout_.rate_hz, self.length_s_, np.zeros(n), unknown, unknown
        )
