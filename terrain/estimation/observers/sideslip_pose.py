"""Pose of a car-like robot without a path, and what fixes say about its sideslip: shared by three observers.

With the speed u of the rear axle along the body (what its wheel measures: u = v cos b_R for the speed v of
the paper), the steering angle d, slip angles b of the axles, the wheelbase L and s the sign of u::

    x' = u (cos yaw - sin yaw tan(s b_R))
    y' = u (sin yaw + cos yaw tan(s b_R))
    yaw' = u (tan(d + s b_F) - tan(s b_R)) / L

These are lines 2 and 3 of (2), Deremetz et al. 2017, without a path: (2) is singular where 1 - c(s) y = 0.
The paper's lateral deviation is the error of position across the robot, e = n . (p_measured - p), and its
angular deviation that of the heading.  On a straight path along x both are the same: y is the deviation, yaw
is theta~, and (2) with c = 0 is y' = v sin(theta~ + b_R), yaw' = v cos b_R (tan(d + b_F) - tan b_R) / L.

**Correction.**  In the paper, with J the derivative of (lateral, angular) rate by (b_F, b_R)::

    dev' = f + K e        b' = q J^T e        q = K_beta / K_alpha

The error then obeys e' = J b~ - K e, b~' = -q J^T e: in each singular direction of J, with singular value g,
two poles of z^2 + K z + q g^2 = 0.  A fix comes only every T; for a fix the errors have moved by
e = e_0 + T J b~, and the corrections G_e e, G_b e that give the sampled error the poles Z = exp(z T) are::

    G_e = 1 - Z_1 Z_2 = 1 - exp(-K T)      G_b = J^T h(J J^T),   h(g^2) = (1 - Z_1)(1 - Z_2) / (g^2 T)

(eigenvalues of (I - G H) Phi; h tends to q G_e / K for g = 0, so that nothing is singular at speed 0).  It is
stable for every K, q and T, and the paper's observer for T to 0.  Between fixes the heading of f is the
measured one, carried on by yaw', as the paper's f takes measured deviations.

A fix that is further from its prediction than six standard deviations, and than the least gate, is rejected;
fixes that are rejected for long, and agree among themselves, are where the robot is: the pose begins anew.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.angles import wrapped
from terrain.errors import ConfigError
from terrain.estimation.observers.family import ObserverStatus
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import BicycleRobot

SIDESLIP_ROWS: tuple[str, ...] = (
    *("speed_rear_mps", "steer_front_rad", "position_x_m", "position_y_m", "yaw_rad"),
    *("yaw_rate_radps", "roll_rad", "accel_y_mps2"),
)
"""Rows of all observers of sideslip, at the places that follow."""
IN_SPEED, IN_STEER, IN_X, IN_Y, IN_YAW, IN_RATE, IN_ROLL, IN_ACCEL = range(8)

SIDESLIPS: tuple[str, ...] = ("slip_front_rad", "slip_rear_rad")
"""Slips of all observers of sideslip."""

STANDING_MPS = 0.05
"""Slower is standing, as in :mod:`terrain.slip`."""
SLIP_MAX_RAD = 0.5
"""Bound of a slip angle, beyond any that a tyre's force rises up to."""
LONGEST_STEP_S = 1.0
"""A longer time since the step before is no step."""
LOST_S = 1.0
"""Longer without a fix the pose is dead reckoning."""
GAIN_TIME_S = 0.1
"""For which an error of a measured heading lasts: until the next fix."""
_FASTEST_MPS = 60.0
_GATE_STDS = 6.0

(
    X, Y, YAW, YAW_LEFT, SINCE_POSITION, SINCE_YAW, SINCE_FIX,
    POSITION_BAD_S, BAD_X, BAD_Y, YAW_BAD_S, BAD_YAW, HAS_POSITION, HAS_YAW,
    ROLL, SPEED, STEER, STATUS, SLIP_F, SLIP_R, TIME,
) = range(21)  # fmt: skip
"""Places in the memory of every observer of sideslip: the pose, what its last correction left of the error of
heading, times since fixes, fixes that were rejected, what was measured last, the status, and slip angles."""
SHARED_SIZE = 21

BASE, AHEAD, GAIN, RATIO, POSITION_STD, YAW_STD, GATE_M, GATE_RAD, RESET_S, STEER_MAX = range(10)
"""Places in the parameters of every observer of sideslip."""
N_SHARED = 10


