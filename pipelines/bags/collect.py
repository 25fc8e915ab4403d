"""Numbers of one topic as they are collected from a bag, and the stamps of its messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pipelines.messages.cdr import Decoder
from pipelines.messages.definitions import Definition, check_path, has_header, known_text, parse_definition
from pipelines.messages.storage import DAMAGED_MESSAGE, Batch, Faults, Topic
from terrain.errors import LogError
from terrain.files.names import shown
from terrain.logs.parquet_file import MAX_VALUES
from terrain.records import Array

STAMP_PATHS = ("header.stamp.sec", "header.stamp.nanosec")


class Numbers(NamedTuple):
    """Numbers (n, k) of the messages of a topic, with their stamps (n,) in ns; in the order of the log."""

    stamp_ns: Array
    values: Array


def definition_of(place: str, topic: Topic, distro: str) -> Definition:
    """Return the definition of a topic's messages: that of the file, else that of a release of ROS 2.

    Parameters
    ----------
    place : of the bag, as messages name it
    topic : of the bag
    distro : whose definitions are taken where the file has none

    Raises
    ------
    LogError
        if its messages are not encoded as ROS 2 does, or it is not defined.
    """
    if topic.encoding != "cdr":
        raise LogError(
            f"{place}: topic {shown(topic.name)} is encoded as {shown(topic.encoding)}, 'cdr' is read"
        )
    text = topic.definition if topic.schema_encoding == "ros2msg" and topic.definition.strip() else ""
    text = text or known_text(topic.kind, distro)
    if not text:
        raise LogError(
            f"{place}: topic {shown(topic.name)} is of type {shown(topic.kind)}, which is not defined"
        )
    try:
        return parse_definition(topic.kind, text)
    except LogError as error:
        raise LogError(f"{place}: topic {shown(topic.name)}: {error}") from error


class Collector:
    """Numbers of the messages of a topic.

    Parameters
    ----------
    place : of the bag, as messages name it
    topic : whose messages are taken
    definition : of them
    paths : to the numbers, each with the name of a joint where one stands for an index
    by_header : stamps are those of the headers, where there are any; else the log times
    faults : gets what is damaged
    """

    def __init__(
        self,
        place: str,
        topic: str,
        definition: Definition,
        paths: list[tuple[str, str]],
        by_header: bool,
        faults: Faults,
    ) -> None:
        self.topic, self._place, self._faults = topic, place, faults
        self._by_header = by_header and has_header(definition)
        self._is_by_joint = any(joint for _, joint in paths)
        found = [check_path(topic, definition, path, joint) for path, joint in paths]
        if self._by_header:
            found += [check_path(topic, definition, path) for path in STAMP_PATHS]
        self._decoder = Decoder(definition, found)
        self._n_paths, self._n_values = len(paths), 0
        self._parts: list[tuple[Array, Array, Array]] = []

    def take(self, batch: Batch) -> None:
        """Take messages.

        Raises
        ------
        LogError
            if one is damaged, or there are too many.
        """
        self._n_values += batch.size.size * max(self._n_paths, 1)
        if self._n_values > MAX_VALUES:
            raise LogError(f"{self._place}: topic {shown(self.topic)} has more than {MAX_VALUES} values")
        values, damaged = self._decoder.decode(batch.data, batch.start, batch.size)
        if damaged.any():
            text = f"topic {shown(self.topic)} has {int(damaged.sum())} messages that are not as defined"
            self._faults.found(self._place, DAMAGED_MESSAGE, text, int(damaged.sum()))
        stamp_ns = batch.log_ns
        if self._by_header:
            seconds, rest = values[:, self._n_paths], values[:, self._n_paths + 1]
            known = np.isfinite(seconds) & np.isfinite(rest)
            whole, part = (np.where(known, each, 0).astype(np.int64) for each in (seconds, rest))
            stamp_ns = whole * 1_000_000_000 + part
        values = values[:, : self._n_paths]
        kept = ~damaged
        if self._is_by_joint:  # a robot may send its joints in several messages
            kept &= np.isfinite(values).any(axis=1)
        self._parts.append((batch.log_ns[kept], stamp_ns[kept], values[kept]))

    def numbers(self) -> Numbers:
        """Return what was collected, in the order of log times."""
        if not self._parts:
            return Numbers(np.empty(0, dtype=np.int64), np.empty((0, self._n_paths)))
        log_ns, stamp_ns, values = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        self._parts = []
        if np.any(np.diff(log_ns) < 0):
            order = np.argsort(log_ns, kind="stable")
            stamp_ns, values = stamp_ns[order], values[order]
        return Numbers(stamp_ns, values)


class TextCollector:
    """Texts of the messages of a topic of ``std_msgs/String``, with their log times.

    Parameters
    ----------
    place : of the bag, as messages name it
    topic : whose messages are taken
    faults : gets what is damaged
    most : texts that are taken
    """

    def __init__(self, place: str, topic: str, faults: Faults, most: int) -> None:
        self.topic, self._place, self._faults, self._most = topic, place, faults, most
        self._texts: list[tuple[int, str]] = []

    def take(self, batch: Batch) -> None:
        """Take messages; those beyond the most that are taken are refused."""
        if len(self._texts) + batch.size.size > self._most:
            raise LogError(f"{self._place}: topic {shown(self.topic)} has more than {self._most} messages")
        for log_ns, start, size in zip(
            batch.log_ns.tolist(), batch.start.tolist(), batch.size.tolist(), strict=True
        ):
            message = bytes(batch.data[start : start + size])
            order = "big" if message[1:2] == b"\0" else "little"
            length = int.from_bytes(message[4:8], order)  # type: ignore[arg-type]
            try:
                if size < 8 or message[0] or length > size - 8:
                    raise ValueError
                self._texts.append((log_ns, message[8 : 8 + length].rstrip(b"\0").decode()))
            except ValueError:
                text = f"topic {shown(self.topic)} has a message that is no text"
                self._faults.found(self._place, DAMAGED_MESSAGE, text)

    def texts(self) -> list[tuple[int, str]]:
        """Return log times in ns with the texts, in order."""
        return sorted(self._texts, key=lambda each: each[0])


Taker = Callable[[Batch], None]
