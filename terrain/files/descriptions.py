"""YAML that describes things: every number with its unit and its source, no unknown key."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import yaml

from terrain.errors import ConfigError


class _NoKeyTwice(yaml.SafeLoader):
    """A safe loader that refuses a key given twice, of which plain YAML takes the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping whose keys differ."""
        keys = [key.value for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} is given twice", node.start_mark
                )
        return super().construct_mapping(node, deep=deep)


def read_yaml(path: Path) -> Any:
    """Return what a YAML file holds, unchecked; no file can run code.

    Raises
    ------
    ConfigError
        if it cannot be opened or is no YAML.
    """
    try:
        return yaml.load(path.read_text(encoding="utf-8"), Loader=_NoKeyTwice)  # a SafeLoader
    except OSError as error:
        raise ConfigError(f"{path}: cannot be opened ({error.strerror})") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is no YAML ({' '.join(str(error).split())})") from error


def number(place: str, entry: Any, unit: str, low: float | None = None) -> float:
    """Return the number of an entry ``{value, unit, source}``, with ``interval`` where it was calibrated.

    Parameters
    ----------
    place : file and key, as messages name them
    entry : what the file holds
    unit : the one accepted
    low : least value; None where it must be above zero

    Raises
    ------
    ConfigError
        if a key is unknown or missing, the unit another, no source there, or the number out of range.
    """
    check_keys(place, entry, ["value", "unit", "source"], optional=("interval",))
    if entry["unit"] != unit:
        raise ConfigError(f"{place} has the unit {entry['unit']!r}, {unit!r} is required")
    if not isinstance(entry["source"], str) or not entry["source"].strip():
        raise ConfigError(f"{place} has no source: say where the number is from, or 'assumed'")
    value = entry["value"]
    within = not isinstance(value, bool) and isinstance(value, int | float) and math.isfinite(value)
    if low is None and not (within and value > 0):
        raise ConfigError(f"{place} is {value!r}, a number above zero is required")
    if low is not None and not (within and value >= low):
        raise ConfigError(f"{place} is {value!r}, a number{' from zero up' if low == 0 else ''} is required")
    return float(value)


def check_keys(place: str, entry: Any, desired: list[str], optional: tuple[str, ...] = ()) -> None:
    """Refuse a mapping that lacks a desired key or has one that is not accepted; ``ConfigError``."""
    if not isinstance(entry, dict):
        raise ConfigError(f"{place} is {entry!r}, a mapping with {', '.join(desired)} is required")
    accepted = [*desired, *optional]
    unknown = [str(key) for key in entry if key not in accepted]
    missing = [key for key in desired if key not in entry]
    if unknown:
        raise ConfigError(f"{place}: key {unknown[0]!r} is unknown (accepted: {', '.join(accepted)})")
    if missing:
        raise ConfigError(f"{place}: key {missing[0]!r} is missing")
