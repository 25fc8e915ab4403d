"""MCAP files and ROS 2 bags as runs, one a bag: by a mapping, by standard types, or as they were exported."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

from pipelines.bags.collect import Collector, Taker, TextCollector, definition_of
from pipelines.bags.exported import RUN_TOPIC, STRING, ExportedRun
from pipelines.bags.mapping import LABELS_TYPE, Mapping, described, load_mapping, standard_mapping
from pipelines.bags.streams import StreamCollector, start_of, stream_of
from pipelines.messages.definitions import short_type
from pipelines.messages.finding import Bag, find_bags, open_bag, storage_of
from pipelines.messages.storage import Faults, Topic
from terrain.errors import ConfigError, LogError
from terrain.files.names import shown
from terrain.logs.borealtc import whole_run_label
from terrain.logs.log_files import checked_names, short_name
from terrain.logs.read import MAX_STREAMS
from terrain.logs.samples import refuse_apart
from terrain.records import Label, RunLog, Stream
from terrain.robots import Robot, packaged_robot

MAX_LABELS = 1_000_000
"""Messages with terrains; ten a second are 28 hours."""


def find_runs(
    place: Path, mapping: str | Path | None, robot: Robot | None, bags: Sequence[Path] | None = None
) -> list[Callable[..., RunLog]]:
    """Return a function for each bag under a folder, which reads it and takes ``repair=``.

    Parameters
    ----------
    place : folder of bags, the folder of a bag or a file; one in a folder of its own is labelled with that
        folder's name as its terrain
    mapping : YAML file (:mod:`pipelines.bags.mapping`); by the types of the topics by default
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
    path: Path, folder: Path, mapping: Mapping | None, robot: Robot | None, *, repair: bool = False
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
    topics = _topics(bag, place)
    exported = topics.get(RUN_TOPIC)
    if mapping is None and exported is not None and exported.kind == STRING:
        return _exported_run(bag, place, topics, faults)
    if not topics:
        raise LogError(f"{place}: has no topic")
    mapping = standard_mapping(place, list(topics.values())) if mapping is None else mapping
    name = robot.name if robot is not None else mapping.robot
    if not name:
        raise ConfigError(f"{place}: a bag does not name its robot: give it by --robot or in the mapping")
    _check_topics(place, mapping, topics)
    collectors = _collectors(bag, place, topics, mapping, robot, faults)
    labels = TextCollector(place, mapping.labels, faults, MAX_LABELS) if mapping.labels else None
    _read(bag, [each for found in collectors.values() for each in found.collectors], labels, faults)

    raw = {stream: collector.raw() for stream, collector in collectors.items()}
    start_ns = start_of([each.stamp_ns for each in raw.values()], faults.repairs)
    streams = {
        stream: stream_of(place, stream, each, start_ns, faults.repairs) for stream, each in raw.items()
    }
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


def label_intervals(
    texts: Sequence[tuple[int, str]], start_ns: int, streams: dict[str, Stream]
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
    end_s = whole_run_label(streams, "all").end_s
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


def _topics(bag: Bag, place: str) -> dict[str, Topic]:
    found: dict[str, Topic] = {}
    for file in bag.files:
        for topic in storage_of(file, Faults(None)).topics():
            if found.setdefault(topic.name, topic).kind != topic.kind:
                raise LogError(f"{place}: topic {shown(topic.name)} has messages of two types")
    return found


def _check_topics(place: str, mapping: Mapping, topics: dict[str, Topic]) -> None:
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


def _collectors(
    bag: Bag, place: str, topics: dict[str, Topic], mapping: Mapping, robot: Robot | None, faults: Faults
) -> dict[str, StreamCollector]:
    names = {
        topic
        for stream in mapping.streams.values()
        for topic in (stream.topic, *(channel.topic for channel in stream.channels.values()))
        if topic
    }
    definitions = {name: definition_of(place, topics[name], bag.distro) for name in sorted(names)}
    return {
        name: StreamCollector(
            place,
            name,
            stream,
            by_header=mapping.time == "header",
            definitions=definitions,
            topics=topics,
            wheel_radius_m=_wheel_radius_m(mapping, robot),
            faults=faults,
        )
        for name, stream in mapping.streams.items()
    }


def _wheel_radius_m(mapping: Mapping, robot: Robot | None) -> float | None:
    try:
        return (packaged_robot(mapping.robot) if robot is None else robot).wheel_radius_m
    except ConfigError:
        return None


def _read(bag: Bag, collectors: list[Collector], labels: TextCollector | None, faults: Faults) -> None:
    """Give each collector the messages of its topic."""
    takers: dict[str, list[Taker]] = {}
    for each in collectors:
        takers.setdefault(each.topic, []).append(each.take)
    if labels is not None:
        takers.setdefault(labels.topic, []).append(labels.take)
    for file in bag.files:
        for batch in storage_of(file, faults).batches(frozenset(takers)):
            for take in takers[batch.topic]:
                take(batch)


def _exported_run(bag: Bag, place: str, topics: dict[str, Topic], faults: Faults) -> RunLog:
    run = ExportedRun(place, _document(bag, place))
    collectors = run.collectors(faults, topics)
    _read(bag, list(collectors.values()), None, faults)
    return run.run({name: each.numbers() for name, each in collectors.items()}, faults.repairs)


def _document(bag: Bag, place: str) -> str:
    """Return the first message of :data:`RUN_TOPIC`, which is at the beginning."""
    documents = TextCollector(place, RUN_TOPIC, Faults(None), MAX_STREAMS)
    for file in bag.files:
        for batch in storage_of(file, Faults(Counter())).batches(frozenset((RUN_TOPIC,))):
            documents.take(batch)
            return documents.texts()[0][1]
    raise LogError(f"{place}: {RUN_TOPIC} has no message")


def _parts(path: Path, folder: Path) -> tuple[str, ...]:
    """Return the names that a run is called by: those of the folders down to its bag, and the bag's own."""
    if path == folder:
        path = path.resolve()
        return (path.stem if path.is_file() else path.name,)
    within = path.relative_to(folder)
    return (within.with_suffix("") if path.is_file() else within).parts
