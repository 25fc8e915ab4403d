"""Windows to named feature vectors, as a scikit-learn transformer.

Every feature names the signal sets that it is computed from, and is left out when one of them is switched
off, so that the value of a set can be measured by switching it off.  What depends on the length of the
window or on the rate of a stream (bands, lags) is relative to that stream's own rate.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from features.cross_channel import Feature, correlation_features, derived_channels, speed_features
from features.slip_features import SLIP_STATISTICS, slip_statistics
from features.spectral import MIN_SAMPLES, channel_spectra, spectrum_names
from features.statistics import STATISTICS, channel_statistics
from features.windows import MAX_RATE_DEVIATION, Layout
from terrain.errors import ConfigError, DataError
from terrain.logs.schema import SIGNAL_SETS, UNIT_SYMBOLS, signal_set_of, unit_of
from terrain.records import Array, Windows

LEVEL_STATISTICS = frozenset({"mean", "min", "max", "q05", "q25", "median", "q75", "q95", "rms", "mean_abs"})
"""Statistics that move with the level of a signal."""

LEFT_OUT = {
    "imu": frozenset({"mean", "median"}),
    "wheels": LEVEL_STATISTICS,
    "driving": LEVEL_STATISTICS,
}
"""Statistics that are computed only on request.  The mean of an IMU channel depends on mounting, bias and
slope, the level of a speed, measured or estimated, on how the robot was driven; neither is a property of the
terrain.  ``driving``: speeds and yaw rates among the estimator's states.
"""


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
        for name in (*self.signal_sets, *self.level_sets):
            if name not in SIGNAL_SETS:
                raise ConfigError(f"unknown signal set {name!r}; there are {', '.join(SIGNAL_SETS)}")
        channels = {
            stream: kept
            for stream, names in X.channels.items()
            if (kept := tuple(c for c in names if signal_set_of(stream, c) in set(self.signal_sets)))
        }
        self.layout_ = Layout(channels, {stream: float(X.rate_hz[stream]) for stream in channels})
        self.length_s_ = float(X.length_s)
        self.n_samples_ = {stream: int(X.values[stream].shape[2]) for stream in channels}
        self.features_ = self._extract(self._selected(X[:0]))[0]
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
        return self._extract(self._selected(windows))[1]

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

    def _selected(self, X: Windows) -> dict[str, Array]:
        if abs(X.length_s - self.length_s_) > 1e-9:
            raise DataError(
                f"windows last {X.length_s:g} s; the features were learned on {self.length_s_:g} s"
            )
        values = {}
        for stream, names in self.layout_.channels.items():
            missing = [name for name in names if name not in X.channels.get(stream, ())]
            if missing:
                raise DataError(f"stream {stream!r} lacks channel {missing[0]!r}, which the features need")
            rate_hz = X.rate_hz[stream]
            if abs(rate_hz / self.layout_.rate_hz[stream] - 1) > MAX_RATE_DEVIATION:
                raise DataError(
                    f"stream {stream!r} runs at {rate_hz:.4g} Hz; the features were learned at "
                    f"{self.layout_.rate_hz[stream]:.4g} Hz"
                )
            order = [X.channels[stream].index(name) for name in names]
            array = X.values[stream]
            if array.shape[2] != self.n_samples_[stream]:
                raise DataError(
                    f"a window holds {array.shape[2]} samples of stream {stream!r}; the features were "
                    f"learned on {self.n_samples_[stream]}"
                )
            values[stream] = array if order == list(range(array.shape[1])) else array[:, order]
        return values

    def _extract(self, values: Mapping[str, Array]) -> tuple[list[Feature], Array]:
        features: list[Feature] = []
        parts: list[Array] = []
        for stream, names in self.layout_.channels.items():
            for found, part in (
                self._channel_features(stream, values[stream], names),
                correlation_features(values[stream], names, stream),
            ):
                features += found
                parts.append(part)
        found, part = speed_features(values, self.layout_.channels) if values else ([], np.empty((0, 0)))
        return features + found, np.concatenate([*parts, part], axis=1)

    def _channel_features(
        self, stream: str, values: Array, names: tuple[str, ...]
    ) -> tuple[list[Feature], Array]:
        if stream == "slip":
            features = [
                Feature(f"slip.{name.rpartition('_')[0]}.{statistic}", "1", frozenset({"slip"}))
                for name in names
                for statistic in SLIP_STATISTICS
            ]
            return features, slip_statistics(values).reshape(len(values), len(features))
        derived, derived_names = derived_channels(values, names)
        values, names = np.concatenate([values, derived], axis=1), names + derived_names
        rate_hz = self.layout_.rate_hz[stream]
        columns, table = list(STATISTICS), channel_statistics(values, rate_hz)
        if values.shape[2] >= MIN_SAMPLES:
            columns += spectrum_names(values.shape[2])
            table = np.concatenate([table, channel_spectra(values, rate_hz)], axis=2)
        described, kept = _described(stream, tuple(names), tuple(columns), frozenset(self.level_sets))
        return list(described), table[:, kept]


@lru_cache(maxsize=256)
def _described(
    stream: str, names: tuple[str, ...], columns: tuple[tuple[str, str], ...], level_sets: frozenset[str]
) -> tuple[tuple[Feature, ...], Array]:
    """Return the features of a stream's channels, and which (channels, statistics) they are.

    They are those of every window of a model: made once, as their names cost more than their values.
    """
    features, kept = [], np.zeros((len(names), len(columns)), dtype=bool)
    for i, name in enumerate(names):
        signal_set = signal_set_of(stream, name) or ""
        driving = signal_set == "estimator" and name.startswith(("speed_", "yaw_"))
        left_out = LEFT_OUT.get("driving" if driving else signal_set, frozenset())
        unit = UNIT_SYMBOLS[unit_of(name)]
        for j, (statistic, statistic_unit) in enumerate(columns):
            if statistic in left_out and signal_set not in level_sets:
                continue
            kept[i, j] = True
            features.append(
                Feature(
                    f"{stream}.{name.rpartition('_')[0]}.{statistic}",
                    unit if statistic_unit == "x" else statistic_unit,
                    frozenset({signal_set}),
                )
            )
    kept.flags.writeable = False
    return tuple(features), kept
