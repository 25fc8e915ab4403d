"""MCAP files: written at once or as a run comes, and read from their beginning.

A file is a row of records.  What a program that was killed has left is read too, as far as it is whole; what
a file states of its own sizes is judged before it is unpacked.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from terrain import errors
from terrain.errors import LogError, one_line
from terrain.files.names import shown
from terrain.files.regular import MEBIBYTE
from terrain.logs.faults import DAMAGED_BLOCK, EARLY_END, Faults, Topic
from terrain.logs.log_files import short_name
from terrain.logs.read import RunHead
from terrain.logs.run_topics import Messages

if TYPE_CHECKING:
    from mcap.records import Chunk

library = partial(
    errors.library, need="bags need the packages rosbags, mcap and mcap-protobuf-support", extra="logs"
)

LIBRARY = "terrain-slip"
MAGIC = b"\x89MCAP0\r\n"

MAX_RECORD_BYTES = 256 * MEBIBYTE
"""Of a message, and of a block of them once it is unpacked; an image has 20 MiB, blocks have 1 to 4."""

MAX_RATIO = 200
"""Most that a chunk of more than 16 MiB may grow by when it is unpacked; measurements grow by 2 to 20."""

SMALL_BYTES = 16 * MEBIBYTE

_LATEST_NS = 2**63 - 1


class McapWriter:
    """Topics and their messages as an MCAP file of profile ROS 2.

    Parameters
    ----------
    file : opened for writing
    head : of the run; tools that list a file's metadata show it
    """

    def __init__(self, file: BinaryIO, head: RunHead) -> None:
        mcap = library("mcap.writer")
        self._file = file
        self._writer = mcap.Writer(file, compression=mcap.CompressionType.ZSTD)
        self._writer.start(profile="ros2", library=LIBRARY)
        texts = {name: value for name, value in head if isinstance(value, str)}
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


def mcap_topics(path: Path) -> list[Topic]:
    """Return the topics of a file: those that its end lists, else all that a walk through it finds."""
    records, reader = library("mcap.records"), library("mcap.reader")
    try:
        with path.open("rb") as file:
            summary = reader.SeekingReader(file, record_size_limit=MAX_RECORD_BYTES).get_summary()
    except OSError as error:
        raise LogError(f"{short_name(path)}: cannot be read ({error.strerror or error})") from error
    except Exception:  # whatever the end of a file that was not closed looks like
        summary = None
    if summary and summary.channels:
        return [_topic(each, summary.schemas) for each in summary.channels.values()]
    schemas, channels = {}, {}
    for record in _records(path, Faults(Counter())):  # faults are found when messages are read
        if isinstance(record, records.Schema):
            schemas[record.id] = record
        elif isinstance(record, records.Channel):
            channels[record.id] = record
    return [_topic(each, schemas) for each in channels.values()]


def _topic(channel: Any, schemas: Mapping[int, Any]) -> Topic:
    schema = schemas.get(channel.schema_id)
    if schema is None:
        return Topic(channel.topic, "", channel.message_encoding, "", "")
    text = schema.data.decode("latin-1" if schema.encoding == "protobuf" else "utf-8", "replace")
    return Topic(channel.topic, schema.name, channel.message_encoding, schema.encoding, text)


def mcap_messages(path: Path, names: frozenset[str], faults: Faults) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, log time in ns and content of the messages of some topics, in the order of the file."""
    from mcap.records import Channel, Message

    channels: dict[int, str] = {}
    for record in _records(path, faults):
        if isinstance(record, Message):
            topic = channels.get(record.channel_id)
            if topic is None:
                text = f"a message is of channel {record.channel_id}, which is unknown"
                faults.found(short_name(path), DAMAGED_BLOCK, text)
            elif topic in names:
                yield topic, min(record.log_time, _LATEST_NS), record.data
        elif isinstance(record, Channel):
            channels[record.id] = record.topic


def _records(path: Path, faults: Faults) -> Iterator[Any]:
    """Yield the records before the end of the data, those of chunks too."""
    from mcap.exceptions import EndOfFile, McapError
    from mcap.records import Chunk, DataEnd
    from mcap.stream_reader import StreamReader

    place = short_name(path)
    try:
        with path.open("rb") as file:
            file.seek(len(MAGIC))
            reader = StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES)
            for record in reader.records:
                if isinstance(record, DataEnd):
                    return
                if isinstance(record, Chunk):
                    yield from _chunk_records(place, record, faults)
                else:
                    yield record
    except OSError as error:
        raise LogError(f"{place}: cannot be read ({error.strerror or error})") from error
    except (EndOfFile, struct.error):
        faults.found(place, EARLY_END, "ends in the middle of a record, it was not closed")
    except (McapError, ValueError) as error:
        faults.found(place, DAMAGED_BLOCK, one_line(error))


def _chunk_records(place: str, chunk: Chunk, faults: Faults) -> list[Any]:
    """Return the records of a chunk; none where it is damaged."""
    from mcap.exceptions import EndOfFile
    from mcap.stream_reader import breakup_chunk

    try:
        unpacked = replace(chunk, compression="", data=_unpacked(chunk))
        return list(breakup_chunk(unpacked, validate_crc=True))
    except (EndOfFile, struct.error):
        text = "a chunk ends in the middle of a record"
    except ValueError as error:
        text = one_line(error)
    faults.found(place, DAMAGED_BLOCK, text)
    return []


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
