"""A traction controller by the balance of forces: one speed for all wheels, limited while it rises.

In steady motion the slip of a wheel is given by what resists it, ``F(s) = R``, and not by its speed command:
a controller that integrates the error of slip towards a target below that balance slows the robot to a
standstill, one above it runs away (``tests/terrain/control/test_danzi_pid.py`` shows both).  What a speed
command does decide is how much *more* slip a start takes, and that is what is limited here.

With w the desired speed of the fastest wheel, d the commanded speed, u_i the desired speed of wheel i, g_i
its speed over ground along it, and s* the target slip::

    q = min_i g_i w / u_i                      ground speed, seen from the fastest wheel
    c = max(q + t a, v_l) / (1 - s*)           the speed at which it slips by s*               (cap)
    d = w where w <= d, else min(w, max(d, c))                                                 (drive)

- All wheels are commanded ``d / w`` of their speed: the turning centre stays where it is.
- The cap limits the rise of d and nothing else.  A cap that may fall stalls: less speed, less pull, less
  ground speed, less cap.
- It is the normalised P controller of slip, ``d + K (s* - s) d`` with ``s = 1 - q / d`` and ``K = 1 / (1 -
  s*)`` (as :mod:`terrain.control.danzi_pid` normalises it), acting on the chassis instead of each wheel.
- Below v_l the slip ratio carries little information on the terrain: v_l replaces the robot's speed.
- q is delayed by the filter's lag and the command by its transport; t compensates both with the measured
  acceleration a, limited to that of a start on soft soil, as the acceleration of the first tenths of a second
  does not last.
- s* is the target of the terrain until steady motion has shown at which slip it balances; from then on it is
  that slip and a margin, as ``F(s*) > R`` accelerates and more slip adds nothing.  Where d is limited and the
  robot hardly accelerates, s* rises.  So a target that is too low, or a slope, costs time and not the
  distance travelled.
- Wheels that work against each other (a radius or a position that differs from the nominal one) show in
  torque, not in slip, which is computed from the same nominal values.  The speed of each wheel is reduced in
  proportion to its torque above the mean (droop), behind a low-pass that keeps it slower than the contact,
  and only where the ground grips.
- Braking is left to the motor drivers, except on slick and hard ground: soil resists most where the wheels
  stop, hard ground where they slip a little.  There d falls no faster than ``q (1 - s_b)``, with q
  extrapolated over the lag by the deceleration that such ground can give.

Everything is a step from a state to the next; :func:`traction_step` is compiled and allocates four small
arrays.

Settings of the traction controller (:mod:`terrain.control.traction`): defaults, checks, motor drivers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types

from terrain.control.danzi_pid import DriveState
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot
from terrain.status import StatusCode


class TractionSettings(NamedTuple):
    """Settings; the defaults were tuned on simulated starts whose seeds are used nowhere else.

    Parameters
    ----------
    launch_mps : v_l; at 0.2 m/s a speed error of 1 cm/s is 5 % of slip
    lead_s, lead_max_mps2 : time by which q is extrapolated, and the largest acceleration used for it: the lag
        of the filter, the delay of the command and half the response time of a motor driver; the acceleration
        that 4 % of the weight gives
    balance_margin_ratio : least s* above the slip that balances steady motion
    gain_least_mps2 : a robot that is held back accelerates at least by this, or the floor of s* rises
    floor_rate_ratio : rate at which the floor rises, per second
    fade_mps2 : rate at which d approaches w while no correction can be made
    droop_radps_per_nm, droop_max_ratio, droop_time_s : reduction of a wheel's speed per torque above the
        mean; its limit as a fraction of the wheel's speed; time constant of its low-pass
    std_max_ratio, stale_max_s : slip that is more uncertain, or older, is not used; below one and a half
        launch speeds, and in a controlled braking, the error of the speed counts as at that speed
    brake_lead_s : age of the ground speed during a braking
    charge_mps_per_mps2, charge_time_s : what a motor driver's integral needs to carry the torque of a
        braking, as a speed by its proportional gain, and its time constant; see :func:`with_motor_driver`
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
    std_max_ratio: float = 0.025
    stale_max_s: float = 3.0
    brake_lead_s: float = 0.15
    charge_mps_per_mps2: float = 0.0
    charge_time_s: float = 0.2


