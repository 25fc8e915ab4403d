"""Many messages of one layout from columns of numbers: a message of zeros is filled in."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np

from pipelines.messages.cdr import ORIGIN, Decoder
from pipelines.messages.definitions import PRIMITIVES, SEQUENCE, SINGLE, Definition, check_path
from terrain.records import Array


def encode_columns(
    definition: Definition,
    columns: Mapping[str, Array],
    texts: Mapping[str, str | Sequence[str]],
    n_messages: int,
) -> list[bytes]:
    r"""Return messages as CDR, little-endian.

    Parameters
    ----------
    definition : of the messages
    columns : numbers (n,) by the path of their field; of the others 0 is written
    texts : string, or strings of an array, by path; empty where left out
    n_messages : number of messages

    Examples
    --------
    >>> from pipelines.messages.definitions import parse_definition
    >>> pair = parse_definition("a_msgs/msg/Pair", "string name\nint32 first")
    >>> encode_columns(pair, {"first": np.array([7, 8])}, {"name": "a"}, 2)[1]
    b'\x00\x01\x00\x00\x02\x00\x00\x00a\x00\x00\x00\x08\x00\x00\x00'
    """
    message = bytearray(b"\0\1\0\0")
    _append(message, definition, definition.root, "", texts, _lengths(columns))
    paths = [check_path("", definition, path) for path in columns]
    places = Decoder(definition, paths).layout_of(bytes(message)).places
    rows = np.tile(np.frombuffer(bytes(message), dtype=np.uint8), (n_messages, 1))
    for place, values in zip(places, columns.values(), strict=True):
        assert place is not None
        offset, kind = place
        content = np.ascontiguousarray(values, dtype=f"<{kind}")
        rows[:, offset : offset + int(kind[1])] = content.view(np.uint8).reshape(n_messages, -1)
    packed, size = rows.tobytes(), len(message)
    return [packed[start : start + size] for start in range(0, len(packed), size)]


def _lengths(columns: Mapping[str, Array]) -> dict[str, int]:
    """Return the length of each array of numbers, by its path: that which its last index needs."""
    found: dict[str, int] = {}
    for path in columns:
        name, _, index = path.rpartition("[")
        if name:
            found[name] = max(found.get(name, 0), int(index[:-1]) + 1)
    return found


def _append(
    message: bytearray,
    definition: Definition,
    kind: str,
    path: str,
    texts: Mapping[str, str | Sequence[str]],
    lengths: Mapping[str, int],
) -> None:
    for field in definition.fields[kind]:
        at = f"{path}.{field.name}" if path else field.name
        given = texts.get(at, "")
        n = 1 if field.length == SINGLE else field.length
        if field.length == SEQUENCE:
            n = len(given) if field.kind == "string" else lengths.get(at, 0)
            _add_number(message, n)
        elements = [given] if isinstance(given, str) else list(given)
        for index in range(n):
            if field.kind in PRIMITIVES:
                size = int(PRIMITIVES[field.kind][1])
                message += bytes((ORIGIN - len(message)) % size + size)
            elif field.kind == "string":
                content = elements[index].encode() + b"\0"
                _add_number(message, len(content))
                message += content
            else:
                _append(message, definition, field.kind, at, texts, lengths)


def _add_number(message: bytearray, number: int) -> None:
    message += bytes((ORIGIN - len(message)) % 4) + struct.pack("<I", number)
