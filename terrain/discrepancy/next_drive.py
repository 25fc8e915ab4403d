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
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.evidence import (
    Evidence,
    Statistics,
    correlation,
    evidence_at,
    partial_information,
)
from terrain.discrepancy.noise import ORDER, Noise
from terrain.discrepancy.robot_terms import listed
from terrain.discrepancy.runs import (
    PARALLEL,
    Signals,
    Simulation,
    TerrainMatch,
    drivable,
    low_pass_of,
    measured_channels,
)
from terrain.discrepancy.selection import EXCITED_RATIO, Z_EFFECT
from terrain.discrepancy.verdict import Limit, NextDrive
from terrain.effects import (
    ACCEL,
    BOUNDS,
    CHANNELS,
    CURRENT,
    GYRO,
    HEADING,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
    effect_named,
)
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

TYPICAL_STD = {
    GYRO: 0.01,
    SPEED_X: 0.005,
    SPEED_Y: 0.005,
    ACCEL: 0.1,
    CURRENT: 1.0,
    TURNING_CURRENT: 1.0,
    HEADING: 0.02,
}
"""Noise of channels that the runs do not have; assumed, white."""

MOST = {name: max(abs(value) for value in bounds) for name, bounds in BOUNDS.items()}
"""Largest size that a parameter may have."""


class _Drive(NamedTuple):
    """A scenario, and its information (k, k) on the parameters."""

    scenario: str
    grade_deg: float
    a: Array


class _Separation(NamedTuple):
    """Worst collinearity index of any pair, and sigmas of one at its bounds that the other cannot explain."""

    collinearity: float
    power: float


def next_drive(
    simulation: Simulation,
    sets: Sequence[tuple[str, ...]],
    missed: Sequence[Limit],
    info: Evidence | None = None,
) -> NextDrive | None:
    """Return the next drive, None where nothing is to be distinguished or no scenario helps.

    It distinguishes the effects of sets of which one is present; where there are none, it excites what the runs
    missed.  Without their evidence channels and noise are typical ones, and nothing is compared.  Where a set
    cannot be distinguished by any drive with the channels that are logged, but could be with one more, the reason
    names it.
    """
    if sets:
        return _separating_drive(simulation, sets, info)
    return _exciting_drive(simulation, missed, info) if missed else None


def _separating_drive(
    simulation: Simulation, sets: Sequence[tuple[str, ...]], info: Evidence | None
) -> NextDrive | None:
    """Return the drive that best distinguishes all sets, with more channels if none does."""
    logged = _logged(simulation.robot, info)
    names = list(dict.fromkeys(p for group in sets for effect in group for p in _parameters(effect)))
    twins = [(twin, group) for group in sets for effect in group for twin in effect_named(effect).twins]
    more = list(dict.fromkeys(to for (twin, to), group in twins if twin in group and to not in logged))
    groups = " and ".join(dict.fromkeys(listed(group) for group in sets))
    now = _Separation(np.inf, 0.0)
    if info is not None:
        now = _separation(sets, names, info.total(names)[0])
    for lacking in ([], more) if more else ([],):
        drives = [
            (_separation(sets, names, drive.a), drive)
            for drive in _drives(simulation, names, (*logged, *lacking), info)
        ]
        drives = [pair for pair in drives if pair[0].collinearity < SEPARABLE_INDEX]
        if not drives:
            continue
        separation, drive = max(drives, key=lambda pair: pair[0].power)
        index = f"{separation.collinearity:.2g}"
        if lacking:
            channels = listed(lacking)
            reason = (
                f"{groups} are one without {channels}; with it logged, their collinearity index is {index}"
            )
        elif info is None:
            reason = f"the collinearity index of {groups} would be {index}"
        elif now.collinearity > MIN_IMPROVEMENT_RATIO * separation.collinearity:
            exact = now.collinearity < EXACT_INDEX
            was = f"{now.collinearity:.2g}" if exact else f"over {EXACT_INDEX:g}"
            reason = f"the collinearity index of {groups} falls from {was} to {index}"
        else:
            times = separation.power / max(now.power / math.sqrt(len(info.a)), 1e-9)
            if times < MIN_IMPROVEMENT_RATIO:
                return None
            reason = f"it separates {groups} by {times:.2g} times as many sigmas as one of the runs"
        return NextDrive(drive.scenario, drive.grade_deg, reason)
    return None


