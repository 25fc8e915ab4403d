"""Commands for the wheels that drive desired twists, of every drive, within what motors and steering can do.

The wheels of a swerve robot of radius r are all driven and steered; with the velocities p_i' of their centres::

    rolling without slip      p_i' = r w_i (cos d_i, sin d_i)                            (2.1)
    wheels for a twist        d_i = atan2(p_iy', p_ix') + k pi, w_i = (-1)^k |p_i'| / r  (2.5)
    no motor saturates        |p_i'| <= r w_max of every wheel                           (2.6)-(2.10)

The admissible region is convex, but no polyhedron: each wheel bounds it by a cylinder.

Source: Danzi, AgriMaRo thesis, 2.3.  Corrected: (2.6)-(2.9) have ``y' + x_i g'`` and ``x' - y_i g'`` with each
wheel's own position.  Functions check what they are given; :func:`wheel_command_step` alone trusts it.
"""

from __future__ import annotations

import math
from functools import singledispatch
from typing import NamedTuple

import numpy as np
from numba import types

from terrain.errors import ConfigError
from terrain.kernels import njit
from terrain.kinematics.wheels import (
    above_zero,
    broadcast,
    finite_numbers,
    point_velocity,
    wheel_frame_velocities,
    wheel_positions,
    wheel_velocities,
)
from terrain.records import Array
from terrain.robots import BicycleRobot, OmniRobot, Robot, SkidSteerRobot, SwerveRobot

STANDING_MPS = 1e-6
"""A wheel slower than this is at rest: below, its direction is rounding, no command."""

FAR_RAD = 0.35
"""A wheel steered further than this from where it should be holds back the drive of all (20 degrees)."""

# Signatures that any float array fits, read-only or strided: nothing is compiled in the middle of a drive.
_ROW = types.Array(types.float64, 1, "A", readonly=True)
_TABLE = types.Array(types.float64, 2, "A", readonly=True)
_F8 = types.float64


class WheelMotion(NamedTuple):
    """Commands for the wheels of a robot.

    Parameters
    ----------
    twist : (n, 3) of the body, shortened where a wheel would saturate
    wheel_speed_mps : (n, wheels) wheel circumferential speeds
    wheel_radps : (n, wheels) the same as rates of the wheels
    steer_rad : (n, wheels) steering angles; 0 without steering
    """

    twist: Array
    wheel_speed_mps: Array
    wheel_radps: Array
    steer_rad: Array


@singledispatch
def wheel_motion(robot: Robot, twist: Array, dt_s: float) -> WheelMotion:
    """Return the commands with which a robot drives desired twists, its steering straight at the start.

    Parameters
    ----------
    robot : a swerve robot with motors and steering; other robots without motors have no fastest speed
    twist : (n, 3) desired ``(speed_x_mps, speed_y_mps, yaw_rate_radps)``
    dt_s : time from one twist to the next

    Raises
    ------
    ConfigError
        if the description of a swerve robot lacks a section.

    Notes
    -----
    A swerve robot: :func:`wheel_commands`.  A skid-steer robot of track B: ``v_left = v - w B / 2``,
    ``v_right = v + w B / 2``, each within what its motor can do.  An omni robot: speeds along its wheels, shortened
    by what brings the fastest wheel to its limit.  A car-like robot of wheelbase L: ``tan d = L w / v`` in front
    within its limits, straight at rest, and the twist that it gives.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> wheel_motion(load_robot("husky"), np.array([[0.5, 0.0, 1.0]]), 0.02).wheel_speed_mps
    array([[0.2146, 0.7854]])
    """
    raise ConfigError(f"robot {robot.name}: no kinematics are known for the drive {robot.drive!r}")


@wheel_motion.register
def _(robot: SwerveRobot, twist: Array, dt_s: float) -> WheelMotion:
    admitted, wheel_radps, steer_rad = wheel_commands(
        robot.wheel_positions_m,
        robot.wheel_radius_m,
        robot.motors.speed_max_radps,
        robot.steering.rate_max_radps,
        dt_s,
        twist,
        np.zeros(len(robot.wheels)),
    )
    return WheelMotion(admitted, wheel_radps * robot.wheel_radius_m, wheel_radps, steer_rad)


