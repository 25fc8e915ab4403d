"""Robots: geometry, masses, motors, steering and sensors, read from YAML.

Each number of a description carries its unit and its source, or ``source: assumed`` where nobody knows
better, and, where it was calibrated, the interval that holds it with 95 %::

    name: agrimaro
    drive: swerve
    wheel_radius_m: {value: 0.2, unit: m, source: assumed}
    sensors:
      gyro_bias_z_radps: {value: 0.0021, unit: radps, source: "terrain calibrate", interval: [0.0019, 0.0023]}

Geometry and mass are asked of every robot; the sections ``body``, ``motors``, ``steering``, ``camera`` and
``sensors`` only by what simulates a robot or filters its log.  The section ``effects`` of an extended robot
(:mod:`terrain.effects.described`) says what else acts; :mod:`terrain.extension` makes use of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType, UnionType
from typing import Annotated, Any, NamedTuple, get_args, get_type_hints

import numpy as np

from terrain.effects import read_effects
from terrain.errors import ConfigError
from terrain.files.descriptions import check_keys, number, read_yaml
from terrain.files.resources import data_folder
from terrain.records import Array, read_only

WHEELS_OF_DRIVE: dict[str, tuple[str, ...]] = {"skid_steer": ("left", "right"), "swerve": ("1", "2", "3")}
"""Kinds of robots and how the channels of their wheels are called (``speed_left_mps``, ``motor_2_radps``)."""


Signed = Annotated[float, -math.inf]
"""A number of a description that may be any; a plain ``float`` has to be above zero."""

NotNegative = Annotated[float, 0.0]
"""A number that may be zero."""


@dataclass(frozen=True, slots=True)
class Body:
    """What moves: masses, tyres, and how far the track can be adjusted."""

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
    """Hub motors behind a reduction, and the speed loop of their drivers; torques and gains at the wheel."""

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


@dataclass(frozen=True, slots=True)
class Steering:
    """Steering of each wheel: how fast, how dead, and where its encoder's zero lies."""

    rate_max_radps: float
    accel_max_radps2: float
    dead_band_rad: NotNegative
    torque_max_nm: float
    zero_1_rad: Signed
    zero_2_rad: Signed
    zero_3_rad: Signed


@dataclass(frozen=True, slots=True)
class Camera:
    """Tracking camera: where it sits on the body, and how its pose stream behaves."""

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
    """Rates, noise, bias and delay of everything but the camera.

    ``*_std`` of a sample are those of the robot standing still; ``*_bias_std`` tell how far a bias differs
    from one power-on to the next, ``*_walk`` how fast it moves (per root second).
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


class Equipment(NamedTuple):
    """Every section of a description."""

    body: Body
    motors: Motors
    steering: Steering
    camera: Camera
    sensors: Sensors


@dataclass(frozen=True)
class Robot:
    """A wheeled robot; frames are body x forward, y left, z up.

    Parameters
    ----------
    name : what run logs call it
    drive : ``skid_steer``: the wheels of a side turn together, and a difference of the sides turns it;
        ``swerve``: three wheels that are driven and steered each (thesis 7.2: two on the body's x axis, the
        third to the right of it)
    wheel_radius_m : nominal radius of a wheel
    track_m : distance between the two sides; of a swerve robot, from the third wheel to the others' line
    wheelbase_m : distance between front and rear wheel
    mass_kg : total mass without payload
    body, motors, steering, camera, sensors : None where the description has none
    effects : parameters of :mod:`terrain.effects.catalogue` that are not 0, by name
    effects_cov : (n, n) covariance of the effects in their order; NaN where nobody knows it
    """

    name: str
    drive: str
    wheel_radius_m: float
    track_m: float
    wheelbase_m: float
    mass_kg: float
    body: Body | None = None
    motors: Motors | None = None
    steering: Steering | None = None
    camera: Camera | None = None
    sensors: Sensors | None = None
    effects: Mapping[str, float] = field(default_factory=dict, hash=False)
    effects_cov: Array = field(default_factory=lambda: np.empty((0, 0)), compare=False)

    def __post_init__(self) -> None:
        n = len(self.effects)
        cov = self.effects_cov if np.isfinite(self.effects_cov).any() else np.full((n, n), np.nan)
        if cov.shape != (n, n):
            raise ValueError(f"effects_cov has shape {cov.shape}, {(n, n)} is needed")
        object.__setattr__(self, "effects", MappingProxyType(dict(self.effects)))
        object.__setattr__(self, "effects_cov", read_only(cov))

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to another process, which a read-only view of a mapping does not by itself."""
        values = (getattr(self, item.name) for item in fields(self))
        return type(self), tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in values)

    @property
    def encoder_lag_s(self) -> float:
        """Time constant of the low-pass that wheel rates come behind; 0 where nobody knows of any."""
        told = self.sensors.encoder_time_constant_s if self.sensors else 0.0
        return told + self.effects.get("encoder_lag_s", 0.0)

    @property
    def wheels(self) -> tuple[str, ...]:
        """The wheels' names as channels have them."""
        return WHEELS_OF_DRIVE[self.drive]

    @cached_property
    def wheel_positions_m(self) -> Array:
        """Position (wheels, 2) of each wheel in the body frame.

        Examples
        --------
        >>> load_robot("agrimaro").wheel_positions_m
        array([[-0.5075,  0.    ],
               [ 0.5075,  0.    ],
               [ 0.    , -0.756 ]])
        """
        half_m = self.wheelbase_m / 2
        if self.drive == "swerve":
            return read_only([[-half_m, 0.0], [half_m, 0.0], [0.0, -self.track_m]])
        return read_only([[0.0, self.track_m / 2], [0.0, -self.track_m / 2]])

    def has(self, *sections: str) -> None:
        """Make sure that the description has the sections named.

        Raises
        ------
        ConfigError
            if one is missing.

        Examples
        --------
        >>> replace(load_robot("husky"), motors=None).has("motors")
        Traceback (most recent call last):
        terrain.errors.ConfigError: robot husky: its description has no section 'motors', which is needed here
        """
        for section in sections:
            if getattr(self, section) is None:
                raise ConfigError(
                    f"robot {self.name}: its description has no section {section!r}, which is needed here"
                )

    @cached_property
    def equipment(self) -> Equipment:
        """All sections of the description; ``ConfigError`` where one is missing.

        Examples
        --------
        >>> load_robot("agrimaro").equipment.motors.torque_max_nm
        60.0
        """
        self.has(*Equipment._fields)
        return Equipment(*(getattr(self, name) for name in Equipment._fields))

    def with_track(self, track_m: float) -> Robot:
        """Return the robot with its adjustable track set.

        Raises
        ------
        ConfigError
            if the track is out of the reach of its adjustment.

        Examples
        --------
        >>> load_robot("agrimaro").with_track(1.0).wheel_positions_m[2]
        array([ 0., -1.])
        """
        changed = replace(self, track_m=float(track_m))
        _check_geometry(f"robot {self.name}", changed)
        return changed


