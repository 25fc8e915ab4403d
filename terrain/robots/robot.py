"""What all robots share: geometry, mass, the sections of their description, and their effects."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from terrain.errors import ConfigError
from terrain.records import Array, read_only
from terrain.robots.parts import KIND_OF_SECTION, Body, Camera, Equipment, Motors, Part, Sensors, Steering
from terrain.robots.region import Region

P = TypeVar("P", bound=Part)


@dataclass(frozen=True)
class Robot(ABC):
    """A wheeled robot; body axes are x forward, y left, z up.

    Each kind of drive is a subclass, and answers what differs between drives.  A section of the description
    (:attr:`body`, :attr:`motors`, ...) is never None: where the description lacks it, asking for it raises
    ``ConfigError``.  Code that can do without asks :meth:`describes` first, or takes :meth:`completed`.

    Parameters
    ----------
    name : what run logs call it
    wheel_radius_m : nominal radius of a wheel
    track_m : distance between the two sides; of a swerve robot, from the third wheel to the others' line
    wheelbase_m : distance between front and rear wheel
    mass_kg : total mass without payload
    parts : sections of the description by name
    effects : parameters of :mod:`terrain.effects.catalogue` that are not 0, by name
    effects_cov : (n, n) covariance of the effects in their order; NaN where unknown
    region : of driving, that the effects were validated in; None where none is stated
    assumed : numbers whose source begins with "assumed", as ``track_m`` and ``camera.lever_x_m``
    identified : what logs of it showed beside its nominal figures, as ``effective_track_m``
    filters : filters and observers that its description lists; none where all of its drive apply
    """

    name: str
    wheel_radius_m: float
    track_m: float
    wheelbase_m: float
    mass_kg: float
    parts: Mapping[str, Part] = field(default_factory=dict, hash=False)
    effects: Mapping[str, float] = field(default_factory=dict, hash=False)
    effects_cov: Array = field(default_factory=lambda: np.empty((0, 0)), compare=False)
    region: Region | None = None
    assumed: frozenset[str] = frozenset()
    identified: Mapping[str, float] = field(default_factory=dict, hash=False)
    filters: tuple[str, ...] = ()

    numbers: ClassVar[tuple[str, ...]] = ("wheel_radius_m", "track_m", "wheelbase_m", "mass_kg")
    """Numbers that every description of the drive has, beside its sections."""
    spelled: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """What its descriptions call numbers that have another name here."""
    drive: ClassVar[str]
    """The kind of drive, as descriptions name it."""
    wheels: ClassVar[tuple[str, ...]]
    """The wheels' names, as channels have them."""
    sections: ClassVar[tuple[str, ...]]
    """Sections that a complete description has."""
    n_tyres: ClassVar[int]
    """Tyres that carry the weight."""
    steered: ClassVar[bool]
    """Whether wheels are steered: there is a stream of angles."""
    sideways: ClassVar[bool]
    """Whether it can drive sideways."""
    skids: ClassVar[bool]
    """Whether it turns by skidding, so that the turning moment takes a current of its own."""

    @property
    def on_omni_wheels(self) -> bool:
        """Whether it drives sideways on wheels that are not steered, each along its own direction."""
        return self.sideways and not self.steered

    def __post_init__(self) -> None:
        n = len(self.effects)
        cov = self.effects_cov if np.isfinite(self.effects_cov).any() else np.full((n, n), np.nan)
        if cov.shape != (n, n):
            raise ValueError(f"effects_cov has shape {cov.shape}, {(n, n)} is needed")
        for name, part in self.parts.items():
            if not isinstance(part, KIND_OF_SECTION.get(name, ())):
                raise TypeError(f"section {name!r} is a {type(part).__name__}")
        object.__setattr__(self, "parts", MappingProxyType(dict(self.parts)))
        object.__setattr__(self, "effects", MappingProxyType(dict(self.effects)))
        object.__setattr__(self, "identified", MappingProxyType(dict(self.identified)))
        object.__setattr__(self, "effects_cov", read_only(cov))

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to another process, which a read-only view of a mapping does not by itself."""
        values = (getattr(self, item.name) for item in fields(self))
        return type(self), tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in values)

    @classmethod
    def described(cls, name: str, numbers: Mapping[str, float], **also: Any) -> Self:
        """Return the robot of a description's :attr:`numbers`; ``also`` are other parameters."""
        radius_m, track_m, wheelbase_m, mass_kg = (numbers[key] for key in cls.numbers)
        return cls(name, radius_m, track_m, wheelbase_m, mass_kg, **also)

    @property
    @abstractmethod
    def wheel_positions_m(self) -> Array:
        """Position (wheels, 2) of each wheel in the body frame."""

    @property
    def wheel_directions_rad(self) -> Array:
        """Direction (wheels,) that each wheel drives along where it is not steered; 0 is ahead."""
        return np.zeros(len(self.wheels))

    @property
    @abstractmethod
    def rate_channels(self) -> tuple[str, ...]:
        """Channels of the stream ``wheels`` that tell how fast each wheel turns."""

    @property
    @abstractmethod
    def wheel_rows(self) -> tuple[str, ...]:
        """Row of each wheel's rate or speed in a table of measurements."""

    @property
    @abstractmethod
    def steer_rows(self) -> tuple[str, ...]:
        """Row of each wheel's steering angle in a table of measurements; none without steering."""

    @property
    def logged_wheels(self) -> tuple[str, ...]:
        """Names of the wheels whose rates are logged, in the order of :attr:`rate_channels`."""
        return tuple(channel.partition("_")[2].rpartition("_")[0] for channel in self.rate_channels)

    @property
    def steer_channels(self) -> tuple[str, ...]:
        """Channels of the stream ``steering``, in the order of :attr:`steer_rows`; none without steering.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> load_robot("adap2e").steer_channels, load_robot("husky").steer_channels
        (('angle_front_rad',), ())
        """
        return tuple(row.replace("steer_", "angle_") for row in self.steer_rows)

    @property
    @abstractmethod
    def steering_zeros_rad(self) -> Array:
        """Reading (wheels,) of each steering encoder where the wheel points ahead; 0 without steering."""

    @property
    @abstractmethod
    def steering_rate_max_radps(self) -> float:
        """Fastest steering rate; 0 without steering."""

    @abstractmethod
    def logged_rates(self, wheel_speed_mps: Array) -> Array:
        """Return what :attr:`rate_channels` log of wheel circumferential speeds (..., wheels)."""

    @abstractmethod
    def wheel_speeds_mps(self, rows: Array) -> Array:
        """Return wheel circumferential speeds for values (..., wheels) of :attr:`wheel_rows`."""

    @property
    def body(self) -> Body:
        """Masses and tyres."""
        return self._part(Body)

    @property
    def motors(self) -> Motors:
        """Motors and the speed loop of their motor drivers."""
        return self._part(Motors)

    @property
    def camera(self) -> Camera:
        """Tracking camera."""
        return self._part(Camera)

    @property
    def sensors(self) -> Sensors:
        """All sensors but the camera."""
        return self._part(Sensors)

    @property
    def equipment(self) -> Equipment:
        """All sections of the description; ``ConfigError`` where one is missing.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> load_robot("agrimaro").equipment.motors.torque_max_nm
        60.0
        """
        return Equipment(self.body, self.motors, self._part(Steering), self.camera, self.sensors)

    @property
    def encoder_lag_s(self) -> float:
        """Time constant of the low-pass of the wheel rates, effects included; 0 where none is known."""
        return self.completed.sensors.encoder_time_constant_s + self.effects.get("encoder_lag_s", 0.0)

    def describes(self, *sections: str) -> bool:
        """Return whether the description has all the sections named.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> load_robot("husky").describes("camera", "steering")
        False
        """
        return self.parts.keys() >= set(sections)

    def require(self, *sections: str) -> None:
        """Make sure that the description has the sections named.

        Raises
        ------
        ConfigError
            if one is missing.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> load_robot("husky").without("motors").require("motors")
        Traceback (most recent call last):
        terrain.errors.ConfigError: robot husky: its description has no section 'motors', which is needed here
        """
        for section in sections:
            self._part(KIND_OF_SECTION[section])

    def with_parts(self, **parts: Part) -> Self:
        """Return the robot with sections of its description set, by name.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> husky = load_robot("husky")
        >>> slow = husky.with_parts(motors=replace(husky.motors, speed_max_radps=3.0))
        >>> slow.motors.speed_max_radps
        3.0
        """
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

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> bare = load_robot("husky").without("camera", "sensors")
        >>> bare.completed.camera.latency_s, bare.completed.sensors.gyro_std_radps
        (0.0, nan)
        """
        middle_m = self.wheel_positions_m.mean(axis=0)
        neutral: dict[str, Part] = {
            "body": _neutral(Body, com_x_m=float(middle_m[0]), com_y_m=float(middle_m[1])),
            "motors": _neutral(
                Motors,
                reduction_ratio=1.0,
                torque_constant_nmpa=self.wheel_radius_m,
                efficiency_ratio=1.0,
                torque_max_nm=np.inf,
                speed_max_radps=np.inf,
            ),
            "camera": _neutral(Camera),
            "sensors": _neutral(Sensors),
        }
        return replace(self, parts={**neutral, **self.parts})

    def with_track(self, track_m: float) -> Self:
        """Return the robot with its adjustable track set.

        Raises
        ------
        ConfigError
            if the track is beyond its adjustment.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> load_robot("agrimaro").with_track(1.0).wheel_positions_m[2]
        array([ 0., -1.])
        """
        changed = replace(self, track_m=float(track_m))
        changed.check_geometry(f"robot {self.name}")
        return changed

    def check_geometry(self, place: str) -> None:
        """Refuse dimensions that no body can have; ``place`` is what messages call the robot.

        Raises
        ------
        ConfigError
            if track or wheelbase are not above zero, or the track is beyond what the footprint allows.
        """
        if self.wheelbase_m <= 0 or self.track_m <= 0:
            raise ConfigError(f"{place}: track_m and wheelbase_m must be above zero")
        if not self.describes("body"):
            return
        body = self.body
        if body.footprint_min_m > body.footprint_max_m:
            raise ConfigError(f"{place}: footprint_min_m {body.footprint_min_m} is over footprint_max_m")
        low_m, high_m = (edge - body.tyre_width_m for edge in (body.footprint_min_m, body.footprint_max_m))
        if not low_m <= self.track_m <= high_m:
            raise ConfigError(
                f"{place}: track_m is {self.track_m:g}; the footprint allows {low_m:g} to {high_m:g} m"
            )

    def _part(self, kind: type[P]) -> P:
        section = kind.__name__.lower()
        part = self.parts.get(section)
        if not isinstance(part, kind):
            raise ConfigError(
                f"robot {self.name}: its description has no section {section!r}, which is needed here"
            )
        return part


def check_centre_of_mass(place: str, positions_m: Array, body: Body) -> None:
    """Refuse a centre of mass that lifts one of three wheels.

    Raises
    ------
    ConfigError
        if it is outside the triangle of the wheels (3, 2).
    """
    moments = np.vstack([np.ones(3), positions_m.T])
    shares = np.linalg.solve(moments, [1.0, body.com_x_m, body.com_y_m])
    if shares.min() <= 0:
        raise ConfigError(
            f"{place}: the centre of mass ({body.com_x_m:g}, {body.com_y_m:g}) m lies outside the "
            f"triangle of the wheels: wheel {int(shares.argmin()) + 1} would carry nothing"
        )


def _neutral(kind: type[P], **values: float) -> P:
    """Return a part that does not act: 0 or, of a scale, 1; NaN for rates and noise."""
    named = {item.name: item.name for item in fields(kind)}
    default = {
        name: 1.0 if "_scale_" in name else np.nan if "_std_" in name or name.endswith("_hz") else 0.0
        for name in named
    }
    return kind(**(default | values))


_R = TypeVar("_R", bound=Robot)


def as_drive(kind: type[_R], robot: Robot, refusal: str) -> _R:
    """Return the robot as the one of a drive that it is.

    Parameters
    ----------
    kind : of robot that is required
    robot : any
    refusal : the message for other robots, with ``{name}`` and ``{drive}`` in it

    Raises
    ------
    ConfigError
        if it has another drive.

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
