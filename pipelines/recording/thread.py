"""The thread that writes the recordings of all sessions of a process."""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path
from time import monotonic
from typing import Protocol

import numpy as np

FLUSH_S = 2.0
"""Time between two writings of a recording: what a killed process loses."""


class Recording(Protocol):
    """What the thread works on."""

    def work(self) -> bool:
        """Write what waits; say whether there is more to come."""
        ...

    def close(self, timeout_s: float = 0.0) -> Path | None:
        """End the recording."""
        ...


class RecordingThread:
    """A thread that writes any number of recordings, one after the other.

    Parameters
    ----------
    flush_s : time between two writings of a recording

    Examples
    --------
    >>> writer = RecordingThread()
    >>> writer.stop()
    True
    """

    def __init__(self, flush_s: float = FLUSH_S) -> None:
        import pyarrow.parquet

        pyarrow.table({"now": np.zeros(1)})  # imports what it needs; later that would hold up the sessions

        self._flush_s = flush_s
        self._changed = threading.Condition()
        self._recordings: list[Recording] = []
        self._due: deque[Recording] = deque()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    def add(self, recording: Recording) -> None:
        """Write a recording from now on."""
        with self._changed:
            self._recordings.append(recording)

    def due(self, recording: Recording) -> None:
        """Note that a recording has ended, and is to be written at once."""
        with self._changed:
            self._due.append(recording)
            self._changed.notify()

    def stop(self, timeout_s: float = 10.0) -> bool:
        """Close and write all recordings, and end; say whether there was time for it.

        What there was no time for is recovered at the next start.
        """
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        next_s = monotonic() + self._flush_s
        while True:
            with self._changed:
                while not (self._due or self._stopped) and monotonic() < next_s:
                    self._changed.wait(max(next_s - monotonic(), 0.001))
                stopped = self._stopped
                everything = stopped or monotonic() >= next_s
                now = list(self._recordings) if everything else list(self._due)
                self._due.clear()
            if stopped:
                for one in now:
                    one.close()
            done = [one for one in now if not one.work()]
            with self._changed:
                self._recordings = [one for one in self._recordings if one not in done]
            if everything:
                next_s = monotonic() + self._flush_s
            if stopped and not self._due:
                return
