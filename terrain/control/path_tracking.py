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

A robot that cannot drive sideways is steered towards its path: what the loop of the position asks for across the motion
is the heading that the loop of the heading aims for, and only the yaw rate is corrected.

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
from terrain.control.pid import LONGEST_STEP_S, Gains, pid_step
from terrain.control.stability import DELAY_S, SAMPLE_TIME_S, closed_loop
from terrain.control.turning import SETTINGS as TURN
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot
from terrain.status import StatusCode

MOVING_MPS = 0.05  #: From this speed on a motion has a direction.
N_SPEEDS = 12
FASTEST_MPS = 3.0  #: Up to which a loop is checked where the motors' limit is not known.


class TrackSettings(NamedTuple):
    """Gains and limits of path tracking, of a swerve robot; tuned on simulated drives with seeds of their own."""

    #: L; half the wheelbase, so that a correction of the heading is that angle of the steering
    arm_m: float = 0.5075
    heading_pm: float = 3.0  #: k and k_I of the heading, rad of steering per m of L times heading
    heading_integral_pm2: float = 0.7
    cross_pm: float = 1.0  #: the same per m of cross-track error; slower, as it is less urgent
    cross_integral_pm2: float = 0.2
    heading_max_rad: float = 0.08  #: clamp, as a steering angle: four times the backlash
    #: the same; a side slope of 5 degrees on grass takes 0.2, which no backlash does
    cross_max_rad: float = 0.3
    heading_fastest_ps: float = 3.0  #: bandwidths above which the delays would matter
    cross_fastest_ps: float = 1.5
    #: from a desired twist to the estimated motion: delay, speed loop, steering and filter
    lag_s: float = 0.15
    #: a heading that is less certain is not used; it is compared with changes of the heading, which are known better
    yaw_std_max_rad: float = 0.1
    stale_max_s: float = 3.0  #: without a measured speed over ground for longer, the position is not used
    sideways: bool = True  #: whether a position across the motion is corrected by a speed there


SETTINGS = TrackSettings()


def tracking_of(robot: Robot) -> TrackSettings:
    """Return the settings for a robot: of one that cannot drive sideways the position is behind the heading.

    The heading of such a robot follows with the lag of its yaw rate, and its position more slowly, so that the loop of
    the position has a third of the heading's bandwidth.
    """
    if robot.sideways:
        return SETTINGS._replace(arm_m=robot.wheelbase_m / 2.0)
    return SETTINGS._replace(
        arm_m=robot.wheelbase_m / 2.0,
        sideways=False,
        heading_pm=2.0,
        heading_integral_pm2=0.3,
        cross_pm=0.6,
        cross_integral_pm2=0.06,
        heading_max_rad=0.6,
        cross_max_rad=0.5,
        heading_fastest_ps=1.5,
        cross_fastest_ps=0.5,
    )


def check_tracking(robot: Robot, settings: TrackSettings = SETTINGS, delay_s: float = DELAY_S) -> None:
    """Refuse settings and a delay with which a loop is unstable at some speed of the robot.

    Raises
    ------
    ConfigError
        that says which loop, and where; or if the delay is none.

    Notes
    -----
    Heading and position each, in metres x, behind the filter y, with the steering s and the side force f,
    both first-order lags, at speed v; the command u is held from sample to sample and is delayed::

        x' = v f,  f' = (s - f) v / sigma,  s' = (u - s) / tau_s,  y' = (x - y) / tau_encoder

    ``tau_s`` is half the time in which the steering's acceleration crosses its backlash; without steered wheels it
    is the lag of the yaw rate.  The position follows the heading and not the reverse, so the loops are checked one
    by one.  Backlash is not modelled.
    With the default delay and integral, AgriMaRo's heading is stable up to a bandwidth of 9 rad/s; 3 is set.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> check_tracking(load_robot("agrimaro"))
    >>> check_tracking(load_robot("agrimaro"), SETTINGS._replace(heading_pm=12.0, heading_fastest_ps=12.0))
    Traceback (most recent call last):
    terrain.errors.ConfigError: path tracking: heading_pm 12 and heading_integral_pm2 0.7 with a delay of
    0.05 s are unstable from 1.02 to 2 m/s
    """
    if not 0.0 <= delay_s <= LONGEST_STEP_S:
        raise ConfigError(f"path tracking: delay_s is {delay_s!r}, 0 to {LONGEST_STEP_S:g} s is required")
    fastest_mps = min(robot.wheel_radius_m * robot.completed.motors.speed_max_radps, FASTEST_MPS)
    speeds_mps = np.geomspace(MOVING_MPS, fastest_mps, N_SPEEDS).tolist()
    for loop, (k, k_i, _, fastest_ps) in _loops(settings).items():
        gains = k, k_i, fastest_ps
        loops = [_loop_matrix(robot, gains, delay_s, speed) for speed in speeds_mps]
        radii = [np.abs(np.linalg.eigvals(each)).max() for each in loops]
        bad = [speed for speed, radius in zip(speeds_mps, radii, strict=True) if radius >= 1.0 + 1e-9]
        if bad:
            raise ConfigError(
                f"path tracking: {loop}_pm {k:g} and {loop}_integral_pm2 {k_i:g} with a delay of "
                f"{delay_s:g} s are unstable from {bad[0]:.3g} to {bad[-1]:.3g} m/s"
            )


