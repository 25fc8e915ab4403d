"""A run as topics with messages: its own streams, and standard messages where one fits."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.bags.exported import (
    LABEL_TOPIC,
    RUN_TOPIC,
    STRING,
    TIME_FIELD,
    message_text,
    run_document,
    stamps_ns,
    stream_topics,
)
from pipelines.export.encode import encode_columns
from pipelines.messages.definitions import Definition, known_text, parse_definition
from terrain.errors import DataError
from terrain.files.names import shown
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import to_body
from terrain.logs.replay import TWIST
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import Array, RunLog, Stream

LATEST_S = 2**31 - 1
"""Latest stamp of a header in s: its seconds have 32 bits."""

UNKNOWN = -1.0
"""First number of a covariance of what was not measured."""


class Outgoing(NamedTuple):
    """A topic: the text of its definition, its log times (n,) in ns, and its messages."""

    topic: str
    kind: str
    text: str
    log_ns: Array
    messages: list[bytes]


class _Standard(NamedTuple):
    """Numbers by path, and texts, of standard messages of one stream."""

    topic: str
    kind: str
    columns: Mapping[str, Array]
    texts: Mapping[str, str | list[str]]


def outgoing_topics(run: RunLog) -> Iterator[Outgoing]:
    """Yield the topics of a run: the run's own, then those of standard messages.

    Raises
    ------
    DataError
        if the run is longer than stamps can tell apart, 68 years.
    """
    origin_s = _origin_s(run)
    start_ns = min(int(stamps_ns(stream.time_s[:1], origin_s)[0]) for stream in run.streams.values())
    topics = stream_topics(run.streams)
    yield _texts(RUN_TOPIC, [start_ns], [run_document(run, topics)])
    changes = _label_changes(run)
    if changes:
        times, names = zip(*changes, strict=True)
        yield text_topic(LABEL_TOPIC, np.array(times), list(names), run)
    for name, stream in run.streams.items():
        topic = topics[name]
        columns = {field: stream.channel(channel) for field, channel in topic.fields.items()}
        columns[TIME_FIELD] = stream.time_s
        yield _encoded(topic.topic, topic.kind, message_text(topic.fields), stream, columns, {}, origin_s)
    for name, stream in run.streams.items():
        for make in _STANDARD.get(name, ()):
            found = make(stream)
            if found is not None:
                text = known_text(found.kind)
                yield _encoded(found.topic, found.kind, text, stream, found.columns, found.texts, origin_s)


def text_topic(topic: str, time_s: Array, texts: list[str], run: RunLog) -> Outgoing:
    """Return texts at times of a run as a topic; times outside what stamps can be are its ends."""
    origin_s = _origin_s(run)
    return _texts(
        topic,
        stamps_ns(
            np.clip(np.nan_to_num(time_s, nan=origin_s), origin_s, origin_s + LATEST_S), origin_s
        ).tolist(),
        texts,
    )


def _origin_s(run: RunLog) -> float:
    """Return the time of the run that is stamped 0: 0, where stamps allow it."""
    first_s = min(float(stream.time_s[0]) for stream in run.streams.values())
    last_s = max(float(stream.time_s[-1]) for stream in run.streams.values())
    if last_s - first_s > LATEST_S - 1:
        raise DataError(
            f"run {shown(run.run_id)} is {last_s - first_s:g} s long, stamps have {LATEST_S} s at most"
        )
    return 0.0 if first_s >= 0.0 and last_s <= LATEST_S else float(np.floor(first_s))


def _texts(topic: str, log_ns: list[int], texts: list[str]) -> Outgoing:
    definition = known_text(STRING)
    parsed = parse_definition(STRING, definition)
    messages = [encode_columns(parsed, {}, {"data": text}, 1)[0] for text in texts]
    return Outgoing(topic, STRING, definition, np.array(log_ns, dtype=np.int64), messages)


def _encoded(
    topic: str,
    kind: str,
    text: str,
    stream: Stream,
    columns: Mapping[str, Array],
    texts: Mapping[str, str | list[str]],
    origin_s: float,
) -> Outgoing:
    log_ns = stamps_ns(stream.time_s, origin_s)
    stamp = {"header.stamp.sec": log_ns // 10**9, "header.stamp.nanosec": log_ns % 10**9}
    definition: Definition = parse_definition(kind, text)
    messages = encode_columns(definition, {**stamp, **columns}, texts, log_ns.size)
    return Outgoing(topic, kind, text, log_ns, messages)


def _label_changes(run: RunLog) -> list[tuple[float, str]]:
    """Return the terrains as they change; an empty one where no label holds."""
    found: list[tuple[float, str]] = []
    for label in sorted(run.labels):
        if found and found[-1] == (label.start_s, ""):
            found.pop()
        found += [(label.start_s, label.terrain), (label.end_s, "")]
    return found


def _imu(stream: Stream) -> _Standard | None:
    gyro, accel, angles = IMU_CHANNELS[:3], IMU_CHANNELS[3:6], IMU_CHANNELS[6:]
    columns: dict[str, Array] = {}
    for path, channels in (("angular_velocity", gyro), ("linear_acceleration", accel)):
        if set(channels) <= set(stream.channels):
            columns |= {f"{path}.{axis}": stream.channel(c) for axis, c in zip("xyz", channels, strict=True)}
        else:
            columns[f"{path}_covariance[0]"] = np.full(len(stream), UNKNOWN)
    if len(columns) == 2:
        return None
    known = np.zeros(len(stream), dtype=bool)
    if set(angles) <= set(stream.channels):
        attitude = np.column_stack([stream.channel(channel) for channel in angles])
        known = np.isfinite(attitude).all(axis=1)
        quaternion = np.zeros((len(stream), 4))
        if known.any():
            quaternion[known] = Rotation.from_euler("ZYX", attitude[known][:, ::-1]).as_quat()
        columns |= {f"orientation.{axis}": each for axis, each in zip("xyzw", quaternion.T, strict=True)}
    columns["orientation_covariance[0]"] = np.where(known, 0.0, UNKNOWN)
    return _Standard("/imu", "sensor_msgs/msg/Imu", columns, {"header.frame_id": "imu"})


def _joints(field: str, unit: str) -> Callable[[Stream], _Standard | None]:
    def joints(stream: Stream) -> _Standard | None:
        channels = [channel for channel in stream.channels if channel.endswith(unit)]
        if not channels:
            return None
        columns = {f"{field}[{i}]": stream.channel(channel) for i, channel in enumerate(channels)}
        names = [channel.removesuffix(unit) for channel in channels]
        return _Standard("/joint_states", "sensor_msgs/msg/JointState", columns, {"name": names})

    return joints


def _twist(topic: str) -> Callable[[Stream], _Standard | None]:
    def twist(stream: Stream) -> _Standard | None:
        if not set(TWIST) <= set(stream.channels):
            return None
        paths = ("linear.x", "linear.y", "angular.z")
        columns = {f"twist.{path}": stream.channel(c) for path, c in zip(paths, TWIST, strict=True)}
        return _Standard(topic, "geometry_msgs/msg/TwistStamped", columns, {"header.frame_id": "base_link"})

    return twist


def _odometry(stream: Stream) -> _Standard | None:
    if not set(CAMERA_CHANNELS[:-1]) <= set(stream.channels):
        return None
    values = np.column_stack([stream.channel(channel) for channel in CAMERA_CHANNELS[:-1]])
    position, vector, velocity, rate = (to_body(values[:, a : a + 3]) for a in (0, 3, 7, 10))
    quaternion = np.column_stack([vector, values[:, 6]])
    body = np.full(velocity.shape, np.nan)
    known = np.isfinite(quaternion).all(axis=1) & quaternion.any(axis=1)
    if known.any():
        body[known] = Rotation.from_quat(quaternion[known]).inv().apply(velocity[known])
    columns: dict[str, Array] = {}
    for path, axes, part in (
        ("pose.pose.position", "xyz", position),
        ("pose.pose.orientation", "xyzw", quaternion),
        ("twist.twist.linear", "xyz", body),
        ("twist.twist.angular", "xyz", rate),
    ):
        columns |= {f"{path}.{axis}": each for axis, each in zip(axes, part.T, strict=True)}
    texts = {"header.frame_id": "odom", "child_frame_id": "camera"}
    return _Standard("/odometry", "nav_msgs/msg/Odometry", columns, texts)


_STANDARD: Mapping[str, tuple[Callable[[Stream], _Standard | None], ...]] = {
    "imu": (_imu,),
    "wheels": (_joints("velocity", "_radps"),),
    "steering": (_joints("position", "_rad"),),
    "odometry": (_odometry,),
    "commands": (_twist("/cmd_vel"),),
    "estimator": (_twist("/estimate/twist"),),
    "truth": (_twist("/truth/twist"),),
}
"""What makes standard messages of each stream."""
