"""Scenarios by name: twists desired over time, terrains by distance travelled; conditions of a run, faults of sensors.

A drive is made of legs.  A leg goes from the twist before it to its own in a ramp with bounded accelerations, and
holds it.  From rest and to rest the ratio of the three components of the twist stays constant, so the centre of
rotation does not move during such a ramp and the steering angles do not change.

Sources: Danzi, AgriMaRo thesis, 7.2.3 (``straight``: 1 m/s^2 to 1 m/s) and 6.2 (``complex``: curves, forward and
backward, in both directions; the order and the speeds are assumed).

:class:`Conditions` are what differs from run to run on one terrain: load, slope, tyres, roughness, play.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.files.documents import read_yaml
from terrain.files.names import data_folder
from terrain.kinematics.commands import scaled
from terrain.records import Array, read_only
from terrain.robots import BicycleRobot, Robot, SwerveRobot

RATE_HZ = 50.0  # rate of the twists: that of a run log's commands
ACCEL_MPS2 = 1.0  # change of the velocity in ramps, and the most in any; thesis 7.2.3
YAW_ACCEL_RADPS2 = 1.0  # the most that the yaw rate changes in ramps: at the third wheel less than that
STAND_S = 1.0  # rest before the first leg, and the least after the last
SPOT_RADPS = 0.6  # yaw rate of ``spot_turn``, and the fastest turn on the spot of ``survey``
PATCH_M = (6.0, 12.0)  # length of a terrain patch of ``course``
# A slipping robot gets less far than commanded: ``course`` drives this much further than its patches are long, so
# that with 20 % of slip the last one is crossed as well.
SLIP_MARGIN = 1.25
YAW_RATE_RADPS = 0.3  # of ``arc`` and the curves of ``complex``
CIRCLE_M, CIRCLE_MPS = 1.5, 0.5  # radius of ``circle``, and its speed unless a lower one is given
BRAKE_S = 4.0  # of ``brake``: how long the speed is held before the stop, and the rest after it
LONGEST_S = 3600.0  # a run is held whole in memory, step by step: an hour is two gigabytes
_RAMPED = ("straight", "climb", "starts")  # those whose acceleration can be chosen
# Speed where none is given, and the share of its fastest speed that a slower or car-like robot drives.
CRUISING_MPS, CRUISING_SHARE = 1.0, 1.0 / 3.0
AT_REST = read_only(np.zeros(3))


class Patch(NamedTuple):
    """A terrain from ``start_m`` of distance travelled on, to where the next one starts."""

    start_m: float
    terrain: str


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """What is driven, and on what."""

    name: str
    rate_hz: float  # of the twists
    time_s: Array  # (n,) from 0 to the duration, both included, at that rate
    twist: Array  # (n, 3) desired (speed_x_mps, speed_y_mps, yaw_rate_radps), no wheel beyond its limit
    patches: tuple[Patch, ...]  # terrains in order; the first starts at 0, the last has no end

    def __post_init__(self) -> None:
        for name in ("time_s", "twist"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        object.__setattr__(self, "patches", tuple(Patch(*patch) for patch in self.patches))
        if self.twist.shape != (self.time_s.size, 3):
            raise ValueError(f"twist has shape {self.twist.shape}, {(self.time_s.size, 3)} is needed")
        if not np.allclose(self.time_s * self.rate_hz, np.arange(self.time_s.size), rtol=0, atol=1e-6):
            raise ValueError(f"time_s is not evenly spaced from 0 at {self.rate_hz:g} Hz")
        starts_m = [patch.start_m for patch in self.patches]
        if starts_m[:1] != [0.0] or any(b <= a for a, b in pairwise(starts_m)):
            raise ValueError(f"patches start at {starts_m} m, a rising row from 0 on is needed")

    @property
    def distance_m(self) -> Array:
        """Distance (n,) that the body's origin would have travelled, were the twists followed."""
        return _distance_m(self.time_s, self.twist)


