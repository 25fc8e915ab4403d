"""From a result to JSON, once: frozen records become objects by the names of their fields."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from terrain.files.atomic import atomic_write


def as_json(value: Any) -> Any:
    """Return what JSON can hold of a result: a number that is not finite is None.

    Parameters
    ----------
    value : a record (dataclass or named tuple), a mapping, a sequence, an array, an enum, a path, a number
        or a text; a record with a method ``as_json`` decides itself what it shows

    Examples
    --------
    >>> from typing import NamedTuple
    >>> class Figure(NamedTuple):
    ...     mean: float
    ...     ci: tuple[float, float] | None
    >>> as_json({"energy": Figure(1.5, None), "bad": float("nan")})
    {'energy': {'mean': 1.5, 'ci': None}, 'bad': None}
    """
    if value is None or (isinstance(value, bool | str | int) and not isinstance(value, Enum)):
        return value
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "as_json"):
        return as_json(value.as_json())
    if is_dataclass(value) and not isinstance(value, type):
        return {each.name: as_json(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return {name: as_json(each) for name, each in zip(value._fields, value, strict=True)}
    if isinstance(value, Mapping):
        return {str(key): as_json(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return as_json(value.tolist())
    return [as_json(each) for each in value]


def write_json(path: Path, result: Any) -> None:
    """Write a result to a file, whole or not at all."""
    atomic_write(path, json.dumps(as_json(result), indent=2, allow_nan=False) + "\n")
