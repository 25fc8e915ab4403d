"""Take the drift out of a drive: heading and place are held to what the wanted twists add up to.

Dead band of the steering, play of the third leg, uneven loads and soil turn the robot and push it aside
(Danzi, AgriMaRo thesis, conclusion; their correction is left open there).  With the wanted twist u,
``|u|^2 = v_x^2 + v_y^2 + (L w)^2``, pose p, reference pose p* and error ``e = p - p*``, places in metres and
headings times L::

    f = u, as late as the motion that is seen          t = (e . f) / |f|^2, bounded
    p* goes along f for the time t                     (reference: it waits for the robot)
    e' = e - d (e . d),  d = u / |u|                   (what is left is across the wanted motion)
    c = -(k e' + k_I integral e' ds)                   (correction for each metre, ds = |u| dt)
    u + |u| (c - d (c . d))                            (what is told)

- The reference moves by the way that is made, not by the clock: slip, or a traction controller that holds
  back, is no error, and a correction neither drives nor brakes.  What counts as way is whatever is required:
  forward, backward, sideways, along an arc, or the angle of a turn on the spot, where the place is held.
- Gains are for a metre of way: an error means the same steering angle at any speed.  Above ``fastest / k``
  they fall with the speed, for the delays are in seconds.
- Corrections are angles of the steering, clamped; the integral stands where the clamp would be pressed.
- Standing, the reference is where the robot is, and integrals are 0: a drive starts from where it starts.
  When the wanted direction turns by more than 60 degrees, and while the robot moves that far from it, the
  place is taken afresh and the heading is kept.
- A pose that leaps away from the ground speed is relocalisation: the reference leaps with it, so nothing is
  corrected.  Without a pose for more than half a second, both are taken afresh.

Play lets a correction within it do nothing: with a proportional gain alone up to ``play / (k L)`` of heading
is left; the integral takes that out in a few metres.  Integral and play make a slow cycle together; a
proportional gain that is steep beside it keeps that to milliradians, and to some centimetres beside the way.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types
from scipy.linalg import expm

from terrain.angles import wrapped
from terrain.control.pid import LONGEST_STEP_S, Gains, PidState, pid_step
from terrain.control.stability import DELAY_S, SAMPLE_TIME_S, spectral_radius
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot

OK, CLAMPED, STANDING, NO_POSE, UNCERTAIN, STALE, BAD_TIME = range(7)
STATUS_NAMES = ("ok", "clamped", "standing", "no pose", "uncertain", "stale", "bad time")
"""Corrected; corrected as far as it may; or not corrected, and why."""


class TrackSettings(NamedTuple):
    """How a drive is held to its way; what was found on simulated drives, on seeds of their own.

    Parameters
    ----------
    arm_m : L; half the wheelbase, so that a correction of the heading is that angle of the steering
    heading_pm, heading_integral_pm2 : k and k_I of the heading, rad of steering a metre of L times heading
    cross_pm, cross_integral_pm2 : the same a metre beside the way; slower, as a robot off its way has time
    heading_max_rad : clamp, as a steering angle: four times the play
    cross_max_rad : the same; a side slope of 5 degrees on grass takes 0.2, which no play does
    heading_fastest_ps, cross_fastest_ps : bandwidths from which on the delays would be felt
    lag_s : from a twist that is required to the motion that is seen: delay, speed loop, steering and filter
    yaw_std_max_rad : a heading less certain is none; what counts is how it changes, which is known better
    stale_max_s : without a measured speed over ground for longer, the place is none
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

_STAND_MPS = 0.02  # slower is no drive: a tenth of what counts as one
_AWAY_MPS = 0.05  # a motion that has a direction
_TURNED = 0.5  # cosine of 60 degrees
_LEAP_M, _LEAP_RAD = 0.02, 0.02  # a filter moves its pose by less than a tenth of it beside the motion
_BLIND_S = 0.5  # longer without a pose, and the reference is lost
_BACK, _AHEAD = 1.0, 3.0  # how fast the reference goes after the robot, of what is required

_POSE, _SEEN, _INTEGRAL, _LAST, _BLIND, _ANCHORED = 0, 3, 9, 12, 15, 16
STATE_SIZE = 17

