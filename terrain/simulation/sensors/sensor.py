"""A sensor: from the recorded motion, step by step, to the samples that it writes at its own rate.

Each sensor follows the recorded motion at :data:`~terrain.simulation.sensors.motion.STEP_S`, adds its errors
(low-pass, latency, bias, noise, quantisation, loss) and writes one stream.  A stamp is the time at which the
sample arrived; its content is older by the sensor's latency.

All random numbers are drawn when a sensor is made.  After that it follows the motion in blocks of any length:
a run in one block and a run tick by tick give the same bytes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np
from numba import njit

from terrain.records import Array, Reading, Stream
from terrain.simulation.sensors.motion import (
    STEP_S,
    Motion,
)


class Sensor(ABC):
    """One sensor of one run, and what it wrote so far.

    Parameters
    ----------
    motion : what it is told of; rows may be missing yet
    channels : of its stream
    time_s : (n,) when its samples arrive
    rows : (n,) of the motion that they tell of, none later than the sample
    """

    def __init__(self, motion: Motion, channels: tuple[str, ...], time_s: Array, rows: Array) -> None:
        self.motion, self.channels, self.time_s, self.rows = motion, channels, time_s, rows
        self.values = np.empty((len(time_s), len(channels)))
        self._shown = (time_s.view(), self.values.view())
        for array in self._shown:
            array.flags.writeable = False
        self._n_written = self._n_given = 0

    def stamp(self, offset_s: float, rate_ratio: float) -> None:
        """Stamp by a clock of its own, ``t' = (1 + r) t + T``; samples arrive when they did."""
        self._shown = ((1.0 + rate_ratio) * self.time_s + offset_s, self._shown[1])
        self._shown[0].flags.writeable = False

    def hear(self) -> None:
        """Write the samples that the motion's rows allow by now."""
        told = self._follow()
        new = slice(self._n_written, int(self.rows.searchsorted(told)))
        if new.start < new.stop:
            self._write(new, self.rows[new])
            self._n_written = new.stop

    def arrived(self, time_s: float) -> Reading | None:
        """Return what arrived since this was last asked, up to and with ``time_s``; None if nothing did."""
        new = slice(self._n_given, int(self.time_s.searchsorted(time_s, side="right")))
        self._n_given = new.stop
        return Reading(*(array[new] for array in self._shown)) if new.start < new.stop else None

    def stream(self) -> Stream:
        """Return all that it wrote, once the motion is complete."""
        return Stream(*self._shown, self.channels)

    def _follow(self) -> int:
        """Carry on what has a memory; return up to which row samples can be written."""
        return self.motion.n_rows

    @abstractmethod
    def _write(self, new: slice, rows: Array) -> None:
        """Write samples ``new`` of what the motion's ``rows`` tell."""


class LowPass:
    """First-order low-passes of several quantities, started at rest at the first values they are given.

    Called with values (n, c) at :data:`STEP_S`, they filter them in place and remember where they were.
    """

    def __init__(self, time_constants_s: list[float]) -> None:
        self._keep = np.array([math.exp(-STEP_S / tau) if tau > 0.0 else 0.0 for tau in time_constants_s])
        self._start: Array | None = None
        self._state = np.zeros(len(time_constants_s))

    def __call__(self, values: Array) -> Array:
        """Filter values (n, c) in place, and return them."""
        if len(values):
            self._start = values[0].copy() if self._start is None else self._start
            _low_pass(values, self._keep, self._start, self._state)
        return values


@njit(cache=True)
def _low_pass(values: Array, keep: Array, start: Array, state: Array) -> None:
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            if keep[j] > 0.0:
                state[j] = keep[j] * state[j] + (1.0 - keep[j]) * (values[i, j] - start[j])
                values[i, j] = state[j] + start[j]
