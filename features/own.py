"""A user's own functions of a window as features, in columns beside those of the package."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

from features.extractor import FeatureExtractor
from terrain.errors import ConfigError, DataError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, Windows


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """One window, as a user's own function is given it.

    Examples
    --------
    >>> window = Window({"imu": np.array([[1.0, 2.0]])}, {"imu": ("accel_z_mps2",)}, {"imu": 1.0}, 2.0)
    >>> window["imu", "accel_z_mps2"]
    array([1., 2.])
    """

    values: Mapping[str, Array]  #: per stream ``(n_channels, n_samples)``
    #: channels, rate_hz: per stream
    channels: Mapping[str, tuple[str, ...]]
    rate_hz: Mapping[str, float]
    length_s: float  #: nominal length

    def __getitem__(self, place: tuple[str, str]) -> Array:
        """Return the samples (n,) of ``stream, channel``.

        Raises
        ------
        DataError
            if there is no such channel.
        """
        stream, channel = place
        if channel not in self.channels.get(stream, ()):
            known = ", ".join(f"{name}: {' '.join(names)}" for name, names in self.channels.items())
            raise DataError(
                f"the windows have no channel {channel!r} of a stream {stream!r}; they have {known}"
            )
        samples: Array = self.values[stream][self.channels[stream].index(channel)]
        return samples


WindowFunction = Callable[[Window], float | Mapping[str, float]]
"""From a window to a number, or to several by name; NaN where it is not defined."""


class FunctionExtractor(FeatureExtractor):
    """Turn windows into features and, in the last columns, what a user's own functions give.

    Parameters
    ----------
    signal_sets, level_sets : as :class:`~features.extractor.FeatureExtractor`
    functions : each called once a window, with a :class:`Window`

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

    def __init__(
        self,
        signal_sets: Iterable[str] = SIGNAL_SETS,
        level_sets: Iterable[str] = (),
        functions: Sequence[WindowFunction] = (),
    ) -> None:
        super().__init__(signal_sets, level_sets)
        self.functions = functions

    def fit(self, X: Windows, y: Any = None) -> FunctionExtractor:
        """Learn channels and rates, and the names of what the functions give."""
        super().fit(X, y)
        self.own_names_ = tuple(self._numbers(X, 0)) if len(X) else ()
        return self

    def transform(self, X: Windows | Mapping[str, Array]) -> Array:
        """Return the matrix (n_windows, n_columns); errors as of features.

        Raises
        ------
        ConfigError
            if a function fails, or gives what is no number or has other names than in ``fit``.
        """
        windows = X if isinstance(X, Windows) else self._as_windows(X)
        own = np.empty((len(windows), len(self.own_names_)))
        for row in range(len(windows)):
            numbers = self._numbers(windows, row)
            if tuple(numbers) != self.own_names_:
                raise ConfigError(
                    f"own features of {_place(windows, row)} are {', '.join(numbers)}; those of the first "
                    f"window are {', '.join(self.own_names_)}"
                )
            own[row] = list(numbers.values())
        return np.concatenate([super().transform(windows), own], axis=1)

    def get_feature_names_out(self, input_features: Any = None) -> Array:
        """Return the name of each column, of the package's own features with the unit."""
        return np.array([*super().get_feature_names_out(), *self.own_names_], dtype=object)

    def _numbers(self, windows: Windows, row: int) -> dict[str, float]:
        """Return what all functions give for a window, by name."""
        window = Window(
            {name: values[row] for name, values in windows.values.items()},
            windows.channels,
            windows.rate_hz,
            windows.length_s,
        )
        found: dict[str, float] = {}
        for function in self.functions:
            name = str(getattr(function, "__name__", type(function).__name__))
            try:
                given = function(window)
            except Exception as error:
                raise ConfigError(
                    f"feature {name!r} fails on {_place(windows, row)}: {type(error).__name__}: {error}"
                ) from error
            if isinstance(given, Mapping):
                named = {f"{name}.{key}": value for key, value in given.items()}
            else:
                named = {name: given}
            for key, value in named.items():
                if not isinstance(value, Real | np.generic) or key in found:
                    what = "a second time" if key in found else f"{value!r} for {_place(windows, row)}"
                    raise ConfigError(f"feature {key!r} is given {what}; one number a window is needed")
                found[key] = float(value) if np.isfinite(value) else np.nan
        return found


def _place(windows: Windows, row: int) -> str:
    return f"the window of run {windows.run_id[row]} at {windows.start_s[row]:.2f} s"
