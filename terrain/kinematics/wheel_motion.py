"""From desired twists to commands for the wheels, by the kind of drive."""

from __future__ import annotations

from functools import singledispatch
from typing import NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.kinematics import omni
from terrain.kinematics.swerve import wheel_commands
from terrain.records import Array
from terrain.robots import BicycleRobot, OmniRobot, Robot, SkidSteerRobot, SwerveRobot


class WheelMotion(NamedTuple):
    """Commands for the wheels of a robot.

    Parameters
    ----------
    twist : (n, 3) of the body, shortened where a wheel would saturate
    wheel_speed_mps : (n, wheels) wheel circumferential speeds
    wheel_radps : (n, wheels) the same as rates of the wheels
    steer_rad : (n, wheels) steering angles; 0 without steering
    """

    twist: Array
    wheel_speed_mps: Array
    wheel_radps: Array
    steer_rad: Array


@singledispatch
def wheel_motion(robot: Robot, twist: Array, dt_s: float) -> WheelMotion:
    """Return the commands with which a robot drives desired twists, its steering straight at the start.

    Parameters
    ----------
    robot : a swerve robot with motors and steering; other robots without motors have no fastest speed
    twist : (n, 3) desired ``(speed_x_mps, speed_y_mps, yaw_rate_radps)``
    dt_s : time from one twist to the next

    Raises
    ------
    ConfigError
        if the description of a swerve robot lacks a section.

    Notes
    -----
    A swerve robot: :func:`terrain.kinematics.swerve.wheel_commands`.  A skid-steer robot of track B:
    ``v_left = v - w B / 2``, ``v_right = v + w B / 2``, each within what its motor can do.  An omni robot:
    :func:`terrain.kinematics.omni.inverse`, shortened by what brings the fastest wheel to its limit.  A
    car-like robot of wheelbase L: ``tan d = L w / v`` in front within its limits, straight at rest, and the
    twist that it gives.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> wheel_motion(load_robot("husky"), np.array([[0.5, 0.0, 1.0]]), 0.02).wheel_speed_mps
    array([[0.2146, 0.7854]])
    """
    raise ConfigError(f"robot {robot.name}: no kinematics are known for the drive {robot.drive!r}")


@wheel_motion.register
def _(robot: SwerveRobot, twist: Array, dt_s: float) -> WheelMotion:
    admitted, wheel_radps, steer_rad = wheel_commands(
        robot.wheel_positions_m,
        robot.wheel_radius_m,
        robot.motors.speed_max_radps,
        robot.steering.rate_max_radps,
        dt_s,
        twist,
        np.zeros(len(robot.wheels)),
    )
    return WheelMotion(admitted, wheel_radps * robot.wheel_radius_m, wheel_radps, steer_rad)


@wheel_motion.register
def _(robot: SkidSteerRobot, twist: Array, dt_s: float) -> WheelMotion:
    turn = 0.5 * robot.track_m * twist[:, 2]
    limit = robot.wheel_radius_m * robot.completed.motors.speed_max_radps
    speeds = np.clip(np.column_stack([twist[:, 0] - turn, twist[:, 0] + turn]), -limit, limit)
    return WheelMotion(twist, speeds, speeds / robot.wheel_radius_m, np.zeros_like(speeds))


@wheel_motion.register
def _(robot: OmniRobot, twist: Array, dt_s: float) -> WheelMotion:
    speeds = omni.inverse(robot.wheel_positions_m, robot.wheel_directions_rad, twist)
    limit = robot.wheel_radius_m * robot.completed.motors.speed_max_radps
    over = np.maximum(np.abs(speeds).max(axis=1, keepdims=True) / limit, 1.0)
    return WheelMotion(
        twist / over, speeds / over, speeds / over / robot.wheel_radius_m, np.zeros_like(speeds)
    )


@wheel_motion.register
def _(robot: BicycleRobot, twist: Array, dt_s: float) -> WheelMotion:
    speed = np.clip(twist[:, 0], -robot.speed_max_mps, robot.speed_max_mps)
    curvature = np.divide(twist[:, 2], twist[:, 0], out=np.zeros(len(twist)), where=twist[:, 0] != 0.0)
    steer = np.arctan(robot.wheelbase_m * curvature)
    steer = np.clip(steer, -robot.steering_max_rad, robot.steering_max_rad)
    steers, still = np.column_stack([steer, np.zeros_like(steer)]), np.zeros_like(speed)
    speeds = np.column_stack([speed / np.cos(steer), speed])
    driven = np.column_stack([speed, still, speed * np.tan(steer) / robot.wheelbase_m])
    return WheelMotion(driven, speeds, speeds / robot.wheel_radius_m, steers)
