"""Tracked robots: two tracks, each driven by a sprocket, and a difference of the two turns the robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Self

from terrain.errors import ConfigError
from terrain.robots.skid_steer import SkidSteerRobot


@dataclass(frozen=True)
class TrackedRobot(SkidSteerRobot):
    """Two tracks; ``wheel_radius_m`` is that of the sprocket, ``wheelbase_m`` the length on the ground.

    Logs are those of a skid-steer robot, and so is all that needs no more than the speeds of the two sides.

    Parameters
    ----------
    track_width_m : of one track
    com_height_m : of the centre of mass above the ground
    """

    track_width_m: float = 0.15
    com_height_m: float = 0.15

    numbers: ClassVar[tuple[str, ...]] = (
        *("sprocket_radius_m", "track_m", "contact_length_m", "track_width_m", "com_height_m", "mass_kg"),
    )
    spelled: ClassVar[Mapping[str, str]] = MappingProxyType(
        {"wheel_radius_m": "sprocket_radius_m", "wheelbase_m": "contact_length_m"}
    )
    drive: ClassVar[str] = "tracked"
    n_tyres: ClassVar[int] = 2

    @classmethod
    def described(cls, name: str, numbers: Mapping[str, float], **also: Any) -> Self:
        """Return the robot of a description's numbers; ``also`` are other parameters."""
        radius_m, track_m, length_m, width_m, height_m, mass_kg = (numbers[key] for key in cls.numbers)
        return cls(
            name, radius_m, track_m, length_m, mass_kg, track_width_m=width_m, com_height_m=height_m, **also
        )

    @property
    def half_track_m(self) -> float:
        """Half the distance between the middles of the tracks, d of Tazzari et al. and Yamauchi et al.

        Examples
        --------
        >>> from terrain.robots import load_robot
        >>> load_robot("patako").half_track_m
        0.1965
        """
        return self.track_m / 2.0

    @property
    def contact_length_m(self) -> float:
        """Length of a track on the ground."""
        return self.wheelbase_m

    def check_geometry(self, place: str) -> None:
        """Refuse dimensions that no body can have.

        Raises
        ------
        ConfigError
            if a length is not above zero, or the tracks overlap.
        """
        super().check_geometry(place)
        if self.track_width_m <= 0 or self.com_height_m <= 0:
            raise ConfigError(f"{place}: track_width_m and com_height_m must be above zero")
        if self.track_width_m >= self.track_m:
            raise ConfigError(
                f"{place}: track_width_m is {self.track_width_m:g}, less than track_m "
                f"({self.track_m:g} m) is required: the tracks would overlap"
            )
