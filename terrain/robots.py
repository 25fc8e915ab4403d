"""Robots: their geometry and mass, read from YAML.

Each number of a description carries its unit and its source, or ``source: assumed`` where nobody knows
better::

    name: husky
    drive: skid_steer
    wheel_radius_m: {value: 0.165, unit: m, source: "maker's nominal geometry"}
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from terrain.errors import ConfigError
from terrain.resources import data_folder

DRIVES = ("skid_steer",)


@dataclass(frozen=True, slots=True)
class Robot:
    """A wheeled robot.

    Parameters
    ----------
    name : what run logs call it
    drive : ``skid_steer``: the wheels of a side turn together, and a difference of the sides turns it
    wheel_radius_m : nominal radius of a wheel
    track_m : distance between the wheel centres of the two sides
    wheelbase_m : distance between front and rear axle
    mass_kg : total mass
    """

    name: str
    drive: str
    wheel_radius_m: float
    track_m: float
    wheelbase_m: float
    mass_kg: float


NUMBERS = tuple(field.name for field in fields(Robot) if field.name not in ("name", "drive"))
"""Fields of a robot that are numbers; the unit is the last word of the name."""


def load_robot(name_or_path: str | Path) -> Robot:
    """Return a robot that travels with the package, by name, or the one that a YAML file describes.

    Parameters
    ----------
    name_or_path : ``husky``, or the path of a file that ends in ``.yaml`` or ``.yml``

    Raises
    ------
    ConfigError
        if there is no such robot, a key is unknown or missing, a unit is not the field's own, a source is
        missing, or a number is not positive and finite.

    Examples
    --------
    >>> load_robot("husky").track_m
    0.5708
    """
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        path = data_folder("robots") / f"{name_or_path}.yaml"
        if path.parent != data_folder("robots") or not path.is_file():
            known = ", ".join(sorted(file.stem for file in data_folder("robots").glob("*.yaml")))
            raise ConfigError(f"robot {str(name_or_path)!r} is unknown: give one of {known}, or a .yaml file")
    try:
        described = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be opened ({error.strerror})") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is no YAML ({' '.join(str(error).split())})") from error
    return _robot(path.name, described)


def _robot(file: str, described: Any) -> Robot:
    _check_keys(file, described, [field.name for field in fields(Robot)])
    if not isinstance(described["name"], str) or not described["name"]:
        raise ConfigError(f"{file}: name is {described['name']!r}, a word is wanted")
    if described["drive"] not in DRIVES:
        raise ConfigError(f"{file}: drive {described['drive']!r} is unknown: use one of {', '.join(DRIVES)}")
    numbers = {key: _number(f"{file}: {key}", described[key], key.rpartition("_")[2]) for key in NUMBERS}
    return Robot(described["name"], described["drive"], **numbers)


def _number(place: str, entry: Any, unit: str) -> float:
    _check_keys(place, entry, ["value", "unit", "source"])
    if entry["unit"] != unit:
        raise ConfigError(f"{place} has the unit {entry['unit']!r}, {unit!r} is wanted")
    if not isinstance(entry["source"], str) or not entry["source"].strip():
        raise ConfigError(f"{place} has no source: say where the number is from, or 'assumed'")
    value = entry["value"]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
        raise ConfigError(f"{place} is {value!r}, a number above zero is wanted")
    return float(value)


def _check_keys(place: str, entry: Any, wanted: list[str]) -> None:
    if not isinstance(entry, dict):
        raise ConfigError(f"{place} is {entry!r}, a mapping with {', '.join(wanted)} is wanted")
    unknown = [str(key) for key in entry if key not in wanted]
    missing = [key for key in wanted if key not in entry]
    if unknown:
        raise ConfigError(f"{place}: key {unknown[0]!r} is unknown (accepted: {', '.join(wanted)})")
    if missing:
        raise ConfigError(f"{place}: key {missing[0]!r} is missing")
