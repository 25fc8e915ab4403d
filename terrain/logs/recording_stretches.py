"""Where a long recording is cut into runs: one a command, and what an operator drove between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.records import Array

MIN_RUN_S = 2.0
"""Shorter stretches hold no window and no steady speed."""

STANDING_S = 2.0
"""So long without motion ends what an operator drove."""

MARGIN_S = 0.5
"""What is kept of the standing before and after it: starts and stops are whole."""


class Cut(NamedTuple):
    """Rows ``first`` to ``end`` (not included) of a recording that make one run.

    Parameters
    ----------
    name : ``step_003``, or ``hand_000`` of what an operator drove
    first, end : rows
    commanded : whether the logged command drove it
    """

    name: str
    first: int
    end: int
    commanded: bool


class Cuts(NamedTuple):
    """Runs of a recording, and how many commands were left out because nothing moved."""

    runs: tuple[Cut, ...]
    n_still: int


def cut_recording(step: Array, commanded: Array, moving: Array, breaks: Array, period_s: float) -> Cuts:
    """Return the runs of a recording.

    A run is what follows without a break in one step under the logged command (``step_003``; where an
    operator intervened, so that it was begun anew, ``step_003_2``), or what was driven otherwise, between two
    times of standing (``hand_000``, ``hand_001``).

    Parameters
    ----------
    step : (n,) number of the command
    commanded : (n,) whether the logged command drives
    moving : (n,) whether a wheel turns
    breaks : (n,) whether samples are lost before a row
    period_s : from row to row

    Examples
    --------
    >>> step = np.repeat([0, 1, 2], 60)
    >>> moving = np.repeat([False, True, True, False], 45)
    >>> cut_recording(step, step > 0, moving, np.zeros(180, bool), 0.05).runs[:2]
    (Cut(name='step_001', first=60, end=120, commanded=True),
     Cut(name='step_002', first=120, end=180, commanded=True))
    """
    n_min = round(MIN_RUN_S / period_s)
    runs: list[Cut] = []
    seen: dict[int, int] = {}
    n_still = 0
    for first, end in _stretches(np.column_stack([step, commanded]), breaks):
        if not commanded[first] or end - first < n_min:
            continue
        if not moving[first:end].any():
            n_still += 1
            continue
        number = int(step[first])
        seen[number] = seen.get(number, 0) + 1
        again = f"_{seen[number]}" if seen[number] > 1 else ""
        runs.append(Cut(f"step_{number:03d}{again}", first, end, True))
    n_hand = 0
    for first, end in _stretches(np.asarray(commanded)[:, None], breaks):
        if commanded[first]:
            continue
        for start, stop in _driven(moving[first:end], period_s):
            if stop - start >= n_min:
                runs.append(Cut(f"hand_{n_hand:03d}", first + start, first + stop, False))
                n_hand += 1
    return Cuts(tuple(sorted(runs, key=lambda cut: cut.first)), n_still)


def _stretches(keys: Array, breaks: Array) -> Sequence[tuple[int, int]]:
    """Return first row and end of each stretch of equal keys (n, k) without a break."""
    if not len(keys):
        return []
    starts = np.flatnonzero(np.r_[True, (keys[1:] != keys[:-1]).any(axis=1) | breaks[1:].astype(bool)])
    return list(zip(starts.tolist(), [*starts[1:].tolist(), len(keys)], strict=True))


def _driven(moving: Array, period_s: float) -> list[tuple[int, int]]:
    """Return what lies between two times of standing, with a margin on both sides."""
    rows = np.flatnonzero(moving)
    if not rows.size:
        return []
    apart = np.flatnonzero(np.diff(rows) * period_s > STANDING_S)
    margin = round(MARGIN_S / period_s)
    firsts, lasts = rows[np.r_[0, apart + 1]], rows[np.r_[apart, rows.size - 1]]
    return [
        (max(int(first) - margin, 0), min(int(last) + 1 + margin, len(moving)))
        for first, last in zip(firsts, lasts, strict=True)
    ]
