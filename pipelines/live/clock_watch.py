"""Whether the clock of a robot's stamps was set back, or runs on after stamps that were far ahead."""

from __future__ import annotations

import math
from collections.abc import Mapping

from terrain.records import Reading

BEHIND_S = 1.0
"""A reading that is so far behind the newest stamp of its stream is late, or its clock was set."""

N_BEHIND = 5
"""Readings of a stream in a row that are behind: late ones are fewer."""


class ClockWatch:
    """Watch the stamps of streams.

    Examples
    --------
    >>> import numpy as np
    >>> watch = ClockWatch()
    >>> stamps = (100.0, 100.1, 40.0, 40.1, 40.2, 40.3, 40.4, 40.5)
    >>> [watch.was_set({"imu": Reading(np.array([t]), np.zeros((1, 1)))}) for t in stamps]
    [False, False, False, False, False, False, True, False]
    """

    def __init__(self) -> None:
        self._newest_s: dict[str, float] = {}
        self._n_behind: dict[str, int] = {}
        self.n_set = 0

    def was_set(self, samples: Mapping[str, Reading]) -> bool:
        """Take the stamps of readings; say whether they are of a clock that was set since the call before."""
        for stream in samples:
            stamp_s = last_stamp_s(samples, stream)
            if not math.isfinite(stamp_s):
                continue
            newest_s = self._newest_s.get(stream, -math.inf)
            if stamp_s >= newest_s - BEHIND_S:
                self._newest_s[stream], self._n_behind[stream] = max(stamp_s, newest_s), 0
                continue
            self._n_behind[stream] += 1
            if self._n_behind[stream] >= N_BEHIND:
                self._newest_s.clear()
                self._n_behind.clear()
                self.n_set += 1
                return True
        return False


def last_stamp_s(samples: Mapping[str, Reading], stream: str) -> float:
    """Return the last stamp of a stream; NaN where it has none that can be read."""
    try:
        return float(samples[stream][0][-1])
    except (TypeError, ValueError, LookupError, OverflowError):
        return math.nan
