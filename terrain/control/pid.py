"""PID controller as one pure step: from gains, state and error to output, next state and a status.

(8.2) of Danzi, AgriMaRo thesis, in steps of dt::

    I' = I + K_I e dt                         d = (x' - x) / dt,  x' = x + (1 - exp(-dt / tau)) (e - x)
    u = clip(K_P e + I' + K_D d, -limit, limit)

The thesis specifies neither anti-windup nor a clamp nor a filter on the derivative.  Here integration is
conditional: the integral is kept while the sum is beyond the limit and the error would drive it further.  The
derivative is that of the low-pass filtered error (time constant tau); it is zero at the first error and at
the first after a gap.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from terrain.errors import ConfigError
from terrain.status import StatusCode

LONGEST_STEP_S = 0.5
"""After a longer step the previous error carries no information on the present one."""


class PidStatus(StatusCode):
    """Result of a step: computed, computed and clamped to the limit, or no valid time step or error."""

    OK = 0
    CLAMPED = 1
    BAD_TIME = 2
    NO_ERROR = 3


class Gains(NamedTuple):
    """Gains and limits of a controller; output and limits have the same unit.

    Parameters
    ----------
    kp, ki, kd : output per error, per error and second, per rate of error
    limit : largest magnitude of the output
    integral_limit : largest magnitude of the integral; infinite where ``limit`` is sufficient
    derivative_time_constant_s : of the low-pass on the error before it is differentiated; 0 for none
    """

    kp: float
    ki: float
    kd: float
    limit: float
    integral_limit: float = math.inf
    derivative_time_constant_s: float = 0.0


class PidState(NamedTuple):
    """State of a controller: its integral, in units of the output, and the filtered error or NaN."""

    integral: float = 0.0
    error: float = math.nan


def check_gains(gains: Gains) -> Gains:
    """Return gains that can be used, as floats.

    Raises
    ------
    ConfigError
        if a gain or the time constant is negative or not finite, or a limit not above zero.

    Examples
    --------
    >>> check_gains(Gains(1, 0, 0, limit=2)).limit
    2.0
    >>> check_gains(Gains(1, -1, 0, limit=2))
    Traceback (most recent call last):
    terrain.errors.ConfigError: gain ki is -1, a finite number from zero up is required
    """
    for name, value in gains._asdict().items():
        given = value if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
        if name == "integral_limit":
            if not given > 0:
                raise ConfigError(f"gain {name} is {value!r}, a number above zero is required")
        elif name == "limit":
            if not 0 < given < math.inf:
                raise ConfigError(f"gain {name} is {value!r}, a finite number above zero is required")
        elif not 0 <= given < math.inf:
            raise ConfigError(f"gain {name} is {value!r}, a finite number from zero up is required")
    return Gains(*(float(value) for value in gains))


def pid_step(gains: Gains, state: PidState, error: float, dt_s: float) -> tuple[float, PidState, PidStatus]:
    """Return output, next state and status of one step.

    Parameters
    ----------
    gains : as :func:`check_gains` gives them
    state : ``PidState()`` at first, then what the step before returned
    error : desired less measured
    dt_s : since the step before

    Returns
    -------
    output : within the limit; 0 where there is no error (NaN or infinite) or the time step is not above 0 and
        up to :data:`LONGEST_STEP_S`
    state : then with its integral as it was, and without a memory of the error
    status : whether it was computed

    Examples
    --------
    >>> gains = check_gains(Gains(kp=1.0, ki=0.5, kd=0.0, limit=1.0))
    >>> pid_step(gains, PidState(), 0.4, 0.1)[:2]
    (0.42000000000000004, PidState(integral=0.020000000000000004, error=0.4))
    >>> output, state, status = pid_step(gains, PidState(), 2.0, 0.1)
    >>> output, state.integral, status.label
    (1.0, 0.0, 'clamped')
    >>> pid_step(gains, PidState(0.2), float("nan"), 0.1)[1]
    PidState(integral=0.2, error=nan)
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
