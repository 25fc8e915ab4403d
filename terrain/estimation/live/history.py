"""What a live estimator was and was given in the last quarter of a second: for samples that come late.

A late sample belongs before ticks that are done.  The estimator goes back to the tick before it, and takes
all that has come since once more, in order: the same numbers as if nothing had been late.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from terrain.estimation.measurements.sample_hold import TICK_S
from terrain.records import Array

REWIND_S = 0.25
"""A sample that is later than that is not taken any more."""

N_TICKS = 64
"""Most ticks that are kept; at 200 Hz a little more than :data:`REWIND_S`."""

N_STEPS = 1024
"""Most steps whose samples are kept, where no tick says that they are old."""

Samples = tuple[list[float], Array, Array]
"""Stamps, twice, and values of a stream."""

Buffers = tuple[Array, Array, Array]


class KeptMemory(NamedTuple):
    """What an estimator remembers, and where it is kept tick by tick.

    Parameters
    ----------
    floats, kept_floats : buffers (n,), and the same with a row for each slot (slots, n)
    counts, kept_counts : likewise, of whole numbers
    """

    floats: Buffers
    kept_floats: Buffers
    counts: Buffers
    kept_counts: Buffers


def _slots(buffers: Buffers) -> Buffers:
    first, second, third = (np.empty((N_TICKS, buffer.size), buffer.dtype) for buffer in buffers)
    return first, second, third


class Tick(NamedTuple):
    """A tick that is done: its stamp, and the sample of the wheels (c,), None where they gave none."""

    time_s: float
    wheels: Array | None


class History:
    """The last ticks with the memory behind each, and the last samples of each stream.

    Parameters
    ----------
    floats, counts : buffers that are all an estimator remembers, each (n,)

    Attributes
    ----------
    memory : of the kernel that keeps it
    slot : where it is kept at the next tick
    """

    def __init__(self, floats: Buffers, counts: Buffers) -> None:
        self.memory = KeptMemory(floats, _slots(floats), counts, _slots(counts))
        self._ticks: deque[tuple[Tick, int]] = deque(maxlen=N_TICKS)
        self.slot = 0
        self._samples: deque[tuple[float, dict[str, Samples]]] = deque(maxlen=N_STEPS)

    def keep_samples(self, came: dict[str, Samples], now_s: float) -> None:
        """Remember what came of each stream at a step, and forget what is old."""
        kept = self._samples
        kept.append((max([stamps[-1] for stamps, _, _ in came.values()]), came))
        while kept and not kept[0][0] > now_s - 2.0 * REWIND_S:
            kept.popleft()

    def keep_tick(self, tick: Tick) -> None:
        """Remember a tick that was just done, and whose memory is kept in the slot."""
        self._ticks.append((tick, self.slot))
        self.slot = (self.slot + 1) % N_TICKS

    def stamps(self, stream: str) -> set[float]:
        """Return the stamps of a stream that came."""
        steps = (came[stream][0] for _, came in self._samples if stream in came)
        return {stamp_s for stamps in steps for stamp_s in stamps}

    @property
    def last_s(self) -> float:
        """Stamp of the last tick; minus infinity before the first."""
        return self._ticks[-1][0].time_s if self._ticks else -np.inf

    @property
    def last_measured_s(self) -> float:
        """Stamp of the last tick at which the wheels gave a sample."""
        return next((tick.time_s for tick, _ in reversed(self._ticks) if tick.wheels is not None), -np.inf)

    def reaches(self, time_s: float) -> bool:
        """Say whether it is possible to go back before an instant."""
        return bool(self._ticks) and time_s - TICK_S > max(self._ticks[0][0].time_s, self.last_s - REWIND_S)

    def back_to(self, time_s: float) -> list[Tick]:
        """Put the memory back to the last tick before an instant; return the ticks that are undone."""
        undone: list[Tick] = []
        while self._ticks[-1][0].time_s >= time_s - TICK_S:
            undone.append(self._ticks.pop()[0])
        slot = self._ticks[-1][1]
        memory = self.memory
        buffers, kept = memory.floats + memory.counts, memory.kept_floats + memory.kept_counts
        for buffer, slots in zip(buffers, kept, strict=True):
            buffer[:] = slots[slot]
        self.slot = (slot + 1) % N_TICKS
        return undone[::-1]

    def since(self, stream: str, time_s: float) -> tuple[Array, Array] | None:
        """Return the samples of a stream that are stamped after an instant, in order, each stamp once."""
        steps = [came[stream] for _, came in self._samples if stream in came]
        blocks = [(at_s, values) for stamps, at_s, values in steps if max(stamps) > time_s]
        if not blocks:
            return None
        stamps, values = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        later = np.flatnonzero(stamps > time_s)
        _, first = np.unique(stamps[later], return_index=True)
        return stamps[later][first], values[later][first]

    def clear(self) -> None:
        """Forget all: the clock was set back."""
        self._ticks.clear()
        self._samples.clear()
