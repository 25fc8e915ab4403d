"""PID control: one pure step, and the controller of Danzi, AgriMaRo thesis, chapter 8, on the slip of each wheel.

(8.2) in steps of dt, with K_D = 0: a derivative of estimated slip is mostly noise::

    I' = I + K_I e dt        u = clip(K_P e + I', -limit, limit)

The thesis specifies neither anti-windup nor a clamp.  Here integration is conditional: the integral is kept while
the sum is beyond the limit and the error would drive it further.

On a wheel with radius r, rate w and ground speed v along it:

- slip (8.4), (8.5): ``s = (w r - v) / max(|w r|, |v|)``, 0 where both are below the low speed (7.2.1);
- drive state (8.6): traction, braking or steady by the power ``a v`` against a threshold;
- desired slip (8.7)-(8.9): the target of that state times the wheel's direction;
- error (8.1): desired less real; 0 where the wheel goes over ground slower than the low speed;
- PID (8.2), whose output is added to the wheel's command (8.3) where the robot's own speed is above a threshold.

Two points differ from the printed form:

- The input of the PID is ``e max(|w r|, |v|) / r`` in rad/s and not the ratio e.  By (8.4) a correction changes
  the slip r / max(|w r|, |v|) times as much, so that the printed form's loop gain depends on radius and speed;
  here K_P = 0.5 leaves 0.5 of an error in braking and, in the cases of table 8.1, 0.50 to 0.56 of it in
  traction, at any speed and radius.  ``examples/papers/danzi.py`` has the printed form, which oscillates.
- The wheel's direction is that of its command and not sgn(v), which changes with noise at rest; it changes when
  the command exceeds the low speed in the other direction.  The integral is reset then, and nothing is corrected
  while the wheel still rolls in the old direction: a braking target with the sign of the new direction would
  delay the reversal.

The integral while its output is not used, which the thesis does not specify either, is kept.

A target that is not the slip at which the thrust balances the resistance (0.126 on grass) cannot be held at a
constant speed.  With an integral either form then slows the robot towards a standstill or drives it as far
beyond its command as the clamp allows: in a minute at K_P = K_I = 0.5, from 0.87 m/s to 0.10 with a target of
0.05, and to 1.75 with 0.2 and a clamp of 5 rad/s.  It is a baseline for other controllers.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from terrain.errors import ConfigError
from terrain.status import StatusCode

Settings = TypeVar("Settings", bound=tuple[Any, ...])


def checked(
    what: str, settings: Settings, above_zero: Collection[str] = (), most: Mapping[str, float] | None = None
) -> Settings:
    """Return settings, a named tuple of numbers, as floats.

    Parameters
    ----------
    what : begins a message
    settings : numbers from zero up
    above_zero : names of those that must not be 0
    most : by name, the largest value of some

    Raises
    ------
    ConfigError
        if one is no number, or out of its range.

    Examples
    --------
    >>> checked("gain ", Gains(1, -1, limit=2))
    Traceback (most recent call last):
    terrain.errors.ConfigError: gain ki is -1, a number from zero up is required
    """
    named: Any = settings
    for name, value in named._asdict().items():
        number = value if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
        largest = (most or {}).get(name, math.inf)
        accepted = "above zero" if name in above_zero else "from zero up"
        if largest < math.inf:
            accepted = f"from 0 to {largest:g}"
        within = number > 0.0 if name in above_zero else number >= 0.0
        if not (within and number <= largest and math.isfinite(number)):
            raise ConfigError(f"{what}{name} is {value!r}, a number {accepted} is required")
    made: Settings = named._make(map(float, settings))
    return made


#: A longer step between two calls is no step of a control loop: the previous error tells nothing of the present.
LONGEST_STEP_S = 0.5


class Gains(NamedTuple):
    """Gains and limits of a controller; output and limits have the same unit."""

    kp: float  #: output per error
    ki: float  #: per error and second
    limit: float  #: largest magnitude of the output
    integral_limit: float = math.inf  #: of the integral; infinite where ``limit`` is sufficient


def pid_step(gains: Gains, integral: float, error: float, dt_s: float) -> tuple[float, float, bool]:
    """Return the output of one step, the next integral in its unit, and whether the output is clamped.

    Without an error (NaN or infinite), or with a time step that is not above 0 and up to
    :data:`LONGEST_STEP_S`, the output is 0 and the integral is kept.

    Examples
    --------
    >>> gains = Gains(kp=1.0, ki=0.5, limit=1.0)
    >>> pid_step(gains, 0.0, 0.4, 0.1), pid_step(gains, 0.0, 2.0, 0.1)
    ((0.42000000000000004, 0.020000000000000004, False), (1.0, 0.0, True))
    """
    if not (0.0 < dt_s <= LONGEST_STEP_S and math.isfinite(error)):
        return 0.0, integral, False
    grown = min(max(integral + gains.ki * error * dt_s, -gains.integral_limit), gains.integral_limit)
    desired = gains.kp * error + grown
    if abs(desired) > gains.limit and desired * error > 0.0:
        grown, desired = integral, gains.kp * error + integral
    output = min(max(desired, -gains.limit), gains.limit)
    return output, grown, output != desired


class DriveState(StatusCode):
    """Drive state of a wheel or of the robot; from 0 on, its place in ``slip_table.DRIVE_STATES``.

    ``UNKNOWN`` is that of a wheel whose speed or acceleration is not known.
    """

    UNKNOWN = -1
    TRACTION = 0
    BRAKING = 1
    STEADY = 2


#: Assumed, as the thesis specifies none: 0.1 m/s^2 at 1 m/s, the threshold of a steady speed elsewhere
#: (``terrain.estimation.wheel_slip.STEADY_CHANGE_MPS``), and more than five times the effect of an accelerometer's
#: bias.
POWER_THRESHOLD_WPKG = 0.1
#: Thesis 8.3.2: of a wheel, below which its error is 0, and of the robot, above which commands are corrected.
LOW_SPEED_MPS = 0.05


class WheelPid(NamedTuple):
    """State of a wheel: the integral of its PID, and the direction of its command; 0 before there was one."""

    integral: float = 0.0
    direction: float = 0.0


class WheelStep(NamedTuple):
    """What a step gives a wheel.

    Its correction is 0 where an input or the time is not valid, the robot stands, or the wheel rolls against its
    command or has had none yet.
    """

    correction_radps: float  #: to add to its command
    desired_ratio: float  #: signed along the wheel; NaN where the drive state or the target is unknown
    drive_state: DriveState


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
    gains: Gains,
    radius_m: float,
    state: WheelPid,
    command_radps: float,
    wheel_radps: float,
    speed_mps: float,
    accel_mps2: float,
    chassis_speed_mps: float,
    target_ratio: Sequence[float],
    dt_s: float,
) -> tuple[WheelStep, WheelPid]:
    """Return the correction of one wheel's command and why, and its next state.

    Parameters
    ----------
    gains, radius_m : kp without unit, limits in rad/s; of the wheel
    state : ``WheelPid()`` at first, then what the step before returned
    command_radps, wheel_radps : commanded by the kinematics, and measured
    speed_mps, accel_mps2 : of the wheel's centre over ground, along the wheel
    chassis_speed_mps : magnitude of the robot's velocity
    target_ratio : slip in traction, braking, steady motion, as ``slip_table`` signs it
    dt_s : since the step before

    Examples
    --------
    Forward in traction with too much slip: case 1A of table 8.1, with a radius of 1 m.

    >>> given = WheelPid(), 0.7, 0.7, 0.6, 1.0, 0.6, (0.1, -0.15, 0.05), 0.02
    >>> wheel, _ = wheel_step(Gains(1.0, 0.0, limit=1.0), 1.0, *given)
    >>> round(wheel.correction_radps, 3), wheel.desired_ratio
    (-0.03, 0.1)
    """
    integral, direction = state
    reference = command_radps * radius_m
    if abs(reference) > LOW_SPEED_MPS and reference * direction <= 0.0:
        direction, integral = math.copysign(1.0, reference), 0.0
    slip, fastest = conditioned_slip(wheel_radps * radius_m, speed_mps, LOW_SPEED_MPS)
    drive_state = power_state(accel_mps2, speed_mps, POWER_THRESHOLD_WPKG)
    desired, added = desired_slip(drive_state, direction, target_ratio), 0.0
    error, slow = desired - slip, abs(speed_mps) < LOW_SPEED_MPS
    rolls_on = slow or speed_mps * direction > 0.0
    if rolls_on and math.isfinite(error) and chassis_speed_mps > LOW_SPEED_MPS:
        error = 0.0 if slow else error * (fastest / radius_m)
        added, integral, _ = pid_step(gains, integral, error, dt_s)
    return WheelStep(added, desired, drive_state), WheelPid(integral, direction)
