"""Windows to named feature vectors, as scikit-learn transformers: features, samples, and a user's own functions.

Every feature names the signal sets that it is computed from, and is left out when one of them is switched
off, so that the value of a set can be measured by switching it off.  What depends on the length of the
window or on the rate of a stream (bands, lags) is relative to that stream's own rate.

Beside the statistics of each channel there are features of several: norms of vectors, totals, left against right, per
speed.  Symbols: v the mean speed of the faster wheel over the window (not under ``MIN_SPEED_MPS``), I a motor
current, d = v_right - v_left, w the yaw rate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from features.statistics import (
    MIN_SAMPLES,
    SLIP_STATISTICS,
    STATISTICS,
    channel_correlations,
    channel_spectra,
    channel_statistics,
    slip_statistics,
    spectrum_names,
)
from features.windows import MAX_RATE_DEVIATION, Layout, left_right, rows_of, wheel_stream
from terrain.errors import ConfigError, DataError
from terrain.logs.schema import SIGNAL_SETS, UNIT_SYMBOLS, check_signal_sets, signal_set_of, unit_of
from terrain.records import Array, Windows

#: Statistics that move with the level of a signal.
LEVEL_STATISTICS = frozenset({"mean", "min", "max", "q05", "q25", "median", "q75", "q95", "rms", "mean_abs"})
#: Statistics that are computed only on request. The mean of an IMU channel depends on mounting, bias and slope, the
#: level of a speed, measured or estimated, on how the robot was driven; neither is a property of the terrain.
#: ``driving``: speeds and yaw rates among the estimator's states.
LEFT_OUT = {
    "imu": frozenset({"mean", "median"}),
    "wheels": LEVEL_STATISTICS,
    "driving": LEVEL_STATISTICS,
}
#: Rates that differ by less, relative to one another, give the same features but for rounding.
SAME_RATE = 1e-6
MIN_SPEED_MPS = 0.05  #: Division by speed stops here: below it a wheel reading is mostly quantisation.
#: A smaller wheel difference (rms) does not count as a turn; the yaw rate per wheel difference is NaN.
MIN_WHEEL_DIFFERENCE_MPS = 0.03
N_PARTS = 8  #: Parts of a window over which wheel difference and yaw rate are averaged.
_LOG_FLOOR = 1e-4


class Feature(NamedTuple):
    """Name and unit of a feature, and the signal sets it is computed from."""

    name: str
    unit: str
    sets: frozenset[str]


def derived_channels(values: Array, channels: Sequence[str]) -> tuple[Array, tuple[str, ...]]:
    """Return norms of vectors, and total and difference of currents, as further channels with their names.

    ``gyro_norm`` and ``accel_norm`` do not change when the sensor is mounted turned; the difference of
    the currents is right minus left, or largest minus smallest where there are not just these two.
    """
    derived: list[Array] = [np.empty((values.shape[0], 0, values.shape[2]))]
    names: list[str] = []
    for quantity in ("gyro", "accel"):
        rows = rows_of(channels, quantity)
        if len(rows) > 1:
            derived.append(np.sqrt(np.sum(values[:, rows] ** 2, axis=1))[:, None])
            names.append(f"{quantity}_norm_{unit_of(channels[rows[0]])}")
    rows = rows_of(channels, "current")
    if len(rows) > 1:
        current, sides = values[:, rows], left_right(channels, "current")
        apart = values[:, sides[1]] - values[:, sides[0]] if sides else np.ptp(current, axis=1)
        derived += [current.sum(axis=1)[:, None], apart[:, None]]
        names += ["current_total_a", "current_difference_a"]
    return np.concatenate(derived, axis=1), tuple(names)


def speed_features(
    values: Mapping[str, Array], channels: Mapping[str, Sequence[str]]
) -> tuple[list[Feature], Array]:
    """Return currents, vibration and yaw rate per wheel speed, (n_windows, n_features); none without wheel speeds.

    ``current_per_speed = mean(I) / v``, ``log_drive_effort = log10 mean |sum I v_wheel|``,
    ``log_std_per_speed = log10(std / v)`` of each IMU channel, and the turning-slip measure
    ``yaw_per_wheel_difference = sum(w d) / sum(d d)``, which is one over the track width for wheels
    that do not slip and less the more they do; NaN where the robot does not turn.  The means of w and d
    are taken in eight equal parts of the window, since the two streams have different rates, or in as many
    as the slower stream has samples.
    """
    wheel, n = wheel_stream(channels), len(next(iter(values.values())))
    features: list[Feature] = []
    columns: list[Array] = []
    if wheel is None:
        return features, np.empty((n, 0))

    def add(column: Array, name: str, unit: str, *sets: str) -> None:
        features.append(Feature(name, unit, frozenset(sets)))
        columns.append(column)

    wheels, wheel_channels = values[wheel], channels[wheel]
    speeds = wheels[:, rows_of(wheel_channels, "speed")]
    fastest_mps = np.maximum(np.abs(speeds).mean(axis=2).max(axis=1), MIN_SPEED_MPS)
    current_rows = rows_of(wheel_channels, "current")
    for i in current_rows:
        name = f"{wheel}.{wheel_channels[i].rpartition('_')[0]}.per_speed"
        add(wheels[:, i].mean(axis=1) / fastest_mps, name, "A s/m", "currents", "wheels")
    if current_rows and len(current_rows) == speeds.shape[1]:
        effort = np.abs(np.sum(wheels[:, current_rows] * speeds, axis=1)).mean(axis=1)
        name = f"{wheel}.log_drive_effort"
        add(np.log10(effort + _LOG_FLOOR), name, "log10 A m/s", "currents", "wheels")
    for stream, names in channels.items():
        for i in rows_of(names, "gyro") + rows_of(names, "accel"):
            if signal_set_of(stream, names[i]) == "imu":
                std = values[stream][:, i].std(axis=1) + _LOG_FLOOR
                name = f"{stream}.{names[i].rpartition('_')[0]}.log_std_per_speed"
                unit = f"log10 ({UNIT_SYMBOLS[unit_of(names[i])]})/(m/s)"
                add(np.log10(std / fastest_mps), name, unit, "imu", "wheels")
    sides = left_right(wheel_channels, "speed")
    yaw_stream = next((stream for stream, names in channels.items() if "gyro_z_radps" in names), None)
    if sides and yaw_stream:
        turning_mps = wheels[:, sides[1]] - wheels[:, sides[0]]
        gyro = values[yaw_stream][:, channels[yaw_stream].index("gyro_z_radps")]
        n_parts, means = min(N_PARTS, turning_mps.shape[1], gyro.shape[1]), []
        for signal in (turning_mps, gyro):
            edges = np.linspace(0, signal.shape[1], n_parts + 1).round().astype(int)
            means.append(np.add.reduceat(signal, edges[:-1], axis=1) / np.diff(edges))
        difference, yaw_rate = means
        power = np.sum(difference**2, axis=1)
        gain = np.full(n, np.nan)
        turning = np.sqrt(power / difference.shape[1]) >= MIN_WHEEL_DIFFERENCE_MPS
        np.divide(np.sum(yaw_rate * difference, axis=1), power, out=gain, where=turning)
        add(gain, "turning.yaw_per_wheel_difference", "rad/m", "imu", "wheels")
    return features, np.stack(columns, axis=1) if columns else np.empty((n, 0))


def slip_features(
    values: Mapping[str, Array], channels: Mapping[str, Sequence[str]]
) -> tuple[list[Feature], Array]:
    """Return how far wheels slip that drive and that brake, (n_windows, n_features); none without their slip and speed.

    With the mean slip s_i of a wheel, positive where it drives ahead or back, ``traction = max_i s_i``, ``braking =
    min_i s_i``, and ``scatter`` is the root mean square of the wheels' standard deviations: in a curve the outer wheels
    of a skid-steer robot drive and the inner ones brake, so that these do not depend on the side.
    """
    wheel, n = wheel_stream(channels), len(next(iter(values.values())))
    speeds = [] if wheel is None else list(channels[wheel])
    names = [name[5:-6] for name in channels.get("slip", ()) if f"speed_{name[5:-6]}_mps" in speeds]
    if wheel is None or not names:
        return [], np.empty((n, 0))
    turning = values[wheel][:, [speeds.index(f"speed_{name}_mps") for name in names]].mean(axis=2)
    rows = [channels["slip"].index(f"slip_{name}_ratio") for name in names]
    mean, std = slip_statistics(values["slip"][:, rows])[:, :, :2].transpose(2, 0, 1)
    driven = np.where(turning < 0.0, -mean, mean)
    some = np.isfinite(driven).any(axis=1)
    table = np.full((n, 3), np.nan)
    table[some] = np.column_stack(
        [
            np.nanmax(driven[some], axis=1),
            np.nanmin(driven[some], axis=1),
            np.sqrt(np.nanmean(std[some] ** 2, axis=1)),
        ]
    )
    sets = frozenset({"slip", "wheels"})
    return [Feature(f"slip.{name}", "1", sets) for name in ("traction", "braking", "scatter")], table


def left_out_of(stream: str, channel: str) -> frozenset[str]:
    """Return the statistics of a channel that are computed on request only."""
    signal_set = signal_set_of(stream, channel) or ""
    driving = signal_set == "estimator" and channel.startswith(("speed_", "yaw_"))
    return LEFT_OUT.get("driving" if driving else signal_set, frozenset())


def is_centred(stream: str, channel: str, level_sets: Iterable[str]) -> bool:
    """Return whether the mean over the window is subtracted from the samples of a channel: where it is no feature.

    That is what depends on mounting, slope, or on how the robot was driven (:data:`LEFT_OUT`).
    """
    return (
        left_out_of(stream, channel) != frozenset()
        and (signal_set_of(stream, channel) or "") not in level_sets
    )


@lru_cache(maxsize=256)
def _pairs(stream: str, channels: tuple[str, ...], signal_set: str) -> tuple[Feature, ...]:
    pairs = combinations([channel.rpartition("_")[0] for channel in channels], 2)
    return tuple(Feature(f"{stream}.{a}~{b}.correlation", "1", frozenset({signal_set})) for a, b in pairs)


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
        left_out, unit = left_out_of(stream, name), UNIT_SYMBOLS[unit_of(name)]
        for j, (statistic, of) in enumerate(columns):
            if statistic not in left_out or signal_set in level_sets:
                kept[i, j] = True
                named = f"{stream}.{name.rpartition('_')[0]}.{statistic}"
                features.append(Feature(named, unit if of == "x" else of, frozenset({signal_set})))
    kept.flags.writeable = False
    return tuple(features), kept


@dataclass(eq=False, repr=False)
class FeatureExtractor(TransformerMixin, BaseEstimator):
    """Turn :class:`~terrain.records.Windows` into a feature matrix.

    Attributes
    ----------
    layout_, length_s_, n_samples_ : channels, rates, length and samples that the windows must have
    features_ : list of :class:`Feature`, one a column

    Examples
    --------
    >>> values = np.random.default_rng(0).normal(size=(3, 1, 200))
    >>> windows = Windows({"imu": values}, {"imu": ("accel_z_mps2",)}, {"imu": 100.0}, 2.0,
    ...                   np.arange(3.0), np.array(["a"] * 3), np.array(["grass"] * 3))
    >>> extractor = FeatureExtractor().fit(windows)
    >>> extractor.get_feature_names_out()[0], extractor.transform(windows).shape
    ('imu.accel_z.std [m/s^2]', (3, 51))
    """

    #: names out of :data:`~terrain.logs.schema.SIGNAL_SETS`; a feature is computed only when all sets it needs are
    #: named
    signal_sets: Iterable[str] = SIGNAL_SETS
    level_sets: Iterable[str] = ()  #: sets of which the statistics in :data:`LEFT_OUT` are computed as well

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
        chosen = set(self.signal_sets)
        channels = {
            stream: kept
            for stream, names in X.channels.items()
            if (kept := tuple(name for name in names if signal_set_of(stream, name) in chosen))
        }
        self.layout_ = Layout(channels, {stream: float(X.rate_hz[stream]) for stream in channels})
        self.length_s_ = float(X.length_s)
        self.n_samples_ = {stream: int(X.values[stream].shape[2]) for stream in channels}
        self.features_ = self.named(X[:0])[0]
        if not self.features_:
            raise DataError(f"the windows hold no channel of the signal sets {', '.join(self.signal_sets)}")
        return self

    def features_of(self, windows: Windows) -> Array:
        """Return the features (n_windows, n_features), NaN where not defined.

        ``DataError`` where the windows are of another kind than those of ``fit``.
        """
        return self.named(windows)[1]

    def transform(self, X: Windows) -> Array:
        """Return the matrix (n_windows, n_columns) that the last step takes; errors as of features."""
        return self.matrix(X, self.features_of(X) if self.uses_features else np.empty((len(X), 0)))

    @property
    def uses_features(self) -> bool:
        """Whether the matrix holds the features."""
        return True

    def matrix(self, windows: Windows, features: Array) -> Array:
        """Return the matrix of windows whose features are known: these; of a subclass, more or other columns."""
        return features

    def equals(self, other: FeatureExtractor) -> bool:
        """Whether both give the same features of a window, but for rounding."""
        own, its = (
            (m.layout_.channels, dict(m.n_samples_), m.length_s_, tuple(m.level_sets)) for m in (self, other)
        )
        its_hz, rates_hz = other.layout_.rate_hz, self.layout_.rate_hz.items()
        return own == its and all(abs(rate / its_hz[name] - 1.0) <= SAME_RATE for name, rate in rates_hz)

    def named(self, windows: Windows) -> tuple[list[Feature], Array]:
        """Return the features beside their values."""
        selected, features, parts = self.selected(windows), list[Feature](), [np.empty((len(windows), 0))]
        for stream, names in self.layout_.channels.items():
            values, rate_hz = selected[stream], self.layout_.rate_hz[stream]
            if stream == "slip":
                all_names, columns, table = names, SLIP_STATISTICS, slip_statistics(values)
            else:
                derived, derived_names = derived_channels(values, names)
                all_names, all_values = (*names, *derived_names), np.concatenate([values, derived], axis=1)
                columns, table = STATISTICS, channel_statistics(all_values, rate_hz)
                if values.shape[2] >= MIN_SAMPLES:
                    columns = (*columns, *spectrum_names(values.shape[2]))
                    table = np.concatenate([table, channel_spectra(all_values, rate_hz)], axis=2)
            of_channels, kept = _described(stream, all_names, columns, frozenset(self.level_sets))
            features += of_channels
            parts.append(table[:, kept])
            for quantities, signal_set in ((("gyro", "accel"), "imu"), (("current",), "currents")):
                rows = [i for quantity in quantities for i in rows_of(names, quantity)]
                parts.append(channel_correlations(values[:, rows]))
                features += _pairs(stream, tuple(names[i] for i in rows), signal_set)
        if selected:
            for derive in (speed_features, slip_features):
                derived_features, table = derive(selected, self.layout_.channels)
                features += derived_features
                parts.append(table)
        return features, np.concatenate(parts, axis=1)

    def selected(self, X: Windows) -> dict[str, Array]:
        """Return the samples of the channels that are used, by stream (n, channels, samples).

        ``DataError`` where the windows lack a channel, or have another length, rate or number of samples.
        """
        check_is_fitted(self)
        if abs(X.length_s - self.length_s_) > 1e-9:
            raise DataError(
                f"windows last {X.length_s:g} s; the features were learned on {self.length_s_:g} s"
            )
        own = self.layout_.channels.items()
        missing = [f"{s}.{name}" for s, names in own for name in names if name not in X.channels.get(s, ())]
        if missing:
            listed = (
                "; ".join(f"{stream} with {', '.join(names)}" for stream, names in channels.items())
                for channels in (X.channels, self.layout_.channels)
            )
            has, needed = (each or "no channel" for each in listed)
            raise DataError(
                f"the windows lack {', '.join(missing)}: they have {has}; the features were learned on {needed}"
            )
        values = {}
        for stream, names in self.layout_.channels.items():
            rate_hz, n = X.rate_hz[stream], self.n_samples_[stream]
            array, held = X.values[stream], X.values[stream].shape[2]
            if abs(rate_hz / self.layout_.rate_hz[stream] - 1) > MAX_RATE_DEVIATION:
                raise DataError(
                    f"stream {stream!r} runs at {rate_hz:.4g} Hz; the features were learned at "
                    f"{self.layout_.rate_hz[stream]:.4g} Hz"
                )
            if abs(held - n) > MAX_RATE_DEVIATION * n + 1:
                raise DataError(
                    f"a window holds {held} samples of stream {stream!r}; the features were learned on {n}"
                )
            if names != tuple(X.channels[stream]):
                array = array[:, [X.channels[stream].index(name) for name in names]]
            # The number of samples follows the rate that was measured of a set of runs, from which the next set's
            # differs by a little: where it gives a few less, the last ones are mirrored.
            mirrored = held - 1 - np.abs(held - 1 - np.arange(n))
            values[stream] = array if held == n else np.take(array, mirrored, axis=2)
        return values

    def get_feature_names_out(self, input_features: Any = None) -> Array:
        """Return the name of each column with its unit."""
        check_is_fitted(self)
        return np.array([f"{name} [{unit}]" for name, unit, _ in self.features_], dtype=object)


class PlainExtractor(FeatureExtractor):
    """Turn windows into mean and standard deviation of each channel, and nothing else: what a baseline has.

    Examples
    --------
    >>> windows = Windows({"imu": np.array([[[1.0, 5.0]]])}, {"imu": ("accel_z_mps2",)}, {"imu": 1.0}, 2.0,
    ...                   np.zeros(1), np.array(["a"]), np.array(["grass"]))
    >>> PlainExtractor().fit_transform(windows)
    array([[3., 2.]])
    """

    def named(self, windows: Windows) -> tuple[list[Feature], Array]:
        """Return these features beside their values; NaN where a sample is."""
        features, parts = list[Feature](), [np.empty((len(windows), 0))]
        for stream, values in self.selected(windows).items():
            names = self.layout_.channels[stream]
            for name, table in (("mean", values.mean(axis=2)), ("std", values.std(axis=2))):
                features += _described(stream, names, ((name, "x"),), frozenset(SIGNAL_SETS))[0]
                parts.append(table)
        return features, np.concatenate(parts, axis=1)


@dataclass(eq=False, repr=False)
class SampleExtractor(FeatureExtractor):
    """Turn windows into the matrix of their samples, with or without their features before them.

    Attributes
    ----------
    columns_ : :class:`~terrain.classify.network.SampleColumns` of each stream, the last columns of the matrix

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

    with_features: bool = False

    def fit(self, X: Windows, y: Any = None) -> SampleExtractor:
        """Learn which channels and rates the windows have; errors as of the features."""
        from terrain.classify.network import SampleColumns

        super().fit(X, y)
        rates_hz, n_samples = self.layout_.rate_hz, self.n_samples_
        self.columns_ = tuple(
            SampleColumns(stream, names, rates_hz[stream], n_samples[stream])
            for stream, names in self.layout_.channels.items()
        )
        return self

    @property
    def uses_features(self) -> bool:
        """Whether the matrix holds the features, as it was asked to."""
        return self.with_features

    def matrix(self, windows: Windows, features: Array) -> Array:
        """Return the samples, centred where they must be, after the features where they are asked for."""
        parts = [features] if self.with_features else []
        for stream, values in self.selected(windows).items():
            names = self.layout_.channels[stream]
            centred = np.array([is_centred(stream, name, self.level_sets) for name in names])[:, None]
            mean = np.where(centred, values.mean(axis=2, keepdims=True), 0.0)
            parts.append((values - mean).reshape(len(values), -1))
        return np.concatenate(parts, axis=1)

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


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """One window, as a user's own function is given it: values per stream ``(n_channels, n_samples)``.

    Examples
    --------
    >>> window = Window({"imu": np.array([[1.0, 2.0]])}, {"imu": ("accel_z_mps2",)}, {"imu": 1.0}, 2.0)
    >>> window["imu", "accel_z_mps2"]
    array([1., 2.])
    """

    values: Mapping[str, Array]
    channels: Mapping[str, tuple[str, ...]]
    rate_hz: Mapping[str, float]
    length_s: float

    def __getitem__(self, place: tuple[str, str]) -> Array:
        """Return the samples (n,) of ``stream, channel``; ``DataError`` where there is no such channel."""
        stream, channel = place
        if channel not in self.channels.get(stream, ()):
            known = ", ".join(f"{name}: {' '.join(names)}" for name, names in self.channels.items())
            raise DataError(
                f"the windows have no channel {channel!r} of a stream {stream!r}; they have {known}"
            )
        samples: Array = self.values[stream][self.channels[stream].index(channel)]
        return samples


