"""The traction controller of Danzi, AgriMaRo thesis, chapter 8: a PID on the slip of each wheel.

One step, for each wheel with radius r, rate w and ground speed v along it:

- slip (8.4), (8.5): ``s = (w r - v) / max(|w r|, |v|)``, 0 where both are below the low speed (7.2.1);
- drive state (8.6): traction, braking or steady by the power ``a v`` against a threshold;
- desired slip (8.7)-(8.9): the target of that state times the wheel's direction;
- error (8.1): desired less real; 0 where the wheel goes over ground slower than the low speed;
- PID (8.2), whose output is added to the wheel's command (8.3) where the robot's own speed is above a
  threshold.

Two points differ from the printed form:

- The input of the PID is ``e max(|w r|, |v|) / r`` in rad/s and not the ratio e.  By (8.4) a correction changes
  the slip r / max(|w r|, |v|) times as much, so that the printed form's loop gain depends on radius and speed;
  here K_P = 0.5 leaves 0.5 of an error in braking and, in the cases of table 8.1, 0.50 to 0.56 of it in
  traction, at any speed and radius.  ``examples/papers/danzi.py`` has the printed form, which oscillates.
- The wheel's direction is that of its command and not sgn(v), which changes with noise at rest; it changes when
  the command exceeds the low speed in the other direction.  The integral is reset then, and nothing is corrected
  while the wheel still rolls in the old direction: a braking target with the sign of the new direction would
  delay the reversal.

The thesis specifies neither clamp nor anti-windup, nor the integral while its output is not used: here it is
kept.

A target that is not the slip at which the thrust balances the resistance (0.126 on grass) cannot be held at a
constant speed.  With an integral either form then slows the robot towards a standstill or drives it as far
beyond its command as the clamp allows: in a minute at K_P = K_I = 0.5, from 0.87 m/s to 0.10 with a target of
0.05, and to 1.75 with 0.2 and a clamp of 5 rad/s.  It is a baseline for other controllers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from terrain.control.pid import LONGEST_STEP_S, Gains, PidState, PidStatus, check_gains, pid_step
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

LOW_SPEED_MPS = 0.05
"""Thesis 8.3.2, of a wheel and of the robot."""


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
    """Settings.

    Parameters
    ----------
    wheel_radius_m : of all wheels
    gains : kp without unit, limits in rad/s
    low_speed_mps : of a wheel, below which its error is 0
    chassis_speed_mps : of the robot, above which something is added to commands
    power_threshold_wpkg : beyond which a wheel is in traction or braking
    """

    wheel_radius_m: float
    gains: Gains
    low_speed_mps: float = LOW_SPEED_MPS
    chassis_speed_mps: float = LOW_SPEED_MPS
    power_threshold_wpkg: float = POWER_THRESHOLD_WPKG


class WheelPid(NamedTuple):
    """What a step leaves to the next, of a wheel: its PID, and the direction of its command; 0 before there was one."""

    pid: PidState = PidState()
    direction: float = 0.0


class WheelStep(NamedTuple):
    """What a step gives a wheel.

    Parameters
    ----------
    correction_radps : to add to its command; 0 by every status but ok, clamped and low speed
    desired_ratio : signed along the wheel; NaN where the drive state or the target is unknown
    drive_state, status : by which
    """

    correction_radps: float
    desired_ratio: float
    drive_state: DriveState
    status: ThesisStatus


def check_thesis(settings: ThesisSettings) -> ThesisSettings:
    """Return settings that :func:`thesis_step` accepts.

    Raises
    ------
    ConfigError
        if a gain, the radius or a threshold is out of range.

    Examples
    --------
    >>> check_thesis(ThesisSettings(0.0, Gains(0.5, 0.5, 0.0, limit=5.0)))
    Traceback (most recent call last):
    terrain.errors.ConfigError: wheel_radius_m is 0.0, a finite number above zero is required
    """
    for name, value in settings._asdict().items():
        if name != "gains" and not 0 < value < math.inf:
            raise ConfigError(f"{name} is {value!r}, a finite number above zero is required")
    return settings._replace(gains=check_gains(settings.gains))


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


def power_state(accel_mps2: float, speed_mps: float, threshold_wpkg: float) -> DriveState:
    """Return the drive state of a wheel by (8.6), ``Power_state = a v`` in W/kg; at the threshold it is steady.

    The product is positive while the wheel speeds up and negative while it slows down, in either direction of
    rolling.

    Examples
    --------
    >>> [power_state(*wheel, 0.1).label for wheel in ((-1.0, -0.5), (1.0, -0.5), (0.1, 1.0))]
    ['traction', 'braking', 'steady']
    """
    power_wpkg = accel_mps2 * speed_mps
    if math.isnan(power_wpkg):
        return DriveState.UNKNOWN
    if power_wpkg > threshold_wpkg:
        return DriveState.TRACTION
    return DriveState.BRAKING if power_wpkg < -threshold_wpkg else DriveState.STEADY


def desired_slip(drive_state: DriveState, direction: float, target_ratio: Sequence[float]) -> float:
    """Return (8.7)-(8.9): the target of the state (traction, braking, steady) times the direction, or NaN."""
    return math.nan if drive_state is DriveState.UNKNOWN else direction * target_ratio[drive_state]


def wheel_step(
    settings: ThesisSettings,
    state: WheelPid,
    command_radps: float,
    wheel_radps: float,
    speed_mps: float,
    accel_mps2: float,
    chassis_speed_mps: float,
    target_ratio: Sequence[float],
    dt_s: float,
) -> tuple[WheelStep, WheelPid]:
    """Return the correction of one wheel's command, and its next state; arguments as :func:`thesis_step`."""
    radius, low = settings.wheel_radius_m, settings.low_speed_mps
    integral, direction = state.pid.integral, state.direction
    reference = command_radps * radius
    if abs(reference) > low and reference * direction <= 0.0:
        direction, integral = math.copysign(1.0, reference), 0.0
    slip, fastest = conditioned_slip(wheel_radps * radius, speed_mps, low)
    drive_state = power_state(accel_mps2, speed_mps, settings.power_threshold_wpkg)
    desired = desired_slip(drive_state, direction, target_ratio)
    error, slow = desired - slip, abs(speed_mps) < low
    status = None
    if not 0.0 < dt_s <= LONGEST_STEP_S:
        status = ThesisStatus.BAD_TIME
    elif not math.isfinite(error) or math.isnan(chassis_speed_mps):
        status = ThesisStatus.NO_ERROR
    elif chassis_speed_mps <= settings.chassis_speed_mps:
        status = ThesisStatus.STANDING
    elif not slow and speed_mps * direction <= 0.0:
        status = ThesisStatus.REVERSING
    if status is not None:
        return WheelStep(0.0, desired, drive_state, status), WheelPid(PidState(integral), direction)
    error = 0.0 if slow else error * (fastest / radius)
    added, pid, found = pid_step(settings.gains, PidState(integral, state.pid.error), error, dt_s)
    status = ThesisStatus.LOW_SPEED if slow else ThesisStatus(found)
    return WheelStep(added, desired, drive_state, status), WheelPid(pid, direction)


