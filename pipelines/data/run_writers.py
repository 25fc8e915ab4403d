"""Writers of a run: an MCAP file, a bag of ROS 2, or a folder of CSV files."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import repeat
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.data.bag_files import McapWriter, library
from pipelines.data.settings import Target
from terrain.files.atomic import atomic_file, atomic_folder
from terrain.kinematics.standard_messages import standard_topic
from terrain.logs.mapping import DISTRO
from terrain.logs.run_folders import (
    WINDOWS_FILE,
    RecordedWindow,
    RunHead,
    run_folder,
    windows_text,
    write_csv,
    write_run,
)
from terrain.logs.run_topics import Messages, origin_of, run_messages, stamps_ns
from terrain.records import RunLog


def messages_of_run(run: RunLog, windows: Sequence[RecordedWindow] = ()) -> Iterator[Messages]:
    """Yield the topics of a run and of windows that were recorded with it, then those of standard messages.

    Raises
    ------
    ConfigError
        if rosbags is not installed.
    DataError
        if the run is longer than stamps can tell apart, 68 years.
    """
    yield from run_messages(run, [(window.end_s, window.model_dump_json()) for window in windows])
    for name, stream in run.streams.items():
        topic = standard_topic(name, stream)
        if topic is None:
            continue
        typesys = library("rosbags.typesys")
        store = typesys.get_typestore(typesys.Stores[DISTRO])
        message = zero_message(store, topic.kind)
        for path, value in topic.fixed.items():
            setter(message, path)(value)
        setters = [setter(message, path) for path in topic.paths]
        contents = []
        log_ns = stamps_ns(stream.time_s, origin_of(run))
        for stamp_ns, row in zip(log_ns.tolist(), topic.numbers.tolist(), strict=True):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            for put, number in zip(setters, row, strict=True):
                put(number)
            contents.append(bytes(store.serialize_cdr(message, topic.kind)))
        definition = str(store.generate_msgdef(topic.kind, ros_version=2)[0])
        yield Messages(topic.topic, topic.kind, definition, log_ns, contents)


def setter(message: Any, path: str) -> Callable[[Any], None]:
    """Return what sets the field, or the element of an array, that a path names."""
    *parents, field = path.split(".")
    for name in parents:
        message = getattr(message, name)
    if field.endswith("]"):
        array, _, index = field[:-1].partition("[")
        return partial(getattr(message, array).__setitem__, int(index))
    return partial(setattr, message, field)


def zero_message(store: Any, kind: str) -> Any:
    """Return a message whose numbers are 0, texts empty, and sequences of no element."""
    from rosbags.interfaces import Nodetype

    values: dict[str, Any] = {}
    for name, (node, described) in store.fielddefs[kind][1]:
        if node == Nodetype.NAME:
            values[name] = zero_message(store, described)
        elif node == Nodetype.BASE:
            values[name] = "" if described[0] == "string" else 0
        else:  # those that are written are arrays of float64
            values[name] = np.zeros(described[1] if node == Nodetype.ARRAY else 0)
    return store.types[kind](**values)


def target_place(run_id: str, out: Path, target: Target) -> Path:
    """Return where a run is written: a file of MCAP, else a folder."""
    folder = run_folder(run_id, out)
    return folder.with_name(f"{folder.name}.mcap") if target == "mcap" else folder


def write(place: Path, run: RunLog, windows: Sequence[RecordedWindow], target: Target) -> Mapping[str, int]:
    """Write a run; return the number of messages of each topic, or of rows of each table for other programs.

    Parameters
    ----------
    place : as :func:`target_place` returns it
    run : with any streams
    windows : that were recorded with it
    target : what is written

    Raises
    ------
    ConfigError, DataError
        as :func:`messages_of_run`.
    TerrainError
        if the place cannot be written.
    """
    if target == "runs":
        write_run(run, place.parent, beside={WINDOWS_FILE: windows_text(windows)} if windows else {})
        return {}
    if target == "csv":
        return write_csv(place, run)
    topics = list(messages_of_run(run, windows))
    if target == "mcap":
        with atomic_file(place) as file:
            writer = McapWriter(file, RunHead.of(run))
            for log_ns, topic, content in _in_order(topics):
                writer.write(topic, log_ns, content)
            writer.finish()
    else:
        with atomic_folder(place) as unfinished:
            inner = unfinished / place.name  # a bag's files bear the name of its folder
            rosbag2, typesys = library("rosbags.rosbag2"), library("rosbags.typesys")
            store = typesys.get_typestore(typesys.Stores[DISTRO])
            for each in topics:
                if each.kind not in store.types:
                    definition = each.definition.partition("=" * 80)[0]
                    store.register(typesys.get_types_from_msg(definition, each.kind))
            storage = rosbag2.StoragePlugin["SQLITE3" if target == "ros2" else "MCAP"]
            with rosbag2.Writer(inner, version=9, storage_plugin=storage) as bag:
                connections: dict[tuple[str, str], Any] = {}
                for each in topics:
                    if (each.topic, each.kind) not in connections:
                        connection = bag.add_connection(each.topic, each.kind, typestore=store)
                        connections[each.topic, each.kind] = connection
                for log_ns, each, content in _in_order(topics):
                    bag.write(connections[each.topic, each.kind], log_ns, content)
            for path in inner.iterdir():
                path.rename(unfinished / path.name)
            inner.rmdir()
    counts: Counter[str] = Counter()
    for topic in topics:  # several streams may share one
        counts[topic.topic] += len(topic.contents)
    return counts


def _in_order(topics: Sequence[Messages]) -> Iterator[tuple[int, Messages, bytes]]:
    """Yield log time, topic and content of all messages in the order of log times."""
    rows = (zip(each.log_ns.tolist(), repeat(each), each.contents, strict=False) for each in topics)
    return heapq.merge(*rows, key=itemgetter(0))
