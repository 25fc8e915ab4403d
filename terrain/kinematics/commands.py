"""Commands for the wheels that drive desired twists, of every drive, within what motors and steering can do.

The wheels of a swerve robot of radius r are all driven and steered; with the velocities p_i' of their centres::

    rolling without slip      p_i' = r w_i (cos d_i, sin d_i)                            (2.1)
    wheels for a twist        d_i = atan2(p_iy', p_ix') + k pi, w_i = (-1)^k |p_i'| / r  (2.5)
    no motor saturates        |p_i'| <= r w_max of every wheel                           (2.6)-(2.10)

The admissible region is convex, but no polyhedron: each wheel bounds it by a cylinder.

Source: Danzi, AgriMaRo thesis, 2.3.  Corrected: (2.6)-(2.9) have ``y' + x_i g'`` and ``x' - y_i g'`` with each
wheel's own position.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from terrain.kernels import njit
from terrain.kinematics.wheels import point_velocity, rolling_matrix, velocity_matrix
from terrain.records import Array
from terrain.robots import BicycleRobot, Robot

STANDING_MPS = 1e-6  #: A wheel slower than this is at rest: below, its direction is rounding, no command
#: A wheel steered further than this from where it should be holds back the drive of all (20 degrees).
FAR_RAD = 0.35
# Signatures that any float array fits, read-only or strided: nothing is compiled in the middle of a drive.
_ROW = types.Array(types.float64, 1, "A", readonly=True)
_TABLE = types.Array(types.float64, 2, "A", readonly=True)
_F8 = types.float64


class WheelMotion(NamedTuple):
    """Commands for the wheels of a robot."""

    twist: Array  #: (n, 3) of the body, shortened where a wheel would saturate
    wheel_speed_mps: Array  #: (n, wheels) wheel circumferential speeds
    wheel_radps: Array  #: (n, wheels) the same as rates of the wheels
    steer_rad: Array  #: (n, wheels) steering angles; 0 without steering


def wheel_motion(robot: Robot, twist: Array, dt_s: float, steer_rad: Array | None = None) -> WheelMotion:
    """Return the commands with which a robot drives desired twists.

    Parameters
    ----------
    robot : a swerve robot with motors and steering; other robots without motors have no fastest speed
    twist : (n, 3) desired ``(speed_x_mps, speed_y_mps, yaw_rate_radps)``
    dt_s : time from one twist to the next
    steer_rad : (wheels,) of a swerve robot, commanded before; straight by default

    Raises
    ------
    ConfigError
        if the description of a swerve robot lacks a section.

    Notes
    -----
    A swerve robot: :func:`wheel_commands`.  A car-like robot of wheelbase L: ``tan d = L w / v`` in front within its
    limits, straight at rest, and the twist that it gives.  Others: the speeds along their wheels, of omni wheels
    shortened by what brings the fastest wheel to its limit, of sides each within what its motor can do.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> wheel_motion(load_robot("husky"), np.array([[0.5, 0.0, 1.0]]), 0.02).wheel_speed_mps
    array([[0.2146, 0.7854]])
    """
    radius_m = robot.wheel_radius_m
    if isinstance(robot, BicycleRobot):
        speed = np.clip(twist[:, 0], -robot.speed_max_mps, robot.speed_max_mps)
        curvature = np.divide(twist[:, 2], twist[:, 0], out=np.zeros(len(twist)), where=twist[:, 0] != 0.0)
        steer = np.arctan(robot.wheelbase_m * curvature)
        steer = np.clip(steer, -robot.steering_max_rad, robot.steering_max_rad)
        still = np.zeros_like(speed)
        speeds = np.column_stack([speed / np.cos(steer), speed])
        driven = np.column_stack([speed, still, speed * np.tan(steer) / robot.wheelbase_m])
        return WheelMotion(driven, speeds, speeds / radius_m, np.column_stack([steer, still]))
    if robot.steered:
        motors, steering = robot.motors, robot.steering
        limits = (motors.speed_max_radps, steering.rate_max_radps, dt_s)
        before = np.zeros(len(robot.wheels)) if steer_rad is None else steer_rad
        admitted, wheel_radps, steers = wheel_commands(
            robot.wheel_positions_m, radius_m, *limits, np.asarray(twist, float), before
        )
        return WheelMotion(admitted, wheel_radps * radius_m, wheel_radps, steers)
    place = robot.wheel_positions_m, robot.wheel_directions_rad, robot.roller_angles_rad
    speeds = twist @ rolling_matrix(*place).T
    limit = radius_m * robot.completed.motors.speed_max_radps
    if robot.sideways:
        over = np.maximum(np.abs(speeds).max(axis=1, keepdims=True) / limit, 1.0)
        twist, speeds = twist / over, speeds / over
    speeds = np.clip(speeds, -limit, limit)
    return WheelMotion(twist, speeds, speeds / radius_m, np.zeros_like(speeds))


@njit(types.UniTuple(_F8[::1], 3)(_TABLE, _F8, _F8, _F8, _F8, _ROW, _ROW))
def wheel_command_step(
    positions_m: Array,
    radius_m: float,
    speed_max_radps: float,
    rate_max_radps: float,
    dt_s: float,
    twist: Array,
    steer_rad: Array,
) -> tuple[Array, Array, Array]:
    """Return the commands of the wheels for one twist; compiled, callable from compiled code, checks nothing.

    The twist is shortened to the admissible region, (2.10): its direction is kept, so the centre of rotation and the
    path are.  Each wheel aims by (2.5) with the k that moves the steering least: angles are not wrapped, as slip rings
    let the steering turn for ever, and a wheel that stands still keeps its steering.  The steering moves there no
    faster than it can. While it moves, the wheels' rolling directions contradict each other: as long as one wheel is
    further than :data:`FAR_RAD` from its aim, the speeds of all are multiplied by ``max(0, cos(error))`` of the worst
    one, so that none scrubs. The thesis gives no such law; it says only that steering takes time.

    Parameters
    ----------
    positions_m, radius_m : (wheels, 2) and radius of the wheels
    speed_max_radps, rate_max_radps : limits of the wheels, to which twists are shortened, and of the steering's rate
    dt_s : time from one twist to the next
    twist, steer_rad : (3,) desired, and (wheels,) the steering commanded before

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
        ahead, left, aim = scale * along[i], scale * across[i], steer_rad[i]
        speed_mps = math.hypot(ahead, left)
        speed[i] = 0.0
        if speed_mps >= STANDING_MPS:
            heading = math.atan2(left, ahead)
            k = np.rint((heading - steer_rad[i]) / math.pi)
            speed[i], aim = (1.0 if k % 2 == 0 else -1.0) * speed_mps / radius_m, heading - k * math.pi
        move = aim - steer_rad[i]
        steer[i] = aim if abs(move) <= reach else steer_rad[i] + math.copysign(reach, move)
        worst = max(worst, abs(aim - steer[i]))
    if worst > FAR_RAD:
        for i in range(wheels):
            speed[i] *= max(0.0, math.cos(worst))
    return admitted, speed, steer


