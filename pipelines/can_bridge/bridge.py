"""The loop of a bridge: frames in as they come, a control step at each tick of its own clock."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from pipelines.can_bridge.core import KEPT, BridgeCore
from pipelines.can_bridge.link import Link
from pipelines.can_bridge.results import Latency

MAX_READ = 2000
"""Frames that are read between two control steps once the second is due: a flooded bus delays none."""


class Bridge:
    """Runs a core on a bus.

    Parameters
    ----------
    core : from frames to frames
    link : the bus
    rate_hz : of the control steps
    clock : time of this computer in s

    Attributes
    ----------
    ticks_missed : control steps left out as one before took too long
    duration_s : from the start to the stop
    """

    def __init__(
        self, core: BridgeCore, link: Link, rate_hz: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._core, self._link, self._period_s, self._clock = core, link, 1.0 / rate_hz, clock
        self._stop = False
        self.ticks_missed = 0
        self.duration_s = 0.0
        self._steps_s: deque[float] = deque(maxlen=KEPT)

    @property
    def step(self) -> Latency:
        """Time of a control step."""
        return latency_of(self._steps_s)

    def stop(self) -> None:
        """End :meth:`run` within a period; a signal handler may call it."""
        self._stop = True

    def run(self, duration_s: float | None = None) -> None:
        """Run until stopped, or for a time; then send corrections of zero and shut the bus down."""
        start_s = due_s = self._clock()
        end_s = np.inf if duration_s is None else start_s + duration_s
        try:
            while not self._stop and (now_s := self._clock()) < end_s:
                if now_s < due_s:
                    self._read(min(due_s, end_s) - now_s)
                    continue
                self._read_waiting()
                self._control()
                due_s += self._period_s
                late = int((self._clock() - due_s) / self._period_s)
                if late > 0:
                    self.ticks_missed += late
                    due_s += late * self._period_s
        finally:
            self.duration_s = self._clock() - start_s
            self._link.send(self._core.stop(self._clock()))
            self._link.close()

    def _read(self, timeout_s: float) -> bool:
        frame = self._link.receive(timeout_s)
        if frame is None:
            return False
        self._core.receive(frame, self._clock())
        return True

    def _read_waiting(self) -> None:
        for _ in range(MAX_READ):
            if not self._read(0.0):
                return

    def _control(self) -> None:
        began_s = self._clock()
        frames = self._core.tick(began_s)
        self._steps_s.append(self._clock() - began_s)
        if self._link.send(frames):
            self._core.sent(self._clock())


def latency_of(times_s: Sequence[float]) -> Latency:
    """Return median and 99th percentile of times.

    Examples
    --------
    >>> latency_of([0.001, 0.002, 0.003])
    Latency(median_ms=2.0, p99_ms=2.98)
    >>> latency_of([])
    Latency(median_ms=None, p99_ms=None)
    """
    if not times_s:
        return Latency(None, None)
    median, p99 = np.percentile(np.asarray(times_s), [50.0, 99.0])
    return Latency(round(1e3 * float(median), 4), round(1e3 * float(p99), 4))
