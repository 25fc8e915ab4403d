"""The next drive: the scenario that best distinguishes what the runs could not, or excites what they did not.

Every scenario of ``terrain simulate`` that the robot can drive is driven without noise, on the level and
uphill, and the sensitivities of the effects in question are whitened like those of the runs, with
variations from run to run marginalised.  Two effects are compared by their collinearity index
``1 / sqrt(1 - r)``,
``r`` the largest correlation of a change by the one with a change by the other: 1 is orthogonal, above 10
they cannot be distinguished (Brun et al., Water Resources Research 2001, of two normalised columns).
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from terrain.discrepancy import runs
from terrain.discrepancy.evidence import (
    EXCITED_RATIO,
    Z_EFFECT,
    Evidence,
    correlation,
    evidence_at,
    partial_information,
)
from terrain.discrepancy.noise import ORDER, Noise
from terrain.discrepancy.robot_terms import listed
from terrain.discrepancy.search import names_of
from terrain.discrepancy.verdict import Limit, NextDrive
from terrain.effects import BOUNDS, CHANNELS, CURRENT, effect_named
from terrain.errors import ConfigError
from terrain.kinematics.commands import wheel_motion
from terrain.records import Array
from terrain.robots import BicycleRobot, Robot
from terrain.signals import low_pass
from terrain.simulation.plants.planar import move
from terrain.simulation.scenario import RATE_HZ, SCENARIOS, make_scenario

DEFAULT_SOIL, HARD_SOIL, NEXT_RUNS = "grass", "tiles", 8
"""Of the command that simulates the next drive: a soil, one for robots that get stuck on it, and as many runs
as the blind trials have."""

GRADES_DEG = (0.0, 6.0)  #: Level, and a slope that every robot here climbs
LONGEST_S = 40.0  #: Longest part of a scenario that is simulated
CLOCK_HZ = RATE_HZ / 2  #: Of the replay: half the rate of the commands is five times what they hold
FOLLOW_S = 0.1  #: Lag of wheels and steering behind their commands; assumed

SEPARABLE_INDEX = 10.0
"""Collinearity index above which two effects are not distinguished, whatever the amplitude."""

EXACT_INDEX = 100.0  #: Above it two effects count as one
MIN_IMPROVEMENT_RATIO = 1.5  #: Least improvement by a drive that is suggested
Z_SHOWN = Z_EFFECT + 1.28  #: Expected evidence with which nine drives in ten exceed the threshold

TYPICAL_STD = dict(zip(CHANNELS, (0.01, 0.005, 0.005, 0.1, 1.0, 1.0, 0.02), strict=True))
"""Noise of channels that the runs do not have; assumed, white."""

MOST = {name: max(abs(low), abs(high)) for name, (low, high) in BOUNDS.items()}
"""Largest size that a parameter may have."""


def next_drive(
    simulation: runs.Simulation, sets: Sequence[tuple[str, ...]], missed: Sequence[Limit], info: Evidence
) -> NextDrive | None:
    """Return the next drive, None where nothing is to be distinguished or no scenario helps.

    It distinguishes the effects of sets of which one is present; where there are none, it excites what the runs
    missed.  Where a set cannot be distinguished by any drive with the channels that are logged, but could be with
    one more, the reason names it.
    """
    logged = runs.measured_channels(info.rows)
    if sets:
        return _separating_drive(simulation, sets, logged, info)
    names, bound = [limit.name for limit in missed], np.array([MOST[limit.name] for limit in missed])
    before, best, answer = np.array([limit.detection_limit for limit in missed]), 0.0, None
    for scenario, grade_deg, a in _drives(simulation, names, logged, info) if missed else ():
        with np.errstate(divide="ignore"):
            limit = Z_SHOWN / np.sqrt(np.maximum(np.diag(a), 0.0))
        excited = (limit < EXCITED_RATIO * bound) & (MIN_IMPROVEMENT_RATIO * limit < before)
        # as many as possible; the size of the limits decides between equals
        score = excited.sum() + float(np.mean(1.0 / (1.0 + np.minimum(limit / bound, 1e6))))
        if excited.any() and score > best:
            best, k, others = (
                score,
                int(np.argmin(np.where(excited, limit, np.inf) / bound)),
                excited.sum() - 1,
            )
            beside = f", and {others} more that the runs do not excite" if others else ""
            was = f"{before[k]:.2g}" if math.isfinite(before[k]) else "infinite"
            change = f"falls from {was} to {limit[k]:.2g} {missed[k].unit}"
            reason = f"the detection limit of {names[k]} {change}{beside}"
            answer = NextDrive(scenario, grade_deg, reason)
    return answer


def _separating_drive(
    simulation: runs.Simulation, sets: Sequence[tuple[str, ...]], logged: Sequence[str], info: Evidence
) -> NextDrive | None:
    """Return the drive that best distinguishes all sets, with more channels if none does."""
    members = [effect_named(name) for group in sets for name in group]
    names, groups = names_of(members), " and ".join(dict.fromkeys([listed(group) for group in sets]))
    twins = [(twin, group) for group in sets for name in group for twin in effect_named(name).twins]
    more = list(dict.fromkeys([to for (twin, to), group in twins if twin in group and to not in logged]))
    for lacking in ([], more) if more else ([],):
        drives = [
            (*_separation(sets, names, a), scenario, grade_deg)
            for scenario, grade_deg, a in _drives(simulation, names, (*logged, *lacking), info)
        ]
        drives = [drive for drive in drives if drive[0] < SEPARABLE_INDEX]
        if not drives:
            continue
        index, power, scenario, grade_deg = max(drives, key=lambda drive: drive[1])
        now, power_now = _separation(sets, names, info.total(names)[0])
        if lacking:
            channels = listed(lacking)
            reason = f"{groups} are one without {channels}; with it logged, their collinearity index is {index:.2g}"
        elif now > MIN_IMPROVEMENT_RATIO * index:
            was = f"{now:.2g}" if now < EXACT_INDEX else f"over {EXACT_INDEX:g}"
            reason = f"the collinearity index of {groups} falls from {was} to {index:.2g}"
        else:
            times = power / max(power_now / math.sqrt(len(info.a)), 1e-9)
            if times < MIN_IMPROVEMENT_RATIO:
                return None
            reason = f"it separates {groups} by {times:.2g} times as many sigmas as one of the runs"
        return NextDrive(scenario, grade_deg, reason)
    return None


def _separation(sets: Sequence[tuple[str, ...]], names: Sequence[str], a: Array) -> tuple[float, float]:
    """Return how well an information matrix (k, k) of parameters separates the worst pair of any set.

    That is its collinearity index, and the sigmas of one at its bounds that the other cannot explain.
    """
    index, power = 1.0, math.inf
    for pair in [pair for group in sets for pair in combinations(group, 2)]:
        places = [[names.index(p.name) for p in effect_named(effect).parameters] for effect in pair]
        r = correlation(a, *places)
        index = max(index, math.inf if r >= 1.0 else 1.0 / math.sqrt(1.0 - r))
        for own, beside in (places, places[::-1]):
            free = partial_information(a, beside, own)[1]
            size = np.array([MOST[names[k]] for k in own])
            least = float(np.linalg.eigvalsh(free * np.outer(size, size))[0])
            power = min(power, math.sqrt(max(least, 0.0)))
    return index, power


def _drives(
    simulation: runs.Simulation, names: Sequence[str], channels: Sequence[str], info: Evidence
) -> list[tuple[str, float, Array]]:
    """Return each scenario on each grade, and its information (k, k) on parameters from channels.

    Noise and scatter are those of the runs, or typical ones of channels that they do not have.  Of measurements only
    the pattern of holes is used.
    """
    robot, driven, signals, dt_s = simulation.robot, [], [], 1.0 / CLOCK_HZ
    speed_mps = None  # that it cruises with
    if not isinstance(robot, BicycleRobot):
        if not robot.describes("motors"):
            return []
        if not robot.on_omni_wheels:
            speed_mps = min(0.6 * robot.wheel_radius_m * robot.motors.speed_max_radps, 1.0)
    for name in SCENARIOS:
        try:
            scenario = make_scenario(name, robot, "ground", speed_mps=speed_mps)
        except ConfigError:  # which it cannot drive
            continue
        motion = wheel_motion(robot, scenario.twist[: round(LONGEST_S * RATE_HZ)], 1.0 / RATE_HZ)
        speed, steer = [
            np.ascontiguousarray(low_pass(x, 1.0 / RATE_HZ, FOLLOW_S)[:: round(RATE_HZ / CLOCK_HZ)])
            for x in (motion.wheel_speed_mps, motion.steer_rad)
        ]
        level = np.zeros(len(speed))
        measured = np.full((len(speed), len(CHANNELS)), np.nan)
        measured[:, [CHANNELS.index(channel) for channel in channels]] = 0.0
        parallel = np.abs(np.exp(1j * steer).mean(axis=1)) > runs.PARALLEL
        measured[~parallel, CHANNELS.index(CURRENT)] = np.nan
        for grade_deg in GRADES_DEG[:1] if robot.on_omni_wheels else GRADES_DEG:  # those log no tilt
            grade = roll = level
            if grade_deg:
                flat = move(simulation.planar_on(""), simulation.vector, dt_s, speed, steer, level, level)
                yaw, steepness = (
                    np.cumsum(flat["yaw_rate_radps"]) / CLOCK_HZ,
                    math.tan(math.radians(grade_deg)),
                )
                ahead, left = steepness * np.cos(yaw), -steepness * np.sin(yaw)
                grade, roll = np.arctan(ahead / np.hypot(1.0, left)), np.arctan(left)
            driven.append((name, grade_deg))
            signals.append(runs.Signals("", "", dt_s, 0.0, speed, steer, grade, roll, measured))
    if not signals:
        return []
    std = np.array([*TYPICAL_STD.values()])
    noise = Noise(np.zeros((len(std), 3)), np.zeros((len(std), ORDER + 1)), std)
    noise.growth[:, 0], noise.filters[:, 0] = std**2, 1.0
    known = np.isfinite(info.noise.filters).all(axis=1)
    for typical, own in zip(noise, info.noise, strict=True):
        typical[known] = own[known]
    scatter = {name: info.scatter[name] for name, assumed in simulation.scatter.items() if assumed > 0}
    about = runs.low_pass_of(signals), noise, scatter
    of_drives = evidence_at(signals, simulation, info.vector, names, *about)
    a, _ = of_drives.clusters(of_drives.places(names))
    return [(*drive, own) for drive, own in zip(driven, a, strict=True)]


def next_command(
    drive: NextDrive | None, description: str, robot: Robot, terrains: Sequence[runs.TerrainMatch]
) -> str | None:
    """Return the command that simulates the next drive; None where none is suggested."""
    if drive is None:
        return None
    default = DEFAULT_SOIL if runs.drivable(robot, DEFAULT_SOIL) else HARD_SOIL
    soil = next((match.soil for match in terrains if match.soil), default)
    grade = f" --grade {drive.grade_deg:g}" if drive.grade_deg else ""
    words = f"--robot {shlex.quote(description)} --terrain {soil} --scenario {drive.scenario}{grade}"
    return f"terrain simulate {words} --runs {NEXT_RUNS} --out next_drive"
