"""One time for all that arrives: the caller's, without its steps, and each stream's stamps on it.

Stamps that agree with the time, up to a quarter of a second late, are left as they are. How stamps follow
each other distinguishes a clock that was set from samples that are late: its stamps jump back, or ahead of
the time that has passed. After a jump of a stream the difference to the time is taken anew, once three
readings agree on it; until then they are left out. What is later without a jump is late, however long, and
left out.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from terrain.records import Array, Reading

PERIOD_S = 0.02
"""Time that passes at a step whose time does not say."""

REWIND_S = 0.25
"""A sample that is later than that is not taken any more."""

LONGEST_STEP_S = 0.5
"""A longer step of the time, or one back, is a clock that was set."""

AHEAD_S = 0.1
"""A stamp that is further ahead of the time is wrong."""

JUMP_S, AGREED_S, N_AGREED = 0.25, 0.05, 3
"""Stamps that advance by so much more than the time have jumped; readings whose difference to the time is the
same within this, and how many of them are believed."""

REMEMBERED = 64
"""Messages of which the least late one tells the difference of the clocks."""

SET_S, N_SET = 0.5, 5
"""A stamp that is further ahead of what is known, or that many in a row are behind it, is of a clock that was
set."""

BEHIND_S, N_BEHIND = 1.0, 5
"""A reading that is so far behind the newest stamp of its stream is late, or its clock was set where so many
follow each other: late ones are fewer."""

_FLOATS = np.dtype(np.float64)


def number(value: Any) -> float:
    """Return a value as a number; NaN where it is none.

    Examples
    --------
    >>> number("1.5"), number(None), number(10**400)
    (nan, nan, nan)
    """
    try:
        return math.nan if isinstance(value, str | bytes) else float(value)
    except Exception:  # whatever an object does where a number was due
        return math.nan


def numbers(value: Any) -> Array | None:
    """Return a value as an array of numbers; None where it is none.

    Examples
    --------
    >>> numbers([[1.0], [2.0, 3.0]]) is None, numbers(["a"]) is None, numbers([1, 2])
    (True, True, array([1., 2.]))
    """
    if type(value) is np.ndarray and value.dtype == _FLOATS:
        return value
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            return None
        return array.astype(np.float64, copy=False)
    except Exception:
        return None


def finite_twist(given: object) -> Array:
    """Return a desired twist (3,); zeros where it is none."""
    twist = numbers(given)
    if twist is None or twist.shape != (3,) or not math.isfinite(sum(twist.tolist())):
        return np.zeros(3)
    return twist


class _StreamClock:
    """The clock of one stream.

    Parameters
    ----------
    counts : what was left out, by kind
    too_late : when a reading came last that was too late, and by how much
    """

    def __init__(self) -> None:
        self.too_late = -math.inf, math.nan
        self.offset_s, self.lateness_s = 0.0, 0.0
        self._stamp_s = self._now_s = math.nan
        self._due_s, self._n_due, self._jumped = math.nan, 0, True  # a first stamp may be of any time
        self.counts = {"off the clock": 0, "too late": 0, "clock set": 0}

    def take(self, now_s: float, reading: Reading) -> Reading | None:
        """Return a reading stamped by the time; None where none of it is to be believed."""
        time_s, values = reading
        stamps = time_s.tolist()
        left_out = not math.isfinite(sum(stamps))
        if left_out:
            finite = np.isfinite(time_s)
            time_s, values = time_s[finite], values[finite]
            stamps = time_s.tolist()
        if not stamps:
            return None
        newest_s = stamps[0] if len(stamps) == 1 else max(stamps)
        advanced_s = newest_s - self._stamp_s  # since the reading before
        if advanced_s < -REWIND_S or advanced_s > now_s - self._now_s + JUMP_S:
            self._jumped, self._n_due = True, 0
        self._stamp_s, self._now_s = newest_s, now_s
        late_s = now_s - (newest_s - self.offset_s)
        if -AHEAD_S <= late_s <= REWIND_S:
            self.lateness_s, self._jumped, self._n_due = late_s, False, 0
        elif not self._jumped:
            self.counts["too late" if late_s > 0.0 else "off the clock"] += time_s.size
            if late_s > 0.0:
                self.too_late = now_s, late_s
            return None
        elif not self._agrees(now_s - newest_s):
            self.counts["off the clock"] += time_s.size
            return None
        if self.offset_s == 0.0:
            return Reading(time_s, values) if left_out else reading
        return Reading(time_s - self.offset_s, values)

    def _agrees(self, behind_s: float) -> bool:
        """Take the difference of stamps to the time anew where enough readings agree; say whether it was."""
        if self._n_due == 0 or abs(behind_s - self._due_s) > AGREED_S:
            self._due_s, self._n_due = behind_s, 1
        else:
            self._due_s, self._n_due = min(self._due_s, behind_s), self._n_due + 1
        if self._n_due < N_AGREED:
            return False
        self.offset_s = -self._due_s + min(max(self.lateness_s, 0.0), REWIND_S)
        self._jumped, self._n_due = False, 0
        self.counts["clock set"] += 1
        return True


class Clocks:
    """The time of a live chain, and the clocks of the streams.

    Examples
    --------
    >>> clocks = Clocks()
    >>> reading = Reading(np.array([0.98]), np.zeros((1, 3)))
    >>> now_s, readings = clocks.step(1.0, {"wheels": reading, "imu": "broken"})
    >>> now_s, readings["wheels"].time_s.tolist(), clocks.counts
    (1.0, [0.98], {'imu: unreadable': 1})
    """

    def __init__(self) -> None:
        self._given_s, self._offset_s, self._now_s = math.nan, 0.0, 0.0
        self._streams: dict[str, _StreamClock] = {}
        self._unreadable: dict[str, int] = {}
        self.set = 0

    @property
    def counts(self) -> dict[str, int]:
        """What was not taken, and how often a clock was set, by stream and kind."""
        found = {
            f"{name}: {kind}": n for name, one in self._streams.items() for kind, n in one.counts.items()
        }
        found |= {f"{name}: unreadable": n for name, n in self._unreadable.items()} | {
            "time: clock set": self.set
        }
        return {kind: n for kind, n in found.items() if n}

    @property
    def too_late(self) -> tuple[float, float]:
        """When a reading came last that was too late to be taken, and by how much; minus infinity and NaN."""
        return max((one.too_late for one in self._streams.values()), default=(-math.inf, math.nan))

    @property
    def lateness_s(self) -> dict[str, float]:
        """How late the last reading of each stream came that was taken."""
        return {name: one.lateness_s for name, one in self._streams.items()}

    def step(self, time_s: Any, readings: Any) -> tuple[float, dict[str, Reading]]:
        """Return the time of a step, which never goes back, and what can be read of its readings.

        Parameters
        ----------
        time_s : the caller's time; a number, or anything
        readings : by stream, each a pair of stamps (k,) and values (k, c); or anything
        """
        now_s = self._advance(number(time_s))
        found: dict[str, Reading] = {}
        if type(readings) is not dict and not isinstance(readings, Mapping):
            return now_s, found
        for name, given in readings.items():
            reading = readable(given)
            if reading is None:
                self._unreadable[str(name)] = self._unreadable.get(str(name), 0) + 1
                continue
            clock = self._streams.get(name)
            if clock is None:
                clock = self._streams[name] = _StreamClock()
            taken = clock.take(now_s, reading)
            if taken is not None:
                found[name] = taken
        return now_s, found

    def _advance(self, given_s: float) -> float:
        """Return the time of a step: what was given, less all steps of its clock."""
        if not abs(given_s) < 1e12:
            self._given_s += PERIOD_S  # as if it had gone on
            self._now_s += PERIOD_S
            return self._now_s
        step_s = given_s - self._given_s
        if not math.isnan(step_s) and not 0.0 <= step_s <= LONGEST_STEP_S:
            self._offset_s = given_s - (self._now_s + PERIOD_S)
            self.set += 1
            for clock in self._streams.values():
                clock._jumped = True
        self._given_s = given_s
        self._now_s = given_s - self._offset_s
        return self._now_s


def readable(given: Any) -> Reading | None:
    """Return a reading as arrays (k,) and (k, c); None where it is not that."""
    try:
        time_s, values = given
    except Exception:
        return None
    stamps, array = numbers(time_s), numbers(values)
    if stamps is None or array is None or stamps.ndim != 1 or array.ndim != 2 or len(array) != stamps.size:
        return None
    if type(given) is Reading and stamps is time_s and array is values:
        return given
    return Reading(stamps, array)


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
    """Watch the stamps of streams: whether their clock was set.

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
        self.times_set = 0

    too_late = -math.inf, math.nan
    """As of :attr:`Clocks.too_late`: by their stamps alone samples are never late."""

    @property
    def counts(self) -> dict[str, int]:
        """How often the clock was set, as :attr:`Clocks.counts`; empty where it was not."""
        return {"time: clock set": self.times_set} if self.times_set else {}

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
                self.times_set += 1
                return True
        return False


def last_stamp_s(samples: Mapping[str, Reading], stream: str) -> float:
    """Return the last stamp of a stream; NaN where it has none that can be read."""
    try:
        return float(samples[stream][0][-1])
    except (TypeError, ValueError, LookupError, OverflowError):
        return math.nan
