"""Effects: named groups of parameters of the simulation that are 0 where the effect is absent.

An entry holds all about an effect: bounds, robots, channels, the stage where it acts, where a description has it,
how it is taken off samples, and its words.

Signals of the formulas are those of :mod:`terrain.simulation.plants.planar`: ``u`` the speed that the wheels
would roll without slip, ``v`` the speed over ground, ``d`` a steering angle, ``w`` the yaw rate, ``F`` the
traction, ``W = m g`` the nominal weight, ``f = F / W``, ``th`` the grade (uphill positive), ``ph`` the roll
(left side up positive), ``B`` the track, ``dv`` right minus left wheel speed and
``q = |dv| / (|dv| + 2 |u|)`` how tight a turn is.

To add an effect, write its entry into ``data/effects/library.yaml``, with formula, source and how it is taken off
samples above it, and its formula into the kernels of :mod:`terrain.simulation.plants.planar`.  Everything else reads
the entry, whose keys are the fields of :class:`Effect`, :class:`Parameter`, :class:`Home` and :class:`Inverse`.

The section ``effects`` of a robot's description has those found by ``terrain explain``.  Each parameter is a
number with unit, source and interval like any other; the covariance has a row a parameter, and may be left
out where it is unknown::

    effects:
      schema: 1
      wheel_radius_ratio: {value: 0.031, unit: ratio, source: "terrain explain", interval: [0.028, 0.034]}
      camera_yaw_rad: {value: -0.012, unit: rad, source: "terrain explain", interval: [-0.013, -0.011]}
      covariance:
        wheel_radius_ratio: {wheel_radius_ratio: 2.3e-06, camera_yaw_rad: 1.0e-08}
        camera_yaw_rad: {wheel_radius_ratio: 1.0e-08, camera_yaw_rad: 2.6e-07}

A parameter that is not there is 0, and its effect absent.  Former names of parameters are read as the present
ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from terrain.angles import unwrapped, wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.files.documents import check_keys, is_number, numbers
from terrain.files.names import data_folder
from terrain.kernels import record
from terrain.records import Array, read_only

#: Channels that are compared: gyro, speed over ground of the camera's point, accelerometer, sum of the motor
#: currents, right minus left current, and the rate of a heading that no gyro measured (lidar, two antennas).
CHANNELS: tuple[str, ...] = (
    *("yaw_rate_radps", "speed_x_mps", "speed_y_mps", "accel_x_mps2"),
    *("current_a", "turning_current_a", "heading_rate_radps"),
)

GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT, TURNING_CURRENT, HEADING = CHANNELS

SKID, TRACKED, SWERVE, OMNI, BICYCLE = "skid_steer", "tracked", "swerve", "omni", "bicycle"
SKIDDING = (SKID, TRACKED)  #: Drives that turn by a difference of their sides.
BOTH = (*SKIDDING, SWERVE)  #: Drives of wheels that do not roll across, but for cars.


class Combine(Enum):
    """How a parameter ``e`` changes a number ``x`` of a robot's description."""

    ADDED = "x + e"
    SUBTRACTED = "x - e"
    TIMES = "x (1 + e)"
    OVER = "x / (1 + e)"

    def apply(self, number: Any, value: float) -> Any:
        """Return the changed number, or numbers.

        Examples
        --------
        >>> Combine.OVER.apply(0.3, 1.0), Combine.SUBTRACTED.apply(0.0, 0.1)
        (0.15, -0.1)
        """
        if self in (Combine.ADDED, Combine.SUBTRACTED):
            return number + value if self is Combine.ADDED else number - value
        return number * (1.0 + value) if self is Combine.TIMES else number / (1.0 + value)

    def invert(self, number: Any, value: float) -> Any:
        """Return the number, or numbers, from what :meth:`apply` makes of them."""
        pairs = (Combine.ADDED, Combine.SUBTRACTED), (Combine.TIMES, Combine.OVER)
        ((first, second),) = (pair for pair in pairs if self in pair)
        return (second if self is first else first).apply(number, value)


class Home(NamedTuple):
    """A number of the description that a parameter changes."""

    section: str  #: of the description; empty for a number of the robot itself
    field: str
    combine: Combine
    scaled_by: str = ""  #: field of the same section that the parameter is multiplied by first
    optional: bool = False  #: the parameter also has its other homes where the description lacks this section


STAMPS = ("stamp",)  #: In place of channels: the stamps of the samples.


class Block(NamedTuple):
    """Samples of a stream that follow on those given before, off which an effect is taken, in place."""

    stream: str
    channels: tuple[str, ...]
    time_s: Array  #: (k,)
    values: Array  #: (k, c) as measured
    start_s: float  #: first stamp of the wheels, from which drifts count
    robot: Any  #: with its effects
    applied: Any  #: the same with those effects applied that have a home
    memory: dict[str, Any]  #: of the samples before


class Inverse(NamedTuple):
    """How a parameter is taken off the samples of a log, and how it acts on those of a sensor.

    Of all that act on one number, factors do before offsets, and offsets come off before factors.
    """

    streams: tuple[str, ...]  #: whose samples or stamps change
    columns: tuple[str, ...] = ()  #: beginnings of the channels that change, or STAMPS
    combine: Combine = Combine.ADDED  #: how the corrected number follows from the measured one
    without_home: bool = False  #: only where the description lacks the section of the parameter's home
    drifts: bool = False  #: whether the value grows from 0 with the time since the start, by itself a minute
    #: of what takes more than one number a sample, in place of a change of columns; two parameters may share one
    undo: Callable[[Block, float], None] | None = None
    act: Callable[[Block, float], None] | None = None

    @property
    def is_factor(self) -> bool:
        """Whether numbers are multiplied."""
        return self.combine in (Combine.TIMES, Combine.OVER)

    def size(self, value: float, since_start_s: Array) -> Any:
        """Return the value at times (k,) since the start."""
        return value * since_start_s / 60.0 if self.drifts else value