@njit(types.UniTuple(_F8[:, ::1], 3)(_TABLE, _F8, _F8, _F8, _F8, _TABLE, _ROW))
def wheel_commands(
    positions_m: Array,
    radius_m: float,
    speed_max_radps: float,
    rate_max_radps: float,
    dt_s: float,
    twists: Array,
    steer_0: Array,
) -> tuple[Array, Array, Array]:
    """Return the commands of the wheels, (n, ...) of :func:`wheel_command_step`, to drive twists (n, 3).

    Examples
    --------
    >>> wheels_m, twists = np.array([[-0.5, 0.0], [0.5, 0.0]]), np.tile([0.0, 0.4, 0.0], (9, 1))
    >>> _, wheel, steer = wheel_commands(wheels_m, 0.2, 10.0, 2.0, 0.1, twists, np.zeros(2))
    >>> steer[:, 0].round(2)
    array([0.2 , 0.4 , 0.6 , 0.8 , 1.  , 1.2 , 1.4 , 1.57, 1.57])
    >>> wheel[:, 0].round(2)
    array([0.4 , 0.78, 1.13, 1.43, 1.68, 1.86, 2.  , 2.  , 2.  ])
    """
    n, wheels = len(twists), len(positions_m)
    admitted, speed, steer = np.empty((n, 3)), np.empty((n, wheels)), np.empty((n, wheels))
    last = steer_0.copy()
    for k in range(n):
        admitted[k], speed[k], last = wheel_command_step(
            positions_m, radius_m, speed_max_radps, rate_max_radps, dt_s, twists[k], last
        )
        steer[k] = last
    return admitted, speed, steer


def scaled(positions_m: Array, radius_m: float, twist: Array, speed_max_radps: float) -> Array:
    """Return twists (..., 3) in their own direction, shortened until no wheel saturates, (2.10).

    Examples
    --------
    >>> scaled(np.array([[-0.5, 0.0], [0.5, 0.0]]), 0.2, np.array([2.4, 0.0, 3.6]), 10.0)
    array([1.6, 0. , 2.4])
    """
    desired = np.asarray(twist, dtype=np.float64)
    velocities = (desired @ velocity_matrix(positions_m).T).reshape(*desired.shape[:-1], -1, 2)
    limit_mps = radius_m * speed_max_radps
    fastest_mps = np.maximum(np.linalg.norm(velocities, axis=-1).max(axis=-1), limit_mps)
    return np.asarray(desired * (limit_mps / fastest_mps)[..., None])
