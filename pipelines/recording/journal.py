"""The file that a recording grows in: appended to every few seconds, readable up to where it is torn.

A record is its length, a checksum and its content: a line of JSON, and the samples that the line describes.
The line of the first record names the run.  The file is hidden beside the run folder that it becomes.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from terrain.errors import LogError
from terrain.records import Array

VERSION = 1

SUFFIX = ".recording"

LARGEST_RECORD = 1 << 28
"""A length above it is that of a torn or foreign file."""

_HEAD = struct.Struct("<4sQI")
_MAGIC = b"TRec"


class Block(NamedTuple):
    """Samples of one stream: rows (n, 1 + c) of time and values."""

    stream: str
    channels: tuple[str, ...]
    rows: Array


class Record(NamedTuple):
    """Content of a journal between two flushes."""

    line: Mapping[str, Any]
    blocks: tuple[Block, ...] = ()


def journal_path(folder: Path, run_id: str) -> Path:
    """Return where the journal of a run lies, hidden beside its run folder.

    Examples
    --------
    >>> journal_path(Path("runs"), "field_3").name
    '.field_3.recording'
    """
    return folder / f".{run_id}{SUFFIX}"


def packed(record: Record) -> bytes:
    """Return a record as bytes.

    Examples
    --------
    >>> len(packed(Record({"run_id": "a"})))
    44
    """
    described = [[block.stream, block.channels, len(block.rows)] for block in record.blocks]
    line = json.dumps({**record.line, "streams": described}, separators=(",", ":"), allow_nan=False)
    content = b"\n".join(
        [line.encode(), b"".join(np.ascontiguousarray(b.rows, dtype="<f8").tobytes() for b in record.blocks)]
    )
    return _HEAD.pack(_MAGIC, len(content), zlib.crc32(content)) + content


def read_journal(path: Path) -> Iterator[Record]:
    """Yield the records of a journal up to the first that is not whole.

    Raises
    ------
    OSError
        if the file cannot be read.
    """
    with path.open("rb") as file:
        while (content := _content(file)) is not None:
            line, _, data = content.partition(b"\n")
            try:
                yield _record(json.loads(line), data)
            except (ValueError, TypeError, KeyError, RecursionError):
                return


def read_head(path: Path) -> Mapping[str, Any]:
    """Return the line of the first record of a journal.

    Raises
    ------
    LogError
        if it is not whole, or of another version.
    OSError
        if the file cannot be read.
    """
    first = next(read_journal(path), None)
    if first is None or first.line.get("version") != VERSION:
        raise LogError(f"{path.name}: is no recording that this package wrote")
    return first.line


def _content(file: BinaryIO) -> bytes | None:
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    magic, length, checksum = _HEAD.unpack(head)
    if magic != _MAGIC or length > LARGEST_RECORD:
        return None
    content = file.read(length)
    return content if len(content) == length and zlib.crc32(content) == checksum else None


def _record(line: dict[str, Any], data: bytes) -> Record:
    blocks, at = [], 0
    for stream, channels, n in line.pop("streams"):
        width = 1 + len(channels)
        rows = np.frombuffer(data, "<f8", n * width, at).reshape(n, width)
        blocks.append(Block(stream, tuple(channels), rows))
        at += rows.nbytes
    return Record(line, tuple(blocks))


class Journal:
    """A journal that is being written; no other process takes it while this one lives.

    Parameters
    ----------
    path : of a file that is not there yet

    Raises
    ------
    FileExistsError
        if there is one.
    OSError
        if it cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.n_bytes = path, 0
        self._file = path.open("xb", buffering=0)
        lock(self._file)

    def append(self, records: Sequence[Record]) -> None:
        """Write records and wait until they are on the disk.

        Raises
        ------
        OSError
            if they could not be written; what was written before stays readable.
        """
        content = memoryview(b"".join(packed(record) for record in records))
        self.n_bytes += len(content)
        while content:
            content = content[os.write(self._file.fileno(), content) :]
        os.fsync(self._file.fileno())
        if not os.fstat(self._file.fileno()).st_nlink:
            raise FileNotFoundError(f"{self.path} was removed")

    def close(self) -> None:
        """Close the file, which stays."""
        self._file.close()


def lock(file: Any) -> bool:
    """Lock a file while this process lives; False where another has locked it.

    Where the system has no such locks every file counts as free.
    """
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
