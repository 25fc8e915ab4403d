"""Car-like robots as bicycles: one steered front wheel, one rear wheel, each for the two of its axle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from terrain.errors import ConfigError
from terrain.records import Array, read_only
from terrain.robots.robot import Robot


@dataclass(frozen=True)
class BicycleRobot(Robot):
    """A car-like robot; its body's origin is the middle of the rear axle, as in Deremetz et al.

    Logs have one speed, that of the rear axle, and one steering angle, that of the bicycle's front wheel.

    Parameters
    ----------
    com_ahead_m : distance of the centre of mass ahead of the rear axle, L_R
    com_height_m : of the centre of mass above the ground
    yaw_inertia_kgm2 : about the centre of mass, I_z
    steering_max_rad : largest steering angle
    steering_time_constant_s : of the first-order lag of the steering
    steering_rate_radps : fastest steering rate
    speed_max_mps : fastest speed
    front_cornering_npr, rear_cornering_npr : cornering stiffness of each axle, N/rad
    """

    com_ahead_m: float = 0.6
    com_height_m: float = 0.4
    yaw_inertia_kgm2: float = 200.0
    steering_max_rad: float = 0.35
    steering_time_constant_s: float = 0.1
    steering_rate_radps: float = 1.0
    speed_max_mps: float = 8.0
    front_cornering_npr: float = 15000.0
    rear_cornering_npr: float = 15000.0

    own: ClassVar[tuple[str, ...]] = (
        *("com_ahead_m", "com_height_m", "yaw_inertia_kgm2", "steering_max_rad"),
        *("steering_time_constant_s", "steering_rate_radps", "speed_max_mps"),
        *("front_cornering_npr", "rear_cornering_npr"),
    )
    """Numbers of its description beside those of every robot."""
    numbers: ClassVar[tuple[str, ...]] = (*Robot.numbers, *own)
    drive: ClassVar[str] = "bicycle"
    wheels: ClassVar[tuple[str, ...]] = ("front", "rear")
    sections: ClassVar[tuple[str, ...]] = ("sensors",)
    n_tyres: ClassVar[int] = 4
    steered: ClassVar[bool] = True
    sideways: ClassVar[bool] = False
    skids: ClassVar[bool] = False

    @classmethod
    def described(cls, name: str, numbers: Mapping[str, float], **also: Any) -> Self:
        """Return the robot of a description's numbers; ``also`` are other parameters."""
        own: dict[str, Any] = {key: numbers[key] for key in cls.own}
        radius_m, track_m, wheelbase_m, mass_kg = (numbers[key] for key in Robot.numbers)
        return cls(name, radius_m, track_m, wheelbase_m, mass_kg, **own, **also)

    @property
    def com_behind_front_m(self) -> float:
        """Distance of the centre of mass behind the front axle, L_F.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> load_robot("adap2e").com_behind_front_m
        0.6
        """
        return self.wheelbase_m - self.com_ahead_m

    @property
    def understeer_s2pm(self) -> float:
        """Understeer K by its tyres: at speed v it turns as one with the wheelbase ``L + K v^2``.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> load_robot("adap2e").understeer_s2pm
        0.0
        """
        ahead = self.com_ahead_m / self.front_cornering_npr
        behind = self.com_behind_front_m / self.rear_cornering_npr
        return self.mass_kg * (ahead - behind) / self.wheelbase_m

    @cached_property
    def wheel_positions_m(self) -> Array:
        """Position (2, 2) of the front and the rear wheel; the rear axle is the body's origin."""
        return read_only([[self.wheelbase_m, 0.0], [0.0, 0.0]])

    @property
    def rate_channels(self) -> tuple[str, ...]:
        """Speed of the rear axle."""
        return ("speed_rear_mps",)

    @property
    def wheel_rows(self) -> tuple[str, ...]:
        """Speed of the rear axle."""
        return ("wheel_rear_mps",)

    @property
    def steer_rows(self) -> tuple[str, ...]:
        """Steering angle of the front wheel."""
        return ("steer_front_rad",)

    @property
    def steering_zeros_rad(self) -> Array:
        """Zeros (2,): the angle logged is that of the wheel."""
        return np.zeros(2)

    @property
    def steering_rate_max_radps(self) -> float:
        """Fastest steering rate."""
        return self.steering_rate_radps

    def logged_rates(self, wheel_speed_mps: Array) -> Array:
        """Return the speed (..., 1) of the rear axle, of wheel circumferential speeds (..., 2)."""
        return np.asarray(wheel_speed_mps)[..., 1:]

    def wheel_speeds_mps(self, rows: Array) -> Array:
        """Return the row (..., 1) as it is: the rear axle's circumferential speed."""
        return np.asarray(rows)

    def check_geometry(self, place: str) -> None:
        """Refuse dimensions that no body can have.

        Raises
        ------
        ConfigError
            if the centre of mass is not between the axles, or the steering reaches a quarter turn.
        """
        super().check_geometry(place)
        if not 0.0 < self.com_ahead_m < self.wheelbase_m:
            raise ConfigError(
                f"{place}: com_ahead_m is {self.com_ahead_m:g}, between 0 and wheelbase_m "
                f"({self.wheelbase_m:g} m) is required"
            )
        if not 0.0 < self.steering_max_rad < np.pi / 2:
            raise ConfigError(
                f"{place}: steering_max_rad is {self.steering_max_rad:g}, below pi/2 is required"
            )
