"""Robots: the sections of their descriptions, what each drive is, and the reader of descriptions.

Each number of a description carries its unit and its source, ``source: assumed`` where there is none, and,
where it was calibrated, its 95 % interval::

    name: agrimaro
    drive: swerve
    wheel_radius_m: {value: 0.2, unit: m, source: assumed}
    sensors:
      gyro_bias_z_radps: {value: 0.0021, unit: radps, source: "terrain calibrate", interval: [0.0019, 0.0023]}

Geometry and mass are required of every robot; the sections ``body``, ``motors``, ``steering``, ``camera`` and
``sensors`` by what simulates a robot or filters its log, and ``antenna``, which says where that of a satellite
receiver is mounted, may be left out: then it is above the body's origin.  The section ``identified`` keeps what logs
of one robot showed beside its nominal figures: its effective track, the radius that its wheels roll on, delays.  The
list ``filters`` names the filters and observers that apply, where not all of its drive do.  The section
``effects`` of an extended robot (:mod:`terrain.effects`) says what else acts, and the section ``learned``
(:mod:`terrain.learned_term`) what acts without a name; :mod:`terrain.extension` makes use of both.  The section
``deviation`` (:mod:`terrain.deviation`) says how far runs are from its simulation, and ``watch``
(:mod:`terrain.discrepancy.watch`) how far some seconds of them are.

**The region of driving** that an extended robot was validated in is part of the section ``effects``; a range that was
not measured is left out::

    effects:
      schema: 1
      ...
      region:
        wheel_speed_mps: [-0.82, 1.04]
        yaw_rate_radps: [-0.9, 0.93]
        grade_rad: [-0.05, 0.08]
        terrains: [asphalt, grass]
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, NoReturn, Self, TypeAlias, TypeVar

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.deviation import Deviation, read_deviation
from terrain.effects import read_effects
from terrain.errors import ConfigError
from terrain.files.documents import check_keys, is_number, numbers, read_yaml
from terrain.files.names import check_name, described_file, packaged, shown
from terrain.learned_term import LearnedTerm, read_learned
from terrain.records import Array, read_only
from terrain.robot_sizes import refuse_odd_sizes

#: Part of a range's width that a run may go beyond it: its ends are percentiles, which runs of the same kind
#: miss by that much.
MARGIN = 0.1
#: Margin of a narrow range: what a logger's noise and an uneven floor make of driving that is the same.
LEAST_MARGIN = {"wheel_speed_mps": 0.05, "yaw_rate_radps": 0.05, "grade_rad": 0.02}
#: Each range in words.
WORDS = {"wheel_speed_mps": "wheel speed", "yaw_rate_radps": "yaw rate by the wheels", "grade_rad": "slope"}

Range = tuple[float, float]


class Region(NamedTuple):
    """Ranges, 1st to 99th percentile, of the runs that effects were found on.

    A range is None where it was not measured, and so is what goes beyond it.
    """

    wheel_speed_mps: Range | None  #: mean circumferential speed of the wheels, forward positive
    yaw_rate_radps: Range | None  #: that the wheels would turn the robot with, without slip
    grade_rad: Range | None  #: measured slope, uphill positive
    terrains: tuple[str, ...]  #: labels of the runs


def outside(region: Region, driven: Region) -> str:
    """Return where a drive goes beyond a region, in words; empty where it does not.

    Parameters
    ----------
    region : that was validated
    driven : ranges and terrains of the drive

    Examples
    --------
    >>> validated = Region((-0.5, 1.0), None, None, ("grass",))
    >>> outside(validated, Region((0.0, 1.8), (-1.0, 1.0), None, ("snow",)))
    "wheel speed 0 to 1.8 m/s (validated: -0.5 to 1), terrain 'snow' (validated: grass)"
    >>> outside(validated, Region((0.0, 1.1), None, None, ()))
    ''
    """
    found = []
    for name, words in WORDS.items():
        known, now = getattr(region, name), getattr(driven, name)
        if known is None or now is None:
            continue
        low, high = widened(name, known)
        if now[0] < low or now[1] > high:
            unit = name.rpartition("_")[2].replace("ps", "/s")
            found.append(
                f"{words} {now[0]:.2g} to {now[1]:.2g} {unit} (validated: {known[0]:.2g} to {known[1]:.2g})"
            )
    new = [terrain for terrain in driven.terrains if terrain not in region.terrains]
    if new and region.terrains:
        names = ", ".join(repr(terrain) for terrain in new)
        found.append(f"terrain {names} (validated: {', '.join(region.terrains)})")
    return ", ".join(found)


def widened(name: str, known: Range) -> Range:
    """Return a range of a region with its margin: what goes beyond that is outside.

    Examples
    --------
    >>> widened("wheel_speed_mps", (-1.0, 1.0))
    (-1.2, 1.2)
    """
    margin = max(MARGIN * (known[1] - known[0]), LEAST_MARGIN[name])
    return known[0] - margin, known[1] + margin


def read_region(place: str, described: Any) -> Region:
    """Return the region that a description states.

    Raises
    ------
    ConfigError
        if a key is unknown, a range is not two rising finite numbers, or the terrains are no list of words.

    Examples
    --------
    >>> read_region("mine.yaml: region", {"grade_rad": [0.0, 0.1]})
    Region(wheel_speed_mps=None, yaw_rate_radps=None, grade_rad=(0.0, 0.1), terrains=())
    """
    check_keys(place, described, [], optional=Region._fields)
    terrains = described.get("terrains", [])
    if not isinstance(terrains, list) or not all(isinstance(name, str) and name for name in terrains):
        raise ConfigError(f"{place}: terrains is {terrains!r}, a list of words is required")
    ranges: dict[str, Range | None] = dict.fromkeys(WORDS)
    for name in WORDS:
        edges = described.get(name)
        if edges is None:
            continue
        if not isinstance(edges, list) or len(edges) != 2 or not all(map(is_number, edges)):
            raise ConfigError(f"{place}: {name} is {edges!r}, two finite numbers are required")
        low, high = float(edges[0]), float(edges[1])
        if low > high:
            raise ConfigError(f"{place}: {name} is {edges!r}, the lower edge comes first")
        ranges[name] = low, high
    return Region(**ranges, terrains=tuple(terrains))


Signed: TypeAlias = float  #: A number of a description that may have any value.
NotNegative: TypeAlias = float  #: One that may be zero; a plain ``float`` has to be above zero.
LEAST: Mapping[Any, float | None] = {"Signed": -math.inf, "NotNegative": 0.0, "float": None}


@dataclass(frozen=True, slots=True)
class Body:
    """Masses, tyres, and how far the track can be adjusted."""

    footprint_min_m: float
    footprint_max_m: float
    tyre_width_m: float
    yaw_inertia_kgm2: float
    com_x_m: Signed
    com_y_m: Signed
    com_height_m: NotNegative
    wheel_inertia_kgm2: float
    contact_length_m: float
    relaxation_length_m: float
    tyre_stiffness_npm: float
    tyre_damping_nspm: float


@dataclass(frozen=True, slots=True)
class Motors:
    """Motors behind a reduction, and the speed loop of the motor drivers; torques and gains at the wheel."""

    reduction_ratio: float
    torque_constant_nmpa: float
    efficiency_ratio: float
    torque_max_nm: float
    supply_v: float
    speed_max_radps: float
    torque_time_constant_s: NotNegative
    friction_nm: NotNegative
    speed_gain_nmspr: float
    speed_integral_nmpr: NotNegative
    speed_estimate_time_constant_s: NotNegative

    @property
    def nm_per_a(self) -> float:
        """Torque at the wheel for an ampere of its motor."""
        return self.torque_constant_nmpa * self.reduction_ratio * self.efficiency_ratio


@dataclass(frozen=True, slots=True)
class Steering:
    """Steering of each wheel: its limits, its dead band, and the zero of its encoder."""

    rate_max_radps: float
    accel_max_radps2: float
    dead_band_rad: NotNegative
    torque_max_nm: float
    zero_1_rad: Signed
    zero_2_rad: Signed
    zero_3_rad: Signed


@dataclass(frozen=True, slots=True)
class Camera:
    """Tracking camera: where it is mounted on the body, and the errors of its pose stream."""

    lever_x_m: Signed
    lever_y_m: Signed
    lever_z_m: Signed
    rate_hz: float
    latency_s: NotNegative
    time_constant_s: NotNegative
    speed_std_mps: float
    yaw_rate_std_radps: float
    yaw_std_rad: float
    position_std_m: float
    dropout_rate_hz: NotNegative
    dropout_length_s: float
    jump_rate_hz: NotNegative
    jump_std_m: NotNegative


@dataclass(frozen=True, slots=True)
class Sensors:
    """Rates, noise, bias, delay and bandwidth of all sensors but the camera.

    ``*_std`` are standard deviations of a sample while the robot stands still; ``*_bias_std`` of a bias from
    one power-on to the next; ``*_walk`` the random walk of a bias (per root second).
    """

    wheels_rate_hz: float
    hall_steps_ratio: float
    encoder_time_constant_s: NotNegative
    motor_std_radps: float
    current_std_a: float
    steering_rate_hz: float
    steering_steps_ratio: float
    steering_std_rad: float
    imu_rate_hz: float
    imu_latency_s: NotNegative
    gyro_std_radps: float
    gyro_bias_x_radps: Signed
    gyro_bias_y_radps: Signed
    gyro_bias_z_radps: Signed
    gyro_bias_std_radps: NotNegative
    gyro_walk_radps: NotNegative
    accel_std_mps2: float
    accel_bias_x_mps2: Signed
    accel_bias_y_mps2: Signed
    accel_bias_z_mps2: Signed
    accel_bias_std_mps2: NotNegative
    accel_scale_x_ratio: float
    accel_scale_y_ratio: float
    accel_scale_z_ratio: float
    tilt_std_rad: float
    yaw_std_rad: float
    #: of the first-order low-pass inside the IMU; by default that of a Bosch BNO055 in its fusion modes (data sheet)
    gyro_bandwidth_hz: float = 47.0
    accel_bandwidth_hz: float = 62.5

    @property
    def imu_time_constants_s(self) -> tuple[float, float]:
        """Time constants of the low-passes of gyro and accelerometer; 0 where the bandwidth is not known."""
        gyro_s, accel_s = np.divide(0.5 / math.pi, [self.gyro_bandwidth_hz, self.accel_bandwidth_hz])
        return float(np.nan_to_num(gyro_s)), float(np.nan_to_num(accel_s))


@dataclass(frozen=True, slots=True)
class Antenna:
    """Where the antenna of a satellite receiver is mounted on the body."""

    lever_x_m: Signed
    lever_y_m: Signed
    lever_z_m: Signed = 0.0


Part: TypeAlias = Body | Motors | Steering | Camera | Sensors | Antenna  #: Any section of a description.


#: What each section of a description is read into, by its key in the file.
KIND_OF_SECTION: Mapping[str, type[Part]] = {
    "body": Body,
    "motors": Motors,
    "steering": Steering,
    "camera": Camera,
    "sensors": Sensors,
    "antenna": Antenna,
}


class Wheel(NamedTuple):
    """A wheel, or all wheels of a side that turn together."""

    name: str  #: as channels have it
    x_m: float
    y_m: float
    channel: str = ""  #: of its rate or speed in the stream ``wheels``; empty where it is not logged
    direction_rad: float = 0.0  #: that it drives along where it is not steered; 0 is ahead
    is_steered: bool = False  #: steered wheels are the first ones of a robot
    rolls_across: bool = False  #: as an omni wheel, whose rollers turn with it
    #: of such a wheel, from the direction that it drives along to the axis of its rollers: 0 of an omni wheel
    roller_rad: float = 0.0


@dataclass(frozen=True)
class Robot(ABC):
    """A wheeled robot; body axes are x forward, y left, z up.

    Each kind of drive is a subclass, which says what its wheels are; what follows from them is here.  A section of the
    description is an attribute (:attr:`body`, :attr:`motors`, ...); where the description lacks it, asking for it
    raises ``ConfigError``.  Code that can do without asks :meth:`describes` first, or takes :meth:`completed`.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> husky = load_robot("husky")
    >>> husky.rate_channels, husky.describes("camera", "steering")
    (('speed_left_mps', 'speed_right_mps'), False)
    >>> husky.without("motors").motors
    Traceback (most recent call last):
    terrain.errors.ConfigError: robot husky: its description has no section 'motors', which is needed here
    """

    name: str  #: what run logs call it
    wheel_radius_m: float  #: nominal radius of a wheel
    #: distance between the two sides; of a swerve robot, from the third wheel to the others' line
    track_m: float
    wheelbase_m: float  #: distance between front and rear wheel
    mass_kg: float  #: total mass without payload
    #: sections of the description by name
    parts: Mapping[str, Part] = field(default_factory=dict, hash=False)
    #: parameters of :mod:`terrain.effects` that are not 0, by name
    effects: Mapping[str, float] = field(default_factory=dict, hash=False)
    #: (n, n) covariance of the effects in their order; NaN where unknown
    effects_cov: Array = field(default_factory=partial(np.empty, (0, 0)), compare=False)
    region: Region | None = None  #: of driving, that the effects were validated in; None where none is stated
    #: numbers whose source begins with "assumed", as ``track_m`` and ``camera.lever_x_m``
    assumed: frozenset[str] = frozenset()
    #: what logs of it showed beside its nominal figures, as ``effective_track_m``
    identified: Mapping[str, float] = field(default_factory=dict, hash=False)
    #: filters and observers that its description lists; none where all of its drive apply
    filters: tuple[str, ...] = ()
    #: what acts on it without a name, of :mod:`terrain.learned_term`
    learned: tuple[LearnedTerm, ...] = field(default=(), hash=False)
    #: how far runs deviate from its simulation; None where that is not known
    deviation: Deviation | None = field(default=None, hash=False)

    body: Body = field(init=False, repr=False, compare=False)  #: masses and tyres
    motors: Motors = field(init=False, repr=False, compare=False)  #: and their speed loop
    steering: Steering = field(init=False, repr=False, compare=False)  #: limits and zeros
    camera: Camera = field(init=False, repr=False, compare=False)  #: tracking camera
    sensors: Sensors = field(init=False, repr=False, compare=False)  #: all but the camera
    antenna: Antenna = field(init=False, repr=False, compare=False)  #: of a satellite receiver

    wheels: tuple[str, ...] = field(init=False, repr=False, compare=False)  #: names, as channels have them
    #: names of the wheels whose rates are logged, in the order of :attr:`rate_channels`
    logged_wheels: tuple[str, ...] = field(init=False, repr=False, compare=False)
    #: channels of the stream ``wheels``: rates of motors, ahead of the reduction, or wheel speeds
    rate_channels: tuple[str, ...] = field(init=False, repr=False, compare=False)
    #: whether logs have the rates of motors, and tables those of wheels; else circumferential speeds
    by_motor: bool = field(init=False, repr=False, compare=False)
    #: row of each wheel's rate or speed in a table of measurements
    wheel_rows: tuple[str, ...] = field(init=False, repr=False, compare=False)
    steered_wheels: tuple[str, ...] = field(init=False, repr=False, compare=False)  #: their names
    #: row of each wheel's steering angle in a table of measurements, and channels of the stream ``steering``
    steer_rows: tuple[str, ...] = field(init=False, repr=False, compare=False)
    steer_channels: tuple[str, ...] = field(init=False, repr=False, compare=False)
    steered: bool = field(init=False, repr=False, compare=False)  #: whether there is a stream of angles
    #: whether it drives sideways on wheels that are not steered, each along its own direction
    on_omni_wheels: bool = field(init=False, repr=False, compare=False)
    sideways: bool = field(init=False, repr=False, compare=False)  #: whether it can drive sideways
    #: position (wheels, 2) of each wheel in the body frame
    wheel_positions_m: Array = field(init=False, repr=False, compare=False)
    #: direction (wheels,) that each wheel drives along where it is not steered; 0 is ahead
    wheel_directions_rad: Array = field(init=False, repr=False, compare=False)
    #: angle (wheels,) from there to the axis of its rollers, along which alone the ground holds it; 0 without
    roller_angles_rad: Array = field(init=False, repr=False, compare=False)

    #: numbers that every description of the drive has, beside its sections
    numbers: ClassVar[tuple[str, ...]] = ("wheel_radius_m", "track_m", "wheelbase_m", "mass_kg")
    #: what is assumed, from the numbers before it, of one that a description may leave out
    presumed: ClassVar[Mapping[str, Callable[[Mapping[str, float]], float]]] = MappingProxyType({})
    #: what its descriptions have in place of a number here, and by what that is multiplied
    spelled: ClassVar[Mapping[str, tuple[str, float]]] = MappingProxyType({})
    drive: ClassVar[str]  #: the kind of drive, as descriptions name it
    #: sections that a complete description has
    sections: ClassVar[tuple[str, ...]] = ("body", "motors", "camera", "sensors")
    n_tyres: ClassVar[int]  #: tyres that carry the weight
    #: whether it turns by skidding, so that the turning moment takes a current of its own
    skids: ClassVar[bool] = False

    def __post_init__(self) -> None:
        n = len(self.effects)
        cov = self.effects_cov if np.isfinite(self.effects_cov).any() else np.full((n, n), np.nan)
        if cov.shape != (n, n):
            raise ValueError(f"effects_cov has shape {cov.shape}, {(n, n)} is needed")
        for name, part in self.parts.items():
            if not isinstance(part, KIND_OF_SECTION.get(name, ())):
                raise TypeError(f"section {name!r} is a {type(part).__name__}")
        follows: dict[str, Any] = {"effects_cov": read_only(cov), **self.parts}
        for name in ("parts", "effects", "identified"):
            follows[name] = MappingProxyType(dict(getattr(self, name)))
        table = self.wheel_table()
        names, x_m, y_m, channels, directions, steered, across, rollers = zip(*table, strict=True)
        by_motor = any(channel.startswith("motor_") for channel in channels)
        logged = tuple(name for name, channel in zip(names, channels, strict=True) if channel)
        turning = tuple(name for name, is_steered in zip(names, steered, strict=True) if is_steered)
        follows |= {
            "wheels": names,
            "logged_wheels": logged,
            "steered_wheels": turning,
            "by_motor": by_motor,
            "rate_channels": tuple(filter(None, channels)),
            "wheel_rows": tuple(f"wheel_{name}_{'radps' if by_motor else 'mps'}" for name in logged),
            "steer_rows": tuple(f"steer_{name}_rad" for name in turning),
            "steer_channels": tuple(f"angle_{name}_rad" for name in turning),
            "steered": any(steered),
            "on_omni_wheels": all(across),
            "sideways": all(np.logical_or(across, steered)),
            "wheel_positions_m": read_only(np.column_stack([x_m, y_m])),
            "wheel_directions_rad": read_only(directions),
            "roller_angles_rad": read_only(rollers),
        }
        for name, value in follows.items():
            object.__setattr__(self, name, value)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> NoReturn:
            """Refuse what is not there; of sections, which a description may lack, in a sentence."""
            if name not in KIND_OF_SECTION:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            raise ConfigError(
                f"robot {self.name}: its description has no section {name!r}, which is needed here"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to another process, which a read-only view of a mapping does not by itself."""
        values = (getattr(self, item.name) for item in fields(self) if item.init)
        return type(self), tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in values)

    @abstractmethod
    def wheel_table(self) -> tuple[Wheel, ...]:
        """Return the wheels."""

    @property
    def steering_zeros_rad(self) -> Array:
        """Reading (wheels,) of each steering encoder where the wheel points ahead; 0 without steering."""
        return np.zeros(len(self.wheels))

    @property
    def steering_rate_max_radps(self) -> float:
        """Fastest steering rate; 0 without steering."""
        return 0.0

    def logged_rates(self, wheel_speed_mps: Array) -> Array:
        """Return what :attr:`rate_channels` log of wheel circumferential speeds (..., wheels)."""
        if self.by_motor:
            return np.asarray(wheel_speed_mps / self.wheel_radius_m * self.reduction_ratio)
        return np.asarray(wheel_speed_mps)[..., np.isin(self.wheels, self.logged_wheels)]

    def wheel_speeds_mps(self, rows: Array) -> Array:
        """Return wheel circumferential speeds for values (..., wheels) of :attr:`wheel_rows`."""
        return np.asarray(rows * self.wheel_radius_m if self.by_motor else rows)

    @property
    def encoder_lag_s(self) -> float:
        """Time constant of the low-pass of the wheel rates, effects included; 0 where none is known."""
        return self.completed.sensors.encoder_time_constant_s + self.effects.get("encoder_lag_s", 0.0)

    def describes(self, *sections: str) -> bool:
        """Return whether the description has all the sections named."""
        return self.parts.keys() >= set(sections)

    def require(self, *sections: str) -> None:
        """Make sure that the description has the sections named; else ``ConfigError``."""
        for section in sections:
            getattr(self, section)

    def with_parts(self, **parts: Part) -> Self:
        """Return the robot with sections of its description set, by name."""
        return replace(self, parts={**self.parts, **parts})

    def without(self, *sections: str) -> Self:
        """Return the robot with sections left out of its description."""
        return replace(self, parts={name: part for name, part in self.parts.items() if name not in sections})

    @cached_property
    def completed(self) -> Self:
        """The robot with a neutral part for each section that its description lacks.

        Neutral parts do not act: the mass is a point in the middle of the wheels, a traction of 1 N takes 1 A
        and no friction, camera and sensors have neither delay nor bias nor lever arm; rates and noise, which
        have no neutral value, are NaN.
        """
        x_m, y_m = self.wheel_positions_m.mean(axis=0).tolist()
        own = dict.fromkeys(("torque_max_nm", "speed_max_radps"), np.inf) | {"com_x_m": x_m, "com_y_m": y_m}
        own |= {"reduction_ratio": 1.0, "efficiency_ratio": 1.0, "torque_constant_nmpa": self.wheel_radius_m}
        neutral: dict[str, Any] = {}
        for section in ("body", "motors", "camera", "sensors"):
            values = {}
            for name in KIND_OF_SECTION[section].__dataclass_fields__:
                unknown = math.nan if "_std_" in name or name.endswith("_hz") else 0.0
                values[name] = own.get(name, 1.0 if "_scale_" in name else unknown)
            neutral[section] = KIND_OF_SECTION[section](**values)
        return replace(self, parts={**neutral, **self.parts})

    @property
    def reduction_ratio(self) -> float:
        """Turns of a motor, as logs have them, a turn of its wheel; 1 where no motors are described."""
        return self.motors.reduction_ratio if self.describes("motors") else 1.0

    def check_geometry(self, place: str) -> None:
        """Refuse dimensions that no body can have; ``place`` is what messages call the robot."""
        if self.wheelbase_m <= 0 or self.track_m <= 0:
            raise ConfigError(f"{place}: track_m and wheelbase_m must be above zero")
        refuse_odd_sizes(place, self)
        if not self.describes("body"):
            return
        body = self.body
        if body.footprint_min_m > body.footprint_max_m:
            raise ConfigError(f"{place}: footprint_min_m {body.footprint_min_m} is over footprint_max_m")
        low_m, high_m = body.footprint_min_m - body.tyre_width_m, body.footprint_max_m - body.tyre_width_m
        if not low_m - 1e-9 <= self.track_m <= high_m + 1e-9:  # sums of what is written with few digits
            raise ConfigError(
                f"{place}: track_m is {self.track_m:g}; the footprint allows {low_m:g} to {high_m:g} m"
            )
        if len(self.wheels) == 3:
            self.check_load(place)

    def check_load(self, place: str) -> None:
        """Refuse a centre of mass that lifts one of three wheels."""
        com_m = [self.body.com_x_m, self.body.com_y_m]
        parts = np.linalg.solve(np.vstack([np.ones(3), self.wheel_positions_m.T]), [1.0, *com_m])
        if parts.min() <= 0:
            raise ConfigError(
                f"{place}: the centre of mass ({com_m[0]:g}, {com_m[1]:g}) m lies outside the "
                f"triangle of the wheels: wheel {int(parts.argmin()) + 1} would carry nothing"
            )