def load_robot(name_or_path: str | Path) -> Robot:
    """Return a robot that travels with the package, by name, or the one that a YAML file describes.

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
    file, described = read_description(name_or_path)
    return robot_from(file, described)


def read_description(name_or_path: str | Path) -> tuple[str, Any]:
    """Return the file name and the YAML content of a robot's description, unchecked.

    Raises
    ------
    ConfigError
        if there is no such robot, or the file is no YAML.
    """
    path = description_file(name_or_path)
    return path.name, read_yaml(path)


def description_file(name_or_path: str | Path) -> Path:
    """Return the file of a robot's description: the path itself, or that of a robot of the package.

    Raises
    ------
    ConfigError
        if there is no robot of that name.
    """
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        path = data_folder("robots") / f"{name_or_path}.yaml"
        if path.parent != data_folder("robots") or not path.is_file():
            known = ", ".join(sorted(file.stem for file in data_folder("robots").glob("*.yaml")))
            raise ConfigError(f"robot {str(name_or_path)!r} is unknown: give one of {known}, or a .yaml file")
    return path


def robot_from(file: str, described: Any) -> Robot:
    """Return the robot that the content of a description says; ``file`` is what messages call it.

    Raises
    ------
    ConfigError
        as :func:`load_robot` does.
    """
    hints = get_type_hints(Robot)
    sections = {
        name: next(kind for kind in get_args(hint) if is_dataclass(kind))
        for name, hint in hints.items()
        if isinstance(hint, UnionType)
    }
    extension = ("effects", "effects_cov")
    required = [item.name for item in fields(Robot) if item.name not in (*sections, *extension)]
    check_keys(file, described, required, optional=(*sections, "effects"))
    if not isinstance(described["name"], str) or not described["name"]:
        raise ConfigError(f"{file}: name is {described['name']!r}, a word is required")
    if described["drive"] not in WHEELS_OF_DRIVE:
        known = ", ".join(WHEELS_OF_DRIVE)
        raise ConfigError(f"{file}: drive {described['drive']!r} is unknown: use one of {known}")
    numbers: dict[str, Any] = {
        item.name: number(f"{file}: {item.name}", described[item.name], item.name.rpartition("_")[2])
        for item in fields(Robot)
        if item.type == "float"
    }
    parts: dict[str, Any] = {
        name: _section(f"{file}: {name}", kind, described[name])
        for name, kind in sections.items()
        if described.get(name) is not None
    }
    if "effects" in described:
        read = read_effects(f"{file}: effects", described["effects"], described["drive"])
        parts |= dict(zip(extension, read, strict=True))
    robot = Robot(described["name"], described["drive"], **numbers, **parts)
    _check_geometry(file, robot)
    return robot


def _section(place: str, kind: Any, described: Any) -> Any:
    hints = get_type_hints(kind, include_extras=True)
    check_keys(place, described, list(hints))
    return kind(
        **{
            name: number(
                f"{place}: {name}",
                described[name],
                name.rpartition("_")[2],
                next(iter(getattr(hint, "__metadata__", ())), None),
            )
            for name, hint in hints.items()
        }
    )


def _check_geometry(place: str, robot: Robot) -> None:
    """Refuse what no body can be."""
    body = robot.body
    if robot.wheelbase_m <= 0 or robot.track_m <= 0:
        raise ConfigError(f"{place}: track_m and wheelbase_m must be above zero")
    if body is None:
        return
    if body.footprint_min_m > body.footprint_max_m:
        raise ConfigError(f"{place}: footprint_min_m {body.footprint_min_m} is over footprint_max_m")
    low_m, high_m = (edge - body.tyre_width_m for edge in (body.footprint_min_m, body.footprint_max_m))
    if not low_m <= robot.track_m <= high_m:
        raise ConfigError(
            f"{place}: track_m is {robot.track_m:g}; the footprint allows {low_m:g} to {high_m:g} m"
        )
    if robot.drive == "swerve":
        share_3 = -body.com_y_m / robot.track_m
        share_2 = (1 - share_3) / 2 + body.com_x_m / robot.wheelbase_m
        shares = np.array([1 - share_2 - share_3, share_2, share_3])
        if shares.min() <= 0:
            raise ConfigError(
                f"{place}: the centre of mass ({body.com_x_m:g}, {body.com_y_m:g}) m lies outside the "
                f"triangle of the wheels: wheel {int(shares.argmin()) + 1} would carry nothing"
            )