class Parameter(NamedTuple):
    """A number of the simulation that is 0 where its effect is absent.

    Sensitivities are taken towards both sides, over ``step``, a small change that is still visible: a delay to one
    side alone is half a step off, and noise of the wheels looks like it.
    """

    name: str  #: ends in its unit
    low: float  #: bounds of the search
    high: float
    step: float
    #: range of the whole value that a builder would believe; a value whose interval lies beyond it is never named
    plausible: tuple[float, float] = (-math.inf, math.inf)
    plausible_source: str = ""
    homes: tuple[Home, ...] = ()  #: where the description has it; all of them change together
    inverse: Inverse | None = None
    one_sided: bool = False  #: sensitivities towards the positive side only: a backlash is not negative
    #: from 1, place in the order in which values that scatter from run to run are drawn
    scatter_rank: int = 0
    as_percent: bool = False  #: pages write it as a percentage
    is_error: bool = False  #: of something that is there, so that pages write "off by"
    deprecated: tuple[str, ...] = ()  #: former names, accepted in files and on the command line

    @property
    def unit(self) -> str:
        """Last word of the name."""
        return self.name.rpartition("_")[2]

    @property
    def label(self) -> str:
        """Words of the name without its unit, as pages write it."""
        return self.name.rpartition("_")[0].replace("_", " ")

    def is_plausible(self, low: float, high: float) -> bool:
        """Return whether an interval of the whole value reaches into the plausible range."""
        return low <= self.plausible[1] and high >= self.plausible[0]


class Stage(Enum):
    """Where an effect acts in the dynamic simulation."""

    DESCRIPTION = "the number of its home"
    BODY = "masses and wheel radii of the plant"
    LINKAGE = "between the steering encoders and the wheels"
    CONTACT = "between wheel and ground"
    SENSORS = "samples and stamps"


class Term(NamedTuple):
    """A value as sentences write it."""

    found: float
    half: float  #: of its interval
    total: float  #: with what the robot has of it already
    described: float  #: number of the description that it changes; 0 where there is none
    extended: float  #: the same with the value, or the total
    note: str  #: on the described number, in brackets
    robot: Any  #: as it was tested


class Effect(NamedTuple):
    """An error that the simulation may have."""

    name: str  #: as --effect and results have it
    parameters: tuple[Parameter, ...]
    drives: tuple[str, ...]  #: kinds of robots that it applies to
    channels: tuple[str, ...]  #: where it is visible: a tenth as clearly over the noise as in the clearest
    needs: str  #: the driving that excites it
    source: str  #: of its formula
    #: changes of pose show it: :mod:`terrain.calibration.poses` fits it
    kinematic: bool = False
    sensed_only: bool = False  #: it changes what sensors measure, and not the motion of the body
    stage: Stage | None = None  #: where it acts in the dynamic simulation, of the robots that that simulates
    aliases: tuple[str, ...] = ()  #: other names of the same effect, which no log distinguishes from it
    #: effects that look the same, and the channel that distinguishes them
    twins: tuple[tuple[str, str], ...] = ()
    deprecated: tuple[str, ...] = ()  #: former names, accepted on the command line
    #: what its values make of the robot, as the object of "with"; by default the number of its home, or the values
    words: Callable[[Sequence[Term]], str] | None = None
    modifies: str = ""  #: name of the effect without which it does nothing
    #: drive, and name of the effect that has to be known before runs of it can show this one
    beside: tuple[tuple[str, str], ...] = ()


# -- Words: what a value makes of the robot -------------------------------------------------------------------

EXAMPLE_RADPS = 0.5  #: The turn at which losses that grow with it are stated.
FAST_RADPS, FAST_MPS = 1.0, 2.0  #: The same of what fast turns do.
#: Yaw rate from which the wheels mostly slide sideways, and below which they mostly deflect; of a Warthog on asphalt
#: and gravel.
SLIDING_RADPS = 1.0
#: Speed over which a resistance takes its full size: it opposes motion and does not push a robot at rest.
RESTING_MPS = 0.05


def rounded(value: float, half: float) -> str:
    """Return a number with the digits that half its interval leaves it, three where that is not known.

    Examples
    --------
    >>> rounded(1.4271, 0.03), rounded(0.0961, 0.025), rounded(0.165, float("nan"))
    ('1.43', '0.10', '0.165')
    """
    if not (math.isfinite(half) and half > 0.0):
        return f"{value:.3g}"
    return f"{value:.{min(max(-math.floor(math.log10(half)), 0), 5)}f}"


def _sided(scale: float, text: str, above: str, below: str, terms: Sequence[Term]) -> str:
    """Return words on the size of a value, and whether it is above or below zero."""
    (term,) = terms
    number = rounded(scale * abs(term.total), scale * term.half)
    wheels = "sprockets" if term.robot.drive == TRACKED else "wheels"
    return text.format(number=number, side=above if term.total > 0 else below, wheels=wheels)


