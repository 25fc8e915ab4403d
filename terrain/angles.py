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


def arcs(position_m: Array, yaw_rad: Array, frame_yaw_rad: float = 0.0) -> Array:
    r"""Return what was travelled forward, to the left, and turned (n - 1, 3) from one pose to the next, as arcs.

    With the chord :math:`\Delta p` and the turn :math:`\Delta\psi`, along the axes at the mean heading of the two,

    .. math:: \Delta s = \frac{\Delta\psi / 2}{\sin(\Delta\psi / 2)} R(-\bar\psi)\,\Delta p ,

    so that a steady twist sums to a straight line in time, however tight the turn.

    Parameters
    ----------
    position_m, yaw_rad : (n, 2) and (n,), the yaw without jumps of a turn
    frame_yaw_rad : heading of the frame of the positions in that of the yaw

    Examples
    --------
    A quarter circle of 1 m radius to the left:

    >>> arcs(np.array([[0.0, 0.0], [1.0, 1.0]]), np.array([0.0, np.pi / 2])).round(4) + 0.0
    array([[1.5708, 0.    , 1.5708]])
    """
    turned = np.diff(yaw_rad)
    heading = yaw_rad[:-1] + turned / 2 - frame_yaw_rad
    cos, sin = np.cos(heading), np.sin(heading)
    x, y = (np.diff(position_m, axis=0) / np.sinc(turned / (2 * np.pi))[:, None]).T
    return np.column_stack([cos * x + sin * y, cos * y - sin * x, turned])
