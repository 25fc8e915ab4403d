"""Who says what ground it is: a classifier on live windows, somebody who knows, or nobody."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from features.stream import WindowStream
from pipelines.models.model_files import TerrainModel
from terrain.errors import DataError
from terrain.estimation.live.estimator import LiveEstimate
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import Array, Reading, Sample


class Word(NamedTuple):
    """What was said of the ground, and with which probability; an empty terrain is doubt."""

    time_s: float
    terrain: str
    probability: float


def readable(reading: Reading | None, n_columns: int) -> Reading | None:
    """Return a reading as arrays (k,) and (k, n_columns), k at least 1; None where it is not that."""
    try:
        time_s, values = (np.asarray(part, dtype=np.float64) for part in reading or ())
    except (TypeError, ValueError):
        return None
    fits = time_s.ndim == 1 and time_s.size and values.shape == (time_s.size, n_columns)
    return Reading(time_s, values) if fits else None


class Watch(Protocol):
    """Says what the ground is, now and then; ``sure``: each word is believed at once."""

    sure: bool

    def hear(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[Word]:
        """Take what arrived and what was made of it; return what is to be said, mostly nothing."""
        ...


class Nobody:
    """Says nothing: the table's fallback stands in for every ground."""

    sure = False

    def hear(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[Word]:
        """Return nothing."""
        return []


class Told:
    """Says what somebody knows who is never in doubt, at once and at every change.

    Parameters
    ----------
    name_of : from the true ground to what is said of it, to be wrong on purpose
    """

    sure = True

    def __init__(self, name_of: Callable[[str], str] = str) -> None:
        self._name_of = name_of
        self._said = ""

    def hear(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[Word]:
        """Return the ground of the sample where it is another than before."""
        if not sample.terrain or sample.terrain == self._said:
            return []
        self._said = sample.terrain
        return [Word(sample.time_s, self._name_of(sample.terrain), 1.0)]


_MADE: dict[str, Callable[[LiveEstimate], Array]] = {
    "wheels": lambda estimate: np.concatenate(
        [estimate.motor_radps, estimate.current_a, estimate.wheel_speed_mps]
    ),
    "estimator": lambda estimate: np.array(
        [
            estimate.speed_x_mps,
            estimate.speed_y_mps,
            estimate.yaw_rate_radps,
            estimate.accel_x_mps2,
            estimate.accel_y_mps2,
        ]
    ),
    "slip": lambda estimate: estimate.slip_ratio,
}
_COLUMNS: dict[str, tuple[str, ...]] = {
    "wheels": tuple(
        f"{name.format(i)}" for name in ("motor_{}_radps", "current_{}_a", "speed_{}_mps") for i in (1, 2, 3)
    ),
    "estimator": ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2"),
    "slip": tuple(f"slip_{i}_ratio" for i in (1, 2, 3)),
    "imu": IMU_CHANNELS,
}


class Classifier:
    """Says what a model makes of each live window, cut as the model was taught.

    Windows are made of what ``pipelines.estimate.estimate.enriched`` writes into a log, live: wheel speeds
    beside motor rates, the estimator's states, slip, and the IMU.

    Parameters
    ----------
    model : fitted on such windows

    Attributes
    ----------
    failed : windows that the model refused, by why

    Raises
    ------
    DataError
        if the model wants a stream or a channel that is not made live.
    """

    sure = False

    def __init__(self, model: TerrainModel) -> None:
        layout = model.layout
        for stream, channels in layout.channels.items():
            lacking = sorted(set(channels) - set(_COLUMNS.get(stream, ())))
            if lacking:
                raise DataError(
                    f"the model wants {lacking[0]!r} of the stream {stream!r}, which is not made live"
                )
        self._recipe: Any = model.recipe
        self._classes = [str(name) for name in model.recipe.classes_]
        self._stream = WindowStream(model.rule, layout)
        self._columns = {
            stream: np.array([_COLUMNS[stream].index(channel) for channel in channels])
            for stream, channels in layout.channels.items()
        }
        self.failed: Counter[str] = Counter()

    def hear(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[Word]:
        """Return a word for each window that is complete by now."""
        windows = []
        imu = readable(sample.readings.get("imu"), len(IMU_CHANNELS))
        if imu is not None and "imu" in self._columns:
            for time_s, values in zip(imu.time_s.tolist(), imu.values[:, self._columns["imu"]], strict=True):
                windows += self._stream.push("imu", time_s, values)
        for estimate in estimates:
            for stream, made in _MADE.items():
                if stream in self._columns:
                    values = made(estimate)[self._columns[stream]]
                    windows += self._stream.push(stream, estimate.time_s, values)
        words = []
        for window in windows:
            try:
                probability = self._recipe.predict_proba(window)[0]
            except (ValueError, DataError) as error:  # a window of broken samples must not stop the robot
                self.failed[str(error)] += 1
                continue
            best = int(probability.argmax())
            words.append(Word(sample.time_s, self._classes[best], float(probability[best])))
        return words
