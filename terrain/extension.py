"""Extended robots: a description with effects, and what filters make of it.

The catalogue (:mod:`terrain.effects`) states of each effect where it goes.  It has a home in the description,
as a wheel's radius has, or an inverse on samples, as a gyro's scale has, or neither, as those of the ground
and of turning, which filters do not model.  Whoever reads a run and its robot corrects both, once::

    run, robot = correct(run, robot)

and filters take what is corrected.  A learned term (:mod:`terrain.learned_term`) of the motion is corrected alike, in
the wheels' samples, of a car-like robot in the rows of its observers (:func:`rolling_axle`).  What of the terms filters
do not take is warned of.  A live chain gives its estimator the robot and the
:class:`Correction` of :func:`correct_live`.  Where a description lacks the section of a home, samples are
corrected instead if the effect has an inverse.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import yaml

from terrain.angles import unwrapped
from terrain.deviation import Deviation, deviation_lines
from terrain.effects import (
    ACCEL,
    GYRO,
    PARAMETER,
    SCHEMA,
    SPEED_Y,
    STAMPS,
    Block,
    changed_samples,
    checked_covariance,
    checked_effects,
    parameters_of,
)
from terrain.errors import ConfigError, NotTakenWarning, OutsideRegionWarning
from terrain.files.documents import parse_yaml, read_yaml
from terrain.kinematics.wheels import no_slip_twist, rolled_twist, rolling_matrix
from terrain.learned_term import INPUTS, MOTION, Factor, LearnedTerm, learned_lines, rolling_change
from terrain.records import Array, RunLog, Stream
from terrain.robots import BicycleRobot, Range, Region, Robot, description_file, outside, robot_from, widened

AnyRobot = TypeVar("AnyRobot", bound=Robot)  #: What is corrected keeps its drive.


def apply_homes(robot: AnyRobot, names: Collection[str] = tuple(PARAMETER)) -> AnyRobot:
    """Return a robot with those of its effects that have a home in its description, and are named, applied there.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> extended = replace(load_robot("agrimaro"), effects={"payload_ratio": 0.1, "camera_yaw_rad": 0.02})
    >>> robot = apply_homes(extended)
    >>> round(robot.mass_kg, 3), dict(robot.effects)
    (99.0, {'camera_yaw_rad': 0.02})
    """
    applied = []
    for name, value in robot.effects.items():
        homes = PARAMETER[name].homes
        there = [home for home in homes if not home.section or robot.describes(home.section)]
        if name not in names or not there or not all(home.optional for home in homes if home not in there):
            continue
        for home in there:
            part: Any = robot.parts[home.section] if home.section else robot
            change = value * getattr(part, home.scaled_by) if home.scaled_by else value
            part = replace(part, **{home.field: home.combine.apply(getattr(part, home.field), change)})
            robot = robot.with_parts(**{home.section: part}) if home.section else part
        applied.append(name)
    return _without(robot, applied)


def corrected(robot: AnyRobot) -> AnyRobot:
    """Return the robot that filters take, together with a log that is :func:`corrected_log`.

    Of effects without a home in the description those are left that have no inverse on samples.  Learned motion is in
    the samples of its wheels, or the rows of its observers.  A robot that was corrected is returned as it is.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> robot = corrected(replace(load_robot("agrimaro"), effects={"wheel_radius_ratio": 0.05}))
    >>> round(robot.wheel_radius_m, 3), dict(robot.effects)
    (0.21, {})
    """
    robot = replace(robot, learned=()) if robot.learned else robot
    if not robot.effects:
        return robot
    return _without(apply_homes(robot), [name for name in robot.effects if PARAMETER[name].inverse])


def check_corrected(robot: Robot) -> None:
    """Refuse a robot with effects that :func:`corrected` would apply or that samples would be corrected for.

    Raises
    ------
    ConfigError
        if there are any: a filter would take them for motion.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> check_corrected(replace(load_robot("agrimaro"), effects={"camera_yaw_rad": 0.02}))
    Traceback (most recent call last):
    terrain.errors.ConfigError: robot agrimaro: camera_yaw_rad is not corrected, neither in it nor in its log
    """
    left = set(robot.effects) - set(corrected(robot).effects)
    left |= {f"learned {term.channel}" for term in robot.learned}
    if left:
        raise ConfigError(
            f"robot {robot.name}: {', '.join(sorted(left))} is not corrected, neither in it nor in its log"
        )


def _without(robot: AnyRobot, names: Collection[str]) -> AnyRobot:
    rest = [i for i, name in enumerate(robot.effects) if name not in names]
    if len(rest) == len(robot.effects):
        return robot
    effects = {n: value for n, value in robot.effects.items() if n not in names}
    return replace(robot, effects=effects, effects_cov=robot.effects_cov[np.ix_(rest, rest)])


#: Time outside after which a live drive is: shorter ones, as of a bump, are in the percentiles' tails.
OUTSIDE_S = 1.0

#: Longest time that a live sample stands for: after a gap nothing is known of what was driven.
MAX_STEP_S = 0.1
#: Edges of a range: single samples, as of a start or a wheel that spun, are not what was validated.
PERCENTILES = (1.0, 99.0)


def region_of(runs: Sequence[RunLog], robot: Robot) -> Region:
    """Return the ranges of wheel speed, yaw rate by the wheels and slope of runs as measured, and their terrains.

    Effects of the robot are not applied, so that a run can be judged before it is corrected.

    Examples
    --------
    >>> from terrain.records import Stream
    >>> from terrain.robots import load_robot
    >>> wheels = Stream([0.0, 0.1], [[0.5, 0.9], [0.5, 0.9]], ("speed_left_mps", "speed_right_mps"))
    >>> region = region_of([RunLog("a", "husky", {"wheels": wheels})], load_robot("husky"))
    >>> region.wheel_speed_mps, region.grade_rad
    ((0.7, 0.7), None)
    """
    driven = [_driven(run, robot) for run in runs]
    speed, turn, grade = (np.concatenate([each[i] for each in driven] or [np.empty(0)]) for i in range(3))
    terrains = sorted({name for run in runs for name in run.terrains})
    return Region(_range(speed), _range(turn), _range(grade), tuple(terrains))


def warn_outside(run: RunLog, robot: Robot) -> None:
    """Warn, in one sentence, where a run leaves the region that the robot's effects were validated in, if any.

    Warns
    -----
    OutsideRegionWarning
        with the ranges of the run and those validated.
    """
    if robot.region is not None and (beyond := outside(robot.region, region_of([run], robot))):
        _warn_of(f"run {run.run_id}", robot, beyond)


def _warn_of(drive: str, robot: Robot, beyond: str) -> None:
    """Warn that a drive leaves the region, ``beyond`` as :func:`terrain.robots.outside` returns it."""
    warnings.warn(
        f"{drive} leaves the region that the effects of robot {robot.name} were validated in: {beyond}",
        OutsideRegionWarning,
        stacklevel=4,
    )


class RegionMonitor:
    """Warns, once, when a robot that is driven live has been outside its region for :data:`OUTSIDE_S`.

    ``compares`` states whether samples are compared: there is a region, and nothing was warned of yet; ``memory`` is
    how long it was outside, and the time of the last sample.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot, self.memory = robot, (0.0, math.inf)
        region = robot.region
        ranges = {} if region is None else region._asdict()
        self._limits = tuple(
            widened(name, ranges[name]) if ranges.get(name) is not None else (-math.inf, math.inf)
            for name in ("wheel_speed_mps", "yaw_rate_radps")
        )
        self.compares = region is not None

    def step(self, time_s: float, wheel_speed_mps: float, yaw_rate_radps: float) -> None:
        """Take in a sample: mean wheel speed and yaw rate; NaN is inside."""
        if not self.compares:
            return
        (slow, fast), (right, left) = self._limits
        outside_s, last_s = self.memory
        beyond = wheel_speed_mps < slow or wheel_speed_mps > fast or yaw_rate_radps < right
        if beyond or yaw_rate_radps > left:
            outside_s += min(max(time_s - last_s, 0.0), MAX_STEP_S)
        self.memory = outside_s, time_s
        if outside_s >= OUTSIDE_S and self._robot.region is not None:
            self.compares = False
            now = Region((wheel_speed_mps,) * 2, (yaw_rate_radps,) * 2, None, ())
            _warn_of(f"the drive at {time_s:.1f} s", self._robot, outside(self._robot.region, now))


