"""Bags as runs, one a bag: by a mapping, by standard types, or as they were exported or recorded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from pipelines.data.bag_files import Bag, decoder_of, find_bags, messages_of, open_bag, topics_of
from terrain.errors import ConfigError, LogError
from terrain.kinematics.standard_messages import KINDS
from terrain.logs.mapping import (
    Faults,
    MessageStream,
    Topic,
    TopicMapping,
    load_topics,
    mapped_streams,
    standard_mapping,
)
from terrain.logs.run_folders import RecordedWindow, window_of_text
from terrain.logs.run_topics import (
    RUN_TOPIC,
    STRING,
    WINDOW_TOPIC,
    RunDocument,
    read_document,
    run_of,
    string_of,
)
from terrain.logs.samples import checked_names, refuse_apart, short_name, whole_run_label
from terrain.logs.tables import MAX_VALUES
from terrain.records import Label, RunLog, Stream
from terrain.robots import Robot, robot_named


def find_runs(place: Path, mapping: str | Path | None, robot: Robot | None) -> list[Callable[..., RunLog]]:
    """Return a function for each bag under a folder, which reads it and takes ``repair=``.

    Parameters
    ----------
    place : folder of bags, the folder of a bag or a file; one in a folder of its own is labelled with that
        folder's name as its terrain
    mapping : YAML file (:mod:`terrain.logs.mapping`); by the types of the topics by default
    robot : of all runs that do not name theirs; that of the mapping by default
    """
    if place.is_file():  # one that the user names may be a link
        place = place.resolve()
    if not (paths := find_bags(place)):
        return []
    read_mapping = None if mapping is None else load_topics(mapping)
    return [partial(read_run, path, place, read_mapping, robot) for path in paths]


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
    bag, place = open_bag(path), short_name(path)
    topics = topics_of(bag)
    exported = topics.get(RUN_TOPIC)
    if mapping is None and exported is not None and exported.kind == STRING:
        prefix = RUN_TOPIC.rpartition("/")[0]
        names = frozenset(each for each in topics if each.startswith(prefix))
        counted = Faults(Counter())
        document, messages = _document(bag, place, topics, names, counted)
        tolerant = document.live or repair  # a recording that ends early is read as far as it goes
        if counted.first and not tolerant:
            raise LogError(counted.first)
        return run_of(place, document, messages, counted if tolerant else Faults(None))
    if not topics:
        raise LogError(f"{place}: has no topic")
    mapping = standard_mapping(place, list(topics.values())) if mapping is None else mapping
    name = robot.name if robot is not None else mapping.robot
    if not name:
        raise ConfigError(f"{place}: a bag does not name its robot: give it by --robot or in the mapping")
    faults = Faults(Counter() if repair else None)
    streams, intervals = _mapped(bag, mapping, topics, wheel_radius_m(name, robot), faults)
    # called by the names of the folders down to its bag, and the bag's own
    within = Path(path.resolve().name) if path == folder else path.relative_to(folder)
    parts = (within.with_suffix("") if path.is_file() else within).parts
    refuse_apart("_".join(parts), streams)
    if not mapping.labels:
        terrain = mapping.terrain or (parts[0] if len(parts) > 1 else "")
        intervals = (whole_run_label(streams, terrain),) if terrain else ()
    run = RunLog(
        "_".join(parts), name, streams, intervals, source=f"{place}, a bag", dropped=faults.repairs or {}
    )
    return checked_names(place, run)


def read_stream(
    path: Path,
    name: str,
    stream: MessageStream,
    repairs: Counter[str] | None,
    radius_m: float | None = None,
) -> Stream:
    """Return one stream of a bag that is joined with other files: its times are seconds since 1970.

    Parameters
    ----------
    path : of the bag
    name : of the stream
    stream : as a mapping describes it
    repairs : counts by kind of what is dropped; None refuses
    radius_m : of the robot's wheels; None where unknown
    """
    mapping = TopicMapping(streams={name: stream})
    bag = open_bag(path)
    return _mapped(bag, mapping, topics_of(bag), radius_m, Faults(repairs), 0)[0][name]


def _mapped(
    bag: Bag,
    mapping: TopicMapping,
    topics: Mapping[str, Topic],
    radius_m: float | None,
    faults: Faults,
    start_ns: int | None = None,
) -> tuple[dict[str, Stream], tuple[Label, ...]]:
    """Return the streams and labels of a bag by a mapping."""
    place = short_name(bag.path)
    decoder = partial(decoder_of, place, distro=bag.distro)
    messages = partial(messages_of, bag, faults=faults)
    return mapped_streams(place, mapping, topics, KINDS, decoder, messages, radius_m, faults, start_ns)


def _document(
    bag: Bag, place: str, topics: Mapping[str, Topic], names: frozenset[str], faults: Faults
) -> tuple[RunDocument, dict[str, list[bytes]]]:
    """Return the document of the run of a bag, and the messages of some topics, that of documents too."""
    messages: dict[str, list[bytes]] = {name: [] for name in names}
    n_bytes = 0
    for topic, _, content in messages_of(bag, names, faults):
        messages[topic].append(content)
        n_bytes += len(content)
        if n_bytes > 8 * MAX_VALUES:
            raise LogError(f"{place}: has more than {MAX_VALUES} values")
    if not messages[RUN_TOPIC]:
        raise LogError(f"{place}: {RUN_TOPIC} has no message")
    return read_document(place, string_of(place, messages[RUN_TOPIC][-1]), topics), messages


def recorded_windows(path: Path) -> tuple[str, list[RecordedWindow]] | None:
    """Return the id of the run of a bag and the windows that were recorded with it; None where none were.

    Raises
    ------
    LogError
        if the bag cannot be read, or a window is damaged.
    """
    bag, place = open_bag(path), short_name(path)
    topics, names = topics_of(bag), frozenset((WINDOW_TOPIC, RUN_TOPIC))
    if not names <= set(topics):
        return None
    document, messages = _document(bag, place, topics, names, Faults(Counter()))
    texts = [string_of(place, message) for message in messages[WINDOW_TOPIC]]
    return document.run_id, [window_of_text(place, text) for text in texts]


def wheel_radius_m(name: str, given: Robot | None) -> float | None:
    """Return the wheel radius of a robot by its name, or of the one that is given; None where it is unknown."""
    try:
        return robot_named(name, given).wheel_radius_m
    except ConfigError:
        return None
