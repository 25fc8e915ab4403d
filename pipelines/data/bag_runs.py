"""Bags as runs, one a bag: by a mapping, by standard types, or as they were exported or recorded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipelines.data.bag_files import (
    Bag,
    decoder_of,
    find_bags,
    messages_of,
    open_bag,
    short_type,
    topics_of,
)
from pipelines.data.faults import Faults, Topic
from pipelines.data.message_numbers import Collector, Numbers, TextCollector, give
from pipelines.data.recorded_windows import RecordedWindow, window_of_text
from pipelines.data.run_topics import RUN_TOPIC, STRING, WINDOW_TOPIC, RunDocument
from pipelines.data.standard_messages import KINDS, Converted
from pipelines.data.topic_mapping import (
    LABELS_TYPE,
    TYPES,
    Channel,
    StreamMapping,
    by_radius,
    check_stream,
    described,
    joint_unit,
    load_mapping,
    standard_mapping,
)
from pipelines.data.topic_mapping import Mapping as TopicMapping
from terrain.errors import ConfigError, LogError
from terrain.files.names import shown
from terrain.logs.borealtc import whole_run_label
from terrain.logs.log_files import checked_names, short_name
from terrain.logs.parquet_file import MAX_VALUES
from terrain.logs.samples import checked_stream, longest_rise, refuse_apart
from terrain.logs.schema import UNIT_OFFSETS, UNIT_SCALES, unit_of
from terrain.records import Array, Label, RunLog, Stream
from terrain.robots import Robot, packaged_robot

MAX_LABELS = 1_000_000
"""Messages with terrains; ten a second are 28 hours."""

UNMATCHED = "messages without one of equal stamp on the other topics"


def find_runs(
    place: Path, mapping: str | Path | None, robot: Robot | None, bags: Sequence[Path] | None = None
) -> list[Callable[..., RunLog]]:
    """Return a function for each bag under a folder, which reads it and takes ``repair=``.

    Parameters
    ----------
    place : folder of bags, the folder of a bag or a file; one in a folder of its own is labelled with that
        folder's name as its terrain
    mapping : YAML file (:mod:`pipelines.data.topic_mapping`); by the types of the topics by default
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
    _check_topics(place, mapping, topics)
    radius_m = _wheel_radius_m(mapping, robot)
    readers = {
        stream: StreamReader(
            place,
            stream,
            each,
            by_header=mapping.time == "header",
            topics=topics,
            wheel_radius_m=radius_m,
            faults=faults,
        )
        for stream, each in mapping.streams.items()
    }
    labels = TextCollector(place, mapping.labels, faults, MAX_LABELS) if mapping.labels else None
    _collect(bag, place, topics, readers.values(), labels, faults)
    raw = {stream: reader.raw() for stream, reader in readers.items()}
    start_ns = start_of([each.stamp_ns for each in raw.values()], faults.repairs)
    streams = {stream: _stream(place, stream, each, start_ns, faults.repairs) for stream, each in raw.items()}
    parts = _parts(path, folder)
    refuse_apart("_".join(parts), streams)
    if labels is not None:
        intervals = label_intervals(labels.texts(), start_ns, streams)
    else:
        terrain = mapping.terrain or (parts[0] if len(parts) > 1 else "")
        intervals = (whole_run_label(streams, terrain),) if terrain else ()
    run = RunLog(
        "_".join(parts), name, streams, intervals, source=f"{place}, a bag", dropped=faults.repairs or {}
    )
    return checked_names(place, run)


def _collect(
    bag: Bag,
    place: str,
    topics: Mapping[str, Topic],
    readers: Iterable[StreamReader],
    labels: TextCollector | None,
    faults: Faults,
) -> None:
    """Give the messages of a bag to what takes them."""
    takers: dict[str, list[Collector | TextCollector]] = {}
    for reader in readers:
        for collector in reader.collectors:
            takers.setdefault(collector.topic, []).append(collector)
    if labels is not None:
        takers.setdefault(labels.topic, []).append(labels)
    decoders = {topic: decoder_of(place, topics[topic], bag.distro) for topic in sorted(takers)}
    given = give(takers, decoders)
    for topic, log_ns, content in messages_of(bag, frozenset(takers), faults):
        given(topic, log_ns, content)


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
    mapping = check_stream(f"stream {name}", described_stream)
    bag, place, faults = open_bag(path), short_name(path), Faults(repairs)
    topics = topics_of(bag)
    _check_topics(place, TopicMapping(streams={name: mapping}), topics)
    reader = StreamReader(
        place,
        name,
        mapping,
        by_header=True,
        topics=topics,
        wheel_radius_m=wheel_radius_m,
        faults=faults,
    )
    _collect(bag, place, topics, [reader], None, faults)
    return _stream(place, name, reader.raw(), 0, repairs)


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


