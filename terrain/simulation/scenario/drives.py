"""Drives with a fixed sequence of legs.

Sources: Danzi, AgriMaRo thesis, 7.2.3 (``straight``: 1 m/s^2 to 1 m/s) and 6.2 (``complex``: curves, forward
and backward, in both directions; the order and the speeds are assumed).
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from terrain.records import Array
from terrain.simulation.scenario.drawn import SPOT_RADPS, survey
from terrain.simulation.scenario.legs import (
    ACCEL_MPS2,
    AT_REST,
    STAND_S,
    DriveRequest,
    Leg,
    NamedDrive,
    ramp_s,
    remaining_s,
)

YAW_RATE_RADPS = 0.3
"""Of ``arc`` and the curves of ``complex``."""

CIRCLE_M = 1.5
"""Radius of ``circle``."""

CIRCLE_MPS = 0.5
"""Speed of ``circle``, unless a lower one is given."""

BRAKE_S = 4.0
"""Of ``brake``: how long the speed is held before the stop, and the rest after it."""


def _stand(request: DriveRequest, length_s: float) -> list[Leg]:
    return [Leg(AT_REST, length_s)]


def _straight(request: DriveRequest, length_s: float) -> list[Leg]:
    return _ahead("straight", request, length_s)


def _climb(request: DriveRequest, length_s: float) -> list[Leg]:
    return _ahead("climb", request, length_s)


def _ahead(name: str, request: DriveRequest, length_s: float) -> list[Leg]:
    start_s = request.speed_mps / request.accel_mps2
    hold_s = remaining_s(name, length_s, STAND_S + start_s, at_least_s=1.0)
    ahead = request.limit((request.speed_mps, 0.0, 0.0))
    return [Leg(AT_REST, STAND_S), Leg(ahead, hold_s, request.accel_mps2)]


def _brake_s(request: DriveRequest) -> float:
    return STAND_S + request.speed_mps / ACCEL_MPS2 + 2 * BRAKE_S


def _brake(request: DriveRequest, length_s: float) -> list[Leg]:
    taken_s = STAND_S + request.speed_mps / ACCEL_MPS2 + BRAKE_S
    hold_s = remaining_s("brake", length_s, taken_s, at_least_s=1.0)
    ahead = request.limit((request.speed_mps, 0.0, 0.0))
    return [Leg(AT_REST, STAND_S), Leg(ahead, hold_s), Leg(AT_REST, BRAKE_S, math.inf)]


def _circle_twist(request: DriveRequest) -> Array:
    speed_mps = min(request.speed_mps, CIRCLE_MPS)
    return request.limit((speed_mps, 0.0, speed_mps / CIRCLE_M))


def _circle_s(request: DriveRequest) -> float:
    twist = _circle_twist(request)
    turn_s = 2 * math.pi / float(twist[2])
    return math.ceil(2 * STAND_S + 2 * ramp_s(twist) + turn_s)


def _circle(request: DriveRequest, length_s: float) -> list[Leg]:
    twist = _circle_twist(request)
    turn_s = 2 * math.pi / float(twist[2])
    hold_s = remaining_s("circle", length_s, 2 * STAND_S + 2 * ramp_s(twist), at_least_s=turn_s)
    return [Leg(AT_REST, STAND_S), Leg(twist, hold_s), Leg(AT_REST, STAND_S)]


def _arc(request: DriveRequest, length_s: float) -> list[Leg]:
    twist = request.limit((request.speed_mps, 0.0, YAW_RATE_RADPS))
    hold_s = remaining_s("arc", length_s, 2 * STAND_S + 2 * ramp_s(twist), at_least_s=1.0)
    return [Leg(AT_REST, STAND_S), Leg(twist, hold_s), Leg(AT_REST, STAND_S)]


def _starts(request: DriveRequest, length_s: float) -> list[Leg]:
    drive_s = 3.0 + 2 * request.speed_mps / request.accel_mps2
    n = max(1, int((length_s - STAND_S) / (drive_s + STAND_S)))
    stand_s = remaining_s("starts", length_s, n * drive_s, at_least_s=(n + 1) * STAND_S) / (n + 1)
    ahead = request.limit((request.speed_mps, 0.0, 0.0))
    once = [Leg(ahead, 3.0, request.accel_mps2), Leg(AT_REST, stand_s, request.accel_mps2)]
    return [Leg(AT_REST, stand_s), *once * n]


def _spot_turn(request: DriveRequest, length_s: float) -> list[Leg]:
    left = request.limit((0.0, 0.0, SPOT_RADPS))
    around_s = 2 * ramp_s(left) + STAND_S
    n = 2 * max(1, int((length_s - STAND_S) / (2 * (around_s + 2.0))))
    hold_s = remaining_s("spot_turn", length_s, STAND_S + n * around_s, at_least_s=n * 1.0) / n
    both = [Leg(left, hold_s), Leg(AT_REST, STAND_S), Leg(-left, hold_s), Leg(AT_REST, STAND_S)]
    return [Leg(AT_REST, STAND_S), *both * (n // 2)]


_COMPLEX: tuple[tuple[float, float, float, float], ...] = (
    # speed_x and speed_y in cruising speeds, yaw rate in YAW_RATE_RADPS, share of the time that is held
    (1.0, 0.0, 0.0, 4.0),
    (0.8, 0.0, 1.0, 4.0),
    (0.8, 0.0, -1.0, 4.0),
    (0.0, 0.0, 0.0, 1.0),
    (-0.8, 0.0, 0.0, 3.0),
    (-0.6, 0.0, 1.0, 4.0),
    (-0.6, 0.0, -1.0, 4.0),
    (0.0, 0.0, 0.0, 1.5),
    (0.0, 0.5, 0.0, 3.0),
    (0.0, 0.0, 0.0, 1.0),
    (0.0, -0.5, 0.0, 3.0),
    (0.0, 0.0, 0.0, 1.5),
    (0.5, 0.5, 0.0, 3.0),
    (0.0, 0.0, 0.0, 1.5),
    (0.5, -0.5, 0.0, 3.0),
)

_ON_THE_SPOT: tuple[tuple[float, float, float, float], ...] = (
    # as above
    (0.0, 0.0, 2.0, 4.0),
    (0.0, 0.0, 0.0, 1.0),
    (0.0, 0.0, -2.0, 4.0),
)

_CRAB: tuple[tuple[float, float, float, float], ...] = (
    # as above; the steering does not move through each reversal and turns at the start after each rest
    (-0.6, 0.0, 0.0, 3.0),
    (0.6, 0.0, 0.0, 3.0),
    (0.0, 0.0, 0.0, 1.0),
    (0.0, 0.5, 0.0, 3.0),
    (0.0, -0.5, 0.0, 3.0),
    (0.0, 0.0, 0.0, 1.0),
    (0.4, 0.4, 0.0, 3.0),
    (-0.4, -0.4, 0.0, 3.0),
    (0.0, 0.0, 0.0, 1.0),
    (-0.4, 0.4, 0.0, 3.0),
    (0.4, -0.4, 0.0, 3.0),
)


def _complex(request: DriveRequest, length_s: float) -> list[Leg]:
    if request.sideways:
        return _tour("complex", _COMPLEX, request, length_s)
    ahead = tuple(leg for leg in _COMPLEX if not leg[1])
    return _tour("complex", (*ahead[:8], *_ON_THE_SPOT), request, length_s)


def _crab(request: DriveRequest, length_s: float) -> list[Leg]:
    return _tour("crab", _CRAB, request, length_s)


def _tour(
    name: str, legs: tuple[tuple[float, float, float, float], ...], request: DriveRequest, length_s: float
) -> list[Leg]:
    table = np.array(legs)
    twists = request.limit(table[:, :3] * (request.speed_mps, request.speed_mps, YAW_RATE_RADPS))
    ramps_s = sum(ramp_s(b - a, smooth=True) for a, b in pairwise([AT_REST, *twists, AT_REST]))
    shares = table[:, 3] / table[:, 3].sum()
    held_s = remaining_s(name, length_s, 2 * STAND_S + ramps_s, at_least_s=10.0)
    driven = [Leg(twist, share * held_s) for twist, share in zip(twists, shares, strict=True)]
    return [Leg(AT_REST, STAND_S), *driven, Leg(AT_REST, STAND_S)]


DRIVES: dict[str, NamedDrive] = {
    "stand": NamedDrive(20.0, _stand),
    "straight": NamedDrive(20.0, _straight),
    "arc": NamedDrive(20.0, _arc),
    "starts": NamedDrive(30.0, _starts),
    "spot_turn": NamedDrive(30.0, _spot_turn),
    "complex": NamedDrive(60.0, _complex, smooth=True),
    "survey": NamedDrive(40.0, survey),
    "climb": NamedDrive(15.0, _climb),
    "brake": NamedDrive(_brake_s, _brake),
    "circle": NamedDrive(_circle_s, _circle),
    "crab": NamedDrive(45.0, _crab, smooth=True),
}
"""All drives on one terrain."""