SETTINGS = TractionSettings()


class TractionTarget(NamedTuple):
    """Slip to aim for on the current terrain.

    Parameters
    ----------
    traction_ratio : s*, from 0 to below 1
    braking_ratio : magnitude of the slip of a controlled braking
    braking_mps2 : deceleration at that slip; 0 leaves braking to the motor drivers
    margin_ratio : slip above the balance that gives the working pull; at least the settings' own is used
    """

    traction_ratio: float
    braking_ratio: float = 0.0
    braking_mps2: float = 0.0
    margin_ratio: float = 0.0


class WheelMeasurements(NamedTuple):
    """Estimated state of the wheels, each an array (wheels,) of floats, contiguous.

    Parameters
    ----------
    speed_mps, accel_mps2 : speed and acceleration over ground along each wheel as it is steered, of the
        filter
    slip_ratio, slip_std : slip, signed along the wheel, and its standard deviation
    torque_nm : of the motors, at the wheels, signed along the wheel; NaN where it is not known
    """

    speed_mps: Array
    accel_mps2: Array
    slip_ratio: Array
    slip_std: Array
    torque_nm: Array


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
        least, accepted = (
            (1e-6, "above zero")
            if name in ("launch_mps", "droop_time_s", "charge_time_s")
            else (0.0, "from zero up")
        )
        if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value < math.inf:
            raise ConfigError(f"traction: {name} is {value!r}, a number {accepted} is required")
    return TractionSettings(*(float(value) for value in settings))


def with_motor_driver(settings: TractionSettings, robot: Robot) -> TractionSettings:
    """Return the settings with what a robot's motor drivers need to change their torque.

    A PI speed loop carries a change of torque T by its error until its integral has taken it over: an error
    of ``T / K_P`` with the time constant ``K_P / K_I``.  At a deceleration a, each of n wheels carries
    ``T = a m r / n``.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> round(with_motor_driver(SETTINGS, load_robot("agrimaro")).charge_mps_per_mps2, 3)
    0.1
    """
    motors = robot.equipment.motors
    torque = robot.mass_kg * robot.wheel_radius_m / len(robot.wheels)
    integral = motors.speed_integral_nmpr
    return settings._replace(
        charge_mps_per_mps2=torque / motors.speed_gain_nmspr * robot.wheel_radius_m,
        charge_time_s=motors.speed_gain_nmspr / integral if integral > 0 else 1e6,
    )


MAX_STEP_S = 0.5
"""A longer step between two calls is no step of a control loop."""


class TractionStatus(StatusCode):
    """Whether a correction is made, or why not.

    Slip too uncertain, too old or unknown, a bad clock, or a sensor that is not to be believed.
    """

    OK = 0
    UNCERTAIN = 1
    STALE = 2
    NO_SLIP = 3
    BAD_TIME = 4
    UNSOUND = 5


class TractionReport(NamedTuple):
    """What a step decided, and by what.

    Parameters
    ----------
    driven_mps : commanded speed of the fastest wheel
    target_ratio : s* with its floor
    balance_ratio : slip of steady motion; NaN until it was measured
    slip_ratio : largest of the wheels, positive in traction; NaN where it is not known
    drive_state : number of a :class:`terrain.control.danzi_pid.DriveState`, by what is commanded: the
        measured acceleration would latch into braking
    status : number of a :class:`TractionStatus`
    """

    driven_mps: float
    target_ratio: float
    balance_ratio: float
    slip_ratio: float
    drive_state: int
    status: int


class _Observed(NamedTuple):
    """Speed and acceleration over ground seen from the fastest wheel, slips, and whether they can be used."""

    ground_mps: float
    accel_mps2: float
    largest_slip: float
    mean_slip: float
    status: int


