"""Samples of a stream whose parts come one by one, as in the frames of a bus.

The parts of one instant have equal counters, and make one sample, which is stamped by the first of them.  A sample
is complete when all columns have come.  A part that was lost leaves NaN in the sample, which ends with the first
part of the next; parts of a sample that has ended are late, and those of a counter that stands still repeat an old
measurement: both are dropped and counted.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.records import Reading

LONGEST = 1.02  #: Square of the length of a quaternion's vector part that rounding can explain


class Part(NamedTuple):
    """What one frame or message has of a sample of a stream: values in SI by column, NaN where none was measured.

    ``counter`` is None where the message has none; ``n_out_of_range`` values beyond their bounds are NaN, too.
    """

    stream: str
    counter: int | None
    values: Mapping[int, float]
    n_out_of_range: int = 0


class Assembler:
    """Samples of one stream of some width from their parts as they come.

    Parameters
    ----------
    columns : that the parts have together; a sample with all of them is complete
    dropped : where what is not used is counted
    most : samples that are held between two readings; the oldest are dropped
    quaternion : columns of x, y, z and w where w, which is not negative, follows from the others

    Examples
    --------
    >>> dropped = Counter()
    >>> wheels = Assembler("wheels", 2, frozenset({0, 1}), dropped)
    >>> came = (0.0, 1, {0: 1.0}), (0.01, 1, {1: 2.0}), (0.1, 2, {0: 3.0}), (0.2, 3, {0: 5.0})
    >>> for time_s, counter, values in came:
    ...     wheels.take(time_s, Part("wheels", counter, values))
    >>> wheels.reading(0.15).values
    array([[ 1.,  2.],
           [ 3., nan]])
    >>> dict(dropped)
    {'wheels: part missing': 1}
    """

    def __init__(
        self,
        stream: str,
        width: int,
        columns: frozenset[int],
        dropped: Counter[str],
        most: float = math.inf,
        quaternion: Sequence[int] = (),
    ) -> None:
        self._stream, self._needed, self._dropped, self._most = stream, columns, dropped, most
        self._width, self._quaternion = width, quaternion
        self._row: dict[int, float] = {}
        self._counter: int | None = None
        self._last: int | None = None
        self._time_s = math.nan
        self._done = array("d")  # of each sample its time and its row

    def take(self, time_s: float, part: Part) -> None:
        """Take a part; one of a sample that has ended, or that came already, is dropped and counted."""
        counter, again = part.counter, not self._row.keys().isdisjoint(part.values)
        if counter is not None and (counter == self._last or (again and counter == self._counter)):
            self._dropped[f"{self._stream}: repeated or late"] += 1
            return
        if again or (None not in (counter, self._counter) and counter != self._counter):
            self.finish()
        if not self._row:
            self._time_s = time_s
        self._counter = self._counter if counter is None else counter
        self._row |= part.values
        if part.n_out_of_range:
            self._dropped[f"{self._stream}: out of range"] += part.n_out_of_range
        if self._row.keys() >= self._needed:
            self.finish()

    def finish(self) -> None:
        """End the sample, complete or not."""
        if not self._row:
            return
        if not self._row.keys() >= self._needed:
            self._dropped[f"{self._stream}: part missing"] += 1
        if self._quaternion:
            *vector, real = self._quaternion
            square = sum(self._row.get(column, math.nan) ** 2 for column in vector)
            self._row[real] = math.sqrt(max(1.0 - square, 0.0)) if square <= LONGEST else math.nan
        if len(self._done) >= self._most * (1 + self._width):
            del self._done[: 1 + self._width]
            self._dropped[f"{self._stream}: queue full"] += 1
        self._done.extend((self._time_s, *(self._row.get(i, math.nan) for i in range(self._width))))
        self._row = {}
        self._last, self._counter = self._counter, None

    def reading(self, before_s: float) -> Reading | None:
        """Return the samples that are done or began before a time, and hold them no more; None without any."""
        if self._time_s < before_s:
            self.finish()
        if not self._done:
            return None
        rows = np.array(self._done).reshape(-1, 1 + self._width)
        self._done = array("d")
        return Reading(rows[:, 0].copy(), rows[:, 1:].copy())
