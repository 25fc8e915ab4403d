"""Writers of a run: an MCAP file, a bag of ROS 2, or a folder of CSV files."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from pipelines.data.mcap_file import McapWriter, library
from pipelines.data.recorded_windows import RecordedWindow
from pipelines.data.standard_messages import DISTRO, serialized, standard_topics
from pipelines.report.json_file import as_json
from terrain.errors import DataError
from terrain.files.atomic import atomic_file, atomic_folder
from terrain.files.names import shown
from terrain.logs.run_topics import (
    LABEL_TOPIC,
    LATEST_S,
    RUN_TOPIC,
    STRING,
    STRING_TEXT,
    WINDOW_TOPIC,
    Head,
    run_document,
    stamps_ns,
    stream_messages,
    stream_topics,
    string_message,
)
from terrain.logs.schema import UNIT_SCALES, unit_of
from terrain.logs.write import run_folder
from terrain.records import Array, RunLog

Target = Literal["runs", "mcap", "ros2", "ros2-mcap", "csv"]

LABELS_FILE = "labels.csv"


class Outgoing(NamedTuple):
    """A topic: the text of its definition, its log times (n,) in ns, and its messages."""

    topic: str
    kind: str
    text: str
    log_ns: Array
    messages: list[bytes]


def outgoing_topics(run: RunLog, windows: Sequence[RecordedWindow] = ()) -> Iterator[Outgoing]:
    """Yield the topics of a run: the run's own, then those of standard messages.

    Parameters
    ----------
    run : with any streams
    windows : that were recorded with it

    Raises
    ------
    DataError
        if the run is longer than stamps can tell apart, 68 years.
    """
    origin_s = _origin_s(run)
    start_s = min(float(stream.time_s[0]) for stream in run.streams.values())
    topics = stream_topics(run.streams)
    head = Head(run.run_id, run.robot, run.session, run.filter, run.source)
    document = run_document(head, topics, run.labels, run.dropped)
    yield _texts(RUN_TOPIC, [start_s], [document], origin_s)
    changes = _label_changes(run)
    if changes:
        yield _texts(LABEL_TOPIC, [each[0] for each in changes], [each[1] for each in changes], origin_s)
    if windows:
        texts = [json.dumps(as_json(window)) for window in windows]
        yield _texts(WINDOW_TOPIC, [window.end_s for window in windows], texts, origin_s)
    for name, stream in run.streams.items():
        topic = topics[name]
        values = np.column_stack([stream.channel(channel) for channel in topic.fields.values()])
        log_ns, messages = stream_messages(stream.time_s, values, origin_s)
        yield Outgoing(topic.topic, topic.kind, topic.definition, log_ns, messages)
    for name, stream in run.streams.items():
        for standard in standard_topics(name, stream):
            log_ns = stamps_ns(stream.time_s, origin_s)
            yield Outgoing(standard.topic, standard.kind, *_described(standard, log_ns))


def _described(standard: Any, log_ns: Array) -> tuple[str, Array, list[bytes]]:
    text, messages = serialized(standard, log_ns)
    return text, log_ns, messages


def _origin_s(run: RunLog) -> float:
    """Return the time of the run that is stamped 0: 0, where stamps allow it."""
    first_s = min(float(stream.time_s[0]) for stream in run.streams.values())
    last_s = max(float(stream.time_s[-1]) for stream in run.streams.values())
    if last_s - first_s > LATEST_S - 1:
        raise DataError(
            f"run {shown(run.run_id)} is {last_s - first_s:g} s long, stamps have {LATEST_S} s at most"
        )
    return 0.0 if first_s >= 0.0 and last_s <= LATEST_S else float(np.floor(first_s))


def _texts(topic: str, time_s: Sequence[float], texts: Sequence[str], origin_s: float) -> Outgoing:
    """Return texts at times of a run as a topic; times outside what stamps can be are its ends."""
    known_s = np.clip(np.nan_to_num(time_s, nan=origin_s), origin_s, origin_s + LATEST_S)
    messages = [string_message(text) for text in texts]
    return Outgoing(topic, STRING, STRING_TEXT, stamps_ns(known_s, origin_s), messages)


def _label_changes(run: RunLog) -> list[tuple[float, str]]:
    """Return the terrains as they change; an empty one where no label holds."""
    found: list[tuple[float, str]] = []
    for label in sorted(run.labels):
        if found and found[-1] == (label.start_s, ""):
            found.pop()
        found += [(label.start_s, label.terrain), (label.end_s, "")]
    return found


def target_place(run_id: str, out: Path, target: Target) -> Path:
    """Return where a run is written: a file of MCAP, else a folder."""
    folder = run_folder(run_id, out)
    return folder.with_name(f"{folder.name}.mcap") if target == "mcap" else folder


def write_messages(
    place: Path, run: RunLog, windows: Sequence[RecordedWindow], target: Target
) -> dict[str, int]:
    """Write a run as an MCAP file or a bag of ROS 2; return the number of messages of each topic.

    Raises
    ------
    DataError
        if the run is longer than stamps can tell apart.
    ConfigError
        if mcap or rosbags is not installed.
    TerrainError
        if the place cannot be written.
    """
    topics = list(outgoing_topics(run, windows))
    if target == "mcap":
        head = {"run_id": run.run_id, "robot": run.robot, "session": run.session, "filter": run.filter}
        with atomic_file(place) as file:
            writer = McapWriter(file, head)
            for log_ns, number, message in _in_order(topics):
                writer.write(*topics[number][:3], log_ns, message)
            writer.finish()
    else:
        with atomic_folder(place) as unfinished:
            inner = unfinished / place.name  # a bag's files bear the name of its folder
            _write_ros2(inner, topics, "SQLITE3" if target == "ros2" else "MCAP")
            for path in inner.iterdir():
                path.rename(unfinished / path.name)
            inner.rmdir()
    counts: dict[str, int] = {}
    for topic in topics:  # several streams may share one
        counts[topic.topic] = counts.get(topic.topic, 0) + len(topic.messages)
    return counts


def _write_ros2(folder: Path, topics: Sequence[Outgoing], storage: str) -> None:
    library("rosbags.rosbag2")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores[DISTRO])
    for each in topics:
        if each.kind not in store.types:
            store.register(get_types_from_msg(each.text.partition("=" * 80)[0], each.kind))
    with Writer(folder, version=9, storage_plugin=StoragePlugin[storage]) as writer:
        connections: dict[tuple[str, str], Any] = {}
        for each in topics:
            if (each.topic, each.kind) not in connections:
                connection = writer.add_connection(each.topic, each.kind, typestore=store)
                connections[each.topic, each.kind] = connection
        for log_ns, number, message in _in_order(topics):
            writer.write(connections[topics[number].topic, topics[number].kind], log_ns, message)


def _in_order(topics: Sequence[Outgoing]) -> Iterator[tuple[int, int, bytes]]:
    """Yield log time, number of the topic and message, of all topics in the order of log times."""

    def numbered(number: int) -> Iterator[tuple[int, int, bytes]]:
        topic = topics[number]
        for log_ns, message in zip(topic.log_ns.tolist(), topic.messages, strict=True):
            yield log_ns, number, message

    return heapq.merge(*(numbered(number) for number in range(len(topics))), key=lambda found: found[0])


def write_csv(place: Path, run: RunLog) -> dict[str, int]:
    """Write a run as a folder with a CSV file a stream, and its labels; return the number of rows of each.

    Numbers are written with as many digits as give them back.
    """
    import pandas as pd

    with atomic_folder(place) as folder:
        for name, stream in run.streams.items():
            table = pd.DataFrame(stream.values, columns=list(stream.channels))
            table.insert(0, "time_s", stream.time_s, allow_duplicates=True)
            table.to_csv(folder / f"{name}.csv", index=False, lineterminator="\n")
        if run.labels:
            labels = pd.DataFrame(run.labels, columns=["start_s", "end_s", "terrain"])
            labels.to_csv(folder / LABELS_FILE, index=False, lineterminator="\n")
    rows = {f"{name}.csv": len(stream) for name, stream in run.streams.items()}
    return rows | ({LABELS_FILE: len(run.labels)} if run.labels else {})


def csv_mapping(runs: Sequence[RunLog]) -> str | None:
    """Return the mapping that reads the CSV files of runs; None where they differ in robot or channels.

    Labels are no part of it, and neither are codes, which have no unit.
    """
    first = runs[0]
    for run in runs:
        if run.robot != first.robot or {n: s.channels for n, s in run.streams.items()} != {
            n: s.channels for n, s in first.streams.items()
        }:
            return None
    unit_name = {word: name for name, (word, factor) in reversed(UNIT_SCALES.items()) if factor == 1.0}
    lines = [f"robot: {json.dumps(first.robot)}", 'run_id: "{run}"', "streams:"]
    for name, stream in first.streams.items():
        units = {channel: unit_name.get(unit_of(channel), "") for channel in stream.channels}
        if not any(units.values()):
            continue
        lines += [f"  {json.dumps(name)}:", f"    file: {json.dumps('{run}/' + name + '.csv')}"]
        lines += ["    time: {column: time_s, unit: s}", "    channels:"]
        for channel, unit in units.items():
            place = f"{{column: {json.dumps(channel)}, unit: {json.dumps(unit)}}}"
            lines += [f"      {json.dumps(channel)}: {place}"] if unit else []
    return "\n".join(lines) + "\n"