@wheel_motion.register(SkidSteerRobot)
@wheel_motion.register(OmniRobot)
def _(robot: Robot, twist: Array, dt_s: float) -> WheelMotion:
    speeds, _ = wheel_frame_velocities(twist, robot.wheel_positions_m, robot.wheel_directions_rad)
    limit = robot.wheel_radius_m * robot.completed.motors.speed_max_radps
    if robot.sideways:
        over = np.maximum(np.abs(speeds).max(axis=1, keepdims=True) / limit, 1.0)
        twist, speeds = twist / over, speeds / over
    speeds = np.clip(speeds, -limit, limit)
    return WheelMotion(twist, speeds, speeds / robot.wheel_radius_m, np.zeros_like(speeds))


@wheel_motion.register
def _(robot: BicycleRobot, twist: Array, dt_s: float) -> WheelMotion:
    speed = np.clip(twist[:, 0], -robot.speed_max_mps, robot.speed_max_mps)
    curvature = np.divide(twist[:, 2], twist[:, 0], out=np.zeros(len(twist)), where=twist[:, 0] != 0.0)
    steer = np.arctan(robot.wheelbase_m * curvature)
    steer = np.clip(steer, -robot.steering_max_rad, robot.steering_max_rad)
    steers, still = np.column_stack([steer, np.zeros_like(steer)]), np.zeros_like(speed)
    speeds = np.column_stack([speed / np.cos(steer), speed])
    driven = np.column_stack([speed, still, speed * np.tan(steer) / robot.wheelbase_m])
    return WheelMotion(driven, speeds, speeds / robot.wheel_radius_m, steers)


def inverse(positions_m: Array, radius_m: float, twist: Array, steer_now_rad: Array) -> tuple[Array, Array]:
    """Return wheel speeds and steering angles for a twist, equation (2.5).

    Of the two solutions of a wheel, half a turn apart, it is the one that moves the steering least.  Angles
    are not wrapped: slip rings let the steering turn for ever, and the result lies within a quarter turn of
    ``steer_now_rad``.  A wheel that stands still keeps its steering.

    Parameters
    ----------
    positions_m : (wheels, 2)
    radius_m : of the wheels
    twist : (..., 3)
    steer_now_rad : (..., wheels) where the steering is; broadcast against the twist

    Returns
    -------
    wheel_radps, steer_rad : (..., wheels)

    Raises
    ------
    ConfigError
        for shapes that do not fit, values that are not finite or a radius that is not above zero.

    Examples
    --------
    >>> inverse([[-0.5, 0.0], [0.5, 0.0]], 0.2, [-1.0, 0.0, 0.0], [0.0, 7.0])
    (array([-5., -5.]), array([0.        , 6.28318531]))
    """
    positions = wheel_positions(positions_m)
    radius = above_zero("radius_m", radius_m)
    velocity = wheel_velocities(positions, twist)
    now = finite_numbers("steer_now_rad", steer_now_rad, len(positions))
    along, across, now = broadcast(twist=velocity[..., 0], _=velocity[..., 1], steer_now_rad=now)
    speed, heading = np.hypot(along, across), np.arctan2(across, along)
    k = np.rint((heading - now) / np.pi)
    standing, sign = speed < STANDING_MPS, np.where(k % 2 == 0, 1.0, -1.0)
    return np.where(standing, 0.0, sign * speed / radius), np.where(standing, now, heading - k * np.pi)


def wheel_commands(
    positions_m: Array,
    radius_m: float,
    speed_max_radps: float,
    rate_max_radps: float,
    dt_s: float,
    twists: Array,
    steer_0: Array,
    far_rad: float = FAR_RAD,
) -> tuple[Array, Array, Array]:
    """Return the commands of the wheels, step by step, to drive a sequence of twists.

    Parameters
    ----------
    positions_m : (wheels, 2)
    radius_m : of the wheels
    speed_max_radps : limit of the wheels; twists beyond are shortened
    rate_max_radps : limit of the steering's rate
    dt_s : time from one twist to the next
    twists : (n, 3)
    steer_0 : (wheels,) steering before the first step, rad
    far_rad : see :func:`wheel_command_step`

    Returns
    -------
    twist_admitted : (n, 3) the twists within the admissible region
    wheel_radps, steer_rad : (n, wheels)

    Examples
    --------
    >>> wheels_m = [[-0.5, 0.0], [0.5, 0.0]]
    >>> _, wheel, steer = wheel_commands(wheels_m, 0.2, 10.0, 2.0, 0.1, [[0.0, 0.4, 0.0]] * 9, [0.0, 0.0])
    >>> steer[:, 0].round(2)
    array([0.2 , 0.4 , 0.6 , 0.8 , 1.  , 1.2 , 1.4 , 1.57, 1.57])
    >>> wheel[:, 0].round(2)
    array([0.4 , 0.78, 1.13, 1.43, 1.68, 1.86, 2.  , 2.  , 2.  ])
    """
    positions = wheel_positions(positions_m)
    desired = np.atleast_2d(finite_numbers("twists", twists, 3))
    if desired.ndim != 2:
        raise ConfigError(f"twists have shape {desired.shape}, (n, 3) is required")
    steer = finite_numbers("steer_0", steer_0, len(positions))
    if steer.ndim != 1:
        raise ConfigError(f"steer_0 has shape {steer.shape}, ({len(positions)},) is required")
    limits = {
        "radius_m": radius_m,
        "speed_max_radps": speed_max_radps,
        "rate_max_radps": rate_max_radps,
        "dt_s": dt_s,
        "far_rad": far_rad,
    }
    numbers = [above_zero(name, value) for name, value in limits.items()]
    return _commands(positions, *numbers, desired, steer)  # type: ignore[no-any-return]


