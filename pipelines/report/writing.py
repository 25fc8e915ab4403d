"""Checks of files that are to be written, before the work is done."""

from __future__ import annotations

from pathlib import Path

from terrain.errors import ConfigError
from terrain.files.atomic import ensure_writable

ENDINGS = (".html", ".md")
"""Of reports."""


def check_file(path: Path, option: str, endings: tuple[str, ...] = ()) -> None:
    """Refuse a file that cannot be written.

    Raises
    ------
    ConfigError
        if it is a folder, has none of the endings, or nothing can be written there.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; {option} names a file")
    if endings and path.suffix.lower() not in endings:
        raise ConfigError(
            f"{option} is {str(path)!r}; a name that ends in {' or '.join(endings)} is required"
        )
    ensure_writable(path.parent)
