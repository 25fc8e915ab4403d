"""From topics to streams, as a small YAML mapping describes it, or by the types of a bag's topics.

::

    robot: husky                      # may be left out where --robot is given
    time: header                      # stamps of the headers, log times where there are none; log: log times
    labels: /terrain                  # std_msgs/String with the names of terrains as they change
    streams:
      imu: {topic: /imu/data, kind: imu}
      odometry: {topic: /zed/odom, kind: odometry}
      commands: {topic: /cmd_vel, kind: twist}
      wheels:
        topic: /joint_states
        kind: joints
        channels:
          speed_left_mps: {joint: front_left_wheel, field: velocity}
      battery:
        topic: /status
        channels:
          voltage_v: {field: "cells[0].volts", unit: V, scale: 2, offset: 0.1}

A number becomes ``(scale * number + offset)`` in the unit given, and then SI.  A channel may name a topic of
its own.  Samples of several topics are joined by ``join``: ``equal`` takes the instants that all topics have,
by their stamps; ``previous`` the instants of the stream's topic, with the last value of the others by then.
"""

from __future__ import annotations

import re
from collections.abc import Mapping as Map
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, ValidationError

from terrain.errors import ConfigError, LogError
from terrain.files.documents import first_fault, read_yaml
from terrain.files.names import check_name, listed, plain_name
from terrain.files.resources import data_folder
from terrain.logs.faults import Topic
from terrain.logs.mapping import Strict, Unit, Word, check_unit
from terrain.logs.schema import unit_of

Kind = Literal["fields", "gnss", "imu", "joints", "odometry", "pose", "twist"]

TYPES: Map[str, tuple[str, ...]] = {
    "gnss": ("sensor_msgs/NavSatFix",),
    "imu": ("sensor_msgs/Imu",),
    "joints": ("sensor_msgs/JointState",),
    "odometry": ("nav_msgs/Odometry",),
    "pose": ("geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped"),
    "twist": ("geometry_msgs/Twist", "geometry_msgs/TwistStamped"),
}
"""Types of the messages of each kind."""

STANDARD_STREAMS: Map[str, str] = {"imu": "imu", "odometry": "odometry", "commands": "twist"}
"""Stream of each kind that needs no mapping, where one topic alone is of its types."""

LABELS_TYPE = "std_msgs/String"

DISTRO = "ROS2_HUMBLE"
"""Release whose definitions are written, and taken for a bag that holds none and does not name its own."""

_JOINT_UNITS: Map[str, str] = {"velocity": "rad/s", "position": "rad", "effort": "Nm"}
_PATH = re.compile(r"[A-Za-z]\w*(\[\d+\])?(\.[A-Za-z]\w*(\[\d+\])?)*")


class WheelRadius(Strict):
    """Radius by which rates of wheels become speeds."""

    value: Annotated[FiniteFloat, Field(gt=0.0)]
    unit: Literal["m", "mm"]
    source: Word


class Channel(Strict):
    """Where a channel is: ``(scale * number + offset)`` is in ``unit``; ``source`` is that of those."""

    field: Word
    joint: str = ""
    topic: str = ""
    unit: Unit = ""
    scale: FiniteFloat = 1.0
    offset: FiniteFloat = 0.0
    source: str = ""


class StreamMapping(Strict):
    """Where a stream is."""

    topic: Word
    kind: Kind = "fields"
    channels: Annotated[dict[str, Channel], Field(default_factory=dict)]
    time: Literal["header", "log", ""] = ""
    join: Literal["equal", "previous"] = "equal"
    wheel_radius: WheelRadius | None = None


class Mapping(Strict):
    """How topics become streams."""

    streams: Annotated[dict[Word, StreamMapping], Field(min_length=1)]
    robot: str = ""
    time: Literal["header", "log"] = "header"
    terrain: str = ""
    labels: str = ""


def short_type(name: str) -> str:
    """Return the name of a type without its middle part.

    Examples
    --------
    >>> short_type("sensor_msgs/msg/Imu")
    'sensor_msgs/Imu'
    """
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) == 3 else name


def load_mapping(path: str | Path) -> Mapping:
    """Return the mapping that a YAML file describes.

    Parameters
    ----------
    path : of the file, or the name of a packaged one

    Raises
    ------
    ConfigError
        if the file cannot be read, a key is unknown or missing, or a unit is unknown or does not suit its
        channel.

    Examples
    --------
    >>> load_mapping("husky_topics").streams["wheels"].topic
    '/joint_states'
    """
    path = Path(path)
    packaged = data_folder("bags") / f"{path}.yaml"
    if not path.exists() and plain_name(str(path)) and packaged.is_file():
        path = packaged
    described = read_yaml(path)
    try:
        mapping = Mapping.model_validate(described)
    except ValidationError as error:
        raise ConfigError(f"{path.name}: {first_fault(error)}") from error
    for key in ("robot", "terrain"):
        if getattr(mapping, key):
            check_name(f"{path.name}: {key}", getattr(mapping, key), ConfigError)
    if mapping.terrain and mapping.labels:
        raise ConfigError(f"{path.name}: has both 'terrain' and 'labels', one of them is accepted")
    for name, stream in mapping.streams.items():
        check_name(f"{path.name}: stream", name, ConfigError)
        _check_stream(f"{path.name}: stream {name}", stream)
    return mapping


