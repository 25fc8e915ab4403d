"""Steering of a car-like robot along a path, by estimated sideslip: adaptive law and predicted curvature.

With the deviations y and theta~ from a path of curvature c, slip angles b of the axles, and a desired lateral
offset y_d::

    g = theta~ + b_R      a = 1 - c y      A = -K_p (y - y_d) - K_d a tan g + c a tan^2 g
    d = atan(tan b_R + L / cos b_R (c cos g / a + A cos^3 g / a^2)) - b_F                     (17)
    d = d_traj + d_dev,   d_traj = atan(L c cos g / a)                                        (18)

The part d_dev comes from what is measured, and is passed on.  The part d_traj follows the path, whose future
is known: it is commanded ahead, so that what the actuator makes of it (dead time T_d, then a lag tau) is
where d_traj will be after the horizon H::

    d_command = (d_traj(s + v (T_d + H)) - exp(-H / tau) m) / (1 - exp(-H / tau))

with m the actuator's model driven by the commands of this part.  In steady cornering d_command = d_traj.

Deremetz et al., ICRA 2017, (17), (18); Cariou et al. 2009.  K_p and K_d are per metre: (17) makes y converge
over distance, y'' + K_d y' + K_p y = 0, alike at every speed up to the one from which the actuator's delays
would matter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.control.paths import CURVATURE, GRID_M
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots.bicycle import BicycleRobot
from terrain.status import StatusCode


class SteerStatus(StatusCode):
    """What a steering angle is worth."""

    OK = 0
    CLAMPED = 1
    """At the limit of the steering."""
    SINGULAR = 2
    """1 - c y close to 0 or below, or across the path: bounded."""
    HELD = 3
    """Deviations are not known: the curvature of the path is steered, nothing is corrected."""
    BAD_INPUT = 4
    """Speed or time are not numbers that can be: the steering is as it was."""


class SteeringSettings(NamedTuple):
    """Gains and what is known of the actuator.

    Parameters
    ----------
    position_pm2, angle_pm : K_p and K_d; the default is critically damped
    fastest_ps : bandwidth above which both fall with the speed, as delays are in seconds
    offset_m : desired distance to the left of the path
    delay_s : dead time of the steering
    slip_lag_s : time constant of a low-pass of the slip angles.  The front one has -d in it, at once: fed
        back without a lag it closes a fast loop of gain 1 around actuator and tyres
    horizon_time_constants : H over the actuator's time constant, 3 for its response time (95 %); 0 passes the
        curvature on as it is
    """

    position_pm2: float = 0.16
    angle_pm: float = 0.8
    fastest_ps: float = 1.5
    offset_m: float = 0.0
    delay_s: float = 0.05
    horizon_time_constants: float = 3.0
    slip_lag_s: float = 0.05


BASE, STEER_MAX, K_P, K_D, OFFSET, DELAY, TAU, HORIZON, SLIP_LAG, FASTEST = range(10)
_LEAST_BESIDE, _ACROSS_RAD = 0.2, 1.3
_LONGEST_STEP_S = 0.5
MODEL, LAST, FRONT, REAR = range(4)
STATE_SIZE = 4
"""Of the memory: the actuator's model, the last command, and slip angles behind their low-pass."""


def steering_params(robot: BicycleRobot, settings: SteeringSettings) -> Array:
    """Return the parameters (10,) of :func:`steer`.

    Raises
    ------
    ConfigError
        if a gain is not above zero, or a time below it.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> steering_params(load_robot("adap2e"), SteeringSettings(delay_s=0.0))[DELAY]
    np.float64(0.0)
    """
    if not (
        min(settings.position_pm2, settings.angle_pm, settings.fastest_ps) > 0
        and math.isfinite(settings.offset_m)
    ):
        raise ConfigError("gains of the steering above zero and a finite offset are required")
    if not (
        0 <= settings.delay_s < 2.0
        and 0 <= settings.slip_lag_s < 10.0
        and 0 <= settings.horizon_time_constants < 20.0
    ):
        raise ConfigError("a delay of 0 to 2 s and a horizon of 0 to 20 time constants are accepted")
    tau_s = robot.steering_time_constant_s
    return np.array(
        [
            *(robot.wheelbase_m, robot.steering_max_rad, settings.position_pm2, settings.angle_pm),
            *(settings.offset_m, settings.delay_s, tau_s, settings.horizon_time_constants * tau_s),
            *(settings.slip_lag_s, settings.fastest_ps),
        ]
    )


