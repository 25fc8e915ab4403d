"""Files of messages: where bags lie in a folder, what reads and writes each, and how messages are decoded.

MCAP is read from its beginning, as a row of records: what a program that was killed has left is read too, as
far as it is whole, and what a file states of its own sizes is judged before it is unpacked.  The SQLite of
ROS 2 and bags of ROS 1 are read by rosbags.  Messages are decoded by rosbags (CDR, ROS 1),
mcap-protobuf-support or :mod:`json`.
"""

from __future__ import annotations

import bz2
import json
import re
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple
from urllib.parse import quote

from pydantic import BaseModel

from terrain import errors
from terrain.errors import LogError, TerrainError, one_line
from terrain.files.documents import accepted, read_yaml
from terrain.files.names import MEBIBYTE, shown
from terrain.logs.mapping import DAMAGED_BLOCK, DISTRO, EARLY_END, Faults, Topic, short_type
from terrain.logs.run_folders import RunHead
from terrain.logs.run_topics import Messages
from terrain.logs.samples import check_log_file, short_name

if TYPE_CHECKING:
    from mcap.records import Chunk

library = partial(
    errors.library, need="bags need the packages rosbags, mcap and mcap-protobuf-support", extra="logs"
)

METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3", ".bag")

MCAP_MAGIC = b"\x89MCAP0\r\n"
ROS1_MAGIC = b"#ROSBAG V2.0\n"
SQLITE_MAGIC = b"SQLite format 3\0"

_TYPE = re.compile(r"[A-Za-z]\w*/[a-z]+/[A-Za-z]\w*")

MAX_DEFINITION_CHARACTERS = 1 << 18
MAX_ELEMENTS = 10_000
"""Bounds of a definition: those of ROS have a few hundred characters, and arrays of a few messages."""

MAX_RECORD_BYTES = 256 * MEBIBYTE
"""Of a message, and of a block of them once it is unpacked; an image has 20 MiB, blocks have 1 to 4."""

MAX_RATIO = 200
"""Most that a chunk of more than 16 MiB may grow by when it is unpacked; measurements grow by 2 to 20."""

SMALL_BYTES = 16 * MEBIBYTE

_LATEST_NS = 2**63 - 1


class Bag(NamedTuple):
    """A bag: its files in order, and what names it."""

    path: Path  #: the file, or the folder with ``metadata.yaml``
    files: tuple[Path, ...]  #: with messages
    distro: str = ""  #: release of ROS 2 that wrote it, as rosbags names it; empty where unknown


class _Head(BaseModel):
    relative_file_paths: list[str]
    compression_mode: str | None = None
    ros_distro: str | None = None


class _Metadata(BaseModel):
    """What ``metadata.yaml`` has to state."""

    rosbag2_bagfile_information: _Head


def find_bags(place: Path) -> list[Path]:
    """Return the bags under a folder, sorted: folders with ``metadata.yaml``, and files in no such folder.

    Parameters
    ----------
    place : a folder, a bag's folder or a file
    """
    if place.is_file():
        return [place] if place.suffix.lower() in SUFFIXES else []
    folders = set()
    for path in place.rglob(METADATA):
        with suppress(OSError), path.open("rb") as file:
            if b"rosbag2_bagfile_information" in file.read(4096):  # other programs have files of that name
                folders.add(path.parent)
    files = {
        path
        for path in place.rglob("*")
        if path.suffix.lower() in SUFFIXES
        and path.is_file()
        and path.parent not in folders
        and not any(part.startswith(".") for part in path.relative_to(place).parts)
    }
    return sorted(folders | files)


def open_bag(path: Path) -> Bag:
    """Return what a bag consists of.

    Raises
    ------
    LogError
        if its description is damaged, its messages are compressed one by one, or a file is missing.
    """
    if path.is_file():
        return Bag(path, (check_log_file(path, path.parent),))
    place = short_name(path / METADATA)
    content = read_yaml(check_log_file(path / METADATA, path))
    found = accepted(_Metadata, content, place, LogError, "does not list the files of the bag")
    head = found.rosbag2_bagfile_information
    if head.compression_mode:
        raise LogError(
            f"{place}: the bag is compressed by {shown(head.compression_mode)}, which is not read: "
            f"'ros2 bag convert' writes it without, or as MCAP"
        )
    files = tuple(check_log_file(path / name, path) for name in head.relative_file_paths)
    if not files or any(file.suffix.lower() not in SUFFIXES for file in files):
        raise LogError(
            f"{place}: lists {shown(head.relative_file_paths)}, files {' or '.join(SUFFIXES)} are required"
        )
    return Bag(path, files, f"ROS2_{head.ros_distro.upper()}" if head.ros_distro else "")


def topics_of(bag: Bag) -> dict[str, Topic]:
    """Return the topics of all files of a bag, by name.

    Raises
    ------
    LogError
        if a file is damaged or of an unknown type, or a topic has two types.
    """
    found: dict[str, Topic] = {}
    for file in bag.files:
        magic = _magic(file)
        for topic in mcap_topics(file) if magic == MCAP_MAGIC else _rosbags_topics(file, magic):
            if found.setdefault(topic.name, topic).kind != topic.kind:
                place = short_name(bag.path)
                raise LogError(f"{place}: topic {shown(topic.name)} has messages of two types")
    return found