def _driven(run: RunLog, robot: Robot) -> tuple[Array, Array, Array]:
    """Return mean wheel speed (n,), yaw rate by the wheels (n,) and slope (m,); empty where not measured.

    Of omni wheels, which drive in three directions, the speed is what they would roll in any.
    """
    none = np.empty(0)
    wheels, imu = run.streams.get("wheels"), run.streams.get("imu")
    grade = -imu.channel("pitch_rad") if imu is not None and "pitch_rad" in imu.channels else none
    if wheels is None or not set(robot.rate_channels) <= set(wheels.channels):
        return none, none, grade
    rates = wheels.columns(robot.rate_channels)
    if robot.rate_channels[0].startswith("motor_"):
        rates = rates * (robot.wheel_radius_m / robot.reduction_ratio)
    directions, speed = robot.wheel_directions_rad, rates.mean(axis=1)
    if robot.steered:
        steering = run.streams.get("steering")
        if steering is None or not set(robot.steer_channels) <= set(steering.channels):
            return speed, none, grade
        angles = [
            np.interp(wheels.time_s, steering.time_s, unwrapped(steering.channel(name))) - zero
            for name, zero in zip(robot.steer_channels, robot.steering_zeros_rad, strict=False)
        ]
        if isinstance(robot, BicycleRobot):
            ahead, _, turn = rolled_twist(robot, rates, angles[0][:, None]).T
            return ahead, turn, grade
        directions = np.column_stack(angles)
    rollers = robot.on_omni_wheels, robot.roller_angles_rad
    twist, _ = no_slip_twist(robot.wheel_positions_m, directions, rates, *rollers)
    return np.hypot(twist[:, 0], twist[:, 1]) if robot.on_omni_wheels else speed, twist[:, 2], grade


