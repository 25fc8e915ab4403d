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
from collections.abc import Sequence

import numpy as np
from numba import njit

from terrain.records import Array, Reading, Stream
from terrain.simulation.sensors.motion import (
    STEP_S,
    Motion,
)


class Sensor(ABC):
    """One sensor of one run, and the samples it has written so far.

    Parameters
    ----------
    motion : the recorded motion; its last rows may not be written yet
    channels : of its stream
    time_s : (n,) when its samples arrive
    rows : (n,) of the motion that the samples measure, none later than the sample
    """

    def __init__(self, motion: Motion, channels: tuple[str, ...], time_s: Array, rows: Array) -> None:
        self.motion, self.channels, self.time_s, self.rows = motion, channels, time_s, rows
        self.values = np.empty((len(time_s), len(channels)))
        self._logged = (time_s.view(), self.values.view())
        for array in self._logged:
            array.flags.writeable = False
        self._n_written = self._n_given = 0

    def stamp(self, offset_s: float, rate_ratio: float) -> None:
        """Stamp by a clock of its own, ``t' = (1 + r) t + T``; samples arrive when they did."""
        self._logged = ((1.0 + rate_ratio) * self.time_s + offset_s, self._logged[1])
        self._logged[0].flags.writeable = False

    def update(self) -> None:
        """Write the samples of all rows of the motion that are written."""
        end = self._filter()
        new = slice(self._n_written, int(self.rows.searchsorted(end)))
        if new.start < new.stop:
            self._write(new, self.rows[new])
            self._n_written = new.stop

    def arrived(self, time_s: float) -> Reading | None:
        """Return the samples that arrived since the last call, up to and with ``time_s``; None for none."""
        new = slice(self._n_given, int(self.time_s.searchsorted(time_s, side="right")))
        self._n_given = new.stop
        return Reading(*(array[new] for array in self._logged)) if new.start < new.stop else None

    def stream(self) -> Stream:
        """Return all samples, once the motion is complete."""
        return Stream(*self._logged, self.channels)

    def _filter(self) -> int:
        """Filter the new rows; return the number of rows that samples can be written of."""
        return self.motion.n_rows

    @abstractmethod
    def _write(self, new: slice, rows: Array) -> None:
        """Write the samples ``new``, which measure the motion's ``rows``."""


def is_lost(time_s: Array, intervals_s: Sequence[tuple[float, float]]) -> Array:
    """Return which samples (n,) fall in one of the intervals (start, end); the end is not in it.

    Examples
    --------
    >>> is_lost(np.arange(4.0), [(1.0, 3.0)])
    array([False,  True,  True, False])
    """
    lost = np.zeros(len(time_s), dtype=bool)
    for start_s, end_s in intervals_s:
        lost |= (time_s >= start_s) & (time_s < end_s)
    return lost


class LowPass:
    """First-order low-passes of several quantities, started at rest at the first values.

    Called with values (n, c) at :data:`STEP_S`, they filter them in place and keep their state.
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
