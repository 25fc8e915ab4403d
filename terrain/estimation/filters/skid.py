"""The filter of a skid-steer robot that has wheels and a gyro, and nothing that sees the ground go by.

Wheels of a side turn together at v_left, v_right; v is their mean, D = v_right - v_left their difference, w
the yaw rate, B the effective track, b the gyro's bias::

    wheel_left = v - D / 2      wheel_right = v + D / 2      gyro = w + b      (at rest)  gyro = b

A skid-steer robot turns by sliding, so that B is not the distance of its wheels but 1.5 to 2 times that
(Mandow et al., Experimental kinematics for wheeled skid-steer mobile robots, IROS 2007).  D is measured, and
what it says of w is only as good as the slip of the sides.  So w is no function of D but follows it::

    dw/dt = a (D / B - w) / T + n

with the time T in which wheels turn a body, and white noise n of q rad/s a root second.  Solved for D / B,
the wheels measure the yaw rate with white noise of q T / a: a is how much they are believed.  It falls with

- the size of D, since slip is a part of it: q T / a has a part of q T and one that grows with D / B_0, where
  B_0 is the described track;
- the disagreement e of wheels and yaw rate: how far w is outside of D / (4 B_0) to D / B_0, which a track
  from B_0 to 4 B_0 explains::

    a = 1 / (1 + (e / e_0)^2) / sqrt(1 + (D / B_0 / w_0)^2)

a is taken as a constant of each step, as the weights of a robust regression are.  Wheels that spin without
turning the robot thus say nothing on the gyro's bias, which its own prior, driving straight and standing
still (:mod:`terrain.estimation.feed`) determine.  Without a gyro w still follows the
wheels, as slowly as they are believed.

What is missing is the slip that both sides share: v is the speed of the wheels.  The filter has no reference
of the speed over ground, ``reference_age_s`` of its track is infinite, and so slip is unknown, not zero.
"""

from __future__ import annotations

import math

import numpy as np

from terrain.estimation.feed import REST_ROW, SIDE_ROWS
from terrain.estimation.filter import OBSERVE, PROPAGATE, FilterModel, Noise
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import Robot, SkidSteerRobot, as_drive

MIN_TURN_RADPS = 0.15
"""Wheels that differ by less, over the described track, show nothing of the effective one: D is noise."""

MAX_TRACK_RATIO = 4.0
"""Largest effective track over the described one; twice what is usual on firm ground (Mandow et al. 2007)."""

MAX_BIAS_RADPS = 0.06
"""Largest bias of a gyro, 3.4 degrees a second: seven times what makers of IMUs allow themselves."""

BIAS_STD_RADPS = 0.005
"""How little is known of the bias: a gyro of a robot's IMU repeats within 0.5 degrees a second from start to
start (Xsens, Bias repeatability of gyroscopes, knowledge base), 0.3 as a standard deviation."""

FOLLOWS_S = 0.055
"""T: times q it is what the wheels of a straight drive on firm ground are worth, 0.03 rad/s a root second."""

DISAGREEMENT_RADPS = 0.02
"""e_0: more than the gyro's noise, less than the yaw rates that bumps and ruts cause."""

SLIP_TURN_RADPS = 0.15
"""w_0: where slip makes the wheels half as good as when driving straight."""

_STATES = (
    *("position_x_m", "position_y_m", "yaw_rad", "speed_mps", "yaw_rate_radps"),
    *("effective_track_m", "gyro_bias_radps", "wheel_difference_mps"),
)
WHEELS_AND_GYRO = (*SIDE_ROWS, "gyro_z_radps")
"""Rows of the table that the filter takes beside that of rest."""

_ROWS = (*WHEELS_AND_GYRO, REST_ROW)
_X, _Y, _YAW, _V, _W, _TRACK, _BIAS, _DIFFERENCE = range(8)


@njit
def wheel_weight(yaw_rate_radps: float, difference_mps: float, track_m: float) -> float:
    """Return a, from 0 to 1: how much a difference of the sides is believed beside a yaw rate.

    Parameters
    ----------
    yaw_rate_radps : w
    difference_mps : D, right less left
    track_m : B_0, the described track

    Examples
    --------
    >>> round(wheel_weight(0.0, 0.0, 0.57), 3), round(wheel_weight(0.0, 0.3, 0.57), 3)
    (1.0, 0.006)
    """
    turn = difference_mps / track_m
    least = turn / MAX_TRACK_RATIO
    apart = yaw_rate_radps - min(max(yaw_rate_radps, min(turn, least)), max(turn, least))
    slip = math.sqrt(1.0 + (turn / SLIP_TURN_RADPS) ** 2)
    return 1.0 / (1.0 + (apart / DISAGREEMENT_RADPS) ** 2) / slip


@njit(PROPAGATE)
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
    described = params[0]
    track = min(max(x[_TRACK], described), MAX_TRACK_RATIO * described)
    x_next[_TRACK] = track  # bounds move the mean, the covariance stays
    x_next[_BIAS] = min(max(x[_BIAS], -MAX_BIAS_RADPS), MAX_BIAS_RADPS)
    weight = wheel_weight(x[_W], x[_DIFFERENCE], described)
    near = 1.0 - math.exp(-weight * dt / FOLLOWS_S)
    x_next[_W] += near * (x[_DIFFERENCE] / track - x[_W])
    f[_W, _W], f[_W, _DIFFERENCE] = 1.0 - near, near / track
    if abs(x[_DIFFERENCE]) >= MIN_TURN_RADPS * described:
        f[_W, _TRACK] = -near * x[_DIFFERENCE] / track**2


@njit(OBSERVE)
def _observe(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    for row, side in ((0, -0.5), (1, 0.5)):
        z_hat[row] = x[_V] + side * x[_DIFFERENCE]
        h[row, _V], h[row, _DIFFERENCE] = 1.0, side
    z_hat[2] = x[_W] + x[_BIAS]
    h[2, _W], h[2, _BIAS] = 1.0, 1.0
    z_hat[3] = x[_BIAS]
    h[3, _BIAS] = 1.0


def within_bounds(mean: Array, track_m: float) -> Array:
    """Return states (..., 8) with the effective track and the bias in the bounds of the next prediction.

    Parameters
    ----------
    mean : (..., 8) states, as a measurement left them
    track_m : B_0, the described track
    """
    bounded = np.array(mean)
    bounded[..., _TRACK] = np.clip(mean[..., _TRACK], track_m, MAX_TRACK_RATIO * track_m)
    bounded[..., _BIAS] = np.clip(mean[..., _BIAS], -MAX_BIAS_RADPS, MAX_BIAS_RADPS)
    return bounded


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
    as_drive(SkidSteerRobot, robot, "robot {name} has the drive {drive!r}: this filter is for 'skid_steer'")
    mean = np.zeros(len(_STATES))
    mean[_TRACK] = robot.track_m
    sensors = ("wheel_left", "wheel_right", "gyro", "rest")
    return FilterModel(
        name="skid",
        states=_STATES,
        rows=_ROWS,
        sensors=tuple((sensor, (row,)) for sensor, row in zip(sensors, _ROWS, strict=True)),
        propagate=_propagate,
        observe=_observe,
        params=np.array([robot.track_m]),
        initial_std=np.array([1e-3, 1e-3, 1e-3, 1.0, 0.5, robot.track_m, BIAS_STD_RADPS, 1.0]),
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
    walk_std = np.array([1e-2, 1e-2, 1e-3, 0.5, 0.6, 0.02, 2e-4, 1.0])
    return Noise(walk_std**2, np.array([0.06, 0.06, 0.01, 0.002]) ** 2, model.initial_std**2)
