"""Messages of a storage file of rosbag2 in SQLite (``.db3``)."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from urllib.parse import quote

from pipelines.messages.storage import (
    DAMAGED_MESSAGE,
    EARLY_END,
    MAX_MESSAGE_BYTES,
    Batch,
    Faults,
    Topic,
    batch_of,
)
from terrain.errors import LogError
from terrain.files.names import shown
from terrain.logs.log_files import short_name

BATCH = 4096
"""Messages that are fetched at once."""

BATCH_BYTES = 16 * 2**20

MIN_ROW_BYTES = 4
"""A file cannot hold more messages than one in so many bytes; a damaged one may repeat its pages."""

_LATEST_NS = 2**63 - 1


class SqliteFile:
    """A storage file.

    Parameters
    ----------
    path : of the file
    faults : gets what is damaged
    """

    def __init__(self, path: Path, faults: Faults) -> None:
        self._path, self._faults, self._place = path, faults, short_name(path)

    def topics(self) -> list[Topic]:
        """Return the topics.

        Raises
        ------
        LogError
            if the file is damaged.
        """
        with self._opened() as store:
            definitions = {}
            if _is_table(store, "message_definitions"):
                query = "select topic_type, encoding, encoded_message_definition from message_definitions"
                for kind, encoding, text in store.execute(query).fetchmany(BATCH):
                    if encoding == "ros2msg" and isinstance(text, str):
                        definitions[kind] = text
            rows = store.execute("select name, type, serialization_format from topics").fetchmany(BATCH)
        if not all(isinstance(each, str) for row in rows for each in row):
            raise LogError(f"{self._place}: its list of topics is damaged")
        kinds: dict[str, str] = {}
        for name, kind, _ in rows:
            if kinds.setdefault(name, kind) != kind:
                raise LogError(f"{self._place}: topic {shown(name)} has messages of two types")
        return [
            Topic(name, kind, encoding, "ros2msg" if kind in definitions else "", definitions.get(kind, ""))
            for name, kind, encoding in {row[0]: row for row in rows}.values()
        ]

    def batches(self, names: frozenset[str]) -> Iterator[Batch]:
        """Yield the messages of some topics.

        Raises
        ------
        LogError
            if the file is damaged.
        """
        most = self._path.stat().st_size // MIN_ROW_BYTES
        try:
            with self._opened() as store:
                listed = store.execute("select id, name from topics").fetchmany(BATCH)
                topics = {number: name for number, name in listed if name in names}
                marks = ", ".join("?" * len(topics))
                cursor = store.execute(
                    f"select topic_id, timestamp, data from messages where topic_id in ({marks})",
                    list(topics),
                )
                for rows in _groups(cursor, most):
                    yield from self._batches(rows, topics)
        except LogError as error:
            if self._faults.repairs is None:
                raise
            self._faults.found(self._place, EARLY_END, str(error))

    def _batches(self, rows: list[tuple[object, object, object]], topics: dict[int, str]) -> Iterator[Batch]:
        by_topic: dict[str, tuple[list[int], list[bytes]]] = {}
        for number, log_ns, data in rows:
            if not isinstance(number, int) or not isinstance(log_ns, int) or not isinstance(data, bytes):
                self._faults.found(self._place, DAMAGED_MESSAGE, "a message has no time or no content")
                continue
            times, messages = by_topic.setdefault(topics[number], ([], []))
            times.append(log_ns)
            messages.append(data)
        for name, (times, messages) in by_topic.items():
            yield batch_of(name, times, messages)

    @contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        place = quote(str(self._path.absolute()))
        try:
            with closing(sqlite3.connect(f"file:{place}?mode=ro&immutable=1", uri=True)) as store:
                store.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
                store.execute("pragma trusted_schema = off")
                store.execute("pragma cell_size_check = on")
                for table in ("topics", "messages"):  # a view could take forever
                    if not _is_table(store, table):
                        raise LogError(f"{self._place}: is no bag, the table {table!r} is missing")
                yield store
        except (sqlite3.Error, UnicodeDecodeError, OverflowError) as error:
            text = " ".join(str(error).split())[:160]
            raise LogError(f"{self._place}: is no file of SQLite, or is damaged ({text})") from error


def _is_table(store: sqlite3.Connection, name: str) -> bool:
    query = (
        "select count(*) from sqlite_master where type = 'table' and name = ? and sql not like '%virtual%'"
    )
    return bool(store.execute(query, (name,)).fetchone()[0])


def _groups(cursor: sqlite3.Cursor, most: int) -> Iterator[list[tuple[object, object, object]]]:
    """Yield rows, some at a time; more than ``most`` are no rows of a whole file."""
    size = 0
    rows: list[tuple[object, object, object]] = []
    for n_read, row in enumerate(cursor, 1):
        if n_read > most:
            raise sqlite3.DatabaseError("pages are repeated")
        rows.append(row)
        size += len(row[2]) if isinstance(row[2], bytes) else 0
        if len(rows) >= BATCH or size >= BATCH_BYTES:
            yield rows
            rows, size = [], 0
    yield rows
