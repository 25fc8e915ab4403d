"""Legs of a drive, and the twists that they make.

A leg goes from the twist before it to its own in a ramp with bounded accelerations, and holds it.  From rest
and to rest the ratio of the three components of the twist stays constant, so the centre of rotation does not
move during such a ramp and the steering angles do not change.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.records import Array, read_only
from terrain.simulation.scenario.scenario import RATE_HZ

ACCEL_MPS2 = 1.0
"""Change of the velocity in ramps, and the most in any; thesis 7.2.3."""

YAW_ACCEL_RADPS2 = 1.0
"""The most that the yaw rate changes in ramps: at the third wheel less than :data:`ACCEL_MPS2`."""

STAND_S = 1.0
"""Rest before the first leg, and the least after the last."""


class Leg(NamedTuple):
    """A twist to go to, within the robot's limits, for how long it is held, and how fast it is gone to."""

    twist: Array
    hold_s: float
    accel_mps2: float = ACCEL_MPS2


class DriveRequest(NamedTuple):
    """What every drive is made from; ``limit`` shortens a twist to what the robot can."""

    speed_mps: float
    limit: Callable[[Any], Array]
    rng: np.random.Generator
    accel_mps2: float
    sideways: bool


class NamedDrive(NamedTuple):
    """A drive of fixed or drawn legs on one terrain.

    Parameters
    ----------
    default_s : length in s, or what it follows from
    legs : from a request and a length to the legs
    smooth : whether its ramps start and end without a step of the acceleration
    """

    default_s: float | Callable[[DriveRequest], float]
    legs: Callable[[DriveRequest, float], list[Leg]]
    smooth: bool = False

    def default_length_s(self, request: DriveRequest) -> float:
        """Return how long the drive lasts unless a length is given."""
        return self.default_s(request) if callable(self.default_s) else self.default_s


AT_REST = read_only(np.zeros(3))


def ramp_s(change: Any, accel_mps2: float = ACCEL_MPS2, smooth: bool = False) -> float:
    """Return how long a change of twist takes; the peak of a smooth one is pi/2 times its mean."""
    x_mps, y_mps, yaw_radps = change
    linear_s = float(max(math.hypot(x_mps, y_mps) / accel_mps2, abs(yaw_radps) / YAW_ACCEL_RADPS2))
    return linear_s * math.pi / 2 if smooth else linear_s


def take_legs(legs: Iterator[Leg], length_s: float) -> tuple[list[Leg], float]:
    """Take legs until they last this long; return them and by how much they last longer."""
    taken: list[Leg] = []
    end_s, before = 0.0, AT_REST
    while end_s < length_s:
        leg = next(legs)
        end_s += ramp_s(leg.twist - before, leg.accel_mps2) + leg.hold_s
        before = leg.twist
        taken.append(leg)
    return taken, end_s - length_s


def twists_of(legs: Sequence[Leg], time_s: Array, smooth: bool = False) -> Array:
    """Return the twist (n, 3) at each time, the last one held on after the end.

    The admissible region is convex: with both ends of a ramp in it, all of the ramp is.
    """
    knots_s, knots = [0.0], [AT_REST]
    for leg in legs:
        change_s = ramp_s(leg.twist - knots[-1], leg.accel_mps2, smooth)
        for length_s, there in ((change_s, bool((leg.twist == knots[-1]).all())), (leg.hold_s, True)):
            if length_s > 0 or not there:  # a step takes no time
                knots_s.append(knots_s[-1] + length_s)
                knots.append(leg.twist)
    place = np.interp(time_s, knots_s, np.arange(len(knots_s)))
    before = np.minimum(place.astype(int), len(knots) - 2)
    part = place - before
    if smooth:
        part = (1 - np.cos(np.pi * part)) / 2
    twists = np.array(knots)
    return np.asarray(twists[before] + part[:, None] * (twists[before + 1] - twists[before]))


def sample_times(length_s: float) -> Array:
    """Return the times (n,) of the twists of a drive of this length."""
    return np.arange(round(length_s * RATE_HZ) + 1) / RATE_HZ


def remaining_s(name: str, length_s: float, taken_s: float, at_least_s: float) -> float:
    """Return what is left of the time, once the parts of a fixed length are taken away."""
    if length_s < taken_s + at_least_s - 1e-9:
        shortest_s = math.ceil(10 * (taken_s + at_least_s)) / 10
        raise ConfigError(
            f"duration_s is {length_s:g}, too short for {name!r} at this speed: at least {shortest_s:g} s"
        )
    return length_s - taken_s
