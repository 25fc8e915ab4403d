"""Definitions of ROS 2 messages: fields by type, and paths to fields looked up in them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

from terrain.errors import ConfigError, LogError
from terrain.files.names import listed, shown

MISSING_PACKAGE = "bags need the packages rosbags and mcap: pip install 'terrain-slip[logs]'"

ASSUMED_DISTRO = "ROS2_HUMBLE"
"""Whose definitions are taken for a bag that holds none and does not name its own."""

PRIMITIVES: Mapping[str, str] = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "float32": "f4",
    "float64": "f8",
    **{f"int{8 * n}": f"i{n}" for n in (1, 2, 4, 8)},
    **{f"uint{8 * n}": f"u{n}" for n in (1, 2, 4, 8)},
}
"""Type of numpy of each primitive, without its byte order; its digit is its size and alignment."""

SINGLE, SEQUENCE = -1, -2
"""Lengths of a field that is no array, and of one whose length comes with the message."""

MAX_DEPTH = 32
MAX_FIELDS = 10_000
MAX_ARRAY = 10_000_000
"""Bounds of what a definition may hold; those of ROS have a few dozen fields, five levels deep."""

_SEPARATOR = re.compile(r"^={20,}\s*$", re.MULTILINE)
_FIELD = re.compile(r"([A-Za-z][\w/]*)(?:<=\d+)?(\[(?:<=\d+|\d*)\])?\s+([A-Za-z]\w*)\s*(=?)")
_STEP = re.compile(r"([A-Za-z]\w*)(?:\[(\d{1,8})\])?")


class Field(NamedTuple):
    """A field of a message: ``kind`` is a primitive, ``string``, ``wstring`` or the name of a message."""

    name: str
    kind: str
    length: int


class Definition(NamedTuple):
    """Fields of a message and of those within it, by type (``sensor_msgs/Imu``)."""

    root: str
    fields: Mapping[str, tuple[Field, ...]]


class FieldPath(NamedTuple):
    """A path to a number: names with the index of an array, or the name of a joint that gives the index."""

    steps: tuple[tuple[str, int], ...]
    joint: str = ""


def short_type(name: str) -> str:
    """Return the name of a type without its middle part.

    Examples
    --------
    >>> short_type("sensor_msgs/msg/Imu")
    'sensor_msgs/Imu'
    """
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) == 3 else name


def parse_definition(name: str, text: str) -> Definition:
    """Return the fields of a message from the texts of its definition and of those it is made of.

    Parameters
    ----------
    name : of the type
    text : in the language of ``.msg`` files; further messages behind lines of ``=``, each after ``MSG: name``

    Raises
    ------
    LogError
        if a line is no field, a message is not defined or holds itself, or there is too much of it.

    Examples
    --------
    >>> parse_definition("a_msgs/msg/Rates", "float32[] rates # rad/s").fields["a_msgs/Rates"]
    (Field(name='rates', kind='float32', length=-2),)
    """
    root = short_type(name)
    parts = _SEPARATOR.split(text)
    texts = {root: parts[0]}
    for part in parts[1:]:
        head, _, rest = part.strip().partition("\n")
        if not head.startswith("MSG:"):
            raise LogError(f"definition of {shown(name)}: {shown(head)} is no line 'MSG: package/Type'")
        texts.setdefault(short_type(head[4:].strip()), rest)
    fields: dict[str, tuple[Field, ...]] = {}
    _add(root, texts, fields, (), name)
    return Definition(root, fields)


def _add(
    kind: str,
    texts: Mapping[str, str],
    fields: dict[str, tuple[Field, ...]],
    above: tuple[str, ...],
    name: str,
) -> None:
    if kind in above or len(above) >= MAX_DEPTH:
        raise LogError(f"definition of {shown(name)}: {shown(kind)} holds itself, or is too deep")
    if kind in fields:
        return
    if kind not in texts:
        raise LogError(f"definition of {shown(name)}: lacks that of {shown(kind)}")
    found = tuple(
        field for line in texts[kind].splitlines() if (field := _field(line, kind, texts, name)) is not None
    )
    for field in found:
        if field.kind not in PRIMITIVES and field.kind not in ("string", "wstring"):
            _add(field.kind, texts, fields, (*above, kind), name)
    fields[kind] = found or (Field("structure_needs_at_least_one_member", "uint8", SINGLE),)
    if sum(len(each) for each in fields.values()) > MAX_FIELDS:
        raise LogError(f"definition of {shown(name)}: has more than {MAX_FIELDS} fields")


def _field(line: str, owner: str, texts: Mapping[str, str], name: str) -> Field | None:
    line = line.partition("#")[0].strip()
    if not line:
        return None
    found = _FIELD.match(line)
    if found is None:
        raise LogError(f"definition of {shown(name)}: {shown(line)} is no field")
    kind, array, field, is_constant = found.groups()
    if is_constant:
        return None
    if kind not in PRIMITIVES and kind not in ("string", "wstring"):
        kind = _resolved(kind, owner, texts)
    if array is None:
        return Field(field, kind, SINGLE)
    digits = array[1:-1]
    if not digits.isdigit():
        return Field(field, kind, SEQUENCE)
    if not 0 < len(digits) <= 8 or not 0 < int(digits) <= MAX_ARRAY:
        raise LogError(f"definition of {shown(name)}: {shown(line)} has a length that is not accepted")
    return Field(field, kind, int(digits))


def _resolved(kind: str, owner: str, texts: Mapping[str, str]) -> str:
    if "/" in kind:
        return short_type(kind)
    return "std_msgs/Header" if kind == "Header" else f"{owner.partition('/')[0]}/{kind}"


def check_path(topic: str, definition: Definition, text: str, joint: str = "") -> FieldPath:
    """Return a path to a number of a message.

    Parameters
    ----------
    topic : as messages name it
    definition : of its messages
    text : as ``twist.linear.x`` or ``data[2]``
    joint : name that stands for the index of the last step

    Raises
    ------
    ConfigError
        if there is no such field, or it holds no number.

    Examples
    --------
    >>> rates = parse_definition("a_msgs/msg/Rates", "float32[] rates")
    >>> check_path("/rates", rates, "rates[1]")
    FieldPath(steps=(('rates', 1),), joint='')
    """
    steps: list[tuple[str, int]] = []
    kind, length = definition.root, SINGLE
    for part in text.split("."):
        found = _STEP.fullmatch(part)
        if found is None:
            raise ConfigError(f"field {shown(text)} is no path, as 'twist.linear.x' or 'data[2]' is one")
        if kind not in definition.fields:
            raise ConfigError(
                f"topic {topic}: field {shown(text)}: {steps[-1][0]!r} has no fields of its own"
            )
        fields = {field.name: field for field in definition.fields[kind]}
        if found[1] not in fields:
            raise ConfigError(
                f"topic {topic}: field {shown(text)}: {kind} has no {found[1]!r} (it has {listed([*fields])})"
            )
        _, kind, length = fields[found[1]]
        index = SINGLE if found[2] is None else int(found[2])
        _check_index(topic, text, found[1], index, length, bool(joint))
        steps.append((found[1], index))
    if kind not in PRIMITIVES:
        inner = (
            f" (it has {listed([f.name for f in definition.fields[kind]])})"
            if kind in definition.fields
            else ""
        )
        raise ConfigError(
            f"topic {topic}: field {shown(text)} is of type {kind}, a number is required{inner}"
        )
    return FieldPath(tuple(steps), joint)


def _check_index(topic: str, text: str, name: str, index: int, length: int, by_joint: bool) -> None:
    if by_joint:
        if length == SEQUENCE and index == SINGLE:
            return
        raise ConfigError(f"topic {topic}: field {shown(text)} is no array of joints")
    if (index == SINGLE) != (length == SINGLE):
        fault = (
            "is an array: give an index, as" if index == SINGLE else "is no array: leave the index out, as"
        )
        raise ConfigError(
            f"topic {topic}: field {shown(text)}: {name!r} {fault} {name}{'[0]' if index == SINGLE else ''}"
        )
    if length >= 0 and index >= length:
        raise ConfigError(
            f"topic {topic}: field {shown(text)}: {name!r} has {length} elements, counted from 0"
        )


def has_header(definition: Definition) -> bool:
    """Return whether messages begin with a header, whose stamp is that of the measurement."""
    return definition.fields[definition.root][0] == Field("header", "std_msgs/Header", SINGLE)


@lru_cache(maxsize=256)
def known_text(name: str, distro: str = ASSUMED_DISTRO) -> str:
    """Return the definition that a release of ROS 2 has of a type; empty where it has none.

    Parameters
    ----------
    name : of the type
    distro : as rosbags names releases; :data:`ASSUMED_DISTRO` where it has none of that name

    Raises
    ------
    ConfigError
        if rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ConfigError(MISSING_PACKAGE) from error
    store = get_typestore(Stores.__members__.get(distro, Stores[ASSUMED_DISTRO]))
    package, _, kind = short_type(name).partition("/")
    full = f"{package}/msg/{kind}"
    return str(store.generate_msgdef(full, ros_version=2)[0]) if full in store.types else ""
