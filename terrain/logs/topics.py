"""Messages of topics as streams, as a mapping describes them (``docs/bags.md``), or the types of the topics.

A channel may name a topic of its own.  Samples of several topics are joined by ``join``: ``equal`` takes the instants
that all topics have, by their stamps; ``previous`` the instants of the stream's topic, with the last value of the
others by then.  Messages are an object of ROS or Protobuf, or JSON, whatever decoded them.

What is wrong with a log is refused at once, or counted where it is repaired (:class:`Faults`).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError, LogError
from terrain.files.names import listed, shown
from terrain.logs.labels import label_intervals
from terrain.logs.mapping import MessageStream, TopicMapping
from terrain.logs.samples import checked_stream, longest_rise, refuse_or_count
from terrain.logs.schema import UNIT_SCALES, unit_of
from terrain.logs.tables import MAX_VALUES
from terrain.records import Array, Label, Stream

EARLY_END = "files that end early"
DAMAGED_BLOCK = "damaged blocks of messages"
DAMAGED_MESSAGE = "damaged messages"
UNMATCHED = "messages without one of equal stamp on the other topics"

STAMPS = (
    ("header.stamp.sec", "header.stamp.nanosec"),
    ("header.stamp.secs", "header.stamp.nsecs"),
    ("timestamp.seconds", "timestamp.nanos"),
    ("timestamp.sec", "timestamp.nsec"),
)
"""Where messages of ROS, and those of Foxglove in Protobuf and JSON, have the time of a measurement."""

TYPES: Mapping[str, tuple[str, ...]] = {
    "gnss": ("sensor_msgs/NavSatFix",),
    "imu": ("sensor_msgs/Imu",),
    "joints": ("sensor_msgs/JointState",),
    "odometry": ("nav_msgs/Odometry",),
    "pose": ("geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped"),
    "twist": ("geometry_msgs/Twist", "geometry_msgs/TwistStamped"),
}
"""Types of the messages of each kind of stream."""

STANDARD_STREAMS: Mapping[str, str] = {"imu": "imu", "odometry": "odometry", "commands": "twist"}
"""Stream of each kind that needs no mapping, where one topic alone is of its types."""

LABELS_TYPE = "std_msgs/String"

DISTRO = "ROS2_HUMBLE"
"""Release whose definitions are written, and taken for a bag that holds none and does not name its own."""

MAX_LABELS = 1_000_000  #: Messages with terrains; ten a second are 28 hours
LATEST_NS = 2**62  #: Latest stamp that a message may have

Number = Callable[[Any], float]
Converted = tuple[tuple[str, ...], Array]  #: Channels, and their values (n, c)


class Topic(NamedTuple):
    """A topic: its type, how its messages are encoded, and the definition that the file holds of it.

    ``definition`` is text; of Protobuf it is its bytes, a character each.
    """

    name: str
    kind: str
    encoding: str
    schema_encoding: str
    definition: str


class MessageKind(NamedTuple):
    """A type of message that becomes channels of its own."""

    paths: tuple[str, ...]  #: of its numbers
    channels: Callable[[Array], Converted]  #: from those (n, k) to channels
    #: from a stream to those (n, k), None where the stream lacks channels; None where none is written
    numbers: Callable[[Stream], Array | None] | None = None
    fixed: Mapping[str, Any] = MappingProxyType({})  #: what else is written, by path


class Faults:
    """Faults of one log: counts by kind in ``repairs``, None of which refuses.

    ``first`` is what a strict read would refuse first; empty without a fault.
    """

    def __init__(self, repairs: Counter[str] | None) -> None:
        self.repairs, self.first = repairs, ""

    def found(self, place: str, kind: str, text: str, n: int = 1) -> None:
        """Raise :class:`LogError`, or count."""
        self.first = self.first or f"{place}: {text}; read it with --repair to leave that out"
        refuse_or_count(self.repairs, kind, self.first, n)


def number_at(topic: str, kind: str, message: Any, path: str, joint: str = "") -> Number:
    """Return what takes a number from each message of a topic, of which ``message`` is one; NaN where one lacks it.

    The path is as ``twist.linear.x`` or ``data[2]``, of a joint that of the array that has its number, at its place in
    the field ``name``.  ``ConfigError`` where the message has no such field, or no number in it.

    Examples
    --------
    >>> speed = number_at("/speeds", "a_msgs/Speeds", {"speeds": [1.5, 2.5]}, "speeds[1]")
    >>> speed({"speeds": [3, 4]}), speed({"speeds": []})
    (4.0, nan)
    """
    place = f"topic {topic}: field {shown(path)}"
    if joint:
        if not {path, "name"} <= set(_fields(message)) or not _is_array(_field(message, path)):
            raise ConfigError(f"{place} is no array of joints")

        def of_joint(message: Any) -> float:
            names, values = list(_field(message, "name")), _field(message, path)
            at = names.index(joint) if joint in names else len(values)
            return float(values[at]) if at < len(values) else np.nan

        return of_joint
    steps: list[str | int] = []

    def along(message: Any) -> float:
        for step in steps:
            if isinstance(step, str):
                message = _field(message, step)
            else:
                message = message[step] if step < len(message) else None
            if message is None:
                return np.nan
        return float(message)

    value, owner = message, kind
    for name, index in re.findall(r"(\w+)(?:\[(\d+)\])?", path):
        fields = _fields(value)
        if name not in fields:
            lacks = f"has no {name!r} (it has {listed(fields)})" if fields else "has no fields of its own"
            raise ConfigError(f"{place}: {owner} {lacks}")
        value, owner = _field(value, name), repr(name)
        if _is_array(value) != bool(index):
            fault = f"give an index, as {name}[0]" if not index else f"leave the index out, as {name}"
            raise ConfigError(f"{place}: {name!r} is {'an' if not index else 'no'} array: {fault}")
        steps += [name, int(index)] if index else [name]
        if index:
            if int(index) >= len(value):  # another message may have more elements
                return along
            value = value[int(index)]
    if value is not None and not isinstance(value, int | float | np.number | np.bool_):
        inner = f" (it has {listed(fields)})" if (fields := _fields(value)) else ""
        raise ConfigError(f"{place} is of type {type(value).__name__}, a number is required{inner}")
    if isinstance(message, dict) or not all(isinstance(step, str) for step in steps):
        return along
    return attrgetter(path)


def _fields(message: Any) -> list[str]:
    """Return the names of the fields of a message; empty of what is none."""
    if isinstance(message, dict):
        return [str(name) for name in message]
    if hasattr(message, "DESCRIPTOR"):
        return [field.name for field in message.DESCRIPTOR.fields]
    return [name for name in getattr(message, "__dataclass_fields__", {}) if not name.startswith("__")]


def _field(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name)


def _is_array(value: Any) -> bool:
    return hasattr(value, "__getitem__") and not isinstance(value, str | bytes | dict) and np.ndim(value) > 0


def short_type(name: str) -> str:
    """Return the name of a type without its middle part: ``sensor_msgs/Imu`` of ``sensor_msgs/msg/Imu``."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) == 3 else name


