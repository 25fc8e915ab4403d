"""Peak resident memory and processor time of this process and of all that it started."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread

EVERY_S = 0.1
"""From sample to sample: a run takes some ten times less, its memory is seen in some of the samples."""

_PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 1e6


class Peak:
    """The largest sum of resident memory that was sampled, in MB; shared pages count for each process."""

    def __init__(self) -> None:
        self.mb = 0.0

    def sample(self) -> None:
        """Take one sample."""
        self.mb = max(self.mb, sum(_rss_mb(pid) for pid in process_tree(os.getpid())))


def process_tree(pid: int) -> list[int]:
    """Return a process and all that it started, directly or through others; those that ended are left out."""
    found, pids = [], [pid]
    while pids:
        pid = pids.pop()
        found.append(pid)
        try:
            for task in Path(f"/proc/{pid}/task").iterdir():
                pids += [int(child) for child in (task / "children").read_text().split()]
        except OSError:
            continue
    return found


def cpu_s() -> float:
    """Return the processor time that this process and all that it started have taken so far."""
    ticks = 0
    for pid in process_tree(os.getpid()):
        try:
            after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            ticks += int(after_name[11]) + int(after_name[12])
        except (OSError, ValueError, IndexError):
            continue
    return ticks / os.sysconf("SC_CLK_TCK")


def _rss_mb(pid: int) -> float:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE_MB
    except (OSError, ValueError, IndexError):
        return 0.0


@contextmanager
def peak_memory() -> Iterator[Peak]:
    """Sample memory while a block lasts, from a thread of its own."""
    peak, ended = Peak(), Event()

    def watch() -> None:
        while not ended.wait(EVERY_S):
            peak.sample()

    thread = Thread(target=watch, name="memory", daemon=True)
    peak.sample()
    thread.start()
    try:
        yield peak
    finally:
        ended.set()
        thread.join()
        peak.sample()