@dataclass(frozen=True)
class SkidSteerRobot(Robot):
    """Four wheels that are driven by sides and not steered; each side counts as one wheel.

    The wheels of a side turn together, and a difference of the sides turns the robot.
    """

    drive: ClassVar[str] = "skid_steer"
    n_tyres: ClassVar[int] = 4
    skids: ClassVar[bool] = True

    def wheel_table(self) -> tuple[Wheel, ...]:
        """Return the middle of each side."""
        left = Wheel("left", 0.0, self.track_m / 2, "speed_left_mps")
        return left, Wheel("right", 0.0, -self.track_m / 2, "speed_right_mps")


@dataclass(frozen=True)
class TrackedRobot(SkidSteerRobot):
    """Two tracks; ``wheel_radius_m`` is that of the sprocket, ``wheelbase_m`` the length on the ground.

    Logs are those of a skid-steer robot, and so is all that needs no more than the speeds of the two sides.
    """

    track_width_m: float = 0.15  #: of one track
    com_height_m: float = 0.15  #: of the centre of mass above the ground

    numbers: ClassVar[tuple[str, ...]] = (
        *("sprocket_radius_m", "track_m", "contact_length_m", "track_width_m", "com_height_m", "mass_kg"),
    )
    presumed = MappingProxyType(
        {"com_height_m": lambda own: own["sprocket_radius_m"] + 0.1 * own["contact_length_m"]}
    )
    spelled = MappingProxyType(
        {"wheel_radius_m": ("sprocket_radius_m", 1.0), "wheelbase_m": ("contact_length_m", 1.0)}
    )
    drive: ClassVar[str] = "tracked"
    n_tyres: ClassVar[int] = 2

    @property
    def half_track_m(self) -> float:
        """Half the distance between the middles of the tracks, d of Tazzari et al. and Yamauchi et al."""
        return self.track_m / 2.0

    @property
    def contact_length_m(self) -> float:
        """Length of a track on the ground."""
        return self.wheelbase_m

    def check_geometry(self, place: str) -> None:
        """Refuse dimensions that no body can have."""
        super().check_geometry(place)
        if self.track_width_m <= 0 or self.com_height_m <= 0:
            raise ConfigError(f"{place}: track_width_m and com_height_m must be above zero")
        if self.track_width_m >= self.track_m:
            raise ConfigError(
                f"{place}: track_width_m is {self.track_width_m:g}, less than track_m "
                f"({self.track_m:g} m) is required: the tracks would overlap"
            )


