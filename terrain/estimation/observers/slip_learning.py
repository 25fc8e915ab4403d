r"""Slip-compensated odometry that identifies its slip model while it drives (future work of Yamauchi et al.).

The memory of :mod:`~terrain.estimation.observers.slip_odometry` holds the covariance of the pose **and** of
the parameters of the slip model.  A fix of the position is therefore a measurement of both: with the
innovation :math:`e = z - (x, y)`,

.. math::
    K = P H^T (H P H^T + R)^{-1}, \qquad (pose, p) \leftarrow (pose, p) + K e, \qquad
    P \leftarrow (1 - K H) P,

an extended Kalman filter without which the same step is plain odometry.  Between two fixes the displacement
is linear in all parameters but n, so that this is recursive least squares on displacements, weighted by what
noise and residuals add between them; fixes may be sparse.  A loop closure is a fix as well.

What is observable from what:

- encoders and gyro alone give :math:`D = v_r - v_l - 2 d w`, hence the effective distance of the tracks and,
  *with n assumed*, the slip of each track; they give neither n nor any slip that both tracks share;
- positions give the straight slip while driving straight on grades, the side slip on side slopes, and n and
  the regression (28) in turns, each by what those motions excite;
- sub-tracks are no part of the model.

A parameter whose standard deviation has not fallen to half of that at the start is not observed: its mean is
NaN outside, while the filter goes on with what it has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

import numpy as np
from numba import types

from terrain.angles import wrapped
from terrain.errors import ConfigError
from terrain.estimation.observers.family import Observer, ObserverOutput, ObserverStatus
from terrain.estimation.observers.slip_model import N_MODEL, PARAMETERS, TRACK_RATIO, SlipModel, model_of
from terrain.estimation.observers.slip_odometry import (
    ANGLE_STD,
    CORRELATION,
    COVARIANCE,
    FASTEST_RADPS,
    PARAMS_SIZE,
    POSE,
    READ_ONLY,
    SIZE,
    SLIP_STD,
    SLIPS,
    STATES,
    STATUS,
    STEP,
    THETA,
    N,
    OdometrySettings,
    advance,
    odometry_memory,
    odometry_params,
    read_odometry,
)
from terrain.estimation.observers.slip_odometry import ROWS as ODOMETRY_ROWS
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import TrackedRobot

ROWS = (*ODOMETRY_ROWS, "position_x_m", "position_y_m", "yaw_rad")

FARTHEST_M = 1e6
"""A position beyond is none in a local frame."""

GATE = 13.8
"""Squared innovation over its variance that one fix in a thousand exceeds (chi square, two degrees)."""

RESET_FIXES, ALIKE_M = 10, 0.5
"""So many rejected fixes in a row that agree with each other within so much are right, and the pose is
wrong."""

OBSERVED_RATIO = 0.5
"""Of its standard deviation at the start: a parameter below it is observed."""

TURNING_RADPS = 0.05
"""Slower, a yaw rate shows nothing of the distance of the tracks."""

PRIOR_STD = np.array([0.3, 0.1, 1.0, 0.3, 1.0, 0.3, 0.2, 0.3, 3.0, 1.0, 1.0, 2.0, 1.0, 0.5, 2.0, 0.5])
"""Of :data:`~terrain.estimation.observers.slip_model.PARAMETERS` on unknown ground, wide around the values
printed by Yamauchi et al. (converted from degrees) and those of sand."""


def unknown_ground() -> SlipModel:
    """Return what is assumed of a ground that was never driven on: wide in every number.

    Examples
    --------
    >>> unknown_ground().turning_exponent
    0.85
    """
    return SlipModel(
        turning_exponent=0.85,
        track_ratio=1.5,
        covariance=np.diag(PRIOR_STD**2),
        slip_std_ratio=0.03,
        angle_std_rad=0.05,
        found="unknown ground",
    )


@dataclass(frozen=True)
class LearningSettings:
    """Settings of odometry that identifies its slip model.

    Parameters
    ----------
    odometry : noise and limits of the odometry
    fix_std_m, yaw_fix_std_rad : of a position along an axis, and of a heading
    ratio_std : of the ratio of the tracks' yaw rate and the gyro's, from turn to turn
    forget_s : time in which a parameter may change by its standard deviation at the start
    """

    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    fix_std_m: float = 0.02
    yaw_fix_std_rad: float = 0.02
    ratio_std: float = 0.1
    forget_s: float = math.inf


_F8 = types.float64
_FIX_STD, _YAW_STD, _RATIO_STD, _FORGET = range(PARAMS_SIZE, PARAMS_SIZE + 4)
_PRIOR = PARAMS_SIZE + 4
_LOCATED, _REJECTED, _OFFSET = SIZE, SIZE + 1, SIZE + 2
LEARNING_SIZE = SIZE + 4


@njit
def _correct(after: Array, prior: Array, place: int, innovation: float, variance: float) -> None:
    """Take a measurement of one entry of pose and parameters."""
    covariance = after[COVARIANCE : COVARIANCE + N * N].reshape((N, N))
    column = covariance[:, place].copy()
    total = column[place] + variance
    for i in range(N):
        gain = column[i] / total
        if i < 3:
            after[POSE + i] += gain * innovation
        else:
            after[THETA + i - 3] += gain * innovation
        for j in range(N):
            covariance[i, j] -= gain * column[j]
    for i in range(N_MODEL):
        covariance[3 + i, 3 + i] = max(covariance[3 + i, 3 + i], 1e-12 * prior[i] ** 2)
    after[THETA] = min(max(after[THETA], 0.0), 3.0)
    after[THETA + TRACK_RATIO] = min(max(after[THETA + TRACK_RATIO], 0.3), 10.0)
    for i in range(1, TRACK_RATIO):
        after[THETA + i] = min(max(after[THETA + i], -100.0), 100.0)


@njit
def _learn_track_ratio(params: Array, after: Array, row: Array, dt_s: float) -> None:
    """Compare the yaw rate of the gyro with that of the tracks, at the pace of independent samples."""
    rate, tracks = row[2], (row[1] - row[0]) / (2.0 * params[0])
    if abs(rate) > TURNING_RADPS and abs(rate) <= FASTEST_RADPS and rate * tracks > 0.0 and dt_s > 0.0:
        ratio = tracks / rate
        variance = params[_RATIO_STD] ** 2 * max(2.0 * params[CORRELATION] / dt_s, 1.0)
        innovation = ratio - after[THETA + TRACK_RATIO]
        if abs(innovation) < 5.0:
            _correct(after, params[_PRIOR:], 3 + TRACK_RATIO, innovation, variance)


@njit
def _locate(params: Array, after: Array, x_m: float, y_m: float) -> None:
    """Begin the position anew at a fix; parameters stay."""
    covariance = after[COVARIANCE : COVARIANCE + N * N].reshape((N, N))
    for i in range(2):
        covariance[i, :] = 0.0
        covariance[:, i] = 0.0
        covariance[i, i] = params[_FIX_STD] ** 2
    after[POSE], after[POSE + 1] = x_m, y_m
    after[_LOCATED], after[_REJECTED] = 1.0, 0.0


@njit
def _take_fix(params: Array, after: Array, x_m: float, y_m: float) -> int:
    """Correct by a position, or reject it, and return the status."""
    covariance = after[COVARIANCE : COVARIANCE + N * N].reshape((N, N))
    variance = params[_FIX_STD] ** 2
    e_x, e_y = x_m - after[POSE], y_m - after[POSE + 1]
    s_x, s_y, s_xy = covariance[0, 0] + variance, covariance[1, 1] + variance, covariance[0, 1]
    distance = (s_y * e_x * e_x - 2.0 * s_xy * e_x * e_y + s_x * e_y * e_y) / (s_x * s_y - s_xy * s_xy)
    if distance <= GATE:
        after[_REJECTED] = 0.0
        _correct(after, params[_PRIOR:], 0, e_x, variance)
        _correct(after, params[_PRIOR:], 1, y_m - after[POSE + 1], variance)
        return ObserverStatus.OK.value
    alike = math.hypot(e_x - after[_OFFSET], e_y - after[_OFFSET + 1]) < ALIKE_M
    after[_REJECTED] = after[_REJECTED] + 1.0 if alike else 1.0
    after[_OFFSET], after[_OFFSET + 1] = e_x, e_y
    if after[_REJECTED] < RESET_FIXES:
        return ObserverStatus.REJECTED.value
    _locate(params, after, x_m, y_m)
    return ObserverStatus.RESET.value


@njit(STEP)
def learning_step(params: Array, memory: Array, row: Array, dt_s: float) -> Array:
    """Return the memory a tick later: as :data:`~terrain.estimation.observers.family.Step`."""
    after = memory.copy()
    advance(params, after, row, dt_s)
    if after[STATUS] == ObserverStatus.BAD_INPUT.value:
        return after
    moving = after[STATUS] not in (ObserverStatus.STANDING.value, ObserverStatus.PUSHED.value)
    if moving:
        _learn_track_ratio(params, after, row, dt_s)
        for i in range(N_MODEL):
            walk = params[_PRIOR + i] ** 2 * dt_s / params[_FORGET]
            after[COVARIANCE + (3 + i) * (N + 1)] += walk
    fixed = abs(row[5]) <= FARTHEST_M and abs(row[6]) <= FARTHEST_M
    turned = math.isfinite(row[7]) and abs(row[7]) <= FARTHEST_M
    if after[_LOCATED] == 0.0:
        if fixed and turned:
            _locate(params, after, row[5], row[6])
            after[POSE + 2] = row[7]
            covariance = after[COVARIANCE : COVARIANCE + N * N].reshape((N, N))
            covariance[2, :] = 0.0
            covariance[:, 2] = 0.0
            covariance[2, 2] = params[_YAW_STD] ** 2
        else:
            after[STATUS] = ObserverStatus.STARTING.value
        return after
    status = int(after[STATUS])
    if turned:
        error = wrapped(row[7] - after[POSE + 2])
        variance = after[COVARIANCE + 2 * (N + 1)] + params[_YAW_STD] ** 2
        if error * error <= GATE * variance:
            _correct(after, params[_PRIOR:], 2, error, params[_YAW_STD] ** 2)
        else:
            status = ObserverStatus.REJECTED.value
    if fixed:
        taken = _take_fix(params, after, row[5], row[6])
        if taken != ObserverStatus.OK.value:
            status = taken
    after[STATUS] = status
    return after


@njit(_F8[:, ::1](READ_ONLY, READ_ONLY))
def read_parameters(params: Array, memory: Array) -> Array:
    """Return parameters and their standard deviations (2, 16); NaN where one is not observed yet."""
    out = np.full((2, N_MODEL), np.nan)
    for i in range(N_MODEL):
        std = math.sqrt(max(memory[COVARIANCE + (3 + i) * (N + 1)], 0.0))
        if std <= OBSERVED_RATIO * params[_PRIOR + i]:
            out[0, i], out[1, i] = memory[THETA + i], std
    return out


@njit(types.Tuple((_F8[::1], _F8[::1], _F8[::1], _F8[::1], types.int64))(READ_ONLY, READ_ONLY))
def _read(params: Array, memory: Array) -> tuple[Array, Array, Array, Array, int]:
    motion, motion_std, slip, slip_std, status = read_odometry(params, memory)
    found = read_parameters(params, memory)
    return np.concatenate((motion, found[0])), np.concatenate((motion_std, found[1])), slip, slip_std, status


def learning_output(params: Array, memory: Array) -> ObserverOutput:
    """Return what a memory holds: motion, slips and parameters."""
    return ObserverOutput(*_read(params, memory))


def learned_model(params: Array, memory: Array) -> SlipModel:
    """Return the slip model that a memory has come to, with its covariance and the residuals assumed.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> observer = slip_learning_observer(load_robot("patako"))
    >>> learned_model(observer.params, observer.start).turning_exponent
    0.85
    """
    covariance = memory[COVARIANCE : COVARIANCE + N * N].reshape(N, N)[3 : 3 + N_MODEL, 3 : 3 + N_MODEL]
    return model_of(
        memory[THETA : THETA + N_MODEL],
        covariance=covariance,
        slip_std_ratio=float(params[SLIP_STD]),
        angle_std_rad=float(params[ANGLE_STD]),
        correlation_s=float(params[CORRELATION]),
        found="fixes while driving",
    )


def slip_learning_observer(
    robot: TrackedRobot, prior: SlipModel | None = None, settings: LearningSettings | None = None
) -> Observer:
    """Return slip-compensated odometry that corrects its slip model by fixes of the position.

    Parameters
    ----------
    robot : its tracks
    prior : what is known before; :func:`unknown_ground` by default
    settings : noise and limits

    Raises
    ------
    ConfigError
        if a setting is not above zero, or a parameter of the prior has no standard deviation.

    Notes
    -----
    It starts at the first fix with a heading, and is ``STARTING`` before.  Fixes that jump are ``REJECTED``;
    after ten that agree with each other the position is ``RESET`` to them, and the parameters stay.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> observer = slip_learning_observer(load_robot("patako"))
    >>> found = observer.read(observer.params, observer.start)
    >>> bool(np.isnan(found.mean[observer.states.index("turning_exponent")]))
    True
    """
    prior, settings = prior or unknown_ground(), settings or LearningSettings()
    for each in fields(settings):
        if each.name != "odometry" and not getattr(settings, each.name) > 0.0:
            value = getattr(settings, each.name)
            raise ConfigError(f"slip learning: {each.name} is {value!r}, a number above zero is required")
    std = np.sqrt(np.diag(prior.covariance))
    if not (std > 0.0).all():
        missing = PARAMETERS[int(np.argmin(std))]
        raise ConfigError(f"slip learning: the prior of {missing} has no standard deviation above zero")
    own = (settings.fix_std_m, settings.yaw_fix_std_rad, settings.ratio_std, settings.forget_s)
    params = np.concatenate((odometry_params(robot, prior, settings.odometry), own, std))
    start = np.concatenate((odometry_memory(prior, settings.odometry), np.zeros(4)))
    return Observer(
        "slip-learning", (*STATES, *PARAMETERS), SLIPS, ROWS, params, start, learning_step, learning_output
    )