@njit(cache=True)
def law_17(params: Array, lateral: float, angle: float, curvature: float, front: float, rear: float) -> float:
    """Return the steering angle of (17), not limited; compiled.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> params = steering_params(load_robot("adap2e"), SteeringSettings())
    >>> round(law_17(params, 0.0, 0.0, 0.1, 0.0, 0.0), 4)  # atan(L c)
    0.1194
    """
    gamma = min(max(angle + rear, -_ACROSS_RAD), _ACROSS_RAD)
    beside = max(1.0 - curvature * lateral, _LEAST_BESIDE)
    tangent, cos = math.tan(gamma), math.cos(gamma)
    pull = -params[K_P] * (lateral - params[OFFSET]) - params[K_D] * beside * tangent
    pull += curvature * beside * tangent * tangent
    bend = curvature * cos / beside + pull * cos**3 / beside**2
    return math.atan(math.tan(rear) + params[BASE] / math.cos(rear) * bend) - front


@njit(cache=True)
def _curvature_at(rows: Array, distance_m: float) -> float:
    at = min(max(distance_m / GRID_M, 0.0), rows.shape[0] - 1.001)
    i = int(at)
    return float(rows[i, CURVATURE] + (at - i) * (rows[i + 1, CURVATURE] - rows[i, CURVATURE]))


@njit(cache=True)
def steer(
    params: Array, memory: Array, rows: Array, place: Array, slips: Array, speed_mps: float, dt_s: float
) -> tuple[float, Array, int]:
    """Return the steering to command, the next memory and the status; compiled, the memory is not changed.

    Parameters
    ----------
    params : of :func:`steering_params`
    memory : (STATE_SIZE,) zeros at first
    rows : of a path
    place : (4,) distance, lateral, angle and curvature of a :class:`~terrain.control.paths.Place`
    slips : (2,) of front and rear; NaN is taken as no slip
    speed_mps : of the robot
    dt_s : since the step before
    """
    after = memory.copy()
    if not (0.0 <= dt_s <= _LONGEST_STEP_S and abs(speed_mps) < 100.0 and abs(place[0]) < 1e9):
        return memory[LAST], after, SteerStatus.BAD_INPUT.value
    for i in range(2):
        known = slips[i] if abs(slips[i]) < 1.0 else 0.0
        after[FRONT + i] += (1.0 - math.exp(-dt_s / max(params[SLIP_LAG], 1e-9))) * (
            known - memory[FRONT + i]
        )
    front, rear = after[FRONT], after[REAR]
    status, lateral, angle = SteerStatus.OK.value, place[1], place[2]
    curvature = place[3] if abs(place[3]) < 1e3 else 0.0
    if not (abs(lateral) < 1e6 and abs(angle) < 1e6):
        status, lateral, angle = SteerStatus.HELD.value, params[OFFSET], -rear
    elif 1.0 - curvature * lateral < _LEAST_BESIDE or abs(angle + rear) > _ACROSS_RAD:
        status = SteerStatus.SINGULAR.value
    gamma = min(max(angle + rear, -_ACROSS_RAD), _ACROSS_RAD)
    beside = max(1.0 - curvature * lateral, _LEAST_BESIDE)
    along = params[BASE] * math.cos(gamma) / beside
    followed = math.atan(along * curvature)
    slower = min(1.0, params[FASTEST] / max(abs(speed_mps) * math.sqrt(params[K_P]), 1e-9))
    gains = params.copy()
    gains[K_P] *= slower * slower
    gains[K_D] *= slower
    deviation = law_17(gains, lateral, angle, curvature, front, rear) - followed
    ahead = followed
    if params[HORIZON] > 0.0 and params[TAU] > 0.0:
        reach = abs(speed_mps) * (params[DELAY] + params[HORIZON])
        target = math.atan(along * _curvature_at(rows, place[0] + reach))
        keep = math.exp(-params[HORIZON] / params[TAU])
        ahead = (target - keep * memory[MODEL]) / (1.0 - keep)
    ahead = min(max(ahead, -params[STEER_MAX]), params[STEER_MAX])
    lag = -math.expm1(-dt_s / params[TAU]) if params[TAU] > 0.0 else 1.0
    after[MODEL] += lag * (ahead - after[MODEL])
    command = ahead + deviation
    if abs(command) > params[STEER_MAX]:
        command = math.copysign(params[STEER_MAX], command)
        status = max(status, SteerStatus.CLAMPED.value)
    after[LAST] = command
    return command, after, status