@dataclass(frozen=True)
class SwerveRobot(Robot):
    """Three wheels that are driven and steered each.

    Two of them are on the body's x axis, the third to the right of it (Danzi, AgriMaRo thesis, 7.2).

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> load_robot("agrimaro").wheel_positions_m
    array([[-0.5075,  0.    ],
           [ 0.5075,  0.    ],
           [ 0.    , -0.756 ]])
    """

    drive: ClassVar[str] = "swerve"
    sections: ClassVar[tuple[str, ...]] = ("body", "motors", "steering", "camera", "sensors")
    n_tyres: ClassVar[int] = 3

    def wheel_table(self) -> tuple[Wheel, ...]:
        """Return the three wheels."""
        half_m = self.wheelbase_m / 2
        return (
            Wheel("1", -half_m, 0.0, "motor_1_radps", is_steered=True),
            Wheel("2", half_m, 0.0, "motor_2_radps", is_steered=True),
            Wheel("3", 0.0, -self.track_m, "motor_3_radps", is_steered=True),
        )

    @property
    def steering_zeros_rad(self) -> Array:
        """Reading (3,) of each steering encoder where the wheel points ahead."""
        return np.array([self.steering.zero_1_rad, self.steering.zero_2_rad, self.steering.zero_3_rad])

    @property
    def steering_rate_max_radps(self) -> float:
        """Fastest steering rate."""
        return self.steering.rate_max_radps


