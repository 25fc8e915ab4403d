"""What arrives from a robot: numbers, rows in a queue, and one time for all of them.

The time is the caller's, without its steps, and each stream's stamps are brought onto it.  Stamps that agree with
the time, up to a quarter of a second late, are left as they are.  How stamps follow each other distinguishes a clock
that was set from samples that are late: its stamps jump back, or ahead of the time that has passed.  After a jump of
a stream the difference to the time is taken anew, once three readings agree on it; until then they are left out.
What is later without a jump is late, however long, and left out.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation.feed import OFF_CLOCK_S, TICK_S
from terrain.records import Array, Reading

PERIOD_S = 0.02  #: Time that passes at a step whose time does not say.
REWIND_S = 0.25  #: A sample that is later than that is not taken any more.
LONGEST_STEP_S = 0.5  #: A longer step of the time, or one back, is a clock that was set.
AHEAD_S = 0.1  #: A stamp that is further ahead of the time is wrong.
#: Stamps that advance by so much more than the time have jumped; readings whose difference to the time is the same
#: within this, and how many of them are believed.
JUMP_S, AGREED_S, N_AGREED = 0.25, 0.05, 3
REMEMBERED = 64  #: Messages of which the least late one tells the difference of the clocks.
#: A stamp that is further ahead of what is known, or that many in a row are behind it, is of a clock that was set.
SET_S, N_SET = 0.5, 5
#: A reading that is so far behind the newest stamp of its stream is late, or its clock was set where so many follow
#: each other: late ones are fewer.
BEHIND_S, N_BEHIND = 1.0, 5
#: Rows of a stream that wait for a step: some seconds at a kilohertz; of more, the oldest are left out.
MAX_QUEUED = 20_000
#: A stream that gives nothing for so long is lost; of one that is slower, so many of its periods.
LOST_AFTER_S, PERIODS = 0.5, 3.0
#: When samples came last that were too late to be taken, and by how much, of what never had any.
NEVER = -math.inf, math.nan
#: Samples of a stream that wait for the wheels; five seconds of a camera.
QUEUE = 1024
CLOCK_SET_S = 1.0  #: Samples that are so far behind, many in a row, are of a clock that was set back.
Due = list[tuple[float, bool, Array]]
"""Of samples their stamp, whether all of their numbers are finite, and those, NaN where they are not."""


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
    """Return numbers as an array of floats, NaN for None; None where anything else is among them.

    Examples
    --------
    >>> numbers([1, None]), numbers([[1.0], [2.0, 3.0]]), numbers(["1"]), numbers([True])
    (array([ 1., nan]), None, None, None)
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    try:
        array = np.asarray(value)
        for one in array.ravel().tolist() if array.dtype.kind == "O" else ():
            if not (one is None or type(one) is float or (type(one) is int and abs(one) < 2**63)):
                return None
        return array.astype(np.float64, copy=False) if array.dtype.kind in "fiuO" else None
    except Exception:
        return None


def finite_twist(given: object) -> Array:
    """Return a desired twist (3,); zeros where it is none."""
    twist = numbers(given)
    if twist is None or twist.shape != (3,) or not math.isfinite(sum(twist.tolist())):
        return np.zeros(3)
    return twist


def readable(given: Any) -> Reading | None:
    """Return a reading as arrays (k,) and (k, c); None where it is not that."""
    try:
        stamps, values = map(numbers, given)
    except Exception:
        return None
    if stamps is None or values is None or stamps.ndim != 1 or values.ndim != 2 or len(values) != stamps.size:
        return None
    return Reading(stamps, values)


def last_stamp_s(samples: Mapping[str, Reading], stream: str) -> float:
    """Return the last stamp of a stream; NaN where it has none that can be read."""
    try:
        return float(samples[stream][0][-1])
    except (TypeError, ValueError, LookupError, OverflowError):
        return math.nan


@dataclass(slots=True)
class _StreamClock:
    """What is known of the clock of one stream."""

    offset_s: float = 0.0  #: of its stamps to the time
    lateness_s: float = 0.0  #: of the last reading that was believed
    jumped: bool = True  #: a first stamp may be of any time
    stamp_s: float = math.nan  #: newest stamp of the reading before, and its time
    now_s: float = math.nan
    due_s: float = math.nan  #: a new difference to the time, and how many readings agree on it
    n_due: int = 0


