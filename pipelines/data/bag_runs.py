"""Bags as runs, one a bag: by a mapping, by standard types, or as they were exported or recorded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipelines.data.bag_files import (
    Bag,
    decoder_of,
    find_bags,
    messages_of,
    open_bag,
    topics_of,
)
from pipelines.data.recorded_windows import RecordedWindow, window_of_text
from pipelines.data.standard_messages import KINDS, Converted
from terrain.errors import ConfigError, LogError
from terrain.files.names import shown
from terrain.logs.borealtc import whole_run_label
from terrain.logs.faults import DAMAGED_MESSAGE, Faults, Topic
from terrain.logs.log_files import checked_names, short_name
from terrain.logs.message_numbers import Number, number_at, stamp_at
from terrain.logs.parquet_file import MAX_VALUES
from terrain.logs.run_topics import RUN_TOPIC, STRING, WINDOW_TOPIC, RunDocument
from terrain.logs.samples import checked_stream, longest_rise, refuse_apart
from terrain.logs.schema import UNIT_OFFSETS, UNIT_SCALES, unit_of
from terrain.logs.topic_mapping import (
    LABELS_TYPE,
    TYPES,
    Channel,
    StreamMapping,
    by_radius,
    check_stream,
    described,
    joint_unit,
    load_mapping,
    short_type,
    standard_mapping,
)
from terrain.logs.topic_mapping import Mapping as TopicMapping
from terrain.records import Array, Label, RunLog, Stream
from terrain.robots import Robot, packaged_robot

MAX_LABELS = 1_000_000
"""Messages with terrains; ten a second are 28 hours."""

LATEST_NS = 2**62
"""Latest stamp that a message may have."""

UNMATCHED = "messages without one of equal stamp on the other topics"


def find_runs(
    place: Path, mapping: str | Path | None, robot: Robot | None, bags: Sequence[Path] | None = None
) -> list[Callable[..., RunLog]]:
    """Return a function for each bag under a folder, which reads it and takes ``repair=``.

    Parameters
    ----------
    place : folder of bags, the folder of a bag or a file; one in a folder of its own is labelled with that
        folder's name as its terrain
    mapping : YAML file (:mod:`terrain.logs.topic_mapping`); by the types of the topics by default
    robot : of all runs that do not name theirs; that of the mapping by default
    bags : under the place, where they are known already

    Raises
    ------
    ConfigError
        if the mapping is not accepted.
    """
    found = find_bags(place) if bags is None else bags
    read_mapping = None if mapping is None else load_mapping(mapping)
    return [partial(read_run, path, place, read_mapping, robot) for path in found]


def read_run(
    path: Path, folder: Path, mapping: TopicMapping | None, robot: Robot | None, *, repair: bool = False
) -> RunLog:
    """Return the run of a bag; its time begins at the first stamp of what is read.

    Parameters
    ----------
    path, folder : the bag, and the folder that its name counts from
    mapping : by the types of its topics by default; an export needs none
    robot : of the run, where the bag does not name it
    repair : drop and count what is damaged or missing, which a strict read refuses

    Raises
    ------
    LogError
        if the bag cannot be read, is damaged, or lacks a topic of the mapping.
    ConfigError
        if the mapping does not fit the messages, or no robot is named.
    """
    faults = Faults(Counter() if repair else None)
    bag, place = open_bag(path), short_name(path)
    topics = topics_of(bag)
    exported = topics.get(RUN_TOPIC)
    if mapping is None and exported is not None and exported.kind == STRING:
        return _exported_run(bag, place, topics, faults, repair=repair)
    if not topics:
        raise LogError(f"{place}: has no topic")
    mapping = standard_mapping(place, list(topics.values())) if mapping is None else mapping
    name = robot.name if robot is not None else mapping.robot
    if not name:
        raise ConfigError(f"{place}: a bag does not name its robot: give it by --robot or in the mapping")
    radius_m = _wheel_radius_m(mapping, robot)
    _check_topics(place, mapping, topics, radius_m)
    found = _read_topics(bag, place, topics, mapping, faults)
    raw = {
        stream: _raw_stream(place, stream, each, topics, found, mapping.time, radius_m, faults)
        for stream, each in mapping.streams.items()
    }
    start_ns = start_of([each.stamp_ns for each in raw.values()], faults.repairs)
    streams = {stream: _stream(place, stream, each, start_ns, faults.repairs) for stream, each in raw.items()}
    parts = _parts(path, folder)
    refuse_apart("_".join(parts), streams)
    if mapping.labels:
        texts = sorted(found[mapping.labels].texts, key=lambda each: each[0])
        intervals = label_intervals(texts, start_ns, streams)
    else:
        terrain = mapping.terrain or (parts[0] if len(parts) > 1 else "")
        intervals = (whole_run_label(streams, terrain),) if terrain else ()
    run = RunLog(
        "_".join(parts), name, streams, intervals, source=f"{place}, a bag", dropped=faults.repairs or {}
    )
    return checked_names(place, run)


def read_stream(
    path: Path,
    name: str,
    described_stream: Mapping[str, object],
    repairs: Counter[str] | None,
    wheel_radius_m: float | None = None,
) -> Stream:
    """Return one stream of a bag that is joined with other files: its times are seconds since 1970.

    Parameters
    ----------
    path : of the bag
    name : of the stream
    described_stream : its keys, as in a mapping of topics
    repairs : counts by kind of what is dropped; None refuses
    wheel_radius_m : of the robot; None where unknown

    Raises
    ------
    LogError, ConfigError
        as :func:`read_run`.
    """
    stream = check_stream(f"stream {name}", described_stream)
    mapping = TopicMapping(streams={name: stream})
    bag, place, faults = open_bag(path), short_name(path), Faults(repairs)
    topics = topics_of(bag)
    _check_topics(place, mapping, topics, wheel_radius_m)
    found = _read_topics(bag, place, topics, mapping, faults)
    raw = _raw_stream(place, name, stream, topics, found, mapping.time, wheel_radius_m, faults)
    return _stream(place, name, raw, 0, repairs)


def _exported_run(
    bag: Bag, place: str, topics: Mapping[str, Topic], faults: Faults, *, repair: bool
) -> RunLog:
    """Return the run that was exported or recorded; a recording that ends early is read as far as it goes."""
    prefix = RUN_TOPIC.rpartition("/")[0]
    names = frozenset(name for name in topics if name.startswith(prefix))
    counted = Faults(Counter())
    messages: dict[str, list[bytes]] = {}
    n_bytes = 0
    for topic, _, content in messages_of(bag, names, counted):
        messages.setdefault(topic, []).append(content)
        n_bytes += len(content)
        if n_bytes > 8 * MAX_VALUES:
            raise LogError(f"{place}: has more than {MAX_VALUES} values")
    if not messages.get(RUN_TOPIC):
        raise LogError(f"{place}: {RUN_TOPIC} has no message")
    document = RunDocument(place, _text(place, topics[RUN_TOPIC], messages[RUN_TOPIC][-1]))
    document.check(topics)
    if document.head.live or repair:
        return document.run(messages, counted)
    if counted.repairs:  # a strict read finds the fault again, and says where it is
        for _ in messages_of(bag, names, faults):
            pass
    return document.run(messages, faults)


def _text(place: str, topic: Topic, content: bytes) -> str:
    try:
        message = decoder_of(place, topic, "")(content)
    except Exception as error:  # whatever a library makes of damaged bytes
        raise LogError(f"{place}: topic {shown(topic.name)} has a message that is no text") from error
    return str(message.data)


def recorded_windows(path: Path) -> tuple[str, list[RecordedWindow]] | None:
    """Return the id of the run of a bag and the windows that were recorded with it; None where none were.

    Raises
    ------
    LogError
        if the bag cannot be read, or a window is damaged.
    """
    bag, place = open_bag(path), short_name(path)
    topics = topics_of(bag)
    if not {WINDOW_TOPIC, RUN_TOPIC} <= set(topics):
        return None
    texts: dict[str, list[str]] = {WINDOW_TOPIC: [], RUN_TOPIC: []}
    for topic, _, content in messages_of(bag, frozenset(texts), Faults(Counter())):
        texts[topic].append(_text(place, topics[topic], content))
    if not texts[RUN_TOPIC]:
        return None
    run_id = RunDocument(place, texts[RUN_TOPIC][-1]).head.run_id
    return run_id, [window_of_text(place, text) for text in texts[WINDOW_TOPIC]]


def label_intervals(
    texts: Sequence[tuple[int, str]], start_ns: int, streams: Mapping[str, Stream]
) -> tuple[Label, ...]:
    """Return the terrain intervals of a run from the terrains as they change.

    Parameters
    ----------
    texts : log time in ns and terrain, in order; an empty text ends a terrain
    start_ns : of the run
    streams : of the run; the last terrain lasts until their end

    Examples
    --------
    >>> imu = Stream([0.0, 1.0, 2.0], [[0.0]] * 3, ("gyro_z_radps",))
    >>> label_intervals([(10**9, "ICE"), (10**9 + 5 * 10**8, "ICE"), (2 * 10**9, "")], 0, {"imu": imu})
    (Label(start_s=1.0, end_s=2.0, terrain='ICE'),)
    """
    end_s = whole_run_label(dict(streams), "all").end_s
    changes = [((log_ns - start_ns) / 1e9, terrain.strip()) for log_ns, terrain in texts]
    labels: list[Label] = []
    for (begin_s, terrain), (stop_s, _) in pairwise([*changes, (end_s, "")]):
        stop_s = min(stop_s, end_s)
        if not terrain or stop_s <= begin_s:
            continue
        if labels and labels[-1].terrain == terrain and labels[-1].end_s == begin_s:
            begin_s = labels.pop().start_s
        labels.append(Label(begin_s, stop_s, terrain))
    return tuple(labels)


def _check_topics(
    place: str, mapping: TopicMapping, topics: Mapping[str, Topic], wheel_radius_m: float | None
) -> None:
    """Refuse a mapping of topics that a bag lacks or that are of another type, and speeds without a radius."""
    there = described([*topics.values()])
    for name, stream in mapping.streams.items():
        for topic in (stream.topic, *(channel.topic for channel in stream.channels.values())):
            if topic and topic not in topics:
                raise LogError(
                    f"{place}: stream {name}: there is no topic {shown(topic)} (there are {there})"
                )
        kind = topics[stream.topic].kind
        if stream.kind != "fields" and short_type(kind) not in TYPES[stream.kind]:
            raise LogError(
                f"{place}: stream {name}: topic {stream.topic} is of type {kind}, "
                f"kind {stream.kind!r} is {' or '.join(TYPES[stream.kind])} (there are {there})"
            )
        for channel, entry in stream.channels.items():
            turns = stream.kind == "joints" and by_radius(entry, unit_of(channel))
            if turns and stream.wheel_radius is None and wheel_radius_m is None:
                raise ConfigError(
                    f"{place}: stream {name}: channel {channel} is the speed of a joint that turns: "
                    f"'wheel_radius' is missing, and the robot has no description"
                )
    if not mapping.labels:
        return
    if mapping.labels not in topics:
        raise LogError(f"{place}: labels: there is no topic {shown(mapping.labels)} (there are {there})")
    if short_type(topics[mapping.labels].kind) != LABELS_TYPE:
        raise LogError(
            f"{place}: labels: topic {mapping.labels} is of type {topics[mapping.labels].kind}, "
            f"{LABELS_TYPE} is required"
        )


def _wheel_radius_m(mapping: TopicMapping, robot: Robot | None) -> float | None:
    try:
        return (packaged_robot(mapping.robot) if robot is None else robot).wheel_radius_m
    except ConfigError:
        return None


def _parts(path: Path, folder: Path) -> tuple[str, ...]:
    """Return the names that a run is called by: those of the folders down to its bag, and the bag's own."""
    if path == folder:
        path = path.resolve()
        return (path.stem if path.is_file() else path.name,)
    within = path.relative_to(folder)
    return (within.with_suffix("") if path.is_file() else within).parts


