"""What every kind of storage gives: topics, and messages in batches."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import NamedTuple, Protocol

import numpy as np

from terrain.errors import LogError
from terrain.files.regular import MEBIBYTE
from terrain.records import Array

MAX_MESSAGE_BYTES = 256 * MEBIBYTE
"""Of a message, and of a block of them once it is unpacked; an image has 20 MiB, blocks have 1 to 4."""

EARLY_END = "files that end early"
DAMAGED_BLOCK = "damaged blocks of messages"
DAMAGED_MESSAGE = "damaged messages"


class Topic(NamedTuple):
    """A topic: its type, how its messages are encoded, and the definition that the file holds of it."""

    name: str
    kind: str
    encoding: str
    schema_encoding: str
    definition: str


class Batch(NamedTuple):
    """Messages of one topic: log times (n,) in ns, and where in ``data`` each begins and how long it is."""

    topic: str
    log_ns: Array
    data: bytes | bytearray
    start: Array
    size: Array


class Faults:
    """What is wrong with a log: refused at once, or counted where it is repaired."""

    def __init__(self, repairs: Counter[str] | None) -> None:
        self.repairs = repairs

    def found(self, place: str, kind: str, text: str, n: int = 1) -> None:
        """Raise :class:`LogError`, or count."""
        if self.repairs is None:
            raise LogError(f"{place}: {text}; read it with --repair to leave that out")
        self.repairs[kind] += n


class Storage(Protocol):
    """One file of messages."""

    def topics(self) -> list[Topic]:
        """Return the topics that it has."""
        ...

    def batches(self, names: frozenset[str]) -> Iterator[Batch]:
        """Yield the messages of some topics, in the order in which they lie in the file."""
        ...


def batch_of(topic: str, log_ns: Iterable[int], messages: list[bytes]) -> Batch:
    """Return messages as a batch."""
    size = np.array([len(message) for message in messages], dtype=np.int64)
    start = np.concatenate([[0], np.cumsum(size)[:-1]]) if messages else size
    return Batch(topic, np.array(list(log_ns), dtype=np.int64), b"".join(messages), start, size)
