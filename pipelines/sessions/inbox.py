"""Samples of one robot between two steps of its control: queued as they come, taken out at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from terrain.records import Array, Reading

MAX_QUEUED = 20_000
"""Rows of a stream that wait for a step: some seconds at a kilohertz; of more, the oldest are left out."""


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
        self._time_s: dict[str, list[Array]] = {name: [] for name in channels}
        self._values: dict[str, list[Array]] = {name: [] for name in channels}
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
        self._time_s[stream].append(stamps)
        self._values[stream].append(rows)
        self.received[stream] += stamps.size
        self._n_queued[stream] += stamps.size
        while self._n_queued[stream] > MAX_QUEUED and len(self._time_s[stream]) > 1:
            n = self._time_s[stream].pop(0).size
            self._values[stream].pop(0)
            self._n_queued[stream] -= n
            self.refused[f"{stream}: too many wait"] += n
        finite = stamps[np.isfinite(stamps)]
        return float(finite.max()) if finite.size else None

    def take(self) -> dict[str, Reading]:
        """Return what is queued, as one reading a stream, and empty the queue."""
        found = {}
        for stream, parts in self._time_s.items():
            if not parts:
                continue
            values = self._values[stream]
            if len(parts) == 1:
                found[stream] = Reading(parts[0], values[0])
            else:
                found[stream] = Reading(np.concatenate(parts), np.concatenate(values))
            self._time_s[stream], self._values[stream] = [], []
            self._n_queued[stream] = 0
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
