"""Heading of the start in the frame of a GNSS: what turns speeds over ground into those that it tells."""

from __future__ import annotations

import cmath
import math

import numpy as np

from terrain.estimation.measurements.table import GNSS_SPEED_STD_MPS, MeasurementTable
from terrain.kinematics.swerve import forward
from terrain.kinematics.wheel_velocity import point_velocity
from terrain.records import Array
from terrain.robots import Robot

MIN_SPEED_MPS = 0.2
"""Slower, a course is noise."""

MAX_STD_RAD = 0.05
"""A heading that is known no better is not known: at 1 m/s it would be 5 cm/s of sideways speed."""


def gnss_heading(table: MeasurementTable, robot: Robot) -> float:
    """Return the world's heading in rad of what the yaw rows call 0; NaN where the drive does not tell.

    Parameters
    ----------
    table : measurements with yaw rows that are 0 at the start
    robot : a swerve robot

    Notes
    -----
    The rotation that brings the speeds over ground v, by the camera or else by the wheels, onto those of
    the receiver u with the least squared error, both as complex numbers: the angle of
    ``sum u conj(v e^(i yaw))``.  Its standard deviation is ``speed_std / sqrt(sum |v|^2)``.
    """
    yaw = table.columns(["camera_yaw_rad", "imu_yaw_rad"])
    yaw_rad = np.where(np.isfinite(yaw[:, 0]), yaw[:, 0], yaw[:, 1])
    gnss_speed = table.columns(["gnss_speed_x_mps", "gnss_speed_y_mps"]) @ np.array([1.0, 1.0j])
    seen = _speed_over_ground(table, robot) * np.exp(1j * yaw_rad)
    good = np.isfinite(gnss_speed) & np.isfinite(seen) & (np.abs(seen) > MIN_SPEED_MPS)
    weight = float(np.sum(np.abs(seen[good]) ** 2))
    if weight == 0.0 or GNSS_SPEED_STD_MPS / math.sqrt(weight) > MAX_STD_RAD:
        return math.nan
    return cmath.phase(complex(np.sum(gnss_speed[good] * np.conj(seen[good]))))


def _speed_over_ground(table: MeasurementTable, robot: Robot) -> Array:
    """Return the speed (n,) of the origin in body axes, forward + 1j left: the camera's, or the wheels'."""
    rates, steer = table.columns(list(robot.wheel_rows)), table.columns(list(robot.steer_rows))
    twist, _ = forward(robot.wheel_positions_m, robot.wheel_radius_m, rates, steer)
    speed = twist[:, 0] + 1j * twist[:, 1]
    if not robot.describes("camera"):
        return np.asarray(speed)
    camera = robot.camera
    x, y, turn = table.columns(["camera_speed_x_mps", "camera_speed_y_mps", "camera_yaw_rate_radps"]).T
    origin_x, origin_y = point_velocity(x, y, turn, -camera.lever_x_m, -camera.lever_y_m)
    by_camera = origin_x + 1j * origin_y
    return np.where(np.isfinite(by_camera), by_camera, speed)
