"""What YAML descriptions hold: every number with its unit and its source, no unknown key."""

from __future__ import annotations

import math
from typing import Any

from terrain.errors import ConfigError
from terrain.files.names import shown


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
        raise ConfigError(f"{place} has the unit {shown(entry['unit'])}, {unit!r} is required")
    if not isinstance(entry["source"], str) or not entry["source"].strip():
        raise ConfigError(f"{place} has no source: say where the number is from, or 'assumed'")
    value = entry["value"]
    within = not isinstance(value, bool) and isinstance(value, int | float) and math.isfinite(value)
    if low is None and not (within and value > 0):
        raise ConfigError(f"{place} is {shown(value)}, a number above zero is required")
    if low is not None and not (within and value >= low):
        raise ConfigError(
            f"{place} is {shown(value)}, a number{' from zero up' if low == 0 else ''} is required"
        )
    return float(value)


def check_keys(place: str, entry: Any, desired: list[str], optional: tuple[str, ...] = ()) -> None:
    """Refuse a mapping that lacks a desired key or has one that is not accepted; ``ConfigError``."""
    if not isinstance(entry, dict):
        raise ConfigError(f"{place} is {shown(entry)}, a mapping with {', '.join(desired)} is required")
    accepted = [*desired, *optional]
    unknown = [str(key) for key in entry if key not in accepted]
    missing = [key for key in desired if key not in entry]
    if unknown:
        raise ConfigError(f"{place}: key {shown(unknown[0])} is unknown (accepted: {', '.join(accepted)})")
    if missing:
        raise ConfigError(f"{place}: key {missing[0]!r} is missing")
