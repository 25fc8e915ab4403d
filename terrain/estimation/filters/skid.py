"""The filter of a skid-steer robot that has wheels and a gyro, and nothing that sees the ground go by.

Wheels of a side turn together at v_left, v_right; v is the speed, w the yaw rate, B the effective track::

    wheel_left = v - w B / 2      wheel_right = v + w B / 2      gyro = w + b

A skid-steer robot turns by sliding, so that B is not the distance of its wheels but 1.5 to 2 times that
(Mandow et al., Experimental kinematics for wheeled skid-steer mobile robots, IROS 2007); it is a state, and
known as well as the robot has turned.  The gyro's bias b is distinguished from turning by the wheels, at the
latest when they stand.

What is missing is the slip that both sides share: v is the speed of the wheels.  The filter has no reference
of the speed over ground, ``reference_age_s`` of its track is infinite, and so slip is unknown, not zero.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.estimation.ekf.kernel import OBSERVE, PROPAGATE
from terrain.estimation.ekf.model import FilterModel, Noise
from terrain.records import Array
from terrain.robots import Robot, as_skid_steer

MIN_TURN_RADPS = 0.1
"""Slower turns tell nothing on the track: the product w B would take the noise of w for turning."""

_STATES = (
    *("position_x_m", "position_y_m", "yaw_rad", "speed_mps", "yaw_rate_radps"),
    *("effective_track_m", "gyro_bias_radps"),
)
_ROWS = ("wheel_left_mps", "wheel_right_mps", "gyro_z_radps")
_X, _Y, _YAW, _V, _W, _TRACK, _BIAS = range(7)


@njit(PROPAGATE, cache=True)
def _propagate(x: Array, dt: float, params: Array, x_next: Array, f: Array) -> None:
    cos, sin = math.cos(x[_YAW]), math.sin(x[_YAW])
    for i in range(x.size):
        x_next[i] = x[i]
        f[i, i] = 1.0
    x_next[_X] += dt * x[_V] * cos
    f[_X, _V], f[_X, _YAW] = dt * cos, -dt * x[_V] * sin
    x_next[_Y] += dt * x[_V] * sin
    f[_Y, _V], f[_Y, _YAW] = dt * sin, dt * x[_V] * cos
    x_next[_YAW] += dt * x[_W]
    f[_YAW, _W] = dt


@njit(OBSERVE, cache=True)
def _observe(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    turns = abs(x[_W]) >= MIN_TURN_RADPS
    for row, side in ((0, -0.5), (1, 0.5)):
        z_hat[row] = x[_V] + side * x[_W] * x[_TRACK]
        h[row, _V], h[row, _W] = 1.0, side * x[_TRACK]
        h[row, _TRACK] = side * x[_W] if turns else 0.0
    z_hat[2] = x[_W] + x[_BIAS]
    h[2, _W], h[2, _BIAS] = 1.0, 1.0


def make_skid_filter(robot: Robot) -> FilterModel:
    """Return the filter of a skid-steer robot; the effective track starts as the described one, hardly known.

    Raises
    ------
    ConfigError
        where the robot is of another kind.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> make_skid_filter(load_robot("husky")).references
    ()
    """
    as_skid_steer(robot, "robot {name} has the drive {drive!r}: this filter is for 'skid_steer'")
    mean = np.zeros(len(_STATES))
    mean[_TRACK] = robot.track_m
    return FilterModel(
        name="skid",
        states=_STATES,
        rows=_ROWS,
        sensors=(("wheel_left", _ROWS[:1]), ("wheel_right", _ROWS[1:2]), ("gyro", _ROWS[2:])),
        propagate=_propagate,
        observe=_observe,
        params=np.zeros(1),
        initial_std=np.array([1e-3, 1e-3, 1e-3, 1.0, 0.5, robot.track_m, 0.01]),
        initial_mean=mean,
        positions=_STATES[:2],
        angle_states=("yaw_rad",),
    )


def skid_noise(robot: Robot) -> Noise:
    """Return physical noise for :func:`make_skid_filter`: walks of a second, and what samples scatter by.

    Raises
    ------
    ConfigError
        as :func:`make_skid_filter` does.
    """
    model = make_skid_filter(robot)
    # Rows of wheels carry their slip in turns: with half of it they outvote the gyro on measured asphalt.
    walk_std = np.array([1e-2, 1e-2, 1e-3, 0.5, 1.0, 0.01, 2e-4])
    return Noise(walk_std**2, np.array([0.06, 0.06, 0.01]) ** 2, model.initial_std**2)