def messages_of(bag: Bag, names: frozenset[str], faults: Faults) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, log time in ns and content of the messages of some topics, of one file after another.

    Those of a file of MCAP come in its order, of others in the order of log times.

    Raises
    ------
    LogError
        if a file is damaged, unless faults are counted.
    """
    for file in bag.files:
        magic = _magic(file)
        read = mcap_messages if magic == MCAP_MAGIC else partial(_rosbags_messages, magic)
        yield from read(file, names, faults)


def _magic(path: Path) -> bytes:
    """Return by which of the beginnings that are read a file begins."""
    try:
        with path.open("rb") as file:
            begin = file.read(len(SQLITE_MAGIC))
    except OSError as error:
        raise LogError(f"{short_name(path)}: cannot be opened ({error.strerror or error})") from error
    for magic in (MCAP_MAGIC, ROS1_MAGIC, SQLITE_MAGIC):
        if begin.startswith(magic):
            return magic
    what = f"begins with {begin[:12]!r}" if begin else "is empty"
    raise LogError(
        f"{short_name(path)}: {what}, which is no bag of a known type: MCAP, SQLite of ROS 2 (.db3) and bags "
        "of ROS 1 (.bag, version 2.0) are read"
    )


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
        self._writer.start(profile="ros2", library="terrain-slip")
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
            file.seek(len(MCAP_MAGIC))
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
        content = _unpacked(chunk.data, chunk.compression, chunk.uncompressed_size)
        return list(breakup_chunk(replace(chunk, compression="", data=content), validate_crc=True))
    except (EndOfFile, struct.error):
        text = "a chunk ends in the middle of a record"
    except ValueError as error:
        text = one_line(error)
    faults.found(place, DAMAGED_BLOCK, text)
    return []


def _unpacked(packed: bytes, compression: str, size: int) -> bytes:
    """Return the content of a chunk; ``ValueError`` where it is damaged, or would grow too large."""
    if size > MAX_RECORD_BYTES or size > max(MAX_RATIO * len(packed), SMALL_BYTES):
        raise ValueError(f"a chunk of {len(packed)} bytes would have {size} bytes when unpacked")
    if compression not in ("", "lz4", "zstd"):
        raise ValueError(f"a chunk is packed by {shown(compression)}, lz4 and zstd are read")
    content = packed
    if compression:
        lz4, zstandard = library("lz4.frame"), library("zstandard")
        try:
            if compression == "zstd":
                with zstandard.ZstdDecompressor().stream_reader(packed) as reader:
                    content = bytes(reader.read(size + 1))
            else:
                content = bytes(lz4.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
        except (zstandard.ZstdError, RuntimeError, EOFError) as error:
            raise ValueError(f"a chunk cannot be unpacked ({error})") from error
    if len(content) != size:
        raise ValueError("a chunk is cut off, or has another size than it states")
    return content


def _open_by_rosbags(path: Path, magic: bytes) -> Any:
    """Return the reader of rosbags of a bag of ROS 1, or of a storage file of ROS 2 in SQLite."""
    rosbags = library("rosbags.rosbag1" if magic == ROS1_MAGIC else "rosbags.rosbag2")
    try:
        if magic == SQLITE_MAGIC:  # to look into a view could take forever
            query = (
                "select count(*) from sqlite_master where name in ('topics', 'messages') "
                "and type = 'table' and sql not like '%virtual%'"
            )
            place = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"
            with closing(sqlite3.connect(place, uri=True)) as store:
                if store.execute(query).fetchone()[0] != 2:
                    raise LogError(
                        f"{short_name(path)}: is no bag, it lacks the tables 'topics' and 'messages'"
                    )
        reader = rosbags.Reader(path)
        reader.open()
    except TerrainError:
        raise
    except Exception as error:  # whatever the library makes of a damaged file
        raise LogError(f"{short_name(path)}: is damaged ({one_line(error)})") from error
    if magic == ROS1_MAGIC:
        for position, chunk in reader.chunks.items():
            reader.chunks[position] = chunk._replace(decompressor=_bounded(chunk.decompressor))
    return reader


def _bounded(decompress: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Return what unpacks a chunk of ROS 1 as the library's function does, but no more than is accepted."""
    lz4 = library("lz4.frame")
    unpackers = {bz2.decompress: bz2.BZ2Decompressor, lz4.decompress: lz4.LZ4FrameDecompressor}
    unpacker = unpackers.get(decompress)

    def unpack(packed: bytes) -> bytes:
        content = bytes(unpacker().decompress(packed, MAX_RECORD_BYTES + 1) if unpacker else packed)
        if len(content) > MAX_RECORD_BYTES:
            raise ValueError(f"a chunk of {len(packed)} bytes would have more than {MAX_RECORD_BYTES} bytes")
        return content

    return unpack


