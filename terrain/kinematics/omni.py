"""Kinematics of a robot on fixed omni wheels: twist to wheels, and wheels to twist.

Wheel i at ``p_i = (x_i, y_i)`` drives along ``d_i = (cos a_i, sin a_i)``; its rollers let it move freely
across that, along ``e_i = (-sin a_i, cos a_i)``.  The velocity of its centre is
``p_i' = (v_x - y_i g, v_y + x_i g)``, and where it rolls without slip, its circumferential speed is

    u_i = d_i . p_i' = [cos a_i, sin a_i, x_i sin a_i - y_i cos a_i] (v_x, v_y, g)

which for all wheels is ``u = J V``.  Three wheels determine the twist, ``V = J^-1 u``, unless the lines that
they drive along all meet in one point or are parallel; more wheels contradict each other where one slips.
The rollers turn with ``e_i . p_i'``, which no encoder measures:
:func:`~terrain.kinematics.wheel_velocity.wheel_frame_velocities` steered by ``a_i`` gives it.

Source: Siegwart, Nourbakhsh, Scaramuzza, Introduction to Autonomous Mobile Robots, 3.2.3: the Swedish wheel
with rollers at a right angle.  A twist is ``(speed_x_mps, speed_y_mps, yaw_rate_radps)``.
"""

from __future__ import annotations

import numpy as np

from terrain.errors import ConfigError
from terrain.kinematics.arguments import finite_numbers, wheel_positions
from terrain.records import Array

MAX_CONDITION = 1e6
"""Of the matrix from twist to wheel speeds, lengths over the size of the robot: beyond, directions agree."""


def wheels_on_circle(distance_m: float, angle_rad: Array) -> tuple[Array, Array]:
    """Return positions (wheels, 2) and drive directions (wheels,) of wheels that turn the robot to the left.

    Parameters
    ----------
    distance_m : from the origin of the body to each wheel
    angle_rad : (wheels,) of each wheel's place, from the x axis

    Examples
    --------
    >>> positions_m, direction_rad = wheels_on_circle(0.125, np.radians([60.0, 180.0, 300.0]))
    >>> positions_m.round(3).tolist(), np.degrees(direction_rad).round().tolist()
    ([[0.063, 0.108], [-0.125, 0.0], [0.063, -0.108]], [150.0, 270.0, 390.0])
    """
    angle = finite_numbers("angle_rad", angle_rad)
    positions_m = distance_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return positions_m, angle + np.pi / 2


def rolling_matrix(positions_m: Array, direction_rad: Array) -> Array:
    """Return J (wheels, 3): circumferential speeds of wheels that roll without slip are J times the twist.

    Raises
    ------
    ConfigError
        for shapes that do not fit, values that are not finite, or fewer than three wheels.

    Examples
    --------
    >>> rolling_matrix([[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0]], np.radians([90.0, 180.0, 270.0])).round(2) + 0.0
    array([[ 0. ,  1. ,  0.1],
           [-1. ,  0. ,  0.1],
           [ 0. , -1. ,  0.1]])
    """
    positions = wheel_positions(positions_m)
    direction = finite_numbers("direction_rad", direction_rad, len(positions))
    if direction.ndim != 1 or len(positions) < 3:
        raise ConfigError(
            f"direction_rad has shape {direction.shape}, (wheels,) with three wheels or more is required"
        )
    (x_m, y_m), cos, sin = positions.T, np.cos(direction), np.sin(direction)
    return np.stack([cos, sin, x_m * sin - y_m * cos], axis=-1)


def inverse(positions_m: Array, direction_rad: Array, twist: Array) -> Array:
    """Return the circumferential speed (..., wheels) of wheels that follow a twist (..., 3) without slip.

    Raises
    ------
    ConfigError
        as :func:`rolling_matrix`, and for a twist that is not finite.
    """
    return np.asarray(finite_numbers("twist", twist, 3) @ rolling_matrix(positions_m, direction_rad).T)


def forward(positions_m: Array, direction_rad: Array, wheel_speed_mps: Array) -> tuple[Array, Array]:
    """Return the twist that fits the wheels best, and how far they contradict each other.

    Parameters
    ----------
    positions_m : (wheels, 2)
    direction_rad : (wheels,) in which each drives
    wheel_speed_mps : (..., wheels) circumferential; NaN is a missing sample

    Returns
    -------
    twist : (..., 3) least squares; NaN where a sample is missing
    residual_mps : (...) norm over the wheels of what no twist explains: of three wheels always 0

    Raises
    ------
    ConfigError
        as :func:`rolling_matrix`, for infinite speeds, and if the wheels do not determine the twist.

    Examples
    --------
    >>> place = wheels_on_circle(0.125, np.radians([60.0, 180.0, 300.0]))
    >>> twist, residual_mps = forward(*place, [0.025, 0.025, 0.025])
    >>> twist.round(3) + 0.0, residual_mps.round(3)
    (array([0. , 0. , 0.2]), np.float64(0.0))
    """
    rows = rolling_matrix(positions_m, direction_rad)
    speed = finite_numbers("wheel_speed_mps", wheel_speed_mps, len(rows), missing=True)
    size_m = np.linalg.norm(wheel_positions(positions_m), axis=1).max()
    if not np.linalg.cond(rows / [1.0, 1.0, size_m]) < MAX_CONDITION:
        raise ConfigError(
            "the wheels do not determine the twist: their drive directions allow a motion of none"
        )
    twist = speed @ np.linalg.pinv(rows).T
    return twist, np.linalg.norm(speed - twist @ rows.T, axis=-1)
