"""Motors of wheels and steering: from desired twists to speeds and angles of the wheels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.kinematics.swerve import wheel_commands
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.sensors.truth import wheel_channels

COMMANDS_HZ = 50.0
"""Rate of the twists, as scenarios have them."""

DRIVE_S = 0.06
"""Each of the two lags in a row by which a wheel follows its command; assumed."""

DRIVE_MPS2 = 4.0
"""The most that a wheel speeds up; assumed, 2 g of grip would be needed for more."""

STEER_S = 0.08
"""Lag by which steering follows its command; assumed."""


class WheelCommands(NamedTuple):
    """Commands of a run.

    Parameters
    ----------
    values, channels : (n, c) of the stream
    speed_mps, steer_rad : (n, wheels) desired circumferential speeds and steering angles of the wheels
    """

    values: Array
    channels: tuple[str, ...]
    speed_mps: Array
    steer_rad: Array


def wheel_commands_of(robot: Robot, twist: Array) -> WheelCommands:
    """Return the commands that follow from desired twists (n, 3) with the described geometry."""
    names = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", *wheel_channels("wheel_radps", robot.wheels))
    radius_m = robot.wheel_radius_m
    assert robot.motors is not None
    if robot.drive == "swerve":
        assert robot.steering is not None
        admitted, wheel_radps, steer_rad = wheel_commands(
            robot.wheel_positions_m,
            radius_m,
            robot.motors.speed_max_radps,
            robot.steering.rate_max_radps,
            1.0 / COMMANDS_HZ,
            twist,
            np.zeros(3),
        )
        values = np.hstack([admitted, wheel_radps, steer_rad])
        channels = (*names, *wheel_channels("steer_rad", robot.wheels))
        return WheelCommands(values, channels, wheel_radps * radius_m, steer_rad)
    turn = 0.5 * robot.track_m * twist[:, 2]
    limit = radius_m * robot.motors.speed_max_radps
    speeds = np.clip(np.column_stack([twist[:, 0] - turn, twist[:, 0] + turn]), -limit, limit)
    return WheelCommands(np.hstack([twist, speeds / radius_m]), names, speeds, np.zeros((len(twist), 2)))


@njit(cache=True)
def follow_commands(
    desired_mps: Array, desired_rad: Array, parts: int, dt: float, rate_max: float
) -> tuple[Array, Array]:
    """Return wheel speeds and steering (m, wheels) that follow desired (n, wheels), ``parts`` steps a row."""
    n, wheels = desired_mps.shape
    m = (n - 1) * parts + 1
    wheel_speed, steer = np.empty((m, wheels)), np.empty((m, wheels))
    quick, turn = 1.0 - math.exp(-dt / DRIVE_S), 1.0 - math.exp(-dt / STEER_S)
    fastest, furthest = DRIVE_MPS2 * dt, rate_max * dt
    for i in range(wheels):
        first, second, angle = 0.0, 0.0, desired_rad[0, i]
        for k in range(m):
            row = k // parts
            part = (k - row * parts) / parts
            after = min(row + 1, n - 1)
            goal = desired_mps[row, i] + part * (desired_mps[after, i] - desired_mps[row, i])
            first += min(max(quick * (goal - first), -fastest), fastest)
            second += quick * (first - second)
            wheel_speed[k, i] = second
            aim = desired_rad[row, i] + part * (desired_rad[after, i] - desired_rad[row, i])
            angle += min(max(turn * (aim - angle), -furthest), furthest)
            steer[k, i] = angle
    return wheel_speed, steer
