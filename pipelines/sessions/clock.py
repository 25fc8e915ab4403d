"""A robot's clock, as seen from the other end of a network: stamps arrive late, and never early."""

from __future__ import annotations

import math
from collections import deque

REMEMBERED = 64
"""Messages of which the least late one tells the difference of the clocks."""

SET_S = 0.5
"""A stamp that is further ahead of what is known, or that many in a row are behind it, is of a clock that was
set."""

N_SET = 5


class SessionClock:
    """Tell the time of a robot's clock now.

    A message that was sent at once and one that waited differ in their delay, which is never below zero: the
    difference of the clocks is that of the message that was least late among the last ones.

    Examples
    --------
    >>> clock = SessionClock()
    >>> clock.received(100.0, now_s=5.0)
    >>> clock.received(100.1, now_s=5.3)  # this one waited for 0.2 s
    >>> round(clock.at(5.3), 6)
    100.3
    """

    def __init__(self) -> None:
        self._ahead: deque[float] = deque(maxlen=REMEMBERED)
        self._n_behind = 0
        self._offset_s = math.nan
        self.times_set = 0

    def received(self, stamp_s: float, now_s: float) -> None:
        """Take the newest stamp of a message that has just arrived; a stamp that is no number is left out."""
        ahead_s = stamp_s - now_s
        if not math.isfinite(ahead_s):
            return
        if not math.isnan(self._offset_s):
            self._n_behind = self._n_behind + 1 if ahead_s < self._offset_s - SET_S else 0
            if ahead_s > self._offset_s + SET_S or self._n_behind >= N_SET:
                self._ahead.clear()
                self._n_behind = 0
                self.times_set += 1
        self._ahead.append(ahead_s)
        self._offset_s = max(self._ahead)

    def at(self, now_s: float) -> float:
        """Return the robot's time now; NaN before the first stamp."""
        return now_s + self._offset_s