def _range(values: Array) -> Range | None:
    known = values[np.isfinite(values)]
    if not known.size:
        return None
    low, high = np.percentile(known, PERCENTILES)
    return float(low), float(high)


def correct(run: RunLog, robot: AnyRobot) -> tuple[RunLog, AnyRobot]:
    """Return a log and its robot without the effects that can be taken off them, as filters take both.

    A robot without effects, or one that was corrected, is returned as it is, and so is its log.

    Warns
    -----
    OutsideRegionWarning
        if the run leaves the region that the robot's effects were validated in.
    NotTakenWarning
        if it has learned terms that filters do not take.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> robot = replace(load_robot("husky"), effects={"wheel_radius_ratio": 0.1})
    >>> wheels = Stream([0.0, 0.1], [[1.0], [1.0]], ("speed_left_mps",))
    >>> run, robot = correct(RunLog("a", "husky", {"wheels": wheels}), robot)
    >>> run.streams["wheels"].values[:, 0], dict(robot.effects)
    (array([1.1, 1.1]), {})
    """
    warn_outside(run, robot)
    warn_not_taken(robot)
    return corrected_log(run, robot), corrected(robot)


STANDING_MPS = 0.05  #: An axle that is slower has no turning radius.
NOT_TAKEN = {SPEED_Y: "sideways speed", GYRO: "gyro", ACCEL: "accelerometer"}
"""Channels that filters have, whose learned terms they do not take; the sideways speed but of robots that drive so."""