def _exciting_drive(
    simulation: Simulation, missed: Sequence[Limit], info: Evidence | None
) -> NextDrive | None:
    """Return the drive that excites most of what the runs did not excite."""
    names = [limit.name for limit in missed]
    before = np.array([limit.detection_limit for limit in missed])
    bound = np.array([MOST[name] for name in names])
    best: tuple[float, _Drive, Array] | None = None
    for drive in _drives(simulation, names, _logged(simulation.robot, info), info):
        with np.errstate(divide="ignore"):
            limit = Z_SHOWN / np.sqrt(np.maximum(np.diag(drive.a), 0.0))
        excited = (limit < EXCITED_RATIO * bound) & (MIN_IMPROVEMENT_RATIO * limit < before)
        # as many as possible; the size of the limits decides between equals
        score = excited.sum() + float(np.mean(1.0 / (1.0 + np.minimum(limit / bound, 1e6))))
        if excited.any() and (best is None or score > best[0]):
            best = score, drive, np.where(excited, limit, np.inf)
    if best is None:
        return None
    _, drive, limit = best
    k = int(np.argmin(limit / bound))
    others = int(np.isfinite(limit).sum()) - 1
    beside = f", and {others} more that the runs do not excite" if others else ""
    was = f"from {before[k]:.2g}" if math.isfinite(before[k]) else "from infinite"
    reason = f"the detection limit of {names[k]} falls {was} to {limit[k]:.2g} {missed[k].unit}{beside}"
    return NextDrive(drive.scenario, drive.grade_deg, reason)


def _separation(sets: Sequence[tuple[str, ...]], names: Sequence[str], a: Array) -> _Separation:
    """Return how well an information matrix (k, k) of parameters separates the worst pair of any set."""
    index, power = 1.0, np.inf
    for group in sets:
        for pair in combinations(group, 2):
            one, other = ([names.index(name) for name in _parameters(effect)] for effect in pair)
            r = correlation(a, one, other)
            index = max(index, math.inf if r >= 1.0 else 1.0 / math.sqrt(1.0 - r))
            for own, beside in ((one, other), (other, one)):
                free = partial_information(a, beside, own)[1]
                size = np.array([MOST[names[k]] for k in own])
                least = float(np.linalg.eigvalsh(free * np.outer(size, size))[0])
                power = min(power, math.sqrt(max(least, 0.0)))
    return _Separation(index, power)


def _parameters(effect: str) -> tuple[str, ...]:
    return tuple(p.name for p in effect_named(effect).parameters)


def _logged(robot: Robot, info: Evidence | None) -> tuple[str, ...]:
    """Return the channels of the runs, or those expected from the robot's description."""
    if info is not None:
        return measured_channels(info.rows)
    if robot.on_omni_wheels:
        return (SPEED_X, SPEED_Y, CURRENT, HEADING)
    own = [GYRO, ACCEL]
    own += [SPEED_X, SPEED_Y] if robot.describes("camera") else []
    own += [CURRENT] if robot.describes("motors") else []
    own += [TURNING_CURRENT] if robot.describes("motors") and robot.skids else []
    return tuple(own)


def _drives(
    simulation: Simulation, names: Sequence[str], channels: Sequence[str], info: Evidence | None
) -> list[_Drive]:
    """Return the information of each scenario on each grade on parameters, from channels."""
    driven: list[tuple[str, float]] = []
    signals: list[Signals] = []
    grades = GRADES_DEG[:1] if simulation.robot.on_omni_wheels else GRADES_DEG  # those log no tilt
    for name in SCENARIOS:
        wheels = _wheels(simulation.robot, name)
        if wheels is not None:
            driven += [(name, grade_deg) for grade_deg in grades]
            signals += [_signals(simulation, *wheels, grade_deg, channels) for grade_deg in grades]
    if not signals:
        return []
    vector = simulation.vector if info is None else info.vector
    low_pass = low_pass_of(signals)
    of_drives = evidence_at(signals, simulation, vector, names, low_pass, _statistics(simulation, info))
    a, _ = of_drives.clusters(of_drives.places(names))
    return [_Drive(*drive, own) for drive, own in zip(driven, a, strict=True)]


