"""Names that files give, and files of strangers: regular ones of a bounded size, that lie where they seem to lie.

A name is what may name a run, a robot or a terrain, and messages show values in a bounded form.  Packaged YAML lies in
``data/`` in a checkout, in ``terrain/_data`` in a wheel.
"""

from __future__ import annotations

import re
import stat
import unicodedata
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

from terrain.errors import ConfigError, TerrainError

MEBIBYTE = 2**20

#: Characters of the longest name; file systems take 255 bytes, and writing adds some for a temporary name
MAX_NAME = 128
MAX_NAME_BYTES = 240  #: The same in bytes of UTF-8, of which letters of some scripts have three each
MAX_LISTED = 20  #: Names that a message lists: files can have thousands of columns
MAX_SHOWN = 120  #: Characters of a value that a message shows: files can hold values of megabytes

_FOLDER_NAME = re.compile(r"[^\W_][\w ._+-]*")
_SEPARATOR = re.compile(r"[/\\]")
# C0 and C1, separators of lines, marks that turn the direction of writing, and halves of UTF-16 pairs
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ufeff\ud800-\udfff]")


def name_fault(name: str) -> str | None:
    """Return why a text is no plain name, None where it is one.

    Letters of any language are accepted, and all signs but path separators and control characters.
    """
    if not name.strip():
        return "is empty"
    if len(name) > MAX_NAME:
        return f"is longer than {MAX_NAME} characters"
    if name.startswith("."):
        return "begins with a dot"
    if _SEPARATOR.search(name):
        return "holds a path separator"
    if has_control_characters(name):
        return "holds a control character"
    return f"is longer than {MAX_NAME_BYTES} bytes" if len(name.encode()) > MAX_NAME_BYTES else None


def has_control_characters(text: str) -> bool:
    """Return whether a text holds a control character, which a terminal would act on or hide."""
    return _CONTROL.search(text) is not None


def check_name(place: str, name: str, kind: type[TerrainError]) -> str:
    """Return a name that is a plain one, or raise an error of a kind; ``place`` is file and key, as messages name them.

    Examples
    --------
    >>> check_name("run.json: robot", "/etc/robot.yaml", TerrainError)
    Traceback (most recent call last):
    terrain.errors.TerrainError: run.json: robot '/etc/robot.yaml' is no plain name: it holds a path separator
    """
    fault = name_fault(name)
    if fault is not None:
        raise kind(f"{place} {shown(name)} is no plain name: it {fault}")
    return name


def printable(text: str) -> str:
    """Return a text on one line, with escapes for what cannot be printed and a terminal would act on."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def listed(names: Sequence[str]) -> str:
    """Return names as messages list them: the first ones, control characters as escapes."""
    first = [printable(name[:MAX_NAME]) for name in names[:MAX_LISTED]]
    more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
    return ", ".join(first) + more


def shown(value: Any) -> str:
    """Return a value as messages show it, in quotes where it is a text, and cut where it is long."""
    text = repr(value)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


def plain_name(name: str) -> bool:
    """Return whether a text can name a folder or a file on any system.

    Examples
    --------
    >>> plain_name("SNOW_01"), plain_name("../SNOW"), plain_name("trawa:1"), plain_name("")
    (True, False, False, False)
    """
    return _FOLDER_NAME.fullmatch(name) is not None and name_fault(name) is None


def normal_name(name: str) -> str:
    """Return a name in Unicode's normal form C, in which names are compared; file systems keep either form."""
    return unicodedata.normalize("NFC", name)


def read_regular(path: Path, place: str, kind: type[TerrainError], most_bytes: int) -> bytes:
    """Return the content of a regular file of so many bytes at most; an error of a kind, which names the place."""
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
    """Refuse a file that links lead out of a folder, or in a circle; the folder itself may be a link."""
    try:
        inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError) as error:
        raise kind(f"{place}: cannot be opened (a link that leads nowhere)") from error
    if not inside:
        raise kind(f"{place}: is a link that leads out of {folder}")


def data_folder(kind: str) -> Path:
    """Return the folder of packaged YAML of one kind: ``robots``, ``target_slip``."""
    package = Path(__file__).parents[1]
    installed = package / "_data" / kind
    return installed if installed.is_dir() else package.parent / "data" / kind


def packaged(kind: str) -> tuple[str, ...]:
    """Return the names of the packaged YAML of one kind."""
    return tuple(sorted(map(attrgetter("stem"), data_folder(kind).glob("*.yaml"))))


def described_file(name_or_path: str | Path, what: str, *kinds: str) -> Path:
    """Return a path that ends in ``.yaml`` or ``.yml`` as it is, or the packaged file of a name, of some kinds.

    ``ConfigError``, which says ``what`` is unknown, for any other name.
    """
    path, known = Path(name_or_path), list[str]()
    if path.suffix in (".yaml", ".yml"):
        return path
    for kind in kinds:
        known += packaged(kind)
        if str(name_or_path) in packaged(kind):
            return data_folder(kind) / f"{name_or_path}.yaml"
    names = ", ".join(known)
    raise ConfigError(f"{what} {shown(str(name_or_path))} is unknown: give one of {names}, or a .yaml file")
