"""In which runs a logger has a fault: of whole sessions, or of successive runs of one, confirmed by runs held out.

A logger is set up once a session, or once more within it.  Runs scattered over a session that look as if columns were
exchanged are runs in which the body did not do what the wheels say, as on ice.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terrain.records import Array

#: A session has a fault if that ratio of the runs that can say so do.
MIN_RATIO = 0.8
#: Of a session with fewer, successive runs have it if they are so many, and so large a part of those that can say so.
MIN_STRETCH, MIN_STRETCH_RATIO = 3, 0.2
#: What a run that contradicts costs, in runs that confirm.
CONTRADICTS = 3


def faulty_runs(sessions: Sequence[str], votes: Array) -> list[int]:
    """Return the runs that have a fault, in order.

    ``votes`` (runs,) are 1 for runs that show it, -1 for those that contradict, and 0 for those that cannot say, which
    have it if the others of their session do, or all sessions that can say.

    Examples
    --------
    >>> faulty_runs(["a"] * 4 + ["b"] * 4, np.array([1, 0, 1, 1, -1, -1, 0, -1]))
    [0, 1, 2, 3]
    >>> faulty_runs([""] * 8, np.array([1, -1, -1, 1, -1, -1, -1, 1]))  # scattered runs
    []
    """
    has: set[int] = set()
    names, of = (
        list(dict.fromkeys(sessions)),
        np.array([list(dict.fromkeys(sessions)).index(s) for s in sessions]),
    )
    silent, every = [], True
    for k in range(len(names)):
        places = np.flatnonzero(of == k)
        own = votes[places]
        for_, against = int((own > 0).sum()), int((own < 0).sum())
        if not for_ + against:
            silent += places.tolist()
        elif for_ >= MIN_RATIO * (for_ + against):
            has |= set(places.tolist())
        else:
            every = False
            first, end = _stretch(own)
            n = int((own[first:end] > 0).sum())
            if n >= max(MIN_STRETCH, MIN_STRETCH_RATIO * (for_ + against)):
                has |= set(places[first:end].tolist())
    return sorted(has | set(silent if has and every else []))


def _stretch(votes: Array) -> tuple[int, int]:
    """Return first and end of the successive runs that show a fault most."""
    score = np.where(votes < 0, -CONTRADICTS, votes)
    best, first, end, start, total = 0, 0, 0, 0, 0
    for i, each in enumerate(score.tolist()):
        if total <= 0:
            start, total = i, 0
        total += each
        if total > best:
            best, first, end = total, start, i + 1
    return first, end


def halves(places: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return every other of some runs, and the rest: what is found in either has to be found in the other."""
    return list(places[::2]), list(places[1::2])