_F8 = types.float64
_ROW = types.Array(_F8, 1, "A", readonly=True)
_SETTINGS = types.NamedUniTuple(_F8, len(TrackSettings._fields), TrackSettings)


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
        at some speed that the robot drives.

    Notes
    -----
    Heading and place each, in metres x, behind the filter y, with the steering s and the side force f, both
    lags of first order, at speed v; the command u is held from sample to sample and comes late::

        x' = v f,  f' = (s - f) v / sigma,  s' = (u - s) / tau_s,  y' = (x - y) / tau_encoder

    ``tau_s`` is half of what the steering's acceleration takes for a move by its play.  The place follows the
    heading and not the other way round, so each loop is stable by itself or not.  Play is not in it.  With
    the default delay and integral, AgriMaRo's heading is stable up to a bandwidth of 9 rad/s; 3 is set.

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
        sound = not isinstance(value, bool) and isinstance(value, int | float) and math.isfinite(value)
        if not sound or not (value >= 0.0 if zero else value > 0.0):
            desired = "a number from zero up" if zero else "a number above zero"
            raise ConfigError(f"path tracking: {name} is {value!r}, {desired} is required")
    for name, value, least in (("delay_s", delay_s, 0.0), ("dt_s", dt_s, 1e-3)):
        if not least <= value <= LONGEST_STEP_S:
            raise ConfigError(
                f"path tracking: {name} is {value!r}, {least:g} to {LONGEST_STEP_S:g} s is required"
            )
    fastest_mps = robot.wheel_radius_m * robot.equipment.motors.speed_max_radps
    speeds_mps = np.geomspace(_AWAY_MPS, fastest_mps, 12).tolist()
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
    """Return the loop from sample to sample: x, f, s, y, then the integral and the commands on their way."""
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


def initial_tracking() -> Array:
    """Return the state (STATE_SIZE,) before the first step."""
    return np.zeros(STATE_SIZE)


