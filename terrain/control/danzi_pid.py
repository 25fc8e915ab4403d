"""The traction controller of Danzi, AgriMaRo thesis, chapter 8: a PID on the slip of each wheel.

One step, for each wheel with radius r, rate w and ground speed v along it:

- slip (8.4), (8.5): ``s = (w r - v) / max(|w r|, |v|)``, 0 where both are below the low speed (7.2.1);
- drive state (8.6): traction, braking or steady by the power ``a v`` against a threshold;
- desired slip (8.7)-(8.9): the target of that state times the wheel's direction;
- error (8.1): desired less real; 0 where the wheel goes over ground slower than the low speed;
- PID (8.2), whose output is added to the wheel's command (8.3) where the robot's own speed is above a
  threshold.

Two forms:

- ``printed``: the direction is sgn(v), and the output of the PID on e, a ratio, is added as rad/s.  The loop
  gain then depends on radius and speed: by (8.4) a correction changes the slip r / max(|w r|, |v|) times as
  much.  In the four braking rows of table 8.1 (r = 1 m, 0.5 m/s: twice), iterated at K_P = 1, the error
  oscillates without decay.
- ``normalised``: the input of the PID is ``e max(|w r|, |v|) / r`` in rad/s, by which K_P = 0.5 leaves 0.5 of
  an error in braking and, in the cases of table 8.1, 0.50 to 0.56 of it in traction, at any speed and radius.
  At rest sgn(v) changes with noise: the direction is that of the command instead, which changes when the
  command exceeds the low speed in the other direction.  The integral is reset then, and nothing is corrected
  while the wheel still rolls in the old direction: a braking target with the sign of the new direction would
  delay the reversal.

The thesis specifies neither clamp nor anti-windup, nor the integral while its output is not used: here it is
kept.

A target that is not the slip at which the thrust balances the resistance (0.126 on grass) cannot be held at a
constant speed.  With an integral either form then slows the robot towards a standstill or drives it as far
beyond its command as the clamp allows: in a minute at K_P = K_I = 0.5, normalised, from 0.87 m/s to 0.10 with
a target of 0.05, and to 1.75 with 0.2 and a clamp of 5 rad/s.  It is a baseline for other controllers.

Drive state of a wheel (traction, braking or steady) from the power per mass that accelerates the body.

(8.6) of Danzi, AgriMaRo thesis: ``Power_state = a v`` with acceleration a and speed v along the wheel, in
W/kg.  The product is positive while the wheel speeds up and negative while it slows down, in either direction
of rolling.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types

from terrain.control.pid import (
    GAINS,
    LONGEST_STEP_S,
    Gains,
    PidState,
    PidStatus,
    check_gains,
    pid_step,
)
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.status import StatusCode


class DriveState(StatusCode):
    """Drive state of a wheel or of the robot; from 0 on, its place in ``slip_table.DRIVE_STATES``.

    ``UNKNOWN`` is that of a wheel whose speed or acceleration is not known.
    """

    UNKNOWN = -1
    TRACTION = 0
    BRAKING = 1
    STEADY = 2


POWER_THRESHOLD_WPKG = 0.1
"""Assumed, as the thesis specifies none: 0.1 m/s^2 at 1 m/s, the threshold of a steady speed elsewhere
(``terrain.estimation.slip_figures.STEADY_CHANGE_MPS``), and more than five times the effect of an
accelerometer's bias."""


@njit(types.int64(types.float64, types.float64, types.float64), cache=True)
def power_state(accel_mps2: float, speed_mps: float, threshold_wpkg: float) -> int:
    """Return the number of the :class:`DriveState` of a wheel; at the threshold it is steady.

    Examples
    --------
    >>> [power_state(*wheel, 0.1) for wheel in ((1.0, 0.5), (-1.0, -0.5), (1.0, -0.5), (0.1, 1.0))]
    [0, 0, 1, 2]
    """
    power_wpkg = accel_mps2 * speed_mps
    if math.isnan(power_wpkg):
        return DriveState.UNKNOWN.value
    if power_wpkg > threshold_wpkg:
        return DriveState.TRACTION.value
    return DriveState.BRAKING.value if power_wpkg < -threshold_wpkg else DriveState.STEADY.value


LOW_SPEED_MPS = 0.05
"""Thesis 8.3.2, of a wheel and of the robot."""

FORMS = ("printed", "normalised")
PRINTED, NORMALISED = range(2)


