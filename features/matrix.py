"""The features of windows whose channels, rates and length are known: plain arrays in, plain arrays out.

:class:`~features.extractor.FeatureExtractor` learns these from windows, as a scikit-learn transformer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from features.cross_channel import Feature, correlation_features, derived_channels, speed_features
from features.slip_features import SLIP_STATISTICS, slip_statistics
from features.spectral import MIN_SAMPLES, channel_spectra, spectrum_names
from features.statistics import STATISTICS, channel_statistics
from features.windows import MAX_RATE_DEVIATION, Layout
from terrain.errors import DataError
from terrain.logs.schema import UNIT_SYMBOLS, signal_set_of, unit_of
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


SAME_RATE = 1e-6
"""Rates that differ by less, relative to one another, give the same features but for rounding."""


class FeatureMatrix(NamedTuple):
    """What features are computed from."""

    layout: Layout  #: channels and rates of the streams that features are made of
    length_s: float  #: of a window
    n_samples: Mapping[str, int]  #: of each stream in a window
    #: signal sets of which the statistics in :data:`LEFT_OUT` are computed as well
    level_sets: tuple[str, ...] = ()

    def equals(self, other: FeatureMatrix) -> bool:
        """Whether both give the same features of a window, but for rounding."""
        own, its = ((m.layout.channels, dict(m.n_samples), m.length_s, m.level_sets) for m in (self, other))
        its_hz, rates_hz = other.layout.rate_hz, self.layout.rate_hz.items()
        return own == its and all(abs(rate / its_hz[name] - 1.0) <= SAME_RATE for name, rate in rates_hz)

    def of(self, windows: Windows) -> Array:
        """Return the features (n_windows, n_features); NaN where a feature is not defined.

        Raises
        ------
        DataError
            if the windows lack a channel, or have another length, rate or number of samples.
        """
        return self.named(windows)[1]

    def named(self, windows: Windows) -> tuple[list[Feature], Array]:
        """Return the features' names beside their values."""
        return self._extract(self.selected(windows))

    def selected(self, X: Windows) -> dict[str, Array]:
        """Return the samples of the channels that are used, by stream (n, channels, samples).

        Raises
        ------
        DataError
            as :meth:`of`.
        """
        if abs(X.length_s - self.length_s) > 1e-9:
            raise DataError(
                f"windows last {X.length_s:g} s; the features were learned on {self.length_s:g} s"
            )
        missing = [
            f"{stream}.{name}"
            for stream, names in self.layout.channels.items()
            for name in names
            if name not in X.channels.get(stream, ())
        ]
        if missing:
            raise DataError(
                f"the windows lack {', '.join(missing)}: they have {_listed(X.channels)}; the features were "
                f"learned on {_listed(self.layout.channels)}"
            )
        values = {}
        for stream, names in self.layout.channels.items():
            rate_hz = X.rate_hz[stream]
            if abs(rate_hz / self.layout.rate_hz[stream] - 1) > MAX_RATE_DEVIATION:
                raise DataError(
                    f"stream {stream!r} runs at {rate_hz:.4g} Hz; the features were learned at "
                    f"{self.layout.rate_hz[stream]:.4g} Hz"
                )
            order = [X.channels[stream].index(name) for name in names]
            array = (
                X.values[stream]
                if order == list(range(len(X.channels[stream])))
                else X.values[stream][:, order]
            )
            values[stream] = _of_length(array, self.n_samples[stream], stream)
        return values

    def _extract(self, values: Mapping[str, Array]) -> tuple[list[Feature], Array]:
        features: list[Feature] = []
        parts: list[Array] = []
        for stream, names in self.layout.channels.items():
            for found, part in (
                self._channel_features(stream, values[stream], names),
                correlation_features(values[stream], names, stream),
            ):
                features += found
                parts.append(part)
        found, part = speed_features(values, self.layout.channels) if values else ([], np.empty((0, 0)))
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
        rate_hz = self.layout.rate_hz[stream]
        columns, table = list(STATISTICS), channel_statistics(values, rate_hz)
        if values.shape[2] >= MIN_SAMPLES:
            columns += spectrum_names(values.shape[2])
            table = np.concatenate([table, channel_spectra(values, rate_hz)], axis=2)
        described, kept = _described(stream, tuple(names), tuple(columns), frozenset(self.level_sets))
        return list(described), table[:, kept]


def _listed(channels: Mapping[str, tuple[str, ...]]) -> str:
    return (
        "; ".join(f"{stream} with {', '.join(names)}" for stream, names in channels.items()) or "no channel"
    )


def _of_length(values: Array, n: int, stream: str) -> Array:
    """Return the first n samples of windows; where their own set of runs gave a few less, the last are mirrored.

    The number of samples follows the rate that was measured of a set of runs, which the next set's differs from
    by a little.
    """
    held = values.shape[2]
    if held == n:
        return values
    if abs(held - n) > MAX_RATE_DEVIATION * n + 1:
        raise DataError(
            f"a window holds {held} samples of stream {stream!r}; the features were learned on {n}"
        )
    return np.asarray(np.take(values, held - 1 - np.abs(held - 1 - np.arange(n)), axis=2))


def of_signal_sets(windows: Windows, signal_sets: Iterable[str], level_sets: Iterable[str]) -> FeatureMatrix:
    """Return what the features of some signal sets are computed from, for windows like these.

    Parameters
    ----------
    windows : any number of them, also none
    signal_sets : whose channels are used
    level_sets : as :class:`FeatureMatrix`
    """
    chosen = set(signal_sets)
    channels = {
        stream: kept
        for stream, names in windows.channels.items()
        if (kept := tuple(name for name in names if signal_set_of(stream, name) in chosen))
    }
    return FeatureMatrix(
        Layout(channels, {stream: float(windows.rate_hz[stream]) for stream in channels}),
        float(windows.length_s),
        {stream: int(windows.values[stream].shape[2]) for stream in channels},
        tuple(level_sets),
    )


def left_out_of(signal_set: str, channel: str) -> frozenset[str]:
    """Return the statistics of a channel that are computed on request only."""
    driving = signal_set == "estimator" and channel.startswith(("speed_", "yaw_"))
    return LEFT_OUT.get("driving" if driving else signal_set, frozenset())


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
        left_out = left_out_of(signal_set, name)
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
