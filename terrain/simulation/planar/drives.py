"""Motors of wheels and steering: from desired twists to speeds and angles of the wheels."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.kinematics.wheel_motion import WheelMotion
from terrain.records import Array, Stream
from terrain.robots import Robot
from terrain.simulation.sensors import wheel_channels

COMMANDS_HZ = 50.0
"""Rate of the twists, as scenarios have them."""

DRIVE_S = 0.06
"""Each of the two lags in a row by which a wheel follows its command; assumed."""

DRIVE_MPS2 = 4.0
"""The most that a wheel speeds up; assumed, 2 g of grip would be needed for more."""

STEER_S = 0.08
"""Lag by which steering follows its command; assumed."""


def commands_stream(robot: Robot, desired: WheelMotion) -> Stream:
    """Return the stream of commands."""
    channels = (
        *("speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
        *wheel_channels("wheel_radps", robot.wheels),
        *robot.steer_rows,
    )
    columns = [desired.twist, desired.wheel_radps, desired.steer_rad[:, : len(robot.steer_rows)]]
    return Stream(np.arange(len(desired.twist)) / COMMANDS_HZ, np.hstack(columns), channels)


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