def _check_topics(place: str, mapping: TopicMapping, topics: Mapping[str, Topic]) -> None:
    """Refuse a mapping of topics that a bag lacks."""
    there = described([*topics.values()])
    for name, stream in mapping.streams.items():
        for topic in (stream.topic, *(channel.topic for channel in stream.channels.values())):
            if topic and topic not in topics:
                raise LogError(
                    f"{place}: stream {name}: there is no topic {shown(topic)} (there are {there})"
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


class RawStream(NamedTuple):
    """A stream before it is judged: stamps (n,) in ns, channels, and values (n, c)."""

    stamp_ns: Array
    channels: tuple[str, ...]
    values: Array


class StreamReader:
    """Collects what a stream of a mapping is made of.

    Parameters
    ----------
    place : of the bag, as messages name it
    name : of the stream
    mapping : of it
    by_header : whether stamps are those of headers, where the stream does not state it
    topics : of the bag, by name
    wheel_radius_m : of the robot; None where unknown
    faults : gets what is damaged

    Raises
    ------
    LogError
        if a topic is of another type than the kind has.
    ConfigError
        if a radius is missing.
    """

    def __init__(
        self,
        place: str,
        name: str,
        mapping: StreamMapping,
        *,
        by_header: bool,
        topics: Mapping[str, Topic],
        wheel_radius_m: float | None,
        faults: Faults,
    ) -> None:
        self._place, self._name, self._mapping, self._faults = place, name, mapping, faults
        by_header = mapping.time == "header" if mapping.time else by_header
        self._radius_m = wheel_radius_m
        if mapping.wheel_radius is not None:
            self._radius_m = mapping.wheel_radius.value * UNIT_SCALES[mapping.wheel_radius.unit][1]
        self._by_topic = _channels_by_topic(mapping)
        self._kind = short_type(topics[mapping.topic].kind)
        if mapping.kind != "fields" and self._kind not in TYPES[mapping.kind]:
            raise LogError(
                f"{place}: stream {name}: topic {mapping.topic} is of type {topics[mapping.topic].kind}, "
                f"kind {mapping.kind!r} is {' or '.join(TYPES[mapping.kind])} "
                f"(there are {described([*topics.values()])})"
            )
        for channel, entry in mapping.channels.items():
            if mapping.kind == "joints" and by_radius(entry, unit_of(channel)) and self._radius_m is None:
                raise ConfigError(
                    f"{place}: stream {name}: channel {channel} is the speed of a joint that turns: "
                    f"'wheel_radius' is missing, and the robot has no description"
                )
        self.collectors = [
            Collector(place, topic, short_type(topics[topic].kind), self._paths(channels), by_header, faults)
            for topic, channels in self._by_topic.items()
        ]

    def _paths(self, channels: Mapping[str, Channel]) -> list[tuple[str, str]]:
        if self._kind in KINDS and self._mapping.kind != "fields":
            return [(path, "") for path in KINDS[self._kind].paths]
        return [(channel.field, channel.joint) for channel in channels.values()]

    def raw(self) -> RawStream:
        """Return the channels at the stamps of the stream.

        Raises
        ------
        LogError
            if its topic has no message, or the stamps of its topics do not agree.
        """
        numbers = [collector.numbers() for collector in self.collectors]
        for collector, each in zip(self.collectors, numbers, strict=True):
            if not each.stamp_ns.size:
                what = " with any of the joints" if self._mapping.kind == "joints" else ""
                raise LogError(f"{self._place}: topic {shown(collector.topic)} has no message{what}")
        if self._mapping.kind in ("fields", "joints"):
            stamp_ns, rows = numbers[0].stamp_ns, [each.values for each in numbers]
            if len(numbers) > 1:
                stamp_ns, rows = self._joined(numbers)
            names = [name for channels in self._by_topic.values() for name in channels]
            found = self._in_si(names, np.concatenate(rows, axis=1))
        else:
            stamp_ns, found = numbers[0].stamp_ns, KINDS[self._kind].converted(numbers[0].values)
        if not found.channels:
            raise LogError(
                f"{self._place}: topic {shown(self._mapping.topic)} states that it measures nothing"
            )
        return RawStream(stamp_ns, found.channels, found.values)

    def _in_si(self, names: list[str], values: Array) -> Converted:
        columns = []
        for name, column in zip(names, values.T, strict=True):
            channel, desired = self._mapping.channels[name], unit_of(name)
            unit = joint_unit(channel) if self._mapping.kind == "joints" else channel.unit
            factor = 1.0 if desired == "code" else UNIT_SCALES[unit][1]
            zero = UNIT_OFFSETS.get(unit, 0.0)
            if self._mapping.kind == "joints" and by_radius(channel, desired):
                factor *= self._radius_m or np.nan
            with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is judged later
                columns.append((column * channel.scale + channel.offset) * factor + zero)
        order = [names.index(name) for name in self._mapping.channels]
        return Converted(tuple(self._mapping.channels), np.column_stack(columns)[:, order])

    def _joined(self, numbers: list[Numbers]) -> tuple[Array, list[Array]]:
        """Return the samples of several topics at stamps that all of them have, or at those of the first."""
        orders = [np.argsort(each.stamp_ns, kind="stable") for each in numbers]
        stamps = [each.stamp_ns[order] for each, order in zip(numbers, orders, strict=True)]
        values = [each.values[order] for each, order in zip(numbers, orders, strict=True)]
        if self._mapping.join == "previous":
            return stamps[0], [
                values[0],
                *(_previous(stamps[0], *o) for o in zip(stamps[1:], values[1:], strict=True)),
            ]
        common = stamps[0]
        for each in stamps[1:]:
            common = np.intersect1d(common, each)
        n_lost = sum(each.size for each in stamps) - common.size * len(stamps)
        if n_lost:
            topics = " and ".join(shown(topic) for topic in self._by_topic)
            text = f"{self._name}: {n_lost} messages of {topics} lack one of equal stamp (join: previous)"
            self._faults.found(self._place, UNMATCHED, text, n_lost)
        if not common.size:
            raise LogError(
                f"{self._place}: stream {self._name}: no two stamps of its topics agree (join: previous)"
            )
        return common, [
            value[np.searchsorted(each, common)] for each, value in zip(stamps, values, strict=True)
        ]


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