def warn_not_taken(robot: Robot) -> None:
    """Warn, in one sentence, of learned terms that filters of a robot do not take.

    Warns
    -----
    NotTakenWarning
        with the channels.
    """
    sideways = robot.sideways or robot.on_omni_wheels
    left = {term.channel for term in robot.learned} - ({SPEED_Y} if sideways else set())
    if words := [word for channel, word in NOT_TAKEN.items() if channel in left]:
        warnings.warn(
            f"filters of robot {robot.name} do not take what was learned of its {' and '.join(words)}, which "
            "its simulation does",
            NotTakenWarning,
            stacklevel=3,
        )


def correct_live(robot: AnyRobot) -> tuple[AnyRobot, Correction | None]:
    """Return a robot as live filters take it, and what corrects the samples that come; None without effects.

    Warns
    -----
    NotTakenWarning
        if it has learned terms that filters do not take.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> correct_live(load_robot("husky"))[1] is None
    True
    """
    warn_not_taken(robot)
    return corrected(robot), Correction(robot) if robot.effects or robot.learned else None


def corrected_log(run: RunLog, robot: Robot) -> RunLog:
    """Return a log as the robot would have written it without the effects that have an inverse on samples.

    Commands, estimates and labels are left alone; of a simulated truth the wheels' rates become those of
    wheels of one radius.  Without effects and learned terms the log is returned as it is.
    """
    if not robot.effects and not robot.learned:
        return run
    wheels = run.streams.get("wheels")
    correction = Correction(robot, float(wheels.time_s[0]) if wheels is not None and len(wheels) else 0.0)
    streams = dict(run.streams)
    for name in sorted(streams, key="wheels".__eq__):  # which come last, as live
        stream = streams[name]
        streams[name] = Stream(
            *correction(name, stream.channels, stream.time_s, stream.values), stream.channels
        )
    return replace(run, streams=streams)


def rolling_axle(
    robot: BicycleRobot,
    terms: Sequence[LearnedTerm],
    speed_mps: float,
    steer_rad: float,
    step_s: float,
    lags: Sequence[dict[Factor, Array]],
) -> tuple[float, float]:
    """Return the speed of the axle and the steering angle of a car-like robot that rolls as it moves by learned terms.

    Parameters
    ----------
    speed_mps, steer_rad : as measured; NaN of a sample that is missing changes nothing
    step_s : since the last sample
    lags : memory of each term, moved on
    """
    inputs = np.zeros((1, len(INPUTS)))
    inputs[:, :3] = rolled_twist(robot, np.array([[speed_mps]]), np.array([[steer_rad]]))
    ahead, _, turn = (inputs[:, :3] + rolling_change(terms, inputs, np.array([step_s]), lags))[0].tolist()
    if not math.isfinite(ahead + turn) or abs(ahead) < STANDING_MPS:
        return speed_mps, steer_rad
    steer_rad = math.atan(robot.wheelbase_m * turn / ahead)
    return ahead / math.cos(steer_rad) if robot.front_driven else ahead, steer_rad