@njit(types.UniTuple(_F8, 2)(_F8, _F8, _F8, _F8))
def _aim(along_mps: float, across_mps: float, radius_m: float, now_rad: float) -> tuple[float, float]:
    """Return speed and steering of one wheel, (2.5) with the k that moves the steering least."""
    speed_mps = math.hypot(along_mps, across_mps)
    if speed_mps < STANDING_MPS:
        return 0.0, now_rad
    heading_rad = math.atan2(across_mps, along_mps)
    k = np.rint((heading_rad - now_rad) / math.pi)
    sign = 1.0 if k % 2 == 0 else -1.0
    return sign * speed_mps / radius_m, heading_rad - k * math.pi


@njit(types.UniTuple(_F8[::1], 3)(_TABLE, _F8, _F8, _F8, _F8, _F8, _ROW, _ROW))
def wheel_command_step(
    positions_m: Array,
    radius_m: float,
    speed_max_radps: float,
    rate_max_radps: float,
    dt_s: float,
    far_rad: float,
    twist: Array,
    steer_rad: Array,
) -> tuple[Array, Array, Array]:
    """Return the commands of the wheels for one twist; compiled, callable from compiled code, checks nothing.

    The twist is shortened to the admissible region, each wheel aims (:func:`inverse`) from its last
    steering command, and the steering moves there no faster than it can. While it moves, the wheels'
    rolling directions contradict each other: as long as one wheel is further than ``far_rad`` from its aim,
    the speeds of all are multiplied by ``max(0, cos(error))`` of the worst one, so that none scrubs. The
    thesis gives no such law; it says only that steering takes time.

    Parameters
    ----------
    positions_m : (wheels, 2)
    radius_m, speed_max_radps, rate_max_radps, dt_s, far_rad : as in :func:`wheel_commands`
    twist : (3,)
    steer_rad : (wheels,) the last steering command

    Returns
    -------
    twist_admitted : (3,) within the admissible region; what the drive law takes away is not in it
    wheel_radps, steer_rad : (wheels,)
    """
    wheels = positions_m.shape[0]
    along, across = np.empty(wheels), np.empty(wheels)
    fastest = limit = radius_m * speed_max_radps
    for i in range(wheels):
        x_m, y_m = positions_m[i]
        along[i], across[i] = point_velocity(twist[0], twist[1], twist[2], x_m, y_m)
        fastest = max(fastest, math.hypot(along[i], across[i]))
    scale = limit / fastest
    admitted, speed, steer = np.empty(3), np.empty(wheels), np.empty(wheels)
    for j in range(3):
        admitted[j] = scale * twist[j]
    reach = rate_max_radps * dt_s
    worst = 0.0
    for i in range(wheels):
        speed[i], aim = _aim(scale * along[i], scale * across[i], radius_m, steer_rad[i])
        move = aim - steer_rad[i]
        steer[i] = aim if abs(move) <= reach else steer_rad[i] + math.copysign(reach, move)
        worst = max(worst, abs(aim - steer[i]))
    if worst > far_rad:
        for i in range(wheels):
            speed[i] *= max(0.0, math.cos(worst))
    return admitted, speed, steer


