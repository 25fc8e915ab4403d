"""Writing that is whole or not at all: a temporary name beside the target, then a rename."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from terrain.errors import TerrainError

ATTEMPTS = 100
"""How often a folder is made that another process removes; each attempt takes some microseconds."""


def atomic_write(path: str | Path, content: bytes | str) -> None:
    """Write a file so that at every instant either the old content or all of the new one is there.

    Parameters
    ----------
    path : file to write or replace; its folder is made when missing
    content : bytes, or text that is written as UTF-8

    Raises
    ------
    TerrainError
        if the place cannot be written; nothing is left behind.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     atomic_write(Path(folder) / "report.json", "{}")
    ...     (Path(folder) / "report.json").read_text()
    '{}'
    """
    with atomic_file(Path(path)) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Give a file to write; when the block ends well it becomes ``path``, else it is removed.

    Parameters
    ----------
    path : file to write or replace; its folder is made when missing

    Raises
    ------
    TerrainError
        if the place cannot be written; what was there is there still.
    """
    temporary = _name_beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise _not_written(path, error) from error


def ensure_writable(folder: str | Path) -> None:
    """Find out whether a folder can be made and written, so that long work does not end in a refusal.

    Raises
    ------
    TerrainError
        if the folder cannot be made or written; nothing is left behind.
    """
    folder = Path(folder).absolute()
    made = [parent for parent in (folder, *folder.parents) if not parent.exists()]
    try:
        _try_to_write(folder)
    except OSError as error:
        raise _not_written(folder, error) from error
    finally:
        for parent in made:
            with suppress(OSError):  # another process writes there already
                parent.rmdir()


def _try_to_write(folder: Path) -> None:
    """Make a folder and a file in it; another process that tries the same may remove the folder meanwhile."""
    probe = _name_beside(folder / "probe")
    for attempt in range(ATTEMPTS):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            probe.touch()
            probe.unlink()
            return
        except (FileNotFoundError, FileExistsError):  # removed between two calls
            if attempt == ATTEMPTS - 1:
                raise


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Give an empty folder to fill; when the block ends well it becomes ``path``, else it is removed.

    A folder that already lies at ``path`` is set aside only once the new one is whole.

    Parameters
    ----------
    path : folder to make or replace; its parent is made when missing

    Raises
    ------
    TerrainError
        if the place cannot be written; what was there is there still.
    """
    temporary = _name_beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
        try:
            yield temporary
            _take_place(temporary, path)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
    except OSError as error:
        raise _not_written(path, error) from error


def _take_place(new: Path, path: Path) -> None:
    if not path.exists():
        new.rename(path)
        return
    aside = _name_beside(path)
    path.rename(aside)
    try:
        new.rename(path)
    except BaseException:
        aside.rename(path)
        raise
    shutil.rmtree(aside, ignore_errors=True)


def _name_beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")


def _not_written(path: Path, error: OSError) -> TerrainError:
    return TerrainError(f"{path}: cannot be written ({error.strerror or error})")