class Correction:
    """Takes a robot's effects off samples, a run in one block or block by block.

    Learned motion is added to the wheels, along the direction that each drives in: filters, which take these to roll,
    then move as the body does.  Of a car-like robot it turns the steering too by :attr:`axle_terms` of its observers.

    Drifts count from the first stamp of the wheels, ``start_s``, by default from the first stamp that comes.
    """

    def __init__(self, robot: Robot, start_s: float = math.nan) -> None:
        self._robot, self._applied, self._start_s = robot, apply_homes(robot), start_s
        acting = [
            (float(robot.effects[name]), inverse)
            for name, parameter in PARAMETER.items()
            if robot.effects.get(name)
            and (inverse := parameter.inverse)
            and (name in self._applied.effects or not inverse.without_home)
        ]
        # what was added last comes off first: offsets, then factors
        self._acting = sorted(acting, key=lambda each: each[1].is_factor)
        self._memory: dict[str, Any] = {}
        terms = [term for term in robot.learned if term.channel in MOTION]
        #: learned motion of a car-like robot; empty of others
        self.axle_terms = terms if isinstance(robot, BicycleRobot) else []
        self._terms = [] if self.axle_terms else terms
        self._steered: tuple[Array, Array] = (np.empty(0), np.empty((0, len(robot.steer_channels))))
        self._lags: list[dict[Factor, Array]] = [{} for _ in self._terms]

    def __call__(
        self, name: str, channels: tuple[str, ...], time_s: Array, values: Array
    ) -> tuple[Array, Array]:
        """Return stamps (k,) and values (k, c) of the samples of a stream that follow on those given before."""
        if math.isnan(self._start_s):
            finite = time_s[np.isfinite(time_s)]
            if not finite.size:
                return time_s, values
            self._start_s = float(finite[0])
        own = [(value, inverse) for value, inverse in self._acting if name in inverse.streams]
        if any(inverse.columns != STAMPS for _, inverse in own):
            values = np.array(values, dtype=float)
        if name == "steering" and self._terms:
            self._remember(channels, time_s, values)
        added = self._rolling(name, channels, time_s, values)
        about = np.asarray(time_s), values, self._start_s, self._robot, self._applied, self._memory
        with np.errstate(invalid="ignore", over="ignore"):  # samples may be no finite numbers
            stamps, values = changed_samples(Block(name, channels, *about), own, False)
        return stamps, values if added is None else values + added

    def _rolling(self, name: str, channels: tuple[str, ...], time_s: Array, values: Array) -> Array | None:
        """Return what learned motion adds to the samples of wheels, which are still as measured; None without."""
        robot, applied = self._robot, self._applied
        if name != "wheels" or not self._terms or not set(robot.rate_channels) <= set(channels):
            return None
        places = [channels.index(channel) for channel in robot.rate_channels]
        ratio = robot.reduction_ratio if robot.by_motor else 1.0
        speed = values[:, places] * (robot.wheel_radius_m / ratio if robot.by_motor else 1.0)
        inputs = np.zeros((len(values), len(INPUTS)))
        steer = self._steering(time_s, speed)
        inputs[:, :3] = rolled_twist(robot, speed, steer)
        before = np.concatenate([[self._memory.get("learned", math.nan)], time_s])
        if np.isfinite(time_s).any():
            self._memory["learned"] = float(time_s[np.isfinite(time_s)][-1])
        change = rolling_change(self._terms, inputs, np.diff(before), self._lags)
        added = np.zeros(values.shape)
        if robot.skids:
            turn = 0.5 * applied.track_m * change[:, 2]
            added[:, places] = np.column_stack([change[:, 0] - turn, change[:, 0] + turn])
        else:
            place = robot.wheel_positions_m, steer + robot.wheel_directions_rad, robot.roller_angles_rad
            along = np.einsum("nwk,nk->nw", rolling_matrix(*place), change)
            added[:, places] = np.where(np.isfinite(along), along, 0.0)  # where no angle is known yet
        if robot.by_motor:
            added *= ratio / applied.wheel_radius_m
        return added

    def _remember(self, channels: tuple[str, ...], time_s: Array, values: Array) -> None:
        """Keep the steering as measured until the wheels come."""
        if not set(self._robot.steer_channels) <= set(channels):
            return
        angles = values[:, [channels.index(channel) for channel in self._robot.steer_channels]]
        known = np.isfinite(time_s) & np.isfinite(angles).all(axis=1)
        stamps = np.concatenate([self._steered[0], time_s[known]])
        order = np.argsort(stamps, kind="stable")
        self._steered = stamps[order], np.concatenate([self._steered[1], angles[known]])[order]

    def _steering(self, time_s: Array, speed: Array) -> Array:
        """Return the last angles (n, wheels) of the steering at stamps (n,); NaN before the first, 0 of others."""
        if not self._robot.steered:
            return np.zeros(speed.shape)
        stamps, angles = self._steered
        at = np.searchsorted(stamps, time_s, side="right") - 1
        if len(at) and at[-1] > 0:
            self._steered = stamps[at[-1] :], angles[at[-1] :]
        if not len(stamps):
            return np.full(speed.shape, np.nan)
        return np.where(at[:, None] < 0, np.nan, angles[at] - self._robot.steering_zeros_rad)


