"""One process at a time: a lock that the kernel frees when its process ends, however it ends."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from terrain.errors import TerrainError

POLL_S = 0.05


@contextmanager
def file_lock(path: Path, timeout_s: float, purpose: str) -> Iterator[None]:
    """Hold the lock of a file, which is made where it is missing and stays.

    Parameters
    ----------
    path : of the lock file; its folder is made when missing
    timeout_s : how long another process is waited for
    purpose : what the other process does, for the message

    Raises
    ------
    TerrainError
        if another process holds the lock for too long, or the file cannot be made.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, file_lock(Path(folder) / ".lock", 1.0, "writes"):
    ...     (Path(folder) / ".lock").exists()
    True
    """
    until_s = time.monotonic() + timeout_s
    descriptor = _opened(path, until_s)
    try:
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= until_s:
                    raise TerrainError(
                        f"{path}: another process {purpose} and has not ended within {timeout_s:g} s; try "
                        "again when it has"
                    ) from None
                time.sleep(POLL_S)
        yield
    finally:
        os.close(descriptor)  # frees the lock


def _opened(path: Path, until_s: float) -> int:
    """Open the file; another process may remove an empty folder between its making and its use."""
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except (FileNotFoundError, FileExistsError) as error:
            if path.parent.is_file() or time.monotonic() >= until_s:
                raise TerrainError(f"{path}: cannot be written ({error.strerror})") from error
        except OSError as error:
            raise TerrainError(f"{path}: cannot be written ({error.strerror or error})") from error
