"""Which stretches of held-out runs make a course, and in which order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.logs.splicing import Part, splice_runs
from terrain.records import Array, RunLog, Windows

SHORTEST_S, LONGEST_S = 10.0, 30.0
"""Time on a ground before the next: shorter ones are no more than five windows, longer ones hardly ever
change."""


class Course(NamedTuple):
    """A log over several grounds; the run behind each of its labels, and whether it was spliced."""

    log: RunLog
    runs: tuple[str, ...]
    spliced: bool


def held_out_parts(runs: Mapping[str, RunLog], windows: Windows) -> list[Part]:
    """Return the parts of runs that held-out windows lie in, one a label.

    A run that was held out in part, as the only one of its class, gives what its held-out windows span.

    Parameters
    ----------
    runs : by id
    windows : held out, of these runs
    """
    run_id, terrain = windows.run_id.astype(str), windows.terrain.astype(str)
    parts = []
    for name in np.unique(run_id):
        for label in runs[name].labels:
            begins_s = windows.start_s[(run_id == name) & (terrain == label.terrain)]
            inside = (begins_s >= label.start_s - 1e-6) & (begins_s < label.end_s)
            if inside.any():
                begins_s = begins_s[inside]
                end_s = float(begins_s.max()) + windows.length_s
                parts.append(Part(runs[name], float(begins_s.min()), end_s, label.terrain))
    return parts


def stretches_of(part: Part, rng: np.random.Generator) -> list[Part]:
    """Cut a part of a run into stretches of random lengths without remainder; none where it is too short."""
    found = []
    start_s, left_s = part.start_s, part.end_s - part.start_s
    while left_s >= SHORTEST_S:
        length_s = float(rng.uniform(SHORTEST_S, LONGEST_S))
        if left_s - length_s < SHORTEST_S:
            length_s = left_s if left_s <= LONGEST_S else left_s / 2
        found.append(part._replace(start_s=start_s, end_s=start_s + length_s))
        start_s, left_s = start_s + length_s, left_s - length_s
    return found


def order_stretches(stretches: Sequence[Part], rng: np.random.Generator) -> list[Part]:
    """Order stretches at random so that the ground changes from each to the next.

    The ground with the most left comes next where otherwise too much of it would be left at the end;
    what cannot be placed is left out.
    """
    waiting: dict[str, list[Part]] = {}
    for i in rng.permutation(len(stretches)):
        waiting.setdefault(stretches[i].terrain, []).append(stretches[i])
    found: list[Part] = []
    while True:
        last = found[-1].terrain if found else ""
        names = sorted(name for name, kept in waiting.items() if kept and name != last)
        if not names:
            return found
        counts = Counter({name: len(waiting[name]) for name in names})
        n_left = sum(len(kept) for kept in waiting.values())
        most, n_most = counts.most_common(1)[0]
        weights = np.array([counts[name] for name in names], dtype=float)
        chosen = most if 2 * n_most > n_left else names[rng.choice(len(names), p=weights / weights.sum())]
        found.append(waiting[chosen].pop())


def spliced_course(
    parts: Sequence[Part], channels: Mapping[str, Sequence[str]], run_id: str, rng: np.random.Generator
) -> Course | None:
    """Return a course through all parts, each second of them at most once; None where no ground changes."""
    ordered = order_stretches([s for part in parts for s in stretches_of(part, rng)], rng)
    if len(ordered) < 2:
        return None
    log = splice_runs(ordered, channels, run_id)
    return Course(log, tuple(part.run.run_id for part in ordered), True)


def recorded_courses(parts: Sequence[Part]) -> list[Course]:
    """Return the held-out runs over several grounds as courses of their own."""
    counts = Counter(part.run.run_id for part in parts)
    logs = {part.run.run_id: part.run for part in parts if counts[part.run.run_id] > 1}
    return [Course(log, (name,) * len(log.labels), False) for name, log in logs.items()]


def ground_at(log: RunLog, time_s: Array) -> Array:
    """Return which label (n,) holds at each time, one that ends there included; -1 where none does."""
    found = np.full(len(time_s), -1)
    for i, label in enumerate(log.labels):
        found[(time_s > label.start_s + 1e-6) & (time_s <= label.end_s + 1e-6)] = i
    return found
