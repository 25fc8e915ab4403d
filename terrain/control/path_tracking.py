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
from scipy.linalg import expm

from terrain.angles import wrapped
from terrain.control.pid import LONGEST_STEP_S, Gains, PidState, PidStatus, pid_step
from terrain.control.stability import DELAY_S, SAMPLE_TIME_S, closed_loop, spectral_radius
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
    *_, seen, integral = np.eye(5)
    integral = integral - slower * k_i * speed_mps * dt_s * seen
    return closed_loop(over[:4, :4], over[:4, 4], integral[None], integral - slower * k * seen, n_delayed)


Twist = tuple[float, float, float]
"""Forward, left and turn; or a pose."""


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
    status : whether the twist was corrected
    """

    heading_error_rad: float
    cross_track_m: float
    correction_rad: float
    status: TrackStatus


class TrackState(NamedTuple):
    """What a step leaves to the next.

    Parameters
    ----------
    reference : x, y and heading p* of the path; None where there is none, as at first
    desired_once, desired : desired twist behind one and two low-passes
    integral : of the errors along x, along y and of the heading, as corrections
    last : x, y and heading of the robot
    blind_s : time without a pose
    """

    reference: Twist | None = None
    desired_once: Twist = (0.0, 0.0, 0.0)
    desired: Twist = (0.0, 0.0, 0.0)
    integral: Twist = (0.0, 0.0, 0.0)
    last: Twist = (0.0, 0.0, 0.0)
    blind_s: float = 0.0


_NO_ERRORS = (0.0, 0.0, 0.0)
_STAND_MPS = 0.02  # slower is standing: a tenth of the speed that counts as a drive
_TURNED = 0.5  # cosine of 60 degrees
_JUMP_M, _JUMP_RAD = 0.02, 0.02  # a filter moves its pose by less than a tenth of it beside the motion
_BLIND_S = 0.5  # longer without a pose, and the reference is lost
_BACK, _AHEAD = 1.0, 3.0  # limits of the reference's speed, in multiples of the desired one


def _rotated(angle_rad: float, x: float, y: float) -> tuple[float, float]:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return cos * x - sin * y, sin * x + cos * y


def _seen_along(yaw_rad: float, x: float, y: float) -> tuple[float, float]:
    """Return a vector of the world in axes of this heading."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return cos * x + sin * y, cos * y - sin * x


def _pose_status(settings: TrackSettings, pose: PoseEstimate, ground: Twist) -> TrackStatus:
    """Return whether a pose can be used."""
    if not all(map(math.isfinite, (*pose[:3], *ground))):
        return TrackStatus.NO_POSE
    if not pose.yaw_std_rad <= settings.yaw_std_max_rad:
        return TrackStatus.UNCERTAIN
    return TrackStatus.OK if pose.stale_s <= settings.stale_max_s else TrackStatus.STALE


def _after_jump(reference: Twist, last: Twist, pose: PoseEstimate, ground: Twist, dt_s: float) -> Twist:
    """Return the reference, which jumps with a pose that jumps away from the motion."""
    forward, left, turn = ground
    step_x, step_y = _rotated(last[2] + 0.5 * dt_s * turn, forward, left)
    due_x, due_y = last[0] + dt_s * step_x, last[1] + dt_s * step_y
    jump = float(wrapped(pose.yaw_rad - last[2] - dt_s * turn))
    if not (abs(jump) > _JUMP_RAD or math.hypot(pose.x_m - due_x, pose.y_m - due_y) > _JUMP_M):
        return reference
    off_x, off_y = _rotated(jump, reference[0] - due_x, reference[1] - due_y)
    return pose.x_m + off_x, pose.y_m + off_y, reference[2] + jump


def _delayed(settings: TrackSettings, state: TrackState, twist: Twist, dt_s: float) -> TrackState:
    """Delay the desired twist as the estimated motion is."""
    part = 1.0 - (math.exp(-2.0 * dt_s / settings.lag_s) if settings.lag_s > 0.0 else 0.0)

    def low_passed(before: Twist, new: Twist) -> Twist:
        x, y, turn = (late + part * (value - late) for late, value in zip(before, new, strict=True))
        return x, y, turn

    once = low_passed(state.desired_once, twist)
    return state._replace(desired_once=once, desired=low_passed(state.desired, once))


def _advanced(
    settings: TrackSettings, state: TrackState, pose: PoseEstimate, late2: float, dt_s: float
) -> Twist:
    """Return the reference, moved along the delayed twist to where it is nearest to the robot."""
    assert state.reference is not None
    (x, y, yaw), (forward, left, turn), arm = state.reference, state.desired, settings.arm_m
    ahead, beside = _seen_along(yaw, pose.x_m - x, pose.y_m - y)
    turned = arm * arm * float(wrapped(pose.yaw_rad - yaw)) * turn
    ahead_s = (ahead * forward + beside * left + turned) / late2
    ahead_s = min(max(ahead_s, -_BACK * dt_s), _AHEAD * dt_s)
    step_x, step_y = _rotated(yaw + 0.5 * ahead_s * turn, forward, left)
    return x + ahead_s * step_x, y + ahead_s * step_y, yaw + ahead_s * turn