@dataclass(frozen=True)
class OmniRobot(Robot):
    """Three omni wheels on a circle about the body's origin, 120 degrees apart, that all turn it to the left.

    A wheel's motor rate is positive where the wheel drives the robot counter-clockwise.  ``track_m`` and
    ``wheelbase_m`` are the sides of the rectangle around the wheels where the first is at 60 degrees:
    ``sqrt(3) d`` and ``1.5 d`` of the distance d.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> robot = load_robot("robotino")
    >>> round(robot.wheel_distance_m, 6), np.degrees(robot.wheel_directions_rad).round(6).tolist()
    (0.125, [150.0, 270.0, 390.0])
    """

    first_wheel_rad: float = math.pi / 3  #: place of the first wheel on the circle, from the x axis

    numbers: ClassVar[tuple[str, ...]] = ("wheel_radius_m", "wheel_distance_m", "first_wheel_rad", "mass_kg")
    spelled = MappingProxyType(
        {"track_m": ("wheel_distance_m", math.sqrt(3.0)), "wheelbase_m": ("wheel_distance_m", 1.5)}
    )
    drive: ClassVar[str] = "omni"
    n_tyres: ClassVar[int] = 3

    @property
    def wheel_distance_m(self) -> float:
        """Distance of each wheel from the body's origin."""
        return self.track_m / math.sqrt(3.0)

    def wheel_table(self) -> tuple[Wheel, ...]:
        """Return the three wheels, each driving counter-clockwise about the origin."""
        wheels, d = [], self.wheel_distance_m
        for k, at in enumerate((self.first_wheel_rad + 2.0 * np.pi / 3.0 * np.arange(3)).tolist(), 1):
            x_m, y_m = d * float(np.cos(at)), d * float(np.sin(at))
            wheels.append(Wheel(f"{k}", x_m, y_m, f"motor_{k}_radps", at + np.pi / 2, rolls_across=True))
        return tuple(wheels)

    def check_geometry(self, place: str) -> None:
        """Refuse dimensions that no body can have, and a load that lifts a wheel."""
        if self.wheel_distance_m <= 0:
            raise ConfigError(f"{place}: wheel_distance_m must be above zero")
        refuse_odd_sizes(place, self)
        if not self.describes("body"):
            return
        if 2.0 * self.wheel_distance_m > self.body.footprint_max_m:
            raise ConfigError(
                f"{place}: wheel_distance_m is {self.wheel_distance_m:g}; the footprint allows up to "
                f"{self.body.footprint_max_m / 2.0:g} m"
            )
        self.check_load(place)