class ThesisStatus(StatusCode):
    """Result of a step of a wheel: those of its PID, and three in which its error is not used.

    ``LOW_SPEED``: the error counts as 0.  ``STANDING``, ``REVERSING``: nothing is added, as the robot is at
    rest, or as the wheel rolls against its command or has had none yet.
    """

    OK = PidStatus.OK
    CLAMPED = PidStatus.CLAMPED
    BAD_TIME = PidStatus.BAD_TIME
    NO_ERROR = PidStatus.NO_ERROR
    LOW_SPEED = 4
    STANDING = 5
    REVERSING = 6


class ThesisSettings(NamedTuple):
    """Settings; :func:`thesis_settings` checks them.

    Parameters
    ----------
    wheel_radius_m : of all wheels
    form : :data:`PRINTED` or :data:`NORMALISED`
    low_speed_mps : of a wheel, below which its error is 0
    chassis_speed_mps : of the robot, above which something is added to commands
    power_threshold_wpkg : beyond which a wheel is in traction or braking
    gains : kp in rad/s (printed) or without unit (normalised), limits in rad/s
    """

    wheel_radius_m: float
    form: int
    low_speed_mps: float
    chassis_speed_mps: float
    power_threshold_wpkg: float
    gains: Gains


STATES = ("integral_radps", "error", "direction")
"""Rows of the state (3, wheels): the two of its PID (:class:`terrain.control.pid.PidState`), and the
direction of its command, 1 or -1; 0 before there was one."""

_F8 = types.float64
_ROW = types.Array(_F8, 1, "A", readonly=True)
_TABLE = types.Array(_F8, 2, "A", readonly=True)
SETTINGS = types.NamedTuple((_F8, types.int64, _F8, _F8, _F8, GAINS), ThesisSettings)


def thesis_settings(
    wheel_radius_m: float,
    gains: Gains,
    form: str = "normalised",
    *,
    low_speed_mps: float = LOW_SPEED_MPS,
    chassis_speed_mps: float = LOW_SPEED_MPS,
    power_threshold_wpkg: float = POWER_THRESHOLD_WPKG,
) -> ThesisSettings:
    """Return settings that :func:`thesis_step` accepts.

    Raises
    ------
    ConfigError
        if the form is unknown, or a gain, the radius or a threshold is out of range.

    Examples
    --------
    >>> thesis_settings(0.2, Gains(0.5, 0.5, 0.0, limit=5.0)).form == NORMALISED
    True
    >>> thesis_settings(0.2, Gains(0.5, 0.5, 0.0, limit=5.0), "new")
    Traceback (most recent call last):
    terrain.errors.ConfigError: form 'new' is unknown: use one of printed, normalised
    """
    if form not in FORMS:
        raise ConfigError(f"form {form!r} is unknown: use one of {', '.join(FORMS)}")
    numbers = {
        "wheel_radius_m": wheel_radius_m,
        "low_speed_mps": low_speed_mps,
        "chassis_speed_mps": chassis_speed_mps,
        "power_threshold_wpkg": power_threshold_wpkg,
    }
    for name, value in numbers.items():
        if not 0 < value < math.inf:
            raise ConfigError(f"{name} is {value!r}, a finite number above zero is required")
    radius_m, low_mps, chassis_mps, power_wpkg = (float(value) for value in numbers.values())
    return ThesisSettings(radius_m, FORMS.index(form), low_mps, chassis_mps, power_wpkg, check_gains(gains))


def new_state(wheels: int = 3) -> Array:
    """Return the state (3, wheels) before the first step."""
    return np.array([np.zeros(wheels), np.full(wheels, np.nan), np.zeros(wheels)])


@njit(types.UniTuple(_F8, 2)(_F8, _F8, _F8), cache=True)
def conditioned_slip(wheel_speed_mps: float, speed_mps: float, low_speed_mps: float) -> tuple[float, float]:
    """Return slip (8.4) and its denominator (8.5); slip is 0 where both speeds are low, NaN where unknown.

    Examples
    --------
    >>> conditioned_slip(-0.39, -0.5, 0.05), conditioned_slip(0.01, -0.04, 0.05)
    ((0.21999999999999997, 0.5), (0.0, 0.04))
    """
    fastest_mps = max(abs(wheel_speed_mps), abs(speed_mps))
    slip_mps = wheel_speed_mps - speed_mps
    if math.isnan(slip_mps):
        return math.nan, math.nan
    return (0.0 if fastest_mps < low_speed_mps else slip_mps / fastest_mps), fastest_mps


