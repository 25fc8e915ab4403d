"""Standard messages as channels: the fields of each kind, and what its numbers become."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import QUATERNION_TOLERANCE, to_camera
from terrain.logs.replay import TWIST
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import Array


class Converted(NamedTuple):
    """Channels, and their values (n, c)."""

    channels: tuple[str, ...]
    values: Array


class StandardKind(NamedTuple):
    """Paths of the numbers of a message, and the function from those (n, k) to channels."""

    paths: tuple[str, ...]
    converted: Callable[[Array], Converted]


def _vector(path: str, axes: str = "xyz") -> tuple[str, ...]:
    return tuple(f"{path}.{axis}" for axis in axes)


def attitude(quaternion: Array) -> Array:
    """Return roll, pitch and yaw (n, 3) of quaternions (n, 4), x y z w; NaN where one is no rotation.

    Examples
    --------
    >>> attitude(np.array([[0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)], [0.0, 0.0, 0.0, 0.0]])).round(3)
    array([[0.   , 0.   , 1.571],
           [  nan,   nan,   nan]])
    """
    angles = np.full((len(quaternion), 3), np.nan)
    valid = _is_rotation(quaternion)
    if valid.any():
        angles[valid] = Rotation.from_quat(quaternion[valid]).as_euler("ZYX")[:, ::-1]
    return angles


def _is_rotation(quaternion: Array) -> Array:
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.sqrt(np.sum(quaternion * quaternion, axis=1))
        return np.asarray(np.abs(length - 1.0) <= QUATERNION_TOLERANCE)


def _imu(numbers: Array) -> Converted:
    """Return the channels of an IMU; what its covariances declare unknown is NaN, or left out for good."""
    groups = [numbers[:, 0:3], numbers[:, 3:6], attitude(numbers[:, 6:10])]
    kept = []
    for number, group in enumerate(groups):
        unknown = numbers[:, 10 + number] == -1.0
        if number == 2:  # all zeros are what a message holds that nothing was written into
            unknown |= ~numbers[:, 6:10].any(axis=1)
        group[unknown] = np.nan
        kept += [not unknown.all()] * 3
    values = np.concatenate(groups, axis=1)
    return Converted(
        tuple(channel for channel, is_kept in zip(IMU_CHANNELS, kept, strict=True) if is_kept),
        values[:, np.array(kept)],
    )


def _odometry(numbers: Array) -> Converted:
    """Return the channels of a tracking camera, which gives velocities in its fixed frame."""
    position, quaternion, velocity, rate = (numbers[:, a:b] for a, b in ((0, 3), (3, 7), (7, 10), (10, 13)))
    fixed = np.full(velocity.shape, np.nan)
    valid = _is_rotation(quaternion)
    if valid.any():
        fixed[valid] = Rotation.from_quat(quaternion[valid]).apply(velocity[valid])
    values = [
        to_camera(position),
        to_camera(quaternion[:, :3]),
        quaternion[:, 3:],
        to_camera(fixed),
        to_camera(rate),
    ]
    return Converted(CAMERA_CHANNELS[:-1], np.concatenate(values, axis=1))


def _twist(numbers: Array) -> Converted:
    return Converted(TWIST, numbers)


_TWIST_PATHS = ("linear.x", "linear.y", "angular.z")

KINDS: Mapping[str, StandardKind] = {
    "sensor_msgs/Imu": StandardKind(
        (
            *_vector("angular_velocity"),
            *_vector("linear_acceleration"),
            *_vector("orientation", "xyzw"),
            "angular_velocity_covariance[0]",
            "linear_acceleration_covariance[0]",
            "orientation_covariance[0]",
        ),
        _imu,
    ),
    "nav_msgs/Odometry": StandardKind(
        (
            *_vector("pose.pose.position"),
            *_vector("pose.pose.orientation", "xyzw"),
            *_vector("twist.twist.linear"),
            *_vector("twist.twist.angular"),
        ),
        _odometry,
    ),
    "geometry_msgs/Twist": StandardKind(_TWIST_PATHS, _twist),
    "geometry_msgs/TwistStamped": StandardKind(tuple(f"twist.{path}" for path in _TWIST_PATHS), _twist),
}
"""By type of message, those that become channels of their own."""