@dataclass(frozen=True)
class MecanumRobot(Robot):
    """Four mecanum wheels that drive ahead; their rollers' axes cross in an X, seen from above.

    Each pulls along the axis of its roller on the ground, at ``roller_rad`` from ahead: to the right in front on the
    left and behind on the right, to the left on the others.  Of the half lengths of the rectangle of the wheels only
    the sum acts (Muir and Neuman, Kinematic modeling for feedback control of an omnidirectional wheeled mobile robot,
    ICRA 1987), at 45 degrees; :attr:`wheel_distance_m` is that sum.

    Examples
    --------
    >>> robot = MecanumRobot("cart", 0.05, 0.3, 0.4, 20.0)
    >>> robot.rate_channels[:2], robot.wheel_distance_m, robot.sideways
    (('speed_front_left_mps', 'speed_front_right_mps'), 0.35, True)
    """

    roller_rad: float = math.pi / 4

    numbers: ClassVar[tuple[str, ...]] = (*Robot.numbers, "roller_rad")
    presumed = MappingProxyType({"roller_rad": lambda own: math.pi / 4})
    drive: ClassVar[str] = "mecanum"
    n_tyres: ClassVar[int] = 4

    @property
    def wheel_distance_m(self) -> float:
        """Speed of a wheel over the yaw rate of turning in place."""
        return (self.wheelbase_m * math.tan(self.roller_rad) + self.track_m) / 2.0

    def wheel_table(self) -> tuple[Wheel, ...]:
        """Return the four wheels."""
        half_m, side_m, wheels = self.wheelbase_m / 2, self.track_m / 2, []
        for end, x_m in (("front", half_m), ("rear", -half_m)):
            for side, y_m in (("left", side_m), ("right", -side_m)):
                roller_rad = -math.copysign(self.roller_rad, x_m * y_m)
                name = f"{end}_{side}"
                about = f"speed_{name}_mps", 0.0, False, True, roller_rad
                wheels.append(Wheel(name, x_m, y_m, *about))
        return tuple(wheels)

    def check_geometry(self, place: str) -> None:
        """Refuse dimensions that no body can have, and rollers that do not turn across or along."""
        super().check_geometry(place)
        if not 0.0 < self.roller_rad < np.pi / 2:
            raise ConfigError(f"{place}: roller_rad is {self.roller_rad:g}, between 0 and pi/2 is required")


