"""Motion of the robot as camera and wheels saw it, without what a camera makes up."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from terrain.calibration.standing import Stretch
from terrain.estimation.measurements.cleaning import MIN_CONFIDENCE_RATIO
from terrain.kinematics.camera import CHANNELS, body_motion
from terrain.kinematics.wheel_velocity import TWIST, point_velocity
from terrain.records import Array, Stream
from terrain.robots import Robot

JUMP_S = 0.075
"""Width of the running median that a relocalisation of the camera stands out from."""

JUMP = (0.1, 0.1, 0.1, 0.05)
"""By more than this, in m/s of both speeds, rad/s and rad; driving and noise stay below."""

MAX_GAP_S = 0.1
"""Over a longer gap nothing is interpolated."""

SEEN = ("camera_speed_x_mps", "camera_speed_y_mps", "camera_yaw_rate_radps", "camera_yaw_rad")


def seen_motion(stretch: Stretch, robot: Robot) -> Stream | None:
    """Return speeds of the camera point, yaw rate and yaw by the camera, with its latency taken off.

    Samples of low confidence, and those of a relocalisation (wrong speeds for a few samples), are left out.
    None where the camera saw nothing.
    """
    odometry = stretch.of("odometry", CHANNELS)
    if odometry is None or not robot.describes("camera"):
        return None
    camera = robot.camera
    seen = body_motion(odometry, camera)
    values = np.column_stack([seen.speed_mps, seen.yaw_rate_radps, seen.yaw_rad])
    confident = np.isfinite(values).all(axis=1) & (
        odometry.channel("confidence_ratio") >= MIN_CONFIDENCE_RATIO
    )
    if not confident.any():
        return None
    time_s, values = seen.time_s[confident] - camera.latency_s, values[confident]
    width = 2 * round(JUMP_S * odometry.rate_hz / 2) + 1
    kept = (np.abs(values - median_filter(values, size=(width, 1), mode="nearest")) <= JUMP).all(axis=1)
    return Stream(time_s[kept], values[kept], SEEN) if kept.any() else None


def origin_twist(stretch: Stretch, robot: Robot) -> Stream | None:
    """Return the twist of the robot's origin by the camera, or None where it saw nothing."""
    seen = seen_motion(stretch, robot)
    if seen is None:
        return None
    camera = robot.camera
    x_mps, y_mps, turn_radps = seen.values[:, :3].T
    origin = point_velocity(x_mps, y_mps, turn_radps, -camera.lever_x_m, -camera.lever_y_m)
    return Stream(seen.time_s, np.column_stack([*origin, turn_radps]), TWIST)


def at_times(stream: Stream, time_s: Array) -> Array:
    """Return a stream's values (n, channels) at other times; NaN outside it and within its long gaps."""
    after = np.searchsorted(stream.time_s, time_s)
    inside = (after > 0) & (after < len(stream))
    inside[inside] = stream.time_s[after[inside]] - stream.time_s[after[inside] - 1] <= MAX_GAP_S
    values = np.full((len(time_s), len(stream.channels)), np.nan)
    for i, column in enumerate(stream.values.T):
        values[inside, i] = np.interp(time_s[inside], stream.time_s, column)
    return values
