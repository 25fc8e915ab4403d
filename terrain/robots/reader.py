"""Reader of robots' descriptions.

Each number of a description carries its unit and its source, ``source: assumed`` where there is none, and,
where it was calibrated, its 95 % interval::

    name: agrimaro
    drive: swerve
    wheel_radius_m: {value: 0.2, unit: m, source: assumed}
    sensors:
      gyro_bias_z_radps: {value: 0.0021, unit: radps, source: "terrain calibrate", interval: [0.0019, 0.0023]}

Geometry and mass are required of every robot; the sections ``body``, ``motors``, ``steering``, ``camera`` and
``sensors`` by what simulates a robot or filters its log.  The section ``identified`` keeps what logs of one
robot showed beside its nominal figures: its effective track, the radius that its wheels roll on, delays.  The
list ``filters`` names the filters and observers that apply, where not all of its drive do.  The section
``effects`` of an extended robot (:mod:`terrain.effects`) says what else acts; :mod:`terrain.extension` makes
use of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

from terrain.effects import read_effects
from terrain.errors import ConfigError
from terrain.files.documents import check_keys, number, read_yaml
from terrain.files.names import check_name, data_folder, shown
from terrain.robots.region import read_region
from terrain.robots.robot import (
    KIND_OF_SECTION,
    BicycleRobot,
    OmniRobot,
    Robot,
    SkidSteerRobot,
    SwerveRobot,
    TrackedRobot,
)

KIND_OF_DRIVE: dict[str, type[Robot]] = {
    kind.drive: kind for kind in (SkidSteerRobot, TrackedRobot, SwerveRobot, OmniRobot, BicycleRobot)
}
"""The type of each drive."""

IDENTIFIED: Mapping[str, float | None] = {
    "rolling_radius_m": None,
    "effective_track_m": None,
    "lidar_delay_s": -math.inf,
    "wheels_delay_s": -math.inf,
    "wheel_distance_m": None,
}
"""Numbers of the section ``identified``, which logs of one robot showed and no nominal figure is: the least
value of each, None for above zero (:mod:`terrain.calibration.skid_steer`,
:mod:`terrain.calibration.omni`)."""


def load_robot(name_or_path: str | Path) -> Robot:
    """Return a robot of the package, by name, or the one that a YAML file describes.

    Parameters
    ----------
    name_or_path : ``agrimaro``, ``husky``, or the path of a file that ends in ``.yaml`` or ``.yml``

    Raises
    ------
    ConfigError
        if there is no such robot, a key is unknown or missing, a unit is not the field's own, a source is
        missing, a number is out of its range, or the geometry is impossible.

    Examples
    --------
    >>> load_robot("husky").track_m
    0.5708
    """
    if str(name_or_path) in robot_names():
        return _packaged(str(name_or_path))
    return robot_from(*read_description(name_or_path))


@cache
def _packaged(name: str) -> Robot:
    """Return a robot of the package, read once a process: its file takes 30 ms, and a robot never changes."""
    return robot_from(*read_description(name))


def read_description(name_or_path: str | Path) -> tuple[str, Any]:
    """Return the file name and the YAML content of a robot's description, unchecked."""
    path = description_file(name_or_path)
    return path.name, read_yaml(path)


def description_file(name_or_path: str | Path) -> Path:
    """Return the file of a robot's description: the path itself, or that of a robot of the package."""
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        return path
    known = robot_names()
    if str(name_or_path) not in known:
        raise ConfigError(
            f"robot {shown(str(name_or_path))} is unknown: give one of {', '.join(known)}, or a .yaml file"
        )
    return data_folder("robots") / f"{name_or_path}.yaml"


def robot_names() -> tuple[str, ...]:
    """Return the names of the robots that travel with the package."""
    return tuple(sorted(file.stem for file in data_folder("robots").glob("*.yaml")))


