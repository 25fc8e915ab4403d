r"""Slip-compensated odometry of a tracked robot (Yamauchi et al., ROBOMECH Journal 2017).

State: the pose :math:`x, y, \theta` in the frame of the start, which moves by (5) to (7),

.. math:: x' = V_x \cos\theta - V_y \sin\theta, \quad y' = V_x \sin\theta + V_y \cos\theta, \quad \theta' = w,

with the velocity that :mod:`~terrain.estimation.observers.slip_model` makes of the speeds of the tracks, the
gyro and the tilt; steps are integrated as arcs.  The yaw rate is that of the gyro, or, where it is absent or
agrees with the tracks within a threshold (gyrodometry), that of the tracks over their effective distance.

The covariance is that of the pose and of all parameters p of the model, the errors of the run and the bias
of the gyro beside them, which do not change within a run:

.. math::
    P \leftarrow F P F^T + Q, \qquad
    F = \begin{pmatrix} F_{pose} & \partial\,step/\partial p \\ 0 & 1 \end{pmatrix}

Q holds the noise of gyro and encoders, and the residuals of the slip model with their correlation time.
So an error that a whole run has in common grows with the distance, and noise with its root.

**Corrected** against the paper: (27) without its singular points, (26) in reverse, (22) by the grade; see
there.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, fields

import numpy as np
from numba import types

from terrain.errors import ConfigError
from terrain.estimation.observers.arcs import arc_displacement
from terrain.estimation.observers.family import Observer, ObserverOutput, ObserverStatus
from terrain.estimation.observers.slip_model import (
    GYRO_BIAS,
    N_MODEL,
    N_PARAMETERS,
    RUN_ANGLE,
    RUN_SLIP,
    TRACK_RATIO,
    SlipModel,
    body_velocity,
    next_displacement,
)
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import TrackedRobot

ROWS = ("speed_left_mps", "speed_right_mps", "yaw_rate_radps", "roll_rad", "pitch_rad")
STATES = (
    *("position_x_m", "position_y_m", "yaw_rad"),
    *("speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
)
SLIPS = ("slip_left_ratio", "slip_right_ratio", "slip_body_rad")

LONGEST_STEP_S = 1.0
"""Over a longer gap the tracks may have done anything."""

BLIND_MPS = 0.5
"""Of tracks whose speeds are not known: slow robots too may have begun to drive."""
LOST_M = 1e6
"""Standard deviation above which a position is not known at all."""

FASTEST_MPS, FASTEST_RADPS = 20.0, 20.0
"""More than a track or a robot can; such a reading is wrong."""

N = 3 + N_PARAMETERS
POSE, VELOCITY, TILT, DISPLACEMENT, STATUS = 0, 3, 6, 8, 9
BELTS, GROUND, VARIANCE = 10, 12, 14
THETA = 17
COVARIANCE = THETA + N_PARAMETERS
SIZE = COVARIANCE + N * N
"""Memory: pose, velocity, tilt last known, yaw since the turn began, status, speeds of belts and of the
ground under them, variances of the velocity, parameters, covariance of pose and
parameters."""


@dataclass(frozen=True)
class OdometrySettings:
    """Noise and limits of the odometry of a tracked robot.

    Parameters
    ----------
    gyro_threshold_radps : the gyro is used where it differs from the tracks by more; 0: always
    gyro_noise_radps, gyro_bias_std_radps : of a sample, and of what is left of the bias
    encoder_noise_mps : of a sample of the speed of a track
    stand_mps : both tracks slower: the robot stands, or is pushed
    pushed_radps : yaw rate above which a robot on standing tracks is pushed
    min_speed_mps : tracks and ground slower: the slip of the track is NaN
    """

    gyro_threshold_radps: float = 0.0
    gyro_noise_radps: float = 0.002
    gyro_bias_std_radps: float = 0.0005
    encoder_noise_mps: float = 0.001
    stand_mps: float = 0.003
    pushed_radps: float = 0.02
    min_speed_mps: float = 0.005


_HALF, _LENGTH = 0, 1
_SETTINGS = 2
(_THRESHOLD, _GYRO_STD, _BIAS_STD, _ENCODER_STD, _STAND, _PUSHED, _MIN_SPEED) = range(
    _SETTINGS, _SETTINGS + 7
)
SLIP_STD, ANGLE_STD, CORRELATION = range(_SETTINGS + 7, _SETTINGS + 10)
PARAMS_SIZE = _SETTINGS + 10

_F8 = types.float64
READ_ONLY = types.Array(_F8, 1, "C", readonly=True)
ANY_ROW = types.Array(_F8, 1, "A", readonly=True)
STEP = _F8[::1](READ_ONLY, READ_ONLY, ANY_ROW, _F8)


def odometry_params(robot: TrackedRobot, model: SlipModel, settings: OdometrySettings) -> Array:
    """Return the parameters (PARAMS_SIZE,) of a step.

    Raises
    ------
    ConfigError
        if a setting is negative or not a number, or a least speed is 0.
    """
    for each in fields(settings):
        value = getattr(settings, each.name)
        zero = each.name not in ("stand_mps", "min_speed_mps")
        valid = value == value and (value >= 0.0 if zero else 0.0 < value < math.inf)
        if not valid or (value == math.inf and each.name != "gyro_threshold_radps"):
            accepted = "a number from zero up" if zero else "a number above zero"
            raise ConfigError(f"odometry: {each.name} is {value!r}, {accepted} is required")
    geometry = (robot.half_track_m, robot.contact_length_m)
    residuals = (model.slip_std_ratio, model.angle_std_rad, model.correlation_s)
    return np.array([*geometry, *astuple(settings), *residuals])


def odometry_memory(model: SlipModel, settings: OdometrySettings) -> Array:
    """Return the memory (SIZE,) at the start: at the origin, with the heading 0."""
    start = np.zeros(SIZE)
    start[STATUS] = ObserverStatus.STARTING.value
    start[THETA : THETA + N_MODEL] = model.vector
    covariance = start[COVARIANCE:].reshape(N, N)
    covariance[3 : 3 + N_MODEL, 3 : 3 + N_MODEL] = model.covariance
    for place, std in (
        (RUN_SLIP, model.run_slip_std_ratio),
        (RUN_ANGLE, model.run_angle_std_rad),
        (GYRO_BIAS, settings.gyro_bias_std_radps),
    ):
        covariance[3 + place, 3 + place] = std * std
    return start


@njit
def yaw_rate_of(params: Array, theta: Array, row: Array, slopes: Array) -> tuple[float, float, int]:
    """Return the yaw rate, the variance of its noise and a status; write its derivatives by parameters.

    A gyro that is absent, or faster than a robot can turn, is replaced by the tracks.
    """
    by_track = 2.0 * params[_HALF] * theta[TRACK_RATIO]
    tracks = (row[1] - row[0]) / by_track
    slopes[:] = 0.0
    gyro = row[2] - theta[GYRO_BIAS]
    status = ObserverStatus.OK.value
    if not abs(row[2]) <= FASTEST_RADPS:
        if not math.isnan(row[2]):
            status = ObserverStatus.REJECTED.value
    elif abs(gyro - tracks) >= params[_THRESHOLD]:
        slopes[GYRO_BIAS] = -1.0
        return gyro, params[_GYRO_STD] ** 2, status
    slopes[TRACK_RATIO] = -tracks / theta[TRACK_RATIO]
    return tracks, 2.0 * (params[_ENCODER_STD] / by_track) ** 2, status


@njit
def _quadratic(covariance: Array, slope: Array) -> float:
    """Return the variance that parameters of a covariance give a quantity with these derivatives."""
    total = 0.0
    for i in range(N_PARAMETERS):
        if slope[i] != 0.0:
            for j in range(N_PARAMETERS):
                total += slope[i] * covariance[3 + i, 3 + j] * slope[j]
    return total


@njit
def _propagate(covariance: Array, moved: tuple[float, float], step_slopes: Array) -> None:
    """Move the covariance of pose and parameters over a step that moves by (dx, dy)."""
    by = np.zeros((3, N))
    by[:, 3:] = step_slopes
    by[0, 0] = by[1, 1] = by[2, 2] = 1.0
    by[0, 2], by[1, 2] = -moved[1], moved[0]
    rows = by @ covariance
    pose = rows @ by.T
    for i in range(3):
        covariance[i, 3:] = rows[i, 3:]
        covariance[3:, i] = rows[i, 3:]
        for j in range(3):
            covariance[i, j] = 0.5 * (pose[i, j] + pose[j, i])


@njit
def take_tilt(after: Array, row: Array) -> bool:
    """Take roll and pitch where they are measured, and return whether; else those last known stay."""
    if abs(row[3]) <= 0.5 * math.pi and abs(row[4]) <= 0.5 * math.pi:
        after[TILT], after[TILT + 1] = row[3], row[4]
        return True
    return False


@njit
def _widen(params: Array, after: Array, covariance: Array, dt_s: float) -> None:
    """Widen the pose by a motion that was not measured: as fast as the tracks were, or :data:`BLIND_MPS`."""
    moved = max(abs(after[BELTS]), abs(after[BELTS + 1]), BLIND_MPS) * dt_s
    for i in range(3):
        std = math.sqrt(max(covariance[i, i], 0.0))
        grown, most = (std + moved, LOST_M) if i < 2 else (std + moved / params[_HALF], math.pi)
        grown = max(min(grown, most), std)
        covariance[i, i] = grown * grown


@njit
def advance(params: Array, after: Array, row: Array, dt_s: float) -> None:
    """Take the measurements of a tick, and move pose and covariance in place."""
    valid = 0.0 <= dt_s <= LONGEST_STEP_S and abs(row[0]) <= FASTEST_MPS and abs(row[1]) <= FASTEST_MPS
    covariance = after[COVARIANCE : COVARIANCE + N * N].reshape((N, N))
    if not valid:
        after[STATUS] = ObserverStatus.BAD_INPUT.value
        if 0.0 < dt_s < math.inf:
            _widen(params, after, covariance, dt_s)
        return
    theta = after[THETA : THETA + N_PARAMETERS]
    rate_slopes, slopes = np.empty(N_PARAMETERS), np.empty((2, N_PARAMETERS))
    rate, rate_variance, status = yaw_rate_of(params, theta, row, rate_slopes)
    if not take_tilt(after, row):
        status = ObserverStatus.PREDICTED.value
    belts = (row[0], row[1])
    after[BELTS], after[BELTS + 1] = belts
    if abs(belts[0]) <= params[_STAND] and abs(belts[1]) <= params[_STAND]:
        _stand(params, after, covariance, rate, rate_variance, dt_s)
        return
    tilt = (after[TILT], after[TILT + 1])
    v_x, v_y, x_by_rate, y_by_rate = body_velocity(
        theta, params[_HALF], belts, rate, tilt, after[DISPLACEMENT], slopes
    )
    for i in range(N_PARAMETERS):
        slopes[0, i] += x_by_rate * rate_slopes[i]
        slopes[1, i] += y_by_rate * rate_slopes[i]
    after[VELOCITY], after[VELOCITY + 1], after[VELOCITY + 2] = v_x, v_y, rate
    after[GROUND], after[GROUND + 1] = v_x - params[_HALF] * rate, v_x + params[_HALF] * rate
    after[DISPLACEMENT] = next_displacement(after[DISPLACEMENT], belts, rate, params[_LENGTH], dt_s)
    after[STATUS] = status
    speed = 0.5 * (abs(belts[0]) + abs(belts[1]))
    slip_variance, side_variance = (params[SLIP_STD] * speed) ** 2, (params[ANGLE_STD] * speed) ** 2
    encoder_variance = 0.5 * params[_ENCODER_STD] ** 2
    after[VARIANCE] = _quadratic(covariance, slopes[0]) + slip_variance + encoder_variance
    after[VARIANCE + 1] = _quadratic(covariance, slopes[1]) + side_variance
    after[VARIANCE + 2] = _quadratic(covariance, rate_slopes) + rate_variance
    if dt_s > 0.0:
        twice = 2.0 * params[CORRELATION] * dt_s
        noise = (
            (slip_variance * twice + encoder_variance * dt_s * dt_s),
            side_variance * twice,
            rate_variance * dt_s * dt_s,
        )
        _move(after, covariance, slopes, rate_slopes, noise, dt_s)


@njit
def _stand(
    params: Array, after: Array, covariance: Array, rate: float, rate_variance: float, dt_s: float
) -> None:
    """Hold the position of a robot whose tracks stand; its heading follows the gyro if it is pushed."""
    pushed = abs(rate) > params[_PUSHED]
    after[VELOCITY] = after[VELOCITY + 1] = 0.0
    after[VELOCITY + 2] = rate if pushed else 0.0
    after[GROUND] = after[GROUND + 1] = 0.0
    after[VARIANCE] = after[VARIANCE + 1] = 0.0
    after[VARIANCE + 2] = rate_variance
    after[STATUS] = ObserverStatus.PUSHED.value if pushed else ObserverStatus.STANDING.value
    if pushed:
        after[POSE + 2] += rate * dt_s
        covariance[2, 2] += rate_variance * dt_s * dt_s


@njit
def _move(
    after: Array,
    covariance: Array,
    slopes: Array,
    rate_slopes: Array,
    noise: tuple[float, float, float],
    dt_s: float,
) -> None:
    """Move the pose along its arc, and its covariance with it; ``noise`` is along, across and of the yaw."""
    yaw, rate = after[POSE + 2], after[VELOCITY + 2]
    moved = arc_displacement(yaw, after[VELOCITY], after[VELOCITY + 1], rate, dt_s)
    cos, sin = math.cos(yaw + 0.5 * rate * dt_s), math.sin(yaw + 0.5 * rate * dt_s)
    step_slopes = np.empty((3, N_PARAMETERS))
    for i in range(N_PARAMETERS):
        step_slopes[0, i] = dt_s * (cos * slopes[0, i] - sin * slopes[1, i])
        step_slopes[1, i] = dt_s * (sin * slopes[0, i] + cos * slopes[1, i])
        step_slopes[2, i] = dt_s * rate_slopes[i]
    _propagate(covariance, moved, step_slopes)
    covariance[0, 0] += cos * cos * noise[0] + sin * sin * noise[1]
    covariance[1, 1] += sin * sin * noise[0] + cos * cos * noise[1]
    covariance[0, 1] += cos * sin * (noise[0] - noise[1])
    covariance[1, 0] = covariance[0, 1]
    covariance[2, 2] += noise[2]
    after[POSE] += moved[0]
    after[POSE + 1] += moved[1]
    after[POSE + 2] += rate * dt_s


@njit(STEP)
def odometry_step(params: Array, memory: Array, row: Array, dt_s: float) -> Array:
    """Return the memory a tick later: as :data:`~terrain.estimation.observers.family.Step`."""
    after = memory.copy()
    advance(params, after, row, dt_s)
    return after


@njit(types.Tuple((_F8[::1], _F8[::1], _F8[::1], _F8[::1], types.int64))(READ_ONLY, READ_ONLY))
def read_odometry(params: Array, memory: Array) -> tuple[Array, Array, Array, Array, int]:
    """Return states, their standard deviations, slips, theirs, and the status of a memory."""
    mean, std = memory[: VELOCITY + 3].copy(), np.empty(6)
    slip, slip_std = np.full(3, np.nan), np.full(3, np.nan)
    for i in range(3):
        std[i] = math.sqrt(max(memory[COVARIANCE + i * (N + 1)], 0.0))
        std[3 + i] = math.sqrt(max(memory[VARIANCE + i], 0.0))
    status = int(memory[STATUS])
    if status == ObserverStatus.STARTING.value:
        return mean, std, slip, slip_std, status
    for i in range(2):
        belt, ground = memory[BELTS + i], memory[GROUND + i]
        fastest = max(abs(belt), abs(ground))
        if fastest >= params[_MIN_SPEED]:
            slip[i] = min(max((belt - ground) / fastest, -1.0), 1.0)
            slip_std[i] = std[3] / fastest
    v_x, v_y = abs(mean[3]), mean[4]
    square = v_x * v_x + v_y * v_y
    if square >= params[_MIN_SPEED] ** 2:
        slip[2] = math.atan2(v_y, v_x)
        slip_std[2] = math.hypot(v_x * std[4], v_y * std[3]) / square
    return mean, std, slip, slip_std, status


def odometry_output(params: Array, memory: Array) -> ObserverOutput:
    """Return what a memory holds: states, slips and their standard deviations."""
    return ObserverOutput(*read_odometry(params, memory))


def slip_odometry_observer(
    robot: TrackedRobot, model: SlipModel, settings: OdometrySettings | None = None
) -> Observer:
    """Return the slip-compensated odometry of a tracked robot.

    Parameters
    ----------
    robot : its tracks
    model : slip on this ground, as ``terrain calibrate --what odometry`` finds it
    settings : noise and limits

    Raises
    ------
    ConfigError
        as :func:`odometry_params` does.

    Notes
    -----
    Statuses: ``STANDING`` and ``PUSHED`` with both tracks stopped, the pose held or turned by the gyro;
    ``PREDICTED`` without a tilt, the last one being used; ``REJECTED`` for a yaw rate that cannot be,
    replaced by that of the tracks; ``BAD_INPUT`` for speeds or times that cannot be, nothing being changed.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> observer = slip_odometry_observer(load_robot("patako"), SlipModel(compaction_slip_ratio=0.1))
    >>> memory, row = observer.start, np.array([0.1, 0.1, 0.0, 0.0, 0.0])
    >>> for _ in range(100):
    ...     memory = observer.step(observer.params, memory, row, 0.01)
    >>> found = observer.read(observer.params, memory)
    >>> found.mean[:3].round(3), found.slip.round(2)
    (array([0.09, 0.  , 0.  ]), array([0.1, 0.1, 0. ]))
    """
    settings = settings or OdometrySettings()
    return Observer(
        "slip-odometry",
        STATES,
        SLIPS,
        ROWS,
        odometry_params(robot, model, settings),
        odometry_memory(model, settings),
        odometry_step,
        odometry_output,
    )
