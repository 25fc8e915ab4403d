"""What a live estimator was and was given in the last quarter of a second: for samples that come late.

A late sample belongs before ticks that are done.  The estimator goes back to the tick before it, and takes
all that has come since once more, in order: the same numbers as if nothing had been late.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.estimation.measurements.sample_hold import TICK_S
from terrain.records import Array

REWIND_S = 0.25
"""A sample that is later than that is not taken any more."""

N_TICKS = 64
"""Most ticks that are kept; at 200 Hz a little more than :data:`REWIND_S`."""


class Tick(NamedTuple):
    """A tick that is done: its stamp, and the sample of the wheels (c,), None where they gave none."""

    time_s: float
    wheels: Array | None


class History:
    """The last ticks with the memory behind each, and the last samples of each stream.

    Parameters
    ----------
    memory : buffers that are all an estimator remembers
    streams : names of the streams
    """

    def __init__(self, memory: Sequence[Array], streams: Sequence[str]) -> None:
        self._memory = tuple(memory)
        self._kept = tuple(np.empty((N_TICKS, *buffer.shape), buffer.dtype) for buffer in memory)
        self._ticks: deque[tuple[Tick, int]] = deque(maxlen=N_TICKS)
        self._slot = 0
        self.samples: dict[str, deque[tuple[Array, Array]]] = {name: deque() for name in streams}

    def keep_samples(self, stream: str, time_s: Array, values: Array, now_s: float) -> None:
        """Remember samples of a stream, and forget the old ones."""
        kept = self.samples[stream]
        kept.append((time_s, values))
        while kept and not kept[0][0][-1] > now_s - 2.0 * REWIND_S:
            kept.popleft()

    def keep_tick(self, tick: Tick) -> None:
        """Remember the memory behind a tick that was just done."""
        slot = self._slot
        for buffer, kept in zip(self._memory, self._kept, strict=True):
            kept[slot] = buffer
        self._ticks.append((tick, slot))
        self._slot = (slot + 1) % N_TICKS

    def stamps_before_the_last(self, stream: str) -> set[float]:
        """Return the stamps of a stream that came before its last samples."""
        blocks = list(self.samples[stream])[:-1]
        return {stamp_s for time_s, _ in blocks for stamp_s in time_s.tolist()}

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
        for buffer, kept in zip(self._memory, self._kept, strict=True):
            buffer[...] = kept[slot]
        self._slot = (slot + 1) % N_TICKS
        return undone[::-1]

    def since(self, stream: str, time_s: float) -> tuple[Array, Array] | None:
        """Return the samples of a stream that are stamped after an instant, in order, each stamp once."""
        blocks = [
            block for block in self.samples[stream] if block[0][-1] > time_s or (block[0] > time_s).any()
        ]
        if not blocks:
            return None
        stamps, values = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        later = np.flatnonzero(stamps > time_s)
        _, first = np.unique(stamps[later], return_index=True)
        return stamps[later][first], values[later][first]

    def clear(self) -> None:
        """Forget all: the clock was set back."""
        self._ticks.clear()
        for kept in self.samples.values():
            kept.clear()
