"""MCAP files: written at once or as a run comes, and read from their beginning.

A file is a row of records.  What a program that was killed has left is read too, as far as it is whole; what
a file states of its own sizes is judged before it is unpacked.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from terrain.errors import ConfigError, LogError, one_line
from terrain.files.names import shown
from terrain.files.regular import MEBIBYTE
from terrain.logs.faults import DAMAGED_BLOCK, EARLY_END, Faults, Topic
from terrain.logs.log_files import short_name
from terrain.logs.run_topics import Head, Messages

if TYPE_CHECKING:
    from mcap.records import Chunk

MISSING_PACKAGE = (
    "bags need the packages rosbags, mcap and mcap-protobuf-support: pip install 'terrain-slip[logs]'"
)

LIBRARY = "terrain-slip"
MAGIC = b"\x89MCAP0\r\n"

MAX_RECORD_BYTES = 256 * MEBIBYTE
"""Of a message, and of a block of them once it is unpacked; an image has 20 MiB, blocks have 1 to 4."""

MAX_RATIO = 200
"""Most that a chunk of more than 16 MiB may grow by when it is unpacked; measurements grow by 2 to 20."""

SMALL_BYTES = 16 * MEBIBYTE

_LATEST_NS = 2**63 - 1


def library(name: str) -> Any:
    """Return a module of a package that not everybody needs.

    Raises
    ------
    ConfigError
        if the package is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise ConfigError(MISSING_PACKAGE) from error


class McapWriter:
    """Topics and their messages as an MCAP file of profile ROS 2.

    Parameters
    ----------
    file : opened for writing
    head : of the run; tools that list a file's metadata show it

    Raises
    ------
    ConfigError
        if mcap is not installed.
    """

    def __init__(self, file: BinaryIO, head: Head) -> None:
        library("mcap.writer")
        from mcap.writer import CompressionType, Writer

        self._file = file
        self._writer = Writer(file, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library=LIBRARY)
        texts = {name: value for name, value in head._asdict().items() if isinstance(value, str)}
        self._writer.add_metadata("terrain_run", texts)
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}

    def write(self, of: Messages, log_ns: int, content: bytes) -> None:
        """Write one of the messages of a topic, which is described before the first."""
        topic, kind, definition = of[:3]
        if (topic, kind) not in self._channels:
            if kind not in self._schemas:
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition.encode())
            self._channels[topic, kind] = self._writer.register_channel(topic, "cdr", self._schemas[kind])
        self._writer.add_message(self._channels[topic, kind], log_ns, content, log_ns)

    def flush(self) -> None:
        """End the chunk that is being filled, and give all to the system: it is readable then."""
        self._writer.flush()

    def finish(self) -> None:
        """Write the end of the file, which stays open, and give all to the system."""
        self._writer.finish()
        self._file.flush()