def _distance_m(time_s: Array, twist: Array) -> Array:
    speed_mps = np.hypot(twist[:, 0], twist[:, 1])
    steps_m = np.diff(time_s) * (speed_mps[1:] + speed_mps[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps_m)])


class Leg(NamedTuple):
    """A twist to go to, within the robot's limits, for how long it is held, and how fast it is gone to."""

    twist: Array
    hold_s: float
    accel_mps2: float = ACCEL_MPS2


STAND = Leg(AT_REST, STAND_S)


def _ramp_s(change: Any, accel_mps2: float = ACCEL_MPS2, smooth: bool = False) -> float:
    """Return how long a change of twist takes; the peak of a smooth one is pi/2 times its mean."""
    x_mps, y_mps, yaw_radps = change
    linear_s = float(max(math.hypot(x_mps, y_mps) / accel_mps2, abs(yaw_radps) / YAW_ACCEL_RADPS2))
    return linear_s * math.pi / 2 if smooth else linear_s


def _take(legs: Iterator[Leg], length_s: float) -> tuple[list[Leg], float]:
    """Take legs until they last this long; return them and by how much they last longer."""
    taken: list[Leg] = []
    end_s, before = 0.0, AT_REST
    while end_s < length_s:
        leg = next(legs)
        end_s += _ramp_s(leg.twist - before, leg.accel_mps2) + leg.hold_s
        before = leg.twist
        taken.append(leg)
    return taken, end_s - length_s


def _twists(legs: Sequence[Leg], time_s: Array, smooth: bool = False) -> Array:
    """Return the twist (n, 3) at each time, the last one held on after the end.

    The admissible region is convex: with both ends of a ramp in it, all of the ramp is.
    """
    knots_s, knots = [0.0], [AT_REST]
    for leg in legs:
        change_s = _ramp_s(leg.twist - knots[-1], leg.accel_mps2, smooth)
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


# What each scenario is made for by default; None where that follows from speed or terrains.
DURATION_S: dict[str, float | None] = {
    "stand": 20.0,
    "straight": 20.0,
    "arc": 20.0,
    "starts": 30.0,
    "spot_turn": 30.0,
    "complex": 60.0,
    "survey": 40.0,
    "climb": 15.0,
    "brake": None,
    "circle": None,
    "crab": 45.0,
    "course": None,
}
SCENARIOS: tuple[str, ...] = tuple(DURATION_S)  # names that :func:`make_scenario` accepts

