"""Angles on their circle, and off it."""

from __future__ import annotations

from typing import Any, overload

import numpy as np
from numba.extending import register_jitable

from terrain.records import Array


@overload
def wrapped(angle_rad: float) -> float: ...


@overload
def wrapped(angle_rad: Array) -> Array: ...


def wrapped(angle_rad: Any) -> Any:
    """Return an angle, or angles of any shape, in (-pi, pi]; one that lies there is returned as it is.

    Compiled code may call it too.

    Examples
    --------
    >>> wrapped(np.array([-np.pi, 0.5, 4.0])).round(3)
    array([ 3.142,  0.5  , -2.283])
    """
    return angle_rad - 2 * np.pi * np.ceil((angle_rad - np.pi) / (2 * np.pi))


register_jitable(wrapped)


def unwrapped(angle_rad: Array) -> Array:
    """Return an angle (n,) without jumps of a turn from one known sample to the next; NaN stays NaN.

    Examples
    --------
    >>> unwrapped(np.array([3.0, np.nan, -3.0])).round(3)
    array([3.   ,   nan, 3.283])
    """
    out = np.array(angle_rad)
    known = np.isfinite(out)
    out[known] = np.unwrap(out[known])
    return out
