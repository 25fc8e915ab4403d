"""Reading JSON and YAML of strangers: bounded in size, depth and aliases, and no key twice.

All JSON and YAML files are read here.  What a file may hold is bounded so that no file takes the memory or
the stack of the process, and so that what comes back can be shown, compared and converted: whole numbers
have 64 bits at most, numbers of JSON are finite, and texts can be written as UTF-8.

Descriptions have every number with its unit and its source, and no unknown key.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import yaml

from terrain.errors import ConfigError, TerrainError
from terrain.files.names import MEBIBYTE, read_regular, shown

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError

Document = TypeVar("Document", bound="BaseModel")


SPELLINGS = {
    "m/s": "mps",
    "m/s^2": "mps2",
    "m/s²": "mps2",
    "rad/s": "radps",
    "N": "n",
    "Nm": "nm",
    "A": "a",
    "V": "v",
}
"""Units as they are usually written, beside those that keys end in."""


def numbers(place: str, entries: Mapping[str, Any], lows: Mapping[str, float | None]) -> dict[str, float]:
    """Return the numbers of some keys, each in the unit that its key ends in; ``lows`` as of :func:`number`."""
    found = {}
    for key, low in lows.items():
        found[key] = number(f"{place}: {key}", entries[key], key.rpartition("_")[2], low)
    return found


def number(
    place: str,
    entry: Any,
    unit: str,
    low: float | None = None,
    high: float = math.inf,
    also: str = "interval",
) -> float:
    """Return the number of an entry ``{value, unit, source}``, which may have one more key, ``also``.

    ``ConfigError`` where a key is unknown or missing, the unit another, no source there, or the number below ``low``,
    without one not above zero, or above ``high``.
    """
    check_keys(place, entry, ["value", "unit", "source"], optional=(also,))
    if entry["unit"] != unit and SPELLINGS.get(str(entry["unit"])) != unit:
        raise ConfigError(f"{place} has the unit {shown(entry['unit'])}, {unit!r} is required")
    if not isinstance(entry["source"], str) or not entry["source"].strip():
        raise ConfigError(f"{place} has no source: say where the number is from, or 'assumed'")
    value = entry["value"]
    if not is_number(value) or (value <= 0 if low is None else value < low):
        more = " above zero" if low is None else " from zero up" if low == 0 else ""
        raise ConfigError(f"{place} is {shown(value)}, a number{more} is required")
    if value > high:
        raise ConfigError(f"{place} is {float(value):g}, at most {high:g} is accepted")
    return float(value)


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number, and no truth value."""
    return not isinstance(value, bool) and isinstance(value, int | float) and math.isfinite(value)


def check_keys(place: str, entry: Any, desired: list[str], optional: tuple[str, ...] = ()) -> None:
    """Refuse a mapping that lacks a desired key or has one that is not accepted; ``ConfigError``."""
    if not isinstance(entry, dict):
        raise ConfigError(f"{place} is {shown(entry)}, a mapping with {', '.join(desired)} is required")
    accepted = [*desired, *optional]
    for key in entry:
        if key not in accepted:
            raise ConfigError(f"{place}: key {shown(str(key))} is unknown (accepted: {', '.join(accepted)})")
    if missing := [repr(key) for key in desired if key not in entry]:
        are = "key {} is" if len(missing) == 1 else "keys {} are"
        raise ConfigError(f"{place}: {are.format(', '.join(missing))} missing")


MAX_JSON_BYTES = 16 * MEBIBYTE  #: A run with a label each second of 24 hours has 7 MiB of them
MAX_YAML_BYTES = MEBIBYTE  #: Descriptions are written by people: the longest of the package has 24 KiB
MAX_DEPTH = 32  #: Levels of lists and mappings; those of this package have 6 at most
MAX_NODES = 100_000  #: Values of YAML, those of an alias counted each time: so many take some seconds to read
MAX_PLACE_CHARACTERS = 200  #: Keys down to a fault, as a message names them

_MAX_WHOLE = 2**63
_DEEP = f"is nested deeper than {MAX_DEPTH} levels"
#: What the constructors of YAML raise on a scalar that does not suit its tag, as the date 2026-13-45
_BAD_VALUES = (ValueError, LookupError, AttributeError, TypeError, OverflowError)


def read_json(path: Path, place: str, kind: type[TerrainError], most_bytes: int = MAX_JSON_BYTES) -> Any:
    """Return what a JSON file holds, unchecked.

    An error of a kind, which names the place, where it is missing, no regular file or too large, or as
    :func:`parse_json` raises.
    """
    try:
        return parse_json(read_regular(path, place, kind, most_bytes))
    except ValueError as error:
        raise kind(f"{place}: {error}") from error


