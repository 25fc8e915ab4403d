"""Angles on their circle, and off it."""

from __future__ import annotations

import numpy as np

from terrain.records import Array


def wrapped(angle_rad: Array) -> Array:
    """Return angles (any shape) in (-pi, pi].

    Examples
    --------
    >>> wrapped(np.array([-np.pi, 4.0])).round(3)
    array([ 3.142, -2.283])
    """
    return np.asarray(np.pi - np.mod(np.pi - angle_rad, 2 * np.pi))


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
