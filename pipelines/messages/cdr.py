"""Numbers of serialized messages: all messages of one layout are decoded at once.

Where a number lies in a message of CDR depends only on the lengths of the strings and sequences before it.
One message is walked through; of the others, those of its size that have the same lengths at the same places
are read as columns.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipelines.messages.definitions import PRIMITIVES, SEQUENCE, SINGLE, Definition, Field, FieldPath
from terrain.records import Array

ORIGIN = 4
"""Bytes before the content, of which alignment is counted: they state the encoding."""

MAX_LAYOUTS = 64
"""Layouts of one size of message that are kept; further messages are walked through one by one."""

_KNOWN_SIZES = 4096


class UndecodableError(ValueError):
    """A message does not hold what its definition states."""


class Layout(NamedTuple):
    """Where the numbers of a message are.

    Parameters
    ----------
    fixed : (p,) places of the bytes that decide the layout
    content : (p,) those bytes
    places : offset and type of each number; None where the message lacks it
    """

    fixed: Array
    content: Array
    places: tuple[tuple[int, str] | None, ...]


class _Node:
    """Numbers that are looked for in a message, as a tree of its fields."""

    def __init__(self) -> None:
        self.children: dict[str, dict[int, _Node]] = {}
        self.leaves: list[int] = []
        self.joints: list[tuple[str, str, int]] = []

    def add(self, path: FieldPath, number: int) -> None:
        node = self
        if path.joint:
            self.joints.append((path.steps[0][0], path.joint, number))
            return
        for name, index in path.steps:
            node = node.children.setdefault(name, {}).setdefault(index, _Node())
        node.leaves.append(number)


class _Walk:
    """One walk through a message."""

    def __init__(self, definition: Definition, sought: _Node, n_numbers: int, data: bytes) -> None:
        if len(data) < ORIGIN or data[0] != 0 or data[1] > 1:
            raise UndecodableError("is not in plain CDR")
        self._fields, self._data = definition.fields, data
        self._order = "<" if data[1] else ">"
        self._position = ORIGIN
        self._left = n_numbers
        self._names: list[str] = []
        self.ranges: list[tuple[int, int]] = [(0, 2)]
        self.places: list[tuple[int, str] | None] = [None] * n_numbers
        self._message(definition.root, sought)

    def _message(self, kind: str, sought: _Node | None) -> None:
        joints: dict[str, list[tuple[str, int]]] = {}
        for array, joint, number in sought.joints if sought else ():
            joints.setdefault(array, []).append((joint, number))
        for field in self._fields[kind]:
            if not self._left:
                return
            inner = sought.children.get(field.name) if sought else None
            if joints and field.name == "name":
                self._read_names()
            elif field.length == SINGLE:
                self._single(field.kind, inner.get(SINGLE) if inner else None)
            else:
                self._array(field, inner, joints.get(field.name, []))

    def _single(self, kind: str, sought: _Node | None) -> None:
        if kind in PRIMITIVES:
            size = int(PRIMITIVES[kind][1])
            self._align(size)
            self._found(sought, self._position, PRIMITIVES[kind])
            self._skip(size)
        elif kind == "string":
            self._skip(self._length())
        elif kind == "wstring":
            raise UndecodableError("has a wide string before the field")
        else:
            self._message(kind, sought)

    def _array(self, field: Field, sought: dict[int, _Node] | None, joints: list[tuple[str, int]]) -> None:
        n = self._length() if field.length == SEQUENCE else field.length
        if n > len(self._data):
            raise UndecodableError("has an array that is longer than the message")
        if field.kind in PRIMITIVES:
            size = int(PRIMITIVES[field.kind][1])
            if n:
                self._align(size)
            start = self._position
            self._skip(n * size)
            for index, node in (sought or {}).items():
                self._found(node if index < n else None, start + index * size, PRIMITIVES[field.kind])
                self._left -= len(node.leaves) if index >= n else 0
            for joint, number in joints:
                self._left -= 1
                place = self._names.index(joint) if joint in self._names else n
                if place < n:
                    self.places[number] = (start + place * size, PRIMITIVES[field.kind])
            return
        for index in range(n):
            if not self._left:
                return
            self._single(field.kind, (sought or {}).get(index))

    def _found(self, sought: _Node | None, place: int, kind: str) -> None:
        for number in sought.leaves if sought else ():
            self.places[number] = (place, kind)
            self._left -= 1

    def _read_names(self) -> None:
        """Read an array of strings, whose content decides the layout too."""
        for _ in range(min(self._length(), len(self._data))):
            size = self._length()
            start = self._position
            self._skip(size)
            self.ranges.append((start, start + size))
            self._names.append(self._data[start : start + size].rstrip(b"\0").decode(errors="replace"))

    def _length(self) -> int:
        self._align(4)
        start = self._position
        self._skip(4)
        self.ranges.append((start, start + 4))
        return int(struct.unpack_from(f"{self._order}I", self._data, start)[0])

    def _align(self, size: int) -> None:
        self._position += (ORIGIN - self._position) % size

    def _skip(self, size: int) -> None:
        self._position += size
        if self._position > len(self._data):
            raise UndecodableError("is shorter than its definition states")


class Decoder:
    r"""Numbers of the messages of one type.

    Parameters
    ----------
    definition : of the messages
    paths : to the numbers

    Examples
    --------
    >>> from pipelines.messages.definitions import check_path, parse_definition
    >>> twist = parse_definition("a_msgs/msg/Speeds", "string name\nfloat64 left\nfloat64 right")
    >>> decoder = Decoder(twist, [check_path("/speeds", twist, "right")])
    >>> message = b"\0\1\0\0" + struct.pack("<I4sdd", 2, b"a", 1.5, 2.5)
    >>> decoder.decode(message, np.array([0]), np.array([len(message)]))[0]
    array([[2.5]])
    """

    def __init__(self, definition: Definition, paths: Sequence[FieldPath]) -> None:
        self._definition, self._n = definition, len(paths)
        self._sought = _Node()
        for number, path in enumerate(paths):
            self._sought.add(path, number)
        self._layouts: dict[int, list[Layout]] = {}

    def decode(self, data: bytes | bytearray, start: Array, size: Array) -> tuple[Array, Array]:
        """Return the numbers (n, k), NaN where a message lacks one, and which messages (n,) are damaged.

        Parameters
        ----------
        data : holds the messages
        start, size : (n,) of each message in bytes
        """
        buffer = np.frombuffer(data, dtype=np.uint8)
        values = np.full((start.size, self._n), np.nan)
        damaged = np.zeros(start.size, dtype=bool)
        for each in np.unique(size).tolist():
            rows = np.flatnonzero(size == each)
            if len(self._layouts) > _KNOWN_SIZES:
                self._layouts.clear()
            layouts = self._layouts.setdefault(each, [])
            for layout in layouts:
                rows = self._read(buffer, start, rows, layout, values)
            while rows.size:
                first = int(start[rows[0]])
                try:
                    layout = self.layout_of(bytes(data[first : first + each]))
                except UndecodableError:
                    damaged[rows[0]] = True
                    rows = rows[1:]
                    continue
                alone = len(layouts) >= MAX_LAYOUTS
                left = self._read(buffer, start, rows[:1] if alone else rows, layout, values)
                rows = rows[1:] if alone else left
                if not alone:
                    layouts.append(layout)
        return values, damaged

    def layout_of(self, message: bytes) -> Layout:
        """Return where the numbers of a message are; ``UndecodableError`` where it is damaged."""
        walk = _Walk(self._definition, self._sought, self._n, message)
        fixed = np.concatenate([np.arange(*each) for each in walk.ranges])
        return Layout(fixed, np.frombuffer(message, dtype=np.uint8)[fixed], tuple(walk.places))

    def _read(self, buffer: Array, start: Array, rows: Array, layout: Layout, values: Array) -> Array:
        """Read those of some rows that have a layout; return the others."""
        if not rows.size:
            return rows
        fits = np.all(buffer[start[rows][:, None] + layout.fixed] == layout.content, axis=1)
        same = rows[fits]
        order = "<" if layout.content[1] else ">"
        for column, place in enumerate(layout.places):
            if place is not None:
                offset, kind = place
                at = start[same][:, None] + np.arange(offset, offset + int(kind[1]))
                values[same, column] = buffer[at].view(f"{order}{kind}")[:, 0]
        others: Array = rows[~fits]
        return others