class _TopicReader:
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
        self._stamp: tuple[Number, Number] | None = None

    def take(self, log_ns: int, content: bytes) -> None:
        try:
            message = self._decode(content)
        except Exception as error:  # whatever a library makes of damaged bytes
            self._damaged(error)
            return
        if not self.paths:
            if len(self.texts) >= MAX_LABELS:
                raise LogError(
                    f"{self._place}: topic {shown(self.topic.name)} has more than {MAX_LABELS} messages"
                )
            self.texts.append((log_ns, str(message.data)))
            return
        if self._numbers is None:
            about = (self.topic.name, short_type(self.topic.kind), message)
            self._numbers = [number_at(*about, *path) for path in self.paths]
            self._stamp = stamp_at(*about)
        try:
            row = [float(number(message)) for number in self._numbers]
            seconds, rest = (0, log_ns) if self._stamp is None else (get(message) for get in self._stamp)
            stamp_ns = int(seconds) * 10**9 + int(rest)
            if abs(stamp_ns) > LATEST_NS:
                raise ValueError("a stamp is beyond what clocks show")
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            self._damaged(error)
            return
        self.rows.append(row)
        self.stamp_ns.append(stamp_ns)
        self.log_ns.append(log_ns)
        if len(self.rows) * len(self.paths) > MAX_VALUES:
            raise LogError(f"{self._place}: topic {shown(self.topic.name)} has more than {MAX_VALUES} values")

    def _damaged(self, error: Exception) -> None:
        text = f"topic {shown(self.topic.name)} has a message that is not as defined ({str(error)[:120]})"
        self._faults.found(self._place, DAMAGED_MESSAGE, text)

    def numbers(self, paths: Sequence[tuple[str, str]], *, by_header: bool) -> tuple[Array, Array]:
        """Return stamps (n,) in ns, and numbers (n, k) of some paths, in the order of log times."""
        order = np.argsort(np.array(self.log_ns, dtype=np.int64), kind="stable")
        stamp_ns = np.array(self.stamp_ns if by_header else self.log_ns, dtype=np.int64)
        values = np.array(self.rows, dtype=np.float64).reshape(len(order), len(self.paths))
        values = values[order][:, [self.paths[path] for path in paths]]
        kept: Array = np.ones(len(order), dtype=bool)
        if any(joint for _, joint in paths):  # a robot may send its joints in several messages
            kept = np.asarray(np.isfinite(values).any(axis=1))
        return stamp_ns[order][kept], values[kept]