def _late(above: str, *more: Any) -> str:
    """Return words on who is late, by a positive and, where another is named, by a negative value."""
    *below, (term,) = more
    who = above if term.extended > 0 or not below else below[0]
    return f"{who} {rounded(abs(term.extended), term.half)} s late"


def _track(terms: Sequence[Term]) -> str:
    (term,) = terms
    return f"an effective track of {rounded(term.extended, term.described * term.half)} m {term.note}"


def _wheel_distance(terms: Sequence[Term]) -> str:
    (term,) = terms
    distance_m = term.robot.wheel_distance_m
    number = rounded(distance_m * (1.0 + term.total), distance_m * term.half)
    return f"wheels {number} m from the middle (described: {distance_m:.3g} m)"


def _point(term: Term, scale: float, sides: tuple[str, str]) -> str:
    """Return where a point lies along an axis; only the sum of what is described and found is known."""
    unit = "m" if scale == 1.0 else "mm"
    number = rounded(scale * abs(term.extended), scale * term.half)
    return f"{number} {unit} {sides[0 if term.extended >= 0.0 else 1]}"


def _lever_arm(terms: Sequence[Term]) -> str:
    """Return where the measured point is; a distance to a side that is not significant is left out."""
    along, across = terms
    points = [_point(along, 1.0, ("ahead", "behind"))]
    if not abs(across.found) <= across.half:
        points.append(_point(across, 1.0, ("left", "right")))
    joint = " " if points[-1].endswith("behind") else " of "
    return f"the measured point {' and '.join(points)}{joint}the centre {along.note}"


def _centre_of_mass(terms: Sequence[Term]) -> str:
    points = [
        _point(t, 1e3, sides)
        for t, sides in zip(terms, (("ahead", "behind"), ("left", "right")), strict=True)
    ]
    described = ", ".join(f"{1e3 * term.described:.3g}" for term in terms)
    return f"the centre of mass {' and '.join(points)} of the middle (described: {described} mm)"


def _turn_drag(terms: Sequence[Term]) -> str:
    lost = terms[0].total * EXAMPLE_RADPS**2
    percent = 100.0 * (lost / (1.0 + lost) if lost > 0 else lost)
    change = "loses" if percent > 0 else "gains"
    return f"a robot that {change} {abs(percent):.2g} % of its speed in a turn of {EXAMPLE_RADPS:g} rad/s"


def _fast_turns(terms: Sequence[Term]) -> str:
    by_speed, by_turn = (term.total for term in terms)
    x = by_speed * (FAST_MPS * FAST_RADPS) ** 2 / (1.0 + (FAST_RADPS / SLIDING_RADPS) ** 2)
    x += by_turn * FAST_RADPS / (SLIDING_RADPS + FAST_RADPS)
    gained = x / (1.0 + abs(x))
    percent = 100.0 * gained / (1.0 + gained)
    change = "narrower" if percent > 0 else "wider"
    return f"a track that acts {abs(percent):.2g} % {change} at {FAST_MPS:g} m/s and {FAST_RADPS:g} rad/s"


def _turning_moment(terms: Sequence[Term]) -> str:
    (term,) = terms
    lever_nm = 0.5 * term.robot.track_m * term.robot.mass_kg * GRAVITY_MPS2
    number = rounded(lever_nm * abs(term.total), lever_nm * term.half)
    return f"a moment against turning in place {number} Nm {'larger' if term.total > 0 else 'smaller'}"


def _understeer(terms: Sequence[Term]) -> str:
    (term,) = terms
    own, base_m = term.robot.understeer_s2pm, term.robot.wheelbase_m
    before, after = (base_m / (base_m + each * FAST_MPS**2) for each in (own, own + term.total))
    number = f"{rounded(own + term.total, term.half)} s²/m (described: {own:.2g} s²/m)"
    change = f"{100.0 * abs(after / before - 1.0):.2g} % {'less' if term.total > 0 else 'more'}"
    return f"an understeer of {number}, which turns it {change} at {FAST_MPS:g} m/s"


# -- Inverses on samples that take more than one number a sample ----------------------------------------------


def _undo_one_sided_radius(block: Block, e: float) -> None:
    for i, channel in enumerate(block.channels):
        quantity, _, rest = channel.partition("_")
        wheel = rest.rpartition("_")[0]
        if quantity in ("motor", "speed", "wheel") and wheel in block.robot.wheels:
            block.values[:, i] *= 1.0 + (0.5 if wheel in ("3", "right") else -0.5) * e


def _undo_yaw_delay(block: Block, delay_s: float) -> None:
    """Delay the difference of the sides' wheel speeds, and leave their mean."""
    names = ("speed_left_mps", "speed_right_mps")
    if not set(names) <= set(block.channels) or not block.time_s.size:
        return
    left, right = (block.channels.index(name) for name in names)
    half = 0.5 * (block.values[:, right] - block.values[:, left])
    before_s, before = block.memory.get("yaw_delay", (np.empty(0), np.empty(0)))
    known, earlier = np.isfinite(half) & np.isfinite(block.time_s), before_s < np.min(block.time_s)
    time_s = np.concatenate([before_s[earlier], block.time_s[known]])
    if not time_s.size:
        return
    seen = np.concatenate([before[earlier], half[known]])
    change = np.interp(block.time_s - delay_s, time_s, seen) - half
    block.values[:, left] -= change
    block.values[:, right] += change
    first = max(int(np.searchsorted(time_s, time_s[-1] - delay_s)) - 1, 0)
    block.memory["yaw_delay"] = time_s[first:], seen[first:]