def _wheels(robot: Robot, name: str) -> tuple[Array, Array] | None:
    """Return wheel speeds and steering (n, wheels) of a scenario, or None if the robot cannot drive it."""
    speed_mps = None  # that it cruises with
    if not isinstance(robot, BicycleRobot):
        if not robot.describes("motors"):
            return None
        if not robot.on_omni_wheels:
            speed_mps = min(0.6 * robot.wheel_radius_m * robot.motors.speed_max_radps, 1.0)
    try:
        scenario = make_scenario(name, robot, "ground", speed_mps=speed_mps)
    except ConfigError:
        return None
    motion = wheel_motion(robot, scenario.twist[: round(LONGEST_S * RATE_HZ)], 1.0 / RATE_HZ)
    every = round(RATE_HZ / CLOCK_HZ)
    wheel_speed_mps, steer_rad = (
        np.ascontiguousarray(low_pass(x, 1.0 / RATE_HZ, FOLLOW_S)[::every])  # as all callers of kernels
        for x in (motion.wheel_speed_mps, motion.steer_rad)
    )
    return wheel_speed_mps, steer_rad


def _signals(
    simulation: Simulation,
    wheel_speed_mps: Array,
    steer_rad: Array,
    grade_deg: float,
    channels: Sequence[str],
) -> Signals:
    """Return the signals of a drive without noise; of its measurements only the pattern of holes is used."""
    level, dt_s = np.zeros(len(wheel_speed_mps)), 1.0 / CLOCK_HZ
    measured = np.full((len(wheel_speed_mps), len(CHANNELS)), np.nan)
    measured[:, [CHANNELS.index(name) for name in channels]] = 0.0
    parallel = np.abs(np.exp(1j * steer_rad).mean(axis=1)) > PARALLEL
    measured[~parallel, CHANNELS.index(CURRENT)] = np.nan
    grade = roll = level
    if grade_deg:
        driven = wheel_speed_mps, steer_rad, level, level
        flat = move(simulation.planar, simulation.vector, dt_s, *driven)
        yaw = np.cumsum(flat["yaw_rate_radps"]) / CLOCK_HZ
        steepness = math.tan(math.radians(grade_deg))
        ahead, left = steepness * np.cos(yaw), -steepness * np.sin(yaw)
        grade, roll = np.arctan(ahead / np.hypot(1.0, left)), np.arctan(left)
    return Signals("", "", dt_s, 0.0, wheel_speed_mps, steer_rad, grade, roll, measured)


def _statistics(simulation: Simulation, info: Evidence | None) -> Statistics:
    """Return noise and scatter of the runs, and a typical noise of channels that they do not have."""
    std = np.array([TYPICAL_STD[name] for name in CHANNELS])
    noise = Noise(np.zeros((len(CHANNELS), 3)), np.zeros((len(CHANNELS), ORDER + 1)), std)
    noise.growth[:, 0], noise.filters[:, 0] = std**2, 1.0
    if info is None:
        return Statistics(noise, simulation.scatter)
    known = np.isfinite(info.noise.filters).all(axis=1)
    for typical, measured in zip(noise, info.noise, strict=True):
        typical[known] = measured[known]
    return Statistics(noise, info.statistics.scatter)


def next_command(
    drive: NextDrive | None, description: str, robot: Robot, terrains: Sequence[TerrainMatch]
) -> str | None:
    """Return the command that simulates the next drive; None where none is suggested."""
    if drive is None:
        return None
    default = DEFAULT_SOIL if drivable(robot, DEFAULT_SOIL) else HARD_SOIL
    soil = next((match.soil for match in terrains if match.soil), default)
    grade = f" --grade {drive.grade_deg:g}" if drive.grade_deg else ""
    words = f"--robot {shlex.quote(description)} --terrain {soil} --scenario {drive.scenario}{grade}"
    return f"terrain simulate {words} --runs {NEXT_RUNS} --out next_drive"