def _read_topics(
    bag: Bag, place: str, topics: Mapping[str, Topic], mapping: TopicMapping, faults: Faults
) -> dict[str, _TopicReader]:
    """Read the topics of a mapping, each once, however many streams are made of it."""
    readers: dict[str, _TopicReader] = {}

    def reader(name: str) -> _TopicReader:
        if name not in readers:
            decode = decoder_of(place, topics[name], bag.distro)
            readers[name] = _TopicReader(place, topics[name], decode, faults)
        return readers[name]

    for stream in mapping.streams.values():
        for topic, channels in _channels_by_topic(stream).items():
            for path in _paths(stream, topics, channels):
                reader(topic).paths.setdefault(path, len(reader(topic).paths))
    if mapping.labels:
        reader(mapping.labels)
    for topic, log_ns, content in messages_of(bag, frozenset(readers), faults):
        readers[topic].take(log_ns, content)
    return readers


def _paths(
    stream: StreamMapping, topics: Mapping[str, Topic], channels: Mapping[str, Channel]
) -> list[tuple[str, str]]:
    if stream.kind in ("fields", "joints"):
        return [(channel.field, channel.joint) for channel in channels.values()]
    kind = short_type(topics[stream.topic].kind)
    return [(path, "") for path in KINDS[kind].paths]


