"""What differs from run to run on one terrain: load, slope, tyres, roughness, play; and faults of sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from terrain.errors import ConfigError
from terrain.files.documents import read_yaml
from terrain.files.names import data_folder
from terrain.records import Array

_ANY = (-math.inf, math.inf, "a finite number")
_ABOVE_ZERO = (1e-6, math.inf, "a number above zero")
_FROM_ZERO = (0.0, math.inf, "a number from zero up")
_SLOPE = (-1.0, 1.0, "a gradient from -1 to 1")

_RANGES: dict[str, tuple[float, float, str]] = {
    "payload_kg": _FROM_ZERO,
    "payload_m": _ANY,
    "grade_ratio": _SLOPE,
    "undulation_ratio": _SLOPE,
    "undulation_length_m": _ABOVE_ZERO,
    "radius_factors": _ABOVE_ZERO,
    "roughness_factor": _FROM_ZERO,
    "field_length_m": _ABOVE_ZERO,
    "leg_backlash_rad": (0.0, 0.5, "an angle from 0 to 0.5 rad"),
}


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of one run; the defaults are level and nominal.

    All plants have load and slope, tracks an even one; tyres, roughness, variation and play are those of the dynamic
    plant alone.

    Raises
    ------
    ConfigError
        for a number that is not finite or out of its range.
    """

    # load, and where it lies (x, y) from the empty robot's centre of mass, body axes
    payload_kg: float = 0.0
    payload_m: tuple[float, float] = (0.0, 0.0)
    # (2,) mean gradient of the ground along world x and y, uphill positive
    grade_ratio: tuple[float, float] = (0.0, 0.0)
    undulation_ratio: float = 0.0  # a gradient along world x that changes along the path; its wave length
    undulation_length_m: float = 15.0
    # (3,) true rolling radius of each wheel over the nominal one
    radius_factors: tuple[float, float, float] = (1.0, 1.0, 1.0)
    roughness_factor: float = 1.0  # roughness over that of the soil's description
    field_length_m: float = 0.5  # over which length the terrain changes along the path
    # by how much the third leg swings to either side on its hinge (thesis, conclusions)
    leg_backlash_rad: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high, desired) in _RANGES.items():
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                if not (math.isfinite(number) and low <= number <= high):
                    raise ConfigError(f"conditions: {name} is {value!r}, {desired} is required")


@dataclass(frozen=True, slots=True)
class Spread:
    """How wide :class:`Conditions` scatter (``data/spread/field.yaml`` has the sources)."""

    payload_max_kg: float
    payload_offset_m: float
    grade_std_ratio: float
    undulation_std_ratio: float
    undulation_length_m: float
    radius_std_ratio: float
    roughness_log_std_ratio: float
    field_length_m: float


def load_spread() -> Spread:
    """Return the spread that travels with the package.

    Examples
    --------
    >>> load_spread().grade_std_ratio
    0.035
    """
    described = read_yaml(data_folder("spread") / "field.yaml")
    return Spread(**{item.name: float(described[item.name]["value"]) for item in fields(Spread)})


def draw_conditions(
    spread: Spread, rng: np.random.Generator, nominal: Conditions | None = None
) -> Conditions:
    """Return the conditions of one run, drawn around the nominal ones.

    Normal draws are cut at two standard deviations, so that no run is impossible.  Lengths are the spread's.
    """
    nominal = Conditions() if nominal is None else nominal

    def normal(std: float, n: int) -> Array:
        return std * np.clip(rng.standard_normal(n), -2.0, 2.0)

    grade = np.array(nominal.grade_ratio) + normal(spread.grade_std_ratio, 2)
    radius = np.array(nominal.radius_factors) * (1.0 + normal(spread.radius_std_ratio, 3))
    offset = np.array(nominal.payload_m) + rng.uniform(-spread.payload_offset_m, spread.payload_offset_m, 2)
    payload_kg = nominal.payload_kg + float(rng.uniform(0.0, spread.payload_max_kg))
    undulation = nominal.undulation_ratio + float(normal(spread.undulation_std_ratio, 1)[0])
    rougher = float(np.exp(normal(spread.roughness_log_std_ratio, 1)[0]))
    return Conditions(
        payload_kg=payload_kg,
        payload_m=(float(offset[0]), float(offset[1])),
        grade_ratio=(float(grade[0]), float(grade[1])),
        undulation_ratio=undulation,
        undulation_length_m=spread.undulation_length_m,
        radius_factors=(float(radius[0]), float(radius[1]), float(radius[2])),
        roughness_factor=nominal.roughness_factor * rougher,
        field_length_m=spread.field_length_m,
        leg_backlash_rad=nominal.leg_backlash_rad,
    )


@dataclass(frozen=True, slots=True)
class Faults:
    """What goes wrong with the sensors on purpose, beside what they do by themselves.

    Raises
    ------
    ConfigError
        if an interval does not end after it starts.
    """

    camera_lost_s: tuple[tuple[float, float], ...] = ()  # intervals (start, end) without a sample
    gnss_lost_s: tuple[tuple[float, float], ...] = ()
    by_chance: bool = True  # dropouts and jumps of the camera at the rates of its description

    def __post_init__(self) -> None:
        for name in ("camera_lost_s", "gnss_lost_s"):
            for start_s, end_s in getattr(self, name):
                if not start_s < end_s:
                    raise ConfigError(
                        f"faults: {name} has ({start_s!r}, {end_s!r}), start before end is required"
                    )


NO_FAULTS: Faults = Faults()  # nothing on purpose
