"""A run's own topics in a bag: names and types of its streams, and the run that they are.

``/terrain/run`` has one message, JSON in a ``std_msgs/String``: what ``run.json`` of a run folder states, and
of each stream its topic and the channel of each field.  A stream's messages have a header, ``time_s`` as it
is in the run, and a field a channel; the stamp of the header is ``time_s`` in whole nanoseconds.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from pipelines.bags.collect import Collector, Numbers
from pipelines.messages.definitions import Definition, known_text, parse_definition
from pipelines.messages.storage import Faults, Topic
from terrain.errors import LogError
from terrain.files.documents import parse_json
from terrain.files.names import shown
from terrain.logs.log_files import checked_names
from terrain.logs.read import MAX_STREAMS, MAY_BE_UNKNOWN, read_labels
from terrain.logs.samples import checked_stream, refuse_apart
from terrain.logs.schema import unit_of
from terrain.records import RunLog, Stream

RUN_TOPIC = "/terrain/run"
LABEL_TOPIC = "/terrain/label"
WINDOW_TOPIC = "/terrain/window"
PREFIX = "/terrain/"
PACKAGE = "terrain_msgs"

STRING = "std_msgs/msg/String"

TIME_FIELD = "time_s"

VERSION = 1


class StreamTopic(NamedTuple):
    """A stream as a topic: its name and type, and the channel of each field."""

    topic: str
    kind: str
    fields: Mapping[str, str]


def stream_topics(streams: Mapping[str, Stream]) -> dict[str, StreamTopic]:
    """Return the topic of each stream; names that ROS does not accept are replaced.

    Examples
    --------
    >>> stream_topics({"imu": Stream([0.0], [[1.0]], ("gyro_z_radps",))})["imu"]
    StreamTopic(topic='/terrain/imu', kind='terrain_msgs/msg/Imu', fields={'gyro_z_radps': 'gyro_z_radps'})
    """
    reserved = [topic.removeprefix(PREFIX) for topic in (RUN_TOPIC, LABEL_TOPIC, WINDOW_TOPIC)]
    names = _unique(streams, "stream", reserved)
    found = {}
    for stream, name in zip(streams, names, strict=True):
        channels = streams[stream].channels
        fields = _unique(channels, "channel", (TIME_FIELD, "header"))
        kind = "".join(part.capitalize() for part in name.split("_"))
        found[stream] = StreamTopic(
            PREFIX + name, f"{PACKAGE}/msg/{kind}", dict(zip(fields, channels, strict=True))
        )
    return found


def _unique(names: Iterable[str], fallback: str, reserved: Iterable[str]) -> list[str]:
    """Return a name for each, as ROS accepts them: lower-case letters, digits and single underlines."""
    taken = set(reserved)
    found = []
    for number, name in enumerate(names):
        plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
        plain = plain if re.match(r"[a-z]", plain) else f"{fallback}_{number}"
        while plain in taken or plain.replace("_", "") in {each.replace("_", "") for each in taken}:
            plain = f"{plain}_{number}"
        taken.add(plain)
        found.append(plain)
    return found


def message_text(fields: Iterable[str]) -> str:
    """Return the definition of the messages of a stream, with that of its header."""
    lines = ["std_msgs/Header header", f"float64 {TIME_FIELD}", *(f"float64 {field}" for field in fields)]
    header = known_text("std_msgs/msg/Header")
    return "\n".join([*lines, "=" * 80, "MSG: std_msgs/Header", header])


def run_document(run: RunLog, topics: Mapping[str, StreamTopic]) -> str:
    """Return what the message of :data:`RUN_TOPIC` states."""
    return json.dumps(
        {
            "version": VERSION,
            "run_id": run.run_id,
            "robot": run.robot,
            "session": run.session,
            "filter": run.filter,
            "source": run.source,
            "labels": [label._asdict() for label in run.labels],
            "streams": {
                name: {"topic": each.topic, "type": each.kind, "fields": dict(each.fields)}
                for name, each in topics.items()
            },
            "dropped": dict(sorted(run.dropped.items())),
        },
        allow_nan=False,
    )


class ExportedRun:
    """The run of a bag with :data:`RUN_TOPIC`: its document first, then the numbers of its streams.

    Parameters
    ----------
    place : of the bag, as messages name it
    text : of the document

    Raises
    ------
    LogError
        if the document is damaged.
    """

    def __init__(self, place: str, text: str) -> None:
        self._place = f"{place}: {RUN_TOPIC}"
        try:
            document = parse_json(text)
            if document["version"] != VERSION:
                raise LogError(f"{self._place}: version {shown(document['version'])} is unknown")
            self._topics = {
                str(name): StreamTopic(str(each["topic"]), str(each["type"]), _texts(each["fields"]))
                for name, each in document["streams"].items()
            }
            self._head = {
                key: str(document[key]) for key in ("run_id", "robot", "session", "filter", "source")
            }
            self._dropped = {str(kind): int(n) for kind, n in document["dropped"].items()}
            self._labels = read_labels(self._place, document["labels"])
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise LogError(f"{self._place}: is damaged ({type(error).__name__}: {error})") from error
        if not 0 < len(self._topics) <= MAX_STREAMS:
            raise LogError(f"{self._place}: lists {len(self._topics)} streams, 1 to {MAX_STREAMS} are read")

    def collectors(self, faults: Faults, topics: Mapping[str, Topic]) -> dict[str, Collector]:
        """Return what collects the numbers of each stream.

        Raises
        ------
        LogError
            if a topic is missing, or not of its type.
        """
        found = {}
        for name, each in self._topics.items():
            if each.topic not in topics or topics[each.topic].kind != each.kind:
                raise LogError(
                    f"{self._place}: stream {shown(name)} has no topic {shown(each.topic)} of its type"
                )
            for channel in each.fields.values():
                unit_of(channel)
            paths = [(field, "") for field in (TIME_FIELD, *each.fields)]
            definition = self._definition(topics[each.topic], each)
            found[name] = Collector(self._place, each.topic, definition, paths, False, faults)
        return found

    def _definition(self, topic: Topic, stream: StreamTopic) -> Definition:
        """Return the definition that the file holds, which must be the one that such a stream has."""
        own = parse_definition(stream.kind, message_text(stream.fields))
        if topic.encoding != "cdr" or (
            topic.definition and parse_definition(topic.kind, topic.definition) != own
        ):
            raise LogError(f"{self._place}: topic {shown(topic.name)} has not the fields of its stream")
        return own

    def run(self, numbers: Mapping[str, Numbers], repairs: Any) -> RunLog:
        """Return the run.

        Parameters
        ----------
        numbers : of each stream
        repairs : counts by kind of what is dropped instead of refused; None refuses

        Raises
        ------
        LogError
            if a stream is broken.
        """
        streams = {}
        for name, topic in self._topics.items():
            values = numbers[name].values
            streams[name] = checked_stream(
                f"{self._place}: stream {shown(name)}",
                values[:, 0],
                values[:, 1:],
                tuple(topic.fields.values()),
                row_of=lambda index: index + 1,
                repairs=repairs,
                unknown_is_a_value=name in MAY_BE_UNKNOWN,
            )
        refuse_apart(self._head["run_id"], streams)
        counts = dict(self._dropped)
        for kind, n in (repairs or {}).items():
            counts[kind] = counts.get(kind, 0) + n
        run = RunLog(
            self._head["run_id"],
            self._head["robot"],
            streams,
            self._labels,
            source=self._head["source"],
            dropped=counts,
            session=self._head["session"],
            filter=self._head["filter"],
        )
        return checked_names(self._place, run)


def _texts(fields: Mapping[str, Any]) -> dict[str, str]:
    found = {str(field): str(channel) for field, channel in fields.items()}
    if not found or len(set(found.values())) != len(found):
        raise ValueError("the fields of a stream are no list of channels")
    return found


def stamps_ns(time_s: np.typing.NDArray[np.float64], origin_s: float) -> np.typing.NDArray[np.int64]:
    """Return times in whole nanoseconds since an origin.

    Examples
    --------
    >>> stamps_ns(np.array([-0.5, 0.25]), -1.0)
    array([ 500000000, 1250000000])
    """
    return np.asarray(np.rint((time_s - origin_s) * 1e9)).astype(np.int64)