def thesis_step(
    settings: ThesisSettings,
    states: Sequence[WheelPid],
    command_radps: Array,
    wheel_radps: Array,
    speed_mps: Array,
    accel_mps2: Array,
    chassis_speed_mps: float,
    target_ratio: Sequence[float],
    dt_s: float,
) -> tuple[list[WheelStep], list[WheelPid]]:
    """Return the correction of each wheel's command and why, and the next states.

    Parameters
    ----------
    settings : accepted ones
    states : ``WheelPid()`` of each wheel at first, then what the step before returned
    command_radps, wheel_radps : (wheels,) commanded by the kinematics, and measured
    speed_mps, accel_mps2 : (wheels,) of the wheel's centre over ground, along the wheel
    chassis_speed_mps : magnitude of the robot's velocity
    target_ratio : slip in traction, braking, steady motion, as ``slip_table`` signs it
    dt_s : since the step before

    Examples
    --------
    Forward in traction with too much slip: case 1A of table 8.1, with a radius of 1 m.

    >>> import numpy as np
    >>> settings = ThesisSettings(1.0, Gains(1.0, 0.0, 0.0, limit=1.0))
    >>> rate, speed, targets = np.array([0.7]), np.array([0.6]), (0.1, -0.15, 0.05)
    >>> (wheel,), _ = thesis_step(settings, [WheelPid()], rate, rate, speed, np.ones(1), 0.6, targets, 0.02)
    >>> round(wheel.correction_radps, 3), wheel.desired_ratio
    (-0.03, 0.1)
    """
    rows = zip(*(row.tolist() for row in (command_radps, wheel_radps, speed_mps, accel_mps2)), strict=True)
    steps = [
        wheel_step(settings, state, command, rate, speed, accel, chassis_speed_mps, target_ratio, dt_s)
        for state, (command, rate, speed, accel) in zip(states, rows, strict=True)
    ]
    return [step for step, _ in steps], [state for _, state in steps]
