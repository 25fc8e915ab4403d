"""Situations to compare controllers in: scenario, soils, conditions and faults, drawn by a seed."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.records import Command, Label, RunLog, Sample
from terrain.robots import Robot
from terrain.simulation.run import simulate
from terrain.simulation.scenario import (
    RATE_HZ,
    SCENARIOS,
    Conditions,
    Faults,
    Patch,
    Scenario,
    draw_conditions,
    fastest_mps_of,
    make_scenario,
)
from terrain.simulation.sensors import Gnss
from terrain.terramechanics.soil import Soil, load_soil, scattered, soil_names

COURSE = "course"  #: Terrain of scenarios that cross all soils in one drive.
STARTS, BRAKE, SLOPE, MIXED = "starts", "brake", "slope", "mixed"

#: Of ``starts``: long enough to evaluate 5 s of each, and to learn the slip of steady motion.
STARTS_HOLD_S, STARTS_REST_S, N_STARTS = 6.0, 1.5, 3
#: Default length of ``mixed``, and the interval in it without the camera.
MIXED_S, CAMERA_LOST_S = 90.0, (28.0, 31.0)
#: Scenarios made for comparisons, and what there is to say of them; those of ``terrain simulate`` are accepted, too.
SITUATIONS = {
    STARTS: "Stand, start, hold the speed, stop: three times. Metrics of a start are means of the second "
    "and third, when the slip of steady motion is known; those of the first are listed beside them in the "
    "table.",
    "straight": "",
    COURSE: "All terrains one after the other.",
    SLOPE: "Uphill; the steepest grade is searched for at each seed.",
    BRAKE: "Drive, and stop as fast as possible.",
    "circle": "",
    "crab": "",
    MIXED: "Terrains in any order, and no camera for three seconds.",
}


def usual_speed(robot: Robot) -> float:
    """Return the speed of a situation by default: 1 m/s, or 0.6 of what motors give that are slower than that.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> [round(usual_speed(load_robot(name)), 2) for name in ("husky", "robotino")]
    [1.0, 0.56]
    """
    limit_mps = fastest_mps_of(robot)
    return 1.0 if limit_mps >= 1.0 else 0.6 * limit_mps


class Situation(NamedTuple):
    """All that a simulated drive needs beside a robot and a controller."""

    scenario: Scenario
    soils: Mapping[str, Soil]
    conditions: Conditions
    faults: Faults
    seed: np.random.SeedSequence


@dataclass(frozen=True, slots=True)
class SituationOptions:
    """What is chosen of a situation."""

    duration_s: float | None = None
    speed_mps: float | None = None  #: :func:`usual_speed` of the robot by default
    accel_mps2: float = 1.0
    grade_deg: float = 0.0  #: uphill along the initial heading
    radius_factors: tuple[float, float, float] | None = None  #: true over nominal radius; drawn by default
    leg_backlash_rad: float = 0.0  #: of the third leg


def make_situation(
    name: str, robot: Robot, terrain: str, seed: int, options: SituationOptions = SituationOptions()
) -> Situation:
    """Return a situation of :data:`SITUATIONS`, or of the scenarios of ``terrain simulate``, for a robot.

    Load, soil, tyres, roughness and noise are drawn, by seed and terrain alone: a soil, or ``course`` for all of
    them.  ``course`` and ``mixed`` have slopes and undulations as fields have (``data/spread``); all others have
    the chosen grade.  ``ConfigError`` is raised where they do not go together, or an option is out of range.
    """
    known = (*SITUATIONS, *(scenario for scenario in SCENARIOS if scenario not in SITUATIONS))
    if name not in known:
        raise ConfigError(f"scenario {name!r} is unknown: use one of {', '.join(known)}")
    over_all = terrain == COURSE
    if over_all != (name in (COURSE, MIXED)):
        raise ConfigError(
            f"scenario {name!r} does not go with terrain {terrain!r}: 'course' is for 'course' and 'mixed'"
        )
    soils = {soil.name: soil for soil in map(load_soil, soil_names() if over_all else (terrain,))}
    drawn_for = terrain if over_all else next(iter(soils))  # the soil's name, wherever its file lies
    key = [seed, zlib.crc32(drawn_for.encode())]
    drawn, driven, simulated = np.random.SeedSequence(key).spawn(3)
    rng = np.random.default_rng(drawn)
    soils = {name: scattered(soil, rng) for name, soil in soils.items()}
    chosen: dict[str, Any] = {} if over_all else {"grade_ratio": (0.0, 0.0), "undulation_ratio": 0.0}
    if options.leg_backlash_rad:
        chosen["leg_backlash_rad"] = options.leg_backlash_rad
    if options.grade_deg:
        chosen["grade_ratio"] = (math.tan(math.radians(options.grade_deg)), 0.0)
    if options.radius_factors is not None:
        chosen["radius_factors"] = options.radius_factors
    conditions = replace(draw_conditions(rng, robot=robot), **chosen)
    number, names = int(driven.generate_state(1)[0]), list(soils)
    duration_s, accel_mps2 = options.duration_s, options.accel_mps2
    speed_mps = usual_speed(robot) if options.speed_mps is None else options.speed_mps
    changes = {"accel_mps2": accel_mps2} if accel_mps2 != 1.0 else {}
    if name == STARTS:
        if duration_s is not None:
            raise ConfigError(f"scenario 'starts' is as long as its {N_STARTS} starts: leave duration_s out")
        # stand, start, hold the speed, stop, several times: as ``terrain simulate`` has it, but longer
        enough_s = 60.0 + 4.0 * speed_mps / accel_mps2 if accel_mps2 > 0 else None
        checked = make_scenario(STARTS, robot, names[0], enough_s, speed_mps, accel_mps2=accel_mps2)
        ramp_s = speed_mps / accel_mps2
        lengths_s = (ramp_s, STARTS_HOLD_S, ramp_s, STARTS_REST_S) * N_STARTS
        knots_s = np.cumsum([0.0, 1.0, *lengths_s])
        speeds = [0.0, 0.0, *(speed_mps, speed_mps, 0.0, 0.0) * N_STARTS]
        time_s = np.arange(round(knots_s[-1] * RATE_HZ) + 1) / RATE_HZ
        twist = np.zeros((time_s.size, 3))
        twist[:, 0] = np.interp(time_s, knots_s, speeds)
        scenario = replace(checked, time_s=time_s, twist=twist)
    elif name == MIXED:
        length_s = MIXED_S if duration_s is None else duration_s
        whole = make_scenario("complex", robot, names[0], length_s, speed_mps, number, **changes)
        # patches of 5 to 9 m in drawn order, no two alike in a row
        patches, start_m, of_patches = list[Patch](), 0.0, np.random.default_rng(driven)
        while start_m < float(whole.distance_m[-1]):
            others = [each for each in names if not patches or each != patches[-1].terrain]
            patches.append(Patch(start_m, others[int(of_patches.integers(len(others)))]))
            start_m += float(of_patches.uniform(5.0, 9.0))
        scenario = replace(whole, name=MIXED, patches=tuple(patches))
    else:
        made = "climb" if name == SLOPE else name
        scenario = make_scenario(made, robot, names, duration_s, speed_mps, number, **changes)
    faults = Faults(camera_lost_s=(CAMERA_LOST_S,)) if name == MIXED else Faults()
    return Situation(scenario, soils, conditions, faults, simulated)


def simulate_situation(
    robot: Robot, situation: Situation, controller: Callable[[Sample], Command], delay_s: float
) -> RunLog:
    """Return the log of a robot in a situation, driven by a controller with a delay from a sample to the wheel.

    Robots of other drives than swerve have a satellite receiver, beside a camera where one is described.
    """
    return simulate(
        robot,
        situation.scenario,
        situation.soils,
        situation.seed,
        run_id="drive",
        conditions=situation.conditions,
        faults=situation.faults,
        controller=controller,
        command_delay_s=delay_s,
        gnss=None if robot.drive == "swerve" else Gnss(),
    )


def start_times(scenario: Scenario) -> list[float]:
    """Return the times at which motion is desired after a rest."""
    desired = np.abs(scenario.twist).max(axis=1) > 0
    return [float(time_s) for time_s in scenario.time_s[:-1][np.diff(desired.astype(int)) == 1]]


def desired_until(scenario: Scenario) -> float:
    """Return the last time at which motion is desired; 0 where none is."""
    desired = np.flatnonzero(np.abs(scenario.twist).max(axis=1) > 0)
    return float(scenario.time_s[desired[-1]]) if desired.size else 0.0


def brake_time(scenario: Scenario) -> float:
    """Return the time from which on standstill is desired, to the end."""
    return float(scenario.time_s[scenario.time_s > desired_until(scenario)][0])


def terrain_changes(labels: Sequence[Label]) -> list[tuple[float, str]]:
    """Return the time at which each new terrain begins, and its name, of a run's labels."""
    return [
        (after.start_s, after.terrain)
        for before, after in pairwise(labels)
        if after.terrain != before.terrain
    ]