def parse_json(content: bytes | str) -> Any:
    """Return what a JSON text holds.

    ``ValueError``, whose message says what the text does, where it is no JSON or no UTF-8, nests too deep, gives a key
    twice, or holds a number that is not finite or a whole number of more than 64 bits.

    Examples
    --------
    >>> parse_json('{"mean": [NaN]}')
    Traceback (most recent call last):
    ValueError: holds NaN, finite numbers are required
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"is no JSON (key {shown(twice)} is given twice)")
        return found

    def refuse(name: str) -> Any:
        raise ValueError(f"holds {name}, finite numbers are required")

    def finite(digits: str) -> float:
        return value if math.isfinite(value := float(digits)) else float(refuse(digits[:20]))

    def whole(digits: str) -> int:
        if len(digits) > 20 or abs(int(digits)) >= _MAX_WHOLE:
            raise ValueError("holds a whole number of more than 64 bits")
        return int(digits)

    try:
        text = content if isinstance(content, str) else content.decode("utf-8-sig")
        hooks: dict[str, Any] = {"parse_constant": refuse, "parse_float": finite, "parse_int": whole}
        found = json.loads(text, object_pairs_hook=unique, **hooks)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"is no JSON ({error})") from error
    except RecursionError as error:
        raise ValueError(_DEEP) from error
    level = [found] if isinstance(found, dict | list) else []
    for _ in range(MAX_DEPTH):  # lists and mappings within those of the level above
        every = [each.values() if isinstance(each, dict) else each for each in level]
        level = [child for children in every for child in children if isinstance(child, dict | list)]
    if level:
        raise ValueError(_DEEP)
    if "\\u" in text:
        try:
            json.dumps(found, ensure_ascii=False).encode()
        except UnicodeEncodeError as error:
            raise ValueError("holds half of a UTF-16 pair, which is no character") from error
    return found


def parse_document(content: bytes | str, model: type[Document]) -> Document:
    """Return what a pydantic model makes of a JSON text."""
    from pydantic import ValidationError

    parse_json(content)
    try:
        return model.model_validate_json(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"{place}: {first['msg']}") from None


def accepted(
    model: type[Document], content: Any, place: str, kind: type[TerrainError], fault: str = ""
) -> Document:
    """Return what a pydantic model makes of a mapping or of a JSON text.

    An error of a kind in one sentence, which names the place, what the document is (``fault``) and what is not
    accepted.
    """
    from pydantic import ValidationError

    try:
        if isinstance(content, str | bytes):
            return model.model_validate_json(content)
        return model.model_validate(content)
    except ValidationError as error:
        first = first_fault(error)
        raise kind(f"{place}: {fault} ({first})" if fault else f"{place}: {first}") from error


def read_yaml(path: Path, text: str | None = None) -> Any:
    """Return what a YAML file holds, or a text in place of it, unchecked; no file can run code.

    ``ConfigError`` where it cannot be opened, is no regular file or too large, or as :func:`parse_yaml` raises.
    """
    try:
        return parse_yaml(
            text if text is not None else read_regular(path, str(path), ConfigError, MAX_YAML_BYTES)
        )
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error


def parse_yaml(content: bytes | str) -> Any:
    """Return what a YAML text holds; no text can run code.

    ``ValueError``, whose message says what the text does, where it is no YAML or no UTF-8, nests too deep, gives a key
    twice, or holds too many values, a whole number of more than 64 bits or an alias of itself.

    Examples
    --------
    >>> parse_yaml("track_m: {value: 0.57, unit: m}")
    {'track_m': {'value': 0.57, 'unit': 'm'}}
    """
    try:
        text = content if isinstance(content, str) else content.decode("utf-8-sig")
        return yaml.load(text, Loader=_BoundedLoader)  # a SafeLoader
    except _TooMuchError as error:
        raise ValueError(str(error)) from error
    except (yaml.YAMLError, *_BAD_VALUES) as error:
        raise ValueError(f"is no YAML ({' '.join(str(error).split())})") from error


def first_fault(error: ValidationError) -> str:
    """Return the first thing in a document that is not accepted, in one sentence."""
    fault: dict[str, Any] = dict(error.errors()[0])
    place = ".".join(str(part) for part in fault["loc"]) or "the file"
    if not place.isprintable() or len(place) > MAX_PLACE_CHARACTERS:
        place = shown(place)
    if fault["type"] == "extra_forbidden":
        return f"key {shown(place)} is unknown"
    if fault["type"] == "missing":
        return f"key {place!r} is missing"
    return f"{place} is {shown(fault['input'])}: {fault['msg'][0].lower()}{fault['msg'][1:]}"


class _TooMuchError(yaml.YAMLError):
    """A text that is YAML and is not read."""


class _BoundedLoader(yaml.SafeLoader):
    """A safe loader that refuses a key given twice, of which plain YAML takes the last, and what is too much.

    An alias counts as many values as the node that it repeats: a few lines of aliases of aliases stand for
    thousands of millions.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0
        self._n_nodes = 0
        self._sizes: dict[str, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node, and count those below it."""
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        is_alias, before = isinstance(event, yaml.AliasEvent), self._n_nodes
        if is_alias:
            anchor: Any = event.anchor
            if anchor in self.anchors and anchor not in self._sizes:
                raise _TooMuchError(f"holds an alias of itself (*{anchor})")
        self._n_nodes += self._sizes.get(event.anchor, 1) if is_alias else 1
        if self._n_nodes > MAX_NODES:
            raise _TooMuchError(f"holds more than {MAX_NODES} values, those of aliases counted each time")
        self._depth += 1
        if self._depth > MAX_DEPTH + 1 and not is_alias:  # the value within the deepest list
            raise _TooMuchError(_DEEP)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if event.anchor is not None and not is_alias:
            self._sizes[event.anchor] = self._n_nodes - before
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping whose keys differ."""
        keys: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in keys:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {shown(key.value)} is given twice", key.start_mark
                )
            keys.add(key.value)
        return super().construct_mapping(node, deep=deep)

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """Construct a whole number of 64 bits at most."""
        if len(node.value) > 80 or abs(found := super().construct_yaml_int(node)) >= _MAX_WHOLE:
            raise _TooMuchError("holds a whole number of more than 64 bits")
        return int(found)


_BoundedLoader.add_constructor("tag:yaml.org,2002:int", _BoundedLoader.construct_yaml_int)
