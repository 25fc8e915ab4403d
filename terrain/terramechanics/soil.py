"""Soils: the numbers of a ground's traction, sinkage and roughness, read from YAML (``data/soils``).

Each number carries its unit and its source and, where it differs from place to place, how much: a coefficient
of variation from one run to the next and, of friction and rolling resistance, along the ground within a run::

    name: dry_sand
    law: janosi
    friction_angle_rad:
      value: 0.489
      unit: rad
      source: "Wong, Theory of Ground Vehicles, table 2.3"
      scatter: {run: 0.08, field: 0.05, source: "Phoon and Kulhawy 1999"}

``law`` names the traction law: ``janosi`` on ground that shears, ``magic`` on hard ground; a description has
the numbers of its own law and no other.  Ground that shears may also have Bekker's three numbers of sinkage,
and any ground ``roller_friction_ratio``, what it does to the rollers of omni wheels.
The unit of his moduli depends on the exponent n: ``npmn1`` is N/m^(n+1), ``npmn2`` is N/m^(n+2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.files.documents import check_keys, number, read_yaml
from terrain.files.names import described_file, packaged

EXTRA = "soils/extra"  #: Packaged soils that show an effect, and are no classes of labelled runs
#: The numbers of each traction law.
LAWS: dict[str, tuple[str, ...]] = {
    "janosi": ("cohesion_pa", "friction_angle_rad", "shear_modulus_m"),
    "magic": ("stiffness_ratio", "shape_ratio", "peak_friction_ratio", "curvature_ratio"),
}

RESISTANCE = ("rolling_resistance_ratio", "slip_sinkage_ratio")
ROLLERS = "roller_friction_ratio"  #: Of omni wheels: friction of their rollers over the load; may be left out

SINKAGE = ("kc_npmn1", "kphi_npmn2", "sinkage_exponent_ratio")

#: Lowest and highest value of each number, so that an angle in degrees is noticed; None: above zero.
#: The sinkage of a rigid wheel has no root for an exponent of 3, and near it is no approximation any more.
RANGES: dict[str, tuple[float | None, float]] = {
    "rolling_resistance_ratio": (0.0, 1.0),
    "slip_sinkage_ratio": (0.0, 5.0),
    "roughness_m3": (0.0, 1.0),
    "cohesion_pa": (0.0, 1e6),
    "friction_angle_rad": (None, 1.2),
    "shear_modulus_m": (None, 1.0),
    "stiffness_ratio": (None, 100.0),
    "shape_ratio": (None, 3.0),
    "peak_friction_ratio": (None, 3.0),
    "curvature_ratio": (-math.inf, 1.0),
    "kc_npmn1": (0.0, 1e9),
    "kphi_npmn2": (None, 1e12),
    "sinkage_exponent_ratio": (None, 2.0),
    "roller_friction_ratio": (0.0, 2.0),
}
#: The number of each law whose ``field`` is that of the thrust.
FRICTION = {"janosi": "friction_angle_rad", "magic": "peak_friction_ratio"}


class Scatter(NamedTuple):
    """How much one number of a soil differs, as coefficients of variation."""

    parameter: str
    run_ratio: float
    field_ratio: float


@dataclass(frozen=True, slots=True)
class Soil:
    """One kind of ground; numbers that its law does not have, or that are not given, are NaN."""

    name: str  #: the terrain's label
    law: str  #: ``janosi`` or ``magic``
    rolling_resistance_ratio: float  #: resistance of the rolling wheel over its load, without compaction
    slip_sinkage_ratio: float  #: exponent by which sinkage grows with slip; 0 where it does not
    roughness_m3: float  #: ISO 8608 displacement spectral density at 0.1 cycles/m, of waviness 2
    #: cohesion_pa, friction_angle_rad, shear_modulus_m: c and phi of Mohr and Coulomb, K of Janosi and Hanamoto
    cohesion_pa: float = math.nan
    friction_angle_rad: float = math.nan
    shear_modulus_m: float = math.nan
    #: stiffness_ratio, shape_ratio, peak_friction_ratio, curvature_ratio: B, C, D, E of the Magic Formula
    stiffness_ratio: float = math.nan
    shape_ratio: float = math.nan
    peak_friction_ratio: float = math.nan
    curvature_ratio: float = math.nan
    kc_npmn1: float = math.nan  #: kc_npmn1, kphi_npmn2, sinkage_exponent_ratio: kc, kphi and n of Bekker
    kphi_npmn2: float = math.nan
    sinkage_exponent_ratio: float = math.nan
    roller_friction_ratio: float = math.nan  #: of omni wheels' rollers over the load, with any law
    scatter: tuple[Scatter, ...] = ()  #: how numbers differ from run to run and along a run

    def field_ratios(self) -> tuple[float, float]:
        """Return coefficients of variation along a run, 0 where none is given.

        Of the thrust, which is that of the friction, and of the resistance, which is that of rolling.
        """
        ratios = {each.parameter: each.field_ratio for each in self.scatter}
        return ratios.get(FRICTION[self.law], 0.0), ratios.get(RESISTANCE[0], 0.0)


def soil_names() -> tuple[str, ...]:
    """Return the names of the soils that travel with the package and are classes of terrain.

    Examples
    --------
    >>> soil_names()
    ('asphalt', 'clay', 'dry_sand', 'firm_soil_gravel', 'grass', 'snow', 'tiles', 'tilled_loam')
    """
    return packaged("soils")


def load_soil(name_or_path: str | Path) -> Soil:
    """Return a soil that travels with the package, by name, or the one that a YAML file describes.

    Parameters
    ----------
    name_or_path : one of :func:`soil_names` or :data:`EXTRA`, or the path of a file that ends in ``.yaml`` or ``.yml``

    Raises
    ------
    ConfigError
        if there is no such soil or law, a key is unknown or missing, a unit is not the field's own, a source
        is missing, or a number is out of its range.

    Examples
    --------
    >>> soil = load_soil("clay")
    >>> soil.law, soil.cohesion_pa
    ('janosi', 4140.0)
    """
    path = described_file(name_or_path, "soil", "soils", EXTRA)
    return soil_from(path.name, read_yaml(path))


def soil_from(file: str, described: Any) -> Soil:
    """Return the soil that the content of a description says; ``file`` is what messages call it.

    Raises
    ------
    ConfigError
        as :func:`load_soil` does.
    """
    check_keys(file, described, ["name", "law"], optional=tuple(RANGES))
    name, law = described["name"], described["law"]
    if not isinstance(name, str) or not name:
        raise ConfigError(f"{file}: name is {name!r}, a word is required")
    if not isinstance(law, str) or law not in LAWS:
        raise ConfigError(f"{file}: law {law!r} is unknown: use one of {', '.join(LAWS)}")
    sinks = law == "janosi" and not described.keys().isdisjoint(SINKAGE)
    parameters = [*RESISTANCE, "roughness_m3", *LAWS[law], *(SINKAGE if sinks else ())]
    parameters += [ROLLERS] if ROLLERS in described else []
    check_keys(file, described, ["name", "law", *parameters])
    values, scatter = {}, []
    for key in parameters:
        place, unit = f"{file}: {key}", key.rpartition("_")[2]
        values[key] = number(place, described[key], unit, *RANGES[key], also="scatter")
        if "scatter" in described[key]:
            entry, has_field = described[key]["scatter"], key in (RESISTANCE[0], *FRICTION.values())
            check_keys(
                f"{place}: scatter", entry, ["run", "source"], optional=("field",) if has_field else ()
            )
            ratios = []
            for part in ("run", "field"):
                ratio = {"value": entry.get(part, 0.0), "unit": "ratio", "source": entry["source"]}
                ratios.append(number(f"{place}: scatter: {part}", ratio, "ratio", 0.0, 1.0))
            scatter.append(Scatter(key, *ratios))
    return Soil(name, law, **values, scatter=tuple(scatter))


def scattered(soil: Soil, rng: np.random.Generator) -> Soil:
    """Return the soil of one run, drawn around its description.

    Each number with a scatter is multiplied by its own log-normal factor of median 1, whose coefficient of
    variation is ``run_ratio`` and whose logarithm is cut at two standard deviations; of a friction angle, the
    tangent is.  A number that would leave :data:`RANGES` stops there.

    Parameters
    ----------
    soil : what to draw around
    rng : source of the draw; the same state gives the same soil

    Examples
    --------
    >>> sand = load_soil("dry_sand")
    >>> drawn = scattered(sand, np.random.default_rng(0))
    >>> drawn.kphi_npmn2 != sand.kphi_npmn2, drawn.name
    (True, 'dry_sand')
    """
    drawn: dict[str, Any] = {}
    for entry in soil.scatter:
        sigma = math.sqrt(math.log1p(entry.run_ratio**2))
        factor = math.exp(sigma * min(max(rng.standard_normal(), -2.0), 2.0))
        value = getattr(soil, entry.parameter)
        if entry.parameter == "friction_angle_rad":
            value = math.atan(math.tan(value) * factor)
        else:
            value *= factor
        drawn[entry.parameter] = min(value, RANGES[entry.parameter][1])
    return replace(soil, **drawn)
