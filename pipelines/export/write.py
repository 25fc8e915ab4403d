"""Writing topics as an MCAP file or a ROS 2 bag."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from pipelines.export.outgoing import Outgoing
from pipelines.messages.definitions import ASSUMED_DISTRO, MISSING_PACKAGE
from terrain.errors import ConfigError

LIBRARY = "terrain-slip"


def write_mcap(file: BinaryIO, topics: Sequence[Outgoing], metadata: dict[str, str]) -> None:
    """Write topics as an MCAP file of profile ROS 2, in the order of log times.

    Parameters
    ----------
    file : opened for writing
    topics : with their messages
    metadata : shown by tools that list a file's metadata

    Raises
    ------
    ConfigError
        if mcap is not installed.
    """
    try:
        from mcap.writer import CompressionType, Writer
    except ImportError as error:
        raise ConfigError(MISSING_PACKAGE) from error
    writer = Writer(file, compression=CompressionType.ZSTD)
    writer.start(profile="ros2", library=LIBRARY)
    writer.add_metadata("terrain_run", metadata)
    schemas = {each.kind: writer.register_schema(each.kind, "ros2msg", each.text.encode()) for each in topics}
    channels = {
        key: writer.register_channel(key[0], "cdr", schemas[key[1]])
        for key in dict.fromkeys((each.topic, each.kind) for each in topics)
    }
    for log_ns, topic, message in _in_order(topics):
        channel = channels[topics[topic].topic, topics[topic].kind]
        writer.add_message(channel, log_ns, message, log_ns)
    writer.finish()


def write_ros2(folder: Path, topics: Sequence[Outgoing], storage: str) -> None:
    """Write topics as a bag of rosbag2.

    Parameters
    ----------
    folder : of the bag, which is made
    topics : with their messages
    storage : ``sqlite3`` or ``mcap``

    Raises
    ------
    ConfigError
        if rosbags is not installed.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise ConfigError(MISSING_PACKAGE) from error
    store = get_typestore(Stores[ASSUMED_DISTRO])
    for each in topics:
        if each.kind not in store.types:
            first, _, _ = each.text.partition("=" * 80)
            store.register(get_types_from_msg(first, each.kind))
    with Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        connections: dict[tuple[str, str], Any] = {}
        for each in topics:
            key = (each.topic, each.kind)
            if key not in connections:
                connections[key] = writer.add_connection(each.topic, each.kind, typestore=store)
        for log_ns, topic, message in _in_order(topics):
            writer.write(connections[topics[topic].topic, topics[topic].kind], log_ns, message)


def _in_order(topics: Sequence[Outgoing]) -> Iterator[tuple[int, int, bytes]]:
    """Yield log time, number of the topic and message, of all topics in the order of log times."""

    def each(number: int) -> Iterator[tuple[int, int, bytes]]:
        topic = topics[number]
        for log_ns, message in zip(topic.log_ns.tolist(), topic.messages, strict=True):
            yield log_ns, number, message

    return heapq.merge(*(each(number) for number in range(len(topics))), key=lambda found: found[0])
