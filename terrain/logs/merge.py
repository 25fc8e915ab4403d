"""Runs that hold the same measurements: reported, refused, or made one run that holds each stretch once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.logs.duplicates import SharedStretch, groups_of, shared_stretches
from terrain.records import Label, RunLog, Stream

PART_GAP_S = 1.0
"""Between two parts of a merged run; far longer than the gaps that a window may have."""

LABEL_MARGIN_S = 2.0
"""Labels are compared this far inside of a stretch, whose ends are known to a second."""

MAX_SHOWN = 3
"""Pairs that a refusal names."""

Part = tuple[RunLog, float, float]
"""A run, and start and end of what is kept of it."""


class DistinctRuns(NamedTuple):
    """Runs of which no two hold the same measurements, and the ids of those that were merged."""

    runs: list[RunLog]
    merged: tuple[tuple[str, ...], ...] = ()


def distinct_runs(runs: Sequence[RunLog], *, merge: bool) -> DistinctRuns:
    """Return runs of which no two hold the same measurements.

    Parameters
    ----------
    runs : of one data set
    merge : make one run of those that share a stretch, which then counts once; else they are refused

    Raises
    ------
    DataError
        if runs share a stretch and are not to be merged, or label it differently.
    """
    found = shared_stretches(runs)
    if not found:
        return DistinctRuns(list(runs))
    refuse_other_labels(runs, found)
    if not merge:
        raise DataError(
            f"{'; '.join(sentences(found))}: held out, they would be recognised and not classified; remove "
            "one of them, or use --merge-duplicates to treat them as one run"
        )
    return DistinctRuns(merge_runs(runs, found), groups_of(found))


def sentences(found: Sequence[SharedStretch]) -> list[str]:
    """Return what the shared stretches are, in words; beyond the first ones their number.

    Examples
    --------
    >>> sentences([SharedStretch("a", "b", 0.0, 9.0, 100.0, 109.0)])
    ['runs a and b hold the same measurements for 9.0 s (from 0.0 s of a and 100.0 s of b)']
    """
    shown = [
        f"runs {each.first} and {each.second} hold the same measurements for {each.duration_s:.1f} s "
        f"(from {each.first_start_s:.1f} s of {each.first} and {each.second_start_s:.1f} s of {each.second})"
        for each in found[:MAX_SHOWN]
    ]
    if len(found) > MAX_SHOWN:
        shown.append(f"and so do {len(found) - MAX_SHOWN} more pairs of runs")
    return shown


def merge_runs(runs: Sequence[RunLog], stretches: Sequence[SharedStretch]) -> list[RunLog]:
    """Return runs of which no two share a stretch.

    Of the runs of a group, the first with labels is kept whole; what others hold besides follows it, on its
    clock, with gaps.  A merged run bears the id of the run that was kept whole; what a gap touches is in no
    window.

    Parameters
    ----------
    runs : with ids of their own
    stretches : that they share, as :func:`~terrain.logs.duplicates.shared_stretches` finds them

    Raises
    ------
    DataError
        if two runs label a stretch differently, or the rest of a run has other channels.

    Examples
    --------
    >>> imu = Stream(np.arange(4.0), np.ones((4, 1)), ("gyro_z_radps",))
    >>> a, b = (RunLog(name, "husky", {"imu": imu}, ((0.0, 4.0, "ice"),)) for name in "ab")
    >>> [run.run_id for run in merge_runs([a, b], [SharedStretch("a", "b", 0.0, 3.0, 0.0, 3.0)])]
    ['a']
    """
    refuse_other_labels(runs, stretches)
    by_id = {run.run_id: run for run in runs}
    merged: dict[str, RunLog] = {}
    absorbed: set[str] = set()
    for group in groups_of(stretches):
        in_order = [run for run in runs if run.run_id in group]
        members = sorted(in_order, key=lambda run: not run.labels)  # stable: labelled runs first
        first = members[0]
        parts: list[Part] = []
        for number, run in enumerate(members[1:], 1):
            before = {earlier.run_id for earlier in members[:number]}
            taken = [
                stretch.of(run.run_id)
                for stretch in stretches
                if run.run_id in (stretch.first, stretch.second)
                and (stretch.first in before or stretch.second in before)
            ]
            parts += [(run, *span) for span in _complement(run, taken)]
        merged[first.run_id] = _join(first, parts)
        absorbed |= set(group) - {first.run_id}
    return [merged.get(run_id, run) for run_id, run in by_id.items() if run_id not in absorbed]


def refuse_other_labels(runs: Sequence[RunLog], stretches: Sequence[SharedStretch]) -> None:
    """Refuse runs that hold the same measurements under different labels.

    Raises
    ------
    DataError
        that names both runs and both labels.
    """
    by_id = {run.run_id: run for run in runs}
    for stretch in stretches:
        first, second = (
            _terrains(by_id[name], *stretch.of(name)) for name in (stretch.first, stretch.second)
        )
        if first and second and first != second:
            raise DataError(
                f"runs {stretch.first} and {stretch.second} hold the same measurements under the labels "
                f"{' and '.join(first)} and {' and '.join(second)}: correct one, or remove a run"
            )


def _terrains(run: RunLog, start_s: float, end_s: float) -> tuple[str, ...]:
    """Return the labels inside of a stretch."""
    margin_s = min(LABEL_MARGIN_S, (end_s - start_s) / 4)
    inside = [
        label.terrain
        for label in run.labels
        if label.start_s < end_s - margin_s and label.end_s > start_s + margin_s
    ]
    return tuple(dict.fromkeys(inside))


def _complement(run: RunLog, taken: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the spans of a run outside of some stretches."""
    spans, at_s = [], min(float(stream.time_s[0]) for stream in run.streams.values())
    end_s = max(float(stream.time_s[-1]) for stream in run.streams.values())
    for start_s, stop_s in sorted(taken):
        if start_s - at_s > PART_GAP_S:
            spans.append((at_s, start_s))
        at_s = max(at_s, stop_s)
    if end_s - at_s > PART_GAP_S:
        spans.append((at_s, end_s + 1e-9))
    return spans


