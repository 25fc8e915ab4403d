"""Regimes of driving that a person can ask for: a range of speed, straight on, in a curve or on the spot."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from terrain.records import Array

MAX_SPEEDS, MIN_WIDTH_MPS = 4, 0.15
"""At most so many ranges of speed, none narrower: closer speeds are not worth asking an operator for."""

EDGE_STEP_MPS, EDGE_SHIFT_MPS = 0.05, 0.1
"""Edges are multiples of the first; an inner one is moved by up to the second to where fewest windows lie, so
that one commanded speed is not cut in two."""

STRAIGHT_RADPS = 0.1
"""A smaller yaw rate is straight on: 11 degrees in a window of 2 s."""

STRAIGHT_RATIO, SPIN_RATIO = 0.1, 0.8
"""Difference of the speeds of the two sides over their sum: straight on below the first where no yaw rate is
measured, on the spot above the second, where one side nearly stands or turns against the other."""

SPIN_RADIUS_M = 0.3
"""A robot without two sides turns on the spot below this speed per yaw rate: about half a track width."""


class Motion(NamedTuple):
    """How the robot moved in each of n windows.

    Parameters
    ----------
    speed_mps : (n,) magnitude of the speed of the fastest wheel, mean over the window
    yaw_rate_radps : (n,) magnitude of the mean yaw rate; NaN where no gyroscope measures it
    turn_ratio : (n,) ``|v_right - v_left| / (|v_right| + |v_left|)`` of the mean speeds of the two sides: 0
        straight on, 1 where one side stands or they turn against each other; NaN without two sides
    """

    speed_mps: Array
    yaw_rate_radps: Array
    turn_ratio: Array

    def of(self, rows: Array) -> Motion:
        """Return the motion in some of the windows."""
        return Motion(self.speed_mps[rows], self.yaw_rate_radps[rows], self.turn_ratio[rows])


class Manoeuvre(IntEnum):
    """What a robot does in a window."""

    STRAIGHT = 0
    CURVE = 1
    SPIN = 2


class Regimes(NamedTuple):
    """Regimes of ranges of speed, numbered manoeuvre by manoeuvre within each range.

    ``edges_mps`` are those of the ranges, the outer ones among them; what lies outside of these is in the
    range beside it.
    """

    edges_mps: tuple[float, ...]

    def numbers(self, speed_mps: Array, yaw_rate_radps: Array, turn_ratio: Array) -> Array:
        """Return the regime (n,) of windows; arguments as :func:`manoeuvres`."""
        within = np.searchsorted(np.array(self.edges_mps[1:-1]), speed_mps, side="right")
        found = within * len(Manoeuvre) + manoeuvres(speed_mps, yaw_rate_radps, turn_ratio)
        return np.asarray(found, dtype=int)

    def name(self, number: int) -> str:
        """Return a regime in words.

        Examples
        --------
        >>> regimes = Regimes((0.1, 0.3, 0.6))
        >>> [regimes.name(number) for number in (0, 4)]
        ['straight at 0.1 to 0.3 m/s', 'curve at 0.3 to 0.6 m/s']
        """
        within, manoeuvre = divmod(number, len(Manoeuvre))
        low, high = self.edges_mps[within : within + 2]
        return f"{Manoeuvre(manoeuvre).name.lower()} at {low:g} to {high:g} m/s"


def learn_regimes(speed_mps: Array) -> Regimes:
    """Return regimes whose ranges of speed divide what was driven evenly, between commanded speeds.

    The range is that from the 1st to the 99th percentile of the windows, whatever their terrain.

    Examples
    --------
    >>> learn_regimes(np.array([0.2, 0.22, 0.4, 0.6, 0.8])).edges_mps
    (0.2, 0.35, 0.55, 0.8)
    >>> learn_regimes(np.array([0.48, 0.5, 0.52])).edges_mps
    (0.45, 0.55)
    """
    low, high = np.quantile(speed_mps, [0.01, 0.99])
    n_ranges = int(np.clip((high - low) / MIN_WIDTH_MPS, 1, MAX_SPEEDS))
    inner = {_moved(edge, speed_mps) for edge in np.linspace(low, high, n_ranges + 1)[1:-1]}
    ends = np.floor(low / EDGE_STEP_MPS), max(np.ceil(high / EDGE_STEP_MPS), 1.0)
    first, last = (float(np.round(EDGE_STEP_MPS * end, 6)) for end in ends)
    return Regimes((first, *sorted(edge for edge in inner if first < edge < last), last))


def _moved(edge_mps: float, speed_mps: Array) -> float:
    """Return the multiple of the step near an edge with the fewest windows beside it."""
    reach = round(EDGE_SHIFT_MPS / EDGE_STEP_MPS)
    nearest = round(edge_mps / EDGE_STEP_MPS)
    places = EDGE_STEP_MPS * np.arange(max(nearest - reach, 1), nearest + reach + 1)
    beside = [int(np.sum(np.abs(speed_mps - place) < EDGE_STEP_MPS / 2)) for place in places]
    best = min(zip(beside, np.abs(places - edge_mps), places, strict=True))
    return float(np.round(best[2], 6))


def manoeuvres(speed_mps: Array, yaw_rate_radps: Array, turn_ratio: Array) -> Array:
    """Return the :class:`Manoeuvre` (n,) of each window.

    Parameters
    ----------
    speed_mps : (n,) magnitude of the speed of the fastest wheel
    yaw_rate_radps : (n,) magnitude; NaN where not measured
    turn_ratio : (n,) difference of the speeds of the two sides over their sum; NaN without two sides

    Examples
    --------
    >>> ratio = np.array([0.0, 0.3, 1.0, np.nan])
    >>> manoeuvres(np.full(4, 0.5), np.array([0.0, 0.2, 0.6, np.nan]), ratio).tolist()
    [0, 1, 2, 0]
    """
    straight = np.where(
        np.isnan(yaw_rate_radps), ~(turn_ratio >= STRAIGHT_RATIO), yaw_rate_radps < STRAIGHT_RADPS
    )
    by_radius = speed_mps < SPIN_RADIUS_M * yaw_rate_radps
    spin = np.where(np.isnan(turn_ratio), ~straight & by_radius, turn_ratio >= SPIN_RATIO)
    return np.where(spin, Manoeuvre.SPIN, np.where(straight, Manoeuvre.STRAIGHT, Manoeuvre.CURVE))