class RawStream(NamedTuple):
    """A stream before it is judged: stamps (n,) in ns, channels, and values (n, c)."""

    stamp_ns: Array
    channels: tuple[str, ...]
    values: Array


def _raw_stream(
    place: str,
    name: str,
    mapping: StreamMapping,
    topics: Mapping[str, Topic],
    found: Mapping[str, _TopicReader],
    time: str,
    wheel_radius_m: float | None,
    faults: Faults,
) -> RawStream:
    """Return the channels of a stream at its stamps; its topics have been read."""
    numbers = []
    by_topic = _channels_by_topic(mapping)
    for topic, channels in by_topic.items():
        paths = _paths(mapping, topics, channels)
        stamps, values = found[topic].numbers(paths, by_header=(mapping.time or time) == "header")
        if not stamps.size:
            what = " with any of the joints" if mapping.kind == "joints" else ""
            raise LogError(f"{place}: topic {shown(topic)} has no message{what}")
        numbers.append((stamps, values))
    stamp_ns, values = numbers[0]
    if mapping.kind in ("fields", "joints"):
        if len(numbers) > 1:
            stamp_ns, values = _joined(place, name, mapping, numbers, faults)
        names = [channel for channels in by_topic.values() for channel in channels]
        if mapping.wheel_radius is not None:
            wheel_radius_m = mapping.wheel_radius.value * UNIT_SCALES[mapping.wheel_radius.unit][1]
        converted = _in_si(mapping, names, values, wheel_radius_m)
    else:
        converted = KINDS[short_type(topics[mapping.topic].kind)].converted(values)
    if not converted.channels:
        raise LogError(f"{place}: topic {shown(mapping.topic)} states that it measures nothing")
    return RawStream(stamp_ns, *converted)


