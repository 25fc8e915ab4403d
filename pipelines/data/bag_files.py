"""Files of messages: where bags lie in a folder, what reads each, and how its messages are decoded.

MCAP is read by :mod:`pipelines.data.mcap_file`, the SQLite of ROS 2 and bags of ROS 1 by rosbags.  Messages
are decoded by rosbags (CDR, ROS 1), mcap-protobuf-support or :mod:`json`.
"""

from __future__ import annotations

import bz2
import json
import re
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from pipelines.data.mcap_file import MAGIC, MAX_RECORD_BYTES, library, mcap_messages, mcap_topics
from terrain.errors import LogError, TerrainError, one_line
from terrain.files.documents import first_fault, read_yaml
from terrain.files.names import shown
from terrain.logs.faults import DAMAGED_BLOCK, EARLY_END, Faults, Topic
from terrain.logs.log_files import check_log_file, short_name
from terrain.logs.topic_mapping import DISTRO, short_type

METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3", ".bag")

ROS1_MAGIC = b"#ROSBAG V2.0\n"
SQLITE_MAGIC = b"SQLite format 3\0"

_TYPE = re.compile(r"[A-Za-z]\w*/[a-z]+/[A-Za-z]\w*")

MAX_DEFINITION_CHARACTERS = 1 << 18
MAX_ELEMENTS = 10_000
"""Bounds of a definition: those of ROS have a few hundred characters, and arrays of a few messages."""


class Bag(NamedTuple):
    """A bag: its files in order, and what names it.

    Parameters
    ----------
    path : the file, or the folder with ``metadata.yaml``
    files : with messages
    distro : release of ROS 2 that wrote it, as rosbags names it; empty where unknown
    """

    path: Path
    files: tuple[Path, ...]
    distro: str = ""


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
    folders = {path.parent for path in place.rglob(METADATA) if _is_description(path)}
    files = {
        path
        for path in place.rglob("*")
        if path.suffix.lower() in SUFFIXES
        and path.is_file()
        and path.parent not in folders
        and not any(part.startswith(".") for part in path.relative_to(place).parts)
    }
    return sorted(folders | files)


def _is_description(path: Path) -> bool:
    """Return whether a file is the description of a bag; other programs have files of that name."""
    try:
        with path.open("rb") as file:
            return b"rosbag2_bagfile_information" in file.read(4096)
    except OSError:
        return False


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
    try:
        found = _Metadata.model_validate(read_yaml(check_log_file(path / METADATA, path)))
    except ValidationError as error:
        raise LogError(f"{place}: does not list the files of the bag ({first_fault(error)})") from error
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
        for topic in mcap_topics(file) if magic == MAGIC else _rosbags_topics(file, magic):
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
        read = mcap_messages if magic == MAGIC else partial(_rosbags_messages, magic)
        yield from read(file, names, faults)


def _magic(path: Path) -> bytes:
    """Return by which of the beginnings that are read a file begins."""
    try:
        with path.open("rb") as file:
            begin = file.read(len(SQLITE_MAGIC))
    except OSError as error:
        raise LogError(f"{short_name(path)}: cannot be opened ({error.strerror or error})") from error
    for magic in (MAGIC, ROS1_MAGIC, SQLITE_MAGIC):
        if begin.startswith(magic):
            return magic
    what = f"begins with {begin[:12]!r}" if begin else "is empty"
    raise LogError(
        f"{short_name(path)}: {what}, which is no bag of a known type: MCAP, SQLite of ROS 2 (.db3) and bags "
        "of ROS 1 (.bag, version 2.0) are read"
    )


def _open_by_rosbags(path: Path, magic: bytes) -> Any:
    """Return the reader of rosbags of a bag of ROS 1, or of a storage file of ROS 2 in SQLite."""
    rosbags = library("rosbags.rosbag1" if magic == ROS1_MAGIC else "rosbags.rosbag2")
    try:
        if magic == SQLITE_MAGIC:
            _refuse_views(path)
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


def _refuse_views(path: Path) -> None:
    """Refuse a database whose messages are a view: to look into it could take forever."""
    query = (
        "select count(*) from sqlite_master where name in ('topics', 'messages') "
        "and type = 'table' and sql not like '%virtual%'"
    )
    place = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"
    with closing(sqlite3.connect(place, uri=True)) as store:
        if store.execute(query).fetchone()[0] != 2:
            raise LogError(f"{short_name(path)}: is no bag, it lacks the tables 'topics' and 'messages'")


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
        return _of_protobuf(at, topic) if topic.encoding == "protobuf" else _of_ros(at, topic, distro)
    except TerrainError:
        raise
    except RecursionError as error:
        raise LogError(f"{at}: its definition holds itself, or is too deep") from error
    except Exception as error:  # whatever a library makes of a damaged definition
        raise LogError(f"{at}: its definition is damaged ({one_line(error)})") from error


def _of_protobuf(at: str, topic: Topic) -> Callable[[bytes], Any]:
    decoders, records = library("mcap_protobuf.decoder"), library("mcap.records")
    definition = topic.definition.encode("latin-1", "replace")
    schema = records.Schema(1, definition, topic.schema_encoding, topic.kind)
    decoder: Callable[[bytes], Any] | None = decoders.DecoderFactory().decoder_for("protobuf", schema)
    if decoder is None:
        raise LogError(f"{at} has a definition in {shown(topic.schema_encoding)}, 'protobuf' is read")
    return decoder


def _of_ros(at: str, topic: Topic, distro: str) -> Callable[[bytes], Any]:
    typesys = library("rosbags.typesys")
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
        _refuse_strange_types(at, types)
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


def _refuse_strange_types(at: str, types: Mapping[str, Any]) -> None:
    """Refuse names that are none, of which the library makes code, and arrays that would be very much code."""
    from rosbags.interfaces import Nodetype

    n_fields = n_elements = 0
    for name, (constants, fields) in types.items():
        if not _TYPE.fullmatch(name) or not all(each[0].isidentifier() for each in (*constants, *fields)):
            raise LogError(f"{at}: its definition has a name that is none: {shown(name)}")
        n_fields += len(fields)
        for _, (node, described) in fields:
            if node == Nodetype.ARRAY and (described[0][0] != Nodetype.BASE or "string" in described[0][1]):
                n_elements += described[1]
    if max(n_fields, n_elements) > MAX_ELEMENTS:
        raise LogError(f"{at}: its definition has more than {MAX_ELEMENTS} fields or elements")
