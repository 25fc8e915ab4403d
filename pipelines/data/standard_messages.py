"""Standard messages of ROS as channels of streams, and streams as standard messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.data.mcap_file import library
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import QUATERNION_TOLERANCE, to_body, to_camera
from terrain.logs.geodesy import local_metres
from terrain.logs.mapping import POSITION_CHANNELS
from terrain.logs.replay import TWIST
from terrain.logs.schema import IMU_CHANNELS, POSE_CHANNELS
from terrain.records import Array, Stream

DISTRO = "ROS2_HUMBLE"
"""Release whose definitions are written, and taken for a bag that holds none and does not name its own."""

UNKNOWN = -1.0
"""First number of a covariance of what was not measured."""


class Converted(NamedTuple):
    """Channels, and their values (n, c)."""

    channels: tuple[str, ...]
    values: Array


class StandardKind(NamedTuple):
    """Paths of the numbers of a message, and the function from those (n, k) to channels."""

    paths: tuple[str, ...]
    converted: Callable[[Array], Converted]


def _paths(path: str, axes: str = "xyz") -> tuple[str, ...]:
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
        unknown = numbers[:, 10 + number] == UNKNOWN
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
    vectors = [to_camera(each) for each in (position, quaternion[:, :3], fixed, rate)]
    values = [*vectors[:2], quaternion[:, 3:], *vectors[2:]]
    return Converted(CAMERA_CHANNELS[:-1], np.concatenate(values, axis=1))


def _twist(numbers: Array) -> Converted:
    return Converted(TWIST, numbers)


def _pose(numbers: Array) -> Converted:
    """Return position and continuous yaw of poses in the plane."""
    yaw_rad = attitude(numbers[:, 3:7])[:, 2]
    known = np.isfinite(yaw_rad)
    yaw_rad[known] = np.unwrap(yaw_rad[known])
    return Converted(POSE_CHANNELS, np.column_stack([numbers[:, :2], yaw_rad]))


def _gnss(numbers: Array) -> Converted:
    """Return positions in m of the first fix, with their deviation; NaN without a fix."""
    degrees, height_m, status, variance_m2 = numbers[:, :2], numbers[:, 2], numbers[:, 3], numbers[:, 4]
    latitude, longitude = (np.where(status >= 0, np.radians(each), np.nan) for each in degrees.T)
    metres = local_metres(latitude, longitude, height_m)
    std_m = np.where((status >= 0) & (variance_m2 > 0), np.sqrt(np.abs(variance_m2)), np.nan)
    channels = (*POSITION_CHANNELS, "std_position_m")
    if not np.isfinite(std_m).any():
        return Converted(POSITION_CHANNELS, metres)
    return Converted(channels, np.column_stack([metres, std_m]))


_TWIST_PATHS = ("linear.x", "linear.y", "angular.z")
_POSE_PATHS = (*_paths("position"), *_paths("orientation", "xyzw"))

KINDS: Mapping[str, StandardKind] = {
    "sensor_msgs/NavSatFix": StandardKind(
        ("latitude", "longitude", "altitude", "status.status", "position_covariance[0]"), _gnss
    ),
    "sensor_msgs/Imu": StandardKind(
        (
            *_paths("angular_velocity"),
            *_paths("linear_acceleration"),
            *_paths("orientation", "xyzw"),
            "angular_velocity_covariance[0]",
            "linear_acceleration_covariance[0]",
            "orientation_covariance[0]",
        ),
        _imu,
    ),
    "nav_msgs/Odometry": StandardKind(
        (
            *(f"pose.pose.{path}" for path in _POSE_PATHS),
            *_paths("twist.twist.linear"),
            *_paths("twist.twist.angular"),
        ),
        _odometry,
    ),
    "geometry_msgs/Twist": StandardKind(_TWIST_PATHS, _twist),
    "geometry_msgs/TwistStamped": StandardKind(tuple(f"twist.{path}" for path in _TWIST_PATHS), _twist),
    "geometry_msgs/PoseStamped": StandardKind(tuple(f"pose.{path}" for path in _POSE_PATHS), _pose),
    "geometry_msgs/PoseWithCovarianceStamped": StandardKind(
        tuple(f"pose.pose.{path}" for path in _POSE_PATHS), _pose
    ),
}
"""By type of message, those that become channels of their own."""


class StandardTopic(NamedTuple):
    """A stream as standard messages.

    Parameters
    ----------
    topic, kind : name and type
    columns : (n,) numbers, or (n, k) of an array, by path of their field
    texts : text, or texts of an array, by path
    """

    topic: str
    kind: str
    columns: Mapping[str, Array]
    texts: Mapping[str, str | list[str]]


def standard_topics(name: str, stream: Stream) -> Iterator[StandardTopic]:
    """Yield what a stream is in standard messages: none, one or several topics."""
    make = _TOPICS.get(name)
    found = make(stream) if make is not None else None
    if found is not None:
        yield found


def _topic_of_imu(stream: Stream) -> StandardTopic | None:
    gyro, accel, angles = IMU_CHANNELS[:3], IMU_CHANNELS[3:6], IMU_CHANNELS[6:]
    columns: dict[str, Array] = {}
    for path, channels in (("angular_velocity", gyro), ("linear_acceleration", accel)):
        if set(channels) <= set(stream.channels):
            columns |= {f"{path}.{axis}": stream.channel(c) for axis, c in zip("xyz", channels, strict=True)}
        else:
            columns[f"{path}_covariance"] = _covariance(np.full(len(stream), UNKNOWN))
    if len(columns) == 2:
        return None
    known = np.zeros(len(stream), dtype=bool)
    if set(angles) <= set(stream.channels):
        euler = np.column_stack([stream.channel(channel) for channel in angles])
        known = np.isfinite(euler).all(axis=1)
        quaternion = np.zeros((len(stream), 4))
        if known.any():
            quaternion[known] = Rotation.from_euler("ZYX", euler[known][:, ::-1]).as_quat()
        columns |= {f"orientation.{axis}": each for axis, each in zip("xyzw", quaternion.T, strict=True)}
    columns["orientation_covariance"] = _covariance(np.where(known, 0.0, UNKNOWN))
    return StandardTopic("/imu", "sensor_msgs/msg/Imu", columns, {"header.frame_id": "imu"})


def _covariance(first: Array) -> Array:
    return np.column_stack([first, np.zeros((len(first), 8))])


def _topic_of_joints(field: str, unit: str) -> Callable[[Stream], StandardTopic | None]:
    def joints(stream: Stream) -> StandardTopic | None:
        channels = [channel for channel in stream.channels if channel.endswith(unit)]
        if not channels:
            return None
        columns = {field: np.column_stack([stream.channel(channel) for channel in channels])}
        names = [channel.removesuffix(unit) for channel in channels]
        return StandardTopic("/joint_states", "sensor_msgs/msg/JointState", columns, {"name": names})

    return joints


def _topic_of_twist(topic: str) -> Callable[[Stream], StandardTopic | None]:
    def twist(stream: Stream) -> StandardTopic | None:
        if not set(TWIST) <= set(stream.channels):
            return None
        columns = {f"twist.{path}": stream.channel(c) for path, c in zip(_TWIST_PATHS, TWIST, strict=True)}
        kind = "geometry_msgs/msg/TwistStamped"
        return StandardTopic(topic, kind, columns, {"header.frame_id": "base_link"})

    return twist


def _topic_of_odometry(stream: Stream) -> StandardTopic | None:
    if not set(CAMERA_CHANNELS[:-1]) <= set(stream.channels):
        return None
    values = np.column_stack([stream.channel(channel) for channel in CAMERA_CHANNELS[:-1]])
    position, vector, velocity, rate = (to_body(values[:, a : a + 3]) for a in (0, 3, 7, 10))
    quaternion = np.column_stack([vector, values[:, 6]])
    body = np.full(velocity.shape, np.nan)
    known = np.isfinite(quaternion).all(axis=1) & quaternion.any(axis=1)
    if known.any():
        body[known] = Rotation.from_quat(quaternion[known]).inv().apply(velocity[known])
    numbers = np.column_stack([position, quaternion, body, rate])
    columns = dict(zip(KINDS["nav_msgs/Odometry"].paths, numbers.T, strict=True))
    texts = {"header.frame_id": "odom", "child_frame_id": "camera"}
    return StandardTopic("/odometry", "nav_msgs/msg/Odometry", columns, texts)


_TOPICS: Mapping[str, Callable[[Stream], StandardTopic | None]] = {
    "imu": _topic_of_imu,
    "wheels": _topic_of_joints("velocity", "_radps"),
    "steering": _topic_of_joints("position", "_rad"),
    "odometry": _topic_of_odometry,
    "commands": _topic_of_twist("/cmd_vel"),
    "estimator": _topic_of_twist("/estimate/twist"),
    "truth": _topic_of_twist("/truth/twist"),
}
"""What makes standard messages of each stream."""


def serialized(topic: StandardTopic, log_ns: Array) -> tuple[str, list[bytes]]:
    """Return the definition of standard messages, and one (CDR) for each stamp, which their headers bear.

    Raises
    ------
    ConfigError
        if rosbags is not installed.
    """
    library("rosbags.typesys")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores[DISTRO])
    message = _zero(store, topic.kind)
    for path, text in topic.texts.items():
        setattr(*_place(message, path), text)
    stamp = {"header.stamp.sec": log_ns // 10**9, "header.stamp.nanosec": log_ns % 10**9}
    columns = {**stamp, **topic.columns}
    places = [_place(message, path) for path in columns]
    rows = zip(*(each.tolist() if each.ndim == 1 else each for each in columns.values()), strict=True)
    messages = []
    for row in rows:
        for (owner, field), value in zip(places, row, strict=True):
            setattr(owner, field, value)
        messages.append(bytes(store.serialize_cdr(message, topic.kind)))
    return str(store.generate_msgdef(topic.kind, ros_version=2)[0]), messages


def _place(message: Any, path: str) -> tuple[Any, str]:
    """Return the part of a message that has the last field of a path, and the name of that field."""
    *parents, field = path.split(".")
    for name in parents:
        message = getattr(message, name)
    return message, field


def _zero(store: Any, kind: str) -> Any:
    """Return a message whose numbers are 0, texts empty, and sequences of no element."""
    from rosbags.interfaces import Nodetype

    values: dict[str, Any] = {}
    for name, (node, described) in store.fielddefs[kind][1]:
        if node == Nodetype.NAME:
            values[name] = _zero(store, described)
        elif node == Nodetype.BASE:
            values[name] = "" if described[0] == "string" else 0
        else:  # those that are written are arrays of float64
            values[name] = np.zeros(described[1] if node == Nodetype.ARRAY else 0)
    return store.types[kind](**values)