def _join(first: RunLog, parts: Sequence[Part]) -> RunLog:
    """Return a run followed by parts of others."""
    if not parts:
        return first
    times_s = {name: [stream.time_s] for name, stream in first.streams.items()}
    values = {name: [stream.values] for name, stream in first.streams.items()}
    labels = list(first.labels)
    end_s = max(float(stream.time_s[-1]) for stream in first.streams.values())
    for run, start_s, stop_s in parts:
        shift_s = end_s + PART_GAP_S - start_s
        for name, stream in first.streams.items():
            other = run.streams.get(name)
            if other is None or set(other.channels) != set(stream.channels):
                raise DataError(
                    f"runs {first.run_id} and {run.run_id} hold the same measurements, but not the same "
                    f"channels of stream {name!r}: remove one of the runs"
                )
            inside = (other.time_s >= start_s) & (other.time_s < stop_s)
            order = [other.channels.index(channel) for channel in stream.channels]
            times_s[name].append(other.time_s[inside] + shift_s)
            values[name].append(other.values[inside][:, order])
        labels += [
            Label(max(each.start_s, start_s) + shift_s, min(each.end_s, stop_s) + shift_s, each.terrain)
            for each in run.labels
            if each.start_s < stop_s and each.end_s > start_s
        ]
        end_s = shift_s + stop_s
    streams = {
        name: Stream(np.concatenate(times_s[name]), np.concatenate(values[name]), stream.channels)
        for name, stream in first.streams.items()
    }
    return RunLog(
        first.run_id, first.robot, streams, tuple(labels), first.source, first.dropped, first.session,
        first.filter,
    )  # fmt: skip