@njit(types.UniTuple(_F8[:, ::1], 3)(_TABLE, _F8, _F8, _F8, _F8, _F8, _TABLE, _ROW))
def _commands(
    positions_m: Array,
    radius_m: float,
    speed_max_radps: float,
    rate_max_radps: float,
    dt_s: float,
    far_rad: float,
    twists: Array,
    steer_0: Array,
) -> tuple[Array, Array, Array]:
    n, wheels = len(twists), len(positions_m)
    admitted, speed, steer = np.empty((n, 3)), np.empty((n, wheels)), np.empty((n, wheels))
    last = steer_0.copy()
    for k in range(n):
        admitted[k], speed[k], last = wheel_command_step(
            positions_m, radius_m, speed_max_radps, rate_max_radps, dt_s, far_rad, twists[k], last
        )
        steer[k] = last
    return admitted, speed, steer


def admissible_scale(positions_m: Array, radius_m: float, twist: Array, speed_max_radps: float) -> Array:
    """Return the largest k (...), at most 1, with which ``k * twist`` saturates no wheel, (2.10).

    Examples
    --------
    >>> admissible_scale([[-0.5, 0.0], [0.5, 0.0]], 0.2, [[4.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 10.0)
    array([0.5, 1. ])
    """
    limit_mps = above_zero("radius_m", radius_m) * above_zero("speed_max_radps", speed_max_radps)
    velocity = wheel_velocities(positions_m, twist)
    fastest_mps = np.hypot(velocity[..., 0], velocity[..., 1]).max(axis=-1)
    return np.asarray(limit_mps / np.maximum(fastest_mps, limit_mps))


def scaled(positions_m: Array, radius_m: float, twist: Array, speed_max_radps: float) -> Array:
    """Return the twist (..., 3) in its own direction, shortened until no wheel saturates.

    The direction is kept, so the centre of rotation and the path are: the robot is slower on the same curve.

    Examples
    --------
    >>> scaled([[-0.5, 0.0], [0.5, 0.0]], 0.2, [2.4, 0.0, 3.6], 10.0)
    array([1.6, 0. , 2.4])
    """
    scale = admissible_scale(positions_m, radius_m, twist, speed_max_radps)
    return np.asarray(np.asarray(twist, dtype=np.float64) * scale[..., None])


def admissible_yaw_rate(
    positions_m: Array, radius_m: float, speed_x_mps: Array, speed_y_mps: Array, speed_max_radps: float
) -> tuple[Array, Array]:
    """Return the lowest and the highest yaw rate (...) that saturate no wheel at a given translation.

    The boundary of the admissible region: with v_max = r w_max, (2.6) corrected asks of every wheel
    ``(x_i^2 + y_i^2) g'^2 + 2 (x_i v_y - y_i v_x) g' + v_x^2 + v_y^2 - v_max^2 <= 0``, an interval of g'.
    Figure 2.8 and its dimensionless twist (2.11) come of positions in half wheelbases, radius and limit 1.

    Parameters
    ----------
    positions_m : (wheels, 2)
    radius_m : of the wheels
    speed_x_mps, speed_y_mps : (...) broadcast against each other
    speed_max_radps : limit of the wheels

    Returns
    -------
    low_radps, high_radps : (...); NaN where no yaw rate is admissible

    Examples
    --------
    >>> xi = 1.5  # track over half the wheelbase
    >>> admissible_yaw_rate([[-1, 0], [1, 0], [0, -xi]], 1.0, [0.0, 0.7], 0.0, 1.0)
    (array([-0.66666667, -0.71414284]), array([0.66666667, 0.2       ]))
    """
    positions = wheel_positions(positions_m)
    limit_mps = above_zero("radius_m", radius_m) * above_zero("speed_max_radps", speed_max_radps)
    x_mps, y_mps = broadcast(
        speed_x_mps=finite_numbers("speed_x_mps", speed_x_mps),
        speed_y_mps=finite_numbers("speed_y_mps", speed_y_mps),
    )
    x, y = positions.T
    square = x * x + y * y
    across = x * y_mps[..., None] - y * x_mps[..., None]
    away = x * x_mps[..., None] + y * y_mps[..., None]
    # across^2 + away^2 = square * speed^2 turns the discriminant into one that cancels nothing
    inside = square * limit_mps**2 - away**2
    # a wheel at the origin does not feel the yaw rate: it bounds the translation alone
    free = np.where(np.hypot(x_mps, y_mps) <= limit_mps, np.inf, np.nan)[..., None]
    root = np.sqrt(np.where(inside >= 0, inside, np.nan))
    pivot = np.where(square > 0, square, 1.0)
    low = np.where(square > 0, (-across - root) / pivot, -free).max(axis=-1)
    high = np.where(square > 0, (-across + root) / pivot, free).min(axis=-1)
    return np.where(low <= high, low, np.nan), np.where(low <= high, high, np.nan)