class PoseSettings(NamedTuple):
    """Fixes, and the gains by which they correct.

    Parameters
    ----------
    gain_ps : K_y = K_theta, section VI
    slip_gain : q = K_beta / K_alpha; 0 leaves the slip at 0.  Section VI has 2e12 / 5e11 = 4, with which the
        noise of fixes of 2 cm alone reaches 3 degrees within a few drives
    position_std_m, yaw_std_rad : standard deviations of a fix
    gate_m, gate_rad : least distance from the prediction at which a fix may be rejected
    reset_s : time for which fixes have to be rejected, and agree, before the pose begins anew
    """

    gain_ps: float = 15.0
    slip_gain: float = 2.5
    position_std_m: float = 0.02
    yaw_std_rad: float = 0.005
    gate_m: float = 0.3
    gate_rad: float = 0.15
    reset_s: float = 1.0


def shared_params(robot: BicycleRobot, settings: PoseSettings, size: int) -> Array:
    """Return parameters (size,) of which the first N_SHARED are set.

    Raises
    ------
    ConfigError
        if a setting is not a finite number above zero (the slip gain: from zero).
    """
    for name, value in settings._asdict().items():
        if not (math.isfinite(value) and (value > 0.0 or (name == "slip_gain" and value == 0.0))):
            raise ConfigError(f"{name} is {value:g}, a finite number above zero is required")
    params = np.zeros(size)
    params[:N_SHARED] = robot.wheelbase_m, robot.com_ahead_m, *settings, robot.steering_max_rad
    return params


def shared_start(size: int) -> Array:
    """Return a memory (size,) before the first step."""
    memory = np.zeros(size)
    memory[STATUS] = ObserverStatus.STARTING.value
    return memory


@njit
def take_inputs(params: Array, after: Array, row: Array, dt_s: float) -> int:
    """Take speed, steering and roll into the memory in place; return OK or BAD_INPUT.

    A roll that was never measured is that of level ground.
    """
    ok = 0.0 <= dt_s <= LONGEST_STEP_S and abs(row[IN_SPEED]) < _FASTEST_MPS
    if not (ok and abs(row[IN_STEER]) < 0.5 * math.pi):
        after[STATUS] = ObserverStatus.BAD_INPUT.value
        return ObserverStatus.BAD_INPUT.value
    after[SPEED], after[STEER] = row[IN_SPEED], row[IN_STEER]
    if abs(row[IN_ROLL]) < 0.5 * math.pi:
        after[ROLL] = row[IN_ROLL]
    after[TIME] += dt_s
    return ObserverStatus.OK.value


@njit
def yaw_rate_of(params: Array, speed: float, steer: float, slip_f: float, slip_r: float) -> float:
    """Return yaw' of slip angles."""
    sign = -1.0 if speed < 0.0 else 1.0
    front = min(max(steer + sign * slip_f, -1.4), 1.4)
    return float(speed * (math.tan(front) - math.tan(sign * slip_r)) / params[BASE])


@njit
def slip_jacobian(params: Array, speed: float, steer: float, slip_f: float, slip_r: float) -> Array:
    """Return J (2, 2): lateral speed and yaw rate by the slip angles of front and rear."""
    jacobian, size = np.zeros((2, 2)), abs(speed)
    front = min(max(steer + (slip_f if speed >= 0.0 else -slip_f), -1.4), 1.4)
    rear = 1.0 / math.cos(slip_r) ** 2
    jacobian[0, 1] = size * rear
    jacobian[1, 0] = size / (params[BASE] * math.cos(front) ** 2)
    jacobian[1, 1] = -size * rear / params[BASE]
    return jacobian


@njit
def advance_pose(after: Array, speed_mps: float, lateral_mps: float, yaw_rate: float, dt_s: float) -> None:
    """Carry the pose on in place, at the speeds of the rear axle and a yaw rate."""
    middle = after[YAW] + after[YAW_LEFT] + 0.5 * dt_s * yaw_rate
    cos, sin = math.cos(middle), math.sin(middle)
    after[X] += dt_s * (speed_mps * cos - lateral_mps * sin)
    after[Y] += dt_s * (speed_mps * sin + lateral_mps * cos)
    after[YAW] = wrapped(after[YAW] + dt_s * yaw_rate)
    for since in (SINCE_POSITION, SINCE_YAW, SINCE_FIX):
        after[since] = min(after[since] + dt_s, 1e6)


@njit
def _pole_factor(square: float, gain: float, ratio: float, time_s: float) -> float:
    """Return h for g^2 = ``square``."""
    stiff, decay = ratio * square, math.exp(-gain * time_s)
    if stiff * time_s * time_s < 1e-5 * min(1.0, gain * time_s):
        return ratio * (1.0 - decay) / gain
    root = 0.25 * gain * gain - stiff
    if root >= 0.0:
        half = math.sqrt(root)
        both = math.exp((half - 0.5 * gain) * time_s) + math.exp(-(half + 0.5 * gain) * time_s)
    else:
        both = 2.0 * math.exp(-0.5 * gain * time_s) * math.cos(math.sqrt(-root) * time_s)
    return (1.0 - both + decay) / (square * time_s)


