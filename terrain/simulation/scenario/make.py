"""Scenarios by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from terrain.errors import ConfigError
from terrain.kinematics.commands import scaled
from terrain.records import Array
from terrain.robots import BicycleRobot, Robot, SwerveRobot
from terrain.simulation.scenario.drawn import course
from terrain.simulation.scenario.drives import DRIVES
from terrain.simulation.scenario.legs import ACCEL_MPS2, DriveRequest, sample_times, twists_of
from terrain.simulation.scenario.scenario import RATE_HZ, Patch, Scenario

LONGEST_S = 3600.0
"""A run is held whole in memory, step by step: an hour is a gigabyte and a half."""

_RAMPED = ("straight", "climb", "starts")
"""Those whose acceleration can be chosen."""

CRUISING_MPS, CRUISING_SHARE = 1.0, 1.0 / 3.0
"""Speed where none is given, and the share of its fastest speed that a slower or car-like robot drives."""

SCENARIOS: tuple[str, ...] = (*DRIVES, "course")
"""Names that :func:`make_scenario` accepts."""


def make_scenario(
    name: str,
    robot: Robot,
    terrains: str | Sequence[str],
    duration_s: float | None = None,
    speed_mps: float | None = None,
    seed: int | np.random.Generator = 0,
    accel_mps2: float = ACCEL_MPS2,
) -> Scenario:
    """Return a scenario by name; all start at rest, all but ``straight``, ``climb`` and ``course`` end there.

    ============= =================================================================================== stand
    standing still, for calibration straight      1 s of rest, 1 m/s^2 up to the speed, held to the end climb
    the same for 15 s, for a slope brake         1 s of rest, 1 m/s^2 up to the speed, held for 4 s, and a
    command to stop at once; 4 s of rest circle        a full turn and more to the left on a radius of 1.5 m,
    at 0.5 m/s at most crab          backward, forward, to both sides and along both diagonals, forth and back
    each; smooth arc           the same with 0.3 rad/s, and down to rest starts        from rest at 1 m/s^2 to
    the speed, 3 s, and down at 1 m/s^2, again and again spot_turn     in place to the left, to the right, at
    0.6 rad/s, several times complex       forward, curves to both sides, backward with curves, sideways,
    diagonally; smooth survey        labelled runs: stretches of 4 to 6 s, straight and in gentle arcs, now
    and then a stop, a
                  stretch backward or a turn on the spot; drawn
    course        over patches of 6 to 12 m of every terrain in turn, in drawn request, at changing speed
    ============= ===================================================================================

    Robots that cannot drive sideways have no ``crab``, and in ``complex`` turn on the spot instead; only
    swerve robots have ``course``, and car-like ones no ``spot_turn``.

    Parameters
    ----------
    name : one of :data:`SCENARIOS`
    robot : no twist saturates its wheels; without motors, which swerve robots need, they have no limit
    terrains : of the ground, one unless the scenario is ``course``; the names are not looked up
    duration_s : what the scenario is made for by default; taken to a whole number of samples
    speed_mps : cruising speed, by default 1 m/s, of a slower or car-like robot a third of its fastest;
        ``survey`` and ``course`` draw from 0.4 to 1.2 times it, backward and sideways
        ``complex`` is slower, and so is all of ``crab``
    seed : of everything drawn; the same gives the same bytes
    accel_mps2 : of the ramps of ``straight``, ``climb`` and ``starts``; infinite, they are steps

    Raises
    ------
    ConfigError
        for an unknown name, terrains that do not fit it, a duration too short for it, a speed beyond the
        robot, an acceleration that is none or that the scenario does not take, or a scenario that the robot
        cannot drive.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> straight = make_scenario("straight", load_robot("agrimaro"), "grass")
    >>> straight.time_s[[0, 75, -1]], straight.twist[[0, 75, -1], 0], straight.patches
    (array([ 0. ,  1.5, 20. ]), array([0. , 0.5, 1. ]), (Patch(start_m=0.0, terrain='grass'),))
    """
    if name not in SCENARIOS:
        raise ConfigError(f"scenario {name!r} is unknown: use one of {', '.join(SCENARIOS)}")
    grounds = (terrains,) if isinstance(terrains, str) else tuple(terrains or ())
    if not grounds or not all(isinstance(terrain, str) and terrain for terrain in grounds):
        raise ConfigError(f"terrains are {terrains!r}: one name or several are required")
    if len(grounds) > 1 and name != "course":
        raise ConfigError(
            f"scenario {name!r} is driven on one terrain, {len(grounds)} are given: use 'course'"
        )
    if not _can_drive(robot, name):
        raise ConfigError(f"scenario {name!r} is not for robot {robot.name} with the drive {robot.drive!r}")
    request = DriveRequest(
        *_ability(robot, speed_mps), _generator(seed), _checked_accel(name, accel_mps2), robot.sideways
    )
    desired_s = _checked_duration(duration_s)
    if name == "course":
        time_s, twist, patches = course(request, desired_s, grounds)
    else:
        drive = DRIVES[name]
        length_s = drive.default_length_s(request) if desired_s is None else desired_s
        time_s = sample_times(length_s)
        twist = twists_of(drive.legs(request, length_s), time_s, drive.smooth)
        patches = (Patch(0.0, grounds[0]),)
    return Scenario(name, RATE_HZ, time_s, twist, patches)


def _can_drive(robot: Robot, name: str) -> bool:
    able = {
        "crab": robot.sideways,
        "course": isinstance(robot, SwerveRobot),
        "spot_turn": not isinstance(robot, BicycleRobot),
    }
    return able.get(name, True)


def _checked_duration(duration_s: float | None) -> float | None:
    if duration_s is None:
        return None
    if not _is_number(duration_s) or not 1 / RATE_HZ <= duration_s <= LONGEST_S:
        raise ConfigError(
            f"duration_s is {duration_s!r}, a time from {1 / RATE_HZ:g} to {LONGEST_S:g} s is required"
        )
    return float(duration_s)


def _ability(robot: Robot, speed_mps: float | None) -> tuple[float, Callable[[Any], Array]]:
    """Return the speed, checked, and what shortens a twist to what the robot can."""
    positions_m, radius_m = robot.wheel_positions_m, robot.wheel_radius_m
    motors = robot.motors if isinstance(robot, SwerveRobot) else robot.completed.motors
    speed_max_radps, car = motors.speed_max_radps, isinstance(robot, BicycleRobot)
    if isinstance(robot, BicycleRobot):
        speed_max_radps = min(speed_max_radps, robot.speed_max_mps / radius_m)
    if speed_mps is None:
        fastest_mps = radius_m * speed_max_radps
        slow = car or fastest_mps < CRUISING_MPS
        speed_mps = CRUISING_SHARE * fastest_mps if slow else CRUISING_MPS
    if not _is_number(speed_mps) or not 0 < speed_mps <= radius_m * speed_max_radps:
        raise ConfigError(
            f"speed_mps is {speed_mps!r}: robot {robot.name} drives above 0 and up to "
            f"{radius_m * speed_max_radps:g} m/s"
        )
    if car or math.isinf(speed_max_radps):  # wheels of a car turn as fast as it drives
        return float(speed_mps), lambda twist: np.asarray(twist, dtype=np.float64)
    return float(speed_mps), lambda twist: scaled(positions_m, radius_m, twist, speed_max_radps)


def _checked_accel(name: str, accel_mps2: float) -> float:
    if not (_is_number(accel_mps2) or accel_mps2 == math.inf) or not accel_mps2 > 0:
        raise ConfigError(f"accel_mps2 is {accel_mps2!r}, a number above zero is required, inf for steps")
    if accel_mps2 != ACCEL_MPS2 and name not in _RAMPED:
        raise ConfigError(
            f"accel_mps2 is {accel_mps2:g}: scenario {name!r} has ramps of its own, "
            f"only {', '.join(_RAMPED)} take it"
        )
    return float(accel_mps2)


def _generator(seed: int | np.random.Generator) -> np.random.Generator:
    if isinstance(seed, np.random.Generator):
        return seed
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ConfigError(f"seed is {seed!r}, a whole number from 0 up is required")
    return np.random.default_rng(seed)


def _is_number(value: Any) -> bool:
    return (
        isinstance(value, int | float | np.integer | np.floating)
        and not isinstance(value, bool)
        and math.isfinite(value)
    )
