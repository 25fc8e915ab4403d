"""What arrives from a robot: samples that are queued, the clock of their stamps, and whether streams come."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from terrain.records import Array, Reading

MAX_QUEUED = 20_000
"""Rows of a stream that wait for a step: some seconds at a kilohertz; of more, the oldest are left out."""

REMEMBERED = 64
"""Messages of which the least late one tells the difference of the clocks."""

SET_S = 0.5
"""A stamp that is further ahead of what is known, or that many in a row are behind it, is of a clock that was
set."""

N_SET = 5

BEHIND_S = 1.0
"""A reading that is so far behind the newest stamp of its stream is late, or its clock was set."""

N_BEHIND = 5
"""Readings of a stream in a row that are behind: late ones are fewer."""

LOST_AFTER_S = 0.5
"""A stream that gives nothing for so long is lost; of one that is slower, three of its periods."""

PERIODS = 3.0


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


class SessionClock:
    """Tell the time of a robot's clock now.

    A message that was sent at once and one that waited differ in their delay, which is never below zero: the
    difference of the clocks is that of the message that was least late among the last ones.

    Examples
    --------
    >>> clock = SessionClock()
    >>> clock.received(100.0, now_s=5.0)
    >>> clock.received(100.1, now_s=5.3)  # this one waited for 0.2 s
    >>> round(clock.at(5.3), 6)
    100.3
    """

    def __init__(self) -> None:
        self._ahead: deque[float] = deque(maxlen=REMEMBERED)
        self._n_behind = 0
        self._offset_s = math.nan
        self.times_set = 0

    def received(self, stamp_s: float, now_s: float) -> None:
        """Take the newest stamp of a message that has just arrived; a stamp that is no number is left out."""
        ahead_s = stamp_s - now_s
        if not math.isfinite(ahead_s):
            return
        if not math.isnan(self._offset_s):
            self._n_behind = self._n_behind + 1 if ahead_s < self._offset_s - SET_S else 0
            if ahead_s > self._offset_s + SET_S or self._n_behind >= N_SET:
                self._ahead.clear()
                self._n_behind = 0
                self.times_set += 1
        self._ahead.append(ahead_s)
        self._offset_s = max(self._ahead)

    def at(self, now_s: float) -> float:
        """Return the robot's time now; NaN before the first stamp."""
        return now_s + self._offset_s


class ClockWatch:
    """Watch the stamps of streams.

    Examples
    --------
    >>> import numpy as np
    >>> watch = ClockWatch()
    >>> stamps = (100.0, 100.1, 40.0, 40.1, 40.2, 40.3, 40.4, 40.5)
    >>> [watch.was_set({"imu": Reading(np.array([t]), np.zeros((1, 1)))}) for t in stamps]
    [False, False, False, False, False, False, True, False]
    """

    def __init__(self) -> None:
        self._newest_s: dict[str, float] = {}
        self._n_behind: dict[str, int] = {}
        self.n_set = 0

    def was_set(self, samples: Mapping[str, Reading]) -> bool:
        """Take the stamps of readings; say whether they are of a clock that was set since the call before."""
        for stream in samples:
            stamp_s = last_stamp_s(samples, stream)
            if not math.isfinite(stamp_s):
                continue
            newest_s = self._newest_s.get(stream, -math.inf)
            if stamp_s >= newest_s - BEHIND_S:
                self._newest_s[stream], self._n_behind[stream] = max(stamp_s, newest_s), 0
                continue
            self._n_behind[stream] += 1
            if self._n_behind[stream] >= N_BEHIND:
                self._newest_s.clear()
                self._n_behind.clear()
                self.n_set += 1
                return True
        return False


def last_stamp_s(samples: Mapping[str, Reading], stream: str) -> float:
    """Return the last stamp of a stream; NaN where it has none that can be read."""
    try:
        return float(samples[stream][0][-1])
    except (TypeError, ValueError, LookupError, OverflowError):
        return math.nan


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
        names = self._channels.get(stream, ())
        values = self._values.get(stream)
        return np.array(
            [
                math.nan if values is None or name not in names else values[names.index(name)]
                for name in channels
            ]
        )
