"""From which rates a model takes logs: measured on windows that are held out, brought to lower rates and back.

A log of a higher rate loses nothing that the model was trained on.  One of a lower rate lacks the band above its own
Nyquist frequency: whether the features depend on it is seen on held-out windows without that band.  The lowest rate is
kept, stream by stream, down to which the accuracy, mean over the units that are held out (runs or sessions), falls by
less than :data:`MAX_DROP`, at one standard error of the paired difference.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from features.recipes import WindowPipeline, feature_matrix
from features.windows import Layout
from terrain.errors import DataError
from terrain.records import Array, Windows
from terrain.signals import resampled

RATIOS = (0.9, 0.75, 0.5, 0.25)  #: Of a model's rate, from the top, that are tried
MAX_DROP = 0.02  #: Of accuracy: as much as another deal of the folds moves it


class LowerRate(NamedTuple):
    """A rate of a stream that is tried, and the rows (n, columns) of windows that were brought to it and back."""

    stream: str
    rate_hz: float
    rows: Array


def at_lower_rates(recipe: WindowPipeline, windows: Windows) -> Iterator[LowerRate]:
    """Yield windows as a recipe's last step would take them from logs of lower rates; none without samples."""
    for stream, values in windows.values.items():
        rate_hz = windows.rate_hz[stream]
        for ratio in RATIOS:
            lower = Layout({}, {stream: ratio * rate_hz})
            try:
                n = lower.n_samples(stream, windows.length_s)
            except DataError:  # a window holds too few
                break
            low = resampled(values, rate_hz, n, ratio * rate_hz)
            again = resampled(low, ratio * rate_hz, values.shape[2], rate_hz)
            of_stream = replace(windows, values={**windows.values, stream: again})
            yield LowerRate(stream, ratio * rate_hz, feature_matrix(recipe, of_stream))


def right_at(rows: Sequence[Array], truth: Array, fitted: Any) -> Array:
    """Return which windows (rates, n) a fold's classifier has right, by their rows at each rate that is tried."""
    return np.array([np.asarray(fitted.predict(each)) == truth for each in rows]).reshape(-1, len(truth))


def least_rates(
    tried: Sequence[LowerRate], right: Array, lower_right: Array, unit: Array
) -> dict[str, float]:
    """Return the lowest rate of each stream that does not matter; of one without such a rate, none.

    Parameters
    ----------
    tried : rates, stream by stream from the top
    right, lower_right : (n,) and (rates, n) which held-out windows are right, as they are and at each rate
    unit : (n,) run or session of each window
    """
    least: dict[str, float] = {}
    stopped: set[str] = set()
    _, number = np.unique(unit.astype(str), return_inverse=True)
    n_windows = np.bincount(number)
    for (stream, rate_hz, _), lower in zip(tried, lower_right, strict=True):
        drop = np.bincount(number, right.astype(float) - lower) / n_windows
        error = drop.std(ddof=1) / math.sqrt(len(drop)) if len(drop) > 1 else math.inf
        if stream in stopped or not drop.mean() + error <= MAX_DROP:
            stopped.add(stream)
        else:
            least[stream] = rate_hz
    return least


def accepted(rate_hz: Mapping[str, float], least_hz: Mapping[str, float]) -> str:
    """Return in words from which rates logs are taken.

    Examples
    --------
    >>> accepted({"imu": 100.0, "wheels": 6.5}, {"wheels": 3.25})
    'imu from 100 Hz, wheels from 3.25 Hz'
    """
    return ", ".join(f"{name} from {least_hz.get(name, hz):.4g} Hz" for name, hz in rate_hz.items())