def _in_si(
    mapping: StreamMapping, names: Sequence[str], values: Array, wheel_radius_m: float | None
) -> Converted:
    columns = {}
    for name, column in zip(names, values.T, strict=True):
        channel, desired = mapping.channels[name], unit_of(name)
        unit = joint_unit(channel) if mapping.kind == "joints" else channel.unit
        factor = 1.0 if desired == "code" else UNIT_SCALES[unit][1]
        if mapping.kind == "joints" and by_radius(channel, desired):
            factor *= wheel_radius_m or np.nan
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is judged later
            scaled = (column * channel.scale + channel.offset) * factor
            columns[name] = scaled + UNIT_OFFSETS.get(unit, 0.0)
    return Converted(tuple(mapping.channels), np.column_stack([columns[name] for name in mapping.channels]))


def _joined(
    place: str, name: str, mapping: StreamMapping, numbers: list[tuple[Array, Array]], faults: Faults
) -> tuple[Array, Array]:
    """Return the samples of several topics at stamps that all of them have, or at those of the first."""
    orders = [np.argsort(stamps, kind="stable") for stamps, _ in numbers]
    stamps = [each[order] for (each, _), order in zip(numbers, orders, strict=True)]
    values = [each[order] for (_, each), order in zip(numbers, orders, strict=True)]
    if mapping.join == "previous":
        others = [_previous(stamps[0], *other) for other in zip(stamps[1:], values[1:], strict=True)]
        return stamps[0], np.concatenate([values[0], *others], axis=1)
    common = stamps[0]
    for each in stamps[1:]:
        common = np.intersect1d(common, each)
    n_lost = sum(each.size for each in stamps) - common.size * len(stamps)
    if n_lost:
        topics = " and ".join(shown(topic) for topic in _channels_by_topic(mapping))
        text = f"{name}: {n_lost} messages of {topics} lack one of equal stamp (join: previous)"
        faults.found(place, UNMATCHED, text, n_lost)
    if not common.size:
        raise LogError(f"{place}: stream {name}: no two stamps of its topics agree (join: previous)")
    rows = [value[np.searchsorted(each, common)] for each, value in zip(stamps, values, strict=True)]
    return common, np.concatenate(rows, axis=1)


def _previous(at_ns: Array, stamp_ns: Array, values: Array) -> Array:
    """Return the last values (m, k) by each of some instants; NaN before the first.

    Examples
    --------
    >>> _previous(np.array([1, 5]), np.array([3, 4]), np.array([[1.0], [2.0]])).tolist()
    [[nan], [2.0]]
    """
    last = np.searchsorted(stamp_ns, at_ns, side="right") - 1
    return np.where((last >= 0)[:, None], values[np.maximum(last, 0)], np.nan)


def _channels_by_topic(mapping: StreamMapping) -> dict[str, dict[str, Channel]]:
    found: dict[str, dict[str, Channel]] = {}
    for name, channel in mapping.channels.items():
        found.setdefault(channel.topic or mapping.topic, {})[name] = channel
    if mapping.topic in found or not found:
        return {mapping.topic: found.pop(mapping.topic, {}), **found}
    return found


def start_of(stamps: list[Array], repairs: Counter[str] | None) -> int:
    """Return the stamp in ns at which a run begins: the first one; when repairing, of those in order.

    Examples
    --------
    >>> start_of([np.array([50, 40, 60])], None), start_of([np.array([0, 40, 50, 60])], Counter())
    (40, 0)
    """
    if repairs is None:
        return min(int(each.min()) for each in stamps)
    return min(int(each[longest_rise(each)[0]]) for each in stamps)


def _stream(place: str, name: str, raw: RawStream, start_ns: int, repairs: Counter[str] | None) -> Stream:
    """Return a stream on the clock of the run.

    Raises
    ------
    LogError
        if stamps go back or repeat, a channel has nothing finite, or there are fewer than two samples.
    """
    if raw.stamp_ns.size > 1 and not np.any(raw.stamp_ns):
        raise LogError(f"{place}: stream {name}: all headers are stamped 0; take the log times (time: log)")
    return checked_stream(
        f"{place}: stream {name}",
        (raw.stamp_ns - start_ns) / 1e9,
        raw.values,
        raw.channels,
        row_of=lambda sample: sample + 1,
        repairs=repairs,
    )
