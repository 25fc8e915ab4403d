"""Sideslip of a car-like robot from its pose alone: the extended kinematic model.

State: position and heading of the rear axle, and the slip angles of both axles, which have no equation of
their own (5); corrections (6) with the gains of the multi-model observer.  Equations, gains and what is done
with fixes: :mod:`terrain.estimation.observers.sideslip_pose`.  Without dynamics the slip follows fixes
only: it lags behind a bend or a slope by the time of its poles, 0.1 to 0.3 s.

Deremetz et al., ICRA 2017, (5), (6); Guillet et al. 2014.  Corrected: line 3 of (2) is the derivative of
theta~ (printed: of theta).  At rest J = 0 and the slip is as it was.
"""

from __future__ import annotations

import math

import numpy as np

from terrain.estimation.observers import sideslip_pose as pose
from terrain.estimation.observers.family import Observer, ObserverOutput, ObserverStatus
from terrain.estimation.observers.sideslip_pose import (
    HAS_POSITION,
    HAS_YAW,
    N_SHARED,
    SHARED_SIZE,
    SLIP_F,
    SLIP_R,
    SPEED,
    STANDING_MPS,
    STATUS,
    STEER,
    YAW,
    YAW_STD,
    X,
    Y,
    advance_pose,
    correct_by_fix,
    slip_jacobian,
    spread,
    status_of,
    take_inputs,
    yaw_rate_of,
)
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import BicycleRobot

SLIP_WALK = N_SHARED
COV = SHARED_SIZE
_N = 4
_UNKNOWN_STD_RAD = 0.15
"""A slip that is less certain is not known."""


def sideslip_kinematic_observer(
    robot: BicycleRobot,
    settings: pose.PoseSettings = pose.PoseSettings(),  # noqa: B008
    slip_walk_radps: float = 0.05,
) -> Observer:
    """Return the observer of the extended kinematic model.

    Parameters
    ----------
    robot : car-like
    settings : gains, noise and gates of fixes
    slip_walk_radps : change of a slip angle within a second, one standard deviation

    Raises
    ------
    ConfigError
        if a setting is not accepted.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.estimation.observers.family import observe
    >>> observer = sideslip_kinematic_observer(load_robot("adap2e"))
    >>> time_s, nan = np.arange(200) * 0.1, np.full(200, np.nan)
    >>> crab = np.column_stack([nan + 2.0, nan * 0.0, 2.0 * time_s, 0.1 * time_s, nan, nan, nan, nan])
    >>> crab[:, [0, 1, 4]] = 2.0, 0.0, 0.0  # straight ahead at 2 m/s, and 0.1 m/s sideways
    >>> observe(observer, time_s, crab).slip[-1].round(2)
    array([0.05, 0.05])
    """
    params = pose.shared_params(robot, settings, N_SHARED + 1)
    params[SLIP_WALK] = slip_walk_radps
    start = pose.shared_start(SHARED_SIZE + _N * _N)
    start[COV:].reshape(_N, _N)[2:, 2:] = np.eye(2) * 0.1**2
    states = ("position_x_m", "position_y_m", "yaw_rad")
    return Observer(
        "sideslip-kinematic", states, pose.SIDESLIPS, pose.SIDESLIP_ROWS, params, start, _step, _read
    )


@njit
def error_growth(params: Array, after: Array, size: int, dt_s: float) -> Array:
    """Return the transition (size, size) of errors of pose and slip over a tick."""
    grown = np.eye(size)
    grown[:2, 2:4] = dt_s * slip_jacobian(params, after[SPEED], after[STEER], after[SLIP_F], after[SLIP_R])
    return grown


@njit
def add_pose_noise(params: Array, after: Array, cov: Array, slip_walk: float, dt_s: float) -> None:
    """Add in place what the walk of the slip and the measured heading bring."""
    moved = abs(after[SPEED]) * dt_s
    cov[0, 0] += moved * abs(after[SPEED]) * pose.GAIN_TIME_S * params[YAW_STD] ** 2
    if abs(after[SPEED]) >= STANDING_MPS:
        cov[2, 2] = min(cov[2, 2] + slip_walk**2 * dt_s, 0.25)
        cov[3, 3] = min(cov[3, 3] + slip_walk**2 * dt_s, 0.25)


@njit
def predict_pose(params: Array, after: Array, dt_s: float) -> None:
    """Carry the pose on in place by the slip angles; a robot that stands stays."""
    speed = after[SPEED]
    if after[HAS_POSITION] == 0.0 or after[HAS_YAW] == 0.0 or abs(speed) < STANDING_MPS:
        speed = 0.0
    rate = yaw_rate_of(params, speed, after[STEER], after[SLIP_F], after[SLIP_R])
    advance_pose(after, speed, abs(speed) * math.tan(after[SLIP_R]), rate, dt_s)


@njit
def _step(params: Array, memory: Array, row: Array, dt_s: float) -> Array:
    after = memory.copy()
    if take_inputs(params, after, row, dt_s) != ObserverStatus.OK.value:
        return after
    cov = after[COV : COV + _N * _N].reshape(_N, _N)
    predict_pose(params, after, dt_s)
    if after[HAS_POSITION] == 1.0 and after[HAS_YAW] == 1.0 and dt_s > 0.0:
        spread(cov, error_growth(params, after, _N, dt_s))
        add_pose_noise(params, after, cov, params[SLIP_WALK], dt_s)
    after[STATUS] = status_of(memory, after, correct_by_fix(params, after, cov, row))
    return after


@njit
def set_slips(after: Array, slips: Array, std: Array) -> None:
    """Set the slip angles (2,) in place, NaN and so is their deviation where nothing shows them."""
    slips[0], slips[1] = after[SLIP_F], after[SLIP_R]
    for i in range(2):
        if after[STATUS] == ObserverStatus.STARTING.value or not std[i] < _UNKNOWN_STD_RAD:
            slips[i] = std[i] = math.nan


@njit
def _figures(memory: Array) -> Array:
    """Return means (3,), their deviations, slips (2,) and theirs, in one array."""
    out = np.empty(10)
    out[0], out[1], out[2] = memory[X], memory[Y], memory[YAW]
    for i in range(4):
        var = math.sqrt(max(memory[COV + 5 * i], 0.0))
        if i < 2:
            out[4 + i] = var
        else:
            out[6 + i] = var
    out[3] = out[4]
    if memory[HAS_POSITION] == 0.0:
        out[:2] = math.nan
    if memory[HAS_YAW] == 0.0:
        out[2] = math.nan
    set_slips(memory, out[6:8], out[8:10])
    return out


def _read(params: Array, memory: Array) -> ObserverOutput:
    out = _figures(memory)
    return ObserverOutput(out[:3], out[3:6], out[6:8], out[8:], int(memory[STATUS]))