@dataclass(frozen=True)
class BicycleRobot(Robot):
    """A car-like robot; its body's origin is the middle of the rear axle, as in Deremetz et al.

    Logs have one speed, that of the rear axle, and one steering angle, that of the bicycle's front wheel.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> load_robot("adap2e").steer_channels, load_robot("adap2e").understeer_s2pm
    (('angle_front_rad',), 0.0)
    """

    com_ahead_m: float = 0.6  #: distance of the centre of mass ahead of the rear axle, L_R
    com_height_m: float = 0.4  #: of the centre of mass above the ground
    yaw_inertia_kgm2: float = 200.0  #: about the centre of mass, I_z
    steering_max_rad: float = 0.35
    steering_time_constant_s: float = 0.1  #: of the first-order lag of the steering
    steering_rate_radps: float = 1.0  #: fastest
    speed_max_mps: float = 8.0
    front_cornering_npr: float = 15000.0  #: cornering stiffness of each axle
    rear_cornering_npr: float = 15000.0

    numbers: ClassVar[tuple[str, ...]] = (
        *Robot.numbers,
        *["com_ahead_m", "com_height_m", "yaw_inertia_kgm2", "steering_max_rad", "steering_time_constant_s"],
        *["steering_rate_radps", "speed_max_mps", "front_cornering_npr", "rear_cornering_npr"],
    )
    # the box of the wheels; tyres that turn a load aside by 8 times itself a radian, as soft ones on firm soil
    presumed = MappingProxyType(
        {
            "com_ahead_m": lambda own: own["wheelbase_m"] / 2.0,
            "com_height_m": lambda own: own["wheel_radius_m"] + 0.1 * own["wheelbase_m"],
            "yaw_inertia_kgm2": lambda own: (
                own["mass_kg"]
                * ((own["wheelbase_m"] + 2.0 * own["wheel_radius_m"]) ** 2 + own["track_m"] ** 2)
                / 12.0
            ),
            "steering_time_constant_s": lambda own: 0.1,
            "steering_rate_radps": lambda own: 1.0,
            "front_cornering_npr": lambda own: (
                8.0 * GRAVITY_MPS2 * own["mass_kg"] * own["com_ahead_m"] / own["wheelbase_m"]
            ),
            "rear_cornering_npr": lambda own: (
                8.0 * GRAVITY_MPS2 * own["mass_kg"] * (1.0 - own["com_ahead_m"] / own["wheelbase_m"])
            ),
        }
    )
    drive: ClassVar[str] = "bicycle"
    sections: ClassVar[tuple[str, ...]] = ("sensors",)
    n_tyres: ClassVar[int] = 4
    #: whether the front wheel drives, and the speed that is logged is its own
    front_driven: ClassVar[bool] = False

    def wheel_table(self) -> tuple[Wheel, ...]:
        """Return front and rear wheel; the rear axle is the body's origin."""
        logged = ("speed_front_mps", "") if self.front_driven else ("", "speed_rear_mps")
        front = Wheel("front", self.wheelbase_m, 0.0, logged[0], is_steered=True)
        return front, Wheel("rear", 0.0, 0.0, logged[1])

    @property
    def com_behind_front_m(self) -> float:
        """Distance of the centre of mass behind the front axle, L_F."""
        return self.wheelbase_m - self.com_ahead_m

    @property
    def understeer_s2pm(self) -> float:
        """Understeer K by its tyres: at speed v it turns as one with the wheelbase ``L + K v^2``."""
        ahead = self.com_ahead_m / self.front_cornering_npr
        behind = self.com_behind_front_m / self.rear_cornering_npr
        return self.mass_kg * (ahead - behind) / self.wheelbase_m

    @property
    def steering_rate_max_radps(self) -> float:
        """Fastest steering rate."""
        return self.steering_rate_radps

    def check_geometry(self, place: str) -> None:
        """Refuse dimensions that no body can have."""
        # what is presumed of the axles follows from where the mass is
        if self.wheelbase_m > 0.0 and not 0.0 < self.com_ahead_m < self.wheelbase_m:
            raise ConfigError(
                f"{place}: com_ahead_m is {self.com_ahead_m:g}, between 0 and wheelbase_m "
                f"({self.wheelbase_m:g} m) is required"
            )
        super().check_geometry(place)
        if not 0.0 < self.steering_max_rad < np.pi / 2:
            raise ConfigError(
                f"{place}: steering_max_rad is {self.steering_max_rad:g}, below pi/2 is required (degrees?)"
            )


