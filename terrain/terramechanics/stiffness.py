"""How much a ground yields under a wheel and how difficult it is to drive on, from a soil's own numbers.

Two measures order the grounds as the AgriMaRo thesis does (8.1)::

    level = HARD   a road law of traction: nothing yields
            FIRM   ground that shears under the wheel and carries it
            SOFT   ground that sinks by Bekker's pressure-sinkage law

    difficulty = R / (P + R)     R resistance at no slip, P largest net pull: the part of the wheel's largest
                                 thrust that its own resistance takes; 0 none, 1 the wheel is stuck

``data/terrains/stiffness.yaml`` has the level of terrains that are no described soils.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.classify.stiffness import StiffnessLevel
from terrain.errors import ConfigError
from terrain.files.documents import check_keys, read_yaml
from terrain.files.names import data_folder, shown
from terrain.terramechanics.soil import Soil, extra_soil_names, load_soil, soil_names
from terrain.terramechanics.traction import ground_record, net_pull, wheel_ground

TABLE = "stiffness.yaml"

N_SLIPS = 100  #: Slips from 0 to 0.99 among which the largest net pull is found


class GroundResponse(NamedTuple):
    """What a ground does under a wheel."""

    level: StiffnessLevel  #: by which :func:`response_of` orders grounds first
    sinkage_m: float  #: of the wheel that rolls without slip
    difficulty_ratio: float  #: resistance over the largest thrust


def stiffness_level(soil: Soil) -> StiffnessLevel:
    """Return the level of a described soil.

    Examples
    --------
    >>> [stiffness_level(load_soil(name)).name for name in ("asphalt", "grass", "clay")]
    ['HARD', 'FIRM', 'SOFT']
    """
    if soil.law == "magic":
        return StiffnessLevel.HARD
    return StiffnessLevel.FIRM if math.isnan(soil.kphi_npmn2) else StiffnessLevel.SOFT


def response_of(
    soil: Soil, normal_n: float, wheel_radius_m: float, tyre_width_m: float, contact_length_m: float
) -> GroundResponse:
    """Return how a soil yields under a wheel.

    Parameters
    ----------
    soil : the ground
    normal_n : load of the wheel, above 0
    wheel_radius_m, tyre_width_m, contact_length_m : as for :func:`~terrain.terramechanics.traction.net_pull`

    Examples
    --------
    >>> found = response_of(load_soil("clay"), 294.3, 0.2, 0.1, 0.12)
    >>> found.level.name, round(found.sinkage_m, 4), round(found.difficulty_ratio, 2)
    ('SOFT', 0.0068, 0.34)
    """
    geometry = wheel_radius_m, tyre_width_m, contact_length_m
    _, _, resistance_n, sinkage_m = wheel_ground(ground_record(soil, *geometry)[0], float(normal_n), 0.0, 0.0)
    pull_n = float(net_pull(soil, normal_n, np.linspace(0.0, 0.99, N_SLIPS), *geometry).max())
    difficulty = min(resistance_n / (pull_n + resistance_n), 1.0) if pull_n > -resistance_n else 1.0
    return GroundResponse(stiffness_level(soil), float(sinkage_m), float(difficulty))


def known_levels() -> dict[str, StiffnessLevel]:
    """Return the level of every terrain that is known: described soils, and those of the packaged table.

    Raises
    ------
    ConfigError
        if the table is damaged.

    Examples
    --------
    >>> known_levels()["SNOW"].name, known_levels()["snow"].name
    ('SOFT', 'HARD')
    """
    levels = {name: stiffness_level(load_soil(name)) for name in (*soil_names(), *extra_soil_names())}
    described = read_yaml(data_folder("terrains") / TABLE)
    check_keys(TABLE, described, ["levels"])
    if not isinstance(described["levels"], dict):
        raise ConfigError(f"{TABLE}: levels is {shown(described['levels'])}, a mapping is required")
    for name, entry in described["levels"].items():
        place = f"{TABLE}: {name}"
        check_keys(place, entry, ["level", "source"])
        if entry["level"] not in list(StiffnessLevel.__members__):
            known = ", ".join(StiffnessLevel.__members__)
            raise ConfigError(f"{place}: level is {shown(entry['level'])}, one of {known} is required")
        if not isinstance(entry["source"], str) or not entry["source"].strip():
            raise ConfigError(f"{place} has no source: state where the level is from, or 'assumed'")
        levels[str(name)] = StiffnessLevel[entry["level"]]
    return levels
