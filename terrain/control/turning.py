"""Yaw rate of robots that turn by the speeds of their wheels, or by the steering of a car, kept while wheels slip.

Sides with the speeds u_L and u_R and the distance B between them turn a robot that skids by less than
``(u_R - u_L) / B``, as the ground resists.  In a steady turn it is less by the factor 1 / x, as if the sides were the
*effective track* ``x B`` apart (Mandow et al., IROS 2007).  With the desired yaw rate w*, of which the traction
controller drives the part p, behind the lag of the robot, and the measured one w::

    e = w_r - w,   w_r' = (p w* - w_r) / T
    w_c = x (w* + k_P e + k_I integral e dt)            (yaw rate that the kinematics is given)

- x is that of the robot's description at first, 1 where it has none; then it follows the yaw rate of the wheels over
  that of the robot while it turns, by the angle that the wheels would turn it, and the integral is changed so that the
  wheels' speeds do not jump.  Where the wheels' speeds are compared with the ground, the
  robot's yaw rate counts x times: the slip that turning takes is no slip of traction.
- The integral removes what is left: a side on softer ground, unequal radii.  The correction is bounded by a part of the
  wheels' speed, and by the speed at which a wheel would reverse.  Where it is bounded, or a wheel is at its motor's
  limit, the integral does not grow; at rest it is 0.
- A turn can take more than the ground or the motors give: the robot slips by more than a bound, and more speed of its
  wheels gives hardly more thrust, or a wheel stays behind its command.  It would cost the robot its speed: x and the
  integral fall then, towards the turn that the wheels' speeds give by themselves.
- Where another controller drives, as a log is replayed, the error is none of these commands': nothing is integrated.
- Without a yaw rate nothing is corrected, and x stays.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.control.pid import LONGEST_STEP_S
from terrain.kinematics.wheels import rolling_matrix
from terrain.records import Array
from terrain.robots import BicycleRobot, Robot


class TurnSettings(NamedTuple):
    """Gains and limits.

    The yaw rate follows its command within about 0.15 s, and the command comes after as much: with these gains the loop
    has a gain margin of 5.
    """

    k_p: float = 0.3
    k_i_ps: float = 2.0
    lag_s: float = 0.2  #: T
    limit_ratio: float = 0.3  #: change of a wheel's speed by the correction, over the speed of the fastest
    #: a robot that turns slower shows no effective track; the angle over which it is averaged; its bounds
    turning_radps: float = 0.05
    angle_rad: float = 0.5
    least_ratio: float = 0.8
    most_ratio: float = 3.0
    most_slip_ratio: float = 0.5  #: of the robot; with more the ground gives hardly more thrust
    follow_s: float = 0.3  #: within which wheels follow their commands
    relief_s: float = 0.3  #: within which a turn that takes too much is given up


SETTINGS = TurnSettings()
_BEHIND_RATIO, _BEHIND_MPS = (
    0.15,
    0.05,
)  # by which a wheel is behind its command whose motor gives all its torque
_AHEAD = 0.2  # mean speed of the wheels over that of the fastest, below which a robot turns on the spot


class TurnState(NamedTuple):
    """What a step leaves to the next."""

    track_ratio: float = 1.0  #: x
    integral_radps: float = 0.0
    reference_radps: float = 0.0  #: w_r
    commanded_mps: Array | None = (
        None  #: (wheels,) speeds that were commanded, behind a low-pass; None at first
    )


class Turning(NamedTuple):
    """How the wheels of a robot turn it: ``J`` of :func:`~terrain.kinematics.wheels.rolling_matrix`."""

    rolling: Array  #: (wheels, 3)
    skids: bool  #: whether its effective track is another than its track
    limit_mps: float  #: fastest speed of a wheel
    #: by which a change of the yaw rate changes the fastest wheel's speed; of a car its wheelbase
    arm_m: float


def turning_of(robot: Robot) -> Turning:
    """Return how a robot turns by its wheels' speeds, or by the steering of a car, whose wheels' speeds do not matter.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> turning_of(load_robot("husky")).rolling.round(3).tolist()
    [[1.0, 0.0, -0.285], [1.0, 0.0, 0.285]]
    """
    limit_mps = robot.wheel_radius_m * robot.completed.motors.speed_max_radps
    if isinstance(robot, BicycleRobot):
        ahead = np.tile([1.0, 0.0, 0.0], (len(robot.wheels), 1))
        return Turning(ahead, skids=False, limit_mps=limit_mps, arm_m=robot.wheelbase_m)
    place = robot.wheel_positions_m, robot.wheel_directions_rad, robot.roller_angles_rad
    rolling = rolling_matrix(*place)
    return Turning(rolling, robot.skids, limit_mps, float(np.abs(rolling[:, 2]).max()))


def first_state(robot: Robot) -> TurnState:
    """Return the state of a robot at rest, with the effective track that its description knows."""
    return TurnState(robot.identified.get("effective_track_m", robot.track_m) / robot.track_m)


def open_loop(state: TurnState) -> TurnState:
    """Return a state whose commands were not driven by: none of the error was left by them, and no wheel is behind."""
    return state._replace(integral_radps=0.0, commanded_mps=None)


def turn_step(
    settings: TurnSettings,
    turning: Turning,
    state: TurnState,
    twist: Array,
    driven_part: float,
    yaw_rate_radps: float,
    wheel_speed_mps: Array,
    speed_mps: float,
    dt_s: float,
) -> tuple[Array, TurnState]:
    """Return the twist (3,) for the kinematics, within what the motors can do, and the next state.

    Parameters
    ----------
    settings, state : as :data:`SETTINGS`; :func:`first_state` at first, then what the step before returned
    turning : of the robot
    twist : (3,) desired
    driven_part : of the desired speed that was commanded in the step before, 0 to 1
    yaw_rate_radps, wheel_speed_mps, speed_mps : estimated, (wheels,) measured, and ahead over ground; NaN where unknown
    dt_s : since the step before

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> turning, ahead = turning_of(load_robot("husky")), np.array([0.5, 0.0, 0.4])
    >>> slow = ahead, 1.0, 0.3, np.array([0.4, 0.6]), 0.5, 0.02
    >>> turn_step(SETTINGS, turning, TurnState(reference_radps=0.4), *slow)[0].round(3)
    array([0.5  , 0.   , 0.434])
    """
    ratio, integral, reference, commanded = state
    commanded = np.zeros(len(wheel_speed_mps)) if commanded is None else commanded
    desired = float(twist[2])
    if not 0.0 < dt_s <= LONGEST_STEP_S:
        yaw_rate_radps, dt_s = math.nan, 0.0
    reference += (driven_part * desired - reference) * -math.expm1(-dt_s / settings.lag_s)
    error = reference - yaw_rate_radps
    mean_mps, fastest = float(wheel_speed_mps.mean()), float(np.abs(wheel_speed_mps).max())
    spins = turning.skids and abs(mean_mps) > _AHEAD * fastest
    spins = spins and 1.0 - speed_mps / mean_mps > settings.most_slip_ratio  # False for NaN
    follows = np.sign(commanded) * wheel_speed_mps - (1.0 - _BEHIND_RATIO) * np.abs(commanded)
    strained = spins or bool((follows < -_BEHIND_MPS).any())
    if turning.skids and abs(yaw_rate_radps) > settings.turning_radps:
        left, right = turning.rolling[:, 2].tolist()
        rolled = float(wheel_speed_mps[1] - wheel_speed_mps[0]) / (right - left)
        shown = min(max(rolled / yaw_rate_radps, settings.least_ratio), settings.most_ratio)
        turned = min(abs(rolled) * dt_s / settings.angle_rad, 1.0)
        if math.isfinite(rolled) and not (strained and shown > ratio):
            ratio += (shown - ratio) * turned
            integral = state.track_ratio / ratio * (desired + integral) - desired
    if turning.skids and strained:
        keep = math.exp(-dt_s / settings.relief_s)
        ratio, integral = 1.0 + keep * (ratio - 1.0), keep * integral
    arms = ratio * turning.rolling[:, 2]
    speeds = turning.rolling[:, :2] @ twist[:2] + arms * desired
    fastest = float(np.abs(speeds).max())
    # by how much the yaw rate may change before a wheel would reverse, in either direction
    least = most = settings.limit_ratio * fastest / (ratio * turning.arm_m)
    for speed, arm in zip(speeds.tolist(), arms.tolist(), strict=True):
        if speed * arm > 0.0:
            least = min(least, abs(speed / arm))
        elif speed * arm < 0.0:
            most = min(most, abs(speed / arm))
    added = 0.0
    if math.isfinite(error):
        grown = integral + settings.k_i_ps * error * dt_s
        asked = settings.k_p * error + grown
        added = min(max(asked, -least), most)
        bounded = (
            strained or asked != added or fastest + float(np.abs(arms).max()) * abs(added) > turning.limit_mps
        )
        if not (bounded and asked * error > 0.0):
            integral = grown
    integral = min(max(integral, -least), most)
    given = np.array([twist[0], twist[1], ratio * (desired + added)])
    over = float(np.abs(turning.rolling @ given).max()) / turning.limit_mps
    given = given / max(over, 1.0)
    part = -math.expm1(-dt_s / settings.follow_s)
    commanded = commanded + part * (driven_part * (turning.rolling @ given) - commanded)
    return given, TurnState(ratio, integral, reference, commanded)
