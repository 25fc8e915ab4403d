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

from terrain.control.paths import GRID_M, Place, ReferencePath
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import BicycleRobot
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


_LEAST_BESIDE, _ACROSS_RAD = 0.2, 1.3
_LONGEST_STEP_S = 0.5


class SteerState(NamedTuple):
    """The actuator's model m, the last command, and slip angles behind their low-pass."""

    model_rad: float = 0.0
    command_rad: float = 0.0
    front_rad: float = 0.0
    rear_rad: float = 0.0


def check_steering(settings: SteeringSettings) -> SteeringSettings:
    """Return settings that :func:`steer` accepts.

    Raises
    ------
    ConfigError
        if a gain is not above zero, or a time below it.
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
    return settings


def law_17(
    settings: SteeringSettings,
    base_m: float,
    lateral: float,
    angle: float,
    curvature: float,
    front: float,
    rear: float,
) -> float:
    """Return the steering angle of (17), not limited.

    Examples
    --------
    >>> round(law_17(SteeringSettings(), 1.2, 0.0, 0.0, 0.1, 0.0, 0.0), 4)  # atan(L c)
    0.1194
    """
    gamma = min(max(angle + rear, -_ACROSS_RAD), _ACROSS_RAD)
    beside = max(1.0 - curvature * lateral, _LEAST_BESIDE)
    tangent, cos = math.tan(gamma), math.cos(gamma)
    pull = -settings.position_pm2 * (lateral - settings.offset_m) - settings.angle_pm * beside * tangent
    pull += curvature * beside * tangent * tangent
    bend = curvature * cos / beside + pull * (cos * cos * cos) / (beside * beside)
    return math.atan(math.tan(rear) + base_m / math.cos(rear) * bend) - front


def _curvature_at(path: ReferencePath, distance_m: float) -> float:
    at = min(max(distance_m / GRID_M, 0.0), len(path.curvature_pm) - 1.001)
    before, after = path.curvature_pm[int(at) : int(at) + 2].tolist()
    return float(before + (at - int(at)) * (after - before))


def steer(
    robot: BicycleRobot,
    settings: SteeringSettings,
    state: SteerState,
    path: ReferencePath,
    place: Place,
    slips: Array,
    speed_mps: float,
    dt_s: float,
) -> tuple[float, SteerState, SteerStatus]:
    """Return the steering to command, the next state and the status.

    Parameters
    ----------
    robot, settings : that steers; accepted ones
    state : ``SteerState()`` at first, then what the step before returned
    path, place : that is followed, and where the robot is on it
    slips : (2,) of front and rear; NaN is taken as no slip
    speed_mps : of the robot
    dt_s : since the step before
    """
    if not (0.0 <= dt_s <= _LONGEST_STEP_S and abs(speed_mps) < 100.0 and abs(place.distance_m) < 1e9):
        return state.command_rad, state, SteerStatus.BAD_INPUT
    part = 1.0 - math.exp(-dt_s / max(settings.slip_lag_s, 1e-9))
    front, rear = (
        before + part * ((slip if abs(slip) < 1.0 else 0.0) - before)
        for before, slip in zip(state[2:], slips.tolist(), strict=True)
    )
    status, lateral, angle = SteerStatus.OK, place.lateral_m, place.angle_rad
    curvature = place.curvature_pm if abs(place.curvature_pm) < 1e3 else 0.0
    if not (abs(lateral) < 1e6 and abs(angle) < 1e6):
        status, lateral, angle = SteerStatus.HELD, settings.offset_m, -rear
    elif 1.0 - curvature * lateral < _LEAST_BESIDE or abs(angle + rear) > _ACROSS_RAD:
        status = SteerStatus.SINGULAR
    gamma = min(max(angle + rear, -_ACROSS_RAD), _ACROSS_RAD)
    beside = max(1.0 - curvature * lateral, _LEAST_BESIDE)
    along = robot.wheelbase_m * math.cos(gamma) / beside
    followed = math.atan(along * curvature)
    slower = min(1.0, settings.fastest_ps / max(abs(speed_mps) * math.sqrt(settings.position_pm2), 1e-9))
    gains = settings._replace(
        position_pm2=settings.position_pm2 * (slower * slower), angle_pm=settings.angle_pm * slower
    )
    deviation = law_17(gains, robot.wheelbase_m, lateral, angle, curvature, front, rear) - followed
    ahead, tau_s, most = followed, robot.steering_time_constant_s, robot.steering_max_rad
    horizon_s = settings.horizon_time_constants * tau_s
    if horizon_s > 0.0:
        reach = abs(speed_mps) * (settings.delay_s + horizon_s)
        target = math.atan(along * _curvature_at(path, place.distance_m + reach))
        keep = math.exp(-horizon_s / tau_s)
        ahead = (target - keep * state.model_rad) / (1.0 - keep)
    ahead = min(max(ahead, -most), most)
    lag = -math.expm1(-dt_s / tau_s) if tau_s > 0.0 else 1.0
    command = ahead + deviation
    if abs(command) > most:
        command, status = math.copysign(most, command), max(status, SteerStatus.CLAMPED)
    return (
        command,
        SteerState(state.model_rad + lag * (ahead - state.model_rad), command, front, rear),
        status,
    )
