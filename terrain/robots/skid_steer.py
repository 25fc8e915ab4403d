"""Skid-steer robots: the wheels of a side turn together, and a difference of the sides turns the robot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from terrain.records import Array, read_only
from terrain.robots.robot import Robot


@dataclass(frozen=True)
class SkidSteerRobot(Robot):
    """Four wheels that are driven by sides and not steered; each side counts as one wheel."""

    drive: ClassVar[str] = "skid_steer"
    wheels: ClassVar[tuple[str, ...]] = ("left", "right")
    sections: ClassVar[tuple[str, ...]] = ("body", "motors", "camera", "sensors")
    n_tyres: ClassVar[int] = 4
    steered: ClassVar[bool] = False
    sideways: ClassVar[bool] = False
    skids: ClassVar[bool] = True

    @cached_property
    def wheel_positions_m(self) -> Array:
        """Middle (2, 2) of each side in the body frame."""
        return read_only([[0.0, self.track_m / 2], [0.0, -self.track_m / 2]])

    @property
    def rate_channels(self) -> tuple[str, ...]:
        """Wheel circumferential speeds of the sides."""
        return tuple(f"speed_{wheel}_mps" for wheel in self.wheels)

    @property
    def wheel_rows(self) -> tuple[str, ...]:
        """Wheel circumferential speeds of the sides."""
        return tuple(f"wheel_{wheel}_mps" for wheel in self.wheels)

    @property
    def steer_rows(self) -> tuple[str, ...]:
        """No row: nothing is steered."""
        return ()

    @property
    def steering_zeros_rad(self) -> Array:
        """Zeros (2,): nothing is steered."""
        return np.zeros(2)

    @property
    def steering_rate_max_radps(self) -> float:
        """No rate: nothing is steered."""
        return 0.0

    def logged_rates(self, wheel_speed_mps: Array) -> Array:
        """Return the wheel circumferential speeds (..., 2) as they are."""
        return np.asarray(wheel_speed_mps)

    def wheel_speeds_mps(self, rows: Array) -> Array:
        """Return the rows (..., 2) as they are: they are wheel circumferential speeds."""
        return np.asarray(rows)
