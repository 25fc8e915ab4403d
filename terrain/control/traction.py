"""A traction controller by the balance of forces: one speed for all wheels, limited while it rises.

In steady motion the slip of a wheel is given by what resists it, ``F(s) = R``, and not by its speed command:
a controller that integrates the error of slip towards a target below that balance slows the robot to a
standstill, one above it runs away (``tests/terrain/control/test_pid.py`` shows both).  What a speed
command does decide is how much *more* slip a start takes, and that is what is limited here.

With w the desired speed of the fastest wheel, d the commanded speed, u_i the desired speed of wheel i, g_i
its speed over ground along it, and s* the target slip::

    q = min_i g_i w / u_i                      ground speed, seen from the fastest wheel
    q' = a + (q - q') / T                      without the steps of single fixes
    c = max(q' + t a', v_l) / (1 - s*)         the speed at which it slips by s*               (cap)
    d = w where w <= d, else min(w, max(d, c))                                                 (drive)

- All wheels are commanded ``d / w`` of their speed: the turning centre stays where it is.
- The cap limits the rise of d and nothing else.  A cap that may fall stalls: less speed, less pull, less
  ground speed, less cap.
- It is the normalised P controller of slip, ``d + K (s* - s) d`` with ``s = 1 - q / d`` and ``K = 1 / (1 -
  s*)`` (as :mod:`terrain.control.pid` normalises it), acting on the chassis instead of each wheel.
- Below v_l the slip ratio carries little information on the terrain: v_l replaces the robot's speed, and d rises
  as it does while no correction can be made.
- On hard ground slip is small, and follows from the acceleration: of all rises of d to a speed within a distance a
  constant one slips least, but for the first v_0, which wheels may slip by, as slip is none below.  There d rises at
  once, and by so much less later.
- A receiver moves q at each fix, by centimetres per second: a command that follows at once makes the wheels slip by as
  much, so that it follows by the acceleration between fixes, and reaches them within T.
- q is delayed by the filter's lag and the command by its transport; t compensates both with the acceleration a',
  a behind a low-pass of T, limited to that of a start on soft soil, as the acceleration of the first tenths of a second
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
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.control.pid import LONGEST_STEP_S, DriveState
from terrain.records import Array
from terrain.robots import Robot
from terrain.status import StatusCode


class TractionSettings(NamedTuple):
    """Settings; the defaults were tuned on simulated starts whose seeds are used nowhere else."""

    launch_mps: float = 0.22  #: v_l; at 0.2 m/s a speed error of 1 cm/s is 5 % of slip
    #: time by which q is extrapolated, and the largest acceleration used for it: the lag of the filter, the delay of
    #: the command and half the response time of a motor driver; the acceleration that 4 % of the weight gives
    lead_s: float = 0.15
    lead_max_mps2: float = 0.3
    smooth_s: float = 0.0  #: T, within which d follows a fix that moves q in a step
    #: standard deviations of the ground speed that are added to q: what is not known holds no robot back
    std_ahead: float = 0.0
    balance_margin_ratio: float = 0.03  #: least s* above the slip that balances steady motion
    #: a robot that is held back accelerates at least by this, or the floor of s* rises
    gain_least_mps2: float = 0.25
    floor_rate_ratio: float = 0.15  #: rate at which the floor rises, per second
    step_mps: float = 0.0  #: up to it d rises at once
    rise_mps2: float = math.inf  #: largest rate at which d rises
    fade_mps2: float = 1.0  #: rate at which d approaches w while no correction can be made
    #: reduction of a wheel's speed per torque above the mean; its limit as a fraction of the wheel's speed; time
    #: constant of its low-pass
    droop_radps_per_nm: float = 0.02
    droop_max_ratio: float = 0.1
    droop_time_s: float = 1.5
    #: slip that is more uncertain, or older, is not used; below one and a half launch speeds, and in a controlled
    #: braking, the error of the speed counts as at that speed
    std_max_ratio: float = 0.025
    stale_max_s: float = 3.0
    brake_lead_s: float = 0.15  #: age of the ground speed during a braking
    #: what a motor driver's integral needs to carry the torque of a braking, as a speed by its proportional gain, and
    #: its time constant; see :func:`settings_of`
    charge_mps_per_mps2: float = 0.0
    charge_time_s: float = 0.2


SETTINGS = TractionSettings()
#: Of other than swerve robots: a satellite receiver or a camera gives a speed to 3 or 4 cm/s, which near the launch
#: speed is 0.2 of slip, and less than half of what a start takes without control; what is not known is driven as by a
#: ramp, slower than the usual 1 m/s^2 behind a first step, and that is the fastest; an acceleration behind a low-pass
#: does last; a robot that gains less than 0.4 m/s^2 loses more distance than slip is worth.
OTHERS = {
    "std_max_ratio": 0.2,
    "launch_mps": 0.2,
    "smooth_s": 0.2,
    "std_ahead": 0.25,
    "lead_max_mps2": 0.8,
    "gain_least_mps2": 0.4,
    "fade_mps2": 0.7,
    "rise_mps2": 0.7,
    "step_mps": 0.1,
}


class TractionTarget(NamedTuple):
    """Slip to aim for on the current terrain."""

    traction_ratio: float  #: s*, from 0 to below 1
    braking_ratio: float = 0.0  #: magnitude of the slip of a controlled braking
    braking_mps2: float = 0.0  #: deceleration at that slip; 0 leaves braking to the motor drivers
    #: above the balance, gives the working pull; at least the settings' own is used
    margin_ratio: float = 0.0


class WheelMotion(NamedTuple):
    """Estimated motion at the wheels; arrays (wheels,), signed along each wheel as it is steered."""

    speed_mps: Array  #: over ground, of the filter
    accel_mps2: Array
    slip_ratio: Array
    slip_std: Array
    torque_nm: Array  #: of the motors, at the wheels; NaN where it is not known
    wheel_radps: Array
    chassis_mps: float  #: magnitude of the robot's velocity
    stale_s: float  #: since the speed over ground was measured last; infinite before the first time


def settings_of(robot: Robot) -> TractionSettings:
    """Return the settings, with what a robot's motor drivers need to change their torque.

    A PI speed loop carries a change of torque T by its error until its integral has taken it over: an error
    of ``T / K_P`` with the time constant ``K_P / K_I``.  At a deceleration a, each of n driven wheels carries
    ``T = a m r / n``; without known motors nothing is added.  Wheels are steered against each other by an error of
    their angles: where they are not, they turn the robot by their difference in torque, and none droops.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> round(settings_of(load_robot("agrimaro")).charge_mps_per_mps2, 3)
    0.1
    """
    settings = SETTINGS
    if not (robot.steered and robot.sideways):
        settings = settings._replace(droop_radps_per_nm=0.0, **OTHERS)
    motors, torque = robot.completed.motors, robot.mass_kg * robot.wheel_radius_m / len(robot.logged_wheels)
    if motors.speed_gain_nmspr == 0.0:
        return settings
    integral = motors.speed_integral_nmpr
    return settings._replace(
        charge_mps_per_mps2=torque / motors.speed_gain_nmspr * robot.wheel_radius_m,
        charge_time_s=motors.speed_gain_nmspr / integral if integral > 0 else 1e6,
    )


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


class WheelReport(NamedTuple):
    """What a step of a controller of the wheels decided, and by what; NaN where it does not have the figure."""

    driven_mps: float  #: commanded speed of the fastest wheel
    aimed_ratio: float  #: s* with its floor
    balance_ratio: float  #: slip of steady motion; NaN until it was measured
    slip_ratio: float  #: largest of the wheels, positive in traction
    drive_state: DriveState  #: by what is commanded, as the measured acceleration would latch into braking
    status: TractionStatus


class TractionState(NamedTuple):
    """What a step leaves to the next; as it is at first, of a robot at rest on unknown terrain."""

    driven_mps: float = 0.0  #: d
    desired_mps: float = 0.0  #: w
    lagged_mps: float = 0.0  #: d behind the lag of what is estimated
    reference_mps: float = 0.0  #: speed that is commanded without a change
    constant_s: float = 0.0  #: for how long it has been
    smooth_mps: float = (
        math.nan
    )  #: q without the steps of single fixes, and its acceleration; NaN where unknown
    smooth_mps2: float = 0.0
    slow_mps: float = 0.0  #: q behind a low-pass
    balance_ratio: float = math.nan  #: slip of steady motion, NaN until it was measured
    floor_ratio: float = 0.0  #: least s*
    held_s: float = 0.0  #: for how long d has been limited
    braking_s: float = 0.0  #: for how long braking has been controlled
    braked_from_mps: float = 0.0  #: largest d in it
    droop_nm: tuple[float, ...] = ()  #: torque of each wheel behind its low-pass; none yet at first
    rate_radpm: tuple[float, ...] = ()  #: of each wheel at w = 1 m/s, of the last command to move


#: A command that falls by the second within the first is ahead of the estimate: it shows no slip of that braking yet.
_LAG_S, _FALLEN_MPS = 0.15, 0.2
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


def traction_step(
    settings: TractionSettings,
    state: TractionState,
    target: TractionTarget,
    radius_m: float,
    wheel_radps: Array,
    wheels: WheelMotion,
    dt_s: float,
) -> tuple[Array, TractionState, WheelReport]:
    """Return the wheels' commands (wheels,), the next state, and why.

    Parameters
    ----------
    settings, state : as :data:`SETTINGS`; ``TractionState()`` at first, then what the step before returned
    target : slips to aim for
    radius_m : nominal radius of the wheels
    wheel_radps : (wheels,) desired
    wheels : as estimated
    dt_s : since the step before
    """
    rates = wheel_radps.tolist()
    if not state.rate_radpm:
        state = state._replace(droop_nm=(0.0,) * len(rates), rate_radpm=(0.0,) * len(rates))
    desired, along = 0.0, 0.0
    for rate, before in zip(rates, state.rate_radpm, strict=True):
        desired = max(desired, abs(rate) * radius_m)
        along += rate * before
    was = state.driven_mps if along >= 0.0 else 0.0  # a reversal is a start from rest
    if desired > 0.0:  # a command to stop keeps the directions of the last motion
        state = state._replace(rate_radpm=tuple(rate / desired for rate in rates))
    if not 0.0 < dt_s <= LONGEST_STEP_S:
        driven = min(desired, was + settings.fade_mps2 * _USUAL_STEP_S)
        figures = driven, target.traction_ratio, state.balance_ratio, math.nan
        command = np.array([rate * driven for rate in state.rate_radpm])
        report = WheelReport(*figures, DriveState.STEADY, TractionStatus.BAD_TIME)
        return command, state._replace(driven_mps=driven), report

    # q and acceleration: of all wheels the one counts that shows the least speed; largest and mean slip; status
    status = TractionStatus.OK
    q, accel, largest_slip, mean_slip, uncertain = math.inf, 0.0, -math.inf, 0.0, 0.0
    for rate, *motion in zip(state.rate_radpm, *(row.tolist() for row in wheels[:4]), strict=True):
        if not all(map(math.isfinite, motion)):
            status = TractionStatus.NO_SLIP
            continue
        speed, wheel_accel, slip, std = motion
        sign = 1.0 if rate >= 0.0 else -1.0
        ratio = abs(rate) * radius_m  # of the fastest wheel's speed
        largest_slip = max(largest_slip, sign * slip)
        mean_slip += sign * slip / len(state.rate_radpm)
        fastest = abs(speed) / max(1.0 - max(sign * slip, 0.0), 0.05)
        judged = max(fastest, _JUDGED * settings.launch_mps, state.braked_from_mps)
        uncertain = max(uncertain, std * fastest / judged)
        seen = sign * speed + settings.std_ahead * std * fastest
        if ratio >= _SLOWEST_WHEEL_RATIO and seen / ratio < q:
            q, accel = seen / ratio, sign * wheel_accel / ratio
    if status is TractionStatus.OK and not wheels.stale_s <= settings.stale_max_s:
        status = TractionStatus.STALE
    if status is TractionStatus.OK and not uncertain <= settings.std_max_ratio:
        status = TractionStatus.UNCERTAIN
    falls = target.braking_mps2 == 0.0 and state.lagged_mps - desired > _FALLEN_MPS
    if status is TractionStatus.OK and falls:
        status = TractionStatus.UNCERTAIN
    q = 0.0 if math.isinf(q) else q
    smooth, smooth_mps2 = q, accel
    if status is TractionStatus.OK and math.isfinite(state.smooth_mps):
        smooth, part = state.smooth_mps + accel * dt_s, dt_s / max(settings.smooth_s, dt_s)
        smooth, smooth_mps2 = (
            smooth + part * (q - smooth),
            state.smooth_mps2 + part * (accel - state.smooth_mps2),
        )
    margin = max(settings.balance_margin_ratio, target.margin_ratio)
    aimed = target.traction_ratio  # s*: no more than the balance and its margin, no less than the floor
    balance, floor = state.balance_ratio, state.floor_ratio
    if math.isfinite(balance):
        aimed = min(aimed, max(balance, 0.0) + margin)
    aimed = max(aimed, floor)

    # d, by what is commanded
    driven, held_s, braking_s, drive_state = desired, 0.0, 0.0, DriveState.STEADY
    if desired > was + 1e-9:
        drive_state = DriveState.TRACTION
    elif state.desired_mps - desired > _BRAKE_MPS2 * dt_s or (state.braking_s > 0.0 and was > desired):
        drive_state = DriveState.BRAKING
    if status is not TractionStatus.OK:
        driven = min(desired, max(was + settings.fade_mps2 * dt_s, settings.step_mps))
    elif drive_state is DriveState.TRACTION:
        ahead = smooth + settings.lead_s * min(max(smooth_mps2, 0.0), settings.lead_max_mps2)
        cap = max(ahead, settings.launch_mps) / (1.0 - min(aimed, _FLOOR_MAX))
        rise_mps2 = settings.rise_mps2 if smooth > settings.launch_mps else settings.fade_mps2
        driven = min(desired, max(was, min(cap, max(settings.step_mps, was + rise_mps2 * dt_s))))
        held_s = state.held_s + dt_s if driven < desired else 0.0
    elif drive_state is DriveState.BRAKING and target.braking_mps2 > 0.0:
        stops_in_s = state.braked_from_mps / max(target.braking_mps2, 1e-6)
        time_s = state.braking_s + dt_s
        ahead = q - target.braking_mps2 * min(time_s, settings.brake_lead_s)
        ahead *= 1.0 - target.braking_ratio
        overdue = state.braking_s > _BRAKE_LONGEST * stops_in_s + _BRAKE_SPARE_S
        if not overdue and not ahead <= max(desired, _BRAKE_END_MPS):
            charge = settings.charge_mps_per_mps2 * math.exp(-time_s / settings.charge_time_s)
            driven, braking_s = max(desired, min(was, ahead - charge * target.braking_mps2)), time_s

    # the slip of steady motion, and the floor of s*, which rises where the robot gains no speed
    slow, reference, constant_s = state.slow_mps, state.reference_mps, state.constant_s
    if status is TractionStatus.OK:
        slow += (q - slow) * min(dt_s / _SLOW_S, 1.0)
        gained = (q - slow) / _SLOW_S
        if held_s > _HELD_S and gained < settings.gain_least_mps2:
            floor = min(aimed + settings.floor_rate_ratio * dt_s, _FLOOR_MAX)
        if abs(driven - reference) > _CONSTANT_MPS:
            reference, constant_s = driven, 0.0
        constant_s += dt_s
        if constant_s > _CONSTANT_S and abs(gained) < _STEADY_MPS2 and q > _STEADY_MPS:
            before = balance if math.isfinite(balance) else mean_slip
            balance = before + (mean_slip - before) * min(dt_s / _BALANCE_S, 1.0)
            steady = min(max(balance, 0.0) + margin, _FLOOR_MAX)
            floor = steady if driven >= desired else max(floor, steady)

    # one speed for all wheels, less the droop by torque above the mean, behind its low-pass
    signs = [1.0 if rate >= 0.0 else -1.0 for rate in state.rate_radpm]
    torques = wheels.torque_nm.tolist()
    # a torque that is not known must not count as 0 beside the others
    measured = driven > _STEADY_MPS and all(map(math.isfinite, torques))
    keep = math.exp(-dt_s / settings.droop_time_s)
    filtered = tuple(
        keep * before + (1.0 - keep) * (sign * torque if measured else 0.0)
        for before, sign, torque in zip(state.droop_nm, signs, torques, strict=True)
    )
    mean = 0.0
    for torque in filtered:
        mean += torque / len(filtered)
    grip = min(max(2.0 - abs(mean_slip) / _GRIP, 0.0), 1.0)
    commands = [rate * driven for rate in state.rate_radpm]
    if status is TractionStatus.OK:
        for i, sign in enumerate(signs):
            limit = grip * settings.droop_max_ratio * abs(commands[i])
            droop = settings.droop_radps_per_nm * (filtered[i] - mean)
            commands[i] -= sign * min(max(droop, -limit), limit)
    braked_from = 0.0 if braking_s == 0.0 else max(state.braked_from_mps, was)
    smooth = smooth if status is TractionStatus.OK else math.nan
    lagged = state.lagged_mps + (driven - state.lagged_mps) * min(dt_s / _LAG_S, 1.0)
    seen = driven, desired, lagged, reference, constant_s, smooth, smooth_mps2, slow
    learned = *seen, balance, floor, held_s, braking_s, braked_from
    slip = math.nan if status is TractionStatus.NO_SLIP else largest_slip
    report = WheelReport(driven, aimed, balance, slip, drive_state, status)
    return np.array(commands), TractionState(*learned, filtered, state.rate_radpm), report