def packaged_robot(name: str) -> Robot:
    """Return a robot of the package by the name that a log gives: a name, never the path of a file.

    Examples
    --------
    >>> packaged_robot("husky").drive
    'skid_steer'
    >>> packaged_robot("/tmp/husky.yaml")
    Traceback (most recent call last):
    terrain.errors.ConfigError: robot '/tmp/husky.yaml' is unknown: a log names one of adap2e, ...
    """
    known = robot_names()
    if name not in known:
        raise ConfigError(
            f"robot {shown(name)} is unknown: a log names one of {', '.join(known)}, or the one whose "
            ".yaml file is given"
        )
    return load_robot(name)


def robot_named(name: str, given: Robot | None) -> Robot:
    """Return the robot that a log names: the one that is given, where it bears the name, else the package's."""
    return given if given is not None and given.name == name else packaged_robot(name)


def robot_from(file: str, described: Any) -> Robot:
    """Return the robot of a description's content; ``file`` is what messages call it."""
    drive = described.get("drive") if isinstance(described, dict) else None
    kind = KIND_OF_DRIVE.get(drive, SkidSteerRobot) if isinstance(drive, str) else SkidSteerRobot
    optional = (*KIND_OF_SECTION, "identified", "filters", "effects")
    check_keys(file, described, ["name", "drive", *kind.numbers], optional=optional)
    name = described["name"]
    if not isinstance(name, str) or not name:
        raise ConfigError(f"{file}: name is {shown(name)}, a word is required")
    check_name(f"{file}: name", name, ConfigError)
    if not isinstance(drive, str) or drive not in KIND_OF_DRIVE:
        raise ConfigError(f"{file}: drive {shown(drive)} is unknown: use one of {', '.join(KIND_OF_DRIVE)}")
    numbers = {key: number(f"{file}: {key}", described[key], _unit(key)) for key in kind.numbers}
    parts = {
        section: _part(f"{file}: {section}", part, described[section])
        for section, part in KIND_OF_SECTION.items()
        if described.get(section) is not None
    }
    assumed = frozenset(_assumed(described, kind.numbers))
    shown_by_logs, filters = described.get("identified", {}), described.get("filters", [])
    check_keys(f"{file}: identified", shown_by_logs, [], optional=tuple(IDENTIFIED))
    identified = {
        key: number(f"{file}: identified: {key}", entry, _unit(key), IDENTIFIED[key])
        for key, entry in shown_by_logs.items()
    }
    if not isinstance(filters, list) or not all(isinstance(name, str) and name for name in filters):
        raise ConfigError(f"{file}: filters is {shown(filters)}, a list of names is required")
    also = {"parts": parts, "assumed": assumed, "identified": identified, "filters": tuple(filters)}
    robot = kind.described(name, numbers, **also)
    if "effects" in described:
        effects, cov = read_effects(f"{file}: effects", described["effects"], drive)
        stated = described["effects"].get("region")
        region = None if stated is None else read_region(f"{file}: effects: region", stated)
        robot = replace(robot, effects=effects, effects_cov=cov, region=region)
    robot.check_geometry(file)
    return robot


def _assumed(described: dict[str, Any], numbers: tuple[str, ...]) -> Iterator[str]:
    """Yield the names of the numbers of a checked description whose source begins with "assumed"."""
    sections = {"": {key: described[key] for key in numbers}}
    sections |= {f"{name}.": described[name] for name in KIND_OF_SECTION if described.get(name) is not None}
    for prefix, entries in sections.items():
        for key, entry in entries.items():
            if entry["source"].strip().lower().startswith("assumed"):
                yield f"{prefix}{key}"


def _part(place: str, kind: Any, described: Any) -> Any:
    hints = get_type_hints(kind, include_extras=True)
    check_keys(place, described, list(hints))
    return kind(
        **{
            key: number(f"{place}: {key}", described[key], _unit(key), *getattr(hint, "__metadata__", ()))
            for key, hint in hints.items()
        }
    )


def _unit(key: str) -> str:
    return key.rpartition("_")[2]