class Origin(StrEnum):
    """Where a number of a description comes from."""

    SOURCED = "sourced"
    ASSUMED = "assumed"
    LEFT_OUT = "left out"


class Basis(NamedTuple):
    """A number of a robot's description that a parameter of an effect changes."""

    section: str  #: of the description; empty for a number of the robot itself
    field: str
    #: as it stands; the neutral one of Robot.completed where the description lacks the section
    described: float
    extended: float  #: with the parameter's value
    origin: Origin
    written: str  #: what the description calls it: of tracks sprocket_radius_m is the wheel_radius_m

    @property
    def name(self) -> str:
        """Name of the number, as :attr:`terrain.robots.Robot.assumed` has it."""
        return f"{self.section}.{self.written}" if self.section else self.written

    @property
    def is_described(self) -> bool:
        """Whether the description states a number that is not 0."""
        return bool(self.described) and self.origin is not Origin.LEFT_OUT


def basis_of(robot: Robot, parameter: str, value: float = 0.0) -> tuple[Basis, ...]:
    """Return the described numbers that a parameter of an effect changes; none where it has no home.

    A lever arm of -0.23 m is relative to the lever arm described: where that one is assumed, so is half of
    the answer, and only their sum was measured.  The robot's own effects are not applied.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> (basis,) = basis_of(load_robot("husky"), "lever_x_m", -0.23)
    >>> basis.name, basis.described, round(basis.extended, 2), basis.origin.value
    ('camera.lever_x_m', 0.35, 0.12, 'assumed')
    >>> basis_of(load_robot("husky"), "yaw_delay_s")
    ()
    """
    before = replace(robot.completed, effects={}, effects_cov=np.empty((0, 0)))
    after = apply_homes(replace(before, effects={parameter: value}, effects_cov=np.full((1, 1), np.nan)))
    bases = []
    for home in PARAMETER[parameter].homes:
        if home.section and home.section not in before.parts:
            continue
        spelled, factor = robot.spelled.get(home.field, (home.field, 1.0))
        written = home.field if home.section or factor != 1.0 else spelled
        parts = (each.parts[home.section] if home.section else each for each in (before, after))
        described, extended = (float(getattr(part, home.field)) for part in parts)
        basis = Basis(home.section, home.field, described, extended, Origin.SOURCED, written)
        if home.section and not robot.describes(home.section):
            basis = basis._replace(origin=Origin.LEFT_OUT)
        elif basis.name in robot.assumed:
            basis = basis._replace(origin=Origin.ASSUMED)
        bases.append(basis)
    return tuple(bases)


EARLIER = "the description that was extended"  #: Source of what was built in already

DIGITS = 7  #: Significant digits that a file has of each number.


