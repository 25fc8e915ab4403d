"""The region of driving that an extended robot was validated in, as its description has it.

It is part of the section ``effects``; a range that was not measured is left out::

    effects:
      schema: 1
      ...
      region:
        wheel_speed_mps: [-0.82, 1.04]
        yaw_rate_radps: [-0.9, 0.93]
        grade_rad: [-0.05, 0.08]
        terrains: [asphalt, grass]
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from terrain.errors import ConfigError
from terrain.files.documents import check_keys

MARGIN = 0.1
"""Part of a range's width that a run may go beyond it: its ends are percentiles, which runs of the same kind
miss by that much."""

LEAST_MARGIN = {"wheel_speed_mps": 0.05, "yaw_rate_radps": 0.05, "grade_rad": 0.02}
"""Margin of a narrow range: what a logger's noise and an uneven floor make of driving that is the same."""

WORDS = {"wheel_speed_mps": "wheel speed", "yaw_rate_radps": "yaw rate by the wheels", "grade_rad": "slope"}
"""Each range in words."""

Range = tuple[float, float]


class Region(NamedTuple):
    """Ranges, 1st to 99th percentile, of the runs that effects were found on.

    A range is None where it was not measured, and so is what goes beyond it.
    """

    wheel_speed_mps: Range | None  #: mean circumferential speed of the wheels, forward positive
    yaw_rate_radps: Range | None  #: that the wheels would turn the robot with, without slip
    grade_rad: Range | None  #: measured slope, uphill positive
    terrains: tuple[str, ...]  #: labels of the runs


def outside(region: Region, driven: Region) -> str:
    """Return where a drive goes beyond a region, in words; empty where it does not.

    Parameters
    ----------
    region : that was validated
    driven : ranges and terrains of the drive

    Examples
    --------
    >>> validated = Region((-0.5, 1.0), None, None, ("grass",))
    >>> outside(validated, Region((0.0, 1.8), (-1.0, 1.0), None, ("snow",)))
    "wheel speed 0 to 1.8 m/s (validated: -0.5 to 1), terrain 'snow' (validated: grass)"
    >>> outside(validated, Region((0.0, 1.1), None, None, ()))
    ''
    """
    found = []
    for name, words in WORDS.items():
        known, now = getattr(region, name), getattr(driven, name)
        if known is None or now is None:
            continue
        low, high = widened(name, known)
        if now[0] < low or now[1] > high:
            unit = name.rpartition("_")[2].replace("ps", "/s")
            found.append(
                f"{words} {now[0]:.2g} to {now[1]:.2g} {unit} (validated: {known[0]:.2g} to {known[1]:.2g})"
            )
    new = [terrain for terrain in driven.terrains if terrain not in region.terrains]
    if new and region.terrains:
        names = ", ".join(repr(terrain) for terrain in new)
        found.append(f"terrain {names} (validated: {', '.join(region.terrains)})")
    return ", ".join(found)


def widened(name: str, known: Range) -> Range:
    """Return a range of a region with its margin: what goes beyond that is outside.

    Examples
    --------
    >>> widened("wheel_speed_mps", (-1.0, 1.0))
    (-1.2, 1.2)
    """
    margin = max(MARGIN * (known[1] - known[0]), LEAST_MARGIN[name])
    return known[0] - margin, known[1] + margin


def read_region(place: str, described: Any) -> Region:
    """Return the region that a description states.

    Raises
    ------
    ConfigError
        if a key is unknown, a range is not two rising finite numbers, or the terrains are no list of words.

    Examples
    --------
    >>> read_region("mine.yaml: region", {"grade_rad": [0.0, 0.1]})
    Region(wheel_speed_mps=None, yaw_rate_radps=None, grade_rad=(0.0, 0.1), terrains=())
    """
    check_keys(place, described, [], optional=Region._fields)
    terrains = described.get("terrains", [])
    if not isinstance(terrains, list) or not all(isinstance(name, str) and name for name in terrains):
        raise ConfigError(f"{place}: terrains is {terrains!r}, a list of words is required")
    speed, turn, grade = (_range(f"{place}: {name}", described.get(name)) for name in WORDS)
    return Region(speed, turn, grade, tuple(terrains))


def _range(place: str, described: Any) -> Range | None:
    if described is None:
        return None
    two = isinstance(described, list) and len(described) == 2
    if not two or not all(
        isinstance(edge, int | float) and not isinstance(edge, bool) and math.isfinite(edge)
        for edge in described
    ):
        raise ConfigError(f"{place} is {described!r}, two finite numbers are required")
    low, high = (float(edge) for edge in described)
    if low > high:
        raise ConfigError(f"{place} is {described!r}, the lower edge comes first")
    return low, high
