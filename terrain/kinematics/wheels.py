"""Kinematics of wheels, of every drive: the velocity of each for a twist, and the twist for all of them.

With the body's velocity ``(v_x, v_y)`` at its origin, its yaw rate g', and wheel i at ``(x_i, y_i)`` that drives
along ``d_i``, all in body axes, the angle of its steering or that of an omni wheel's mounting::

    velocity of its centre    p_i' = (v_x - y_i g', v_y + x_i g')                        (2.2)
    along the wheel           p_ix' cos d_i + p_iy' sin d_i
    across it, to the left    p_iy' cos d_i - p_ix' sin d_i

The ground holds a wheel with rollers along the axis of the one that touches it alone, at an angle g_i from d_i; with
the velocity along that axis a wheel that rolls there has ``u_i cos g_i = p_ix' cos(d_i + g_i) + p_iy' sin(d_i + g_i)``:
an omni wheel's g_i is 0, a mecanum wheel's usually 45 degrees to a side.

Where a wheel rolls without slip, the first is its circumferential speed u_i, which for all of them is ``u = J V``;
the second is 0, but of an omni wheel, whose rollers turn with it.  The twist of wheels that contradict each other is
that of least squares over all these rows, which for wheels that do not roll across is ``V = H^+ S(d) u`` (2.3, 2.4).

A twist is an array ``(..., 3)`` ordered ``(speed_x_mps, speed_y_mps, yaw_rate_radps)`` everywhere here.

Sources: Danzi, AgriMaRo thesis, 2.3 and (7.3)-(7.5).  Corrected: it puts the yaw rate first, and the columns of its
H are reordered accordingly; one table of wheel positions, ``robot.wheel_positions_m`` (its 7.2), because (2.3)
numbers the wheels of the x axis in the opposite order; rows of H are ``[-y_i 1 0; x_i 0 1]``; S is block-diagonal,
6 x 3.  Omni wheels: Siegwart, Nourbakhsh, Scaramuzza, Introduction to Autonomous Mobile Robots, 3.2.3: the Swedish
wheel with rollers at a right angle, and at any other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import register_jitable

from terrain.errors import ConfigError
from terrain.records import Array

#: Of the matrix from twist to wheel speeds, lengths over the size of the robot: beyond, directions agree.
MAX_CONDITION = 1e6
#: Steering angle of a car-like robot at the most, where its tangent is 3.6: a larger one is a reading that is off.
STEEPEST_RAD = 1.3


def finite_numbers(name: str, given: Any, size: int, missing: bool = False) -> Array:
    """Return ``given`` as an array of finite floats with ``size`` columns; NaN too where samples may miss."""
    try:
        array = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{name} cannot be read as an array of numbers") from None
    if array.shape[-1:] != (size,):
        raise ConfigError(f"{name} has shape {array.shape}, (..., {size}) is required")
    bad = np.isinf(array) if missing else ~np.isfinite(array)
    if bad.any():
        raise ConfigError(f"{name} holds {array[bad].flat[0]}, finite numbers are required")
    return array


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


def wheel_frame_velocities(twist: Array, positions_m: Array, direction_rad: Array) -> tuple[Array, Array]:
    """Return the velocities (n, wheels) along each wheel and across it of twists (n, 3), positions and directions."""
    forward, left = point_velocity(twist[:, 0:1], twist[:, 1:2], twist[:, 2:3], *positions_m.T)
    return in_wheel_frame(forward, left, np.cos(direction_rad), np.sin(direction_rad))


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


def rolling_matrix(positions_m: Array, direction_rad: Array, roller_rad: Array | float = 0.0) -> Array:
    """Return J (..., wheels, 3): circumferential speeds of wheels that roll without slip are J times the twist.

    Parameters
    ----------
    positions_m, direction_rad : (wheels, 2), and (..., wheels) that each drives along
    roller_rad : from there to the axis of its rollers, of each or all

    Examples
    --------
    >>> rolling_matrix([[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0]], np.radians([90.0, 180.0, 270.0])).round(2) + 0.0
    array([[ 0. ,  1. ,  0.1],
           [-1. ,  0. ,  0.1],
           [ 0. , -1. ,  0.1]])
    """
    positions = finite_numbers("positions_m", positions_m, 2)
    direction = finite_numbers("direction_rad", direction_rad, len(positions), missing=True)
    axis, (x_m, y_m) = direction + roller_rad, positions.T
    cos, sin = np.cos(axis), np.sin(axis)
    return np.stack([cos, sin, x_m * sin - y_m * cos], axis=-1) / np.cos(roller_rad + 0.0 * axis)[..., None]


def no_slip_twist(
    positions_m: Array,
    direction_rad: Array,
    wheel_speed_mps: Array,
    rolls_across: bool = False,
    roller_rad: Array | float = 0.0,
) -> tuple[Array, Array]:
    """Return the twist that fits wheels which do not slip best, and how far they contradict each other.

    Parameters
    ----------
    positions_m : (wheels, 2)
    direction_rad : (..., wheels) that each drives along
    wheel_speed_mps : (..., wheels) circumferential; NaN, here or there, is a missing sample
    rolls_across : whether wheels roll across their direction too, as omni wheels; others do not move there
    roller_rad : as :func:`rolling_matrix` takes it

    Returns
    -------
    twist : (..., 3) least squares; NaN where a sample is missing
    residual_mps : (...) norm over the rows of what no twist explains: of three omni wheels always 0

    Raises
    ------
    ConfigError
        for shapes that do not fit, infinite values, and if the wheels do not determine the twist.

    Examples
    --------
    >>> twist, residual_mps = no_slip_twist([[-0.5, 0.0], [0.5, 0.0]], [-0.1, 0.1], [1.0, 1.0])
    >>> twist.round(3) + 0.0, residual_mps.round(3)
    (array([0.995, 0.   , 0.2  ]), np.float64(0.0))
    """
    rows = rolling_matrix(positions_m, direction_rad, roller_rad)
    speed = finite_numbers("wheel_speed_mps", wheel_speed_mps, rows.shape[-2], missing=True)
    if not rolls_across:
        across = rolling_matrix(positions_m, np.asarray(direction_rad) + np.pi / 2)
        rows, speed = np.concatenate([rows, across], axis=-2), np.concatenate([speed, 0.0 * speed], axis=-1)
    size_m = np.linalg.norm(positions_m, axis=-1).max()
    known = np.nan_to_num(rows)[np.isfinite(rows).all(axis=(-2, -1))] / [1.0, 1.0, size_m or 1.0]
    if rows.shape[-2] < 3 or not (np.linalg.cond(known) < MAX_CONDITION).all():
        raise ConfigError(
            "the wheels do not determine the twist: their drive directions allow a motion of none"
        )
    square, seen = np.swapaxes(rows, -2, -1) @ rows, np.einsum("...ij,...i->...j", rows, speed)
    twist = np.linalg.solve(square, seen[..., None])[..., 0]
    return twist, np.linalg.norm(speed - np.einsum("...ij,...j->...i", rows, twist), axis=-1)


def rolled_twist(robot: Any, wheel_speed_mps: Array, steer_rad: Array) -> Array:
    """Return the twist (n, 3) that the wheels of a robot of any drive would roll without slip, as it is described.

    Parameters
    ----------
    robot : :class:`terrain.robots.Robot`
    wheel_speed_mps : (n, wheels) circumferential, of a car-like robot (n, 1) of the driven axle, too
    steer_rad : (n, wheels) zeros taken off; not looked at without steering

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> rolled_twist(load_robot("husky"), np.array([[0.4, 0.6]]), np.zeros((1, 2))).round(3)
    array([[0.5 , 0.  , 0.35]])
    """
    if robot.on_omni_wheels:
        place = robot.wheel_positions_m, robot.wheel_directions_rad, robot.roller_angles_rad
        return np.asarray(wheel_speed_mps @ np.linalg.pinv(rolling_matrix(*place)).T)
    if robot.sideways:
        return no_slip_twist(
            robot.wheel_positions_m, steer_rad + robot.wheel_directions_rad, wheel_speed_mps
        )[0]
    out = np.zeros((len(wheel_speed_mps), 3))
    if robot.skids:
        left, right = wheel_speed_mps[:, 0], wheel_speed_mps[:, -1]
        out[:, 0], out[:, 2] = 0.5 * (left + right), (right - left) / robot.track_m
        return out
    angle = np.clip(steer_rad[:, 0], -STEEPEST_RAD, STEEPEST_RAD)
    out[:, 0] = wheel_speed_mps[:, 0] * np.cos(angle) if robot.front_driven else wheel_speed_mps[:, -1]
    out[:, 2] = out[:, 0] * np.tan(angle) / robot.wheelbase_m
    return out