def standard_mapping(place: str, topics: list[Topic]) -> TopicMapping:
    """Return the mapping of a bag, which messages call ``place``, by the types of its topics.

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
                "choose one with --mapping"
            )
        if fitting:
            streams[stream] = MessageStream.model_validate({"topic": fitting[0], "kind": kind})
    if not streams:
        raise ConfigError(f"{place}: needs a mapping (--mapping): it has {_described(topics)}")
    return TopicMapping(streams=streams)


def _described(topics: Sequence[Topic]) -> str:
    return listed([f"{topic.name} ({topic.kind})" for topic in sorted(topics)]) if topics else "no topic"


class _Source(NamedTuple):
    """Where the numbers of a stream are: path and joint of each, by topic, and what makes channels of them."""

    stream: MessageStream
    paths: Mapping[str, Sequence[tuple[str, str]]]
    channels: Callable[[Array], Converted]


class MappedTopics:
    """The topics of a mapping: takes their messages, each once, and gives the streams that they become.

    ``topics`` are those that there are, by name; ``kinds`` by type of message those that become channels of their own;
    ``decoder`` returns what makes an object of each message of a topic.  ``LogError`` where there is no such topic, or
    one of another type; ``ConfigError`` where speeds of wheels need the radius and none is known.
    """

    def __init__(
        self,
        place: str,
        mapping: TopicMapping,
        topics: Mapping[str, Topic],
        kinds: Mapping[str, MessageKind],
        decoder: Callable[[Topic], Callable[[bytes], Any]],
        wheel_radius_m: float | None,
        faults: Faults,
    ) -> None:
        self._place, self._mapping, self._faults = place, mapping, faults
        self._sources: dict[str, _Source] = {}
        self._of_topic: dict[str, _TopicNumbers] = {}
        there = _described([*topics.values()])
        for name, stream in mapping.streams.items():
            at = f"{place}: stream {name}"
            for topic in (stream.topic, *(channel.topic for channel in stream.channels.values())):
                if topic and topic not in topics:
                    raise LogError(f"{at}: there is no topic {shown(topic)} (there are {there})")
            kind = topics[stream.topic].kind
            if stream.kind != "fields" and short_type(kind) not in TYPES[stream.kind]:
                required = f"kind {stream.kind!r} is {' or '.join(TYPES[stream.kind])} (there are {there})"
                raise LogError(f"{at}: topic {stream.topic} is of type {kind}, {required}")
            radius, radius_m = stream.wheel_radius, wheel_radius_m
            if radius is not None:
                radius_m = radius.value * UNIT_SCALES[radius.unit][1]
            if stream.channels:
                self._sources[name] = _fields_source(at, stream, radius_m)
            else:
                of_kind = kinds[short_type(kind)]
                paths = {stream.topic: [(path, "") for path in of_kind.paths]}
                self._sources[name] = _Source(stream, paths, of_kind.channels)
        labels = mapping.labels
        if labels and labels not in topics:
            raise LogError(f"{place}: labels: there is no topic {shown(labels)} (there are {there})")
        if labels and short_type(topics[labels].kind) != LABELS_TYPE:
            of_type = f"topic {labels} is of type {topics[labels].kind}"
            raise LogError(f"{place}: labels: {of_type}, {LABELS_TYPE} is required")
        asked = [each for source in self._sources.values() for each in source.paths.items()]
        for name, numbers in [*asked, *([(labels, [])] if labels else [])]:
            if name not in self._of_topic:
                self._of_topic[name] = _TopicNumbers(place, topics[name], decoder(topics[name]), faults)
            for path in numbers:
                self._of_topic[name].paths.setdefault(path, len(self._of_topic[name].paths))

    @property
    def names(self) -> frozenset[str]:
        """Topics whose messages are taken."""
        return frozenset(self._of_topic)

    def take(self, topic: str, log_ns: int, content: bytes) -> None:
        """Take a message of one of :attr:`names`, with its log time in ns."""
        self._of_topic[topic].take(log_ns, content)

    def streams(self, start_ns: int | None = None) -> tuple[int, dict[str, Stream]]:
        """Return the stamp in ns at which the time of the streams begins, and the streams.

        That stamp is the first one unless it is given; when repairing the first of those in order.  ``LogError``
        where a topic has no message, topics of a stream have no stamp in common, stamps go back or repeat, a
        channel has nothing finite, or there are fewer than two samples.
        """
        raw = {name: self._raw(name, source) for name, source in self._sources.items()}
        repairs = self._faults.repairs
        if start_ns is None:
            stamps = [stamp_ns for stamp_ns, *_ in raw.values()]
            firsts = [each.min() if repairs is None else each[longest_rise(each)[0]] for each in stamps]
            start_ns = min(map(int, firsts))
        streams = {}
        for name, (stamp_ns, channels, values) in raw.items():
            at = f"{self._place}: stream {name}"
            if stamp_ns.size > 1 and not np.any(stamp_ns):
                raise LogError(f"{at}: all headers are stamped 0; take the log times (time: log)")
            time_s = (stamp_ns - start_ns) / 1e9
            streams[name] = checked_stream(at, time_s, values, channels, repairs=repairs)
        return start_ns, streams

    def labels(self, start_ns: int, streams: Mapping[str, Stream]) -> tuple[Label, ...]:
        """Return the terrain intervals of the topic of labels."""
        texts = self._of_topic[self._mapping.labels].texts
        return label_intervals(sorted(texts, key=lambda each: each[0]), start_ns, streams)

    def _raw(self, name: str, source: _Source) -> tuple[Array, tuple[str, ...], Array]:
        """Return the stamps (n,) in ns, the channels and the values (n, c) of a stream."""
        stream = source.stream
        by_header = (stream.time or self._mapping.time) == "header"
        stamps, values = list[Array](), list[Array]()
        for topic, paths in source.paths.items():
            stamp_ns, numbers = self._of_topic[topic].numbers(paths, by_header=by_header)
            if not stamp_ns.size:
                what = " with any of the joints" if stream.kind == "joints" else ""
                raise LogError(f"{self._place}: topic {shown(topic)} has no message{what}")
            order = np.argsort(stamp_ns, kind="stable") if len(source.paths) > 1 else slice(None)
            stamps.append(stamp_ns[order])
            values.append(numbers[order])
        common = stamps[0]
        if len(stamps) > 1 and stream.join == "previous":
            for i, each in enumerate(stamps[1:], start=1):
                row = np.searchsorted(each, common, side="right") - 1
                values[i] = np.where((row >= 0)[:, None], values[i][np.maximum(row, 0)], np.nan)
        elif len(stamps) > 1:
            for each in stamps[1:]:
                common = np.intersect1d(common, each)
            n_lost = sum(each.size for each in stamps) - common.size * len(stamps)
            if n_lost:
                topics = " and ".join(shown(topic) for topic in source.paths)
                text = f"{name}: {n_lost} messages of {topics} lack one of equal stamp (join: previous)"
                self._faults.found(self._place, UNMATCHED, text, n_lost)
            if not common.size:
                fault = "no two stamps of its topics agree (join: previous)"
                raise LogError(f"{self._place}: stream {name}: {fault}")
            rows = [np.searchsorted(each, common) for each in stamps]
            values = [value[row] for value, row in zip(values, rows, strict=True)]
        channels, joined = source.channels(np.concatenate(values, axis=1))
        if not channels:
            raise LogError(f"{self._place}: topic {shown(stream.topic)} states that it measures nothing")
        return common, channels, joined


def _fields_source(at: str, stream: MessageStream, wheel_radius_m: float | None) -> _Source:
    """Return where the channels of a stream of fields or joints are."""
    by_topic: dict[str, list[str]] = {stream.topic: []}
    for name, channel in stream.channels.items():
        by_topic.setdefault(channel.topic or stream.topic, []).append(name)
        if channel.turns(unit_of(name)) and wheel_radius_m is None:
            missing = "'wheel_radius' is missing, and the robot has no description"
            raise ConfigError(f"{at}: channel {name} is the speed of a joint that turns: {missing}")
    places = [name for names in by_topic.values() for name in names]

    def in_si(values: Array) -> Converted:
        columns = []
        for name, channel in stream.channels.items():
            desired = unit_of(name)
            unit = "1" if desired == "code" else channel.number_unit
            si = channel.si(values[:, places.index(name)], unit)
            columns.append(si * (wheel_radius_m or np.nan) if channel.turns(desired) else si)
        return tuple(stream.channels), np.column_stack(columns)

    paths = {
        topic: [(stream.channels[name].field, stream.channels[name].joint) for name in names]
        for topic, names in by_topic.items()
        if names
    }
    return _Source(stream, paths, in_si)


class _TopicNumbers:
    """Collects the numbers of the messages of a topic, or their texts where no path is asked for.

    ``paths`` has for each number its path and, where its array has a number a joint, the joint's name; an
    entry of ``rows`` has them in that order.
    """

    def __init__(self, place: str, topic: Topic, decode: Callable[[bytes], Any], faults: Faults) -> None:
        self.topic, self.paths = topic, dict[tuple[str, str], int]()
        self.log_ns, self.stamp_ns = list[int](), list[int]()
        self.rows, self.texts = list[list[float]](), list[tuple[int, str]]()
        self._place, self._decode, self._faults = place, decode, faults
        self._numbers: list[Number] | None = None
        self._stamp: list[Number] = []

    def take(self, log_ns: int, content: bytes) -> None:
        try:
            message = self._decode(content)
        except Exception as error:  # whatever a library makes of damaged bytes
            self._damaged(error)
            return
        if not self.paths:
            self.texts.append((log_ns, str(message.data)))
            self._bounded(len(self.texts), MAX_LABELS, "messages")
            return
        if self._numbers is None:
            about = (self.topic.name, short_type(self.topic.kind), message)
            self._numbers = [number_at(*about, *path) for path in self.paths]
            for pair in STAMPS:  # the first of which the message has
                try:
                    self._stamp = self._stamp or [number_at(*about, path) for path in pair]
                except ConfigError:
                    continue
        try:
            row = [float(number(message)) for number in self._numbers]
            seconds, rest = (get(message) for get in self._stamp) if self._stamp else (0, log_ns)
            stamp_ns = int(seconds) * 10**9 + int(rest)
            if abs(stamp_ns) > LATEST_NS:
                raise ValueError("a stamp is beyond what clocks show")
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            self._damaged(error)
            return
        self.rows.append(row)
        self.stamp_ns.append(stamp_ns)
        self.log_ns.append(log_ns)
        self._bounded(len(self.rows) * len(self.paths), MAX_VALUES, "values")

    def _bounded(self, n: int, most: int, what: str) -> None:
        if n > most:
            raise LogError(f"{self._place}: topic {shown(self.topic.name)} has more than {most} {what}")

    def _damaged(self, error: Exception) -> None:
        text = f"topic {shown(self.topic.name)} has a message that is not as defined ({str(error)[:120]})"
        self._faults.found(self._place, DAMAGED_MESSAGE, text)

    def numbers(self, paths: Sequence[tuple[str, str]], *, by_header: bool) -> tuple[Array, Array]:
        """Return stamps (n,) in ns, and numbers (n, k) of some paths, in the order of log times."""
        order = np.argsort(np.array(self.log_ns, dtype=np.int64), kind="stable")
        stamp_ns = np.array(self.stamp_ns if by_header else self.log_ns, dtype=np.int64)[order]
        values = np.array(self.rows, dtype=np.float64).reshape(len(order), len(self.paths))
        values = values[order][:, [self.paths[path] for path in paths]]
        if any(joint for _, joint in paths):  # a robot may send its joints in several messages
            known = np.isfinite(values).any(axis=1)
            stamp_ns, values = stamp_ns[known], values[known]
        return stamp_ns, values
