"""Long runs cut into parts, so that few of them can be fitted and checked on others.

What is stated of runs is judged on runs held out, and its interval is the scatter between runs; of one or two
recordings there is none.  Parts of a minute or less, one after the other, take the place of runs then: what lasts
longer than a part (a payload, a warm motor) is one and the same in all of them, so that intervals hold for that drive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from terrain.records import RunLog, Stream

FEW = 3  #: Fewer runs are cut: of three or more some can be held out.
LONG_S = 55.0  #: Together, from which on runs are long: a drive of a minute.
PARTS = 16  #: Of all runs together, about.
SHORTEST_S, LONGEST_S = 6.0, 60.0  #: Of a part: what a low-pass leaves of it, and what changes within it.


def cut_long(runs: Sequence[RunLog]) -> list[RunLog]:
    """Return parts of runs where these are few and long, each called by its run and number; else the runs.

    Examples
    --------
    >>> import numpy as np
    >>> run = RunLog("a", "husky", {"imu": Stream(np.arange(0.0, 60.5, 0.5), np.zeros((121, 1)), ("gyro_z_radps",))})
    >>> [(part.run_id, part.end_s) for part in cut_long([run])][:2], len(cut_long([run] * 3))
    ([('a_part_01', 5.5), ('a_part_02', 11.5)], 3)
    """
    whole_s = sum(run.end_s - run.start_s for run in runs)
    if len(runs) >= FEW or whole_s < LONG_S:
        return list(runs)
    length_s = min(max(whole_s / PARTS, SHORTEST_S), LONGEST_S)
    parts: list[RunLog] = []
    for run in runs:
        n = int((run.end_s - run.start_s) / length_s)
        if n < 2:
            parts.append(run)
            continue
        step_s = (run.end_s - run.start_s) / n
        for k in range(n):
            begin_s, end_s = run.start_s + k * step_s, run.start_s + (k + 1) * step_s
            parts.append(_between(run, begin_s, end_s, f"{run.run_id}_part_{k + 1:02d}", k + 1 == n))
    return parts


def _between(run: RunLog, begin_s: float, end_s: float, run_id: str, last: bool) -> RunLog:
    """Return what a run has from one instant up to another; the last part has the end, too."""
    streams = {}
    for name, stream in run.streams.items():
        kept = (stream.time_s >= begin_s) & ((stream.time_s <= end_s) if last else (stream.time_s < end_s))
        if kept.sum() >= 2:
            streams[name] = Stream(stream.time_s[kept], stream.values[kept], stream.channels)
    labels = tuple(
        label._replace(start_s=max(label.start_s, begin_s), end_s=min(label.end_s, end_s))
        for label in run.labels
        if label.start_s < end_s and label.end_s > begin_s
    )
    return replace(run, run_id=run_id, streams=streams, labels=labels)


def cut_note(runs: Sequence[RunLog], parts: Sequence[RunLog]) -> tuple[str, ...]:
    """Return a sentence on what was cut; none where nothing was."""
    if len(runs) == len(parts):
        return ()
    length_s = sum((part.end_s - part.start_s) for part in parts) / len(parts)
    return (
        f"{len(runs)} long run{'s' * (len(runs) > 1)} cut into {len(parts)} parts of about {length_s:.0f} s, which "
        "count as runs: intervals are of the scatter between parts, and hold for this drive.",
    )
