"""From parts to samples: the frames of one instant have equal counters, and are stamped by the first of them.

A sample is complete when all channels that the DBC has of its stream have come.  A frame that was lost leaves
NaN in its part of the sample, which ends with the first frame of the next; frames of a sample that has ended
are late, and those of a counter that stands still repeat an old measurement: both are dropped and counted.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from pipelines.can.codec import Drop, Frame, Part, decode
from pipelines.can.dbc import Layout
from pipelines.can.signals import QUATERNION, channels_of, real_part
from terrain.records import Reading

QUEUE = 1000
"""Most samples of a stream between two readings: ten seconds of an IMU; the oldest are dropped."""

INCOMPLETE_S = 0.02
"""A sample whose other frames have not come for so long is used without them."""


class _Assembler:
    """Samples of one stream.

    Parameters
    ----------
    stream : its name
    columns : that the DBC has
    dropped : gets counts by kind
    """

    def __init__(self, stream: str, columns: frozenset[int], dropped: Counter[str]) -> None:
        self._stream, self._needed, self._dropped = stream, columns, dropped
        self._width = len(channels_of(stream))
        self._adds_real_part = stream == "odometry" and QUATERNION[3] not in columns
        self._row = [math.nan] * self._width
        self._there: set[int] = set()
        self._counter: int | None = None
        self._last: int | None = None
        self._time_s = math.nan
        self.done: list[tuple[float, list[float]]] = []

    def take(self, time_s: float, part: Part) -> None:
        """Take a part of a sample."""
        if part.counter is not None and part.counter == self._last:
            self._dropped[f"{self._stream}: repeated or late"] += 1
            return
        known = part.counter is not None and self._counter is not None
        another = bool(self._there) and known and part.counter != self._counter
        if another or not self._there.isdisjoint(part.columns):
            if not another and known:
                self._dropped[f"{self._stream}: repeated or late"] += 1
                return
            self.finish()
        if not self._there:
            self._time_s = time_s
        if part.counter is not None:
            self._counter = part.counter
        for column, value in zip(part.columns, part.values, strict=True):
            self._row[column] = value
        self._there.update(part.columns)
        if part.n_out_of_range:
            self._dropped[f"{self._stream}: out of range"] += part.n_out_of_range
        if self._there >= self._needed:
            self.finish()

    def finish_before(self, time_s: float) -> None:
        """End a sample that began before a time."""
        if self._there and self._time_s < time_s:
            self.finish()

    def finish(self) -> None:
        """End the sample, complete or not."""
        if not self._there:
            return
        if not self._there >= self._needed:
            self._dropped[f"{self._stream}: part missing"] += 1
        if self._adds_real_part:
            x, y, z, w = QUATERNION
            self._row[w] = real_part(self._row[x], self._row[y], self._row[z])
        if len(self.done) >= QUEUE:
            del self.done[0]
            self._dropped[f"{self._stream}: queue full"] += 1
        self.done.append((self._time_s, self._row))
        self._row, self._there = [math.nan] * self._width, set()
        self._last, self._counter = self._counter, None


class Receiver:
    """Samples from frames as they come; whatever comes, it does not raise.

    Parameters
    ----------
    layout : of the DBC
    streams : that are read; frames of others are left alone

    Attributes
    ----------
    dropped : what was not used, as counts by kind
    n_used : frames that were used

    Examples
    --------
    >>> from pipelines.can.codec import encode
    >>> from pipelines.can.dbc import load_layout
    >>> layout = load_layout()
    >>> receiver = Receiver(layout, ("wheels",))
    >>> for frame in encode(layout, "wheels", [10.0, 11.0, 12.0, 1.0, 2.0, 3.0], counter=0, time_s=4.0):
    ...     stream = receiver.take(frame)
    >>> receiver.readings(5.0)["wheels"].values
    array([[10., 11., 12.,  1.,  2.,  3.]])
    """

    def __init__(self, layout: Layout, streams: tuple[str, ...]) -> None:
        self._layout = layout
        self.dropped: Counter[str] = Counter()
        self.n_used = 0
        self._streams = {
            name: _Assembler(name, layout.columns(name), self.dropped)
            for name in streams
            if name in layout.by_stream
        }

    def take(self, frame: Frame) -> str | None:
        """Take a frame; return the stream that it is of, None where it is not used."""
        part = decode(self._layout, frame)
        if isinstance(part, Drop):
            self.dropped[part.value] += 1
            return None
        assembler = self._streams.get(part.stream)
        if assembler is None:
            self.dropped[f"{part.stream}: not read here"] += 1
            return None
        assembler.take(frame.time_s, part)
        self.n_used += 1
        return part.stream

    def readings(self, now_s: float) -> dict[str, Reading]:
        """Return the samples since the last call, by stream; of incomplete ones those that are old enough."""
        found = {}
        for name, assembler in self._streams.items():
            assembler.finish_before(now_s - INCOMPLETE_S)
            if assembler.done:
                times, rows = zip(*assembler.done, strict=True)
                found[name] = Reading(np.array(times), np.array(rows))
                assembler.done = []
        return found
