"""An observer sample by sample, from readings as they come from a robot."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from terrain.estimation.observers.family import Observer, ObserverStatus
from terrain.estimation.observers.rows import RowFeed
from terrain.extension import Correction
from terrain.records import Array, Reading
from terrain.robots import Robot


class LiveObserverEstimate(NamedTuple):
    """What is believed at one tick; arrays are the caller's to keep.

    Parameters
    ----------
    time_s : stamp of the wheels
    mean, std : (d,) states and their standard deviations, in the order of :attr:`Observer.states`
    slip, slip_std : (k,) in the order of :attr:`Observer.slips`; NaN where it is not observed
    status : of the estimates
    """

    time_s: float
    mean: Array
    std: Array
    slip: Array
    slip_std: Array
    status: ObserverStatus


class LiveObserver:
    """Slip of a robot from samples as they come; the numbers are those of a whole log.

    Parameters
    ----------
    observer : any
    robot : whose it is, corrected
    channels : names of the columns of the readings of each stream
    correction : takes the effects of an extended robot off what arrives, see
        :func:`terrain.extension.correct_live`

    Raises
    ------
    ConfigError
        if the wheels have no speed that the observer takes.
    """

    def __init__(
        self,
        observer: Observer,
        robot: Robot,
        channels: Mapping[str, tuple[str, ...]],
        correction: Correction | None = None,
    ) -> None:
        self.observer, self._channels, self._correction = observer, channels, correction
        self._feed = RowFeed(robot, observer.rows, channels)
        self._memory = np.array(observer.start)
        self._last_s = math.nan
        self._unreadable: dict[str, int] = {}
        self.latest: LiveObserverEstimate | None = None

    too_late = -math.inf, math.nan
    """Samples that come late are left out, and counted, one by one."""

    filter: None = None
    """No memory of it is kept over a restart: it starts from its first samples."""

    @property
    def name(self) -> str:
        """Name of the observer."""
        return self.observer.name

    @property
    def states(self) -> tuple[str, ...]:
        """Name of each state, in the order of ``mean`` and ``std``."""
        return self.observer.states

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind."""
        return dict(self._feed.dropped) | {f"{name}: unreadable": n for name, n in self._unreadable.items()}

    def step(self, readings: Mapping[str, Reading]) -> list[LiveObserverEstimate]:
        """Take in what arrived, and return an estimate for each sample of the wheels.

        Parameters
        ----------
        readings : by stream; any may be missing, late, repeated or wrong, and streams without names of
            channels are not looked at
        """
        if not isinstance(readings, Mapping):
            return []
        for name in readings:
            if name != "wheels" and (arrays := self._arrays(name, readings[name])) is not None:
                self._feed.push(name, *arrays)
        wheels = self._arrays("wheels", readings["wheels"]) if "wheels" in readings else None
        if wheels is None:
            return []
        found = (
            self._tick(time_s, values) for time_s, values in zip(wheels[0].tolist(), wheels[1], strict=True)
        )
        estimates = [estimate for estimate in found if estimate is not None]
        if estimates:
            self.latest = estimates[-1]
        return estimates

    def settle(self, *, all_of_them: bool = False) -> list[LiveObserverEstimate]:
        """Return nothing: every estimate has settled when it is returned."""
        return []

    def _arrays(self, name: str, reading: Reading) -> tuple[Array, Array] | None:
        """Return stamps and values; None, counted, where they are no samples of the stream."""
        if name not in self._channels:
            return None
        try:
            time_s, values = (np.asarray(part, dtype=np.float64) for part in reading)
        except (TypeError, ValueError, OverflowError):
            time_s = values = np.empty(0)
        if time_s.ndim != 1 or values.shape != (time_s.size, len(self._channels[name])):
            self._unreadable[name] = self._unreadable.get(name, 0) + 1
            return None
        if self._correction is None:
            return time_s, values
        return self._correction(name, self._channels[name], time_s, values)

    def _tick(self, time_s: float, wheels: Array) -> LiveObserverEstimate | None:
        row = self._feed.tick(time_s, wheels)
        if row is None:
            return None
        dt_s = 0.0 if math.isnan(self._last_s) else max(time_s - self._last_s, 0.0)  # a clock may be set
        self._last_s = time_s
        self._memory = self.observer.step(self.observer.params, self._memory, row, dt_s)
        output = self.observer.read(self.observer.params, self._memory)
        return LiveObserverEstimate(time_s, *output[:4], ObserverStatus(output.status))
