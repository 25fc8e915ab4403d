"""The gate of data for a robot that is served: what is implausible or doubtful in its samples, while it drives.

Its last minute is judged as a run of a log is (:func:`pipelines.data.datasets.verdict`), in the same sentences, on the
thread that classifies.  Nothing is refused: a robot that drives is not stopped by a doubt about its units.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from pipelines.data.datasets import verdict
from terrain.errors import TerrainError
from terrain.logs.plausibility import Check, Level, worst
from terrain.records import Reading, RunLog, Stream
from terrain.robots import Robot

KEPT_S = 60.0  #: Of samples; in a minute a robot turns, starts and stops
FIRST_S = 15.0  #: Units and gravity show at once, and turns soon
EVERY_S = 30.0
MAX_ROWS = 6000  #: Of a stream: of a faster one every other sample, or fewer, are judged


class LiveGate:
    """Judge the last minute of samples from time to time.

    Parameters
    ----------
    robot_name, robot : of the session; None for a robot without a description
    channels : of each stream
    thread : that judges; at once without one

    Attributes
    ----------
    doubts : by check and place, what is implausible or doubtful; one is withdrawn where that is found sound later
    """

    def __init__(
        self,
        robot_name: str,
        channels: Mapping[str, Sequence[str]],
        robot: Robot | None,
        thread: ThreadPoolExecutor | None = None,
    ) -> None:
        self.doubts: dict[tuple[str, str], Check] = {}
        self._name, self._robot, self._thread = robot_name, robot, thread
        self._channels, self._kept = dict(channels), {name: deque[Reading]() for name in channels}
        self._due_s = np.nan
        self._judging: Future[tuple[Check, ...]] | None = None

    @property
    def sentences(self) -> list[str]:
        """What is implausible, then what is doubtful, a sentence each."""
        checks = sorted(self.doubts.values(), key=lambda check: check.level != Level.IMPLAUSIBLE)
        return [f"{check.level} {check.sentence}" for check in checks]

    def step(self, time_s: float, readings: Mapping[str, Reading]) -> None:
        """Take the samples of a step, and judge those of the last minute where that is due; it does not raise."""
        for name, reading in readings.items():
            kept = self._kept[name]
            kept.append(reading)
            while kept[0].time_s[-1] < time_s - KEPT_S:
                kept.popleft()
        if np.isnan(self._due_s):
            self._due_s = time_s + FIRST_S
        if self._judging is not None and self._judging.done():
            self._take(self._judging.result())
            self._judging = None
        if time_s < self._due_s or self._judging is not None:
            return
        self._due_s = time_s + EVERY_S
        taken = {name: list(kept) for name, kept in self._kept.items() if kept}
        if self._thread is None:
            self._take(self._judge(taken))
        else:
            self._judging = self._thread.submit(self._judge, taken)

    def _judge(self, taken: Mapping[str, Sequence[Reading]]) -> tuple[Check, ...]:
        streams = {}
        for name, readings in taken.items():
            time_s, values = (np.concatenate(each) for each in zip(*readings, strict=True))
            latest_s = np.maximum.accumulate(np.where(np.isfinite(time_s), time_s, -np.inf))
            rising = np.isfinite(time_s) & (time_s > np.concatenate([[-np.inf], latest_s[:-1]]))
            rows = np.flatnonzero(rising)[:: 1 + int(rising.sum()) // MAX_ROWS]
            if len(rows) > 1:
                finite = np.where(np.isfinite(values[rows]), values[rows], np.nan)
                streams[name] = Stream(time_s[rows], finite, tuple(self._channels[name]))
        try:
            return verdict(RunLog("live", self._name, streams), self._robot)
        except (TerrainError, ValueError, ArithmeticError):  # what no log holds is no reason to stop
            return ()

    def _take(self, checks: Sequence[Check]) -> None:
        for key in {(check.check, check.place) for check in checks}:
            of_key = [check for check in checks if (check.check, check.place) == key]
            level = worst(of_key)
            if level in (Level.DOUBTFUL, Level.IMPLAUSIBLE):
                self.doubts[key] = next(check for check in of_key if check.level == level)
            elif level == Level.OK:
                self.doubts.pop(key, None)