class Clocks:
    """The time of a live chain, and the clocks of the streams.

    Attributes
    ----------
    counts : what was not taken, and how often a clock was set, by stream and kind
    too_late : when a reading came last that was too late to be taken, and by how much; minus infinity and NaN

    Examples
    --------
    >>> clocks = Clocks()
    >>> reading = Reading(np.array([0.98]), np.zeros((1, 3)))
    >>> now_s, readings = clocks.step(1.0, {"wheels": reading, "imu": "broken"})
    >>> now_s, readings["wheels"].time_s.tolist(), dict(clocks.counts)
    (1.0, [0.98], {'imu: unreadable': 1})
    """

    def __init__(self) -> None:
        self._given_s, self._offset_s, self._now_s = math.nan, 0.0, 0.0
        self._streams: dict[str, _StreamClock] = {}
        self.counts: Counter[str] = Counter()
        self.too_late = NEVER

    def step(self, time_s: Any, readings: Any) -> tuple[float, dict[str, Reading]]:
        """Return the time of a step, which never goes back, and what can be read of its readings.

        Parameters
        ----------
        time_s : the caller's time; a number, or anything
        readings : by stream, each a pair of stamps (k,) and values (k, c); or anything
        """
        given_s = number(time_s)
        if not abs(given_s) < 1e12:  # as if it had gone on
            self._given_s += PERIOD_S
            self._now_s += PERIOD_S
        else:
            step_s = given_s - self._given_s
            if not math.isnan(step_s) and not 0.0 <= step_s <= LONGEST_STEP_S:
                self._offset_s = given_s - (self._now_s + PERIOD_S)
                self.counts["time: clock set"] += 1
                for clock in self._streams.values():
                    clock.jumped = True
            self._given_s, self._now_s = given_s, given_s - self._offset_s
        taken: dict[str, Reading] = {}
        for name, given in readings.items() if isinstance(readings, Mapping) else ():
            reading = readable(given)
            if reading is None:
                self.counts[f"{name}: unreadable"] += 1
            elif (believed := self._believed(name, reading)) is not None:
                taken[name] = believed
        return self._now_s, taken

    def _believed(self, name: str, reading: Reading) -> Reading | None:
        """Return a reading of a stream stamped by the time; None where none of it is to be believed."""
        clock, now_s = self._streams.setdefault(name, _StreamClock()), self._now_s
        finite = np.isfinite(reading.time_s)
        if not finite.all():
            reading = Reading(reading.time_s[finite], reading.values[finite])
        if not reading.time_s.size:
            return None
        newest_s = float(reading.time_s.max())
        advanced_s = newest_s - clock.stamp_s  # since the reading before
        if advanced_s < -REWIND_S or advanced_s > now_s - clock.now_s + JUMP_S:
            clock.jumped, clock.n_due = True, 0
        clock.stamp_s, clock.now_s = newest_s, now_s
        behind_s, late_s = now_s - newest_s, now_s - (newest_s - clock.offset_s)
        if -AHEAD_S <= late_s <= REWIND_S:
            clock.lateness_s, clock.jumped, clock.n_due = late_s, False, 0
        elif not clock.jumped:
            self.counts[f"{name}: {'too late' if late_s > 0.0 else 'off the clock'}"] += reading.time_s.size
            self.too_late = (now_s, late_s) if late_s > 0.0 else self.too_late
            return None
        else:
            agrees = clock.n_due > 0 and abs(behind_s - clock.due_s) <= AGREED_S
            clock.due_s = min(clock.due_s, behind_s) if agrees else behind_s
            clock.n_due = clock.n_due + 1 if agrees else 1
            if clock.n_due < N_AGREED:
                self.counts[f"{name}: off the clock"] += reading.time_s.size
                return None
            clock.offset_s = -clock.due_s + min(max(clock.lateness_s, 0.0), REWIND_S)
            clock.jumped, clock.n_due = False, 0
            self.counts[f"{name}: clock set"] += 1
        return reading if clock.offset_s == 0.0 else Reading(reading.time_s - clock.offset_s, reading.values)


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

    too_late = NEVER  # by their stamps alone samples are never late

    def __init__(self) -> None:
        self._newest_s: dict[str, float] = {}
        self._n_behind: dict[str, int] = {}
        self.counts: Counter[str] = Counter()  # how often the clock was set, as those of `Clocks`

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
                self.counts["time: clock set"] += 1
                return True
        return False


def check_channels(stream: str, names: Iterable[str], known: Sequence[str]) -> None:
    """Raise ``ConfigError`` where a stream that is read sample by sample lacks a channel."""
    for name in names:
        if name not in known:
            raise ConfigError(f"channels of {stream!r} are {list(known)}: {name!r} must be among them")


