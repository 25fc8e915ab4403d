"""Reading files of strangers: regular ones of a bounded size, that lie where they seem to lie."""

from __future__ import annotations

import stat
from pathlib import Path

from terrain.errors import TerrainError

MEBIBYTE = 2**20


def read_regular(path: Path, place: str, kind: type[TerrainError], most_bytes: int) -> bytes:
    """Return the content of a regular file.

    Parameters
    ----------
    path : file to read
    place : as messages name it
    kind : of error that is raised
    most_bytes : that it may have

    Raises
    ------
    TerrainError
        of the kind, if it is missing, cannot be opened, is no regular file or is larger.
    """
    check_regular(path, place, kind)
    try:
        with path.open("rb") as file:
            content = file.read(most_bytes + 1)
    except OSError as error:
        raise kind(f"{place}: cannot be opened ({error.strerror or error})") from error
    if len(content) > most_bytes:
        raise kind(f"{place}: is larger than {most_bytes / MEBIBYTE:g} MiB, the most that is read")
    return content


def check_regular(path: Path, place: str, kind: type[TerrainError]) -> None:
    """Refuse what is no regular file: reading a pipe or a device need not end."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise kind(f"{place}: cannot be opened ({error.strerror or error})") from error
    except ValueError as error:  # a null character
        raise kind(f"{place}: cannot be opened ({error})") from error
    if not stat.S_ISREG(mode):
        what = "a folder" if stat.S_ISDIR(mode) else "a pipe, a socket or a device"
        raise kind(f"{place}: is {what}, a regular file is required")


def check_inside(path: Path, folder: Path, place: str, kind: type[TerrainError]) -> None:
    """Refuse a file that links lead out of a folder; the folder itself may be a link.

    Raises
    ------
    TerrainError
        of the kind, if the file lies elsewhere, or its links lead in a circle.
    """
    try:
        inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError) as error:
        raise kind(f"{place}: cannot be opened (a link that leads nowhere)") from error
    if not inside:
        raise kind(f"{place}: is a link that leads out of {folder}")
