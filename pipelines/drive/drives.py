"""Situations to drive in: a scenario, its ground and its day, all of a seed."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.records import Label
from terrain.robots import Robot
from terrain.simulation.conditions import Conditions, Faults, draw_conditions, load_spread
from terrain.simulation.scenario.make import SCENARIOS, make_scenario
from terrain.simulation.scenario.scenario import RATE_HZ, Patch, Scenario
from terrain.terramechanics.soil import Soil, load_soil, scattered, soil_names

COURSE = "course"
"""Word for all soils in one drive."""

STARTS_HOLD_S, STARTS_REST_S, N_STARTS = 6.0, 1.5, 3
"""Of ``starts``: long enough to see 5 s of each, and to learn what steady motion balances."""

MIXED = "mixed"
MIXED_S, LOSS_S = 90.0, (28.0, 31.0)
"""``mixed`` is so long unless told otherwise, and the camera is lost for 3 s in it."""

SLOPE = "slope"
DRIVES = ("starts", "straight", COURSE, SLOPE, "brake", "circle", "crab", MIXED)
"""Scenarios with something to show; any other scenario's name is driven too."""


class Situation(NamedTuple):
    """All that a simulated drive needs beside a robot and a controller."""

    scenario: Scenario
    soils: Mapping[str, Soil]
    conditions: Conditions
    faults: Faults
    seed: np.random.SeedSequence


def situation(
    name: str,
    robot: Robot,
    terrain: str,
    seed: int,
    *,
    duration_s: float | None = None,
    speed_mps: float = 1.0,
    accel_mps2: float = 1.0,
    grade_deg: float = 0.0,
    radius_factors: tuple[float, float, float] | None = None,
    leg_backlash_rad: float = 0.0,
) -> Situation:
    """Return a situation; what is drawn depends on the seed and the terrain alone.

    Load, soil, tyres, roughness and noise are drawn.  ``course`` and ``mixed`` have slopes and undulations as
    fields have (``data/spread``); everything else is as steep as it is told.

    Parameters
    ----------
    name : one of :data:`DRIVES`, or of the scenarios of ``terrain simulate``
    robot : swerve robot
    terrain : soil, or ``course`` for all of them
    seed : which draw
    duration_s, speed_mps, accel_mps2 : of the scenario
    grade_deg : uphill along the start's heading
    radius_factors : true radius of each wheel over the believed one; drawn by default
    leg_backlash_rad : play of the third leg

    Raises
    ------
    ConfigError
        if scenario or terrain are unknown or do not go together, or an option is out of range.
    """
    known = (*DRIVES, *(scenario for scenario in SCENARIOS if scenario not in DRIVES))
    if name not in known:
        raise ConfigError(f"scenario {name!r} is unknown: use one of {', '.join(known)}")
    over_all = terrain == COURSE
    if over_all != (name in (COURSE, MIXED)):
        raise ConfigError(
            f"scenario {name!r} does not go with terrain {terrain!r}: 'course' is for 'course' and 'mixed'"
        )
    soils = {soil.name: soil for soil in map(load_soil, soil_names() if over_all else (terrain,))}
    ground = terrain if over_all else next(iter(soils))  # its name, wherever its file lies
    key = [seed, zlib.crc32(ground.encode())]
    drawn, driven, simulated = np.random.SeedSequence(key).spawn(3)
    rng = np.random.default_rng(drawn)
    soils = {soil: scattered(described, rng) for soil, described in soils.items()}
    conditions = draw_conditions(load_spread(), rng)
    if not over_all:
        conditions = replace(conditions, grade_ratio=(0.0, 0.0), undulation_ratio=0.0)
    if leg_backlash_rad:
        conditions = replace(conditions, leg_backlash_rad=leg_backlash_rad)
    if grade_deg:
        conditions = replace(conditions, grade_ratio=(math.tan(math.radians(grade_deg)), 0.0))
    if radius_factors is not None:
        conditions = replace(conditions, radius_factors=radius_factors)
    names = list(soils)
    faults = Faults()
    drive_seed = int(driven.generate_state(1)[0])
    changes = {"accel_mps2": accel_mps2} if accel_mps2 != 1.0 else {}
    if name == "starts":
        if duration_s is not None:
            raise ConfigError(f"scenario 'starts' is as long as its {N_STARTS} starts: leave duration_s out")
        scenario = _starts(robot, names[0], speed_mps, accel_mps2)
    elif name == MIXED:
        length_s = MIXED_S if duration_s is None else duration_s
        whole = make_scenario("complex", robot, names[0], length_s, speed_mps, drive_seed, **changes)
        scenario = replace(whole, name=MIXED, patches=_patches(names, whole, np.random.default_rng(driven)))
        faults = Faults(camera_lost_s=(LOSS_S,))
    else:
        made = "climb" if name == SLOPE else name
        scenario = make_scenario(made, robot, names, duration_s, speed_mps, drive_seed, **changes)
    return Situation(scenario, soils, conditions, faults, simulated)


def _starts(robot: Robot, terrain: str, speed_mps: float, accel_mps2: float) -> Scenario:
    """Stand, start, drive, stop, again and again: as ``terrain simulate`` has it, with longer drives."""
    enough_s = 60.0 + 4.0 * speed_mps / accel_mps2 if accel_mps2 > 0 else None
    checked = make_scenario("starts", robot, terrain, enough_s, speed_mps, accel_mps2=accel_mps2)
    ramp_s = speed_mps / accel_mps2
    knots_s, speeds = [0.0, 1.0], [0.0, 0.0]
    for _ in range(N_STARTS):
        for length_s, speed in (
            (ramp_s, speed_mps),
            (STARTS_HOLD_S, speed_mps),
            (ramp_s, 0.0),
            (STARTS_REST_S, 0.0),
        ):
            knots_s.append(knots_s[-1] + length_s)
            speeds.append(speed)
    time_s = np.arange(round(knots_s[-1] * RATE_HZ) + 1) / RATE_HZ
    twist = np.zeros((time_s.size, 3))
    twist[:, 0] = np.interp(time_s, knots_s, speeds)
    return replace(checked, time_s=time_s, twist=twist)


def start_times(scenario: Scenario) -> list[float]:
    """Return the instants at which a robot that is to stand is to start."""
    desired = np.abs(scenario.twist).max(axis=1) > 0
    return [float(time_s) for time_s in scenario.time_s[:-1][np.diff(desired.astype(int)) == 1]]


def desired_until(scenario: Scenario) -> float:
    """Return the last instant at which the robot is to move; 0 where it never is."""
    desired = np.flatnonzero(np.abs(scenario.twist).max(axis=1) > 0)
    return float(scenario.time_s[desired[-1]]) if desired.size else 0.0


def brake_time(scenario: Scenario) -> float:
    """Return the instant from which on the robot is told to stand, to the end."""
    return float(scenario.time_s[scenario.time_s > desired_until(scenario)][0])


def _patches(names: list[str], scenario: Scenario, rng: np.random.Generator) -> tuple[Patch, ...]:
    patches: list[Patch] = []
    start_m, end_m = 0.0, float(scenario.distance_m[-1])
    while start_m < end_m:
        left = [name for name in names if not patches or name != patches[-1].terrain]
        patches.append(Patch(start_m, left[int(rng.integers(len(left)))]))
        start_m += float(rng.uniform(5.0, 9.0))
    return tuple(patches)


def changes_of(labels: Sequence[Label]) -> list[tuple[float, str]]:
    """Return when each new ground begins, and which, of a run's labels."""
    return [
        (after.start_s, after.terrain)
        for before, after in pairwise(labels)
        if after.terrain != before.terrain
    ]
