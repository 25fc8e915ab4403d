"""Standard messages of ROS as numbers: to the channels of a stream, and of those.

One table has both directions: a type of message, the places of its numbers, what channels they become, and
which numbers a stream's channels become.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from terrain.kinematics.camera import CHANNELS, QUATERNION_TOLERANCE, to_body, to_camera
from terrain.logs.mapping import POSITION_CHANNELS, Converted, MessageKind, local_metres
from terrain.logs.schema import IMU_CHANNELS, POSE_CHANNELS, TWIST
from terrain.records import Array, Stream

UNKNOWN = -1.0  #: First number of a covariance of what was not measured
#: Channels of a tracking camera but its confidence, for which the message has no place.
_CAMERA = CHANNELS[:-1]


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


def _of_imu(numbers: Array) -> Converted:
    """Return the channels of an IMU; what its covariances declare unknown is NaN, or left out for good."""
    groups = [numbers[:, 0:3], numbers[:, 3:6], attitude(numbers[:, 6:10])]
    kept = []
    for number, group in enumerate(groups):
        unknown = numbers[:, 10 + number] == UNKNOWN
        if number == 2:  # all zeros are what a message holds that nothing was written into
            unknown |= ~numbers[:, 6:10].any(axis=1)
        group[unknown] = np.nan
        kept += [not unknown.all()] * 3
    channels = tuple(channel for channel, is_kept in zip(IMU_CHANNELS, kept, strict=True) if is_kept)
    return channels, np.concatenate(groups, axis=1)[:, np.array(kept)]


def _to_imu(stream: Stream) -> Array | None:
    numbers = np.zeros((len(stream), 13))
    for place in (0, 3):
        channels = IMU_CHANNELS[place : place + 3]
        if set(channels) <= set(stream.channels):
            numbers[:, place : place + 3] = stream.columns(channels)
        else:
            numbers[:, 10 + place // 3] = UNKNOWN
    if (numbers[:, 10:12] == UNKNOWN).all():
        return None
    known: Array = np.zeros(len(stream), dtype=bool)
    if set(IMU_CHANNELS[6:]) <= set(stream.channels):
        euler = stream.columns(IMU_CHANNELS[6:])
        known = np.asarray(np.isfinite(euler).all(axis=1))
        if known.any():
            numbers[known, 6:10] = Rotation.from_euler("ZYX", euler[known][:, ::-1]).as_quat()
    numbers[:, 12] = np.where(known, 0.0, UNKNOWN)
    return numbers


def _of_odometry(numbers: Array) -> Converted:
    """Return the channels of a tracking camera, which gives velocities in its fixed frame."""
    position, quaternion, velocity, rate = (numbers[:, a:b] for a, b in ((0, 3), (3, 7), (7, 10), (10, 13)))
    fixed = np.full(velocity.shape, np.nan)
    valid = _is_rotation(quaternion)
    if valid.any():
        fixed[valid] = Rotation.from_quat(quaternion[valid]).apply(velocity[valid])
    vectors = [to_camera(each) for each in (position, quaternion[:, :3], fixed, rate)]
    return _CAMERA, np.concatenate([*vectors[:2], quaternion[:, 3:], *vectors[2:]], axis=1)


def _to_odometry(stream: Stream) -> Array | None:
    if not set(_CAMERA) <= set(stream.channels):
        return None
    values = stream.columns(_CAMERA)
    position, vector, velocity, rate = (to_body(values[:, a : a + 3]) for a in (0, 3, 7, 10))
    quaternion = np.column_stack([vector, values[:, 6]])
    body = np.full(velocity.shape, np.nan)
    known = np.isfinite(quaternion).all(axis=1) & quaternion.any(axis=1)
    if known.any():
        body[known] = Rotation.from_quat(quaternion[known]).inv().apply(velocity[known])
    return np.column_stack([position, quaternion, body, rate])


def _of_twist(numbers: Array) -> Converted:
    return TWIST, numbers


def _to_twist(stream: Stream) -> Array | None:
    return stream.columns(TWIST) if set(TWIST) <= set(stream.channels) else None


def _of_pose(numbers: Array) -> Converted:
    """Return position and continuous yaw of poses in the plane."""
    yaw_rad = attitude(numbers[:, 3:7])[:, 2]
    known = np.isfinite(yaw_rad)
    yaw_rad[known] = np.unwrap(yaw_rad[known])
    return POSE_CHANNELS, np.column_stack([numbers[:, :2], yaw_rad])


def _of_fix(numbers: Array) -> Converted:
    """Return positions in m of the first fix, with their deviation; NaN without a fix."""
    degrees, height_m, status, variance_m2 = numbers[:, :2], numbers[:, 2], numbers[:, 3], numbers[:, 4]
    latitude, longitude = (np.where(status >= 0, np.radians(each), np.nan) for each in degrees.T)
    metres = local_metres(latitude, longitude, height_m)
    std_m = np.where((status >= 0) & (variance_m2 > 0), np.sqrt(np.abs(variance_m2)), np.nan)
    if not np.isfinite(std_m).any():
        return POSITION_CHANNELS, metres
    return (*POSITION_CHANNELS, "std_position_m"), np.column_stack([metres, std_m])


def _paths(path: str, axes: str = "xyz") -> tuple[str, ...]:
    return tuple(f"{path}.{axis}" for axis in axes)


_TWIST = ("linear.x", "linear.y", "angular.z")
_POSE = (*_paths("position"), *_paths("orientation", "xyzw"))

#: By type of message, those that become channels of their own, and what they are made of.
KINDS: Mapping[str, MessageKind] = {
    "sensor_msgs/NavSatFix": MessageKind(
        ("latitude", "longitude", "altitude", "status.status", "position_covariance[0]"), _of_fix
    ),
    "sensor_msgs/Imu": MessageKind(
        (
            *_paths("angular_velocity"),
            *_paths("linear_acceleration"),
            *_paths("orientation", "xyzw"),
            "angular_velocity_covariance[0]",
            "linear_acceleration_covariance[0]",
            "orientation_covariance[0]",
        ),
        _of_imu,
        _to_imu,
        {"header.frame_id": "imu"},
    ),
    "nav_msgs/Odometry": MessageKind(
        (
            *(f"pose.pose.{path}" for path in _POSE),
            *_paths("twist.twist.linear"),
            *_paths("twist.twist.angular"),
        ),
        _of_odometry,
        _to_odometry,
        {"header.frame_id": "odom", "child_frame_id": "camera"},
    ),
    "geometry_msgs/Twist": MessageKind(_TWIST, _of_twist),
    "geometry_msgs/TwistStamped": MessageKind(
        tuple(f"twist.{path}" for path in _TWIST), _of_twist, _to_twist, {"header.frame_id": "base_link"}
    ),
    "geometry_msgs/PoseStamped": MessageKind(tuple(f"pose.{path}" for path in _POSE), _of_pose),
    "geometry_msgs/PoseWithCovarianceStamped": MessageKind(
        tuple(f"pose.pose.{path}" for path in _POSE), _of_pose
    ),
}
#: Topic and type of the standard messages that each stream becomes.
_TOPICS: Mapping[str, tuple[str, str]] = {
    "imu": ("/imu", "sensor_msgs/Imu"),
    "odometry": ("/odometry", "nav_msgs/Odometry"),
    "commands": ("/cmd_vel", "geometry_msgs/TwistStamped"),
    "estimator": ("/estimate/twist", "geometry_msgs/TwistStamped"),
    "truth": ("/truth/twist", "geometry_msgs/TwistStamped"),
}
#: Streams that become states of joints: the field of their numbers, and the unit of the channels.
_JOINTS = {"wheels": ("velocity", "_radps"), "steering": ("position", "_rad")}


class StandardTopic(NamedTuple):
    """A stream as standard messages."""

    topic: str  #: name and type
    kind: str
    paths: tuple[str, ...]  #: places of numbers, and those (n, k) of each sample
    numbers: Array
    fixed: Mapping[str, Any]  #: what all messages hold, by path


def standard_topic(name: str, stream: Stream) -> StandardTopic | None:
    """Return what a stream is in standard messages, if it is anything there."""
    if name in _JOINTS:
        field, unit = _JOINTS[name]
        channels = tuple(channel for channel in stream.channels if channel.endswith(unit))
        if not channels:
            return None
        fixed = {
            "name": [channel.removesuffix(unit) for channel in channels],
            field: np.zeros(len(channels)),
        }
        paths = tuple(f"{field}[{i}]" for i in range(len(channels)))
        return StandardTopic(
            "/joint_states", "sensor_msgs/msg/JointState", paths, stream.columns(channels), fixed
        )
    if name not in _TOPICS:
        return None
    topic, kind = _TOPICS[name]
    to_numbers = KINDS[kind].numbers
    numbers = None if to_numbers is None else to_numbers(stream)
    if numbers is None:
        return None
    return StandardTopic(topic, kind.replace("/", "/msg/"), KINDS[kind].paths, numbers, KINDS[kind].fixed)