@njit
def fix_gains(jacobian: Array, gain: float, ratio: float, time_s: float) -> tuple[float, Array]:
    """Return G_e and G_b (2, 2) of a fix that comes a time after the one before.

    Examples
    --------
    >>> g_e, g_b = fix_gains(np.array([[0.0, 5.0], [4.0, -4.0]]), 15.0, 4.0, 0.001)
    >>> round(g_e / 0.001, 1), (g_b / 0.001).round(1).tolist()  # K and q J^T, for short times
    (14.9, [[0.0, 15.9], [19.9, -15.9]])
    """
    a = jacobian[0, 0] ** 2 + jacobian[0, 1] ** 2
    d = jacobian[1, 0] ** 2 + jacobian[1, 1] ** 2
    b = jacobian[0, 0] * jacobian[1, 0] + jacobian[0, 1] * jacobian[1, 1]
    middle, spread = 0.5 * (a + d), math.hypot(0.5 * (a - d), b)
    small, large = max(middle - spread, 0.0), middle + spread
    h_small = _pole_factor(small, gain, ratio, time_s)
    h = np.zeros((2, 2))
    h[0, 0] = h[1, 1] = h_small
    if large - small > 1e-9 * large:
        slope = (_pole_factor(large, gain, ratio, time_s) - h_small) / (large - small)
        h[0, 0] += slope * (a - small)
        h[1, 1] += slope * (d - small)
        h[0, 1] = h[1, 0] = slope * b
    g_b = np.zeros((2, 2))
    for i in range(2):
        for j in range(2):
            g_b[i, j] = jacobian[0, i] * h[0, j] + jacobian[1, i] * h[1, j]
    return 1.0 - math.exp(-gain * time_s), g_b


@njit
def spread(cov: Array, moved: Array) -> None:
    """Set a covariance (n, n) in place to A P A^T; zeros of A, of which there are many, are left out."""
    n = cov.shape[0]
    half = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            a = moved[i, k]
            if a != 0.0:
                for j in range(n):
                    half[i, j] += a * cov[k, j]
    cov[:] = 0.0
    for j in range(n):
        for k in range(n):
            a = moved[j, k]
            if a != 0.0:
                for i in range(n):
                    cov[i, j] += half[i, k] * a


@njit
def _persists(params: Array, after: Array, place: int, agree: bool) -> bool:
    """Count a rejected fix in place, and return whether such fixes agree for long enough to begin anew."""
    if after[place] == 0.0 or not agree:
        after[place] = 1.0 + after[TIME]
    if 1.0 + after[TIME] - after[place] < params[RESET_S]:
        return False
    after[place] = 0.0
    return True


@njit
def _judge_yaw(params: Array, after: Array, row: Array, std_rad: float) -> tuple[int, float]:
    """Return whether a heading is used (OK), REJECTED, begins anew (RESET), absent (STARTING); its error."""
    if not abs(row[IN_YAW]) < 1e6:
        return ObserverStatus.STARTING.value, 0.0
    error, gate = wrapped(row[IN_YAW] - after[YAW]), min(max(params[GATE_RAD], _GATE_STDS * std_rad), 1.5)
    if after[HAS_YAW] == 1.0:
        if abs(error) <= gate:
            after[YAW_BAD_S] = 0.0
            return ObserverStatus.OK.value, error
        agree = abs(wrapped(error - after[BAD_YAW])) <= gate
        after[BAD_YAW] = error
        if not _persists(params, after, YAW_BAD_S, agree):
            return ObserverStatus.REJECTED.value, 0.0
    after[YAW], after[YAW_LEFT], after[HAS_YAW] = wrapped(row[IN_YAW]), 0.0, 1.0
    return ObserverStatus.RESET.value, 0.0


@njit
def _judge_position(params: Array, after: Array, row: Array, std_m: float) -> tuple[int, float, float]:
    """Return the same for a position, and its errors along and across the robot."""
    x, y = row[IN_X], row[IN_Y]
    if not (abs(x) < 1e9 and abs(y) < 1e9):
        return ObserverStatus.STARTING.value, 0.0, 0.0
    if after[HAS_POSITION] == 1.0 and after[HAS_YAW] == 1.0:
        off_x, off_y = x - after[X], y - after[Y]
        heading = after[YAW] + after[YAW_LEFT]
        along = math.cos(heading) * off_x + math.sin(heading) * off_y
        across = math.cos(heading) * off_y - math.sin(heading) * off_x
        gate = max(params[GATE_M], _GATE_STDS * std_m) + 0.1 * abs(after[SPEED]) * after[SINCE_POSITION]
        if math.hypot(along, across) <= gate:
            after[POSITION_BAD_S] = 0.0
            return ObserverStatus.OK.value, along, across
        agree = math.hypot(off_x - after[BAD_X], off_y - after[BAD_Y]) <= gate
        after[BAD_X], after[BAD_Y] = off_x, off_y
        if not _persists(params, after, POSITION_BAD_S, agree):
            return ObserverStatus.REJECTED.value, 0.0, 0.0
    after[X], after[Y], after[HAS_POSITION] = x, y, 1.0
    return ObserverStatus.RESET.value, 0.0, 0.0


