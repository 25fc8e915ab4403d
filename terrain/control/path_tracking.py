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

Settings of path tracking (:mod:`terrain.control.path_tracking`), and whether its loops are stable.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types
from scipy.linalg import expm

from terrain.angles import wrapped
from terrain.control.pid import LONGEST_STEP_S, Gains, PidState, PidStatus, pid_step
from terrain.control.stability import DELAY_S, SAMPLE_TIME_S, spectral_radius
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot
from terrain.status import StatusCode

MOVING_MPS = 0.05
"""From this speed on a motion has a direction."""

N_SPEEDS = 12


class TrackSettings(NamedTuple):
    """Gains and limits of path tracking; tuned on simulated drives whose seeds are used nowhere else.

    Parameters
    ----------
    arm_m : L; half the wheelbase, so that a correction of the heading is that angle of the steering
    heading_pm, heading_integral_pm2 : k and k_I of the heading, rad of steering per m of L times heading
    cross_pm, cross_integral_pm2 : the same per m of cross-track error; slower, as it is less urgent
    heading_max_rad : clamp, as a steering angle: four times the backlash
    cross_max_rad : the same; a side slope of 5 degrees on grass takes 0.2, which no backlash does
    heading_fastest_ps, cross_fastest_ps : bandwidths above which the delays would matter
    lag_s : from a desired twist to the estimated motion: delay, speed loop, steering and filter
    yaw_std_max_rad : a heading that is less certain is not used; it is compared with changes of the heading,
        which are known better
    stale_max_s : without a measured speed over ground for longer, the position is not used
    """

    arm_m: float = 0.5075
    heading_pm: float = 3.0
    heading_integral_pm2: float = 0.7
    cross_pm: float = 1.0
    cross_integral_pm2: float = 0.2
    heading_max_rad: float = 0.08
    cross_max_rad: float = 0.3
    heading_fastest_ps: float = 3.0
    cross_fastest_ps: float = 1.5
    lag_s: float = 0.15
    yaw_std_max_rad: float = 0.1
    stale_max_s: float = 3.0


SETTINGS = TrackSettings()


def check_tracking(
    robot: Robot, settings: TrackSettings = SETTINGS, delay_s: float = DELAY_S, *, dt_s: float = SAMPLE_TIME_S
) -> TrackSettings:
    """Return settings that can be used, as floats.

    Parameters
    ----------
    robot : with its sections
    settings : to check
    delay_s : from the estimate to the wheels, beside the filter's lag
    dt_s : sample time

    Raises
    ------
    ConfigError
        if a setting is negative or not finite, one other than a gain or the lag is 0, or a loop is unstable
        at some speed of the robot.

    Notes
    -----
    Heading and position each, in metres x, behind the filter y, with the steering s and the side force f,
    both first-order lags, at speed v; the command u is held from sample to sample and is delayed::

        x' = v f,  f' = (s - f) v / sigma,  s' = (u - s) / tau_s,  y' = (x - y) / tau_encoder

    ``tau_s`` is half the time in which the steering's acceleration crosses its backlash.  The position
    follows the heading and not the reverse, so the loops are checked one by one.  Backlash is not modelled.
    With the default delay and integral, AgriMaRo's heading is stable up to a bandwidth of 9 rad/s; 3 is set.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> check_tracking(load_robot("agrimaro")) == SETTINGS
    True
    >>> check_tracking(load_robot("agrimaro"), SETTINGS._replace(heading_pm=12.0, heading_fastest_ps=12.0))
    Traceback (most recent call last):
    terrain.errors.ConfigError: path tracking: heading_pm 12 and heading_integral_pm2 0.7 with a delay of
    0.05 s are unstable from 1.02 to 2 m/s
    """
    for name, value in settings._asdict().items():
        zero = name in ("lag_s",) or "integral" in name or name.endswith("_pm")
        valid = not isinstance(value, bool) and isinstance(value, int | float) and math.isfinite(value)
        if not valid or not (value >= 0.0 if zero else value > 0.0):
            accepted = "a number from zero up" if zero else "a number above zero"
            raise ConfigError(f"path tracking: {name} is {value!r}, {accepted} is required")
    for name, value, least in (("delay_s", delay_s, 0.0), ("dt_s", dt_s, 1e-3)):
        if not least <= value <= LONGEST_STEP_S:
            raise ConfigError(
                f"path tracking: {name} is {value!r}, {least:g} to {LONGEST_STEP_S:g} s is required"
            )
    fastest_mps = robot.wheel_radius_m * robot.equipment.motors.speed_max_radps
    speeds_mps = np.geomspace(MOVING_MPS, fastest_mps, N_SPEEDS).tolist()
    for loop in ("heading", "cross"):
        k, k_i = getattr(settings, f"{loop}_pm"), getattr(settings, f"{loop}_integral_pm2")
        fastest_ps = getattr(settings, f"{loop}_fastest_ps")
        gains = (k, k_i, fastest_ps)
        radii = [spectral_radius(_loop_matrix(robot, gains, delay_s, dt_s, speed)) for speed in speeds_mps]
        bad = [speed for speed, radius in zip(speeds_mps, radii, strict=True) if radius >= 1.0 + 1e-9]
        if bad:
            raise ConfigError(
                f"path tracking: {loop}_pm {k:g} and {loop}_integral_pm2 {k_i:g} with a delay of "
                f"{delay_s:g} s are unstable from {bad[0]:.3g} to {bad[-1]:.3g} m/s"
            )
    return TrackSettings(*(float(value) for value in settings))


def _loop_matrix(
    robot: Robot, gains: tuple[float, float, float], delay_s: float, dt_s: float, speed_mps: float
) -> Array:
    """Return the loop from sample to sample: x, f, s, y, the integral, the delayed commands."""
    body, _, steering, _, sensors = robot.equipment
    n_delayed = max(math.ceil(delay_s / dt_s - 1e-9), 1)
    plant = np.zeros((5, 5))  # the fifth is the command, held
    plant[0, 1] = speed_mps
    plant[1, [2, 1]] = np.array([1.0, -1.0]) * speed_mps / body.relaxation_length_m
    steering_s = max(math.sqrt(steering.dead_band_rad / steering.accel_max_radps2), 1e-3)
    plant[2, [4, 2]] = np.array([1.0, -1.0]) / steering_s
    plant[3, [0, 3]] = np.array([1.0, -1.0]) / max(sensors.encoder_time_constant_s, 1e-3)
    over = expm(plant * dt_s)
    k, k_i, fastest_ps = gains
    slower = min(1.0, fastest_ps / max(k * speed_mps, 1e-9))
    one, loop = np.eye(5 + n_delayed), np.zeros((5 + n_delayed, 5 + n_delayed))
    loop[:4, :4] = over[:4, :4]
    loop[:4] += np.outer(over[:4, 4], one[-1])
    loop[4] = one[4] - slower * k_i * speed_mps * dt_s * one[3]
    loop[5] = loop[4] - slower * k * one[3]
    loop[6:] = one[5:-1]
    return loop


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
    settings : as :func:`~terrain.control.path_tracking.check_tracking` gives them
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
    >>> from terrain.control.path_tracking import SETTINGS
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
