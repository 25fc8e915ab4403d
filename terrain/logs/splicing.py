"""Courses over several grounds, spliced from parts of runs that each lie on one.

Logs that cross from one ground to another are rare.  The samples of parts of runs, one after the other on one
clock, are such a log but for the change of driving at the splice: windows across it hold samples of both
grounds, as they would on a robot.

Samples keep their distance within a part.  At a splice a stream's next sample may come too early or too late
by up to a period, as the parts were cut without regard to it: one sample more or less is taken there, so that
the distance is between half and one and a half periods wherever the run holds such a sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.logs.schema import TIME_TOLERANCE_S
from terrain.records import Array, Label, RunLog, Stream, Windows

SHORTEST_S, LONGEST_S = 10.0, 30.0
"""Time on a ground before the next: shorter ones are no more than five windows, longer ones hardly ever
change."""

LEAST_PERIODS, MOST_PERIODS = 0.5, 1.5
"""Distance of two samples across a splice, in periods: within what the clocks of loggers do."""


class Part(NamedTuple):
    """A part ``[start_s, end_s)`` of a run, on one ground."""

    run: RunLog
    start_s: float
    end_s: float
    terrain: str


def stretches_of(part: Part, rng: np.random.Generator) -> list[Part]:
    """Cut a part of a run into stretches of random lengths without remainder; none where it is too short."""
    stretches = []
    start_s, left_s = part.start_s, part.end_s - part.start_s
    while left_s >= SHORTEST_S:
        length_s = float(rng.uniform(SHORTEST_S, LONGEST_S))
        if left_s - length_s < SHORTEST_S:
            length_s = left_s if left_s <= LONGEST_S else left_s / 2
        stretches.append(part._replace(start_s=start_s, end_s=start_s + length_s))
        start_s, left_s = start_s + length_s, left_s - length_s
    return stretches


def order_stretches(stretches: Sequence[Part], rng: np.random.Generator) -> list[Part]:
    """Order stretches at random so that the terrain changes from each to the next.

    The terrain with the most left comes next where otherwise too much of it would be left at the end;
    what cannot be placed is left out.
    """
    waiting: dict[str, list[Part]] = {}
    for i in rng.permutation(len(stretches)):
        waiting.setdefault(stretches[i].terrain, []).append(stretches[i])
    ordered: list[Part] = []
    last = ""
    while names := sorted(name for name, parts in waiting.items() if parts and name != last):
        n_of = {name: len(waiting[name]) for name in names}
        most = max(n_of, key=lambda name: n_of[name])
        if 2 * n_of[most] > sum(map(len, waiting.values())):
            last = most
        else:
            weights = np.array([*n_of.values()], dtype=float)
            last = names[rng.choice(len(names), p=weights / weights.sum())]
        ordered.append(waiting[last].pop())
    return ordered


def parts_under(runs: Mapping[str, RunLog], windows: Windows) -> list[Part]:
    """Return the parts of runs, by id, that windows lie in, one a label: what the windows of a run span."""
    run_id, terrain = windows.run_id.astype(str), windows.terrain.astype(str)
    parts = []
    for name in np.unique(run_id):
        for label in runs[name].labels:
            begins_s = windows.start_s[(run_id == name) & (terrain == label.terrain)]
            begins_s = begins_s[(begins_s >= label.start_s - TIME_TOLERANCE_S) & (begins_s < label.end_s)]
            if begins_s.size:
                end_s = float(begins_s.max()) + windows.length_s
                parts.append(Part(runs[name], float(begins_s.min()), end_s, label.terrain))
    return parts


def splice_runs(parts: Sequence[Part], channels: Mapping[str, Sequence[str]], run_id: str) -> RunLog:
    """Return one log of all parts, in order, from 0 s on, labelled with their grounds.

    Their runs have all channels, which are taken in this order, at about one rate; ``DataError`` where there is no
    part, or one holds no sample of a stream.

    Examples
    --------
    >>> imu = Stream(np.arange(100) / 10, np.ones((100, 1)), ("gyro_z_radps",))
    >>> run = RunLog("a", "husky", {"imu": imu})
    >>> parts = [Part(run, 1.0, 3.0, "grass"), Part(run, 5.05, 7.0, "sand")]
    >>> course = splice_runs(parts, {"imu": ("gyro_z_radps",)}, "course")
    >>> course.labels[1], course.streams["imu"].time_s[18:23].round(3).tolist()
    (Label(start_s=2.0, end_s=3.95, terrain='sand'), [1.8, 1.9, 2.05, 2.15, 2.25])
    """
    if not parts:
        raise DataError(f"{run_id}: there is no part to splice")
    begins_s = np.concatenate(([0.0], np.cumsum([part.end_s - part.start_s for part in parts]))).tolist()
    streams = {}
    for name, names in channels.items():
        times: list[Array] = []
        values: list[Array] = []
        for part, begin_s in zip(parts, begins_s, strict=False):
            stream, shift_s = part.run.streams[name], begin_s - part.start_s
            ends_s = np.array([part.start_s, part.end_s]) - TIME_TOLERANCE_S
            first, end = np.searchsorted(stream.time_s, ends_s)
            if first == end:
                raise DataError(
                    f"run {part.run.run_id}: no sample of stream {name!r} from {part.start_s:g} to "
                    f"{part.end_s:g} s"
                )
            if times:
                period_s, before_s = 1.0 / stream.rate_hz, times[-1][-1]
                distance_s = stream.time_s[first] + shift_s - before_s
                if distance_s < LEAST_PERIODS * period_s and first + 1 < end:
                    first += 1
                elif distance_s > MOST_PERIODS * period_s and first > 0:
                    first -= int(stream.time_s[first - 1] + shift_s - before_s > TIME_TOLERANCE_S)
            order = [stream.channels.index(channel) for channel in names]
            times.append(stream.time_s[first:end] + shift_s)
            values.append(stream.values[first:end][:, order])
        streams[name] = Stream(np.concatenate(times), np.concatenate(values), tuple(names))
    labels = tuple(map(Label, begins_s, begins_s[1:], [part.terrain for part in parts]))
    return RunLog(run_id, parts[0].run.robot, streams, labels, source="spliced from parts of runs")
