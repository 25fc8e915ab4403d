"""What arrives from a robot in messages: rows that are queued until a step, and whether streams come."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from terrain.records import Array, Reading

MAX_QUEUED = 20_000
"""Rows of a stream that wait for a step: some seconds at a kilohertz; of more, the oldest are left out."""

LOST_AFTER_S, PERIODS = 0.5, 3.0
"""A stream that gives nothing for so long is lost; of one that is slower, so many of its periods."""


class Inbox:
    """Queue rows of streams, in the order in which they come.

    Parameters
    ----------
    channels : number of columns by stream

    Attributes
    ----------
    received : rows taken, by stream
    refused : rows or readings that were not taken, by reason

    Examples
    --------
    >>> inbox = Inbox({"imu": 2})
    >>> inbox.put("imu", [0.0, 0.01], [[1.0, 2.0], [3.0, None]])
    0.01
    >>> inbox.take()["imu"].values.tolist()
    [[1.0, 2.0], [3.0, nan]]
    >>> inbox.put("imu", [0.0], [[1.0]]), dict(inbox.refused)
    (None, {'imu: not rows of 2 numbers': 1})
    """

    def __init__(self, channels: Mapping[str, int]) -> None:
        self._n_columns = dict(channels)
        self._queued: dict[str, list[Reading]] = {name: [] for name in channels}
        self._n_queued = dict.fromkeys(channels, 0)
        self.received: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()

    def put(self, stream: str, time_s: Any, values: Any) -> float | None:
        """Queue rows; return their newest stamp, or None where they were refused and counted."""
        n_columns = self._n_columns.get(stream)
        if n_columns is None:
            self.refused["stream that was not announced"] += 1
            return None
        stamps, rows = as_numbers(time_s), as_numbers(values)
        if stamps is None or rows is None or rows.shape != (stamps.size, n_columns) or stamps.ndim != 1:
            self.refused[f"{stream}: not rows of {n_columns} numbers"] += 1
            return None
        if not stamps.size:
            return None
        queued = self._queued[stream]
        queued.append(Reading(stamps, rows))
        self.received[stream] += stamps.size
        self._n_queued[stream] += stamps.size
        while self._n_queued[stream] > MAX_QUEUED and len(queued) > 1:
            n = queued.pop(0).time_s.size
            self._n_queued[stream] -= n
            self.refused[f"{stream}: too many wait"] += n
        finite = stamps[np.isfinite(stamps)]
        return float(finite.max()) if finite.size else None

    def take(self) -> dict[str, Reading]:
        """Return what is queued, as one reading a stream, and empty the queue."""
        found = {}
        for stream, queued in self._queued.items():
            if queued:
                found[stream] = (
                    Reading(*map(np.concatenate, zip(*queued, strict=True))) if queued[1:] else queued[0]
                )
                self._queued[stream], self._n_queued[stream] = [], 0
        return found


def as_numbers(given: Any) -> Array | None:
    """Return numbers as an array of floats, NaN for None; None where anything else is among them.

    Examples
    --------
    >>> as_numbers([1, None]), as_numbers(["1"]), as_numbers([True])
    (array([ 1., nan]), None, None)
    """
    if not isinstance(given, Sequence | np.ndarray) or isinstance(given, str | bytes):
        return None
    try:
        array = np.asarray(given)
        if array.dtype.kind in "fiu":
            return array.astype(np.float64, copy=False)
        if array.dtype.kind != "O" or not all(map(_is_number, array.ravel().tolist())):
            return np.empty(array.shape) if array.size == 0 else None
        return array.astype(np.float64)
    except (TypeError, ValueError, OverflowError, RecursionError, MemoryError):
        return None


def _is_number(value: Any) -> bool:
    return value is None or (type(value) is float) or (type(value) is int and abs(value) < 2**63)


class StreamHealth:
    """Judge whether each stream comes, and keep its last values.

    Parameters
    ----------
    channels : by stream

    Examples
    --------
    >>> health = StreamHealth({"imu": ("gyro_z_radps",)})
    >>> health.take({"imu": Reading(np.array([1.0]), np.array([[0.1]]))}, 1.0)
    >>> health.health(1.2), health.health(2.0)
    ({'imu': 'fresh'}, {'imu': 'lost'})
    """

    def __init__(self, channels: Mapping[str, Sequence[str]]) -> None:
        self._channels = {stream: tuple(names) for stream, names in channels.items()}
        self._last_s = dict.fromkeys(channels, math.nan)
        self._period_s = dict.fromkeys(channels, 0.0)
        self._values: dict[str, Array] = {}

    def take(self, readings: Mapping[str, Reading], time_s: float) -> None:
        """Note what came by a time of the robot's clock."""
        for stream, reading in readings.items():
            if not len(reading.values):
                continue
            step_s = (time_s - self._last_s[stream]) / len(reading.values)
            if 0.0 < step_s < 10.0:
                self._period_s[stream] = step_s
            self._last_s[stream], self._values[stream] = time_s, reading.values[-1]

    def health(self, time_s: float) -> dict[str, str]:
        """Return ``fresh``, ``not finite`` or ``lost`` by stream."""
        found = {}
        for stream, last_s in self._last_s.items():
            allowed_s = max(LOST_AFTER_S, PERIODS * self._period_s[stream])
            if not abs(time_s - last_s) <= allowed_s:  # True for NaN, and a clock that was set back
                found[stream] = "lost"
            else:
                found[stream] = "fresh" if np.isfinite(self._values[stream]).all() else "not finite"
        return found

    def last(self, stream: str, channels: Sequence[str]) -> Array:
        """Return the last values of some channels; NaN where there is none."""
        values = self._values.get(stream)
        known = {} if values is None else dict(zip(self._channels[stream], values, strict=True))
        return np.array([known.get(name, math.nan) for name in channels])
