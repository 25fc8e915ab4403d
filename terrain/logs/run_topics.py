"""A run as topics: names and types of its streams, its document, and messages as rows of numbers.

``/terrain/run`` holds JSON in a ``std_msgs/String``: what ``run.json`` of a run folder states, and of each
stream its topic and the channel of each field; the last such message of a file is the one that counts.  A
stream's messages have a header, ``time_s`` as it is in the run, and a field a channel; the stamp of the
header is ``time_s`` in whole nanoseconds.  All messages of a stream have one length, so that an array of
records is both their encoder and their decoder.
"""

from __future__ import annotations

import json
import re
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AliasChoices, BaseModel, ConfigDict, Field

from terrain.errors import DataError, LogError
from terrain.files.documents import accepted, parse_json
from terrain.files.names import plain_name, shown
from terrain.logs.mapping import DAMAGED_MESSAGE, Faults, Topic
from terrain.logs.run_folders import MAX_STREAMS, MAY_BE_UNKNOWN, LabelEntry, RunHead, label_changes
from terrain.logs.samples import DEAD_CHANNEL, checked_stream
from terrain.logs.schema import unit_of
from terrain.records import Array, Label, RunLog, Stream

PREFIX = "/terrain/"
RUN_TOPIC, LABEL_TOPIC, WINDOW_TOPIC = "/terrain/run", "/terrain/label", "/terrain/window"
RESERVED = tuple(topic.removeprefix(PREFIX) for topic in (RUN_TOPIC, LABEL_TOPIC, WINDOW_TOPIC))
PACKAGE = "terrain_msgs"

