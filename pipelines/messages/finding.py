"""Where bags lie in a folder, and which files each consists of."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from pipelines.messages.mcap_file import MAGIC, McapFile
from pipelines.messages.sqlite_file import SqliteFile
from pipelines.messages.storage import Faults, Storage
from terrain.errors import LogError
from terrain.files.documents import read_yaml
from terrain.files.names import shown
from terrain.logs.log_files import check_log_file, short_name

METADATA = "metadata.yaml"

SUFFIXES = (".mcap", ".db3")


class Bag(NamedTuple):
    """A bag: its storage files in order, and what names it.

    Parameters
    ----------
    path : the file, or the folder with ``metadata.yaml``
    files : with messages
    distro : release of ROS 2 that wrote it, as rosbags names it; empty where unknown
    """

    path: Path
    files: tuple[Path, ...]
    distro: str = ""


def find_bags(place: Path) -> list[Path]:
    """Return the bags under a folder, sorted: folders with ``metadata.yaml``, and files in no such folder.

    Parameters
    ----------
    place : a folder, a bag's folder or a file
    """
    if place.is_file():
        return [place] if place.suffix.lower() in SUFFIXES else []
    folders = {path.parent for path in place.rglob(METADATA) if _is_bag(path)}
    files = {
        path
        for path in place.rglob("*")
        if path.suffix.lower() in SUFFIXES
        and path.is_file()
        and path.parent not in folders
        and not any(part.startswith(".") for part in path.relative_to(place).parts)
    }
    return sorted(folders | files)


def _is_bag(path: Path) -> bool:
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
    document = read_yaml(check_log_file(path / METADATA, path))
    head = document.get("rosbag2_bagfile_information") if isinstance(document, dict) else None
    names = head.get("relative_file_paths") if isinstance(head, dict) else None
    if (
        not isinstance(head, dict)
        or not isinstance(names, list)
        or not all(isinstance(n, str) for n in names)
    ):
        raise LogError(f"{place}: does not list the files of the bag")
    if head.get("compression_mode"):
        raise LogError(
            f"{place}: the bag is compressed by {shown(head['compression_mode'])}, which is not read: "
            f"'ros2 bag convert' writes it without, or as MCAP"
        )
    files = tuple(check_log_file(path / name, path) for name in names)
    if not files or any(file.suffix.lower() not in SUFFIXES for file in files):
        raise LogError(f"{place}: lists {shown(names)}, files {' or '.join(SUFFIXES)} are required")
    distro = head.get("ros_distro")
    return Bag(path, files, f"ROS2_{distro.upper()}" if isinstance(distro, str) else "")


def storage_of(path: Path, faults: Faults) -> Storage:
    """Return the reader of a file of messages, by its first bytes."""
    try:
        with path.open("rb") as file:
            begin = file.read(len(MAGIC))
    except OSError as error:
        raise LogError(f"{short_name(path)}: cannot be opened ({error.strerror or error})") from error
    return McapFile(path, faults) if begin == MAGIC or path.suffix == ".mcap" else SqliteFile(path, faults)
