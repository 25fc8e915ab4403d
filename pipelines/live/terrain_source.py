"""Sources of the current terrain: a classifier on live windows, a known terrain, or none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from features.stream import WindowStream
from pipelines.models.model_files import TerrainModel
from terrain.errors import DataError
from terrain.estimation.live.estimate import LiveEstimate
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import Array, Reading, Sample


class TerrainEstimate(NamedTuple):
    """Terrain at a time, and its probability; an empty terrain is unknown."""

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


class TerrainSource(Protocol):
    """Gives the terrain from time to time.

    ``certain``: each output is accepted at once, and holds until the next.
    """

    certain: bool

    @property
    def n_refused(self) -> int:
        """Number of windows without an output."""
        ...

    def update(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[TerrainEstimate]:
        """Take a sample and the estimates made from it; return the terrains found, in most steps none."""
        ...


class NoTerrain:
    """No source: the terrain stays unknown, and the table's fallback is used."""

    certain = False
    n_refused = 0

    def update(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[TerrainEstimate]:
        """Return nothing."""
        return []


class KnownTerrain:
    """The true terrain of the samples, at every change of it.

    Parameters
    ----------
    name_of : from the true terrain to the one that is given, to be wrong on purpose
    """

    certain = True
    n_refused = 0

    def __init__(self, name_of: Callable[[str], str] = str) -> None:
        self._name_of = name_of
        self._last = ""

    def update(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[TerrainEstimate]:
        """Return the terrain of the sample where it has changed."""
        if not sample.terrain or sample.terrain == self._last:
            return []
        self._last = sample.terrain
        return [TerrainEstimate(sample.time_s, self._name_of(sample.terrain), 1.0)]


_COMPUTED: dict[str, Callable[[LiveEstimate], Array]] = {
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
    """The output of a model for each live window, cut as the windows of its training.

    Windows hold the channels that ``pipelines.estimate.estimate.enriched`` adds to a log, computed live:
    wheel speeds beside motor rates, the estimator's states, slip, and the IMU.

    Parameters
    ----------
    model : fitted on such windows

    Attributes
    ----------
    failed : number of windows that the model refused, by error message

    Raises
    ------
    DataError
        if the model requires a stream or a channel that is not computed live.
    """

    certain = False

    def __init__(self, model: TerrainModel) -> None:
        layout = model.layout
        for stream, channels in layout.channels.items():
            lacking = sorted(set(channels) - set(_COLUMNS.get(stream, ())))
            if lacking:
                raise DataError(
                    f"the model requires {lacking[0]!r} of the stream {stream!r}, which is not computed live"
                )
        self._recipe: Any = model.recipe
        self._classes = [str(name) for name in model.recipe.classes_]
        self._stream = WindowStream(model.rule, layout)
        self._columns = {
            stream: np.array([_COLUMNS[stream].index(channel) for channel in channels])
            for stream, channels in layout.channels.items()
        }
        self.failed: Counter[str] = Counter()

    @property
    def n_refused(self) -> int:
        """Number of windows that the model refused."""
        return self.failed.total()

    def update(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[TerrainEstimate]:
        """Return the terrain of each window that is complete by now."""
        windows = []
        imu = readable(sample.readings.get("imu"), len(IMU_CHANNELS))
        if imu is not None and "imu" in self._columns:
            for time_s, values in zip(imu.time_s.tolist(), imu.values[:, self._columns["imu"]], strict=True):
                windows += self._stream.push("imu", time_s, values)
        for estimate in estimates:
            for stream, compute in _COMPUTED.items():
                if stream in self._columns:
                    values = compute(estimate)[self._columns[stream]]
                    windows += self._stream.push(stream, estimate.time_s, values)
        found: list[TerrainEstimate] = []
        for window in windows:
            try:
                probability = self._recipe.predict_proba(window)[0]
            except (ValueError, DataError) as error:  # a window of broken samples must not stop the loop
                self.failed[str(error)] += 1
                continue
            best = int(probability.argmax())
            found.append(TerrainEstimate(sample.time_s, self._classes[best], float(probability[best])))
        return found