STRING, STRING_TEXT = "std_msgs/msg/String", "string data\n"
HEADER_TEXT = f"""\
{"=" * 80}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

TIME_FIELD = "time_s"

LATEST_S = 2**31 - 1  #: Latest stamp of a header in s: its seconds have 32 bits

SHORT_STREAM = "streams with fewer than 2 samples"
DEAD_STREAM = "streams with nothing finite"
APART = "streams apart in time"

DECIDED = ("commands", "control")  #: Streams that a controller writes; sensors have precedence over them


class StreamTopic(BaseModel):
    """A stream as a topic: its name and type, and the channel of each field."""

    model_config = ConfigDict(frozen=True)

    topic: str
    kind: str = Field(validation_alias=AliasChoices("type", "kind"), serialization_alias="type")
    fields: Annotated[dict[str, str], Field(min_length=1)]


class Messages(NamedTuple):
    """Messages of a topic: its name and type, the text that defines it, log times (n,) in ns, and contents."""

    topic: str
    kind: str
    definition: str
    log_ns: Array
    contents: list[bytes]


def check_recordable(channels: Mapping[str, Sequence[str]]) -> None:
    """Raise ``LogError`` where streams of sensors have names that a recording cannot have."""
    for name, each in channels.items():
        if not plain_name(name) or name in DECIDED:
            raise LogError(f"stream {name!r} cannot be recorded as a sensor's")
        if not each or len(set(each)) < len(each) or TIME_FIELD in each:
            raise LogError(f"stream {name!r}: channels {', '.join(each)!r} are no list of different names")
        for channel in each:
            unit_of(channel)


def stream_topic(stream: str, channels: Sequence[str], taken: Iterable[StreamTopic] = ()) -> StreamTopic:
    """Return the topic of a stream beside the run's others; names that ROS does not accept are replaced.

    Examples
    --------
    >>> stream_topic("imu", ("gyro_z_radps",))
    StreamTopic(topic='/terrain/imu', kind='terrain_msgs/msg/Imu', fields={'gyro_z_radps': 'gyro_z_radps'})
    """

    def accepted_names(names: Iterable[str], fallback: str, reserved: Iterable[str]) -> list[str]:
        """Return a name for each, as ROS accepts them: lower-case letters, digits and single underlines."""
        used, plain_names = {name.replace("_", "") for name in reserved}, []
        for number, name in enumerate(names):
            plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
            plain = plain if re.match(r"[a-z]", plain) else f"{fallback}_{number}"
            while plain.replace("_", "") in used:
                plain = f"{plain}_{number}"
            used.add(plain.replace("_", ""))
            plain_names.append(plain)
        return plain_names

    others = [each.topic.removeprefix(PREFIX) for each in taken]
    (name,) = accepted_names([stream], f"stream_{len(others)}", [*RESERVED, *others])
    fields = dict(zip(accepted_names(channels, "channel", (TIME_FIELD, "header")), channels, strict=True))
    kind = f"{PACKAGE}/msg/{''.join(part.capitalize() for part in name.split('_'))}"
    return StreamTopic(topic=PREFIX + name, kind=kind, fields=fields)


class RunDocument(RunHead):
    """What a message of :data:`RUN_TOPIC` states: what a run does, and of each stream its topic.

    ``live`` is that of a run that was recorded as it came.
    """

    version: Literal[1] = 1
    live: bool = False
    streams: Annotated[dict[str, StreamTopic], Field(min_length=1, max_length=MAX_STREAMS)]


def string_of(place: str, message: bytes) -> str:
    """Return the text of a message of ``std_msgs/String``."""
    end = 8 + int.from_bytes(message[4:8], "little")
    try:
        if message[:2] != b"\0\1" or not 8 < end <= len(message):
            raise ValueError("has another length than it states")
        return message[8 : end - 1].decode()
    except ValueError as error:
        raise LogError(f"{place}: has a message that is no text ({error})") from error


def stamps_ns(time_s: Array | Sequence[float], origin_s: float) -> Array:
    """Return times in whole nanoseconds since an origin."""
    return np.asarray(np.rint((np.asarray(time_s) - origin_s) * 1e9)).astype(np.int64)


def _record(n_channels: int) -> np.dtype[Any]:
    """Return a message of a stream as it lies in a file: a header with an empty frame, and its numbers."""
    header = [("encapsulation", "u1", 4), ("sec", "<i4"), ("nanosec", "<u4"), ("frame_bytes", "<u4")]
    return np.dtype([*header, ("frame_and_padding", "u1", 4), ("numbers", "<f8", (1 + n_channels,))])


def text_messages(
    topic: str, time_s: Array | Sequence[float], texts: Sequence[str], origin_s: float
) -> Messages:
    """Return texts at times of a run as messages; times outside what stamps can be are its ends."""
    known_s = np.clip(np.nan_to_num(time_s, nan=origin_s), origin_s, origin_s + LATEST_S)
    coded = [text.encode() + b"\0" for text in texts]
    contents = [struct.pack("<4BI", 0, 1, 0, 0, len(each)) + each for each in coded]
    return Messages(topic, STRING, STRING_TEXT, stamps_ns(known_s, origin_s), contents)


def stream_messages(
    topic: StreamTopic,
    time_s: Array | Sequence[float],
    values: Array | Sequence[Sequence[float]],
    origin_s: float = 0.0,
) -> Messages:
    """Return samples (n,) and (n, c) of a stream, in the order of its topic's fields, as messages.

    ``origin_s`` is the time on the clock of the run that is stamped 0.
    """
    numbers = np.asarray(values, dtype=float)
    log_ns = stamps_ns(time_s, origin_s)
    records = np.zeros(len(log_ns), dtype=_record(numbers.shape[1]))
    records["encapsulation"][:, 1] = 1
    records["sec"], records["nanosec"] = log_ns // 10**9, log_ns % 10**9
    records["frame_bytes"] = 1
    records["numbers"][:, 0], records["numbers"][:, 1:] = time_s, numbers
    lines = ["std_msgs/Header header", *(f"float64 {field}" for field in (TIME_FIELD, *topic.fields))]
    definition = "\n".join(lines) + "\n" + HEADER_TEXT
    return Messages(topic.topic, topic.kind, definition, log_ns, [record.tobytes() for record in records])


def origin_of(run: RunLog) -> float:
    """Return the time of a run that is stamped 0: 0, where stamps allow it.

    ``DataError`` where the run is longer than stamps can distinguish, 68 years.
    """
    first_s = min(float(stream.time_s[0]) for stream in run.streams.values())
    last_s = max(float(stream.time_s[-1]) for stream in run.streams.values())
    if last_s - first_s > LATEST_S - 1:
        most = f"stamps have {LATEST_S} s at most"
        raise DataError(f"run {shown(run.run_id)} is {last_s - first_s:g} s long, {most}")
    return 0.0 if first_s >= 0.0 and last_s <= LATEST_S else float(np.floor(first_s))


class RunRecorder:
    """A run that is written message by message: topics as those of a run that was exported.

    ``writer`` has ``write(messages, log_ns, content)``, ``flush()`` and ``finish()``.  After :meth:`flush` all that was
    appended is in the file; if the process is killed then, readers read it.
    ``origin_s`` is the time on the clock of the run that is stamped 0; stamps reach 68 years from there.
    """

    def __init__(self, writer: Any, head: RunHead, origin_s: float = 0.0) -> None:
        self._writer, self._head, self._origin_s = writer, head, origin_s
        self._topics: dict[str, StreamTopic] = {}
        self._is_described, self._last_ns = False, 0

    def append(
        self,
        stream: str,
        channels: Sequence[str],
        time_s: Array | Sequence[float],
        values: Array | Sequence[Sequence[float]],
    ) -> None:
        """Append samples (n,) and (n, c) of a stream; one may come later than samples of others."""
        if stream not in self._topics:
            self._topics[stream] = stream_topic(stream, channels, self._topics.values())
            self._is_described = False
        messages = stream_messages(self._topics[stream], time_s, values, self._origin_s)
        if not self._is_described and len(messages.log_ns):
            self._describe(int(messages.log_ns[0]))
        self._write(messages)

    def append_text(self, topic: str, time_s: float, text: str) -> None:
        """Append a text, as of :data:`WINDOW_TOPIC`."""
        self._write(text_messages(topic, [time_s], [text], self._origin_s))

    def _describe(self, log_ns: int) -> None:
        document = _document(self._head, self._topics, live=True)
        self._write(text_messages(RUN_TOPIC, [0.0], [document], 0.0)._replace(log_ns=np.array([log_ns])))
        self._is_described = True

    def _write(self, messages: Messages) -> None:
        for log_ns, content in zip(messages.log_ns.tolist(), messages.contents, strict=True):
            self._writer.write(messages, log_ns, content)
            self._last_ns = max(self._last_ns, log_ns)

    def flush(self) -> None:
        """Give all that was appended to the system."""
        self._writer.flush()

    def finish(self, labels: Iterable[Label] = (), dropped: Mapping[str, int] | None = None) -> None:
        """Write the end of the file, which stays open: labels, and counts by kind of what was not recorded."""
        entries = [LabelEntry(**label._asdict()) for label in labels]
        counts = dict(sorted((dropped or {}).items()))
        self._head = self._head.model_copy(update={"labels": entries, "dropped": counts})
        self._describe(self._last_ns)
        self._writer.finish()


def _document(head: RunHead, topics: Mapping[str, StreamTopic], *, live: bool = False) -> str:
    document = RunDocument(**dict(head), live=live, streams=dict(topics))
    return json.dumps(document.model_dump(by_alias=True), allow_nan=False)


def run_messages(run: RunLog, windows: Sequence[tuple[float, str]] = ()) -> Iterator[Messages]:
    """Yield the topics of a run: its document, its labels, what was recorded with it, and its streams.

    ``windows`` are time of the end and description of each window that was recorded with it.
    """
    origin_s = origin_of(run)
    start_s = min(float(stream.time_s[0]) for stream in run.streams.values())
    topics: dict[str, StreamTopic] = {}
    for name, stream in run.streams.items():
        topics[name] = stream_topic(name, stream.channels, topics.values())
    yield text_messages(RUN_TOPIC, [start_s], [_document(RunHead.of(run), topics)], origin_s)
    changes = label_changes(run.labels)
    for topic, texts in ((LABEL_TOPIC, changes), (WINDOW_TOPIC, windows)):
        if texts:
            times_s, contents = zip(*texts, strict=True)
            yield text_messages(topic, times_s, contents, origin_s)
    for name, stream in run.streams.items():
        values = np.column_stack([stream.channel(channel) for channel in topics[name].fields.values()])
        yield stream_messages(topics[name], stream.time_s, values, origin_s)


def read_document(place: str, text: str, topics: Mapping[str, Topic]) -> RunDocument:
    """Return the document of a run in a file of messages, of its text and the topics of the file by name.

    ``LogError`` where the document is damaged, or the file lacks a topic of a stream, or has one of another type or
    with other fields.
    """
    place = f"{place}: {RUN_TOPIC}"
    try:
        content = parse_json(text)
    except ValueError as error:
        raise LogError(f"{place}: is damaged ({error})") from error
    document = accepted(RunDocument, content, place, LogError, "is damaged")
    for name, each in document.streams.items():
        there = topics.get(each.topic)
        if there is None or there.kind != each.kind:
            raise LogError(f"{place}: stream {shown(name)} has no topic {shown(each.topic)} of its type")
        for channel in each.fields.values():
            unit_of(channel)
        own = re.findall(r"^float64 (\w+)", there.definition.partition("=" * 80)[0], re.MULTILINE)
        differ = there.definition and own != [TIME_FIELD, *each.fields]
        if there.encoding != "cdr" or differ or len(set(each.fields.values())) != len(each.fields):
            raise LogError(f"{place}: topic {shown(each.topic)} has not the fields of its stream")
    return document


def run_of(
    place: str, document: RunDocument, messages: Mapping[str, Sequence[bytes]], faults: Faults
) -> RunLog:
    """Return the run of a document.

    What was recorded as it came is read as a repairing reader does: rows that go back in time, channels
    without a value, streams of fewer than two samples and streams that no instant has in common with the
    others are dropped and counted.

    ``messages`` are those of each topic, in the order of the file; ``LogError`` where a stream or a label is broken
    and ``faults`` refuses that, or no stream is left.
    """
    place = f"{place}: {RUN_TOPIC}"
    dropped = Counter(document.dropped)
    streams: dict[str, Stream] = {}
    for name, topic in document.streams.items():
        record, all_of = _record(len(topic.fields)), messages.get(topic.topic, ())
        whole = [each for each in all_of if len(each) == record.itemsize and each[:4] == b"\0\1\0\0"]
        if damaged := len(all_of) - len(whole):
            text = f"topic {shown(topic.topic)} has {damaged} messages that are not as defined"
            faults.found(place, DAMAGED_MESSAGE, text, damaged)
        numbers = np.frombuffer(b"".join(whole), dtype=record)["numbers"]
        try:
            stream = checked_stream(
                f"{place}: stream {shown(name)}",
                numbers[:, 0],
                numbers[:, 1:],
                tuple(topic.fields.values()),
                repairs=dropped if document.live else faults.repairs,
                unknown_is_a_value=document.live or name in MAY_BE_UNKNOWN,
            )
        except LogError:
            if not document.live:
                raise
            dropped[SHORT_STREAM] += 1
            continue
        alive = np.isfinite(stream.values).any(axis=0)
        if document.live and name != "control" and not alive.all():  # figures of a decision may be unknown
            dropped[DEAD_CHANNEL] += int((~alive).sum())
            if not alive.any():
                dropped[DEAD_STREAM] += 1
                continue
            channels = tuple(stream.channels[i] for i in np.flatnonzero(alive))
            stream = Stream(stream.time_s, stream.values[:, alive], channels)
        streams[name] = stream
    if document.live:  # the longest streams that have an instant in common, as the readers require
        start_s, end_s, together = -np.inf, np.inf, dict[str, Stream]()
        for name in sorted(streams, key=lambda name: (name in DECIDED, -streams[name].duration_s)):
            latest_s = max(start_s, streams[name].time_s[0])
            earliest_s = min(end_s, streams[name].time_s[-1])
            if latest_s < earliest_s:
                start_s, end_s, together[name] = latest_s, earliest_s, streams[name]
        if apart := len(streams) - len(together):
            dropped[APART] += apart
        streams = {name: stream for name, stream in streams.items() if name in together}
        if not streams:
            raise LogError(f"{place}: holds no stream of two samples or more")
    dropped.update(faults.repairs or {})
    return document.run(place, streams, dropped)
