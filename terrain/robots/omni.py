"""Robots on three fixed omni wheels: each drives along its own direction and rolls freely across it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from terrain.errors import ConfigError
from terrain.records import Array, read_only
from terrain.robots.robot import Robot, check_centre_of_mass


@dataclass(frozen=True)
class OmniRobot(Robot):
    """Three omni wheels on a circle about the body's origin, 120 degrees apart, that all turn it to the left.

    A wheel's motor rate is positive where the wheel drives the robot counter-clockwise.  ``track_m`` and
    ``wheelbase_m`` are the sides of the rectangle around the wheels where the first is at 60 degrees:
    ``sqrt(3) d`` and ``1.5 d`` of the distance d.

    Parameters
    ----------
    first_wheel_rad : place of the first wheel on the circle, from the x axis
    """

    first_wheel_rad: float = math.pi / 3

    numbers: ClassVar[tuple[str, ...]] = ("wheel_radius_m", "wheel_distance_m", "first_wheel_rad", "mass_kg")
    drive: ClassVar[str] = "omni"
    wheels: ClassVar[tuple[str, ...]] = ("1", "2", "3")
    sections: ClassVar[tuple[str, ...]] = ("body", "motors", "camera", "sensors")
    n_tyres: ClassVar[int] = 3
    steered: ClassVar[bool] = False
    sideways: ClassVar[bool] = True
    skids: ClassVar[bool] = False

    @classmethod
    def described(cls, name: str, numbers: Mapping[str, float], **also: Any) -> Self:
        """Return the robot of a description's numbers; ``also`` are other parameters."""
        distance_m = numbers["wheel_distance_m"]
        return cls(
            name,
            numbers["wheel_radius_m"],
            math.sqrt(3.0) * distance_m,
            1.5 * distance_m,
            numbers["mass_kg"],
            first_wheel_rad=numbers["first_wheel_rad"],
            **also,
        )

    @property
    def wheel_distance_m(self) -> float:
        """Distance of each wheel from the body's origin.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> round(load_robot("robotino").wheel_distance_m, 6)
        0.125
        """
        return self.track_m / math.sqrt(3.0)

    @cached_property
    def _places_rad(self) -> Array:
        return self.first_wheel_rad + 2.0 * np.pi / 3.0 * np.arange(3)

    @cached_property
    def wheel_positions_m(self) -> Array:
        """Position (3, 2) of each wheel in the body frame."""
        angle = self._places_rad
        return read_only(self.wheel_distance_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1))

    @cached_property
    def wheel_directions_rad(self) -> Array:
        """Direction (3,) that each wheel drives along: counter-clockwise about the origin.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> np.degrees(load_robot("robotino").wheel_directions_rad).round(6).tolist()
        [150.0, 270.0, 390.0]
        """
        return read_only(self._places_rad + np.pi / 2)

    @property
    def rate_channels(self) -> tuple[str, ...]:
        """Rates of the motors, ahead of the reduction."""
        return tuple(f"motor_{wheel}_radps" for wheel in self.wheels)

    @property
    def wheel_rows(self) -> tuple[str, ...]:
        """Rates of the wheels."""
        return tuple(f"wheel_{wheel}_radps" for wheel in self.wheels)

    @property
    def steer_rows(self) -> tuple[str, ...]:
        """No row: nothing is steered."""
        return ()

    @property
    def steering_zeros_rad(self) -> Array:
        """Zeros (3,): nothing is steered."""
        return np.zeros(3)

    @property
    def steering_rate_max_radps(self) -> float:
        """No rate: nothing is steered."""
        return 0.0

    def logged_rates(self, wheel_speed_mps: Array) -> Array:
        """Return the motors' rates (..., 3) ahead of the reduction."""
        return np.asarray(wheel_speed_mps / self.wheel_radius_m * self.motors.reduction_ratio)

    def wheel_speeds_mps(self, rows: Array) -> Array:
        """Return wheel circumferential speeds for rates (..., 3) of the wheels."""
        return np.asarray(rows * self.wheel_radius_m)

    def check_geometry(self, place: str) -> None:
        """Refuse dimensions that no body can have, and a load that lifts a wheel.

        Raises
        ------
        ConfigError
            if the wheels are not above zero from the middle or outside the footprint, or the centre of mass
            is outside their triangle.
        """
        if self.wheel_distance_m <= 0:
            raise ConfigError(f"{place}: wheel_distance_m must be above zero")
        if not self.describes("body"):
            return
        if 2.0 * self.wheel_distance_m > self.body.footprint_max_m:
            raise ConfigError(
                f"{place}: wheel_distance_m is {self.wheel_distance_m:g}; the footprint allows up to "
                f"{self.body.footprint_max_m / 2.0:g} m"
            )
        check_centre_of_mass(place, self.wheel_positions_m, self.body)
