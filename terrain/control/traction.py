"""A traction controller that is right about the physics: one speed for all wheels, held back while it rises.

In steady motion the slip of a wheel is set by what resists it, ``F(s) = R``, and not by how fast it is told
to turn: a controller that integrates the error of slip towards a target under that balance slows the robot
to a standstill, one over it runs away (``tests/terrain/control/test_danzi_pid.py`` has both).  What a speed
command does decide is how much *more* slip a start takes, and that is what is held back here.

With w the speed wanted of the fastest wheel, d the speed driven, u_i the speed wanted of wheel i, g_i the
speed of the ground under it, along it, and s* the slip to aim for::

    q = min_i g_i w / u_i                      ground speed, seen from the fastest wheel
    c = max(q + t a, v_l) / (1 - s*)           the speed at which it slips by s*               (cap)
    d = w where w <= d, else min(w, max(d, c))                                                 (drive)

- All wheels are told ``d / w`` of their speed: the turning centre stays where it is.
- The cap restrains the rise of d and nothing else.  A cap that may fall stalls: less speed, less pull, less
  ground speed, less cap.
- It is the normalised P controller of slip, ``d + K (s* - s) d`` with ``s = 1 - q / d`` and ``K = 1 / (1 -
  s*)`` (as :mod:`terrain.control.danzi_pid` normalises it), acting on the chassis in place of each wheel, and
  guarded.
- Under v_l the slip ratio says little about the ground: the robot counts as that fast.
- q is old by the filter's lag and the command takes its way; t leads by both, with the acceleration a that
  was measured and no more than a start on soft ground has, since that of the first tenths is not going to
  last.
- s* is the target of the ground until steady motion has shown what slip it balances; from then on that slip
  and a margin, as ``F(s*) > R`` is what accelerates, and more of it buys nothing.  Where d is held back and
  the robot hardly gains speed, s* rises.  So a target that is too low, or a slope, costs time and never the
  way.
- Wheels that fight each other (a radius or a place that is not what it is believed to be) show in torque, not
  in slip, which is computed from the same belief.  Each wheel gives way by a little speed a torque over the
  mean: a droop, behind a low-pass that keeps it slower than the contact, and only where the ground grips.
- Braking is left to the drivers but on ground that is slick and hard: soil resists most where the wheels
  stop, hard ground where they slip a little.  There d falls no faster than ``q (1 - s_b)``, with q carried
  over the lag by the deceleration that such ground can give.

Everything is a step from a state to the next; :func:`traction_step` is compiled and allocates four small
arrays.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types

from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot

MAX_STEP_S = 0.5
"""A longer step between two calls is no step of a control loop."""

OK, UNCERTAIN, STALE, NO_SLIP, BAD_TIME = range(5)
"""Why a correction is made or not: made; the slip is too uncertain, too old, not known; a wrong clock."""

STATUS_NAMES = ("ok", "uncertain", "stale", "no slip", "bad time")

TRACTION, BRAKING, STEADY = range(3)
"""Places in ``slip_table.DRIVE_STATES``, by what is commanded: the measured acceleration would latch into
braking."""


class TractionSettings(NamedTuple):
    """What the controller may be told; the defaults were found on simulated starts, on seeds of their own.

    Parameters
    ----------
    launch_mps : v_l; at 0.2 m/s a centimetre a second of error is 5 % of slip
    lead_s, lead_max_mps2 : how far ahead q is led, and with how much acceleration at most: the lag of the
        filter, the delay of the command and half of what a driver takes; what 4 % of the weight accelerate
    balance_margin_ratio : least s* over the slip that steady motion balances
    gain_least_mps2 : a robot that is held back gains at least this much speed, or the floor of s* rises
    floor_rate_ratio : how much the floor rises a second
    fade_mps2 : how fast d goes to w where no correction may be made
    droop_radps_per_nm, droop_max_ratio, droop_time_s : speed a wheel gives way a torque over the mean; at
        most that share of its speed; behind that time constant
    std_max_ratio, stale_max_s : slip that is more uncertain, or older, is no slip to correct by; below one
        and a half launch speeds, and in a controlled braking, the error of the speed counts as at that speed
    brake_lead_s : how long the ground speed of a braking goes unseen
    charge_mps_per_mps2, charge_time_s : what a driver's integral takes to carry the torque of a braking, as a
        speed by its proportional gain, and how long; of the robot, see :func:`with_driver`
    """

    launch_mps: float = 0.22
    lead_s: float = 0.15
    lead_max_mps2: float = 0.3
    balance_margin_ratio: float = 0.03
    gain_least_mps2: float = 0.25
    floor_rate_ratio: float = 0.15
    fade_mps2: float = 1.0
    droop_radps_per_nm: float = 0.02
    droop_max_ratio: float = 0.1
    droop_time_s: float = 1.5
    std_max_ratio: float = 0.02
    stale_max_s: float = 3.0
    brake_lead_s: float = 0.15
    charge_mps_per_mps2: float = 0.0
    charge_time_s: float = 0.2


SETTINGS = TractionSettings()

_SLOW_S = 0.5  # of the speed gained: shorter is noise, longer comes late
_HELD_S = 0.4  # held back for so long, a robot has had time to gain speed
_CONSTANT_S, _CONSTANT_MPS = 0.6, 0.02  # driven at one speed for so long: what is left is steady
_STEADY_MPS2 = 0.06
_USUAL_STEP_S = 0.02  # what a fade goes on with where the clock gives no sense
_STEADY_MPS = 0.1
_BALANCE_S = 1.0
_FLOOR_MAX = 0.95
_JUDGED = 1.5  # of the launch speed: slower, what is corrected is a speed, and its error is judged as one
_GRIP = 0.03  # up to this slip wheels fight; ground that gives way by twice as much lets them
_SHARE = 0.3  # a wheel near the turning centre, slower than this share of the fastest, tells nothing about it
_BRAKE_END_MPS = 0.05  # slower than that, stopping is a matter of a wheel's turn
_BRAKE_MPS2 = 0.5  # a command that falls faster than the resistances slow the robot is a braking

(
    _DRIVEN,
    _WANTED,
    _REFERENCE,
    _CONSTANT,
    _SLOW,
    _BALANCE,
    _FLOOR,
    _HELD,
    _BRAKING,
    _BRAKED_FROM,
    _DROOP,
) = range(11)
_PATTERN = _DROOP + 3
STATE_SIZE = _PATTERN + 3

_F8 = types.float64
_ROW = types.Array(_F8, 1, "A", readonly=True)
_SETTINGS = types.NamedUniTuple(_F8, len(TractionSettings._fields), TractionSettings)


class Ground(NamedTuple):
    """What is aimed for on the ground of now.

    Parameters
    ----------
    traction_ratio : s*, from 0 to below 1
    braking_ratio : size of the slip of a braking that is controlled
    braking_mps2 : deceleration at that slip; 0 leaves braking to the drivers
    margin_ratio : slip over the balance that gives the working pull; what is used is at least the settings'
        own
    """

    traction_ratio: float
    braking_ratio: float = 0.0
    braking_mps2: float = 0.0
    margin_ratio: float = 0.0


_GROUND = types.NamedUniTuple(_F8, len(Ground._fields), Ground)


def check_settings(settings: TractionSettings) -> TractionSettings:
    """Return settings that can be used, as floats.

    Raises
    ------
    ConfigError
        if one is not finite or is negative, or a time constant or the launch speed is zero.

    Examples
    --------
    >>> check_settings(SETTINGS._replace(lead_s=-0.1))
    Traceback (most recent call last):
    terrain.errors.ConfigError: traction: lead_s is -0.1, a number from zero up is required
    """
    for name, value in settings._asdict().items():
        least, desired = (
            (1e-6, "above zero")
            if name in ("launch_mps", "droop_time_s", "charge_time_s")
            else (0.0, "from zero up")
        )
        if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value < math.inf:
            raise ConfigError(f"traction: {name} is {value!r}, a number {desired} is required")
    return TractionSettings(*(float(value) for value in settings))


def with_driver(settings: TractionSettings, robot: Robot) -> TractionSettings:
    """Return the settings with what a robot's drivers take to change their torque.

    A PI loop of speed carries a change of torque by its error until its integral has it: ``T / K_P``, for
    about ``K_P / K_I``.  Of a deceleration a, each of n wheels takes ``T = a m r / n``.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> round(with_driver(SETTINGS, load_robot("agrimaro")).charge_mps_per_mps2, 3)
    0.1
    """
    motors = robot.equipment.motors
    torque = robot.mass_kg * robot.wheel_radius_m / len(robot.wheels)
    integral = motors.speed_integral_nmpr
    return settings._replace(
        charge_mps_per_mps2=torque / motors.speed_gain_nmspr * robot.wheel_radius_m,
        charge_time_s=motors.speed_gain_nmspr / integral if integral > 0 else 1e6,
    )


def initial_state() -> Array:
    """Return the state (STATE_SIZE,) of a robot that stands, on ground that nobody knows."""
    state = np.zeros(STATE_SIZE)
    state[_BALANCE] = math.nan
    return state


def forget_ground(state: Array) -> Array:
    """Return the state without what was learned of the ground: call it where another one is believed."""
    state = state.copy()
    state[_BALANCE], state[_FLOOR] = math.nan, 0.0
    return state


@njit(cache=True)
def _say(
    said: Array, driven: float, target: float, balance: float, slip: float, drive_state: int, status: int
) -> None:
    said[0], said[1], said[2], said[3], said[4], said[5] = driven, target, balance, slip, drive_state, status


@njit(
    types.Tuple((_F8[::1], _F8[::1], _F8[::1]))(
        _SETTINGS, _F8[::1], _GROUND, _F8, _ROW, _ROW, _ROW, _ROW, _ROW, _F8, _ROW, _F8
    ),
    cache=True,
)
def traction_step(
    settings: TractionSettings,
    state: Array,
    ground: Ground,
    radius_m: float,
    wheel_radps: Array,
    ground_mps: Array,
    ground_mps2: Array,
    slip_ratio: Array,
    slip_std: Array,
    stale_s: float,
    torque_nm: Array,
    dt_s: float,
) -> tuple[Array, Array, Array]:
    """Return what the wheels are told, the next state, and why; compiled.

    Parameters
    ----------
    settings, state : as :data:`SETTINGS` and :func:`initial_state`; the state is not changed
    ground : targets
    radius_m : of the wheels, as believed
    wheel_radps : (wheels,) wanted
    ground_mps, ground_mps2 : (wheels,) speed and acceleration of the ground along each wheel as it is
        steered, of the filter
    slip_ratio, slip_std : (wheels,) signed along the wheel
    stale_s : since the speed over ground was measured last
    torque_nm : (wheels,) of the motors, at the wheels, signed along the wheel; NaN where it is not known
    dt_s : since the step before

    Returns
    -------
    wheel_radps : (wheels,)
    state : the next
    said : (6,) driven_mps, of the fastest wheel; target_ratio, s* with its floor; balance_ratio, NaN until it
        was seen; slip_ratio, the largest of a wheel, positive in traction, NaN where it is not known;
        drive_state; status, OK or why no correction is made
    """
    n = wheel_radps.size
    told, after, said = np.empty(n), state.copy(), np.empty(6)
    desired, along = 0.0, 0.0
    for i in range(n):
        desired = max(desired, abs(wheel_radps[i]) * radius_m)
        along += wheel_radps[i] * state[_PATTERN + i]
    was = state[_DRIVEN] if along >= 0.0 else 0.0  # the other way at once is a start from rest
    status = OK
    # what is known of the ground
    q, gain, slip, shared, std = math.inf, 0.0, -math.inf, 0.0, 0.0
    for i in range(n):
        if desired > 0.0:  # what a command to stop takes its directions from
            after[_PATTERN + i] = wheel_radps[i] / desired
        sign = 1.0 if after[_PATTERN + i] >= 0.0 else -1.0
        speed = abs(after[_PATTERN + i]) * radius_m  # in shares of the fastest
        if not (
            math.isfinite(slip_ratio[i])
            and math.isfinite(slip_std[i])
            and math.isfinite(ground_mps[i])
            and math.isfinite(ground_mps2[i])
        ):
            status = NO_SLIP
            continue
        slip = max(slip, sign * slip_ratio[i])
        shared += sign * slip_ratio[i] / n
        fastest = abs(ground_mps[i]) / max(1.0 - max(sign * slip_ratio[i], 0.0), 0.05)
        judged = max(fastest, _JUDGED * settings.launch_mps, state[_BRAKED_FROM])
        std = max(std, slip_std[i] * fastest / judged)
        if speed >= _SHARE:
            seen = sign * ground_mps[i] / speed
            if seen < q:
                q, gain = seen, sign * ground_mps2[i] / speed
    if math.isinf(q):
        q, gain = 0.0, 0.0
    if status == OK and not stale_s <= settings.stale_max_s:
        status = STALE
    if status == OK and not std <= settings.std_max_ratio:
        status = UNCERTAIN
    if not (0.0 < dt_s <= MAX_STEP_S):
        status = BAD_TIME
    if status == BAD_TIME:
        driven = min(desired, was + settings.fade_mps2 * _USUAL_STEP_S)
        after[_DRIVEN] = driven
        for i in range(n):
            told[i] = after[_PATTERN + i] * driven
        _say(said, driven, ground.traction_ratio, state[_BALANCE], math.nan, STEADY, BAD_TIME)
        return told, after, said

    rising = desired > was + 1e-9
    falling = state[_WANTED] - desired > _BRAKE_MPS2 * dt_s
    after[_WANTED] = desired
    margin = max(settings.balance_margin_ratio, ground.margin_ratio)
    target = ground.traction_ratio
    if math.isfinite(state[_BALANCE]):
        target = min(target, max(state[_BALANCE], 0.0) + margin)
    target = max(target, state[_FLOOR])
    drive_state = STEADY
    if rising:
        drive_state = TRACTION
    elif falling or (state[_BRAKING] > 0.0 and was > desired):
        drive_state = BRAKING

    # drive
    braking_s = 0.0
    if status != OK:
        driven = min(desired, was + settings.fade_mps2 * dt_s)
        after[_HELD] = 0.0
    elif rising:
        ahead = q + settings.lead_s * min(max(gain, 0.0), settings.lead_max_mps2)
        cap = max(ahead, settings.launch_mps) / (1.0 - min(target, _FLOOR_MAX))
        driven = min(desired, max(was, cap))
        after[_HELD] = state[_HELD] + dt_s if driven < desired else 0.0
    else:
        driven = desired
        after[_HELD] = 0.0
        if drive_state == BRAKING and ground.braking_mps2 > 0.0:
            braking_s = state[_BRAKING] + dt_s
            ahead = q - ground.braking_mps2 * min(braking_s, settings.brake_lead_s)
            charge = settings.charge_mps_per_mps2 * math.exp(-braking_s / settings.charge_time_s)
            ahead = ahead * (1.0 - ground.braking_ratio)
            driven = max(desired, min(was, ahead - charge * ground.braking_mps2))
            if ahead <= max(desired, _BRAKE_END_MPS):
                driven, braking_s = desired, 0.0
    after[_BRAKING] = braking_s
    after[_BRAKED_FROM] = 0.0 if braking_s == 0.0 else max(state[_BRAKED_FROM], was)
    after[_DRIVEN] = driven

    # what steady motion balances, and whether the robot gains speed
    if status == OK:
        after[_SLOW] = state[_SLOW] + (q - state[_SLOW]) * min(dt_s / _SLOW_S, 1.0)
        gained = (q - after[_SLOW]) / _SLOW_S
        if after[_HELD] > _HELD_S and gained < settings.gain_least_mps2:
            after[_FLOOR] = min(target + settings.floor_rate_ratio * dt_s, _FLOOR_MAX)
        if abs(driven - state[_REFERENCE]) > _CONSTANT_MPS:
            after[_REFERENCE], after[_CONSTANT] = driven, 0.0
        after[_CONSTANT] += dt_s
        if after[_CONSTANT] > _CONSTANT_S and abs(gained) < _STEADY_MPS2 and q > _STEADY_MPS:
            seen = state[_BALANCE] if math.isfinite(state[_BALANCE]) else shared
            after[_BALANCE] = seen + (shared - seen) * min(dt_s / _BALANCE_S, 1.0)
            floor = min(max(after[_BALANCE], 0.0) + margin, _FLOOR_MAX)
            after[_FLOOR] = floor if driven >= desired else max(after[_FLOOR], floor)

    # one speed for all, and torques that are shared; beside the others', one that is not known is not 0
    mean = 0.0
    heard = driven > _STEADY_MPS and np.isfinite(torque_nm).all()
    for i in range(n):
        sign = 1.0 if after[_PATTERN + i] >= 0.0 else -1.0
        seen = sign * torque_nm[i] if heard else 0.0
        keep = math.exp(-dt_s / settings.droop_time_s)
        after[_DROOP + i] = keep * state[_DROOP + i] + (1.0 - keep) * seen
        mean += after[_DROOP + i] / n
    grip = min(max(2.0 - abs(shared) / _GRIP, 0.0), 1.0)
    for i in range(n):
        told[i] = after[_PATTERN + i] * driven
        if status == OK:
            room = grip * settings.droop_max_ratio * abs(told[i])
            give = settings.droop_radps_per_nm * (after[_DROOP + i] - mean)
            told[i] -= (1.0 if after[_PATTERN + i] >= 0.0 else -1.0) * min(max(give, -room), room)
    if status == NO_SLIP:
        slip = math.nan
    _say(said, driven, target, after[_BALANCE], slip, drive_state, status)
    return told, after, said
