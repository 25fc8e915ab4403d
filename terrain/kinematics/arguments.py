"""Arguments of kinematics, checked: ``ConfigError`` names the one that is not accepted."""

from __future__ import annotations

from typing import Any

import numpy as np

from terrain.errors import ConfigError
from terrain.records import Array


def finite_numbers(name: str, given: Any, size: int | None = None, missing: bool = False) -> Array:
    """Return ``given`` as an array of finite floats with ``size`` columns; NaN too where samples may miss."""
    try:
        array = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{name} cannot be read as an array of numbers") from None
    if size is not None and array.shape[-1:] != (size,):
        raise ConfigError(f"{name} has shape {array.shape}, (..., {size}) is required")
    bad = np.isinf(array) if missing else ~np.isfinite(array)
    if bad.any():
        raise ConfigError(f"{name} holds {array[bad].flat[0]}, finite numbers are required")
    return array


def wheel_positions(given: Any) -> Array:
    """Return positions (wheels, 2) of two wheels or more that are not all in one place."""
    positions = finite_numbers("positions_m", given, 2)
    if positions.ndim != 2 or len(positions) < 2:
        raise ConfigError(f"positions_m has shape {positions.shape}, (wheels, 2) with two wheels is required")
    if (positions == positions[0]).all():
        raise ConfigError("positions_m holds one place only: wheels in one place do not tell the yaw rate")
    return positions


def above_zero(name: str, given: Any) -> float:
    """Return ``given`` as a number above zero."""
    value = finite_numbers(name, given)
    if value.ndim or not value > 0:
        raise ConfigError(f"{name} is {given!r}, a number above zero is required")
    return float(value)


def broadcast(**arrays: Array) -> list[Array]:
    """Return arrays of one shape; messages leave out the name ``_``."""
    try:
        return list(np.broadcast_arrays(*arrays.values()))
    except ValueError:
        names = " and ".join(f"{name} {array.shape}" for name, array in arrays.items() if name != "_")
        raise ConfigError(f"shapes do not fit together: {names}") from None