#: From a window to a number, or to several by name; NaN where it is not defined.
WindowFunction = Callable[[Window], float | Mapping[str, float]]


def function_name(function: WindowFunction) -> str:
    """Return the name of a function, or of the class of an object that is called as one."""
    return str(getattr(function, "__name__", type(function).__name__))


@dataclass(eq=False, repr=False)
class FunctionExtractor(FeatureExtractor):
    """Turn windows into features and, in the last columns, what a user's own functions give for each window.

    Attributes
    ----------
    own_names_ : names of the last columns

    Examples
    --------
    >>> def roughness(window):
    ...     return np.abs(np.diff(window["imu", "accel_z_mps2"])).mean()
    >>> windows = Windows({"imu": np.zeros((3, 1, 200))}, {"imu": ("accel_z_mps2",)}, {"imu": 100.0}, 2.0,
    ...                   np.arange(3.0), np.array(["a"] * 3), np.array(["grass"] * 3))
    >>> extractor = FunctionExtractor(functions=(roughness,)).fit(windows)
    >>> extractor.transform(windows).shape, str(extractor.get_feature_names_out()[-1])
    ((3, 52), 'roughness')
    """

    functions: Sequence[WindowFunction] = ()

    def fit(self, X: Windows, y: Any = None) -> FunctionExtractor:
        """Learn channels and rates, and the names of what the functions give."""
        super().fit(X, y)
        self.own_names_ = tuple(self._numbers(X, 0)[1]) if len(X) else ()
        return self

    def matrix(self, windows: Windows, features: Array) -> Array:
        """Return the features, and in the last columns the own ones.

        ``ConfigError`` where a function fails, or gives what is no number or has other names than in ``fit``.
        """
        own = np.empty((len(windows), len(self.own_names_)))
        for row in range(len(windows)):
            place, numbers = self._numbers(windows, row)
            if tuple(numbers) != self.own_names_:
                raise ConfigError(
                    f"own features of {place} are {', '.join(numbers)}; those of the first window are "
                    f"{', '.join(self.own_names_)}"
                )
            own[row] = list(numbers.values())
        return np.concatenate([features, own], axis=1)

    def get_feature_names_out(self, input_features: Any = None) -> Array:
        """Return the name of each column, of the package's own features with the unit."""
        return np.array([*super().get_feature_names_out(), *self.own_names_], dtype=object)

    def _numbers(self, windows: Windows, row: int) -> tuple[str, dict[str, float]]:
        """Return a window's place in words, and what all functions give for it, by name."""
        values = {name: values[row] for name, values in windows.values.items()}
        window = Window(values, windows.channels, windows.rate_hz, windows.length_s)
        place = f"the window of run {windows.run_id[row]} at {windows.start_s[row]:.2f} s"
        numbers: dict[str, float] = {}
        for function in self.functions:
            name = function_name(function)
            try:
                given = function(window)
            except Exception as error:
                raise ConfigError(
                    f"feature {name!r} fails on {place}: {type(error).__name__}: {error}"
                ) from error
            several = isinstance(given, Mapping)
            for key, value in given.items() if isinstance(given, Mapping) else [(name, given)]:
                key = f"{name}.{key}" if several else key
                if not isinstance(value, Real | np.generic) or key in numbers:
                    what = "a second time" if key in numbers else f"{value!r} for {place}"
                    raise ConfigError(f"feature {key!r} is given {what}; one number a window is needed")
                numbers[key] = float(value) if np.isfinite(value) else np.nan
        return place, numbers
