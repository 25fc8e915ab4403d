"""Swerve robots: three wheels, each driven and steered."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from terrain.records import Array, read_only
from terrain.robots.parts import Steering
from terrain.robots.robot import Robot, check_centre_of_mass


@dataclass(frozen=True)
class SwerveRobot(Robot):
    """Three wheels that are driven and steered each.

    Two of them are on the body's x axis, the third to the right of it (Danzi, AgriMaRo thesis, 7.2).
    """

    drive: ClassVar[str] = "swerve"
    wheels: ClassVar[tuple[str, ...]] = ("1", "2", "3")
    sections: ClassVar[tuple[str, ...]] = ("body", "motors", "steering", "camera", "sensors")
    n_tyres: ClassVar[int] = 3
    steered: ClassVar[bool] = True
    sideways: ClassVar[bool] = True
    skids: ClassVar[bool] = False

    @cached_property
    def wheel_positions_m(self) -> Array:
        """Position (3, 2) of each wheel in the body frame.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> load_robot("agrimaro").wheel_positions_m
        array([[-0.5075,  0.    ],
               [ 0.5075,  0.    ],
               [ 0.    , -0.756 ]])
        """
        half_m = self.wheelbase_m / 2
        return read_only([[-half_m, 0.0], [half_m, 0.0], [0.0, -self.track_m]])

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
        """Steering angles."""
        return tuple(f"steer_{wheel}_rad" for wheel in self.wheels)

    @property
    def steering(self) -> Steering:
        """Limits and zeros of the steering."""
        return self._part(Steering)

    @property
    def steering_zeros_rad(self) -> Array:
        """Reading (3,) of each steering encoder where the wheel points ahead."""
        return np.array([self.steering.zero_1_rad, self.steering.zero_2_rad, self.steering.zero_3_rad])

    @property
    def steering_rate_max_radps(self) -> float:
        """Fastest steering rate."""
        return self.steering.rate_max_radps

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
            as :meth:`Robot.check_geometry`, and if the centre of mass is outside the triangle of the wheels.
        """
        super().check_geometry(place)
        if self.describes("body"):
            check_centre_of_mass(place, self.wheel_positions_m, self.body)
