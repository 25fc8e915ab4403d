"""Settings of ``terrain track``."""

from __future__ import annotations

import math
from pathlib import Path

from pydantic import field_validator

from pipelines.report.settings import Settings, setting

SLIP_SOURCES = ("none", "dynamic", "kinematic", "multi", "multi-grip")
"""Names of :class:`terrain.control.car_following.SlipSource`, which would load compiled code here."""
MAX_SLOPE_DEG = 30.0


class TrackSettings(Settings):
    """Robot, path and ground of a simulated drive."""

    robot: str = setting(..., "Car-like robot by name, or its YAML file.")
    path: Path = setting(
        ..., "CSV file of points in their order: columns x_m and y_m, and roll_rad where it is known."
    )
    out: Path = setting(Path("terrain-track"), "Folder of the page, its pictures and the table of the drive.")
    speed: float = setting(3.0, "Speed in m/s.", ge=0.1)
    observer: str = setting("multi", f"Sideslip by: {', '.join(SLIP_SOURCES)}.")
    slope_deg: float = setting(
        0.0, "Side slope in degrees, left side up > 0; with roll_rad in the file, that.", option="--slope"
    )
    grip: float = setting(0.7, "Largest side force over load.", gt=0.0, le=1.5)
    offset: float = setting(0.0, "Desired distance to the left of the path in m.", ge=-100.0, le=100.0)
    stop: tuple[float, ...] = setting(
        (), "Distances in m at which to stop for 3 s, by commas.", separated=True
    )
    point_std: float = setting(
        0.0, "Standard deviation of the points in m: 0.02 for points of an RTK receiver.", ge=0.0, le=10.0
    )
    seed: int = setting(0, "Of the noise of the sensors.", ge=0)

    @field_validator("observer")
    @classmethod
    def _known_observer(cls, name: str) -> str:
        if name not in SLIP_SOURCES:
            raise ValueError(f"--observer is {name!r}; choose among {', '.join(SLIP_SOURCES)}")
        return name

    @field_validator("slope_deg")
    @classmethod
    def _possible_slope(cls, slope_deg: float) -> float:
        if not abs(slope_deg) <= MAX_SLOPE_DEG:
            limits = f"{-MAX_SLOPE_DEG:g} to {MAX_SLOPE_DEG:g} degrees"
            raise ValueError(f"--slope is {slope_deg:g}; {limits} are accepted")
        return slope_deg

    @field_validator("stop")
    @classmethod
    def _rising_stops(cls, stops: tuple[float, ...]) -> tuple[float, ...]:
        ordered = all(a < b for a, b in zip((0.0, *stops), stops, strict=False))
        if not ordered or not all(map(math.isfinite, stops)):
            raise ValueError(f"--stop is {','.join(map(str, stops))}; rising distances above 0 are accepted")
        return stops