def _corrected(
    settings: TrackSettings, state: TrackState, twist: Twist, size: float, pose: PoseEstimate, dt_s: float
) -> tuple[Twist, Twist, TrackReport]:
    """Return the twist corrected by the errors across the desired motion, and the integrals.

    Errors are along x, along y and L times heading, in metres.
    """
    assert state.reference is not None
    (x, y, yaw), arm, status = state.reference, settings.arm_m, TrackStatus.OK
    ahead, beside = _seen_along(pose.yaw_rad, pose.x_m - x, pose.y_m - y)
    along = twist[0] / size, twist[1] / size, arm * twist[2] / size
    error = _across((ahead, beside, arm * float(wrapped(pose.yaw_rad - yaw))), along)
    cross = (
        settings.cross_pm,
        settings.cross_integral_pm2,
        settings.cross_max_rad,
        settings.cross_fastest_ps,
    )
    heading = (
        *(settings.heading_pm, settings.heading_integral_pm2),
        *(settings.heading_max_rad, settings.heading_fastest_ps),
    )
    added, integrals = [], []
    for value, integral, (k, k_i, limit, fastest) in zip(
        error, state.integral, (cross, cross, heading), strict=True
    ):
        slower = min(1.0, fastest / max(k * size, 1e-9))
        gains = Gains(slower * k, slower * k_i, 0.0, limit, limit, 0.0)
        one, pid, found = pid_step(gains, PidState(integral), -value, min(size * dt_s, LONGEST_STEP_S))
        added.append(one)
        integrals.append(pid.integral)
        if found is not PidStatus.OK:
            status = TrackStatus.CLAMPED
    to_x, to_y, to_turn = _across((added[0], added[1], added[2]), along)
    command = twist[0] + size * to_x, twist[1] + size * to_y, twist[2] + size * to_turn / arm
    cross_m = math.copysign(math.hypot(error[0], error[1]), along[0] * error[1] - along[1] * error[0])
    angle = math.sqrt(to_x * to_x + to_y * to_y + to_turn * to_turn)
    return (
        command,
        (integrals[0], integrals[1], integrals[2]),
        TrackReport(error[2] / arm, cross_m, angle, status),
    )


def _across(vector: Twist, along: Twist) -> Twist:
    """Return a vector without its part along a unit vector."""
    part = vector[0] * along[0] + vector[1] * along[1] + vector[2] * along[2]
    return vector[0] - along[0] * part, vector[1] - along[1] * part, vector[2] - along[2] * part


def track_step(
    settings: TrackSettings,
    state: TrackState,
    desired_twist: Array,
    pose: PoseEstimate,
    ground_twist: Array,
    dt_s: float,
) -> tuple[Array, TrackState, TrackReport]:
    """Return the twist to drive, the next state, and why.

    Parameters
    ----------
    settings : as :func:`check_tracking` gives them
    state : ``TrackState()`` at first, then what the step before returned
    desired_twist : (3,) finite
    pose, ground_twist : as estimated; (3,)
    dt_s : since the step before

    Returns
    -------
    twist : (3,)
    state : the next
    report : errors, correction and status

    Examples
    --------
    >>> ahead = np.array([1.0, 0.0, 0.0])
    >>> at = PoseEstimate(0.0, 0.0, 0.0, yaw_std_rad=0.001, stale_s=0.0)
    >>> _, state, _ = track_step(SETTINGS, TrackState(), ahead, at, ahead, 0.02)
    >>> at = at._replace(x_m=0.02, yaw_rad=0.01)  # turned to the left
    >>> twist, state, report = track_step(SETTINGS, state, ahead, at, ahead, 0.02)
    >>> twist.round(3), round(report.heading_error_rad, 3), report.status.name
    (array([ 1.  ,  0.  , -0.03]), 0.01, 'OK')
    """
    twist, ground = tuple(desired_twist.tolist()), tuple(ground_twist.tolist())

    def uncorrected(status: TrackStatus) -> TrackReport:
        return TrackReport(math.nan, math.nan, 0.0, status)

    if not 0.0 < dt_s <= LONGEST_STEP_S:
        return np.array(twist), state, uncorrected(TrackStatus.BAD_TIME)
    status = _pose_status(settings, pose, ground)
    if status is not TrackStatus.OK:
        blind_s = state.blind_s + dt_s
        reference = None if blind_s > _BLIND_S else state.reference
        return np.array(twist), state._replace(blind_s=blind_s, reference=reference), uncorrected(status)
    arm, at = settings.arm_m, pose[:3]
    size = math.sqrt(twist[0] * twist[0] + twist[1] * twist[1] + (arm * twist[2]) * (arm * twist[2]))
    if state.reference is None or size < _STAND_MPS:
        state = TrackState(reference=at)
    elif state.blind_s == 0.0:
        state = state._replace(reference=_after_jump(state.reference, state.last, pose, ground, dt_s))
    state = state._replace(last=at, blind_s=0.0)
    if size < _STAND_MPS:
        return np.array(twist), state, uncorrected(TrackStatus.STANDING)
    state = _delayed(settings, state, twist, dt_s)
    late2, same = _products(arm, state.desired, twist)
    ground2, moves = _products(arm, ground, twist)
    turned = same < _TURNED * size * math.sqrt(late2)
    if turned or (ground2 > MOVING_MPS * MOVING_MPS and moves < _TURNED * size * math.sqrt(ground2)):
        assert state.reference is not None
        state = state._replace(reference=(*at[:2], state.reference[2]), integral=_NO_ERRORS)
    if turned:
        state, late2 = state._replace(desired_once=twist, desired=twist), size * size
    if late2 > 0.0:
        state = state._replace(reference=_advanced(settings, state, pose, late2, dt_s))
    command, integral, report = _corrected(settings, state, twist, size, pose, dt_s)
    return np.array(command), state._replace(integral=integral), report


def _products(arm_m: float, one: Twist, other: Twist) -> tuple[float, float]:
    """Return the square of a twist, and its product with another, in metres."""
    square = product = 0.0
    for j in range(3):
        unit = arm_m if j == 2 else 1.0
        square += (unit * one[j]) * (unit * one[j])
        product += unit * unit * one[j] * other[j]
    return square, product