def _steer(block: Block, name: str, follow: Callable[..., float]) -> None:
    """Turn each steering angle to what follows it, by it, the one before, what followed that, its zero and the time."""
    for channel, zero_rad in zip(block.robot.steer_channels, block.robot.steering_zeros_rad, strict=False):
        if channel not in block.channels:
            continue
        last_rad, follower, last_s = block.memory.get(f"{name} {channel}", (math.nan,) * 3)
        column = block.channels.index(channel)
        angles = unwrapped(np.concatenate([[last_rad], block.values[:, column]]))[1:]
        known = np.isfinite(angles) & np.isfinite(block.time_s)
        for k in np.flatnonzero(known).tolist():
            angle_rad, at_s = float(angles[k]), float(block.time_s[k])
            if math.isnan(follower):
                last_rad, follower, last_s = angle_rad, angle_rad, at_s
            follower = follow(angle_rad, last_rad, follower, zero_rad, max(at_s - last_s, 0.0))
            last_rad, last_s = angle_rad, at_s
            block.values[k, column] = follower
        block.memory[f"{name} {channel}"] = last_rad, follower, last_s
        block.values[known, column] = wrapped(block.values[known, column])


def _undo_steering_gain(block: Block, e: float) -> None:
    _steer(block, "gain", lambda angle, before, last, zero, step_s: zero + (1.0 + e) * wrapped(angle - zero))


def _undo_steering_dead_zone(block: Block, e: float) -> None:
    def excess(angle: float, before: float, last: float, zero: float, step_s: float) -> float:
        from_zero = float(wrapped(angle - zero))
        return zero + math.copysign(max(abs(from_zero) - e, 0.0), from_zero)

    _steer(block, "dead zone", excess)


def _undo_steering_lag(block: Block, tau_s: float) -> None:
    """Pass angles, straight from sample to sample, through the low-pass."""

    def low_pass(angle: float, before: float, last: float, zero: float, step_s: float) -> float:
        lead = tau_s * (angle - before) / step_s if step_s > 0.0 else 0.0
        return angle - lead + math.exp(-step_s / tau_s) * (last - before + lead)

    _steer(block, "lag", low_pass)


def _undo_steering_backlash(block: Block, half_rad: float) -> None:
    def played(angle: float, before: float, last: float, zero: float, step_s: float) -> float:
        return min(max(last, angle - half_rad), angle + half_rad)

    _steer(block, "backlash", played)


def _wheel_columns(block: Block) -> Iterator[tuple[int, float]]:
    """Yield the columns of wheel speeds and rates, and what a rate is times for a speed in m/s."""
    for i, channel in enumerate(block.channels):
        quantity, _, rest = channel.partition("_")
        if quantity in ("motor", "speed", "wheel") and rest.rpartition("_")[0] in block.robot.logged_wheels:
            radius_m = 1.0 if quantity == "speed" else block.robot.wheel_radius_m
            yield i, radius_m / block.robot.reduction_ratio if quantity == "motor" else radius_m


def _undo_wheel_dead_zone(block: Block, dead_mps: float) -> None:
    for i, factor in _wheel_columns(block):
        speed = block.values[:, i]
        speed += dead_mps / factor * (speed * factor) / np.hypot(speed * factor, RESTING_MPS)


def _undo_drive_backlash(block: Block, half_rad: float) -> None:
    """Pass the distance of each wheel through the play; its speed is that part of the motor's that it moves by.

    That is the mean of the steps before and after a sample, the latter as it goes on.
    """
    for i, factor in _wheel_columns(block):
        half = half_rad * block.robot.wheel_radius_m / factor
        name = f"play {block.stream} {block.channels[i]}"
        last, last_s, ahead = block.memory.get(name, (math.nan, math.nan, 0.0))  # ahead: of the wheel
        known = np.isfinite(block.values[:, i]) & np.isfinite(block.time_s)
        for k in np.flatnonzero(known).tolist():
            speed, time_s = float(block.values[k, i]), float(block.time_s[k])
            dt = max(time_s - last_s, 0.0) if math.isfinite(last) else 0.0
            step = coming = 0.0
            if dt:
                step, coming = 0.5 * dt * (last + speed), 0.5 * dt * (3.0 * speed - last)
            now = min(max(ahead - step, -half), half)
            after = min(max(now - coming, -half), half)
            if coming != 0.0:
                carried = 1.0 + (after - now) / coming
                block.values[k, i] *= 0.5 * (carried + (1.0 + (now - ahead) / step if step else carried))
            last, last_s, ahead = speed, time_s, now
        block.memory[name] = last, last_s, ahead


#: Part of the square below which a gyro's nonlinearity does not bend it: there it is at its end.
GYRO_END = 0.1


def bent_rate(rate_radps: Any, nonlinearity_s2: float) -> Any:
    """Return what a nonlinear gyro reads of yaw rates, ``w / sqrt(1 + 2 k w^2)``; ``-k`` inverts it.

    Examples
    --------
    >>> round(float(bent_rate(bent_rate(0.8, 0.1), -0.1)), 9), round(float(bent_rate(100.0, 0.5)), 3)
    (0.8, 1.0)
    """
    return rate_radps / np.sqrt(np.maximum(1.0 + 2.0 * nonlinearity_s2 * rate_radps**2, GYRO_END))


