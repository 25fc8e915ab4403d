"""The adaptive identity observer of tracked vehicles: how much of its speed each track brings to the ground.

Source: R. Tazzari, I. A. Azzollini and L. Marconi, An Adaptive Observer Approach to Slip Estimation for
Agricultural Tracked Vehicles.  With the efficiency ``n = V_t / v`` of each track (4), the speed over ground
of the track over its circumferential speed, and ``i = 1 - n`` the slip of the paper::

    V_G = (n_R v_R + n_L v_L) / 2      Omega = (n_R v_R - n_L v_L) / (2 d)                          (5)
    z^' = M(theta) n^ + L e            n^' = Lambda M(theta)' e            e = z - z^               (8)

State: pose z^ and n^.  Measured: z, from satellites and a compass, and the speeds of the tracks; the yaw rate
of a gyro where there is one.

- Speeds come at every tick, fixes of the pose now and then.  Between two fixes M is integrated with the
  heading that follows from the last measured one by the gyro, else by the estimate; what the heading differs
  by at the next fix is spread over the interval.  At a fix (8) is integrated over the interval since the fix
  before (:mod:`~terrain.estimation.observers.tracked_interval`).  The pose in between is dead reckoning, its
  heading by the gyro where there is one.
- A fix is position and heading at one tick.  One that deviates from the dead reckoning by more than noise and
  the distance that the tracks turned is rejected, and is not used for the efficiencies.
- A track that stands turns nothing, so that its efficiency stays as it is; while both stand the pose follows
  the fixes, low-pass filtered by L.
- Standard deviations are those of the noise of fixes and a random walk of the efficiencies, propagated
  through the errors' own linear map; the noise of one fix acts in two intervals, and its covariance with the
  errors is kept.  Dead reckoning adds the heading's deviation times the distance since the last fix.
- Where efficiencies change, the observation error is larger than its variance explains; their standard
  deviations are then larger by the same ratio.
- Excitation: the smallest eigenvalue of the mean of M'M, forgotten with the time constant T, as a speed (its
  root); T times its square is the mu of (14).

Corrected: (11), whose second row as printed makes M'M singular, has the signs of (8); (14) is over t to
t + T; the heading error of (9) is wrapped to (-pi, pi]; V as :mod:`tracked_interval` states it.  At constant
gains the settling time goes with 1/v^2; ``normalised`` makes it the same at every speed.  A slip that the
model does not know, sideways on a slope or of a dragged track, is no part of (5).
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from terrain.angles import wrapped
from terrain.estimation.observers import tracked_settings as at
from terrain.estimation.observers.family import Observer, ObserverOutput, ObserverStatus
from terrain.estimation.observers.tracked_interval import inverse_3, normalised_gain, observe_interval
from terrain.estimation.observers.tracked_settings import TrackedSettings, tracked_params
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import TrackedRobot

ROWS = ("speed_left_mps", "speed_right_mps", "position_x_m", "position_y_m", "yaw_rad", "yaw_rate_radps")
STATES = (
    *("position_x_m", "position_y_m", "yaw_rad", "speed_x_mps", "yaw_rate_radps"),
    *("eta_left_ratio", "eta_right_ratio", "excitation_mps", "observation_error_m"),
)
"""The observation error is |e|, a radian counted as a metre: ``|e|^2 / 2`` is the part of V that is known."""
SLIPS = ("slip_left_ratio", "slip_right_ratio")

STATUS, STARTED, FIX, ERROR, ETA, OBSERVED = 0, 1, 2, 5, 8, 10
TRAVEL, SPAN, PATH, HEADING, SPEED, DIRECTION = 12, 18, 19, 20, 21, 23
PENDING, BROKEN, UNAIDED, REJECTED, EXCITATION, COVARIANCE, CROSS = 25, 26, 27, 28, 29, 32, 57
MISFIT, MEMORY_SIZE = 72, 73
"""Places in the memory: the last fix, e at it, n^ and whether it was ever observed; W, h, the distance the
faster track turned, and the heading since that fix; speeds at the last tick, the directions in which tracks
last turned; time of ticks without speeds, whether the travel since the fix is unknown, and whether the gyro
was absent in it, how many fixes were rejected; mean of M'M (LL, LR, RR); covariance (5, 5) of the errors, and
(5, 3) of these with the noise of the last fix; square of the observation error over its variance, smoothed.
"""

MISFIT_S = 1.0
"""Over which the observation error is compared with its variance: about as long as efficiencies lag."""

_FURTHEST_M = 1e8  # no position on Earth is further from an origin on it
_FASTEST_RADPS = 50.0  # no gyro of a robot measures more
_PUSHED_RADPS = 0.05  # above the bias of a gyro
_LONGEST_S = 1e9  # at which clocks of a memory stop
_OK, _STARTING, _STANDING, _PREDICTED = (ObserverStatus(k).value for k in range(4))
_REJECTED, _RESET, _UNEXCITED, _PUSHED, _BAD = (ObserverStatus(k).value for k in range(4, 9))


@njit
def _moved_on(params: Array, after: Array, left: float, right: float, rate: float, dt_s: float) -> None:
    """Integrate M over a tick: speeds at its end, 0 of a track that stands, and its mean yaw rate."""
    mean_left, mean_right = 0.5 * (after[SPEED] + left), 0.5 * (after[SPEED + 1] + right)
    after[SPEED], after[SPEED + 1] = left, right
    if not math.isfinite(rate):
        after[UNAIDED] = 1.0
        rate = (after[ETA + 1] * mean_right - after[ETA] * mean_left) / (2.0 * params[at.HALF_TRACK])
    turn = dt_s * rate
    if dt_s > params[at.LONGEST_STEP]:
        after[BROKEN] = 1.0
    else:
        middle = after[HEADING] + 0.5 * turn
        cos, sin, half = 0.5 * math.cos(middle), 0.5 * math.sin(middle), 0.5 / params[at.HALF_TRACK]
        after[TRAVEL] += cos * mean_left * dt_s
        after[TRAVEL + 1] += cos * mean_right * dt_s
        after[TRAVEL + 2] += sin * mean_left * dt_s
        after[TRAVEL + 3] += sin * mean_right * dt_s
        after[TRAVEL + 4] -= half * mean_left * dt_s
        after[TRAVEL + 5] += half * mean_right * dt_s
        after[HEADING] += turn
        after[PATH] += max(abs(mean_left), abs(mean_right)) * dt_s
    after[SPAN] = min(after[SPAN] + dt_s, _LONGEST_S)
    fresh = -math.expm1(-dt_s / params[at.WINDOW])
    near = 0.25 / params[at.HALF_TRACK] ** 2
    after[EXCITATION] += fresh * ((0.25 + near) * mean_left * mean_left - after[EXCITATION])
    after[EXCITATION + 1] += fresh * ((0.25 - near) * mean_left * mean_right - after[EXCITATION + 1])
    after[EXCITATION + 2] += fresh * ((0.25 + near) * mean_right * mean_right - after[EXCITATION + 2])
    if left != 0.0 or right != 0.0:
        for i in (COVARIANCE + 18, COVARIANCE + 24):
            if after[i] < params[at.ETA_STD] ** 2:
                after[i] = min(after[i] + params[at.ETA_WALK] ** 2 * dt_s, params[at.ETA_STD] ** 2)
    for j in range(2):
        if after[SPEED + j] != 0.0:
            after[DIRECTION + j] = math.copysign(1.0, after[SPEED + j])


@njit
def _begin_at(params: Array, after: Array, pose: Array) -> None:
    """Begin the pose anew at a fix; efficiencies are kept."""
    cov, cross = after[COVARIANCE:CROSS].reshape(5, 5), after[CROSS:MISFIT].reshape(5, 3)
    cov[:3, :], cov[:, :3], cross[:, :] = 0.0, 0.0, 0.0
    for i in range(3):
        after[FIX + i], after[ERROR + i] = pose[i], 0.0
        std = params[at.POSITION_STD] if i < 2 else params[at.YAW_STD]
        cov[i, i], cross[i, i] = std * std, -std * std
    _begin_interval(after, pose[2])


@njit
def _begin_interval(after: Array, heading_rad: float) -> None:
    """Forget the travel before a fix."""
    after[TRAVEL:SPAN] = 0.0
    after[SPAN] = after[PATH] = after[BROKEN] = after[UNAIDED] = after[REJECTED] = 0.0
    after[HEADING] = heading_rad


@njit
def _is_plausible(params: Array, after: Array, pose: Array) -> bool:
    """Return whether noise, and efficiencies from 0 to 2, explain how a fix deviates from dead reckoning."""
    if after[BROKEN] != 0.0:
        return True
    off_x = pose[0] - after[FIX] - after[TRAVEL] * after[ETA] - after[TRAVEL + 1] * after[ETA + 1]
    off_y = pose[1] - after[FIX + 1] - after[TRAVEL + 2] * after[ETA] - after[TRAVEL + 3] * after[ETA + 1]
    n_std = math.sqrt(2.0) * params[at.GATE]
    turn = n_std * params[at.YAW_STD] + after[PATH] / params[at.HALF_TRACK]
    near = math.hypot(off_x, off_y) <= n_std * params[at.POSITION_STD] + after[PATH]
    return bool(near and abs(wrapped(pose[2] - after[HEADING])) <= turn)


@njit
def _correct(params: Array, after: Array, pose: Array) -> None:
    """Integrate the observer from the last fix to this one."""
    span, start = after[SPAN], after[FIX + 2]
    late = wrapped(pose[2] - after[HEADING])
    travel = after[TRAVEL:SPAN].copy().reshape(3, 2)
    cos, sin = math.cos(0.5 * late), math.sin(0.5 * late)
    for j in range(2):
        travel[0, j], travel[1, j] = (
            cos * travel[0, j] - sin * travel[1, j],
            sin * travel[0, j] + cos * travel[1, j],
        )
    moved = np.array([pose[0] - after[FIX], pose[1] - after[FIX + 1], after[HEADING] + late - start])
    gain = params[at.GAIN_X : at.GAIN_YAW + 1].copy()
    if params[at.NORMALISED] != 0.0:
        adaptation = normalised_gain(travel, span, gain, 0.25 * params[at.LEAST_SPEED] ** 2)
    else:
        adaptation = np.diag(params[at.ADAPT_LEFT : at.ADAPT_RIGHT + 1])
    eta = after[ETA : ETA + 2].copy()
    error, eta, whole, from_start, from_end = observe_interval(
        travel, span, gain, adaptation, after[ERROR : ERROR + 3].copy(), eta, moved
    )
    for j in range(2):
        if travel[0, j] != 0.0 or travel[1, j] != 0.0 or travel[2, j] != 0.0:
            after[ETA + j] = min(max(eta[j], 0.0), params[at.ETA_MAX])
            after[OBSERVED + j] = 1.0
    error[2] = wrapped(error[2])
    cov, cross = after[COVARIANCE:CROSS].reshape(5, 5), after[CROSS:MISFIT].reshape(5, 3)
    variance = np.full(3, params[at.POSITION_STD] ** 2)
    variance[2] = params[at.YAW_STD] ** 2
    shared = (whole @ cross) @ from_start.T
    fresh = whole @ cov @ whole.T + shared + shared.T
    fresh += (from_start * variance) @ from_start.T + (from_end * variance) @ from_end.T
    cov[:, :] = 0.5 * (fresh + fresh.T)
    cross[:, :] = from_end * variance
    after[ERROR : ERROR + 3], after[FIX : FIX + 3] = error, pose
    seen = cov[:3, :3].copy()
    for i in range(3):
        seen[i, i] += variance[i]
    square = error @ (inverse_3(seen) @ error) / 3.0
    after[MISFIT] += -math.expm1(-span / MISFIT_S) * (square - after[MISFIT])
    _begin_interval(after, pose[2])


@njit
def _take_fix(params: Array, after: Array, pose: Array) -> int:
    """Use, reject or begin anew at a fix; returns the status that it gives, -1 for none of its own."""
    if not (max(abs(pose[0]), abs(pose[1])) <= _FURTHEST_M and math.isfinite(pose[2])):
        return _REJECTED
    if after[STARTED] == 0.0:
        after[STARTED] = 1.0
        _begin_at(params, after, pose)
        return -1
    if not _is_plausible(params, after, pose):
        after[REJECTED] += 1.0
        if after[REJECTED] < params[at.N_RESET]:
            return _REJECTED
        _begin_at(params, after, pose)
        return _RESET
    if after[BROKEN] != 0.0 or after[SPAN] > params[at.LONGEST_INTERVAL]:
        _begin_at(params, after, pose)
        return _RESET
    if after[SPAN] > 1e-6:
        _correct(params, after, pose)
    return -1


_F8, _ROW = types.float64, types.Array(types.float64, 1, "A", readonly=True)
_NUMBERS = types.Array(types.float64, 1, "C", readonly=True)


@njit(_F8[::1](_NUMBERS, _NUMBERS, _ROW, _F8))
def tracked_step(params: Array, memory: Array, row: Array, dt_s: float) -> Array:
    """Return the next memory (MEMORY_SIZE,); see :data:`~terrain.estimation.observers.family.Step`.

    Parameters
    ----------
    params : (N_PARAMS,) of :func:`~terrain.estimation.observers.tracked_settings.tracked_params`
    memory : (MEMORY_SIZE,) of the step before
    row : (6,) of :data:`ROWS`
    dt_s : since the step before
    """
    after = memory.copy()
    left, right, rate = row[0], row[1], row[5]
    fast = not (abs(left) <= params[at.SPEED_MAX] and abs(right) <= params[at.SPEED_MAX])
    if not 0.0 <= dt_s < math.inf or fast:
        if dt_s > 0.0:
            after[PENDING] = min(after[PENDING] + dt_s, _LONGEST_S)
        after[STATUS] = _BAD
        return after
    dt = min(dt_s, _LONGEST_S) + after[PENDING]
    after[PENDING] = 0.0
    if abs(left) < params[at.STANDING]:
        left = 0.0
    if abs(right) < params[at.STANDING]:
        right = 0.0
    stands = left == 0.0 and right == 0.0
    if not abs(rate) <= _FASTEST_RADPS:
        rate = math.nan
    elif stands and abs(rate) < _PUSHED_RADPS:
        rate = 0.0
    _moved_on(params, after, left, right, rate, dt)
    status = -1
    if not (math.isnan(row[2]) or math.isnan(row[3]) or math.isnan(row[4])):
        status = _take_fix(params, after, row[2:5].copy())
    if status < 0:
        if after[STARTED] == 0.0:
            status = _STARTING
        elif stands:
            status = _PUSHED if abs(rate) >= _PUSHED_RADPS else _STANDING
        elif after[SPAN] > params[at.PREDICTED_AFTER]:
            status = _PREDICTED
        else:
            status = _UNEXCITED if left == 0.0 or right == 0.0 else _OK
    after[STATUS] = status
    return after


@njit(types.Tuple((_F8[::1], _F8[::1], _F8[::1], _F8[::1], types.int64))(_NUMBERS, _NUMBERS))
def _read(params: Array, memory: Array) -> tuple[Array, Array, Array, Array, int]:
    mean, std = np.full(len(STATES), np.nan), np.full(len(STATES), np.nan)
    slip, slip_std = np.full(2, np.nan), np.full(2, np.nan)
    left, right, half = memory[SPEED], memory[SPEED + 1], 0.5 / params[at.HALF_TRACK]
    eta, cov = memory[ETA : ETA + 2], memory[COVARIANCE:CROSS].reshape(5, 5)
    wider = max(memory[MISFIT], 1.0)
    ll, lr, rr = cov[3, 3] * wider, cov[3, 4] * wider, cov[4, 4] * wider
    mean[3], mean[4] = 0.5 * (eta[0] * left + eta[1] * right), half * (eta[1] * right - eta[0] * left)
    common, cross = left * left * ll + right * right * rr, 2.0 * left * right * lr
    std[3], std[4] = 0.5 * math.sqrt(max(common + cross, 0.0)), half * math.sqrt(max(common - cross, 0.0))
    mean[5], mean[6], std[5], std[6] = eta[0], eta[1], math.sqrt(ll), math.sqrt(rr)
    a, b, c = memory[EXCITATION], memory[EXCITATION + 1], memory[EXCITATION + 2]
    smallest = 0.5 * (a + c) - math.hypot(0.5 * (a - c), b)
    mean[7] = math.sqrt(max(smallest, 0.0))
    if memory[STARTED] != 0.0:
        ahead, variance = np.empty(3), np.empty(3)
        for i in range(3):
            u, v = memory[TRAVEL + 2 * i], memory[TRAVEL + 2 * i + 1]
            ahead[i] = u * eta[0] + v * eta[1]
            mean[i] = memory[FIX + i] - memory[ERROR + i] + ahead[i]
            variance[i] = cov[i, i] + u * u * ll + 2.0 * u * v * lr + v * v * rr
            variance[i] += 2.0 * (u * cov[i, 3] + v * cov[i, 4])
        if memory[UNAIDED] == 0.0:
            mean[2] = memory[HEADING] - memory[ERROR + 2]
            variance[2] = cov[2, 2] + (params[at.GYRO] * memory[SPAN]) ** 2
        # half of what the heading is off by at the end acts on the distance since the fix
        heading = params[at.YAW_STD] ** 2 + 0.25 * max(variance[2] - cov[2, 2], 0.0)
        variance[0] += ahead[1] * ahead[1] * heading
        variance[1] += ahead[0] * ahead[0] * heading
        std[:3] = np.sqrt(np.maximum(variance, 0.0))
        mean[2] = wrapped(mean[2])
        mean[8] = math.sqrt(memory[ERROR] ** 2 + memory[ERROR + 1] ** 2 + memory[ERROR + 2] ** 2)
    for j in range(2):
        if memory[OBSERVED + j] != 0.0:
            larger = max(eta[j], 1.0)
            slip[j] = memory[DIRECTION + j] * (1.0 - eta[j]) / larger
            slip_std[j] = std[5 + j] / (larger * larger)
    return mean, std, slip, slip_std, int(memory[STATUS])


def read_tracked(params: Array, memory: Array) -> ObserverOutput:
    """Return what a memory says; the pose and slip are NaN before anything was observed.

    Excitation and observation error are computed, not estimated: they have no standard deviation.
    """
    return ObserverOutput(*_read(params, memory))


DEFAULT_SETTINGS = TrackedSettings()


def tracked_observer(robot: TrackedRobot, settings: TrackedSettings = DEFAULT_SETTINGS) -> Observer:
    """Return the adaptive observer of a tracked vehicle.

    Parameters
    ----------
    robot : tracked
    settings : gains, noise and limits

    Raises
    ------
    ConfigError
        if a setting is not above zero and finite.

    Examples
    --------
    >>> from terrain.estimation.observers.family import observe
    >>> from terrain.robots import load_robot
    >>> robot = load_robot("orchard_ugv")
    >>> time_s = np.arange(0.0, 20.0, 0.1)
    >>> rows = np.tile([0.6, 0.6, 0.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    >>> rows[:, 2] = 0.87 * 0.6 * time_s
    >>> track = observe(tracked_observer(robot), time_s, rows)
    >>> track.slip[-1].round(3), ObserverStatus(track.status[-1]).name
    (array([0.128, 0.128]), 'OK')
    """
    params = tracked_params(robot, settings)
    start = np.zeros(MEMORY_SIZE)
    start[ETA : ETA + 2] = start[DIRECTION : DIRECTION + 2] = 1.0
    start[STATUS] = _STARTING
    start[COVARIANCE + 18] = start[COVARIANCE + 24] = params[at.ETA_STD] ** 2
    return Observer("tracked", STATES, SLIPS, ROWS, params, start, tracked_step, read_tracked)