@njit(
    types.Tuple((_F8[::1], _F8[::1], _F8[::1]))(_SETTINGS, _F8[::1], _ROW, _ROW, _F8, _ROW, _F8, _F8, _F8),
    cache=True,
)
def track_step(
    settings: TrackSettings,
    state: Array,
    desired_twist: Array,
    position_m: Array,
    yaw_rad: float,
    ground_twist: Array,
    yaw_std_rad: float,
    stale_s: float,
    dt_s: float,
) -> tuple[Array, Array, Array]:
    """Return the twist to drive, the next state, and why; compiled, the state is not changed.

    Parameters
    ----------
    settings : as :func:`check_tracking` gives them
    state : :func:`initial_tracking` at first, then what the step before returned
    desired_twist : (3,) finite
    position_m : (2,) of the body's origin in the world, as estimated
    yaw_rad : heading; turns do not count
    ground_twist : (3,) as estimated
    yaw_std_rad, stale_s : how sure the heading is, and since when the speed over ground was not measured
    dt_s : since the step before

    Returns
    -------
    twist : (3,)
    state : the next
    said : (4,) heading error in rad, place across the way in m (positive to its left), size of the correction
        as a steering angle in rad, and status; errors are NaN where nothing is corrected

    Examples
    --------
    >>> ahead, settings = np.array([1.0, 0.0, 0.0]), SETTINGS
    >>> at = (np.zeros(2), 0.0, ahead, 0.001, 0.0, 0.02)
    >>> _, state, _ = track_step(settings, initial_tracking(), ahead, *at)
    >>> at = (np.array([0.02, 0.0]), 0.01, ahead, 0.001, 0.0, 0.02)  # turned to the left
    >>> twist, state, said = track_step(settings, state, ahead, *at)
    >>> twist.round(3), said.round(3)
    (array([ 1.  ,  0.  , -0.03]), array([ 0.01 , -0.   ,  0.015,  0.   ]))
    """
    arm = settings.arm_m
    told, after, said = np.empty(3), state.copy(), np.full(4, math.nan)
    told[0], told[1], told[2] = desired_twist[0], desired_twist[1], desired_twist[2]
    said[2] = 0.0
    if not 0.0 < dt_s <= LONGEST_STEP_S:
        said[3] = BAD_TIME
        return told, after, said
    status = OK
    known = math.isfinite(yaw_rad) and math.isfinite(position_m[0]) and math.isfinite(position_m[1])
    for j in range(3):
        known = known and math.isfinite(ground_twist[j])
    if not known:
        status = NO_POSE
    elif not yaw_std_rad <= settings.yaw_std_max_rad:
        status = UNCERTAIN
    elif not stale_s <= settings.stale_max_s:
        status = STALE
    if status != OK:
        after[_BLIND] = state[_BLIND] + dt_s
        if after[_BLIND] > _BLIND_S:
            after[_ANCHORED] = 0.0
        said[3] = status
        return told, after, said

    x, y = position_m[0], position_m[1]
    size = math.sqrt(told[0] ** 2 + told[1] ** 2 + (arm * told[2]) ** 2)
    if after[_ANCHORED] == 0.0 or size < _STAND_MPS:
        after[:] = 0.0
        after[_POSE], after[_POSE + 1], after[_POSE + 2] = x, y, yaw_rad
        after[_ANCHORED] = 1.0
    elif after[_BLIND] == 0.0:  # where the pose leaps away from the motion, the reference is carried along
        middle = state[_LAST + 2] + 0.5 * dt_s * ground_twist[2]
        cos, sin = math.cos(middle), math.sin(middle)
        due_x = state[_LAST] + dt_s * (cos * ground_twist[0] - sin * ground_twist[1])
        due_y = state[_LAST + 1] + dt_s * (sin * ground_twist[0] + cos * ground_twist[1])
        leap = wrapped(yaw_rad - state[_LAST + 2] - dt_s * ground_twist[2])
        if abs(leap) > _LEAP_RAD or math.hypot(x - due_x, y - due_y) > _LEAP_M:
            cos, sin = math.cos(leap), math.sin(leap)
            off_x, off_y = after[_POSE] - due_x, after[_POSE + 1] - due_y
            after[_POSE] = x + cos * off_x - sin * off_y
            after[_POSE + 1] = y + sin * off_x + cos * off_y
            after[_POSE + 2] += leap
    after[_BLIND] = 0.0
    after[_LAST], after[_LAST + 1], after[_LAST + 2] = x, y, yaw_rad
    if size < _STAND_MPS:
        said[3] = STANDING
        return told, after, said

    # what is required, as late as it is seen
    keep = math.exp(-2.0 * dt_s / settings.lag_s) if settings.lag_s > 0.0 else 0.0
    same, late2, ground2, moved = 0.0, 0.0, 0.0, 0.0
    for j in range(3):
        unit = arm if j == 2 else 1.0
        after[_SEEN + 3 + j] += (1.0 - keep) * (told[j] - after[_SEEN + 3 + j])
        after[_SEEN + j] += (1.0 - keep) * (after[_SEEN + 3 + j] - after[_SEEN + j])
        same += unit * unit * after[_SEEN + j] * told[j]
        late2 += (unit * after[_SEEN + j]) ** 2
        moved += unit * unit * ground_twist[j] * told[j]
        ground2 += (unit * ground_twist[j]) ** 2
    turned = same < _TURNED * size * math.sqrt(late2)
    if turned or (ground2 > _AWAY_MPS**2 and moved < _TURNED * size * math.sqrt(ground2)):
        after[_POSE], after[_POSE + 1] = x, y
        after[_INTEGRAL] = after[_INTEGRAL + 1] = after[_INTEGRAL + 2] = 0.0
        if turned:
            for j in range(3):
                after[_SEEN + j] = after[_SEEN + 3 + j] = told[j]
            late2 = size * size

    # the reference goes after the robot
    late_x, late_y, late_turn = after[_SEEN], after[_SEEN + 1], after[_SEEN + 2]
    if late2 > 0.0:
        cos, sin = math.cos(after[_POSE + 2]), math.sin(after[_POSE + 2])
        off_x, off_y = x - after[_POSE], y - after[_POSE + 1]
        ahead_s = (
            (cos * off_x + sin * off_y) * late_x
            + (cos * off_y - sin * off_x) * late_y
            + arm * arm * wrapped(yaw_rad - after[_POSE + 2]) * late_turn
        ) / late2
        ahead_s = min(max(ahead_s, -_BACK * dt_s), _AHEAD * dt_s)
        middle = after[_POSE + 2] + 0.5 * ahead_s * late_turn
        cos, sin = math.cos(middle), math.sin(middle)
        after[_POSE] += ahead_s * (cos * late_x - sin * late_y)
        after[_POSE + 1] += ahead_s * (sin * late_x + cos * late_y)
        after[_POSE + 2] += ahead_s * late_turn

    # errors across, and what is done about them; along, across and L times heading in metres
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    off_x, off_y = x - after[_POSE], y - after[_POSE + 1]
    error = np.array([cos * off_x + sin * off_y, cos * off_y - sin * off_x, 0.0])
    error[2] = arm * wrapped(yaw_rad - after[_POSE + 2])
    way = np.array([told[0] / size, told[1] / size, arm * told[2] / size])
    error -= way * (error[0] * way[0] + error[1] * way[1] + error[2] * way[2])
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
        correction[j], memory, pressed = pid_step(gains, memory, -error[j], min(size * dt_s, LONGEST_STEP_S))
        after[_INTEGRAL + j] = memory.integral
        if pressed != OK:
            status = CLAMPED
    correction -= way * (correction[0] * way[0] + correction[1] * way[1] + correction[2] * way[2])
    told[0] += size * correction[0]
    told[1] += size * correction[1]
    told[2] += size * correction[2] / arm
    said[0] = error[2] / arm
    said[1] = math.copysign(math.hypot(error[0], error[1]), way[0] * error[1] - way[1] * error[0])
    said[2] = math.sqrt(correction[0] ** 2 + correction[1] ** 2 + correction[2] ** 2)
    said[3] = status
    return told, after, said
