"""A robot of known truth that resembles a measured skid-steer one, in five cases from simple to complete."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.trials.scattered_values import TRACK_RATIO, scattered_values

TRACK_ERROR = 1.5
"""Effective track over the nominal one, less 1: a measured Husky turns 2.5 times less than its track says."""

TRACK_SCATTER, WHEELS_LATE_S, N_STALLED = 0.15, 0.28, 4
"""Scatter of the track from run to run, delay of the wheels' stamps, and number of stalled runs."""

VALUE_RATIO = 0.05
"""Largest error of the effective track that counts as right."""


class Known(NamedTuple):
    """A case: its name, and what it has beside the track that is off."""

    name: str
    scatters: bool = False
    late: bool = False
    stalled: bool = False


KNOWN: tuple[Known, ...] = (
    Known("plain"),
    Known("scatter", scatters=True),
    Known("late", late=True),
    Known("stalled", stalled=True),
    Known("all", scatters=True, late=True, stalled=True),
)
"""Trials take them in turn."""


def track_of_runs(known: Known, rng: np.random.Generator, n_runs: int) -> list[dict[str, float]]:
    """Return the effective track of each run, by its parameter."""
    hidden = {TRACK_RATIO: TRACK_ERROR}
    if not known.scatters:
        return [dict(hidden) for _ in range(n_runs)]
    return scattered_values(hidden, rng, TRACK_SCATTER, n_runs, track=True)


def value_is_right(intervals: Mapping[str, tuple[float, float, float]]) -> bool:
    """Return whether an answer gives the effective track within :data:`VALUE_RATIO`.

    Examples
    --------
    >>> value_is_right({TRACK_RATIO: (1.6, 1.5, 1.7)}), value_is_right({TRACK_RATIO: (1.7, 1.5, 1.9)})
    (True, False)
    """
    if TRACK_RATIO not in intervals:
        return False
    true = 1.0 + TRACK_ERROR
    return abs(1.0 + intervals[TRACK_RATIO][0] - true) <= VALUE_RATIO * true