@njit(_F8(types.int64, _F8, _ROW), cache=True)
def desired_slip(drive_state: int, direction: float, target_ratio: Array) -> float:
    """Return (8.7)-(8.9): the target of the state (traction, braking, steady) times the direction, or NaN."""
    return math.nan if drive_state == DriveState.UNKNOWN.value else direction * target_ratio[drive_state]


@njit(
    types.Tuple((_F8[::1], _F8[::1], types.int64[::1], types.int64[::1], _F8[:, ::1]))(
        SETTINGS, _TABLE, _ROW, _ROW, _ROW, _ROW, _F8, _ROW, _F8
    ),
    cache=True,
)
def thesis_step(
    settings: ThesisSettings,
    state: Array,
    command_radps: Array,
    wheel_radps: Array,
    speed_mps: Array,
    accel_mps2: Array,
    chassis_speed_mps: float,
    target_ratio: Array,
    dt_s: float,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the correction of the wheels' commands, and why; compiled, callable from compiled code.

    Parameters
    ----------
    settings, state : of :func:`thesis_settings`; of :func:`new_state` or the step before (left as it is)
    command_radps, wheel_radps : (wheels,) commanded by the kinematics, and measured
    speed_mps, accel_mps2 : (wheels,) of the wheel's centre over ground, along the wheel
    chassis_speed_mps : magnitude of the robot's velocity
    target_ratio : (3,) slip in traction, braking, steady motion, as ``slip_table`` signs it
    dt_s : since the step before

    Returns
    -------
    correction_radps : (wheels,) to add to the commands; 0 by every status but ok, clamped and low speed
    desired_ratio : (wheels,) signed along the wheel; NaN where the drive state or the target is unknown
    drive_state : (wheels,) numbers of :class:`terrain.control.danzi_pid.DriveState`
    status : (wheels,) numbers of :class:`ThesisStatus`
    state : next

    Examples
    --------
    Case 1A of table 8.1, forward in traction with too much slip, on three wheels of a radius of 1 m:

    >>> printed = thesis_settings(1.0, Gains(1.0, 0.0, 0.0, limit=1.0), "printed")
    >>> rate, speed, targets = np.full(3, 0.7), np.full(3, 0.6), np.array([0.1, -0.15, 0.05])
    >>> added, *_ = thesis_step(printed, new_state(), rate, rate, speed, np.ones(3), 0.6, targets, 0.02)
    >>> added.round(3)
    array([-0.043, -0.043, -0.043])
    """
    wheels = wheel_radps.size
    correction, desired, later = np.zeros(wheels), np.empty(wheels), np.empty((3, wheels))
    drive_state, status = np.empty(wheels, np.int64), np.empty(wheels, np.int64)
    integral, memory, direction = later[0], later[1], later[2]
    radius, low = settings.wheel_radius_m, settings.low_speed_mps
    normalised = settings.form == NORMALISED
    for i in range(wheels):
        wheel_speed, speed = wheel_radps[i] * radius, speed_mps[i]
        reference = command_radps[i] * radius
        integral[i], memory[i], direction[i] = state[0, i], np.nan, state[2, i]
        if abs(reference) > low and reference * direction[i] <= 0.0:
            direction[i] = math.copysign(1.0, reference)
            if normalised:
                integral[i] = 0.0
        slip, fastest = conditioned_slip(wheel_speed, speed, low)
        drive_state[i] = power_state(accel_mps2[i], speed, settings.power_threshold_wpkg)
        desired[i] = desired_slip(
            drive_state[i], direction[i] if normalised else np.sign(speed), target_ratio
        )
        error = desired[i] - slip
        if not 0.0 < dt_s <= LONGEST_STEP_S:
            status[i] = ThesisStatus.BAD_TIME.value
        elif not math.isfinite(error) or math.isnan(chassis_speed_mps):
            status[i] = ThesisStatus.NO_ERROR.value
        elif chassis_speed_mps <= settings.chassis_speed_mps:
            status[i] = ThesisStatus.STANDING.value
        elif normalised and abs(speed) >= low and speed * direction[i] <= 0.0:
            status[i] = ThesisStatus.REVERSING.value
        else:
            slow = abs(speed) < low
            if slow:
                error = 0.0
            elif normalised:
                error *= fastest / radius
            before = PidState(integral[i], state[1, i])
            correction[i], after, status[i] = pid_step(settings.gains, before, error, dt_s)
            integral[i], memory[i] = after.integral, after.error
            if slow:
                status[i] = ThesisStatus.LOW_SPEED.value
    return correction, desired, drive_state, status, later
