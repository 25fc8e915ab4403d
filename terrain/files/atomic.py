"""Writing that is whole or not at all: a temporary name beside the target, then a rename; one process at a time.

A lock is freed by the kernel when its process ends, however it ends.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from terrain.errors import TerrainError

POLL_S = 0.05

#: How often a folder is made that another process removes; each attempt takes some microseconds.
ATTEMPTS = 100


@contextmanager
def file_lock(path: Path, timeout_s: float, purpose: str) -> Iterator[None]:
    """Hold the lock of a file, which is made with its folder where it is missing, and stays.

    ``TerrainError`` where another process, which does what ``purpose`` states, holds the lock for too long, or the
    file cannot be made.
    """
    until_s = time.monotonic() + timeout_s
    descriptor = -1
    try:
        while True:
            try:
                if descriptor < 0:
                    path.parent.mkdir(parents=True, exist_ok=True)
                    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= until_s:
                    ended = f"has not ended within {timeout_s:g} s; try again when it has"
                    raise TerrainError(f"{path}: another process {purpose} and {ended}") from None
                time.sleep(POLL_S)
            except OSError as error:
                # another process may remove an empty folder between its making and its use
                passing = isinstance(error, FileNotFoundError | FileExistsError) and not path.parent.is_file()
                if not passing or time.monotonic() >= until_s:
                    raise _not_written(path, error) from error
        yield
    finally:
        if descriptor >= 0:
            os.close(descriptor)  # frees the lock


def atomic_write(path: str | Path, content: bytes | str) -> None:
    """Write a file, text as UTF-8, so that at every instant either the old content or all of the new one is there.

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

    Its folder is made when missing.  ``TerrainError`` where the place cannot be written; what was there is there still.
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


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Give an empty folder to fill; when the block ends well it becomes ``path``, else it is removed.

    A folder that already lies at ``path`` is set aside only once the new one is whole; errors as :func:`atomic_file`.
    """
    temporary, aside = _name_beside(path), _name_beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
        try:
            yield temporary
            if path.exists():
                path.rename(aside)
            try:
                temporary.rename(path)
            except BaseException:
                if aside.exists():
                    aside.rename(path)
                raise
            shutil.rmtree(aside, ignore_errors=True)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
    except OSError as error:
        raise _not_written(path, error) from error


def ensure_writable(folder: str | Path) -> None:
    """Find out whether a folder can be made and written, so that long work does not end in a refusal.

    ``TerrainError`` where it cannot; nothing is left behind.  Another process that tries the same may remove the
    folder meanwhile.
    """
    folder = Path(folder).absolute()
    made = [parent for parent in (folder, *folder.parents) if not parent.exists()]
    probe = _name_beside(folder / "probe")
    try:
        for attempt in range(ATTEMPTS):
            try:
                folder.mkdir(parents=True, exist_ok=True)
                probe.touch()
                probe.unlink()
                break
            except (FileNotFoundError, FileExistsError):  # removed between two calls
                if attempt == ATTEMPTS - 1:
                    raise
    except OSError as error:
        raise _not_written(folder, error) from error
    finally:
        for parent in made:
            with suppress(OSError):  # another process writes there already
                parent.rmdir()


def _name_beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")


def _not_written(path: Path, error: OSError) -> TerrainError:
    return TerrainError(f"{path}: cannot be written ({error.strerror or error})")