def extended_yaml(
    robot_name: str | Path,
    values: Mapping[str, float],
    covariance: Array,
    intervals: Mapping[str, tuple[float, float]],
    source: str | Mapping[str, str],
    region: Region | None = None,
    learned: Sequence[LearnedTerm] = (),
    deviation: Deviation | None = None,
    watch: Sequence[str] = (),
) -> str:
    """Return the description of a robot with a section ``effects``, as YAML.

    Where there are terms it has a section ``learned``, and ``deviation`` where that is known.

    Everything else is kept, comments included; earlier sections of these names are replaced.

    Parameters
    ----------
    robot_name : or path of its YAML file
    values, covariance : by parameter, and (n, n) in their order
    intervals : 95 % of each value
    source : of the numbers, in words; by parameter where they differ
    region : of driving, that they were validated in
    learned : terms that act beside the effects
    deviation : of runs from the simulation of the extended robot
    watch : lines of the section by which the robot is watched (:func:`terrain.discrepancy.watch.watch_lines`)

    Raises
    ------
    ConfigError
        if the robot, a value, the covariance or an interval is not accepted.

    Examples
    --------
    >>> value, interval = {"gyro_scale_ratio": 0.02}, {"gyro_scale_ratio": (0.016, 0.024)}
    >>> text = extended_yaml("husky", value, np.array([[4e-6]]), interval, "me")
    >>> print("".join(text.partition("effects:")[1:]), end="")
    effects:
      schema: 1
      gyro_scale_ratio: {value: 0.02, unit: ratio, source: me, interval: [0.016, 0.024]}
      covariance:
        gyro_scale_ratio: {gyro_scale_ratio: 4.0e-06}
    """
    path = description_file(robot_name)
    described = read_yaml(path)
    robot = robot_from(path.name, described)
    values = checked_effects("effects", values, robot.drive)
    names = list(values)
    cov = checked_covariance("effects: covariance", np.asarray(covariance, dtype=float))
    if cov.shape != (len(names), len(names)):
        raise ConfigError(
            f"effects: covariance has the shape {cov.shape}, {(len(names), len(names))} is required"
        )
    known, section = parameters_of(robot.drive), {"schema": str(SCHEMA)}
    for name, value in values.items():
        low, high = [float(edge) for edge in intervals.get(name, (math.nan, math.nan))]
        if not low <= value <= high < math.inf:
            raise ConfigError(f"effects: {name} is {value:g}, its interval {low:g} to {high:g} must hold it")
        of = source if isinstance(source, str) else source.get(name, EARLIER)
        entry: dict[str, Any] = {"value": _rounded(value), "unit": known[name].unit, "source": of}
        section[name] = _flow(entry | {"interval": [_rounded(low), _rounded(high)]})
    lines = ["effects:", *[f"  {name}: {entry}" for name, entry in section.items()]]
    lines.append("  covariance:" if names else "  covariance: {}")
    for name, row in zip(names, cov, strict=True):
        lines.append(f"    {name}: {_flow(dict(zip(names, map(_rounded, row), strict=True)))}")
    if region is not None:  # a range that was not measured has no line
        ranges = {
            name: [*map(_rounded, pair)]
            for name, pair in zip(region._fields, region[:3], strict=False)
            if pair
        }
        lines.append("  region:")
        lines += [f"    {n}: {_flow(e)}" for n, e in {**ranges, "terrains": [*region.terrains]}.items()]
    lines += [*learned_lines(learned), *deviation_lines(deviation), *watch]
    text = _without_extension(path.read_text(encoding="utf-8-sig")) + "\n".join(lines) + "\n"
    try:
        content = parse_yaml(text)
    except ValueError:
        content = None
    own, kept = (
        {n: e for n, e in each.items() if n not in EXTENSION} if isinstance(each, dict) else None
        for each in (described, content)
    )
    if own != kept:
        raise ConfigError(f"{path}: cannot be extended as it is written: one section a line is required")
    robot_from(path.name, content)
    return text


EXTENSION = ("effects", "learned", "deviation", "watch")  #: Sections that an extension writes.


def _without_extension(text: str) -> str:
    """Return the text of a description without the sections that an extension writes."""
    lines, inside = [], False
    for line in text.splitlines():
        if line.strip() and not line.startswith((" ", "#")):
            inside = line.startswith(tuple(f"{name}:" for name in EXTENSION))
        if not inside:
            lines.append(line)
    return "\n".join(lines).rstrip() + "\n"


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _flow(entry: Any) -> str:
    text = yaml.safe_dump(entry, default_flow_style=True, sort_keys=False, allow_unicode=True, width=math.inf)
    return str(text).removesuffix("...\n").strip()