def _undo_gyro(block: Block, _: float) -> None:
    """Take bias, scale and nonlinearity off the gyro, and off the fused yaw, assumed to be its integral."""
    effects = block.robot.effects
    bias, scale = effects.get("gyro_bias_radps", 0.0), 1.0 + effects.get("gyro_scale_ratio", 0.0)
    bend = effects.get("gyro_nonlinearity_s2", 0.0)
    if "gyro_z_radps" in block.channels:
        gyro = block.values[:, block.channels.index("gyro_z_radps")]
        gyro -= block.applied.effects.get("gyro_bias_radps", 0.0)  # without a home
        if scale != 1.0:
            described = block.applied.completed.sensors.gyro_bias_z_radps
            gyro -= described
            gyro /= scale
            gyro += described
        if bend:
            described = block.applied.completed.sensors.gyro_bias_z_radps
            gyro[:] = bent_rate(gyro - described, -bend) + described
    if "yaw_rad" in block.channels:
        column = block.channels.index("yaw_rad")
        first_rad, last_rad = block.memory.get("yaw_rad", (math.nan, math.nan))
        yaw = unwrapped(np.concatenate([[last_rad], block.values[:, column]]))[1:]
        known = np.isfinite(yaw)
        if known.any():
            first_rad = float(yaw[known][0]) if math.isnan(first_rad) else first_rad
            block.memory["yaw_rad"] = first_rad, float(yaw[known][-1])
        turned_rad = yaw[known] - first_rad - bias * (block.time_s[known] - block.start_s)
        turned_rad /= scale
        if bend and known.any():  # step by step, as it was summed up
            was_rad, was_s, true_rad = block.memory.get("turned", (0.0, block.time_s[known][0], 0.0))
            steps_s = np.diff(block.time_s[known], prepend=was_s)
            steps_rad = np.diff(turned_rad, prepend=was_rad)
            rates = np.divide(steps_rad, steps_s, out=np.zeros_like(steps_rad), where=steps_s > 0.0)
            true = true_rad + np.cumsum(bent_rate(rates, -bend) * steps_s)
            block.memory["turned"] = turned_rad[-1], block.time_s[known][-1], true[-1]
            turned_rad = true
        block.values[known, column] = wrapped(first_rad + turned_rad)


CAMERA_VECTORS = (("position", "m"), ("quaternion", "ratio"), ("velocity", "mps"), ("rate", "radps"))


def turn_camera(values: Array, channels: tuple[str, ...], angle_rad: float) -> None:
    """Turn what a camera tells to what it would tell were it mounted turned to the left by ``-angle_rad``.

    A speed along the robot's x axis then shows as one to the left too, by the sine of the angle.  The fixed
    frame is that of the power-on and turns with the mounting, so that position, velocity, rates and the
    quaternion's vector part all turn alike about the body's z axis; its scalar part stays.

    Parameters
    ----------
    values : (n, c) changed in place
    channels : of the columns: vectors of :data:`terrain.kinematics.camera.CHANNELS`, in the camera's axes, or a
        plane's ``speed_x_mps`` and ``speed_y_mps`` in the body's; others stay
    angle_rad : small or not

    Examples
    --------
    >>> seen = np.array([[1.0, 0.0]])
    >>> turn_camera(seen, ("speed_x_mps", "speed_y_mps"), 0.1)
    >>> seen.round(3)
    array([[0.995, 0.1  ]])
    """
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    # ahead is -z of the camera and left is -x: in that plane two signs make none
    planes = [(f"{name}_z_{unit}", f"{name}_x_{unit}") for name, unit in CAMERA_VECTORS]
    for ahead, left in [("speed_x_mps", "speed_y_mps"), *planes]:
        if ahead in channels and left in channels:
            i, j = channels.index(ahead), channels.index(left)
            x, y = values[:, i].copy(), values[:, j].copy()
            values[:, i] = cos * x - sin * y
            values[:, j] = sin * x + cos * y


def _undo_camera_yaw(block: Block, angle_rad: float) -> None:
    if block.stream != "pose":
        turn_camera(block.values, block.channels, -angle_rad)
    elif "yaw_rad" in block.channels:
        block.values[:, block.channels.index("yaw_rad")] += angle_rad


# -- The library ----------------------------------------------------------------------------------------------

WORDS: dict[str, Callable[..., str]] = {
    function.__name__.removeprefix("_"): function
    for function in (
        *(_sided, _late, _track, _wheel_distance, _lever_arm),
        *(_centre_of_mass, _turn_drag, _fast_turns, _turning_moment, _understeer),
    )
}
UNDO: dict[str, Callable[[Block, float], None]] = {
    function.__name__.removeprefix("_undo_"): function
    for function in (
        *(_undo_one_sided_radius, _undo_yaw_delay, _undo_gyro),
        *(_undo_steering_gain, _undo_steering_lag, _undo_steering_backlash, _undo_steering_dead_zone),
        *(_undo_wheel_dead_zone, _undo_drive_backlash, _undo_camera_yaw),
    )
}
ACT: dict[str, Callable[[Block, float], None]] = {
    "camera_yaw": lambda block, angle_rad: turn_camera(block.values, block.channels, angle_rad)
}