def _loops(settings: TrackSettings) -> dict[str, tuple[float, float, float, float]]:
    """Return gain, integral gain, clamp and bandwidth of heading and cross-track error."""
    values = settings._asdict()
    ends = ("pm", "integral_pm2", "max_rad", "fastest_ps")
    cross, heading = ([values[f"{loop}_{end}"] for end in ends] for loop in ("cross", "heading"))
    return {"heading": (*heading,), "cross": (*cross,)}


def _loop_matrix(robot: Robot, gains: tuple[float, float, float], delay_s: float, speed_mps: float) -> Array:
    """Return the loop from sample to sample: x, f, s, y, the integral, the delayed commands."""
    body, sensors, dt_s = robot.completed.body, robot.completed.sensors, SAMPLE_TIME_S
    steering_s = TURN.lag_s
    if robot.describes("steering"):
        steering_s = max(math.sqrt(robot.steering.dead_band_rad / robot.steering.accel_max_radps2), 1e-3)
    n_delayed = max(math.ceil(delay_s / dt_s - 1e-9), 1)
    plant = np.zeros((5, 5))  # the fifth is the command, held
    plant[0, 1] = speed_mps
    plant[1, [2, 1]] = np.array([1.0, -1.0]) * speed_mps / max(body.relaxation_length_m, 1e-3)
    plant[2, [4, 2]] = np.array([1.0, -1.0]) / steering_s
    plant[3, [0, 3]] = np.array([1.0, -1.0]) / max(sensors.encoder_time_constant_s, 1e-3)
    over = expm(plant * dt_s)
    k, k_i, fastest_ps = gains
    slower = min(1.0, fastest_ps / max(k * speed_mps, 1e-9))
    *_, seen, integral = np.eye(5)
    integral = integral - slower * k_i * speed_mps * dt_s * seen
    return closed_loop(over[:4, :4], over[:4, 4], integral[None], integral - slower * k * seen, n_delayed)


class TrackStatus(StatusCode):
    """Whether the twist is corrected: yes, up to a clamp, or not, and why."""

    OK = 0
    CLAMPED = 1
    STANDING = 2
    NO_POSE = 3
    UNCERTAIN = 4
    STALE = 5
    BAD_TIME = 6


class TrackReport(NamedTuple):
    """Errors, NaN where nothing is corrected, and the correction."""

    heading_error_rad: float
    cross_track_m: float  #: distance from the path, positive to its left
    correction_rad: float  #: magnitude, as a steering angle
    status: TrackStatus


_ZEROS = np.zeros(3)


class TrackState(NamedTuple):
    """What a step leaves to the next."""

    #: (3,) x, y and heading p* of the path; None where there is none, as at first
    reference: Array | None = None
    desired_once: Array = _ZEROS  #: (3,) desired twist behind a low-pass
    desired: Array = _ZEROS  #: (3,) behind two
    integral: tuple[float, ...] = (0.0, 0.0, 0.0)  #: of the errors along x, along y and of the heading
    last: Array = _ZEROS  #: (3,) pose of the robot
    blind_s: float = 0.0  #: without a pose


_STAND_MPS = 0.02  # slower is standing: a tenth of the speed that counts as a drive
_TURNED = 0.5  # cosine of 60 degrees
_JUMP_M, _JUMP_RAD = 0.02, 0.02  # a filter moves its pose by less than a tenth of it beside the motion
_BLIND_S = 0.5  # longer without a pose, and the reference is lost
_BACK, _AHEAD = 1.0, 3.0  # limits of the reference's speed, in multiples of the desired one