def _rosbags_topics(path: Path, magic: bytes) -> list[Topic]:
    found = []
    with closing(_open_by_rosbags(path, magic)) as reader:
        for each in reader.connections:
            if magic == ROS1_MAGIC:
                encoding, schema = "ros1", "ros1msg"
            else:
                encoding, schema = each.ext.serialization_format, f"ros2{each.msgdef.format.name.lower()}"
            found.append(Topic(each.topic, each.msgtype, encoding, schema, each.msgdef.data or ""))
    return found


def _rosbags_messages(
    magic: bytes, path: Path, names: frozenset[str], faults: Faults
) -> Iterator[tuple[str, int, bytes]]:
    with closing(_open_by_rosbags(path, magic)) as reader:
        connections = [each for each in reader.connections if each.topic in names]
        try:
            for connection, log_ns, content in reader.messages(connections) if connections else ():
                yield connection.topic, log_ns, content
        except ValueError as error:
            faults.found(short_name(path), DAMAGED_BLOCK, one_line(error))
        except Exception as error:  # whatever the library makes of a damaged file
            faults.found(short_name(path), EARLY_END, f"is damaged ({one_line(error)})")


def decoder_of(place: str, topic: Topic, distro: str) -> Callable[[bytes], Any]:
    """Return what makes an object (or, of JSON, a dictionary) of a message of a topic.

    Parameters
    ----------
    place : of the bag, as messages name it
    topic : of the bag
    distro : whose definitions are taken where the file has none

    Raises
    ------
    LogError
        if the encoding is unknown, or the messages are not defined.
    ConfigError
        if a package is missing.
    """
    at = f"{place}: topic {shown(topic.name)}"
    if topic.encoding == "json":
        return json.loads
    if topic.encoding not in ("cdr", "ros1", "protobuf"):
        raise LogError(f"{at} is encoded as {shown(topic.encoding)}; cdr, ros1, protobuf and json are read")
    try:
        if topic.encoding != "protobuf":
            return _of_ros(at, topic, distro)
        decoders, records = library("mcap_protobuf.decoder"), library("mcap.records")
        definition = topic.definition.encode("latin-1", "replace")
        schema = records.Schema(1, definition, topic.schema_encoding, topic.kind)
        decoder: Callable[[bytes], Any] | None = decoders.DecoderFactory().decoder_for("protobuf", schema)
        if decoder is None:
            raise LogError(f"{at} has a definition in {shown(topic.schema_encoding)}, 'protobuf' is read")
        return decoder
    except TerrainError:
        raise
    except RecursionError as error:
        raise LogError(f"{at}: its definition holds itself, or is too deep") from error
    except Exception as error:  # whatever a library makes of a damaged definition
        raise LogError(f"{at}: its definition is damaged ({one_line(error)})") from error


def _of_ros(at: str, topic: Topic, distro: str) -> Callable[[bytes], Any]:
    typesys = library("rosbags.typesys")
    nodes = library("rosbags.interfaces").Nodetype
    if len(topic.definition) > MAX_DEFINITION_CHARACTERS:
        raise LogError(f"{at}: its definition is longer than {MAX_DEFINITION_CHARACTERS} characters")
    package, _, name = short_type(topic.kind).partition("/")
    kind = f"{package}/msg/{name}"
    if topic.schema_encoding in ("ros1msg", "ros2msg", "ros2idl") and topic.definition.strip():
        types: dict[str, Any] = {}
        if topic.schema_encoding == "ros2idl":
            for part in topic.definition.split("=" * 80 + "\n"):
                idl = part.partition("\n")[2] if part.startswith("IDL:") else part
                types.update(typesys.get_types_from_idl(idl) if idl.strip() else {})
        else:
            types = dict(typesys.get_types_from_msg(topic.definition, kind))
        # names that are none, of which the library makes code, and arrays that would be very much code
        n_fields = n_elements = 0
        for each, (constants, fields) in types.items():
            names = [field[0] for field in (*constants, *fields)]
            if not _TYPE.fullmatch(each) or not all(map(str.isidentifier, names)):
                raise LogError(f"{at}: its definition has a name that is none: {shown(each)}")
            n_fields += len(fields)
            for _, (node, described) in fields:
                if node == nodes.ARRAY and (described[0][0] != nodes.BASE or "string" in described[0][1]):
                    n_elements += described[1]
        if max(n_fields, n_elements) > MAX_ELEMENTS:
            raise LogError(f"{at}: its definition has more than {MAX_ELEMENTS} fields or elements")
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        store.register(types)
    else:
        releases = typesys.Stores
        store = typesys.get_typestore(releases.__members__.get(distro, releases[DISTRO]))
    if kind not in store.types:
        raise LogError(f"{at} is of type {shown(topic.kind)}, which is not defined")
    store.get_msgdef(kind)
    deserialize = store.deserialize_cdr if topic.encoding == "cdr" else store.deserialize_ros1
    return lambda content: deserialize(content, kind)