@dataclass(frozen=True)
class TricycleRobot(BicycleRobot):
    """A car-like robot whose front wheel is steered and driven; ``wheel_radius_m`` is that wheel's.

    With its speed u and its angle d the rear axle moves ahead by ``u cos d``, and the body turns by ``u sin d / L``.

    Examples
    --------
    >>> TricycleRobot("truck", 0.1, 1.0, 1.4, 200.0).rate_channels
    ('speed_front_mps',)
    """

    drive: ClassVar[str] = "tricycle"
    n_tyres: ClassVar[int] = 3
    front_driven: ClassVar[bool] = True


_R = TypeVar("_R", bound=Robot)


def as_drive(kind: type[_R], robot: Robot, refusal: str) -> _R:
    """Return the robot as the one of a drive that it is.

    Parameters
    ----------
    kind : of robot that is required
    robot : any
    refusal : the message for other robots, with ``{name}`` and ``{drive}`` in it

    Examples
    --------
    >>> from terrain.robots import SwerveRobot, load_robot
    >>> as_drive(SwerveRobot, load_robot("husky"), "robot {name}: drive {drive!r} has no pilot")
    Traceback (most recent call last):
    terrain.errors.ConfigError: robot husky: drive 'skid_steer' has no pilot
    """
    if not isinstance(robot, kind):
        raise ConfigError(refusal.format(name=robot.name, drive=robot.drive))
    return robot


#: The type of each drive.
KIND_OF_DRIVE: dict[str, type[Robot]] = {
    kind.drive: kind
    for kind in (
        *(SkidSteerRobot, TrackedRobot, SwerveRobot, OmniRobot, MecanumRobot, BicycleRobot, TricycleRobot),
    )
}

#: Numbers of the section ``identified``, which logs of one robot showed and no nominal figure is: the least
#: value of each, None for above zero (:mod:`terrain.calibration`).
IDENTIFIED: Mapping[str, float | None] = {
    "rolling_radius_m": None,
    "effective_track_m": None,
    "lidar_delay_s": -math.inf,
    "wheels_delay_s": -math.inf,
    "wheel_distance_m": None,
    "wheelbase_m": None,
    "effective_wheelbase_m": None,
    "steering_gain_ratio": None,
    "steering_offset_rad": -math.inf,
    "understeer_s2pm": -math.inf,
    "pose_x_m": -math.inf,
    "pose_y_m": -math.inf,
    "pose_yaw_rad": -math.inf,
    "pose_delay_s": -math.inf,
    "gnss_delay_s": -math.inf,
    "steering_delay_s": -math.inf,
    "odometry_delay_s": -math.inf,
    "gyro_scale_ratio": None,
    "imu_roll_rad": -math.inf,
    "imu_pitch_rad": -math.inf,
    "imu_yaw_rad": -math.inf,
    "gnss_std_m": None,
    "pose_std_m": None,
    "lidar_std_mps": None,
    "wheel_speed_std_mps": None,
    "torque_per_current_nmpa": None,
    "resistance_n": None,
}