_SLOW_S = 0.5  # window of the speed gain: shorter is noise, longer comes late
_HELD_S = 0.4  # a robot that was limited for so long has had time to gain speed
_CONSTANT_S, _CONSTANT_MPS = 0.6, 0.02  # commanded at one speed for so long: what is left is steady motion
_STEADY_MPS2 = 0.06
_USUAL_STEP_S = 0.02  # time step of a fade where the clock is not valid
_STEADY_MPS = 0.1
_BALANCE_S = 1.0
_FLOOR_MAX = 0.95
_JUDGED = 1.5  # of the launch speed: slower, what is corrected is a speed, and its error is judged as one
_GRIP = 0.03  # up to this slip wheels work against each other; ground that yields by twice as much lets them
_SLOWEST_WHEEL_RATIO = 0.3  # of the fastest: a slower wheel, near the turning centre, is not used for q
_BRAKE_END_MPS = 0.05  # slower than that, stopping is a matter of a wheel's turn
_BRAKE_LONGEST, _BRAKE_SPARE_S = 1.3, 0.3  # of the time that the planned deceleration takes: then wheels lock
_BRAKE_MPS2 = 0.5  # a command that falls faster than the resistances slow the robot is a braking

(
    _DRIVEN,
    _DESIRED,
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

_F8, _I8 = types.float64, types.int64
_ROW = types.Array(_F8, 1, "A", readonly=True)
_SETTINGS = types.NamedUniTuple(_F8, len(TractionSettings._fields), TractionSettings)
_TARGET = types.NamedUniTuple(_F8, len(TractionTarget._fields), TractionTarget)
_WHEELS = types.NamedUniTuple(_F8[::1], len(WheelMeasurements._fields), WheelMeasurements)
_REPORT = types.NamedTuple((_F8, _F8, _F8, _F8, _I8, _I8), TractionReport)


def initial_state() -> Array:
    """Return the state (STATE_SIZE,) of a robot at rest, on unknown terrain."""
    state = np.zeros(STATE_SIZE)
    state[_BALANCE] = math.nan
    return state


def forget_terrain(state: Array) -> Array:
    """Return the state without what was learned of the terrain: for a change of the classified terrain."""
    state = state.copy()
    state[_BALANCE], state[_FLOOR] = math.nan, 0.0
    return state


@njit(cache=True)
def _observe(
    settings: TractionSettings,
    state: Array,
    after: Array,
    radius_m: float,
    wheels: WheelMeasurements,
    stale_s: float,
) -> _Observed:
    """Return the motion over ground seen from the fastest wheel: the least that a wheel shows."""
    n = wheels.slip_ratio.size
    status = TractionStatus.OK.value
    q, gain, slip, shared, std = math.inf, 0.0, -math.inf, 0.0, 0.0
    for i in range(n):
        sign = 1.0 if after[_PATTERN + i] >= 0.0 else -1.0
        ratio = abs(after[_PATTERN + i]) * radius_m  # of the fastest wheel's speed
        if not (
            math.isfinite(wheels.slip_ratio[i])
            and math.isfinite(wheels.slip_std[i])
            and math.isfinite(wheels.speed_mps[i])
            and math.isfinite(wheels.accel_mps2[i])
        ):
            status = TractionStatus.NO_SLIP.value
            continue
        slip = max(slip, sign * wheels.slip_ratio[i])
        shared += sign * wheels.slip_ratio[i] / n
        fastest = abs(wheels.speed_mps[i]) / max(1.0 - max(sign * wheels.slip_ratio[i], 0.0), 0.05)
        judged = max(fastest, _JUDGED * settings.launch_mps, state[_BRAKED_FROM])
        std = max(std, wheels.slip_std[i] * fastest / judged)
        if ratio >= _SLOWEST_WHEEL_RATIO:
            seen = sign * wheels.speed_mps[i] / ratio
            if seen < q:
                q, gain = seen, sign * wheels.accel_mps2[i] / ratio
    if math.isinf(q):
        q, gain = 0.0, 0.0
    if status == TractionStatus.OK.value and not stale_s <= settings.stale_max_s:
        status = TractionStatus.STALE.value
    if status == TractionStatus.OK.value and not std <= settings.std_max_ratio:
        status = TractionStatus.UNCERTAIN.value
    return _Observed(q, gain, slip, shared, status)


@njit(cache=True)
def _aimed_slip(state: Array, target_ratio: float, margin_ratio: float) -> float:
    """Return s*: no more than the balance and its margin, no less than the floor."""
    aimed = float(target_ratio)
    if math.isfinite(state[_BALANCE]):
        aimed = min(aimed, max(state[_BALANCE], 0.0) + margin_ratio)
    return max(aimed, float(state[_FLOOR]))


@njit(cache=True)
def _commanded_state(state: Array, desired_mps: float, was_mps: float, dt_s: float) -> int:
    """Return the drive state by the command."""
    if desired_mps > was_mps + 1e-9:
        return DriveState.TRACTION.value
    falling = state[_DESIRED] - desired_mps > _BRAKE_MPS2 * dt_s
    if falling or (state[_BRAKING] > 0.0 and was_mps > desired_mps):
        return DriveState.BRAKING.value
    return DriveState.STEADY.value


@njit(cache=True)
def _driven_speed(
    settings: TractionSettings,
    state: Array,
    after: Array,
    target: TractionTarget,
    aimed_ratio: float,
    seen: _Observed,
    drive_state: int,
    command: tuple[float, float, float],
) -> float:
    """Return d; ``command`` is the desired speed, the d of the step before, and the time step."""
    desired, was, dt_s = command
    braking_s = 0.0
    if seen.status != TractionStatus.OK.value:
        driven = min(desired, was + settings.fade_mps2 * dt_s)
        after[_HELD] = 0.0
    elif drive_state == DriveState.TRACTION.value:
        ahead = seen.ground_mps + settings.lead_s * min(max(seen.accel_mps2, 0.0), settings.lead_max_mps2)
        cap = max(ahead, settings.launch_mps) / (1.0 - min(aimed_ratio, _FLOOR_MAX))
        driven = min(desired, max(was, cap))
        after[_HELD] = state[_HELD] + dt_s if driven < desired else 0.0
    else:
        driven = desired
        after[_HELD] = 0.0
        stops_in_s = state[_BRAKED_FROM] / max(target.braking_mps2, 1e-6)
        overdue = state[_BRAKING] > _BRAKE_LONGEST * stops_in_s + _BRAKE_SPARE_S
        if drive_state == DriveState.BRAKING.value and target.braking_mps2 > 0.0 and not overdue:
            braking_s = state[_BRAKING] + dt_s
            ahead = seen.ground_mps - target.braking_mps2 * min(braking_s, settings.brake_lead_s)
            charge = settings.charge_mps_per_mps2 * math.exp(-braking_s / settings.charge_time_s)
            ahead = ahead * (1.0 - target.braking_ratio)
            driven = max(desired, min(was, ahead - charge * target.braking_mps2))
            if ahead <= max(desired, _BRAKE_END_MPS):
                driven, braking_s = desired, 0.0
    after[_BRAKING] = braking_s
    after[_BRAKED_FROM] = 0.0 if braking_s == 0.0 else max(state[_BRAKED_FROM], was)
    return driven


@njit(cache=True)
def _learn_balance(
    settings: TractionSettings,
    state: Array,
    after: Array,
    seen: _Observed,
    aimed_ratio: float,
    margin_ratio: float,
    desired_mps: float,
    dt_s: float,
) -> None:
    """Update the slip of steady motion, and raise the floor of s* where the robot gains no speed."""
    driven, q = after[_DRIVEN], seen.ground_mps
    after[_SLOW] = state[_SLOW] + (q - state[_SLOW]) * min(dt_s / _SLOW_S, 1.0)
    gained = (q - after[_SLOW]) / _SLOW_S
    if after[_HELD] > _HELD_S and gained < settings.gain_least_mps2:
        after[_FLOOR] = min(aimed_ratio + settings.floor_rate_ratio * dt_s, _FLOOR_MAX)
    if abs(driven - state[_REFERENCE]) > _CONSTANT_MPS:
        after[_REFERENCE], after[_CONSTANT] = driven, 0.0
    after[_CONSTANT] += dt_s
    if after[_CONSTANT] > _CONSTANT_S and abs(gained) < _STEADY_MPS2 and q > _STEADY_MPS:
        before = state[_BALANCE] if math.isfinite(state[_BALANCE]) else seen.mean_slip
        after[_BALANCE] = before + (seen.mean_slip - before) * min(dt_s / _BALANCE_S, 1.0)
        floor = min(max(after[_BALANCE], 0.0) + margin_ratio, _FLOOR_MAX)
        after[_FLOOR] = floor if driven >= desired_mps else max(after[_FLOOR], floor)


@njit(cache=True)
def _share_torque(
    settings: TractionSettings, state: Array, after: Array, torque_nm: Array, seen: _Observed, dt_s: float
) -> Array:
    """Return the wheels' commands: one speed for all, less the droop by torque above the mean."""
    n = torque_nm.size
    driven = after[_DRIVEN]
    mean = 0.0
    # a torque that is not known must not count as 0 beside the others
    measured = driven > _STEADY_MPS and np.isfinite(torque_nm).all()
    keep = math.exp(-dt_s / settings.droop_time_s)
    for i in range(n):
        sign = 1.0 if after[_PATTERN + i] >= 0.0 else -1.0
        torque = sign * torque_nm[i] if measured else 0.0
        after[_DROOP + i] = keep * state[_DROOP + i] + (1.0 - keep) * torque
        mean += after[_DROOP + i] / n
    grip = min(max(2.0 - abs(seen.mean_slip) / _GRIP, 0.0), 1.0)
    command = np.empty(n)
    for i in range(n):
        command[i] = after[_PATTERN + i] * driven
        if seen.status == TractionStatus.OK.value:
            limit = grip * settings.droop_max_ratio * abs(command[i])
            droop = settings.droop_radps_per_nm * (after[_DROOP + i] - mean)
            sign = 1.0 if after[_PATTERN + i] >= 0.0 else -1.0
            command[i] -= sign * min(max(droop, -limit), limit)
    return command


@njit(
    types.Tuple((_F8[::1], _F8[::1], _REPORT))(_SETTINGS, _F8[::1], _TARGET, _F8, _ROW, _WHEELS, _F8, _F8),
    cache=True,
)
def traction_step(
    settings: TractionSettings,
    state: Array,
    target: TractionTarget,
    radius_m: float,
    wheel_radps: Array,
    wheels: WheelMeasurements,
    stale_s: float,
    dt_s: float,
) -> tuple[Array, Array, TractionReport]:
    """Return the wheels' commands, the next state, and why; compiled.

    Parameters
    ----------
    settings, state : as :data:`~terrain.control.traction.SETTINGS` and :func:`initial_state`; the
        state is not changed
    target : slips to aim for
    radius_m : nominal radius of the wheels
    wheel_radps : (wheels,) desired
    wheels : estimates
    stale_s : time since the speed over ground was measured last
    dt_s : since the step before

    Returns
    -------
    wheel_radps : (wheels,) commanded
    state : the next
    report : what was decided
    """
    after = state.copy()
    desired, along = 0.0, 0.0
    for i in range(wheel_radps.size):
        desired = max(desired, abs(wheel_radps[i]) * radius_m)
        along += wheel_radps[i] * state[_PATTERN + i]
    was = state[_DRIVEN] if along >= 0.0 else 0.0  # a reversal is a start from rest
    if desired > 0.0:  # a command to stop keeps the directions of the last motion
        for i in range(wheel_radps.size):
            after[_PATTERN + i] = wheel_radps[i] / desired
    if not (0.0 < dt_s <= MAX_STEP_S):
        driven = min(desired, was + settings.fade_mps2 * _USUAL_STEP_S)
        after[_DRIVEN] = driven
        command = after[_PATTERN : _PATTERN + wheel_radps.size] * driven
        steady, bad_time = DriveState.STEADY.value, TractionStatus.BAD_TIME.value
        report = TractionReport(driven, target.traction_ratio, state[_BALANCE], math.nan, steady, bad_time)
        return command, after, report
    seen = _observe(settings, state, after, radius_m, wheels, stale_s)
    after[_DESIRED] = desired
    margin = max(settings.balance_margin_ratio, target.margin_ratio)
    aimed = _aimed_slip(state, target.traction_ratio, margin)
    drive_state = _commanded_state(state, desired, was, dt_s)
    driven = _driven_speed(settings, state, after, target, aimed, seen, drive_state, (desired, was, dt_s))
    after[_DRIVEN] = driven
    if seen.status == TractionStatus.OK.value:
        _learn_balance(settings, state, after, seen, aimed, margin, desired, dt_s)
    command = _share_torque(settings, state, after, wheels.torque_nm, seen, dt_s)
    slip = math.nan if seen.status == TractionStatus.NO_SLIP.value else seen.largest_slip
    return command, after, TractionReport(driven, aimed, after[_BALANCE], slip, drive_state, seen.status)
