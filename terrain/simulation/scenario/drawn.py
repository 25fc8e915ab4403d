"""Drives whose legs are drawn: labelled surveys, and courses over patches of every terrain."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from terrain.records import Array
from terrain.simulation.scenario.legs import (
    ACCEL_MPS2,
    AT_REST,
    STAND_S,
    YAW_ACCEL_RADPS2,
    DriveRequest,
    Leg,
    ramp_s,
    remaining_s,
    sample_times,
    take_legs,
    twists_of,
)
from terrain.simulation.scenario.scenario import Patch, distance_travelled_m

SPOT_RADPS = 0.6
"""Yaw rate of ``spot_turn``, and the fastest turn on the spot of ``survey``."""

PATCH_M = (6.0, 12.0)
"""Length of a terrain patch of ``course``."""

SLIP_MARGIN = 1.25
"""A slipping robot gets less far than commanded: ``course`` drives this much further than its patches are
long, so that with 20 % of slip the last one is crossed as well."""


def survey(request: DriveRequest, length_s: float) -> list[Leg]:
    """Draw legs, and brake in time to be at rest at the end."""
    fastest = request.limit((1.2 * request.speed_mps, 0.0, 0.0))
    brake_s = max(ramp_s(fastest), SPOT_RADPS / YAW_ACCEL_RADPS2)
    driven_s = remaining_s("survey", length_s, brake_s + STAND_S, at_least_s=6.0)
    legs, over_s = take_legs(_survey_legs(request), driven_s)
    hold_s = legs[-1].hold_s - over_s
    if hold_s < 0:  # braking starts in the middle of a ramp, from the twist that was reached there
        legs[-1] = legs[-1]._replace(twist=twists_of(legs, np.array([driven_s]))[0])
    legs[-1] = legs[-1]._replace(hold_s=max(0.0, hold_s))
    return [*legs, Leg(AT_REST, length_s)]


def _survey_legs(request: DriveRequest) -> Iterator[Leg]:
    rng = request.rng
    yield Leg(AT_REST, STAND_S)
    yield _stretch(request, 1.0, gentle_1pm=0.2)
    while True:
        kind = rng.choice(["stretch", "stop", "backward", "spot"], p=[0.7, 0.1, 0.1, 0.1])
        if kind == "stretch":
            yield _stretch(request, 1.0, gentle_1pm=0.2)
            continue
        yield Leg(AT_REST, rng.uniform(1.0, 2.0), rng.uniform(0.5, 1.0))
        if kind == "backward":
            yield _stretch(request, -1.0, gentle_1pm=0.2)
            yield Leg(AT_REST, rng.uniform(1.0, 2.0), rng.uniform(0.5, 1.0))
        elif kind == "spot":
            yaw_radps = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, SPOT_RADPS)
            yield Leg(request.limit((0.0, 0.0, yaw_radps)), rng.uniform(3.0, 5.0))
            yield Leg(AT_REST, 1.0)


def _stretch(request: DriveRequest, direction: float, gentle_1pm: float) -> Leg:
    """Draw a stretch of steady speed, every other one an arc of at most this curvature."""
    rng = request.rng
    speed_mps = direction * rng.uniform(0.4, 1.2) * request.speed_mps
    curvature_1pm = rng.integers(2) * rng.uniform(-gentle_1pm, gentle_1pm)
    twist = request.limit((speed_mps, 0.0, curvature_1pm * speed_mps))
    return Leg(twist, rng.uniform(4.0, 6.0), rng.uniform(0.5, 1.0))


def course(
    request: DriveRequest, desired_s: float | None, terrains: tuple[str, ...]
) -> tuple[Array, Array, tuple[Patch, ...]]:
    """Lay patches and drive over them; a given duration lays as many as are reached in it."""
    patch_rng, motion_rng = request.rng.spawn(2)
    request = request._replace(rng=motion_rng)
    rounds = _rounds(terrains, patch_rng)
    laid, end_m = next(rounds)
    if desired_s is None:
        slowest_mps = request.limit((0.4 * request.speed_mps, 0.0, 0.4 * request.speed_mps * 0.15))[0]
        length_s = 2 * STAND_S + 2 * request.speed_mps / ACCEL_MPS2 + SLIP_MARGIN * end_m / slowest_mps
    else:
        length_s = desired_s
        remaining_s("course", length_s, STAND_S + 1.2 * request.speed_mps / 0.5, at_least_s=3.0)
    time_s = sample_times(length_s)
    twist = twists_of(take_legs(_course_legs(request), length_s)[0], time_s)
    reached_m = distance_travelled_m(time_s, twist) / SLIP_MARGIN
    if desired_s is None:
        n = int(np.searchsorted(reached_m, end_m)) + 1
        return time_s[:n], twist[:n], tuple(laid)
    while end_m < reached_m[-1]:
        patches, end_m = next(rounds)
        laid += patches
    return time_s, twist, tuple(patch for patch in laid if patch.start_m < reached_m[-1])


def _course_legs(request: DriveRequest) -> Iterator[Leg]:
    yield Leg(AT_REST, STAND_S)
    while True:
        yield _stretch(request, 1.0, gentle_1pm=0.15)


def _rounds(terrains: tuple[str, ...], rng: np.random.Generator) -> Iterator[tuple[list[Patch], float]]:
    """Yield round after round of patches, every terrain once in each, and where the round ends."""
    start_m, last = 0.0, ""
    while True:
        names = [terrains[i] for i in rng.permutation(len(terrains))]
        if names[0] == last:
            names.append(names.pop(0))  # a change of terrain at every boundary, where there are two
        patches = []
        for terrain in names:
            patches.append(Patch(start_m, terrain))
            start_m += rng.uniform(*PATCH_M)
        last = names[-1]
        yield patches, start_m
