"""Path tracking: heading and position are controlled to the path that the desired twists integrate to.

Dead band of the steering, backlash of the third leg, uneven loads and soil turn the robot and push it aside
(Danzi, AgriMaRo thesis, conclusion; their correction is left open there).  With the desired twist u,
``|u|^2 = v_x^2 + v_y^2 + (L w)^2``, pose p, reference pose p* and error ``e = p - p*``, positions in metres
and headings times L::

    f = u, delayed as the estimated motion is           t = (e . f) / |f|^2, bounded
    p* moves along f for the time t                     (reference: it waits for the robot)
    e' = e - d (e . d),  d = u / |u|                    (error across the desired motion)
    c = -(k e' + k_I integral e' ds)                    (correction per metre, ds = |u| dt)
    u + |u| (c - d (c . d))                             (commanded twist)

- The reference advances by the distance travelled, not by the clock: slip, or a traction controller that
  limits the speed, is no error, and a correction neither drives nor brakes.  The direction of travel is that
  of the desired twist: forward, backward, sideways, along an arc, or the angle of a turn on the spot, where
  the position is held.
- Gains are per metre travelled: an error gives the same steering angle at any speed.  Above ``fastest / k``
  they fall with the speed, as the delays are in seconds.
- Corrections are angles of the steering, clamped; the integral is kept where the clamp is active.
- At rest the reference is the robot's pose, and integrals are 0: a drive starts from where the robot is.
  When the desired direction turns by more than 60 degrees, and while the robot moves that far from it, the
  position of the reference is reset and its heading is kept.
- A pose that jumps against the ground speed is relocalisation: the reference jumps with it, so nothing is
  corrected.  Without a pose for more than half a second, both are reset.

Within the backlash a correction has no effect: with a proportional gain alone up to ``backlash / (k L)`` of
heading error remains; the integral removes it within a few metres.  Integral and backlash together give a
slow limit cycle; a proportional gain that is large beside it keeps that to milliradians, and to some
centimetres of cross-track error.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types

from terrain.angles import wrapped
from terrain.control.pid import LONGEST_STEP_S, Gains, PidState, PidStatus, pid_step
from terrain.control.tracking_settings import MOVING_MPS, TrackSettings
from terrain.records import Array
from terrain.status import StatusCode


class TrackStatus(StatusCode):
    """Whether the twist is corrected: yes, up to a clamp, or not, and why."""

    OK = 0
    CLAMPED = 1
    STANDING = 2
    NO_POSE = 3
    UNCERTAIN = 4
    STALE = 5
    BAD_TIME = 6


class PoseEstimate(NamedTuple):
    """Estimated pose of the body's origin in the world.

    Parameters
    ----------
    x_m, y_m, yaw_rad : pose; whole turns of the heading do not matter
    yaw_std_rad : standard deviation of the heading
    stale_s : time since the speed over ground was measured last
    """

    x_m: float
    y_m: float
    yaw_rad: float
    yaw_std_rad: float
    stale_s: float


class TrackReport(NamedTuple):
    """Errors, NaN where nothing is corrected, and the correction.

    Parameters
    ----------
    heading_error_rad : of the robot
    cross_track_m : distance from the path, positive to its left
    correction_rad : magnitude, as a steering angle
    status : number of a :class:`TrackStatus`
    """

    heading_error_rad: float
    cross_track_m: float
    correction_rad: float
    status: int


_STAND_MPS = 0.02  # slower is standing: a tenth of the speed that counts as a drive
_TURNED = 0.5  # cosine of 60 degrees
_JUMP_M, _JUMP_RAD = 0.02, 0.02  # a filter moves its pose by less than a tenth of it beside the motion
_BLIND_S = 0.5  # longer without a pose, and the reference is lost
_BACK, _AHEAD = 1.0, 3.0  # limits of the reference's speed, in multiples of the desired one

_POSE, _DELAYED, _INTEGRAL, _LAST, _BLIND, _ANCHORED = 0, 3, 9, 12, 15, 16
STATE_SIZE = 17

_F8 = types.float64
_ROW = types.Array(_F8, 1, "A", readonly=True)
_SETTINGS = types.NamedUniTuple(_F8, len(TrackSettings._fields), TrackSettings)
_ESTIMATE = types.NamedUniTuple(_F8, len(PoseEstimate._fields), PoseEstimate)
_REPORT = types.NamedTuple((_F8, _F8, _F8, types.int64), TrackReport)


def initial_tracking() -> Array:
    """Return the state (STATE_SIZE,) before the first step."""
    return np.zeros(STATE_SIZE)


@njit(cache=True)
def _pose_status(settings: TrackSettings, pose: PoseEstimate, ground_twist: Array) -> int:
    """Return whether a pose can be used."""
    known = math.isfinite(pose.yaw_rad) and math.isfinite(pose.x_m) and math.isfinite(pose.y_m)
    for j in range(3):
        known = known and math.isfinite(ground_twist[j])
    if not known:
        return TrackStatus.NO_POSE.value
    if not pose.yaw_std_rad <= settings.yaw_std_max_rad:
        return TrackStatus.UNCERTAIN.value
    return TrackStatus.OK.value if pose.stale_s <= settings.stale_max_s else TrackStatus.STALE.value


@njit(cache=True)
def _follow_jump(state: Array, after: Array, pose: PoseEstimate, ground_twist: Array, dt_s: float) -> None:
    """Move the reference with a pose that jumps away from the motion."""
    middle = state[_LAST + 2] + 0.5 * dt_s * ground_twist[2]
    cos, sin = math.cos(middle), math.sin(middle)
    due_x = state[_LAST] + dt_s * (cos * ground_twist[0] - sin * ground_twist[1])
    due_y = state[_LAST + 1] + dt_s * (sin * ground_twist[0] + cos * ground_twist[1])
    jump = wrapped(pose.yaw_rad - state[_LAST + 2] - dt_s * ground_twist[2])
    if abs(jump) > _JUMP_RAD or math.hypot(pose.x_m - due_x, pose.y_m - due_y) > _JUMP_M:
        cos, sin = math.cos(jump), math.sin(jump)
        off_x, off_y = after[_POSE] - due_x, after[_POSE + 1] - due_y
        after[_POSE] = pose.x_m + cos * off_x - sin * off_y
        after[_POSE + 1] = pose.y_m + sin * off_x + cos * off_y
        after[_POSE + 2] += jump


@njit(cache=True)
def _delay_desired(
    settings: TrackSettings,
    after: Array,
    desired_twist: Array,
    size: float,
    pose: PoseEstimate,
    ground_twist: Array,
    dt_s: float,
) -> float:
    """Delay the desired twist as the estimated motion is, and return the square of its size.

    Where the direction has turned, or the robot does not move along it, the reference's position is reset.
    """
    keep = math.exp(-2.0 * dt_s / settings.lag_s) if settings.lag_s > 0.0 else 0.0
    same, late2, ground2, moved = 0.0, 0.0, 0.0, 0.0
    for j in range(3):
        unit = settings.arm_m if j == 2 else 1.0
        after[_DELAYED + 3 + j] += (1.0 - keep) * (desired_twist[j] - after[_DELAYED + 3 + j])
        after[_DELAYED + j] += (1.0 - keep) * (after[_DELAYED + 3 + j] - after[_DELAYED + j])
        same += unit * unit * after[_DELAYED + j] * desired_twist[j]
        late2 += (unit * after[_DELAYED + j]) ** 2
        moved += unit * unit * ground_twist[j] * desired_twist[j]
        ground2 += (unit * ground_twist[j]) ** 2
    turned = same < _TURNED * size * math.sqrt(late2)
    if turned or (ground2 > MOVING_MPS**2 and moved < _TURNED * size * math.sqrt(ground2)):
        after[_POSE], after[_POSE + 1] = pose.x_m, pose.y_m
        after[_INTEGRAL] = after[_INTEGRAL + 1] = after[_INTEGRAL + 2] = 0.0
        if turned:
            for j in range(3):
                after[_DELAYED + j] = after[_DELAYED + 3 + j] = desired_twist[j]
            late2 = size * size
    return late2


@njit(cache=True)
def _advance_reference(
    settings: TrackSettings, after: Array, pose: PoseEstimate, late2: float, dt_s: float
) -> None:
    """Move the reference along the delayed twist, to where it is nearest to the robot."""
    arm = settings.arm_m
    late_x, late_y, late_turn = after[_DELAYED], after[_DELAYED + 1], after[_DELAYED + 2]
    cos, sin = math.cos(after[_POSE + 2]), math.sin(after[_POSE + 2])
    off_x, off_y = pose.x_m - after[_POSE], pose.y_m - after[_POSE + 1]
    ahead_s = (
        (cos * off_x + sin * off_y) * late_x
        + (cos * off_y - sin * off_x) * late_y
        + arm * arm * wrapped(pose.yaw_rad - after[_POSE + 2]) * late_turn
    ) / late2
    ahead_s = min(max(ahead_s, -_BACK * dt_s), _AHEAD * dt_s)
    middle = after[_POSE + 2] + 0.5 * ahead_s * late_turn
    cos, sin = math.cos(middle), math.sin(middle)
    after[_POSE] += ahead_s * (cos * late_x - sin * late_y)
    after[_POSE + 1] += ahead_s * (sin * late_x + cos * late_y)
    after[_POSE + 2] += ahead_s * late_turn


@njit(cache=True)
def _correct(
    settings: TrackSettings, after: Array, command: Array, size: float, pose: PoseEstimate, dt_s: float
) -> TrackReport:
    """Correct the twist ``command`` in place by the errors across the desired motion.

    Errors are along x, along y and L times heading, in metres.
    """
    arm, status = settings.arm_m, TrackStatus.OK.value
    cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    off_x, off_y = pose.x_m - after[_POSE], pose.y_m - after[_POSE + 1]
    error = np.array([cos * off_x + sin * off_y, cos * off_y - sin * off_x, 0.0])
    error[2] = arm * wrapped(pose.yaw_rad - after[_POSE + 2])
    along = np.array([command[0] / size, command[1] / size, arm * command[2] / size])
    error -= along * (error[0] * along[0] + error[1] * along[1] + error[2] * along[2])
    correction = np.empty(3)
    for j in range(3):
        if j == 2:
            k, k_i, limit = settings.heading_pm, settings.heading_integral_pm2, settings.heading_max_rad
            fastest = settings.heading_fastest_ps
        else:
            k, k_i, limit = settings.cross_pm, settings.cross_integral_pm2, settings.cross_max_rad
            fastest = settings.cross_fastest_ps
        slower = min(1.0, fastest / max(k * size, 1e-9))
        gains = Gains(slower * k, slower * k_i, 0.0, limit, limit, 0.0)
        memory = PidState(after[_INTEGRAL + j], math.nan)
        correction[j], memory, pid = pid_step(gains, memory, -error[j], min(size * dt_s, LONGEST_STEP_S))
        after[_INTEGRAL + j] = memory.integral
        if pid != PidStatus.OK.value:
            status = TrackStatus.CLAMPED.value
    correction -= along * (correction[0] * along[0] + correction[1] * along[1] + correction[2] * along[2])
    command[0] += size * correction[0]
    command[1] += size * correction[1]
    command[2] += size * correction[2] / arm
    cross_m = math.copysign(math.hypot(error[0], error[1]), along[0] * error[1] - along[1] * error[0])
    angle = math.sqrt(correction[0] ** 2 + correction[1] ** 2 + correction[2] ** 2)
    return TrackReport(error[2] / arm, cross_m, angle, status)


@njit(types.Tuple((_F8[::1], _F8[::1], _REPORT))(_SETTINGS, _F8[::1], _ROW, _ESTIMATE, _ROW, _F8), cache=True)
def track_step(
    settings: TrackSettings,
    state: Array,
    desired_twist: Array,
    pose: PoseEstimate,
    ground_twist: Array,
    dt_s: float,
) -> tuple[Array, Array, TrackReport]:
    """Return the twist to drive, the next state, and why; compiled, the state is not changed.

    Parameters
    ----------
    settings : as :func:`~terrain.control.tracking_settings.check_tracking` gives them
    state : :func:`initial_tracking` at first, then what the step before returned
    desired_twist : (3,) finite
    pose : as estimated, its numbers floats
    ground_twist : (3,) as estimated
    dt_s : since the step before

    Returns
    -------
    twist : (3,)
    state : the next
    report : errors, correction and status

    Examples
    --------
    >>> from terrain.control.tracking_settings import SETTINGS
    >>> ahead = np.array([1.0, 0.0, 0.0])
    >>> at = PoseEstimate(0.0, 0.0, 0.0, yaw_std_rad=0.001, stale_s=0.0)
    >>> _, state, _ = track_step(SETTINGS, initial_tracking(), ahead, at, ahead, 0.02)
    >>> at = at._replace(x_m=0.02, yaw_rad=0.01)  # turned to the left
    >>> twist, state, report = track_step(SETTINGS, state, ahead, at, ahead, 0.02)
    >>> twist.round(3), round(report.heading_error_rad, 3), TrackStatus(report.status).name
    (array([ 1.  ,  0.  , -0.03]), 0.01, 'OK')
    """
    command, after = np.empty(3), state.copy()
    command[0], command[1], command[2] = desired_twist[0], desired_twist[1], desired_twist[2]
    if not 0.0 < dt_s <= LONGEST_STEP_S:
        return command, after, TrackReport(math.nan, math.nan, 0.0, TrackStatus.BAD_TIME.value)
    status = _pose_status(settings, pose, ground_twist)
    if status != TrackStatus.OK.value:
        after[_BLIND] = state[_BLIND] + dt_s
        if after[_BLIND] > _BLIND_S:
            after[_ANCHORED] = 0.0
        return command, after, TrackReport(math.nan, math.nan, 0.0, status)
    size = math.sqrt(command[0] ** 2 + command[1] ** 2 + (settings.arm_m * command[2]) ** 2)
    if after[_ANCHORED] == 0.0 or size < _STAND_MPS:
        after[:] = 0.0
        after[_POSE], after[_POSE + 1], after[_POSE + 2] = pose.x_m, pose.y_m, pose.yaw_rad
        after[_ANCHORED] = 1.0
    elif after[_BLIND] == 0.0:
        _follow_jump(state, after, pose, ground_twist, dt_s)
    after[_BLIND] = 0.0
    after[_LAST], after[_LAST + 1], after[_LAST + 2] = pose.x_m, pose.y_m, pose.yaw_rad
    if size < _STAND_MPS:
        return command, after, TrackReport(math.nan, math.nan, 0.0, TrackStatus.STANDING.value)
    late2 = _delay_desired(settings, after, desired_twist, size, pose, ground_twist, dt_s)
    if late2 > 0.0:
        _advance_reference(settings, after, pose, late2, dt_s)
    return command, after, _correct(settings, after, command, size, pose, dt_s)
