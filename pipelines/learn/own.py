"""A user's own classifier and own features: what a recipe makes of them, and how they are named."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, ClassifierMixin, clone
from sklearn.feature_selection import VarianceThreshold
from sklearn.impute import SimpleImputer
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from features.extractor import FeatureExtractor
from terrain.classify.folds import block_groups, split_runs
from terrain.classify.svm import CLIP_STD
from terrain.errors import ConfigError, DataError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, Windows

N_INNER_FOLDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """One window, as a user's own function is given it.

    Parameters
    ----------
    values : per stream ``(n_channels, n_samples)``
    channels, rate_hz : per stream
    length_s : nominal length

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


class OwnClassifier(ClassifierMixin, BaseEstimator):
    """A user's own classifier behind imputation and scaling, with probabilities whatever it gives.

    Held-out outputs of inner folds of whole runs give the thresholds of sets of classes, and, where the
    classifier has margins only, a logistic regression of the classes on these margins (Platt, 1999, for more
    than two classes).  A classifier that has neither gives its class the probability 1.

    Parameters
    ----------
    estimator : with ``fit`` and ``predict``; a clone of it is fitted
    gap : windows left out beside an inner test block, where the only run of a class is cut
    seed : deals runs into inner folds

    Attributes
    ----------
    classes_ : (k,) class names
    inner_probability_ : (n, k) of training rows when their run was held out; NaN where it never was

    Examples
    --------
    >>> from sklearn.linear_model import RidgeClassifier
    >>> rng = np.random.default_rng(0)
    >>> y = np.repeat(["ice", "mud"], 40)
    >>> X, runs = rng.normal(size=(80, 2)) + (y == "mud")[:, None], np.repeat(np.arange(8), 10)
    >>> own = OwnClassifier(RidgeClassifier()).fit(X, y, groups=runs)
    >>> own.outputs, own.predict_proba(X).shape
    ('decision_function', (80, 2))
    """

    def __init__(self, estimator: Any, gap: int = 1, seed: int = 0) -> None:
        self.estimator = estimator
        self.gap = gap
        self.seed = seed

    @property
    def outputs(self) -> str:
        """The method that probabilities come from."""
        names = ("predict_proba", "decision_function", "predict")
        return next(name for name in names if hasattr(self.estimator, name))

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> OwnClassifier:
        """Fit clones on inner folds and on all rows.

        Parameters
        ----------
        X : (n, f) features, NaN where not defined
        y : (n,) classes
        groups : (n,) run of each row; every row is its own run when missing
        """
        X, y = np.asarray(X, dtype=float), np.asarray(y)
        groups = np.arange(len(y)) if groups is None else np.asarray(groups)
        self.classes_, counts = np.unique(y, return_counts=True)
        n_groups = len(np.unique(block_groups(y, groups, N_INNER_FOLDS).astype(str)))
        n_folds = min(N_INNER_FOLDS, n_groups, counts.min())
        self.inner_probability_ = np.full((len(y), len(self.classes_)), np.nan)
        held_out: list[tuple[Array, Array]] = []
        if n_folds >= 2:
            rng = np.random.default_rng(self.seed)
            for train, test in split_runs(y, groups, n_folds, rng, self.gap):
                if np.array_equal(np.unique(y[train]), self.classes_) and len(test):
                    held_out.append((test, self._outputs(self._fitted(X[train], y[train]), X[test])))
        self.calibration_ = None
        if held_out and self.outputs == "decision_function":
            margins = np.concatenate([each for _, each in held_out])
            self.calibration_ = LogisticRegression().fit(
                margins, y[np.concatenate([rows for rows, _ in held_out])]
            )
        for rows, each in held_out:
            self.inner_probability_[rows] = self._probability(each)
        self.pipeline_ = self._fitted(X, y)
        return self

    def predict_proba(self, X: Array) -> Array:
        """Return probabilities (n, k) in the order of ``classes_``."""
        return self._probability(self._outputs(self.pipeline_, np.asarray(X, dtype=float)))

    def predict(self, X: Array) -> Array:
        """Return the class of the highest probability (n,)."""
        return np.asarray(self.classes_[self.predict_proba(X).argmax(axis=1)])

    def _fitted(self, X: Array, y: Array) -> Pipeline:
        steps = [
            ("impute", SimpleImputer(strategy="median", keep_empty_features=True)),
            ("constant", VarianceThreshold()),
            ("scale", StandardScaler()),
            ("clip", FunctionTransformer(np.clip, kw_args={"a_min": -CLIP_STD, "a_max": CLIP_STD})),
            ("classifier", clone(self.estimator)),
        ]
        return Pipeline(steps).fit(X, y)

    def _outputs(self, fitted: Pipeline, X: Array) -> Array:
        if self.outputs == "predict":
            return np.asarray(fitted.predict(X)[:, None] == self.classes_, dtype=float)
        values = np.asarray(getattr(fitted, self.outputs)(X), dtype=float)
        return values[:, None] if values.ndim == 1 else values

    def _probability(self, outputs: Array) -> Array:
        if self.outputs != "decision_function":
            return outputs
        if self.calibration_ is not None:
            return np.asarray(self.calibration_.predict_proba(outputs))
        best = outputs.argmax(axis=1) if outputs.shape[1] > 1 else (outputs[:, 0] > 0).astype(int)
        return np.asarray(best[:, None] == np.arange(len(self.classes_)), dtype=float)


def load_named(text: str) -> Any:
    """Return what ``MODULE:NAME`` names; modules of the current folder are found too.

    Raises
    ------
    ConfigError
        if the module cannot be imported, or has no such name.

    Examples
    --------
    >>> load_named("math:sqrt")(4.0)
    2.0
    >>> load_named("math:squirt")
    Traceback (most recent call last):
    terrain.errors.ConfigError: math:squirt: module 'math' has no 'squirt'
    """
    module_name, _, name = text.partition(":")
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)  # last, so that a file of the folder hides no library
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        raise ConfigError(f"{text}: module {module_name!r} cannot be imported: {error}") from error
    found = getattr(module, name, None)
    if not callable(found) and not hasattr(found, "fit"):
        raise ConfigError(f"{text}: module {module_name!r} has no {name!r}")
    return found
