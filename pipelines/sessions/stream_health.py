"""Health of the streams of a robot whose sensors no filter judges one by one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from terrain.records import Array, Reading

LOST_AFTER_S = 0.5
"""A stream that gives nothing for so long is lost; of one that is slower, three of its periods."""

PERIODS = 3.0


class StreamHealth:
    """Judge whether each stream comes, and keep its last values.

    Parameters
    ----------
    channels : by stream

    Examples
    --------
    >>> health = StreamHealth({"imu": ("gyro_z_radps",)})
    >>> health.take({"imu": Reading(np.array([1.0]), np.array([[0.1]]))}, 1.0)
    >>> health.health(1.2), health.health(2.0)
    ({'imu': 'fresh'}, {'imu': 'lost'})
    """

    def __init__(self, channels: Mapping[str, Sequence[str]]) -> None:
        self._channels = {stream: tuple(names) for stream, names in channels.items()}
        self._last_s = dict.fromkeys(channels, math.nan)
        self._period_s = dict.fromkeys(channels, 0.0)
        self._values: dict[str, Array] = {}

    def take(self, readings: Mapping[str, Reading], time_s: float) -> None:
        """Note what came by a time of the robot's clock."""
        for stream, reading in readings.items():
            if not len(reading.values):
                continue
            step_s = (time_s - self._last_s[stream]) / len(reading.values)
            if 0.0 < step_s < 10.0:
                self._period_s[stream] = step_s
            self._last_s[stream], self._values[stream] = time_s, reading.values[-1]

    def health(self, time_s: float) -> dict[str, str]:
        """Return ``fresh``, ``not finite`` or ``lost`` by stream."""
        found = {}
        for stream, last_s in self._last_s.items():
            allowed_s = max(LOST_AFTER_S, PERIODS * self._period_s[stream])
            if not abs(time_s - last_s) <= allowed_s:  # True for NaN, and a clock that was set back
                found[stream] = "lost"
            else:
                found[stream] = "fresh" if np.isfinite(self._values[stream]).all() else "not finite"
        return found

    def last(self, stream: str, channels: Sequence[str]) -> Array:
        """Return the last values of some channels; NaN where there is none."""
        names = self._channels.get(stream, ())
        values = self._values.get(stream)
        return np.array(
            [
                math.nan if values is None or name not in names else values[names.index(name)]
                for name in channels
            ]
        )
