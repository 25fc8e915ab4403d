"""Kinematics of a robot whose wheels are all driven and steered: twist to wheels, wheels to twist, limits.

With wheel i at ``(x_i, y_i)``, steered by ``d_i`` and turning at ``w_i``, radius r::

    velocity of its centre    p_i' = (v_x - y_i g', v_y + x_i g')                        (2.2)
    rolling without slip      p_i' = r w_i (cos d_i, sin d_i)                            (2.1)
    all wheels                S(d) w = H V, V = H^+ S(d) w                               (2.3), (2.4)
    wheels for a twist        d_i = atan2(p_iy', p_ix') + k pi, w_i = (-1)^k |p_i'| / r  (2.5)

A twist is an array ``(..., 3)`` ordered ``(speed_x_mps, speed_y_mps, yaw_rate_radps)`` everywhere here; the
source puts the yaw rate first, and the columns of its H are reordered accordingly.

Source: Danzi, AgriMaRo thesis, 2.3.  Corrected: one table of wheel positions, ``robot.wheel_positions_m``
(its 7.2), because (2.3) numbers the wheels of the x axis in the opposite order; rows of H are
``[-y_i 1 0; x_i 0 1]``; S is block-diagonal, 6 x 3.  Limits: :mod:`terrain.kinematics.swerve_limits`.

Functions check what they are given; :func:`wheel_command_step` alone trusts it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from terrain.errors import ConfigError
from terrain.kinematics.arguments import above_zero, broadcast, finite_numbers, wheel_positions
from terrain.kinematics.wheel_velocity import point_velocity, velocity_matrix
from terrain.records import Array

STANDING_MPS = 1e-6
"""A wheel slower than this is at rest: below, its direction is rounding, no command."""

FAR_RAD = 0.35
"""A wheel steered further than this from where it should be holds back the drive of all (20 degrees)."""

# Signatures that any float array fits, read-only or strided: nothing is compiled in the middle of a drive.
_ROW = types.Array(types.float64, 1, "A", readonly=True)
_TABLE = types.Array(types.float64, 2, "A", readonly=True)
_F8 = types.float64


def wheel_velocities(positions_m: Array, twist: Array) -> Array:
    """Return the velocity (..., wheels, 2) of the wheel centres in the body frame, equation (2.2).

    Raises
    ------
    ConfigError
        if ``positions_m`` is no (wheels, 2), ``twist`` no (..., 3), or either is not finite.

    Examples
    --------
    >>> wheel_velocities([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.75]], [1.0, 0.0, 0.2])
    array([[ 1.  , -0.1 ],
           [ 1.  ,  0.1 ],
           [ 1.15,  0.  ]])
    """
    return _velocities(wheel_positions(positions_m), finite_numbers("twist", twist, 3))


def forward(positions_m: Array, radius_m: float, wheel_radps: Array, steer_rad: Array) -> tuple[Array, Array]:
    """Return the twist that fits the wheels best, and how far they contradict each other.

    Parameters
    ----------
    positions_m : (wheels, 2)
    radius_m : of the wheels
    wheel_radps, steer_rad : (..., wheels); NaN is a missing sample

    Returns
    -------
    twist : (..., 3) the least-squares solution (2.4); NaN where a sample is missing
    residual_mps : (...) norm of ``S w - H V`` over all wheels: 0 when a rigid body rolls without slip

    Raises
    ------
    ConfigError
        for shapes that do not fit, infinite values or a radius that is not above zero.

    Examples
    --------
    >>> twist, residual_mps = forward([[-0.5, 0.0], [0.5, 0.0]], 0.2, [5.0, 5.0], [-0.1, 0.1])
    >>> twist.round(3), residual_mps.round(3)
    (array([0.995, 0.   , 0.2  ]), np.float64(0.0))
    """
    positions = wheel_positions(positions_m)
    radius = above_zero("radius_m", radius_m)
    wheel = finite_numbers("wheel_radps", wheel_radps, len(positions), missing=True)
    steer = finite_numbers("steer_rad", steer_rad, len(positions), missing=True)
    wheel, steer = broadcast(wheel_radps=wheel, steer_rad=steer)
    wheel_speed = np.stack([np.cos(steer), np.sin(steer)], axis=-1) * (radius * wheel)[..., None]
    seen = wheel_speed.reshape(*wheel.shape[:-1], -1)
    rows = velocity_matrix(positions)
    twist = seen @ np.linalg.pinv(rows).T
    return twist, np.linalg.norm(seen - twist @ rows.T, axis=-1)


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
    velocity = _velocities(positions, finite_numbers("twist", twist, 3))
    now = finite_numbers("steer_now_rad", steer_now_rad, len(positions))
    along, across, now = broadcast(twist=velocity[..., 0], _=velocity[..., 1], steer_now_rad=now)
    wheel, steer = np.empty(now.shape), np.empty(now.shape)
    _aim_all(along.ravel(), across.ravel(), radius, now.ravel(), wheel.reshape(-1), steer.reshape(-1))
    return wheel, steer


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

    Raises
    ------
    ConfigError
        for shapes that do not fit, values that are not finite, limits that are not above zero.

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


@njit(types.UniTuple(_F8, 2)(_F8, _F8, _F8, _F8), cache=True)
def _aim(along_mps: float, across_mps: float, radius_m: float, now_rad: float) -> tuple[float, float]:
    """Return speed and steering of one wheel, (2.5) with the k that moves the steering least."""
    speed_mps = math.hypot(along_mps, across_mps)
    if speed_mps < STANDING_MPS:
        return 0.0, now_rad
    heading_rad = math.atan2(across_mps, along_mps)
    k = np.rint((heading_rad - now_rad) / math.pi)
    sign = 1.0 if k % 2 == 0 else -1.0
    return sign * speed_mps / radius_m, heading_rad - k * math.pi


@njit(types.void(_ROW, _ROW, _F8, _ROW, _F8[:], _F8[:]), cache=True)
def _aim_all(
    along_mps: Array, across_mps: Array, radius_m: float, now_rad: Array, wheel_radps: Array, steer_rad: Array
) -> None:
    for i in range(now_rad.size):
        wheel_radps[i], steer_rad[i] = _aim(along_mps[i], across_mps[i], radius_m, now_rad[i])


@njit(types.UniTuple(_F8[::1], 3)(_TABLE, _F8, _F8, _F8, _F8, _F8, _ROW, _ROW), cache=True)
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


@njit(types.UniTuple(_F8[:, ::1], 3)(_TABLE, _F8, _F8, _F8, _F8, _F8, _TABLE, _ROW), cache=True)
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


def _velocities(positions: Array, twist: Array) -> Array:
    flat = twist @ velocity_matrix(positions).T
    return np.asarray(flat.reshape(*flat.shape[:-1], len(positions), 2))