def load_robot(name_or_path: str | Path) -> Robot:
    """Return a robot of the package, by name, or the one that a YAML file describes.

    Parameters
    ----------
    name_or_path : ``agrimaro``, ``husky``, or the path of a file that ends in ``.yaml`` or ``.yml``

    Raises
    ------
    ConfigError
        if there is no such robot, a key is unknown or missing, a unit is not the field's own, a source is
        missing, a number is out of its range, or the geometry is impossible.

    Examples
    --------
    >>> load_robot("husky").track_m
    0.5708
    """
    name = str(name_or_path)
    if name not in _READ:
        path = description_file(name_or_path)
        robot = robot_from(path.name, read_yaml(path))
        if name != path.stem:  # a path: the file may change
            return robot
        _READ[name] = robot
    return _READ[name]


# A robot of the package is read once a process: it takes 30 ms, and a robot never changes.
_READ: dict[str, Robot] = {}


def description_file(name_or_path: str | Path) -> Path:
    """Return the file of a robot's description: the path itself, or that of a robot of the package."""
    return described_file(name_or_path, "robot", "robots")


def robot_argument(name: str) -> str:
    """Return what a command takes for a robot that a log names: the name, or the file of one that is not packaged.

    Examples
    --------
    >>> robot_argument("husky"), robot_argument("mine")
    ('husky', 'mine.yaml')
    """
    return name if name in packaged("robots") else f"{name}.yaml"


def robot_named(name: str, given: Robot | None = None) -> Robot:
    """Return the robot that a log names: the one that is given, where it bears the name, else the package's.

    A log gives a name, never the path of a file.

    Examples
    --------
    >>> robot_named("husky").drive
    'skid_steer'
    >>> robot_named("/tmp/husky.yaml")
    Traceback (most recent call last):
    terrain.errors.ConfigError: robot '/tmp/husky.yaml' is unknown: a log names one of adap2e, ...
    """
    if given is not None and given.name == name:
        return given
    known = packaged("robots")
    if name not in known:
        raise ConfigError(
            f"robot {shown(name)} is unknown: a log names one of {', '.join(known)}, or the one whose "
            ".yaml file is given"
        )
    return load_robot(name)


def robot_from(file: str, described: Any) -> Robot:
    """Return the robot of a description's content; ``file`` is what messages call it."""
    drive = described.get("drive") if isinstance(described, dict) else None
    kind = KIND_OF_DRIVE.get(drive, SkidSteerRobot) if isinstance(drive, str) else SkidSteerRobot
    others = (*KIND_OF_SECTION, "identified", "filters", "effects", "learned", "deviation", "watch")
    required = [key for key in kind.numbers if key not in kind.presumed]
    check_keys(file, described, ["name", "drive", *required], optional=(*kind.presumed, *others))
    name = described["name"]
    if not isinstance(name, str) or not name:
        raise ConfigError(f"{file}: name is {shown(name)}, a word is required")
    check_name(f"{file}: name", name, ConfigError)
    if not isinstance(drive, str) or drive not in KIND_OF_DRIVE:
        raise ConfigError(f"{file}: drive {shown(drive)} is unknown: use one of {', '.join(KIND_OF_DRIVE)}")
    entries = {key: described[key] for key in kind.numbers if key in described}
    own, parts = numbers(file, entries, dict.fromkeys(entries)), {}
    for key, presume in kind.presumed.items():
        if key not in own:
            own[key], entries[key] = presume(own), {"source": "assumed"}
    for section, part in KIND_OF_SECTION.items():
        if described.get(section) is not None:
            place, lows = f"{file}: {section}", {item.name: LEAST[item.type] for item in fields(part)}
            given = described[section]
            optional = tuple(item.name for item in fields(part) if item.default is not MISSING)
            check_keys(place, given, [key for key in lows if key not in optional], optional=optional)
            parts[section] = part(**numbers(place, given, {key: lows[key] for key in lows if key in given}))
            entries |= {f"{section}.{key}": entry for key, entry in described[section].items()}
    assumed = frozenset(k for k, e in entries.items() if e["source"].strip().lower().startswith("assumed"))
    shown_by_logs, filters = described.get("identified", {}), described.get("filters", [])
    # an effective track is one of a ground, ``effective_track_grass_m``, or of a kind of turns, ``..._tight_m``
    of_ground = [
        key for key in shown_by_logs if f"{key}".startswith("effective_track_") and f"{key}".endswith("_m")
    ]
    check_keys(f"{file}: identified", shown_by_logs, [], optional=(*IDENTIFIED, *of_ground))
    lows = {key: IDENTIFIED.get(key) for key in shown_by_logs}
    identified = numbers(f"{file}: identified", shown_by_logs, lows)
    if not isinstance(filters, list) or not all(isinstance(name, str) and name for name in filters):
        raise ConfigError(f"{file}: filters is {shown(filters)}, a list of names is required")
    also: dict[str, Any] = {key: own[key] for key in own if key in kind.__dataclass_fields__}
    also |= {field: factor * own[key] for field, (key, factor) in kind.spelled.items()}
    also |= {"parts": parts, "assumed": assumed, "identified": identified, "filters": tuple(filters)}
    robot = kind(name, **also)
    if "effects" in described:
        effects, cov = read_effects(f"{file}: effects", described["effects"], drive)
        stated = described["effects"].get("region")
        region = None if stated is None else read_region(f"{file}: effects: region", stated)
        robot = replace(robot, effects=effects, effects_cov=cov, region=region)
    if "learned" in described:
        robot = replace(robot, learned=read_learned(f"{file}: learned", described["learned"]))
    if "deviation" in described:
        robot = replace(robot, deviation=read_deviation(f"{file}: deviation", described["deviation"]))
    robot.check_geometry(file)
    return robot