def track_step(
    settings: TrackSettings,
    state: TrackState,
    twist: Array,
    pose: Array,
    ground_twist: Array,
    yaw_std_rad: float,
    stale_s: float,
    dt_s: float,
) -> tuple[Array, TrackState, TrackReport]:
    """Return the twist to drive (3,), the next state, and why.

    Parameters
    ----------
    settings : gains and limits
    state : ``TrackState()`` at first, then what the step before returned
    twist : (3,) desired, finite
    pose : (3,) estimated x, y and heading of the body's origin; whole turns of the heading do not matter
    ground_twist : (3,) estimated
    yaw_std_rad : standard deviation of the heading
    stale_s : time since the speed over ground was measured last
    dt_s : since the step before

    Examples
    --------
    >>> ahead, at = np.array([1.0, 0.0, 0.0]), np.zeros(3)
    >>> _, state, _ = track_step(SETTINGS, TrackState(), ahead, at, ahead, 0.001, 0.0, 0.02)
    >>> at = np.array([0.02, 0.0, 0.01])  # turned to the left
    >>> twist, state, report = track_step(SETTINGS, state, ahead, at, ahead, 0.001, 0.0, 0.02)
    >>> twist.round(3), round(report.heading_error_rad, 3), report.status.name
    (array([ 1.  ,  0.  , -0.03]), 0.01, 'OK')
    """

    def uncorrected(status: TrackStatus) -> TrackReport:
        return TrackReport(math.nan, math.nan, 0.0, status)

    if not 0.0 < dt_s <= LONGEST_STEP_S:
        return twist, state, uncorrected(TrackStatus.BAD_TIME)
    status = TrackStatus.OK if stale_s <= settings.stale_max_s else TrackStatus.STALE
    if not all(map(math.isfinite, (*pose.tolist(), *ground_twist.tolist()))):
        status = TrackStatus.NO_POSE
    elif not yaw_std_rad <= settings.yaw_std_max_rad:
        status = TrackStatus.UNCERTAIN
    if status is not TrackStatus.OK:
        blind_s = state.blind_s + dt_s
        reference = None if blind_s > _BLIND_S else state.reference
        return twist, state._replace(blind_s=blind_s, reference=reference), uncorrected(status)
    metres = np.array([1.0, 1.0, settings.arm_m])  # what makes a twist or an error metres in all three
    along = metres * twist
    size = math.sqrt(along @ along)
    if state.reference is None or size < _STAND_MPS:
        state = TrackState(reference=pose)
    elif state.blind_s == 0.0:
        # a pose that jumps away from the motion: the reference jumps with it
        last, path = state.last, state.reference
        due = last + dt_s * _rotated(last[2] + 0.5 * dt_s * ground_twist[2], ground_twist)
        jump = float(wrapped(pose[2] - due[2]))
        if abs(jump) > _JUMP_RAD or math.hypot(pose[0] - due[0], pose[1] - due[1]) > _JUMP_M:
            x, y, _ = pose + _rotated(jump, path - due)
            state = state._replace(reference=np.array([x, y, path[2] + jump]))
    state = state._replace(last=pose, blind_s=0.0)
    if size < _STAND_MPS:
        return twist, state, uncorrected(TrackStatus.STANDING)
    along, reference = along / size, state.reference
    assert reference is not None

    # the desired twist, delayed as the estimated motion is
    part = 1.0 - (math.exp(-2.0 * dt_s / settings.lag_s) if settings.lag_s > 0.0 else 0.0)
    once = state.desired_once + part * (twist - state.desired_once)
    desired, integral = state.desired + part * (once - state.desired), state.integral
    late, ground = metres * desired, metres * ground_twist
    turned = late @ along < _TURNED * math.sqrt(late @ late)
    ground_mps = math.sqrt(ground @ ground)
    if turned or (ground_mps > MOVING_MPS and ground @ along < _TURNED * ground_mps):
        reference, integral = np.array([pose[0], pose[1], reference[2]]), (0.0, 0.0, 0.0)
    if turned:
        once = desired = twist
        late = metres * twist

    # the reference moves along it to where it is nearest to the robot
    if (late2 := float(late @ late)) > 0.0:
        ahead_s = float(metres * _seen_from(reference, pose, reference[2]) @ late) / late2
        ahead_s = min(max(ahead_s, -_BACK * dt_s), _AHEAD * dt_s)
        reference = reference + ahead_s * _rotated(reference[2] + 0.5 * ahead_s * desired[2], desired)

    # errors across the desired motion, along x, along y and L times heading
    error = _across(metres * _seen_from(reference, pose, pose[2]), along)
    loops, integrals, status = _loops(settings), list[float](), TrackStatus.OK
    added: list[float] = []
    for value, before, loop in zip(error.tolist(), integral, ("cross", "cross", "heading"), strict=True):
        off = value
        if loop == "heading" and not settings.sideways:  # towards the path
            off -= settings.arm_m * float(along[0]) * added[1]
        k, k_i, limit, fastest = loops[loop]
        slower = min(1.0, fastest / max(k * size, 1e-9))
        gains, distance_m = Gains(slower * k, slower * k_i, limit, limit), min(size * dt_s, LONGEST_STEP_S)
        one, grown, is_clamped = pid_step(gains, before, -off, distance_m)
        added.append(one)
        integrals.append(grown)
        status = TrackStatus.CLAMPED if is_clamped else status
    correction = _across(np.array(added), along) if settings.sideways else np.array([0.0, 0.0, added[2]])
    cross_m = math.copysign(math.hypot(error[0], error[1]), along[0] * error[1] - along[1] * error[0])
    angle = math.sqrt(correction @ correction)
    report = TrackReport(float(error[2]) / settings.arm_m, cross_m, angle, status)
    state = TrackState(reference, once, desired, tuple(integrals), pose)
    return twist + size * correction / metres, state, report


def _rotated(angle_rad: float, vector: Array) -> Array:
    """Return a vector (3,) with x and y turned by an angle."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    x, y, third = vector.tolist()
    return np.array([cos * x - sin * y, sin * x + cos * y, third])


def _seen_from(reference: Array, pose: Array, heading_rad: float) -> Array:
    """Return a pose (3,) less a reference, in axes of a heading."""
    error = _rotated(-heading_rad, pose - reference)
    error[2] = wrapped(error[2])
    return error


def _across(vector: Array, along: Array) -> Array:
    """Return a vector (3,) without its part along a unit vector."""
    return np.asarray(vector - along * (vector @ along))
