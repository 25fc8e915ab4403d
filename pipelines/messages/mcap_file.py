"""Messages of an MCAP file, read from its beginning: what a logger that was killed has left is read too.

A file is a row of records: an opcode, a length and a content.  Messages lie in chunks, which may be packed,
or beside them; what a file states of its own sizes is judged before it is unpacked.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from pipelines.messages.definitions import MISSING_PACKAGE
from pipelines.messages.storage import (
    DAMAGED_BLOCK,
    DAMAGED_MESSAGE,
    EARLY_END,
    MAX_MESSAGE_BYTES,
    Batch,
    Faults,
    Topic,
)
from terrain.errors import ConfigError, LogError
from terrain.files.names import shown
from terrain.files.regular import MEBIBYTE
from terrain.logs.log_files import short_name

MAGIC = b"\x89MCAP0\r\n"

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 2, 3, 4, 5, 6, 15
"""Opcodes of the records that are read; the others are passed over."""

MAX_RATIO = 200
"""Most that a chunk of more than 16 MiB may grow by when it is unpacked; measurements grow by 2 to 20."""

SMALL_BYTES = 16 * MEBIBYTE

MAX_DEFINITION_BYTES = MEBIBYTE

_BLOCK_BYTES = MEBIBYTE
_LATEST_NS = 2**63 - 1

_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_FOOTER = struct.Struct("<BQQQI")


class _Channel(NamedTuple):
    """A channel as the file describes it."""

    schema: int
    topic: str
    encoding: str


class McapFile:
    """An MCAP file.

    Parameters
    ----------
    path : of the file
    faults : gets what is damaged
    """

    def __init__(self, path: Path, faults: Faults) -> None:
        self._path, self._faults, self._place = path, faults, short_name(path)
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, _Channel] = {}

    def topics(self) -> list[Topic]:
        """Return the topics: those that the end of the file lists, else all that a walk through it finds.

        Raises
        ------
        LogError
            if the file is damaged.
        """
        self._schemas, self._channels = {}, {}
        try:
            with self._path.open("rb") as file:
                if not self._read_summary(file):
                    walk = McapFile(self._path, Faults(Counter()))  # faults are found when messages are read
                    for block in walk._blocks(file):
                        for _ in walk._messages(block, frozenset()):
                            pass
                    self._schemas, self._channels = walk._schemas, walk._channels
        except OSError as error:
            raise LogError(f"{self._place}: cannot be read ({error.strerror or error})") from error
        found = [
            Topic(channel.topic, kind, channel.encoding, encoding, definition)
            for channel in self._channels.values()
            for kind, encoding, definition in [self._schemas.get(channel.schema, ("", "", ""))]
        ]
        for topic in found:
            if any(other.name == topic.name and other.kind != topic.kind for other in found):
                raise LogError(f"{self._place}: topic {shown(topic.name)} has messages of two types")
        return list({topic.name: topic for topic in found}.values())

    def batches(self, names: frozenset[str]) -> Iterator[Batch]:
        """Yield the messages of some topics.

        Raises
        ------
        LogError
            if the file is damaged.
        """
        self._schemas, self._channels = {}, {}
        try:
            with self._path.open("rb") as file:
                for block in self._blocks(file):
                    yield from self._messages(block, names)
        except OSError as error:
            raise LogError(f"{self._place}: cannot be read ({error.strerror or error})") from error

    def _read_summary(self, file: BinaryIO) -> bool:
        """Read the channels that the end of the file lists; return whether there are any."""
        end = file.seek(0, 2) - len(MAGIC) - _FOOTER.size
        if end < len(MAGIC):
            return False
        file.seek(end)
        footer = file.read(_FOOTER.size)
        op, length, start, _, crc = _FOOTER.unpack(footer)
        if op != FOOTER or length != 20 or file.read() != MAGIC or not len(MAGIC) < start < end:
            return False
        if end - start > MAX_MESSAGE_BYTES:
            return False
        file.seek(start)
        summary = file.read(end - start)
        if crc and zlib.crc32(summary + footer[:-4]) != crc:
            return False
        try:
            position = 0
            while position < len(summary):
                op, length = _HEAD.unpack_from(summary, position)
                self._describe(op, summary[position + 9 : position + 9 + length])
                position += 9 + length
        except (struct.error, LogError):
            return False
        return bool(self._channels) and all(
            not channel.schema or channel.schema in self._schemas for channel in self._channels.values()
        )

    def _blocks(self, file: BinaryIO) -> Iterator[bytes]:
        """Yield records of schemas, channels and messages, many at a time and unpacked."""
        size = file.seek(0, 2)
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise LogError(f"{self._place}: is no MCAP file, or its first bytes are damaged")
        loose = bytearray()
        while True:
            head = file.read(9)
            op, length = _HEAD.unpack(head) if len(head) == 9 else (0, size)
            if op == DATA_END or length > size - file.tell():
                break
            if op in (SCHEMA, CHANNEL, MESSAGE) and length <= MAX_MESSAGE_BYTES:
                loose += head + file.read(length)
            elif op == CHUNK and length <= MAX_MESSAGE_BYTES:
                if loose:
                    yield bytes(loose)
                    loose.clear()
                block = self._unpacked(file.read(length))
                if block is not None:
                    yield block
            else:
                if op in (SCHEMA, CHANNEL, MESSAGE, CHUNK):
                    self._faults.found(self._place, DAMAGED_BLOCK, f"a record has {length} bytes")
                file.seek(length, 1)
            if len(loose) > _BLOCK_BYTES:
                yield bytes(loose)
                loose.clear()
        if loose:
            yield bytes(loose)
        if op != DATA_END:
            self._faults.found(self._place, EARLY_END, "ends in the middle of a record, it was not closed")

    def _unpacked(self, chunk: bytes) -> bytes | None:
        """Return the records of a chunk; None where it is damaged."""
        try:
            _, _, size, crc = _CHUNK_HEAD.unpack_from(chunk)
            name_size = struct.unpack_from("<I", chunk, _CHUNK_HEAD.size)[0]
            place = _CHUNK_HEAD.size + 4 + name_size
            compression = chunk[_CHUNK_HEAD.size + 4 : place].decode("ascii")
            packed = struct.unpack_from("<Q", chunk, place)[0]
            content = chunk[place + 8 : place + 8 + packed]
            if size > MAX_MESSAGE_BYTES or size > max(MAX_RATIO * len(content), SMALL_BYTES):
                raise ValueError(f"a chunk of {len(content)} bytes would have {size} bytes when unpacked")
            block = _decompressed(compression, content, size)
            if len(block) != size:
                raise ValueError("a chunk has another size than it states")
            if crc and zlib.crc32(block) != crc:
                raise ValueError("a chunk has a wrong checksum")
        except (struct.error, ValueError) as error:
            text = "a chunk is cut off" if isinstance(error, struct.error) else str(error)
            self._faults.found(self._place, DAMAGED_BLOCK, " ".join(text.split())[:160])
            return None
        return block

    def _messages(self, block: bytes, names: frozenset[str]) -> Iterator[Batch]:
        """Yield the messages of a block of records, by channel."""
        found: dict[int, tuple[list[int], list[int], list[int]]] = {}
        sought: dict[int, bool] = {}
        position, end, op = 0, len(block), 0
        unpack, head_size = _MESSAGE_HEAD.unpack_from, _MESSAGE_HEAD.size
        while position < end:
            if end - position >= head_size:
                op, length, channel, _, log_ns, _ = unpack(block, position)
            elif end - position >= _HEAD.size:
                op, length = _HEAD.unpack_from(block, position)
            else:
                length = end
            after = position + 9 + length
            if after > end or (op == MESSAGE and length < head_size - 9):
                self._faults.found(self._place, DAMAGED_BLOCK, "a chunk ends in the middle of a record")
                break
            if op == MESSAGE:
                if channel not in sought:
                    sought[channel] = self._is_sought(channel, names)
                if sought[channel]:
                    times, starts, sizes = found.setdefault(channel, ([], [], []))
                    times.append(log_ns if log_ns <= _LATEST_NS else _LATEST_NS)
                    starts.append(position + head_size)
                    sizes.append(length + 9 - head_size)
            elif op in (SCHEMA, CHANNEL):
                self._describe(op, block[position + 9 : after])
            position = after
        for number, parts in found.items():
            times_ns, start, size = (np.array(part, dtype=np.int64) for part in parts)
            yield Batch(self._channels[number].topic, times_ns, block, start, size)

    def _is_sought(self, channel: int, names: frozenset[str]) -> bool:
        if channel not in self._channels:
            self._faults.found(
                self._place, DAMAGED_MESSAGE, f"a message is of channel {channel}, which is unknown"
            )
            return False
        return self._channels[channel].topic in names

    def _describe(self, op: int, content: bytes) -> None:
        """Take the record of a schema or a channel."""
        if op not in (SCHEMA, CHANNEL):
            return
        try:
            fields = _Fields(content)
            if op == SCHEMA:
                number, name, encoding = fields.number("<H"), fields.text(), fields.text()
                self._schemas[number] = (name, encoding, fields.text(MAX_DEFINITION_BYTES, "replace"))
            else:
                number, schema = fields.number("<H"), fields.number("<H")
                self._channels[number] = _Channel(schema, fields.text(), fields.text())
        except (struct.error, ValueError) as error:
            raise LogError(f"{self._place}: the description of a topic is damaged") from error


class _Fields:
    """Fields of a record, one after the other."""

    def __init__(self, content: bytes) -> None:
        self._content, self._position = content, 0

    def number(self, kind: str) -> int:
        found = struct.unpack_from(kind, self._content, self._position)[0]
        self._position += struct.calcsize(kind)
        return int(found)

    def text(self, most_bytes: int = 65536, errors: str = "strict") -> str:
        size = self.number("<I")
        part = self._content[self._position : self._position + size]
        if len(part) != size or size > most_bytes:
            raise ValueError("a text is cut off or too long")
        self._position += size
        return part.decode(errors=errors)


def _decompressed(compression: str, content: bytes, size: int) -> bytes:
    """Return what is packed, at most a byte more than its stated size; ``ValueError`` where it is damaged."""
    if compression == "":
        return content
    try:
        import lz4.frame
        import zstandard
    except ImportError as error:
        raise ConfigError(MISSING_PACKAGE) from error
    try:
        if compression == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(content) as reader:
                return bytes(reader.read(size + 1))
        if compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=size + 1))
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise ValueError(f"a chunk cannot be unpacked ({error})") from error
    raise ValueError(f"a chunk is packed by {shown(compression)}, lz4 and zstd are read")