class SampleQueue:
    """Samples of a stream that wait for the wheels, in order of their stamps: late ones go where they belong.

    Of two of which one is further ahead than any is late, one has a wrong stamp, and goes.

    Attributes
    ----------
    waiting : samples that are not due
    taken_s : stamp of the last one that was taken out
    n_behind : samples in a row that are stamped long before that one
    counts : of samples left out, by kind
    """

    def __init__(self, columns: Array) -> None:
        """``columns`` say where each channel stands in the readings, -1 where it does not."""
        self._columns, self._is_lacking = columns, columns < 0
        self.waiting: Due = []
        self.taken_s, self.n_behind = -math.inf, 0
        self.counts: Counter[str] = Counter()

    def push(self, time_s: Array, values: Array) -> None:
        """Queue samples."""
        samples = np.ascontiguousarray(values[:, self._columns])  # one layout: one compiled form
        samples[:, self._is_lacking] = np.nan
        finite = np.isfinite(samples) | self._is_lacking
        samples[~finite] = np.nan
        waiting, are_whole = self.waiting, finite.all(axis=1).tolist()
        for stamp_s, is_whole, sample in zip(time_s.tolist(), are_whole, samples, strict=True):
            place = bisect_left(waiting, stamp_s, key=itemgetter(0))
            is_known = place < len(waiting) and waiting[place][0] == stamp_s
            if is_known or not self.taken_s < stamp_s < math.inf:
                self.counts["stamp does not increase"] += 1
                self.n_behind = self.n_behind + 1 if stamp_s <= self.taken_s - CLOCK_SET_S else 0
                continue
            if waiting and waiting[-1][0] - stamp_s > REWIND_S:
                self.counts["stamp does not increase"] += 1
                if len(waiting) > 1 and waiting[-2][0] - stamp_s > REWIND_S:
                    continue
                waiting.pop()
            if len(waiting) == QUEUE:
                self.counts["waited too long"] += QUEUE // 2
                del waiting[: QUEUE // 2]
                place = max(place - QUEUE // 2, 0)
            waiting.insert(place, (stamp_s, is_whole, sample))
            self.n_behind = 0

    def take(self, time_s: float) -> Due:
        """Take out what came by a tick; what is stamped far ahead of it goes."""
        waiting = self.waiting
        n = bisect_right(waiting, time_s + TICK_S, key=itemgetter(0))
        due = waiting[:n]
        del waiting[:n]
        if due:
            self.taken_s = due[-1][0]
        while waiting and waiting[-1][0] > time_s + OFF_CLOCK_S:
            self.counts["off the clock"] += 1
            waiting.pop()
        return due


class Inbox:
    """Queue rows of streams, in the order in which they come; judge whether each comes, and keep its last values.

    Parameters
    ----------
    channels : by stream

    Attributes
    ----------
    received : rows taken, by stream
    refused : rows or readings that were not taken, by reason

    Examples
    --------
    >>> inbox = Inbox({"imu": ("gyro_z_radps", "accel_x_mps2")})
    >>> inbox.put("imu", [0.0, 0.01], [[1.0, 2.0], [3.0, None]])
    0.01
    >>> inbox.take(0.02)["imu"].values.tolist(), inbox.health(0.2), inbox.health(1.0)
    ([[1.0, 2.0], [3.0, nan]], {'imu': 'not finite'}, {'imu': 'lost'})
    >>> inbox.put("imu", [0.0], [[1.0]]), dict(inbox.refused)
    (None, {'imu: not rows of 2 numbers': 1})
    """

    def __init__(self, channels: Mapping[str, Sequence[str]]) -> None:
        self._channels = dict(channels)
        self._queued: dict[str, list[Reading]] = {name: [] for name in channels}
        self._n_queued: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self._last_s = dict.fromkeys(channels, math.nan)
        self._period_s = dict.fromkeys(channels, 0.0)
        self._values: dict[str, Array] = {}

    def put(self, stream: str, time_s: Any, values: Any) -> float | None:
        """Queue rows; return their newest stamp, or None where they were refused and counted."""
        if stream not in self._channels:
            self.refused["stream that was not announced"] += 1
            return None
        reading, n_columns = readable((time_s, values)), len(self._channels[stream])
        if reading is None or reading.values.shape[1] != n_columns:
            self.refused[f"{stream}: not rows of {n_columns} numbers"] += 1
            return None
        if not reading.time_s.size:
            return None
        queued = self._queued[stream]
        queued.append(reading)
        self.received[stream] += reading.time_s.size
        self._n_queued[stream] += reading.time_s.size
        while self._n_queued[stream] > MAX_QUEUED and len(queued) > 1:
            n = queued.pop(0).time_s.size
            self._n_queued[stream] -= n
            self.refused[f"{stream}: too many wait"] += n
        return max(filter(math.isfinite, reading.time_s.tolist()), default=None)

    def take(self, time_s: float) -> dict[str, Reading]:
        """Return what is queued at a time of the robot's clock, as one reading a stream, and empty the queue."""
        taken = {}
        for stream, queued in self._queued.items():
            if queued:
                taken[stream] = Reading(*map(np.concatenate, zip(*queued, strict=True)))
                step_s = (time_s - self._last_s[stream]) / len(taken[stream].values)
                if 0.0 < step_s < 10.0:
                    self._period_s[stream] = step_s
                self._last_s[stream], self._values[stream] = time_s, taken[stream].values[-1]
                self._queued[stream], self._n_queued[stream] = [], 0
        return taken

    def health(self, time_s: float) -> dict[str, str]:
        """Return ``fresh``, ``not finite`` or ``lost`` by stream."""
        health = {}
        for stream, last_s in self._last_s.items():
            allowed_s = max(LOST_AFTER_S, PERIODS * self._period_s[stream])
            if not abs(time_s - last_s) <= allowed_s:  # True for NaN, and a clock that was set back
                health[stream] = "lost"
            else:
                health[stream] = "fresh" if np.isfinite(self._values[stream]).all() else "not finite"
        return health

    def last(self, stream: str, channels: Sequence[str]) -> Array:
        """Return the last values of some channels; NaN where there is none."""
        names, values = self._channels.get(stream, ()), self._values.get(stream, ())
        known = dict(zip(names, values, strict=False))
        return np.array([known.get(name, math.nan) for name in channels])