# Legs: speed_x and speed_y in cruising speeds, yaw rate in YAW_RATE_RADPS, share of the time that is held.  The ramps
# of these start and end without a step of the acceleration.
_CURVES = "1 0 0 4, .8 0 1 4, .8 0 -1 4, 0 0 0 1, -.8 0 0 3, -.6 0 1 4, -.6 0 -1 4, 0 0 0 1.5"
_SIDEWAYS = "0 .5 0 3, 0 0 0 1, 0 -.5 0 3, 0 0 0 1.5, .5 .5 0 3, 0 0 0 1.5, .5 -.5 0 3"
_ON_THE_SPOT = "0 0 2 4, 0 0 0 1, 0 0 -2 4"
# the steering does not move through each reversal and turns at the start after each rest
_CRAB = (
    "-.6 0 0 3, .6 0 0 3, 0 0 0 1, 0 .5 0 3, 0 -.5 0 3, 0 0 0 1, .4 .4 0 3, -.4 -.4 0 3, 0 0 0 1, -.4 .4 0 3, "
    ".4 -.4 0 3"
)


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

    - ``stand``: standing still, for calibration
    - ``straight``: 1 s of rest, 1 m/s^2 up to the speed, held to the end
    - ``climb``: the same for 15 s, for a slope
    - ``brake``: 1 s of rest, 1 m/s^2 up to the speed, held for 4 s, and a command to stop at once; 4 s of rest
    - ``circle``: a full turn and more to the left on a radius of 1.5 m, at 0.5 m/s at most
    - ``crab``: backward, forward, to both sides and along both diagonals, forth and back each; smooth
    - ``arc``: as ``straight`` with 0.3 rad/s, and down to rest
    - ``starts``: from rest at 1 m/s^2 to the speed, 3 s, and down at 1 m/s^2, again and again
    - ``spot_turn``: in place to the left, to the right, at 0.6 rad/s, several times
    - ``complex``: forward, curves to both sides, backward with curves, sideways, diagonally; smooth
    - ``survey``: labelled runs: stretches of 4 to 6 s, straight and in gentle arcs, now and then a stop, a stretch
      backward or a turn on the spot; drawn
    - ``course``: over patches of 6 to 12 m of every terrain in turn, in drawn order, at changing speed

    Robots that cannot drive sideways have no ``crab``, and in ``complex`` turn on the spot instead; car-like ones
    have no ``spot_turn``.

    Parameters
    ----------
    name : one of :data:`SCENARIOS`
    robot : no twist saturates its wheels; without motors, which swerve robots need, they have no limit
    terrains : of the ground, one unless the scenario is ``course``; the names are not looked up
    duration_s : what the scenario is made for by default; taken to a whole number of samples
    speed_mps : cruising speed, by default 1 m/s, of a slower or car-like robot a third of its fastest; ``survey`` and
        ``course`` draw from 0.4 to 1.2 times it, backward and sideways ``complex`` is slower, and so is all of ``crab``
    seed : of everything drawn; the same gives the same bytes
    accel_mps2 : of the ramps of ``straight``, ``climb`` and ``starts``; infinite, they are steps

    Raises
    ------
    ConfigError
        for an unknown name, terrains that do not fit it, a duration too short for it, a speed beyond the robot, an
        acceleration that is none or that the scenario does not take, or a scenario that the robot cannot drive.

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
    car = isinstance(robot, BicycleRobot)
    able = {"crab": robot.sideways, "spot_turn": not car}
    if not able.get(name, True):
        raise ConfigError(f"scenario {name!r} is not for robot {robot.name} with the drive {robot.drive!r}")
    if not (_is_number(accel_mps2) or accel_mps2 == math.inf) or not accel_mps2 > 0:
        raise ConfigError(f"accel_mps2 is {accel_mps2!r}, a number above zero is required, inf for steps")
    if accel_mps2 != ACCEL_MPS2 and name not in _RAMPED:
        raise ConfigError(
            f"accel_mps2 is {accel_mps2:g}: scenario {name!r} has ramps of its own, "
            f"only {', '.join(_RAMPED)} take it"
        )
    if duration_s is not None and not (_is_number(duration_s) and 1 / RATE_HZ <= duration_s <= LONGEST_S):
        raise ConfigError(
            f"duration_s is {duration_s!r}, a time from {1 / RATE_HZ:g} to {LONGEST_S:g} s is required"
        )
    if not isinstance(seed, np.random.Generator):
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise ConfigError(f"seed is {seed!r}, a whole number from 0 up is required")
        seed = np.random.default_rng(seed)
    wheels, radius_m, fastest_mps = robot.wheel_positions_m, robot.wheel_radius_m, fastest_mps_of(robot)
    fastest_radps = fastest_mps / radius_m
    if speed_mps is None:
        slow = car or fastest_mps < CRUISING_MPS
        speed_mps = CRUISING_SHARE * fastest_mps if slow else CRUISING_MPS
    if not _is_number(speed_mps) or not 0 < speed_mps <= fastest_mps:
        raise ConfigError(
            f"speed_mps is {speed_mps!r}: robot {robot.name} drives above 0 and up to {fastest_mps:g} m/s"
        )
    rng, speed, accel = seed, float(speed_mps), float(accel_mps2)

    def limit(twist: Any) -> Array:
        """Shorten a twist to what the robot can; wheels of a car turn as fast as it drives."""
        if car or math.isinf(fastest_radps):
            return np.asarray(twist, dtype=np.float64)
        return scaled(wheels, radius_m, twist, fastest_radps)

    circle_mps = min(speed, CIRCLE_MPS)
    ahead, around = limit((speed, 0.0, 0.0)), limit((circle_mps, 0.0, circle_mps / CIRCLE_M))
    round_s = 2 * math.pi / float(around[2])
    default_s = DURATION_S[name]
    if name == "brake":
        default_s = STAND_S + speed / ACCEL_MPS2 + 2 * BRAKE_S
    elif name == "circle":
        default_s = math.ceil(2 * STAND_S + 2 * _ramp_s(around) + round_s)
    length_s = duration_s or default_s or 0.0

    def remaining_s(taken_s: float, at_least_s: float) -> float:
        """Return what is left of the time, once the parts of a fixed length are taken away."""
        if length_s < taken_s + at_least_s - 1e-9:
            raise ConfigError(
                f"duration_s is {length_s:g}, too short for {name!r} at this speed: "
                f"at least {math.ceil(10 * (taken_s + at_least_s)) / 10:g} s"
            )
        return length_s - taken_s

    def stretch(direction: float, gentle_1pm: float) -> Leg:
        """Draw a stretch of steady speed, every other one an arc of at most this curvature."""
        drawn_mps = direction * rng.uniform(0.4, 1.2) * speed
        curvature_1pm = rng.integers(2) * rng.uniform(-gentle_1pm, gentle_1pm)
        twist = limit((drawn_mps, 0.0, curvature_1pm * drawn_mps))
        return Leg(twist, rng.uniform(4.0, 6.0), rng.uniform(0.5, 1.0))

    def survey() -> Iterator[Leg]:
        yield STAND
        yield stretch(1.0, 0.2)
        while True:
            kind = rng.choice(["stretch", "stop", "backward", "spot"], p=[0.7, 0.1, 0.1, 0.1])
            if kind == "stretch":
                yield stretch(1.0, 0.2)
                continue
            yield Leg(AT_REST, rng.uniform(1.0, 2.0), rng.uniform(0.5, 1.0))
            if kind == "backward":
                yield stretch(-1.0, 0.2)
                yield Leg(AT_REST, rng.uniform(1.0, 2.0), rng.uniform(0.5, 1.0))
            elif kind == "spot":
                yaw_radps = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, SPOT_RADPS)
                yield Leg(limit((0.0, 0.0, yaw_radps)), rng.uniform(3.0, 5.0))
                yield STAND

    def over_patches() -> Iterator[Leg]:
        yield STAND
        while True:
            yield stretch(1.0, 0.15)

    if name == "course":  # a given duration lays as many patches as are reached in it
        patch_rng, rng = seed.spawn(2)
        rounds = _rounds(grounds, patch_rng)
        laid, end_m = next(rounds)
        if duration_s is None:
            slowest_mps = limit((0.4 * speed, 0.0, 0.4 * speed * 0.15))[0]
            length_s = 2 * STAND_S + 2 * speed / ACCEL_MPS2 + SLIP_MARGIN * end_m / slowest_mps
        else:
            remaining_s(STAND_S + 1.2 * speed / 0.5, at_least_s=3.0)
        time_s = np.arange(round(length_s * RATE_HZ) + 1) / RATE_HZ
        twist = _twists(_take(over_patches(), length_s)[0], time_s)
        reached_m = _distance_m(time_s, twist) / SLIP_MARGIN
        if duration_s is None:
            n = int(np.searchsorted(reached_m, end_m)) + 1
            return Scenario(name, RATE_HZ, time_s[:n], twist[:n], tuple(laid))
        while end_m < reached_m[-1]:
            patches, end_m = next(rounds)
            laid += patches
        reached = tuple(patch for patch in laid if patch.start_m < reached_m[-1])
        return Scenario(name, RATE_HZ, time_s, twist, reached)

    legs = [Leg(AT_REST, length_s)]
    if name in ("straight", "climb"):
        legs = [STAND, Leg(ahead, remaining_s(STAND_S + speed / accel, 1.0), accel)]
    elif name == "brake":
        hold_s = remaining_s(STAND_S + speed / ACCEL_MPS2 + BRAKE_S, 1.0)
        legs = [STAND, Leg(ahead, hold_s), Leg(AT_REST, BRAKE_S, math.inf)]
    elif name in ("circle", "arc"):
        arc = around if name == "circle" else limit((speed, 0.0, YAW_RATE_RADPS))
        hold_s = remaining_s(2 * STAND_S + 2 * _ramp_s(arc), round_s if name == "circle" else 1.0)
        legs = [STAND, Leg(arc, hold_s), STAND]
    elif name == "starts":
        drive_s = 3.0 + 2 * speed / accel
        n = max(1, int((length_s - STAND_S) / (drive_s + STAND_S)))
        stand_s = remaining_s(n * drive_s, (n + 1) * STAND_S) / (n + 1)
        legs = [Leg(AT_REST, stand_s), *[Leg(ahead, 3.0, accel), Leg(AT_REST, stand_s, accel)] * n]
    elif name == "spot_turn":
        left = limit((0.0, 0.0, SPOT_RADPS))
        around_s = 2 * _ramp_s(left) + STAND_S
        n = 2 * max(1, int((length_s - STAND_S) / (2 * (around_s + 2.0))))
        hold_s = remaining_s(STAND_S + n * around_s, n * 1.0) / n
        legs = [STAND, *[Leg(left, hold_s), STAND, Leg(-left, hold_s), STAND] * (n // 2)]
    elif name == "survey":  # legs are drawn; brakes in time to be at rest at the end
        brake_s = max(_ramp_s(limit((1.2 * speed, 0.0, 0.0))), SPOT_RADPS / YAW_ACCEL_RADPS2)
        driven_s = remaining_s(brake_s + STAND_S, 6.0)
        legs, over_s = _take(survey(), driven_s)
        hold_s = legs[-1].hold_s - over_s
        if hold_s < 0:  # braking starts in the middle of a ramp, from the twist that was reached there
            legs[-1] = legs[-1]._replace(twist=_twists(legs, np.array([driven_s]))[0])
        legs = [*legs[:-1], legs[-1]._replace(hold_s=max(0.0, hold_s)), Leg(AT_REST, length_s)]
    elif name in ("complex", "crab"):
        rows = _CRAB if name == "crab" else f"{_CURVES}, {_SIDEWAYS if robot.sideways else _ON_THE_SPOT}"
        table = np.array([row.split() for row in rows.split(",")], dtype=float)
        twists = limit(table[:, :3] * (speed, speed, YAW_RATE_RADPS))
        ramps_s = sum(_ramp_s(b - a, smooth=True) for a, b in pairwise([AT_REST, *twists, AT_REST]))
        shares, held_s = table[:, 3] / table[:, 3].sum(), remaining_s(2 * STAND_S + ramps_s, 10.0)
        legs = [STAND, *(Leg(t, share * held_s) for t, share in zip(twists, shares, strict=True)), STAND]
    time_s = np.arange(round(length_s * RATE_HZ) + 1) / RATE_HZ
    twist = _twists(legs, time_s, name in ("complex", "crab"))
    return Scenario(name, RATE_HZ, time_s, twist, (Patch(0.0, grounds[0]),))


def from_legs(name: str, terrain: str, legs: Sequence[Leg]) -> Scenario:
    """Return the scenario of legs one after the other, from rest.

    Examples
    --------
    >>> drive = from_legs("there", "grass", [Leg(np.array([1.0, 0.0, 0.0]), 3.0), STAND])
    >>> float(drive.time_s[-1]), drive.twist[[25, 100, -1], 0]
    (6.0, array([0.5, 1. , 0. ]))
    """
    ramps_s = [_ramp_s(b.twist - a.twist, b.accel_mps2) for a, b in pairwise([STAND, *legs])]
    length_s = sum(ramps_s) + sum(leg.hold_s for leg in legs)
    time_s = np.arange(round(length_s * RATE_HZ) + 1) / RATE_HZ
    return Scenario(name, RATE_HZ, time_s, _twists(legs, time_s), (Patch(0.0, terrain),))


#: Columns of a file of commands.
COMMANDS: tuple[str, ...] = ("time_s", "speed_x_mps", "speed_y_mps", "yaw_rate_radps")


def from_commands(name: str, robot: Robot, terrain: str, commands: Array) -> Scenario:
    """Return the scenario of commands (n, 4) with the columns :data:`COMMANDS`, straight lines between them.

    Raises
    ------
    ConfigError
        if a number is not finite, times do not rise, the drive is too long, or the robot cannot drive it.
    """
    if len(commands) < 2 or not np.isfinite(commands).all() or not (np.diff(commands[:, 0]) > 0).all():
        raise ConfigError(f"{name}: two rows or more of finite numbers at rising times are required")
    length_s, fastest_mps = float(np.ptp(commands[:, 0])), fastest_mps_of(robot)
    if length_s > LONGEST_S:
        raise ConfigError(f"{name}: it lasts {length_s:g} s, at most {LONGEST_S:g} s are simulated")
    if not robot.sideways and commands[:, 2].any():
        raise ConfigError(f"{name}: speed_y_mps is not 0, and robot {robot.name} does not drive sideways")
    speed_mps = np.hypot(*commands[:, 1:3].T)
    if speed_mps.max() > fastest_mps:
        raise ConfigError(
            f"{name}: {speed_mps.max():g} m/s in row {int(np.argmax(speed_mps)) + 1}: robot {robot.name} drives up to "
            f"{fastest_mps:g} m/s"
        )
    time_s = np.arange(math.floor(length_s * RATE_HZ + 1e-6) + 1) / RATE_HZ
    twist = np.column_stack([np.interp(time_s, commands[:, 0] - commands[0, 0], x) for x in commands.T[1:]])
    return Scenario(name, RATE_HZ, time_s, twist, (Patch(0.0, terrain),))


def fastest_mps_of(robot: Robot) -> float:
    """Return the speed of the fastest wheels of a robot, or of a car; infinite where the description has none."""
    motors = robot.motors if isinstance(robot, SwerveRobot) else robot.completed.motors
    limit_mps = robot.wheel_radius_m * motors.speed_max_radps
    return min(limit_mps, robot.speed_max_mps) if isinstance(robot, BicycleRobot) else limit_mps


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


def _is_number(value: Any) -> bool:
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return number and math.isfinite(value)


_ANY = (-math.inf, math.inf, "a finite number")
_ABOVE_ZERO = (1e-6, math.inf, "a number above zero")
_FROM_ZERO = (0.0, math.inf, "a number from zero up")
_SLOPE = (-1.0, 1.0, "a gradient from -1 to 1")

_RANGES: dict[str, tuple[float, float, str]] = {
    "payload_kg": _FROM_ZERO,
    "payload_m": _ANY,
    "grade_ratio": _SLOPE,
    "undulation_ratio": _SLOPE,
    "undulation_length_m": _ABOVE_ZERO,
    "radius_factors": _ABOVE_ZERO,
    "roughness_factor": _FROM_ZERO,
    "field_length_m": _ABOVE_ZERO,
    "leg_backlash_rad": (0.0, 0.5, "an angle from 0 to 0.5 rad"),
}


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of one run; the defaults are level and nominal.

    All plants have load and slope, tracks an even one; tyres, roughness, variation and play are those of the dynamic
    plant alone.

    Raises
    ------
    ConfigError
        for a number that is not finite or out of its range.
    """

    # load, and where it lies (x, y) from the empty robot's centre of mass, body axes
    payload_kg: float = 0.0
    payload_m: tuple[float, float] = (0.0, 0.0)
    # (2,) mean gradient of the ground along world x and y, uphill positive
    grade_ratio: tuple[float, float] = (0.0, 0.0)
    undulation_ratio: float = 0.0  # a gradient along world x that changes along the path; its wave length
    undulation_length_m: float = 15.0
    # (3,) true rolling radius of each of the first wheels over the nominal one; a fourth has the nominal one
    radius_factors: tuple[float, float, float] = (1.0, 1.0, 1.0)
    roughness_factor: float = 1.0  # roughness over that of the soil's description
    field_length_m: float = 0.5  # over which length the terrain changes along the path
    # by how much the third leg swings to either side on its hinge (thesis, conclusions)
    leg_backlash_rad: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high, desired) in _RANGES.items():
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                if not (math.isfinite(number) and low <= number <= high):
                    raise ConfigError(f"conditions: {name} is {value!r}, {desired} is required")


@cache
def field_spread() -> dict[str, float]:
    """Return how wide :class:`Conditions` scatter: ``data/spread/field.yaml``, which has the sources.

    Examples
    --------
    >>> field_spread()["grade_std_ratio"]
    0.035
    """
    described = read_yaml(data_folder("spread") / "field.yaml")
    return {name: float(entry["value"]) for name, entry in described.items() if name != "name"}


SPREAD_KG, SPREAD_M = 90.0, 1.015  # mass and wheelbase of the robot whose loads the spread states


def draw_conditions(
    rng: np.random.Generator, nominal: Conditions | None = None, robot: Robot | None = None
) -> Conditions:
    """Return the conditions of one run, drawn around the nominal ones.

    Normal draws are cut at two standard deviations, so that no run is impossible.  Lengths are the spread's; the load
    and its place are in proportion to a robot's mass and wheelbase.
    """
    nominal, spread = nominal or Conditions(), field_spread()

    def normal(name: str, n: int) -> Array:
        return spread[name] * np.clip(rng.standard_normal(n), -2.0, 2.0)

    grade = np.array(nominal.grade_ratio) + normal("grade_std_ratio", 2)
    radius = np.array(nominal.radius_factors) * (1.0 + normal("radius_std_ratio", 3))
    heavy, large = (robot.mass_kg / SPREAD_KG, robot.wheelbase_m / SPREAD_M) if robot else (1.0, 1.0)
    offset_m = spread["payload_offset_m"] * large
    offset = np.array(nominal.payload_m) + rng.uniform(-offset_m, offset_m, 2)
    payload_kg = nominal.payload_kg + float(rng.uniform(0.0, spread["payload_max_kg"] * heavy))
    undulation = nominal.undulation_ratio + float(normal("undulation_std_ratio", 1)[0])
    rougher = float(np.exp(normal("roughness_log_std_ratio", 1)[0]))
    return replace(
        nominal,
        payload_kg=payload_kg,
        payload_m=tuple(offset.tolist()),
        grade_ratio=tuple(grade.tolist()),
        undulation_ratio=undulation,
        undulation_length_m=spread["undulation_length_m"],
        radius_factors=tuple(radius.tolist()),
        roughness_factor=nominal.roughness_factor * rougher,
        field_length_m=spread["field_length_m"],
    )


@dataclass(frozen=True, slots=True)
class Faults:
    """What goes wrong with the sensors on purpose, beside what they do by themselves.

    Raises
    ------
    ConfigError
        if an interval does not end after it starts.
    """

    camera_lost_s: tuple[tuple[float, float], ...] = ()  # intervals (start, end) without a sample
    by_chance: bool = True  # dropouts and jumps of the camera at the rates of its description

    def __post_init__(self) -> None:
        for start_s, end_s in self.camera_lost_s:
            if not start_s < end_s:
                raise ConfigError(
                    f"faults: camera_lost_s has ({start_s!r}, {end_s!r}), start before end is required"
                )


NO_FAULTS: Faults = Faults()  # nothing on purpose
