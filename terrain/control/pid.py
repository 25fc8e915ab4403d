"""PID control: one pure step, and the controller of Danzi, AgriMaRo thesis, chapter 8, on the slip of each wheel.

(8.2) in steps of dt::

    I' = I + K_I e dt                         d = (x' - x) / dt,  x' = x + (1 - exp(-dt / tau)) (e - x)
    u = clip(K_P e + I' + K_D d, -limit, limit)

The thesis specifies neither anti-windup nor a clamp nor a filter on the derivative.  Here integration is
conditional: the integral is kept while the sum is beyond the limit and the error would drive it further.  The
derivative is that of the low-pass filtered error (time constant tau); it is zero at the first error and at
the first after a gap.

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
    what: str,
    settings: Settings,
    above_zero: Collection[str] = (),
    unbounded: Collection[str] = (),
    most: Mapping[str, float] | None = None,
) -> Settings:
    """Return settings, a named tuple of numbers, as floats.

    Parameters
    ----------
    what : begins a message
    settings : numbers from zero up
    above_zero, unbounded : names of those that must not be 0, and of those that may be infinite
    most : by name, the largest value of some

    Raises
    ------
    ConfigError
        if one is no number, or out of its range.

    Examples
    --------
    >>> checked("gain ", Gains(1, -1, 0, limit=2))
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
        if not (within and number <= largest and (name in unbounded or math.isfinite(number))):
            raise ConfigError(f"{what}{name} is {value!r}, a number {accepted} is required")
    made: Settings = named._make(map(float, settings))
    return made


#: A longer step between two calls is no step of a control loop: the previous error tells nothing of the present.
LONGEST_STEP_S = 0.5


class PidStatus(StatusCode):
    """Result of a step: computed, computed and clamped to the limit, or no valid time step or error."""

    OK = 0
    CLAMPED = 1
    BAD_TIME = 2
    NO_ERROR = 3


class Gains(NamedTuple):
    """Gains and limits of a controller; output and limits have the same unit."""

    kp: float  #: output per error
    ki: float  #: per error and second
    kd: float  #: per rate of error
    limit: float  #: largest magnitude of the output
    integral_limit: float = math.inf  #: of the integral; infinite where ``limit`` is sufficient
    #: of the error's low-pass before it is differentiated; 0 for none
    derivative_time_constant_s: float = 0.0


class PidState(NamedTuple):
    """State of a controller: its integral, in units of the output, and the filtered error or NaN."""

    integral: float = 0.0
    error: float = math.nan


def pid_step(gains: Gains, state: PidState, error: float, dt_s: float) -> tuple[float, PidState, PidStatus]:
    """Return output, next state and status of one step.

    Without an error (NaN or infinite), or with a time step that is not above 0 and up to
    :data:`LONGEST_STEP_S`, the output is 0, the integral is kept, and the memory of the error is dropped.

    Examples
    --------
    >>> gains = Gains(kp=1.0, ki=0.5, kd=0.0, limit=1.0)
    >>> pid_step(gains, PidState(), 0.4, 0.1)[:2]
    (0.42000000000000004, PidState(integral=0.020000000000000004, error=0.4))
    >>> output, state, status = pid_step(gains, PidState(), 2.0, 0.1)
    >>> output, state.integral, status.label
    (1.0, 0.0, 'clamped')
    """
    if not 0.0 < dt_s <= LONGEST_STEP_S:
        return 0.0, PidState(state.integral, math.nan), PidStatus.BAD_TIME
    if not math.isfinite(error):
        return 0.0, PidState(state.integral, math.nan), PidStatus.NO_ERROR
    smooth, rate = error, 0.0
    if not math.isnan(state.error):
        tau_s = gains.derivative_time_constant_s
        change = (error - state.error) * (-math.expm1(-dt_s / tau_s) if tau_s > 0.0 else 1.0)
        smooth, rate = state.error + change, change / dt_s
    without = gains.kp * error + gains.kd * rate
    integral = state.integral + gains.ki * error * dt_s
    integral = min(max(integral, -gains.integral_limit), gains.integral_limit)
    if abs(without + integral) > gains.limit and (without + integral) * error > 0.0:
        integral = state.integral
    desired = without + integral
    output = min(max(desired, -gains.limit), gains.limit)
    status = PidStatus.OK if output == desired else PidStatus.CLAMPED
    return output, PidState(integral, smooth), status


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


class WheelPid(NamedTuple):
    """State of a wheel: its PID, and the direction of its command; 0 before there was one."""

    pid: PidState = PidState()
    direction: float = 0.0


class WheelStep(NamedTuple):
    """What a step gives a wheel."""

    correction_radps: float  #: to add to its command; 0 by every status but ok, clamped and low speed
    desired_ratio: float  #: signed along the wheel; NaN where the drive state or the target is unknown
    drive_state: DriveState
    status: ThesisStatus


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
    >>> wheel, _ = wheel_step(Gains(1.0, 0.0, 0.0, limit=1.0), 1.0, *given)
    >>> round(wheel.correction_radps, 3), wheel.desired_ratio
    (-0.03, 0.1)
    """
    integral, direction = state.pid.integral, state.direction
    reference = command_radps * radius_m
    if abs(reference) > LOW_SPEED_MPS and reference * direction <= 0.0:
        direction, integral = math.copysign(1.0, reference), 0.0
    slip, fastest = conditioned_slip(wheel_radps * radius_m, speed_mps, LOW_SPEED_MPS)
    drive_state = power_state(accel_mps2, speed_mps, POWER_THRESHOLD_WPKG)
    desired = desired_slip(drive_state, direction, target_ratio)
    error, slow = desired - slip, abs(speed_mps) < LOW_SPEED_MPS
    status = None
    if not 0.0 < dt_s <= LONGEST_STEP_S:
        status = ThesisStatus.BAD_TIME
    elif not math.isfinite(error) or math.isnan(chassis_speed_mps):
        status = ThesisStatus.NO_ERROR
    elif chassis_speed_mps <= LOW_SPEED_MPS:
        status = ThesisStatus.STANDING
    elif not slow and speed_mps * direction <= 0.0:
        status = ThesisStatus.REVERSING
    if status is not None:
        return WheelStep(0.0, desired, drive_state, status), WheelPid(PidState(integral), direction)
    error = 0.0 if slow else error * (fastest / radius_m)
    added, pid, computed = pid_step(gains, PidState(integral, state.pid.error), error, dt_s)
    status = ThesisStatus.LOW_SPEED if slow else ThesisStatus(computed)
    return WheelStep(added, desired, drive_state, status), WheelPid(pid, direction)