def _read_library(path: Path) -> tuple[Effect, ...]:
    """Return the effects that a file lists; whatever names no field raises TypeError."""
    # our own data, ten times as fast as the bounded reader of what strangers write
    entries = yaml.load(path.read_text("utf-8"), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    library = []
    for name, entry in entries.items():
        parameters = []
        for parameter, given in entry["parameters"].items():
            homes = []
            for place, change in given.get("homes", {}).items():
                section, _, field = place.rpartition(".")
                about = change if isinstance(change, dict) else {"combine": change}
                homes.append(Home(section, field, **about | {"combine": Combine(about["combine"])}))
            inverse = given.get("inverse")
            if inverse is not None:
                functions = {"undo": UNDO.get(inverse.get("undo")), "act": ACT.get(inverse.get("act"))}
                combine = Combine(inverse.get("combine", Combine.ADDED))
                inverse = Inverse(**_fixed(inverse) | functions | {"combine": combine})
            about = _fixed(given) | {"homes": tuple(homes), "inverse": inverse}
            parameters.append(Parameter(parameter, **about))
        about = _fixed(entry) | {"parameters": tuple(parameters)}
        if "stage" in entry:
            about["stage"] = Stage[entry["stage"].upper()]
        if "words" in entry:
            words, *more = entry["words"]
            about["words"] = partial(WORDS[words], *more)
        library.append(Effect(name, **about))
    return tuple(library)


def _fixed(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields with tuples in place of lists, and of mappings."""
    fixed = dict(entry)
    for key, value in entry.items():
        if isinstance(value, list | dict):
            fixed[key] = tuple(value.items() if isinstance(value, dict) else value)
    return fixed


#: Every known effect, in the order in which results list them.
LIBRARY = _read_library(data_folder("effects") / "library.yaml")
#: Errors of the measured tilt.  They belong to no effect, and are only ever estimated run by run.
TILT_OFFSETS: tuple[Parameter, ...] = (
    Parameter("pitch_offset_rad", -math.inf, math.inf, 0.005, scatter_rank=3),
    Parameter("roll_offset_rad", -math.inf, math.inf, 0.005, scatter_rank=4),
)
#: Parameters of the library by name.
PARAMETER: dict[str, Parameter] = {p.name: p for effect in LIBRARY for p in effect.parameters}
#: Physical limits of each parameter of the library.
BOUNDS: dict[str, tuple[float, float]] = {name: (p.low, p.high) for name, p in PARAMETER.items()}
#: Change of a parameter over which its sensitivity is taken.
STEPS: dict[str, float] = {p.name: p.step for p in (*PARAMETER.values(), *TILT_OFFSETS)}
#: Parameters that scatter from run to run, in the order in which they are drawn.
NUISANCES: tuple[str, ...] = tuple(
    p.name
    for p in sorted((*PARAMETER.values(), *TILT_OFFSETS), key=attrgetter("scatter_rank"))
    if p.scatter_rank
)
#: Parameters that change what sensors measure, and not the motion of the body.
SENSED_ONLY: tuple[str, ...] = tuple(
    p.name for effect in LIBRARY if effect.sensed_only for p in effect.parameters
)
#: By parameter, the channels in which it shows.
SHOWS: dict[str, tuple[str, ...]] = {p.name: effect.channels for effect in LIBRARY for p in effect.parameters}
#: Parameters whose sensitivity is taken towards the positive side only.
ONE_SIDED: tuple[str, ...] = tuple(name for name, p in PARAMETER.items() if p.one_sided)
#: Former names of parameters, and the present ones.
DEPRECATED: dict[str, str] = {old: p.name for p in PARAMETER.values() for old in p.deprecated}


def effect_named(name: str, drive: str | None = None) -> Effect:
    """Return the effect of a name, an alias or a former name.

    Raises
    ------
    ConfigError
        for an unknown name, and if it does not apply to robots of a drive.

    Examples
    --------
    >>> effect_named("encoder_scale").name, effect_named("lever_arm").parameters[1].name
    ('wheel_radius', 'lever_y_m')
    """
    for effect in LIBRARY:
        if name in (effect.name, *effect.aliases, *effect.deprecated):
            if drive is not None and drive not in effect.drives:
                raise ConfigError(f"effect {effect.name} does not apply to a robot with the drive {drive!r}")
            return effect
    raise ConfigError(f"effect {name!r} is unknown: use one of {', '.join(e.name for e in LIBRARY)}")


def library_of(drive: str, names: Collection[str] | None = None) -> tuple[Effect, ...]:
    """Return the effects that apply to robots of a drive, or those named, in the order of the library.

    Raises
    ------
    ConfigError
        if a name is unknown, or its effect does not apply.
    """
    if names is not None:
        chosen = [effect_named(name, drive) for name in names]
        return tuple(effect for effect in LIBRARY if effect in chosen)
    return tuple(effect for effect in LIBRARY if drive in effect.drives)


def showing(drive: str, known: Collection[str] = ()) -> tuple[Effect, ...]:
    """Return those effects of a drive that runs may show, with the parameters that are known already.

    Examples
    --------
    >>> {e.name for e in library_of("omni")} - {e.name for e in showing("omni")}
    {'payload'}
    >>> showing("omni", ["roller_friction_ratio"]) == library_of("omni")
    True
    """
    shown = []
    for effect in library_of(drive):
        beside = [effect_named(name).parameters for of, name in effect.beside if of == drive]
        if all(any(p.name in known for p in parameters) for parameters in beside):
            shown.append(effect)
    return tuple(shown)


def parameters_of(drive: str) -> dict[str, Parameter]:
    """Return the parameters, by name, of all effects that apply to robots of a drive.

    Examples
    --------
    >>> parameters_of("skid_steer")["effective_track_ratio"].high
    4.0
    """
    return {parameter.name: parameter for effect in library_of(drive) for parameter in effect.parameters}


def nuisances_of(drive: str) -> tuple[str, ...]:
    """Return the parameters that scatter from run to run on robots of a drive, in the order of drawing.

    Examples
    --------
    >>> sorted(set(NUISANCES) - set(nuisances_of("swerve")))
    ['effective_track_ratio', 'turning_resistance_ratio']
    """
    own = {*parameters_of(drive), *(p.name for p in TILT_OFFSETS)}
    return tuple(name for name in NUISANCES if name in own)


def in_plant(*stages: Stage) -> tuple[str, ...]:
    """Return the parameters that act at some stages of the dynamic simulation.

    Examples
    --------
    >>> in_plant(Stage.BODY)
    ('wheel_radius_ratio', 'one_sided_radius_ratio', 'payload_ratio')
    """
    return tuple(p.name for effect in LIBRARY if effect.stage in stages for p in effect.parameters)


def on_samples(
    stream: str, channels: tuple[str, ...], effects: Mapping[str, float]
) -> Callable[[Array, Array], tuple[Array, Array]]:
    """Return what makes of times (k,) and values (k, c) of a stream those that a simulated sensor stamps and reports.

    A gyro's scale, which comes before its bias, is no part of it: its sensor has that.

    Examples
    --------
    >>> change = on_samples("wheels", ("motor_1_radps",), {"wheel_scale_1_ratio": 1.0})
    >>> change(np.zeros(1), np.array([[3.0]]))[1]
    array([[1.5]])
    """
    acting = []
    for name in in_plant(Stage.SENSORS):
        e, inverse = effects.get(name, 0.0), PARAMETER[name].inverse
        if e and inverse and stream in inverse.streams:
            acting.append((e, inverse))
    acting.sort(key=lambda each: not each[1].is_factor)

    def change(time_s: Array, values: Array) -> tuple[Array, Array]:
        return changed_samples(Block(stream, channels, time_s, values, 0.0, None, None, {}), acting, True)

    return change


def changed_samples(
    block: Block, acting: Iterable[tuple[float, Inverse]], sensed: bool
) -> tuple[Array, Array]:
    """Return stamps and values, these in place, as effects in their order make sensors show them, or taken off."""
    stamps, done = block.time_s, set()
    for e, inverse in acting:
        change = inverse.combine.invert if sensed else inverse.combine.apply
        special = inverse.act if sensed else inverse.undo
        if inverse.columns == STAMPS:
            stamps = np.asarray(block.start_s + change(stamps - block.start_s, e))
        elif special is None:
            for i, channel in enumerate(block.channels):
                if inverse.columns and channel.startswith(inverse.columns):
                    size = inverse.size(e, block.time_s - block.start_s)
                    block.values[:, i] = change(block.values[:, i], size)
        elif special not in done:
            special(block, e)
            done.add(special)
    return stamps, block.values


def read_effects_of(texts: Iterable[str], drive: str) -> dict[str, float]:
    """Return the parameters that all ``NAME=VALUE`` set together; several values are separated by commas.

    Raises
    ------
    ConfigError
        for an unknown name, an effect that does not apply to the robot or is given twice, a value that is no
        number, too few or too many of them, or one out of bounds.

    Examples
    --------
    >>> read_effects_of(["wheel_radius=0.03", "lever_arm=0.1,-0.05"], "skid_steer")
    {'wheel_radius_ratio': 0.03, 'lever_x_m': 0.1, 'lever_y_m': -0.05}
    """
    acting: dict[str, float] = {}
    for text in texts:
        name, _, given = text.partition("=")
        effect = effect_named(name.strip(), drive)
        try:
            values = [float(part) for part in given.split(",")]
        except ValueError:
            values = []
        required = ",".join(p.name for p in effect.parameters)
        if len(values) != len(effect.parameters):
            raise ConfigError(f"--effect is {text!r}; {effect.name}=VALUE with {required} is required")
        for parameter, value in zip(effect.parameters, values, strict=True):
            if not parameter.low <= value <= parameter.high:
                raise ConfigError(
                    f"effect {effect.name}: {parameter.name} is {value:g}, "
                    f"{parameter.low:g} to {parameter.high:g} is accepted"
                )
            if parameter.name in acting:
                raise ConfigError(f"effect {name!r} is given twice")
            acting[parameter.name] = value
    return acting


#: Order of the numbers in the vector.
PARAMETERS: tuple[str, ...] = tuple(STEPS)
#: Place of each parameter in the vector.
INDEX: dict[str, int] = {name: i for i, name in enumerate(PARAMETERS)}
#: The vector as a record: ``vector.view(EFFECTS)[0]`` has the parameters by name.
EFFECTS = record(dict.fromkeys(PARAMETERS, float))


def vector_of(values: Mapping[str, float]) -> Array:
    """Return the numbers (len(PARAMETERS),) of a simulation, 0 where none is given.

    Raises
    ------
    ConfigError
        for an unknown parameter, or a value that is not finite.
    """
    vector = np.zeros(len(PARAMETERS))
    for name, value in values.items():
        if name not in INDEX or not math.isfinite(value):
            raise ConfigError(
                f"effects: {name} is {value!r}; a finite number of a known parameter is required"
            )
        vector[INDEX[name]] = value
    return vector


SCHEMA = 1  #: Version of the section that is read and written.
#: Keys of the section that name no parameter; the region is read by :mod:`terrain.robots`.
NOT_EFFECTS = ("schema", "covariance", "region")

#: A covariance is written with seven digits: correlations may miss symmetry and sign by as much.
ROUNDING = 1e-5


def checked_effects(place: str, values: Mapping[str, float], drive: str) -> dict[str, float]:
    """Return the values of effects by parameter, checked; ``place`` is what messages call them.

    Raises
    ------
    ConfigError
        for a parameter that is unknown or of an effect that does not apply to the drive, or a value that is
        no finite number within its bounds.
    """
    known = parameters_of(drive)
    for name, value in values.items():
        if name not in known:
            if name in PARAMETER:
                raise ConfigError(f"{place}: {name} does not apply to a robot with the drive {drive!r}")
            raise ConfigError(f"{place}: {name} is no parameter of an effect (known: {', '.join(known)})")
        low, high = known[name].low, known[name].high
        plain = value.item() if isinstance(value, np.number) else value
        if not (is_number(plain) and low <= value <= high):
            raise ConfigError(f"{place}: {name} is {value!r}, a number from {low:g} to {high:g} is required")
    return {name: float(value) for name, value in values.items()}


def read_effects(place: str, described: Any, drive: str) -> tuple[dict[str, float], Array]:
    """Return the values of a section by parameter, and their covariance (n, n) in the same order, NaN without one.

    ``place`` is file and section, as messages name them.

    Raises
    ------
    ConfigError
        if the schema is newer than this version, a parameter is not accepted, or the covariance is no
        covariance of the parameters that are given.

    Examples
    --------
    >>> entry = {"value": 0.1, "unit": "rad", "source": "by hand"}
    >>> read_effects("mine.yaml: effects", {"schema": 1, "camera_yaw_rad": entry}, "swerve")
    ({'camera_yaw_rad': 0.1}, array([[nan]]))
    """
    if not isinstance(described, dict) or "schema" not in described:
        raise ConfigError(f"{place} is {described!r}, a mapping with schema and parameters is required")
    schema = described["schema"]
    if isinstance(schema, bool) or not isinstance(schema, int) or schema < 1:
        raise ConfigError(f"{place}: schema is {schema!r}, {SCHEMA} is required")
    if schema > SCHEMA:
        raise ConfigError(
            f"{place}: schema {schema} is newer than this version of terrain, which reads {SCHEMA}"
        )
    entries = _renamed(place, {k: v for k, v in described.items() if k not in NOT_EFFECTS})
    known = parameters_of(drive)
    checked_effects(place, dict.fromkeys((name for name in entries if name not in known), 0.0), drive)
    values = numbers(place, entries, dict.fromkeys(entries, -math.inf))
    values = checked_effects(place, values, drive)
    if "covariance" not in described:
        return values, np.full((len(values), len(values)), np.nan)
    return values, _covariance(f"{place}: covariance", described["covariance"], list(values))


def _renamed(place: str, entries: dict[Any, Any]) -> dict[str, Any]:
    """Return entries by the present names of their parameters."""
    renamed: dict[str, Any] = {}
    for given, entry in entries.items():
        name = DEPRECATED.get(str(given), str(given))
        if name in renamed:
            raise ConfigError(f"{place}: {name} is given twice, once by its former name")
        renamed[name] = entry
    return renamed


def _covariance(place: str, described: Any, names: list[str]) -> Array:
    if isinstance(described, dict):
        described = _renamed(place, described)
    check_keys(place, described, names)
    for name in names:
        if isinstance(described[name], dict):
            described[name] = _renamed(f"{place}: {name}", described[name])
        check_keys(f"{place}: {name}", described[name], names)
    rows = [[described[row][column] for column in names] for row in names]
    for row, entries in zip(names, rows, strict=True):
        for column, entry in zip(names, entries, strict=True):
            if not is_number(entry):
                raise ConfigError(f"{place}: {row}, {column} is {entry!r}, a finite number is required")
    return checked_covariance(place, np.array(rows, dtype=float).reshape(len(names), len(names)))


def checked_covariance(place: str, covariance: Array) -> Array:
    """Return a covariance (n, n), read-only and symmetric to the last bit.

    Raises
    ------
    ConfigError
        if it is no square of finite numbers, is not symmetric, or gives some combination a negative variance.

    Examples
    --------
    >>> checked_covariance("covariance", np.array([[1.0, 2.0], [2.0, 1.0]]))
    Traceback (most recent call last):
    terrain.errors.ConfigError: covariance is not positive semi-definite: its correlations have eigenvalue -1
    """
    is_square = covariance.ndim == 2 and len(covariance) == covariance.shape[1]
    if not is_square or not np.isfinite(covariance).all():
        raise ConfigError(f"{place} has the shape {covariance.shape}; a square of finite numbers is required")
    variance = covariance.diagonal()
    if (variance < 0).any():
        raise ConfigError(f"{place} is not positive semi-definite: it has the variance {variance.min():g}")
    std = np.sqrt(variance)
    scale = np.where(std > 0, std, 1.0)
    correlation = covariance / scale[:, None] / scale
    skew = float(np.abs(correlation - correlation.T).max(initial=0.0))
    if skew > ROUNDING:
        raise ConfigError(f"{place} is not symmetric: two of its correlations differ by {skew:.3g}")
    least = float(np.linalg.eigvalsh((correlation + correlation.T) / 2).min(initial=0.0))
    if least < -ROUNDING:
        raise ConfigError(
            f"{place} is not positive semi-definite: its correlations have eigenvalue {least:.3g}"
        )
    return read_only((covariance + covariance.T) / 2)
