"""The time of a bus: that of its frames' stamps, continued between frames by this computer's clock."""

from __future__ import annotations

import math

WINDOW_S = 0.5
"""The difference between both clocks is taken anew so often: it follows drift, and a clock that was set."""


class BusClock:
    """Time on the clock of the bus's stamps.

    A frame is read some time after its stamp, never before: the largest difference of a window is that of the
    frame that waited least. One stamp may be wrong: it is the second largest that counts, of frames that are
    more than one.

    Parameters
    ----------
    offset_s : time of the bus over that of this computer, until frames have shown it

    Examples
    --------
    >>> clock = BusClock()
    >>> for read_s in (5.0, 5.01, 5.02):
    ...     clock.received(read_s + 1000.0, read_s)
    >>> clock.time(5.03)
    1005.03
    """

    def __init__(self, offset_s: float = 0.0) -> None:
        self._offset_s = offset_s
        self._began_s = math.nan
        self._first = self._second = -math.inf
        self._found = False

    def received(self, stamp_s: float, read_s: float) -> None:
        """Take the stamp of a frame that was read at a time of this computer."""
        if not math.isfinite(stamp_s):
            return
        if math.isnan(self._began_s):
            self._began_s = read_s
        ahead_s = stamp_s - read_s
        if ahead_s > self._first:
            self._first, self._second = ahead_s, self._first
        elif ahead_s > self._second:
            self._second = ahead_s
        best_s = self._second if math.isfinite(self._second) else self._first
        if not self._found:
            self._offset_s = best_s
            self._found = read_s - self._began_s >= WINDOW_S
        if read_s - self._began_s >= WINDOW_S:
            self._offset_s = best_s
            self._began_s, self._first, self._second = read_s, -math.inf, -math.inf

    def time(self, read_s: float) -> float:
        """Return the time of the bus at a time of this computer."""
        return read_s + self._offset_s
