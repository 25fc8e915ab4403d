"""Yaw rows counted from the start, the camera's on the same turn as the IMU's.

A yaw row is ``initial_yaw_rad`` on average while the robot is at rest at the start, or at its first sample.
A camera that starts late takes the IMU's yaw of that instant instead, and after a loss the turn nearest to
it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.estimation.measurements.samples import CAMERA_YAW, IMU_YAW, RADIUS, YAW_0
from terrain.estimation.measurements.table import LATE_S, STANDING_S, STANDING_SPEED_MPS
from terrain.records import Array

N_YAW = 10
"""Length of the memory: whether the robot has moved, the first stamp; sum, number and mean of the IMU's yaw
at rest, and of the camera's; whether the camera has started, and its offset."""

_MOVED, _CLOCK_0, _IMU_SUM, _IMU_N, _IMU_MEAN, _SEEN_SUM, _SEEN_N, _SEEN_MEAN, _STARTED, _OFFSET = range(
    N_YAW
)


def yaw_memory() -> Array:
    """Return the memory (10,) before the first tick."""
    memory = np.zeros(N_YAW)
    memory[_CLOCK_0] = np.nan
    return memory


@njit(cache=True, error_model="numpy")
def average_yaw(time_s: float, z: Array, params: Array, yaw: Array) -> None:
    """Take a tick into the averages of the yaw rows at the start."""
    if math.isnan(yaw[_CLOCK_0]):
        yaw[_CLOCK_0] = time_s
    if time_s > yaw[_CLOCK_0] + STANDING_S:
        yaw[_MOVED] = 1.0
    for i in range(3):
        if abs(z[i] * params[RADIUS]) > STANDING_SPEED_MPS:
            yaw[_MOVED] = 1.0
    for row, at in ((IMU_YAW, _IMU_SUM), (CAMERA_YAW, _SEEN_SUM)):
        if not math.isnan(z[row]) and (yaw[_MOVED] == 0.0 or yaw[at + 1] == 0.0):
            yaw[at] += z[row]
            yaw[at + 1] += 1.0
            yaw[at + 2] = yaw[at] / yaw[at + 1]


@njit(cache=True, error_model="numpy")
def refer_yaw(time_s: float, z: Array, params: Array, yaw: Array) -> None:
    """Count the yaw rows of a tick from the averages."""
    initial = params[YAW_0]
    for row, mean in ((IMU_YAW, yaw[_IMU_MEAN]), (CAMERA_YAW, yaw[_SEEN_MEAN])):
        z[row] = z[row] - mean + initial
    imu, seen = z[IMU_YAW], z[CAMERA_YAW]
    if math.isnan(seen):
        return
    if yaw[_STARTED] == 0.0:
        yaw[_STARTED] = 1.0
        if not math.isnan(imu) and time_s > yaw[_CLOCK_0] + LATE_S:
            yaw[_OFFSET] = imu - initial
    seen += yaw[_OFFSET]
    if not math.isnan(imu):
        seen += 2 * np.pi * np.rint((imu - seen) / (2 * np.pi))
    z[CAMERA_YAW] = seen
