"""Velocity of a point of a rigid body that moves in a plane, and of a wheel along and across its heading.

With the body's velocity ``(v_x, v_y)`` at its origin, its yaw rate w, and a wheel at ``(x, y)`` steered by d,
all in body axes::

    velocity of the point    a = v_x - w y,  l = v_y + w x
    along the wheel          a cos d + l sin d
    across it, to the left   l cos d - a sin d

The functions take numbers and arrays alike, and compiled code may call them too.

Source: Danzi, AgriMaRo thesis, (2.2) and (7.3)-(7.5).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import register_jitable

from terrain.records import Array

TWIST = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
"""Columns of a twist, as channels and states have them."""


def point_velocity(
    speed_x_mps: float | Array,
    speed_y_mps: float | Array,
    yaw_rate_radps: float | Array,
    x_m: float | Array,
    y_m: float | Array,
) -> tuple[Any, Any]:
    """Return the velocity, forward and left, of a point of the body; arguments are broadcast.

    Examples
    --------
    >>> point_velocity(1.0, 0.0, 0.2, 0.0, -0.75)
    (1.15, 0.0)
    """
    return speed_x_mps - yaw_rate_radps * y_m, speed_y_mps + yaw_rate_radps * x_m


def in_wheel_frame(
    forward_mps: float | Array, left_mps: float | Array, cos_steer: float | Array, sin_steer: float | Array
) -> tuple[Any, Any]:
    """Return the components of a velocity along a wheel and across it, to its left.

    Examples
    --------
    >>> in_wheel_frame(1.0, 0.5, 0.0, 1.0)  # a wheel that points to the left
    (0.5, -1.0)
    """
    along_mps = forward_mps * cos_steer + left_mps * sin_steer
    return along_mps, left_mps * cos_steer - forward_mps * sin_steer


for function in (point_velocity, in_wheel_frame):
    register_jitable(function)


def wheel_frame_velocities(twist: Array, positions_m: Array, steer_rad: Array) -> tuple[Array, Array]:
    """Return the velocities (n, wheels) of the wheel centres along each wheel and across it.

    Parameters
    ----------
    twist : (n, 3) of the body
    positions_m : (wheels, 2)
    steer_rad : (n, wheels)

    Examples
    --------
    >>> wheel_frame_velocities(np.array([[1.0, 0.0, 0.2]]), np.array([[0.5, 0.0]]), np.array([[0.0]]))
    (array([[1.]]), array([[0.1]]))
    """
    forward, left = point_velocity(twist[:, 0:1], twist[:, 1:2], twist[:, 2:3], *positions_m.T)
    return in_wheel_frame(forward, left, np.cos(steer_rad), np.sin(steer_rad))


def velocity_matrix(positions_m: Array) -> Array:
    """Return H (2 wheels, 3) of (2.3): the wheel centres' velocities are H times the twist.

    Examples
    --------
    >>> velocity_matrix(np.array([[0.5, 0.2]]))
    array([[ 1. ,  0. , -0.2],
           [ 0. ,  1. ,  0.5]])
    """
    x_m, y_m = positions_m.T
    one, none = np.ones_like(x_m), np.zeros_like(x_m)
    return np.stack([np.stack([one, none, -y_m], -1), np.stack([none, one, x_m], -1)], 1).reshape(-1, 3)
