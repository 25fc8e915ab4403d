"""The next drive: commands that best distinguish what the runs could not, or excite what they did not.

A drive is designed leg by leg: twists within the speeds and turns of the runs, held for some seconds and reached by a
soft or a hard ramp.  Sequences of legs are drawn, and the best ones are improved a leg at a time.  Each is driven
without noise, on the level and uphill, and the sensitivities of the effects in question are whitened like those of
the runs, with variations from run to run marginalised.  Two effects are compared by their collinearity index
``1 / sqrt(1 - r)``,
``r`` the largest correlation of a change by the one with a change by the other: 1 is orthogonal, above 10
they cannot be distinguished (Brun et al., Water Resources Research 2001, of two normalised columns).
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Sequence
from functools import partial
from io import StringIO
from itertools import combinations
from typing import NamedTuple

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
from terrain.discrepancy.robot_terms import listed, quantity
from terrain.discrepancy.search import names_of
from terrain.discrepancy.verdict import Limit, NextDrive
from terrain.effects import BOUNDS, CHANNELS, CURRENT, PARAMETER, effect_named
from terrain.kinematics.commands import wheel_motion
from terrain.records import Array
from terrain.robots import BicycleRobot, Robot
from terrain.signals import low_pass
from terrain.simulation.plants.planar import move
from terrain.simulation.scenario import COMMANDS, RATE_HZ, SPOT_RADPS, STAND, Leg, fastest_mps_of, from_legs

DEFAULT_SOIL, HARD_SOIL, NEXT_RUNS = "grass", "tiles", 8
"""Of the command that simulates the next drive: a soil, one for robots that get stuck on it, and as many runs
as the blind trials have."""

NEXT_FILE = "next_drive.csv"  #: Of commands, in the folder of the results

GRADES_DEG = (0.0, 6.0)  #: Level, and a slope that every robot here climbs

#: A drive is as long as that many legs, drawn so often, the best so many improved by changing each leg once so often.
N_LEGS, N_DRAWN, N_BEST, N_CHANGES = 12, 24, 2, 2
HOLDS_S, ACCELS_MPS2 = (1.5, 3.0, 5.0), (0.5, 1.0)  #: Of legs; a hard ramp is that of the scenarios
LEAST_MPS = 0.5  #: Fastest speed of a design if the runs were slower, as far as the robot reaches it
#: Room that a drive may take, in metres and in seconds at its fastest speed, the larger of the two.
ROOM_M, ROOM_S = 12.0, 12.0
CLOCK_HZ = RATE_HZ / 2  #: Of the replay: half the rate of the commands is five times what they hold
FOLLOW_S = 0.1  #: Lag of wheels and steering behind their commands; assumed

SEPARABLE_INDEX = 10.0
"""Collinearity index above which two effects are not distinguished, whatever the amplitude."""

EXACT_INDEX = 100.0  #: Above it two effects count as one
LISTED = 3  #: Effects that a reason lists

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
    if not missed:
        return None
    names, bound = [limit.name for limit in missed], np.array([MOST[limit.name] for limit in missed])
    before = np.array([limit.detection_limit for limit in missed])  # of the runs

    def limits(a: Array) -> tuple[Array, Array]:
        """Return the detection limits of a drive, and which effects it excites that the runs did not."""
        with np.errstate(divide="ignore"):
            limit = Z_SHOWN / np.sqrt(np.maximum(np.diag(a), 0.0))
        return limit, (limit < EXCITED_RATIO * bound) & (MIN_IMPROVEMENT_RATIO * limit < before)

    def score(a: Array) -> float:
        """Return how many effects are excited; the size of the limits decides between equals."""
        limit, excited = limits(a)
        return float(excited.sum() + np.mean(1.0 / (1.0 + np.minimum(limit / bound, 1e6))))

    best = _designed(simulation, names, logged, info, score)
    limit, excited = limits(best.a)
    if not excited.any():
        return None
    order = [k for k in np.argsort(limit / bound) if excited[k]]
    words = [f"{PARAMETER[names[k]].label} from {quantity(names[k], float(limit[k]))} up" for k in order]
    more = [f"{n} more"] if (n := len(words) - LISTED) > 0 else []
    return _answer(best, f"it shows what these runs could not, {listed([*words[:LISTED], *more])}")


def _separating_drive(
    simulation: runs.Simulation, sets: Sequence[tuple[str, ...]], logged: Sequence[str], info: Evidence
) -> NextDrive | None:
    """Return the drive that best distinguishes all sets, with more channels if none does."""
    members = [effect_named(name) for group in sets for name in group]
    names, groups = (
        names_of(members),
        " and ".join(dict.fromkeys([listed([name.replace("_", " ") for name in group]) for group in sets])),
    )
    twins = [(twin, group) for group in sets for name in group for twin in effect_named(name).twins]
    more = list(dict.fromkeys([to for (twin, to), group in twins if twin in group and to not in logged]))
    for lacking in ([], more) if more else ([],):

        def score(a: Array) -> float:
            """Return how many sigmas separate the worst pair, those that cannot be distinguished last."""
            index, power = _separation(sets, names, a)
            return power if index < SEPARABLE_INDEX else -min(index, 1e9)

        best = _designed(simulation, names, (*logged, *lacking), info, score)
        index, power = _separation(sets, names, best.a)
        if index >= SEPARABLE_INDEX:
            continue
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
        return _answer(best, reason)
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


class _Design(NamedTuple):
    """A drive, the slope that it is driven on, and its information (k, k) on parameters."""

    legs: tuple[Leg, ...]
    grade_deg: float
    a: Array


def _designed(
    simulation: runs.Simulation,
    names: Sequence[str],
    channels: Sequence[str],
    info: Evidence,
    score: Callable[[Array], float],
) -> _Design:
    """Return the drive with the best score of its information on parameters from channels.

    Noise and scatter are those of the runs, or typical ones of channels that they do not have.
    """
    rng, robot = np.random.default_rng(0), simulation.robot
    draw, room_m = _legs_of(robot, info)
    evaluate = partial(_information, simulation, names, channels, info)
    grades = GRADES_DEG[:1] if robot.on_omni_wheels else GRADES_DEG  # those log no tilt

    def drawn() -> tuple[Leg, ...]:
        while True:
            legs = (STAND, *[draw(rng) for _ in range(N_LEGS)], STAND)
            if max(extent_of(legs)) <= room_m:
                return legs

    ranked: list[tuple[float, _Design]] = []
    for grade_deg in grades:
        sequences = [drawn() for _ in range(N_DRAWN)]
        for legs, a in zip(sequences, evaluate(sequences, grade_deg), strict=True):
            ranked.append((score(a), _Design(legs, grade_deg, a)))
    ranked.sort(key=lambda pair: -pair[0])
    best = ranked[:N_BEST]
    for i, (value, design) in enumerate(best):
        for _ in range(N_CHANGES):
            legs = design.legs
            changed = [(*legs[:k], draw(rng), *legs[k + 1 :]) for k in range(1, len(legs) - 1)]
            changed = [each for each in changed if max(extent_of(each)) <= room_m]
            for each, a in zip(changed, evaluate(changed, design.grade_deg) if changed else (), strict=True):
                if (now := score(a)) > value:
                    value, design = now, _Design(each, design.grade_deg, a)
        best[i] = value, design
    return max(best, key=lambda pair: pair[0])[1]


def _legs_of(robot: Robot, info: Evidence) -> tuple[Callable[[np.random.Generator], Leg], float]:
    """Return how a leg is drawn, within the speeds and turns of the runs, and the room of a drive."""
    fastest_mps = float(np.quantile(np.concatenate([run.pace_mps for run in info.rows]), 0.99))
    fastest_mps = min(max(fastest_mps, LEAST_MPS), 0.8 * fastest_mps_of(robot))
    turned = [np.abs(run.predicted[:, 0]) for run in info.rows]
    yaw_radps = max(float(np.nanquantile(np.concatenate(turned), 0.99)), SPOT_RADPS)
    sizes = np.array([-1.0, -0.5, 0.5, 1.0])

    def draw(rng: np.random.Generator) -> Leg:
        kind = rng.choice(["rest", "straight", "arc", "spot", "sideways"], p=[0.1, 0.35, 0.35, 0.1, 0.1])
        speed_mps, turn = fastest_mps * rng.choice(sizes), rng.choice(sizes)
        twist = np.array([0.0 if kind == "rest" else speed_mps, 0.0, 0.0])
        if isinstance(robot, BicycleRobot):
            twist[2] = speed_mps * math.tan(0.8 * robot.steering_max_rad * turn) / robot.wheelbase_m
            twist[2] = np.clip(twist[2], -yaw_radps, yaw_radps) * (kind in ("arc", "spot"))
        elif kind == "arc":
            twist[2] = yaw_radps * turn
        elif kind == "spot":
            twist[:] = 0.0, 0.0, yaw_radps * turn
        elif kind == "sideways" and robot.sideways:
            twist[:] = speed_mps * rng.choice([0.0, 0.7]), fastest_mps * turn * 0.7, 0.0
        return Leg(twist, float(rng.choice(HOLDS_S)), float(rng.choice(ACCELS_MPS2)))

    return draw, max(ROOM_M, ROOM_S * fastest_mps)


def extent_of(legs: Sequence[Leg]) -> tuple[float, float]:
    """Return how far ahead and to the side of its start a drive reaches, without slip, as the size of its box."""
    step = from_legs("", "ground", legs).twist / RATE_HZ
    cos, sin = np.cos(np.cumsum(step[:, 2])), np.sin(np.cumsum(step[:, 2]))
    x_m, y_m = np.cumsum(cos * step[:, 0] - sin * step[:, 1]), np.cumsum(sin * step[:, 0] + cos * step[:, 1])
    return float(np.ptp(x_m)), float(np.ptp(y_m))


def _information(
    simulation: runs.Simulation,
    names: Sequence[str],
    channels: Sequence[str],
    info: Evidence,
    sequences: Sequence[Sequence[Leg]],
    grade_deg: float,
) -> Array:
    """Return the information (sequences, k, k) of drives on a slope, which they start up."""
    robot, signals, dt_s = simulation.robot, [], 1.0 / CLOCK_HZ
    for legs in sequences:
        motion = wheel_motion(robot, from_legs("", "ground", legs).twist, 1.0 / RATE_HZ)
        speed, steer = [
            np.ascontiguousarray(low_pass(x, 1.0 / RATE_HZ, FOLLOW_S)[:: round(RATE_HZ / CLOCK_HZ)])
            for x in (motion.wheel_speed_mps, motion.steer_rad)
        ]
        grade = roll = np.zeros(len(speed))
        # of measurements only the pattern of holes is used
        measured = np.full((len(speed), len(CHANNELS)), np.nan)
        measured[:, [CHANNELS.index(channel) for channel in channels]] = 0.0
        parallel = np.abs(np.exp(1j * steer).mean(axis=1)) > runs.PARALLEL
        measured[~parallel, CHANNELS.index(CURRENT)] = np.nan
        if grade_deg:
            flat = move(simulation.planar_on(""), simulation.vector, dt_s, speed, steer, grade, roll)
            yaw, steepness = np.cumsum(flat["yaw_rate_radps"]) * dt_s, math.tan(math.radians(grade_deg))
            ahead, left = steepness * np.cos(yaw), -steepness * np.sin(yaw)
            grade, roll = np.arctan(ahead / np.hypot(1.0, left)), np.arctan(left)
        signals.append(runs.Signals("", "", dt_s, 0.0, speed, steer, grade, roll, measured))
    std = np.array([*TYPICAL_STD.values()])
    noise = Noise(np.zeros((len(std), 3)), np.zeros((len(std), ORDER + 1)), std)
    noise.growth[:, 0], noise.filters[:, 0] = std**2, 1.0
    known = np.isfinite(info.noise.filters).all(axis=1)
    for typical, own in zip(noise, info.noise, strict=True):
        typical[known] = own[known]
    scatter = {name: info.scatter[name] for name, assumed in simulation.scatter.items() if assumed > 0}
    about = runs.low_pass_of(signals), noise, scatter
    of_drives = evidence_at(signals, simulation, info.vector, names, *about)
    return of_drives.clusters(of_drives.places(names))[0]


def _answer(design: _Design, reason: str) -> NextDrive:
    legs = tuple((*leg.twist.tolist(), leg.hold_s, leg.accel_mps2) for leg in design.legs)
    duration_s = float(from_legs("", "ground", design.legs).time_s[-1])
    return NextDrive(legs, design.grade_deg, reason, duration_s, *extent_of(design.legs))


def commands_of(drive: NextDrive) -> str:
    """Return a drive as a file of commands: CSV with the columns of :data:`terrain.simulation.scenario.COMMANDS`.

    Examples
    --------
    >>> drive = NextDrive(((0.5, 0.0, 0.0, 1.0, 1.0),), 0.0, "", 1.5, 0.6, 0.0)
    >>> print("".join(commands_of(drive).splitlines(True)[:3]), end="")
    time_s,speed_x_mps,speed_y_mps,yaw_rate_radps
    0.00,0.0000,0.0000,0.0000
    0.02,0.0200,0.0000,0.0000
    """
    made = from_legs("", "ground", [Leg(np.array(leg[:3]), *leg[3:]) for leg in drive.legs])
    rows = np.column_stack([made.time_s, made.twist]) + 0.0
    text = StringIO()
    np.savetxt(text, rows, fmt=["%.2f", *["%.4f"] * 3], delimiter=",", header=",".join(COMMANDS), comments="")
    return text.getvalue()


def next_command(
    drive: NextDrive | None,
    description: str,
    robot: Robot,
    terrains: Sequence[runs.TerrainMatch],
    commands: str = NEXT_FILE,
) -> str | None:
    """Return the command that simulates the next drive, by its file; None where none is suggested."""
    if drive is None:
        return None
    default = DEFAULT_SOIL if runs.drivable(robot, DEFAULT_SOIL) else HARD_SOIL
    soil = next((match.soil for match in terrains if match.soil), default)
    grade = f" --grade {drive.grade_deg:g}" if drive.grade_deg else ""
    words = f"--robot {shlex.quote(description)} --terrain {soil} --scenario {shlex.quote(commands)}{grade}"
    return f"terrain simulate {words} --runs {NEXT_RUNS} --out next_drive"