class McapReader:
    """An MCAP file.

    Parameters
    ----------
    path : of the file
    faults : gets what is damaged

    Raises
    ------
    ConfigError
        if mcap is not installed.
    """

    def __init__(self, path: Path, faults: Faults) -> None:
        self._path, self._faults, self._place = path, faults, short_name(path)
        library("mcap.stream_reader")

    def topics(self) -> list[Topic]:
        """Return the topics: those that the end of the file lists, else all that a walk through it finds.

        Raises
        ------
        LogError
            if the file cannot be read.
        """
        from mcap.reader import SeekingReader

        try:
            with self._path.open("rb") as file:
                summary = SeekingReader(file, record_size_limit=MAX_RECORD_BYTES).get_summary()
        except OSError as error:
            raise LogError(f"{self._place}: cannot be read ({error.strerror or error})") from error
        except Exception:  # whatever the end of a file that was not closed looks like
            summary = None
        schemas, channels = (
            (summary.schemas, summary.channels) if summary and summary.channels else self._walk()
        )
        return [_topic(each, schemas) for each in channels.values()]

    def _walk(self) -> tuple[dict[int, Any], dict[int, Any]]:
        """Return the schemas and channels in the order of the file, by number."""
        from mcap.records import Channel, Schema

        found: dict[type, dict[int, Any]] = {Schema: {}, Channel: {}}
        counted = McapReader(self._path, Faults(Counter()))  # faults are found when messages are read
        for record in counted._records():
            if type(record) in found:
                found[type(record)][record.id] = record
        return found[Schema], found[Channel]

    def messages(self, names: frozenset[str]) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, log time in ns and content of the messages of some topics, in the order of the file.

        Raises
        ------
        LogError
            if the file is damaged.
        """
        from mcap.records import Channel, Message

        channels: dict[int, str] = {}
        for record in self._records():
            if isinstance(record, Message):
                topic = channels.get(record.channel_id)
                if topic is None:
                    text = f"a message is of channel {record.channel_id}, which is unknown"
                    self._faults.found(self._place, DAMAGED_BLOCK, text)
                elif topic in names:
                    yield topic, min(record.log_time, _LATEST_NS), record.data
            elif isinstance(record, Channel):
                channels[record.id] = record.topic

    def _records(self) -> Iterator[Any]:
        """Yield the records before the end of the data, those of chunks too."""
        from mcap.exceptions import EndOfFile, McapError
        from mcap.records import Chunk, DataEnd
        from mcap.stream_reader import StreamReader

        try:
            with self._path.open("rb") as file:
                if file.read(len(MAGIC)) != MAGIC:
                    raise LogError(f"{self._place}: is no MCAP file")
                reader = StreamReader(
                    file, skip_magic=True, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES
                )
                for record in reader.records:
                    if isinstance(record, DataEnd):
                        return
                    if isinstance(record, Chunk):
                        yield from self._chunk_records(record)
                    else:
                        yield record
        except OSError as error:
            raise LogError(f"{self._place}: cannot be read ({error.strerror or error})") from error
        except (EndOfFile, struct.error):
            self._faults.found(self._place, EARLY_END, "ends in the middle of a record, it was not closed")
        except (McapError, ValueError) as error:
            self._faults.found(self._place, DAMAGED_BLOCK, one_line(error))

    def _chunk_records(self, chunk: Chunk) -> list[Any]:
        """Return the records of a chunk; none where it is damaged."""
        from mcap.exceptions import EndOfFile
        from mcap.stream_reader import breakup_chunk

        try:
            records: list[Any] = breakup_chunk(
                replace(chunk, compression="", data=_unpacked(chunk)), validate_crc=True
            )
            return records
        except (EndOfFile, struct.error):
            text = "a chunk ends in the middle of a record"
        except ValueError as error:
            text = one_line(error)
        self._faults.found(self._place, DAMAGED_BLOCK, text)
        return []


def _topic(channel: Any, schemas: Mapping[int, Any]) -> Topic:
    schema = schemas.get(channel.schema_id)
    if schema is None:
        return Topic(channel.topic, "", channel.message_encoding, "", "")
    text = schema.data.decode("latin-1" if schema.encoding == "protobuf" else "utf-8", "replace")
    return Topic(channel.topic, schema.name, channel.message_encoding, schema.encoding, text)


def _unpacked(chunk: Chunk) -> bytes:
    """Return the content of a chunk; ``ValueError`` where it is damaged, or would grow too large."""
    packed: bytes = chunk.data
    size: int = chunk.uncompressed_size
    if size > MAX_RECORD_BYTES or size > max(MAX_RATIO * len(packed), SMALL_BYTES):
        raise ValueError(f"a chunk of {len(packed)} bytes would have {size} bytes when unpacked")
    if chunk.compression not in ("", "lz4", "zstd"):
        raise ValueError(f"a chunk is packed by {shown(chunk.compression)}, lz4 and zstd are read")
    content = packed
    if chunk.compression:
        lz4, zstandard = library("lz4.frame"), library("zstandard")
        try:
            if chunk.compression == "zstd":
                with zstandard.ZstdDecompressor().stream_reader(packed) as reader:
                    content = bytes(reader.read(size + 1))
            else:
                content = bytes(lz4.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
        except (zstandard.ZstdError, RuntimeError, EOFError) as error:
            raise ValueError(f"a chunk cannot be unpacked ({error})") from error
    if len(content) != size:
        raise ValueError("a chunk is cut off, or has another size than it states")
    return content