@njit
def _forget(cov: Array, place: int, std: float) -> None:
    """Set the variance of one error in place, and its covariances to 0."""
    cov[place, :] = 0.0
    cov[:, place] = 0.0
    cov[place, place] = std * std


@njit
def correct_by_fix(params: Array, after: Array, cov: Array, row: Array) -> int:
    """Correct pose, slip and covariance in place by what a row has of a fix; return the status.

    ``cov`` (n, n) is of the errors across the robot, of heading, of both slip angles, and further ones.
    """
    heading, error = _judge_yaw(params, after, row, math.sqrt(cov[1, 1] + params[YAW_STD] ** 2))
    position, along, across = _judge_position(
        params, after, row, math.sqrt(cov[0, 0] + params[POSITION_STD] ** 2)
    )
    if heading == ObserverStatus.RESET.value:
        _forget(cov, 1, params[YAW_STD])
        after[SINCE_YAW] = after[SINCE_FIX] = 0.0
    if position == ObserverStatus.RESET.value:
        _forget(cov, 0, params[POSITION_STD])
        after[SINCE_POSITION] = after[SINCE_FIX] = 0.0
    jacobian = slip_jacobian(params, after[SPEED], after[STEER], after[SLIP_F], after[SLIP_R])
    if abs(after[SPEED]) < STANDING_MPS:
        jacobian[:] = 0.0
    used, time_s = np.zeros(2), 0.0
    if position == ObserverStatus.OK.value:
        used[0], time_s, after[SINCE_POSITION] = 1.0, after[SINCE_POSITION], 0.0
    if heading == ObserverStatus.OK.value:
        used[1], time_s, after[SINCE_YAW] = 1.0, max(time_s, after[SINCE_YAW]), 0.0
    if used.any():
        after[SINCE_FIX] = 0.0
        jacobian[0] *= used[0]
        jacobian[1] *= used[1]
        g_e, g_b = fix_gains(jacobian, params[GAIN], params[RATIO], min(max(time_s, 1e-4), LOST_S))
        cos, sin = math.cos(after[YAW] + after[YAW_LEFT]), math.sin(after[YAW] + after[YAW_LEFT])
        after[X] += g_e * (cos * along - sin * across)
        after[Y] += g_e * (sin * along + cos * across)
        if used[1]:
            after[YAW], after[YAW_LEFT] = wrapped(after[YAW] + g_e * error), (1.0 - g_e) * error
        after[SLIP_F] = _bounded(after[SLIP_F] + g_b[0, 0] * across + g_b[0, 1] * error)
        after[SLIP_R] = _bounded(after[SLIP_R] + g_b[1, 0] * across + g_b[1, 1] * error)
        _condition(params, cov, g_e * used, g_b)
    for status in (ObserverStatus.RESET.value, ObserverStatus.REJECTED.value):
        if heading == status or position == status:
            return status
    return ObserverStatus.OK.value


@njit
def _condition(params: Array, cov: Array, g_e: Array, g_b: Array) -> None:
    """Set a covariance in place to (I - G H) P (I - G H)^T + G R G^T of a fix; ``g_e`` (2,) has its parts."""
    kept, gains = np.eye(cov.shape[0]), np.zeros((4, 2))
    gains[0, 0], gains[1, 1] = g_e[0], g_e[1]
    gains[2:4] = g_b
    kept[:4, :2] -= gains
    spread(cov, kept)
    for i in range(4):
        for j in range(4):
            cov[i, j] += gains[i, 0] * gains[j, 0] * params[POSITION_STD] ** 2
            cov[i, j] += gains[i, 1] * gains[j, 1] * params[YAW_STD] ** 2


@njit
def _bounded(slip_rad: float) -> float:
    return min(max(slip_rad, -SLIP_MAX_RAD), SLIP_MAX_RAD)


@njit
def status_of(before: Array, after: Array, fix: int) -> int:
    """Return the status of a tick, of what its fix gave."""
    if after[HAS_POSITION] == 0.0 or after[HAS_YAW] == 0.0:
        return ObserverStatus.STARTING.value
    if before[HAS_POSITION] == 0.0 or before[HAS_YAW] == 0.0:
        return ObserverStatus.STARTING.value
    if fix != ObserverStatus.OK.value:
        return fix
    if abs(after[SPEED]) < STANDING_MPS:
        return ObserverStatus.STANDING.value
    return ObserverStatus.PREDICTED.value if after[SINCE_FIX] > LOST_S else ObserverStatus.OK.value
