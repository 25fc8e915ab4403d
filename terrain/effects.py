"""Effects: named groups of parameters of the simulation that are 0 where the effect is absent.

An entry holds all about an effect: bounds, robots, channels, the stage where it acts, where a description has it,
how it is taken off samples, and its words.

Signals of the formulas are those of :mod:`terrain.simulation.plants.planar`: ``u`` the speed that the wheels
would roll without slip, ``v`` the speed over ground, ``d`` a steering angle, ``w`` the yaw rate, ``F`` the
traction, ``W = m g`` the nominal weight, ``f = F / W``, ``th`` the grade (uphill positive), ``ph`` the roll
(left side up positive), ``B`` the track, ``dv`` right minus left wheel speed and
``q = |dv| / (|dv| + 2 |u|)`` how tight a turn is.

To add an effect, write its entry into the library, with formula, source and how it is taken off samples above it,
and its formula into the kernels of :mod:`terrain.simulation.plants.planar`.  Everything else reads the entry.

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
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from enum import Enum
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from terrain.angles import unwrapped, wrapped
from terrain.errors import ConfigError
from terrain.files.documents import check_keys, number
from terrain.kernels import record
from terrain.records import Array, read_only

#: Channels that are compared: gyro, speed over ground of the camera's point, accelerometer, sum of the motor
#: currents, right minus left current, and the rate of a heading that no gyro measured (lidar, two antennas).
CHANNELS: tuple[str, ...] = (
    *("yaw_rate_radps", "speed_x_mps", "speed_y_mps", "accel_x_mps2"),
    *("current_a", "turning_current_a", "heading_rate_radps"),
)

GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT, TURNING_CURRENT, HEADING = CHANNELS

MOTION: tuple[str, ...] = (GYRO, SPEED_X, SPEED_Y)  #: Channels of the planar motion.
SKID, TRACKED, SWERVE, OMNI, BICYCLE = "skid_steer", "tracked", "swerve", "omni", "bicycle"
SKIDDING = (SKID, TRACKED)  #: Drives that turn by a difference of their sides.
BOTH = (*SKIDDING, SWERVE)  #: Drives of wheels that do not roll across, but for cars.
WITH_IMU = (*BOTH, BICYCLE)  #: Drives whose logs have an IMU.
EVERY = (*WITH_IMU, OMNI)


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
    #: of what takes more than one number a sample; two parameters may share one
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
    sensed_only: bool = False  #: it changes what sensors measure, and not the motion of the body
    stage: Stage | None = None  #: where it acts in the dynamic simulation, of the robots that that simulates
    aliases: tuple[str, ...] = ()  #: other names of the same effect, which no log distinguishes from it
    twins: tuple[tuple[str, str], ...] = ()
    """Effects that look the same, and the channel that distinguishes them."""
    deprecated: tuple[str, ...] = ()  #: former names, accepted on the command line
    words: Callable[[Sequence[Term]], str] | None = None
    """What its values make of the robot, as the object of "with"; by default the number of its home, or the values."""
    modifies: str = ""  #: name of the effect without which it does nothing
    beside: tuple[tuple[str, str], ...] = ()
    """Drive, and name of the effect that has to be known before runs of it can show this one."""


def effect(
    name: str,
    parameter: Parameter,
    *entry: Any,
    homes: tuple[Home, ...] = (),
    inverse: Inverse | None = None,
    **others: Any,
) -> Effect:
    """Return an effect of one parameter, given by its unit alone: its name is that of the effect, and the unit.

    ``entry`` and ``others`` are the fields of :class:`Effect` from the drives on.
    """
    named = parameter._replace(name=f"{name}_{parameter.name}", homes=homes, inverse=inverse)
    return Effect(name, (named,), *entry, **others)


# -- Words: what a value makes of the robot -------------------------------------------------------------------

#: The turn and the speed at which losses that grow with them are stated.
EXAMPLE_RADPS, EXAMPLE_MPS = 0.5, 1.0
FAST_RADPS, FAST_MPS = 1.0, 2.0  #: The same of what fast turns do.
#: Yaw rate from which the wheels mostly slide sideways, and below which they mostly deflect; of a Warthog on asphalt
#: and gravel.
SLIDING_RADPS = 1.0


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


def _sided(scale: float, text: str, above: str, below: str) -> Callable[[Sequence[Term]], str]:
    """Return words on the size of a value, and whether it is above or below zero."""

    def words(terms: Sequence[Term]) -> str:
        (term,) = terms
        side, wheels = above if term.total > 0 else below, "wheels"
        if term.robot.drive == TRACKED:
            wheels = "sprockets"
        number = rounded(scale * abs(term.total), scale * term.half)
        return text.format(number=number, side=side, wheels=wheels)

    return words


def _late(above: str, below: str = "") -> Callable[[Sequence[Term]], str]:
    """Return words on who is late, by a positive and by a negative value."""

    def words(terms: Sequence[Term]) -> str:
        (term,) = terms
        who = above if term.extended > 0 else below or above
        return f"{who} {rounded(abs(term.extended), term.half)} s late"

    return words


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
    x = terms[0].total * (FAST_MPS * FAST_RADPS) ** 2 / (1.0 + (FAST_RADPS / SLIDING_RADPS) ** 2)
    gained = x / (1.0 + abs(x))
    percent = 100.0 * gained / (1.0 + gained)
    return f"a track that acts {percent:.2g} % narrower at {FAST_MPS:g} m/s and {FAST_RADPS:g} rad/s"


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


def _undo_steering_backlash(block: Block, half_rad: float) -> None:
    for channel in set(block.robot.steer_channels) & set(block.channels):
        last_rad, follower = block.memory.get(channel, (math.nan, math.nan))
        column = block.channels.index(channel)
        angles = unwrapped(np.concatenate([[last_rad], block.values[:, column]]))[1:]
        known = np.isfinite(angles)
        for k in np.flatnonzero(known).tolist():
            last_rad = float(angles[k])
            follower = (
                last_rad
                if math.isnan(follower)
                else min(max(follower, last_rad - half_rad), last_rad + half_rad)
            )
            block.values[k, column] = follower
        block.memory[channel] = last_rad, follower
        block.values[known, column] = wrapped(block.values[known, column])


def _undo_gyro(block: Block, _: float) -> None:
    """Take bias and scale off the gyro, and off the fused yaw, which is assumed to be the integral of both."""
    bias, scale = (
        block.robot.effects.get("gyro_bias_radps", 0.0),
        1.0 + block.robot.effects.get("gyro_scale_ratio", 0.0),
    )
    if "gyro_z_radps" in block.channels:
        gyro = block.values[:, block.channels.index("gyro_z_radps")]
        gyro -= block.applied.effects.get("gyro_bias_radps", 0.0)  # without a home
        if scale != 1.0:
            described = block.applied.completed.sensors.gyro_bias_z_radps
            gyro -= described
            gyro /= scale
            gyro += described
    if "yaw_rad" in block.channels:
        column = block.channels.index("yaw_rad")
        first_rad, last_rad = block.memory.get("yaw_rad", (math.nan, math.nan))
        yaw = unwrapped(np.concatenate([[last_rad], block.values[:, column]]))[1:]
        known = np.isfinite(yaw)
        if known.any():
            first_rad = float(yaw[known][0]) if math.isnan(first_rad) else first_rad
            block.memory["yaw_rad"] = first_rad, float(yaw[known][-1])
        turned_rad = yaw[known] - first_rad - bias * (block.time_s[known] - block.start_s)
        block.values[known, column] = wrapped(first_rad + turned_rad / scale)


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


def _act_camera_yaw(block: Block, angle_rad: float) -> None:
    turn_camera(block.values, block.channels, angle_rad)


def _undo_camera_yaw(block: Block, angle_rad: float) -> None:
    if block.stream != "pose":
        turn_camera(block.values, block.channels, -angle_rad)
    elif "yaw_rad" in block.channels:
        block.values[:, block.channels.index("yaw_rad")] += angle_rad


# -- The catalogue --------------------------------------------------------------------------------------------

_contact = partial(effect, stage=Stage.CONTACT)
_sensor = partial(effect, sensed_only=True, stage=Stage.SENSORS)
_described_sensor = partial(effect, sensed_only=True, stage=Stage.DESCRIPTION)


def _steering_offset(wheel: int) -> Effect:
    name = f"steering_offset_{wheel}"
    # d_N = measured angle + d0 (kinematics of a planar robot)
    # wheel 3 is beside the middle, and hardly turns the robot
    return effect(
        name,
        Parameter("rad", -0.3, 0.3, 0.005),
        (SWERVE,),
        (*MOTION, HEADING) if wheel < 3 else MOTION,
        "several speeds and standstill",
        homes=(Home("steering", f"zero_{wheel}_rad", Combine.SUBTRACTED),),
        stage=Stage.LINKAGE,
    )


def _wheel_scale(wheel: int) -> Effect:
    """Return the scale of one encoder.

    All three together span wheel_radius and one_sided_radius, so that of the five three logs
    determine three; one alone looks like neither.
    """
    name = f"wheel_scale_{wheel}"
    # wheel speed N = (1 + e) x measured (kinematics of a planar robot)
    # an encoder that loses counts, or a tyre of another wear: a fifth is more than either
    # Taken off: rate and speed of wheel N x (1 + e)
    return effect(
        name,
        Parameter("ratio", -0.2, 0.2, 0.01, as_percent=True, is_error=True),
        (SWERVE,),
        (*MOTION, HEADING),
        "straight drives in several directions",
        inverse=Inverse(("wheels",), (f"motor_{wheel}_", f"speed_{wheel}_"), Combine.TIMES),
        stage=Stage.SENSORS,
    )


#: Streams that are not stamped by the logger of the wheels.
OTHER_LOGGER = ("imu", "odometry", "gnss", "lidar")

#: Every known effect.  The order is no ranking, but results list effects in it.
LIBRARY: tuple[Effect, ...] = (
    # == Wheels and steering
    # wheel speed = (1 + e) r x wheel rate, torque = (1 + e) r F (kinematics of a planar robot)
    # Taken off: wheel speed in m/s x (1 + e), where a log has it
    effect(
        "wheel_radius",
        Parameter("ratio", -0.3, 0.3, 0.01, scatter_rank=5, as_percent=True, is_error=True),
        EVERY,
        (*MOTION, CURRENT, HEADING),
        "any speed; slopes and accelerations to part it from slip",
        homes=(Home("", "wheel_radius_m", Combine.TIMES),),
        inverse=Inverse(("wheels",), ("speed_",), Combine.TIMES),
        stage=Stage.BODY,
        aliases=("encoder_scale",),
    ),
    # wheel speeds of the right side x (1 + e/2), of the left x (1 - e/2) (kinematics of a planar robot)
    # pressure and wear of tyres differ by a few percent from side to side
    # Taken off: rates and speeds of the right side x (1 + e/2), left x (1 - e/2)
    effect(
        "one_sided_radius",
        Parameter("ratio", -0.1, 0.1, 0.008, scatter_rank=6, as_percent=True, is_error=True),
        BOTH,
        (*MOTION, HEADING),
        "fast and straight",
        inverse=Inverse(("wheels", "truth"), undo=_undo_one_sided_radius),
        stage=Stage.BODY,
        words=_sided(
            100.0, "{wheels} that are {number} % {side} on the right than on the left", "larger", "smaller"
        ),
    ),
    *(_wheel_scale(wheel) for wheel in (1, 2, 3)),
    *(_steering_offset(wheel) for wheel in (1, 2, 3)),
    # d follows the measured angle through a play of half width b (play operator; Krasnosel'skii and
    # Pokrovskii, Systems with Hysteresis, 1989)
    # Taken off: angles pass through a play of half width b
    effect(
        "steering_backlash",
        Parameter("rad", 0.0, 0.2, 0.003, one_sided=True, deprecated=("steering_play_rad",)),
        (SWERVE, BICYCLE),
        (*MOTION, HEADING),
        "reversals of the steering",
        inverse=Inverse(("steering",), undo=_undo_steering_backlash),
        stage=Stage.LINKAGE,
        deprecated=("steering_play",),
    ),
    # d(t) = measured angle at t - T (kinematics of a planar robot)
    # Taken off: stamp t + T
    effect(
        "steering_delay",
        Parameter("s", 0.0, 0.5, 0.01),
        (SWERVE, BICYCLE),
        (*MOTION, HEADING),
        "steps of the steering",
        inverse=Inverse(("steering",), STAMPS, Combine.ADDED),
        stage=Stage.LINKAGE,
    ),
    # w(t) = what the wheels ask for at t - T (pure delay)
    # Taken off: right minus left wheel speed of t - T
    effect(
        "yaw_delay",
        Parameter("s", 0.0, 0.5, 0.01),
        SKIDDING,
        (GYRO, SPEED_Y, HEADING),
        "steps of the yaw rate",
        inverse=Inverse(("wheels",), undo=_undo_yaw_delay),
        words=_late("the robot turning"),
    ),
    # == Sensors: they change what a log holds of a motion; most of them nothing else
    # gyro = w + b (IEEE Std 952)
    # 3 deg/s, the zero error of MEMS gyros as data sheets have it (Bosch BMI055: 1 deg/s)
    # Taken off: gyro - b where the description has no home; fused yaw - b t
    _described_sensor(
        "gyro_bias",
        Parameter("radps", -0.05, 0.05, 0.001, scatter_rank=1),
        WITH_IMU,
        (GYRO,),
        "standstill; several runs, since every power-on has a bias of its own",
        homes=(Home("sensors", "gyro_bias_z_radps", Combine.ADDED),),
        inverse=Inverse(("imu",), undo=_undo_gyro),
    ),
    # gyro = (1 + k) w (IEEE Std 952)
    # data sheets of MEMS gyros have 1 to 4 %; a part that is off by more than 15 % is broken
    # Taken off: (gyro - bias) / (1 + k) + bias; fused yaw / (1 + k)
    _sensor(
        "gyro_scale",
        Parameter("ratio", -0.15, 0.15, 0.01, as_percent=True, is_error=True),
        WITH_IMU,
        (GYRO,),
        "turns, and an absolute heading on a skid-steer robot",
        inverse=Inverse(("imu",), undo=_undo_gyro),
        twins=(("effective_track", HEADING),),
        words=_sided(100.0, "a gyro that reads {number} % too {side}", "much", "little"),
    ),
    # accelerometer = a_x + g sin th + b (IEEE Std 1293)
    # Taken off: accelerometer - b
    _described_sensor(
        "accel_bias",
        Parameter("mps2", -2.0, 2.0, 0.02, scatter_rank=2),
        WITH_IMU,
        (ACCEL,),
        "several runs, since every power-on has a bias of its own",
        homes=(Home("sensors", "accel_bias_x_mps2", Combine.ADDED, scaled_by="accel_scale_x_ratio"),),
        inverse=Inverse(("imu",), ("accel_x_",), Combine.SUBTRACTED, without_home=True),
        aliases=("accelerometer_mounting_pitch",),
    ),
    # gyro, accelerometer and tilt(t) = what they measure at t - T (pure delay; the samples of one IMU
    # arrive together)
    # as much of it and of camera_latency is a clock_offset: logs determine two of the three
    # Taken off: stamp t - T
    effect(
        "imu_latency",
        Parameter("s", 0.0, 0.5, 0.005),
        WITH_IMU,
        (GYRO, ACCEL),
        "steps of the yaw rate, and a camera that is not late",
        homes=(Home("sensors", "imu_latency_s", Combine.ADDED),),
        inverse=Inverse(("imu",), STAMPS, Combine.SUBTRACTED, without_home=True),
        stage=Stage.DESCRIPTION,
        words=_late("the IMU"),
    ),
    # camera(t) = what it sees at t - T (pure delay)
    # measured: 0.16 s (Husky) and 0.3 to 0.5 s (Warthog), poses of a lidar's scans, DRIVE
    _described_sensor(
        "camera_latency",
        Parameter("s", 0.0, 1.0, 0.005),
        EVERY,
        (SPEED_X, SPEED_Y, HEADING),
        "accelerations at two frequencies",
        homes=(Home("camera", "latency_s", Combine.ADDED),),
        words=_late("the camera or lidar"),
    ),
    # camera = R(-a) (v_x, v_y): mounted turned to the left by -a, v_y grows by a v (kinematics of a
    # planar robot)
    # Taken off: R(a) of what the camera measured; yaw of a pose + a
    _sensor(
        "camera_yaw",
        Parameter("rad", -0.3, 0.3, 0.005),
        EVERY,
        (SPEED_X, SPEED_Y),
        "straight, on more than one side slope",
        inverse=Inverse(("odometry", "lidar", "pose"), undo=_undo_camera_yaw, act=_act_camera_yaw),
        words=_sided(math.degrees(1.0), "the camera turned {number}° to the {side}", "right", "left"),
    ),
    # v_x - l_y w, v_y + l_x w at the camera (kinematics of a planar robot)
    Effect(
        "lever_arm",
        tuple(
            Parameter(
                f"{name}_m", -1.0, 1.0, 0.02, (Home("camera", f"{name}_m", Combine.ADDED),), is_error=True
            )
            for name in ("lever_x", "lever_y")
        ),
        EVERY,
        (SPEED_X, SPEED_Y),
        "turns to both sides",
        sensed_only=True,
        stage=Stage.DESCRIPTION,
        words=_lever_arm,
    ),
    # IMU and camera stamp t' = t + T; wheels, currents and steering t: for T < 0 these are the late ones
    # (two loggers without a common clock)
    # Taken off: stamp t' - T
    effect(
        "clock_offset",
        Parameter("s", -0.5, 0.5, 0.005),
        WITH_IMU,
        (*MOTION, HEADING),
        "switching manoeuvres",
        inverse=Inverse(OTHER_LOGGER, STAMPS, Combine.SUBTRACTED),
        stage=Stage.SENSORS,
        words=_late("the other sensors logged", "the wheels logged"),
    ),
    # IMU and camera stamp t' = (1 + r) t (two loggers without a common clock)
    # Taken off: stamp t' / (1 + r), from the first stamp of the wheels
    effect(
        "clock_rate",
        Parameter("ratio", -0.02, 0.02, 0.0005, as_percent=True, is_error=True),
        WITH_IMU,
        (*MOTION, HEADING),
        "switching manoeuvres from the start of a run to its end",
        inverse=Inverse(OTHER_LOGGER, STAMPS, Combine.OVER),
        stage=Stage.SENSORS,
    ),
    # T d(measured)/dt + measured = wheel rate (first-order low-pass)
    effect(
        "encoder_lag",
        Parameter("s", 0.0, 0.5, 0.005),
        WITH_IMU,
        (*MOTION, CURRENT, TURNING_CURRENT, HEADING),
        "accelerations",
        homes=(Home("sensors", "encoder_time_constant_s", Combine.ADDED),),
        stage=Stage.DESCRIPTION,
    ),
    # == Slip and resistance
    # w = dv / (B (1 + e)) (Mandow et al., Experimental kinematics for wheeled skid-steer mobile robots,
    # IROS 2007)
    effect(
        "effective_track",
        Parameter("ratio", -0.5, 4.0, 0.02, scatter_rank=9, as_percent=True, is_error=True),
        SKIDDING,
        (GYRO, SPEED_Y, HEADING),
        "turns in place and in arcs, and an absolute heading",
        homes=(Home("", "track_m", Combine.TIMES),),
        twins=(("gyro_scale", HEADING),),
        words=_track,
    ),
    # dv loses D = k q dv, shared as u_r = D a/(a+b), u_l = -D b/(a+b), a = |v_r|^(1-n), b = |v_l|^(1-n),
    # n = 0.5 (Endo et al., IROS 2007, as in Yamauchi et al., (27) written without its singular points;
    # the size of D is this project's)
    effect(
        "turning_slip",
        Parameter("ratio", -0.5, 0.9, 0.02),
        SKIDDING,
        (*MOTION, HEADING),
        "arcs of several radii and turns in place",
    ),
    # n = 0.5 + e in turning_slip (Endo et al., IROS 2007, as in Yamauchi et al., (27))
    # n from 0, in proportion to the speeds, to 1, alike; Endo et al. fitted one to each ground
    effect(
        "turning_slip_power",
        Parameter("ratio", -0.5, 0.5, 0.02),
        (TRACKED,),
        (SPEED_X, ACCEL, CURRENT),
        "arcs of several radii with much turning slip",
        modifies="turning_slip",
    ),
    # w grows by x/(1 + x), x = c (u w)^2 / (1 + (w / w0)^2), w0 = 1 rad/s, u and w without it (lateral
    # acceleration moves the centre of rotation ahead by s0, about c' u (turn_side_slip), and the moment
    # that resists turning falls with (2 s0 / L)^2: Wong, Theory of Ground Vehicles, skid-steering at high
    # speeds; that it builds up with w, and the bounded form, are this project's)
    # measured: 0.03 to 0.045 s^2/m^2 (Warthog on asphalt and gravel, up to 3.5 m/s and 2.8 rad/s); it
    # goes with 1/mu^2, and would be 2 at mu = 0.1
    effect(
        "track_narrowing",
        Parameter("s2pm2", 0.0, 2.0, 0.02),
        SKIDDING,
        (GYRO, SPEED_Y, HEADING),
        "fast arcs, and turns in place",
        words=_fast_turns,
    ),
    # u / (1 + c w^2) in place of u, about u (1 - c w^2), and that itself for c < 0; w as simulated, with
    # the effective track (second-order loss of speed in turns, as in the logs of Baril et al., DRIVE,
    # ICRA 2024; the bounded form is this project's)
    # measured: 0.02 to 0.1 s^2 (Warthog on asphalt and sand), 0.6 to 0.9 s^2 (Husky)
    effect(
        "turn_drag",
        Parameter("s2", -0.1, 3.0, 0.005),
        SKIDDING,
        (SPEED_X,),
        "arcs of several yaw rates",
        words=_turn_drag,
    ),
    # v = u - |u| c f (linear part of any thrust curve; Wong, Theory of Ground Vehicles)
    _contact(
        "force_slip",
        Parameter("ratio", -0.3, 3.0, 0.02, scatter_rank=8),
        EVERY,
        (SPEED_X, SPEED_Y),
        "slopes and accelerations",
    ),
    # f = f_max (1 - K/(s l) (1 - exp(-s l/K))), with K/l = c f_max / 2 so that c is its slip per force at
    # the start (Janosi and Hanamoto 1961, as integrated along the contact (Yamauchi et al., (17),
    # corrected))
    _contact(
        "shear_slip",
        Parameter("ratio", 0.0, 3.0, 0.02),
        WITH_IMU,
        (SPEED_X, SPEED_Y),
        "tractions over half of f_max, of both small and large size",
    ),
    # resistance grows by b |s| W (Lyasko, Slip sinkage effect in soil-vehicle mechanics, J.
    # Terramechanics 2010: linear in slip)
    _contact(
        "slip_resistance", Parameter("ratio", 0.0, 5.0, 0.05), BOTH, (CURRENT, SPEED_X), "a range of slip"
    ),
    # resistance grows by c W (Wong, Theory of Ground Vehicles)
    # without currents it shows by the slip that it takes, as a smaller wheel radius does
    _contact(
        "rolling_resistance",
        Parameter("ratio", -0.05, 0.5, 0.005, scatter_rank=7),
        BOTH,
        (CURRENT, SPEED_X),
        "several speeds, forward and backward",
    ),
    # resistance grows by c v (viscous friction of bearings and gears)
    _contact("viscous_drag", Parameter("nspm", 0.0, 500.0, 3.0), BOTH, (CURRENT, SPEED_X), "three speeds"),
    # == Load and motors
    # mass m (1 + p) (Newton)
    effect(
        "payload",
        Parameter("ratio", -0.5, 1.5, 0.02, as_percent=True),
        (*BOTH, OMNI),
        (CURRENT, SPEED_X),
        "accelerations and slopes",
        homes=(
            Home("", "mass_kg", Combine.TIMES),
            Home("body", "yaw_inertia_kgm2", Combine.TIMES, optional=True),
        ),
        stage=Stage.BODY,
        twins=(("motor_constant", SPEED_X),),
        beside=((OMNI, "roller_friction"),),
    ),
    # current (1 + q) (DC motor: current is torque over its constant)
    # Taken off: current / (1 + q)
    _described_sensor(
        "motor_constant",
        Parameter("ratio", -0.5, 1.0, 0.01, as_percent=True, is_error=True),
        BOTH,
        (CURRENT, TURNING_CURRENT),
        "accelerations and slopes",
        homes=(Home("motors", "torque_constant_nmpa", Combine.OVER),),
        inverse=Inverse(("wheels",), ("current_",), Combine.OVER, without_home=True),
        twins=(("payload", SPEED_X),),
    ),
    # current (1 + q t / 60 s) from the start of a run (remanence of a magnet that warms; linear over a
    # run)
    # Taken off: current / (1 + q t / 60 s), from the first stamp of the wheels
    _sensor(
        "motor_drift",
        Parameter("ratio", -0.5, 1.0, 0.01, as_percent=True),
        BOTH,
        (CURRENT, TURNING_CURRENT),
        "long runs",
        inverse=Inverse(("wheels",), ("current_",), Combine.OVER, drifts=True),
    ),
    # current of each motor + b: n b in the sum of n motors, nothing in the difference of the sides (zero
    # error of a current sensor)
    # zero of a Hall sensor: up to 2 % of a range of 50 to 200 A
    # Taken off: current of each motor - b
    _sensor(
        "current_offset",
        Parameter("a", -4.0, 4.0, 0.05),
        BOTH,
        (CURRENT,),
        "standstill, and driving forward and backward",
        inverse=Inverse(("wheels",), ("current_",), Combine.SUBTRACTED),
    ),
    # == Sideways motion
    # v_y = -c v_x w: to the outside of a turn (m (dv_y/dt + w v_x) = -K v_y with c = m/K; the centre of
    # rotation lies c v_x ahead: Mandow et al., Experimental kinematics for wheeled skid-steer mobile
    # robots, IROS 2007)
    # measured: 0.11 to 0.19 s (Husky; Warthog on asphalt, gravel and sand), DRIVE, as turn_drag
    effect(
        "turn_side_slip",
        Parameter("s", -0.5, 0.5, 0.005),
        SKIDDING,
        (SPEED_Y,),
        "arcs of several speeds, to both sides",
        words=_sided(
            EXAMPLE_MPS * EXAMPLE_RADPS,
            f"a slide of {{number}} m/s to the {{side}} at {EXAMPLE_MPS:g} m/s and {EXAMPLE_RADPS:g} rad/s",
            *("outside", "inside"),
        ),
    ),
    # T dv_y/dt + v_y = -c v_x w (first-order lag of the lateral motion: the inertia in m (dv_y/dt + w
    # v_x) = -K v_y)
    # with the friction of turn_side_slip its time constant would be c, 0.2 s at the most where measured
    effect(
        "side_slip_build_up",
        Parameter("s", 0.0, 1.0, 0.01, one_sided=True),
        SKIDDING,
        (SPEED_Y,),
        "steps of the yaw rate while driving",
        modifies="turn_side_slip",
    ),
    # resistance to rolling and to turning grow by k q W (scrub of skidding wheels; the form in q as EKF
    # practice has it)
    effect(
        "scrub", Parameter("ratio", -0.2, 1.0, 0.005), SKIDDING, (CURRENT, TURNING_CURRENT, SPEED_X), "turns"
    ),
    # v_y = -c ph |v| (Yamauchi et al., (2), with the sign that gravity sets)
    _contact(
        "side_hill_slip", Parameter("ratio", 0.0, 5.0, 0.05), WITH_IMU, (SPEED_Y,), "both signs of roll"
    ),
    # == What makes omni robots slip, and what looks like it
    # across each wheel G = -r n W v_across / U, beside F = C n W (u - v_along) / U along it (this
    # project's; docs/measured_slip.md has how it holds on measured runs)
    effect(
        "roller_friction",
        Parameter("ratio", 0.0, 1.5, 0.01),
        (OMNI,),
        (SPEED_X, SPEED_Y, HEADING, GYRO, CURRENT),
        "straight drives in several directions",
    ),
    # n_i = (1 + 2 c . p_i / d^2) / 3 of wheels at p_i, d from the middle, with the centre of mass c
    # (balance of moments)
    # measured: 16 mm ahead by weights (Robotino)
    Effect(
        "load_shift",
        tuple(
            Parameter(
                f"load_shift_{axis}_m",
                -0.05,
                0.05,
                0.001,
                (Home("body", f"com_{axis}_m", Combine.ADDED),),
            )
            for axis in ("x", "y")
        ),
        (OMNI,),
        (SPEED_X, SPEED_Y, HEADING, GYRO),
        "straight drives in several directions over ground on which the rollers resist",
        words=_centre_of_mass,
    ),
    # w = mean wheel speed / (d (1 + e)) (kinematics of a planar robot)
    # a tape measures it to a few per cent; measured turns: 0.120 to 0.128 m of 0.125 m (Robotino)
    effect(
        "wheel_distance",
        Parameter("ratio", -0.1, 0.1, 0.005, as_percent=True, is_error=True),
        (OMNI,),
        (HEADING, GYRO),
        "turns",
        homes=(Home("", "track_m", Combine.TIMES), Home("", "wheelbase_m", Combine.TIMES)),
        words=_wheel_distance,
    ),
    # positions, and speeds over ground, (1 + s) x what they are (a camera above measures in pixels)
    # Taken off: positions / (1 + s)
    effect(
        "camera_scale",
        Parameter("ratio", -0.3, 0.3, 0.01, as_percent=True, is_error=True),
        (OMNI,),
        (SPEED_X, SPEED_Y),
        "straight drives, and turns to part it from the radius of the wheels",
        inverse=Inverse(("pose",), ("position_",), Combine.OVER),
        sensed_only=True,
    ),
    # == What makes a car-like robot turn otherwise than its wheels point
    # d = measured angle + d0 (kinematics of a planar robot)
    # Taken off: angle + d0
    effect(
        "steering_offset_front",
        Parameter("rad", -0.3, 0.3, 0.005),
        (BICYCLE,),
        (GYRO, HEADING),
        "several speeds and standstill",
        inverse=Inverse(("steering",), ("angle_front_",), Combine.ADDED),
    ),
    # w = v tan d / (L + K v |v|): the front axle yields by K L / (m a) rad/N more, a the distance of the
    # centre of mass from the rear axle (understeer gradient, Gillespie, Fundamentals of Vehicle Dynamics:
    # tyres and compliance of the steering alike)
    # cars have 0.001 to 0.006 s^2/m (1 to 5 deg per g over 9.8 m/s^2); soft tyres on soil more.  Below
    # the lower bound the front axle of a light robot would be stiffer than rigid
    effect(
        "understeer",
        Parameter("s2pm", -0.01, 0.1, 0.001),
        (BICYCLE,),
        (GYRO, HEADING),
        "arcs of several speeds, to both sides",
        words=_understeer,
    ),
    # stiffness of both axles x (1 + e); so does a load of 1 / (1 + e) - 1, with nothing else to show it
    # (linear single-track model: Rajamani, Vehicle Dynamics and Control)
    # load, pressure and ground: a third on loose soil of what it is on firm ground (Wong, Theory of
    # Ground Vehicles)
    effect(
        "cornering_stiffness",
        Parameter("ratio", -0.7, 2.0, 0.02, as_percent=True, is_error=True),
        (BICYCLE,),
        (SPEED_Y, GYRO),
        "fast arcs to both sides, side slopes and steps of the steering",
        homes=(Home("", "front_cornering_npr", Combine.TIMES), Home("", "rear_cornering_npr", Combine.TIMES)),
    ),
)
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
    for p in sorted((*PARAMETER.values(), *TILT_OFFSETS), key=lambda p: p.scatter_rank)
    if p.scatter_rank
)
#: Parameters that change what sensors measure, and not the motion of the body.
SENSED_ONLY: tuple[str, ...] = tuple(
    p.name for effect in LIBRARY if effect.sensed_only for p in effect.parameters
)
#: Parameters whose sensitivity is taken towards the positive side only.
ONE_SIDED: tuple[str, ...] = tuple(name for name, p in PARAMETER.items() if p.one_sided)
#: Former names of parameters, and the present ones.
DEPRECATED: dict[str, str] = {old: p.name for p in PARAMETER.values() for old in p.deprecated}


def effect_named(name: str) -> Effect:
    """Return the effect of a name, an alias or a former name.

    Raises
    ------
    ConfigError
        for an unknown name.

    Examples
    --------
    >>> effect_named("encoder_scale").name, effect_named("lever_arm").parameters[1].name
    ('wheel_radius', 'lever_y_m')
    """
    for effect in LIBRARY:
        if name in (effect.name, *effect.aliases, *effect.deprecated):
            return effect
    raise ConfigError(f"effect {name!r} is unknown: use one of {', '.join(e.name for e in LIBRARY)}")


def library_of(drive: str) -> tuple[Effect, ...]:
    """Return the effects that apply to robots of a drive."""
    return tuple(effect for effect in LIBRARY if drive in effect.drives)


def chosen_effects(drive: str, names: Collection[str]) -> tuple[Effect, ...]:
    """Return effects by their names, in the order of the catalogue.

    Raises
    ------
    ConfigError
        if one is unknown, or does not apply to robots of a drive.
    """
    chosen = [effect_named(name) for name in names]
    for effect in chosen:
        if drive not in effect.drives:
            raise ConfigError(f"effect {effect.name} does not apply to a robot with the drive {drive!r}")
    return tuple(effect for effect in LIBRARY if effect in chosen)


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
    >>> set(NUISANCES) - set(nuisances_of("swerve"))
    {'effective_track_ratio'}
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
    inverses = [(effects.get(name, 0.0), PARAMETER[name].inverse) for name in in_plant(Stage.SENSORS)]
    acting = [(e, inverse) for e, inverse in inverses if e and inverse and stream in inverse.streams]
    acting.sort(key=lambda each: not each[1].is_factor)

    def change(time_s: Array, values: Array) -> tuple[Array, Array]:
        stamps = time_s
        for e, inverse in acting:
            if inverse.columns == STAMPS:
                stamps = inverse.combine.invert(stamps, e)
            elif inverse.act is not None:
                inverse.act(Block(stream, channels, time_s, values, 0.0, None, None, {}), e)
            for i, channel in enumerate(channels):
                if inverse.columns and channel.startswith(inverse.columns):
                    values[:, i] = inverse.combine.invert(values[:, i], inverse.size(e, time_s))
        return stamps, values

    return change


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
        effect = effect_named(name.strip())
        if drive not in effect.drives:
            raise ConfigError(f"effect {effect.name} does not apply to a robot with the drive {drive!r}")
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
PARAMETERS: tuple[str, ...] = (*PARAMETER, *[p.name for p in TILT_OFFSETS])
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
        plain = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not (plain and math.isfinite(value) and low <= value <= high):
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
    values = {n: number(f"{place}: {n}", entry, known[n].unit, -math.inf) for n, entry in entries.items()}
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
            if isinstance(entry, bool) or not isinstance(entry, int | float) or not math.isfinite(entry):
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
    if (
        covariance.ndim != 2
        or covariance.shape[0] != covariance.shape[1]
        or not np.isfinite(covariance).all()
    ):
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