def check_stream(place: str, described: Map[str, object]) -> StreamMapping:
    """Return a stream of messages that is described in a mapping of files.

    Parameters
    ----------
    place : of the stream, as messages name it
    described : its keys

    Raises
    ------
    ConfigError
        if a key is unknown or missing, or a unit does not suit its channel.
    """
    try:
        stream = StreamMapping.model_validate(dict(described))
    except ValidationError as error:
        raise ConfigError(f"{place}: {first_fault(error)}") from error
    _check_stream(place, stream)
    return stream


def _check_stream(place: str, stream: StreamMapping) -> None:
    has_channels = stream.kind in ("fields", "joints")
    if has_channels != bool(stream.channels):
        fault = (
            "has no channels"
            if has_channels
            else f"is of kind {stream.kind!r}, which has channels of its own"
        )
        raise ConfigError(f"{place}: {fault}")
    if stream.wheel_radius is not None and stream.kind != "joints":
        raise ConfigError(f"{place}: 'wheel_radius' is for kind 'joints'")
    for name, channel in stream.channels.items():
        try:
            desired = unit_of(name)
        except LogError as error:
            raise ConfigError(f"{place}: {error}") from error
        at = f"{place}: channel {name}"
        if stream.kind == "joints":
            _check_joint(at, channel, desired)
            continue
        if channel.joint:
            raise ConfigError(f"{at}: 'joint' is for kind 'joints'")
        if not _PATH.fullmatch(channel.field):
            raise ConfigError(
                f"{at}: field {channel.field!r} is no path, as 'twist.linear.x' or 'data[2]' is one"
            )
        if desired != "code":
            check_unit(at, channel.unit, desired)


def _check_joint(place: str, channel: Channel, desired: str) -> None:
    if channel.field not in _JOINT_UNITS:
        raise ConfigError(f"{place}: field {channel.field!r} is none of {', '.join(_JOINT_UNITS)}")
    if not channel.joint:
        raise ConfigError(f"{place}: key 'joint' is missing")
    if channel.topic:
        raise ConfigError(f"{place}: 'topic' is for streams without a kind")
    unit = channel.unit or _JOINT_UNITS[channel.field]
    if not by_radius(channel, desired):
        check_unit(place, unit, desired)


def joint_unit(channel: Channel) -> str:
    """Return the unit of a joint's number: as stated, else that of ROS."""
    return channel.unit or _JOINT_UNITS[channel.field]


def by_radius(channel: Channel, desired: str) -> bool:
    """Return whether a channel is a speed whose joint turns: its rate is multiplied by the wheel's radius."""
    return (
        desired == "mps" and channel.field == "velocity" and joint_unit(channel) in ("rad/s", "deg/s", "rpm")
    )


def standard_mapping(place: str, topics: list[Topic]) -> Mapping:
    """Return the mapping of a bag by the types of its topics.

    Parameters
    ----------
    place : as messages name it
    topics : of the bag

    Raises
    ------
    ConfigError
        if none has a type of :data:`STANDARD_STREAMS`, or several have one.

    Examples
    --------
    >>> standard_mapping("a.mcap", [Topic("/imu", "sensor_msgs/msg/Imu", "cdr", "", "")]).streams["imu"].topic
    '/imu'
    """
    streams = {}
    for stream, kind in STANDARD_STREAMS.items():
        fitting = [topic.name for topic in topics if short_type(topic.kind) in TYPES[kind]]
        if len(fitting) > 1:
            raise ConfigError(
                f"{place}: the topics {listed(fitting)} are all of type {' or '.join(TYPES[kind])}: "
                f"choose one with --mapping"
            )
        if fitting:
            streams[stream] = StreamMapping.model_validate({"topic": fitting[0], "kind": kind})
    if not streams:
        raise ConfigError(f"{place}: needs a mapping (--mapping): it has {described(topics)}")
    return Mapping(streams=streams)


def described(topics: list[Topic]) -> str:
    """Return topics with their types, as messages list them."""
    return listed([f"{topic.name} ({topic.kind})" for topic in sorted(topics)]) if topics else "no topic"
