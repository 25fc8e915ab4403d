"""Results of commands: frozen records whose fields say what they are, and all that derives from them."""

from __future__ import annotations

import builtins
import sys
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, field, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.report.tree import Report

Progress = Callable[[str, int, int], None]
"""Called with the task, how many of its steps are done, and how many there are."""


def silent(task: str, done: int, total: int) -> None:
    """Report no progress."""


def described(text: str, unit: str = "", *, default: Any = MISSING, form: str = "") -> Any:
    """Return a field of a result.

    Parameters
    ----------
    text : what it is
    unit : in SI, ``1`` of a ratio, empty where there is none
    default : where it may be left out
    form : how it is written, as :func:`pipelines.report.numbers.format_value` takes it
    """
    metadata = {"description": text, "unit": unit, "form": form}
    if default is MISSING:
        return field(metadata=metadata)
    return field(default=default, metadata=metadata)


class Result:
    """Base of the results of commands, which are frozen dataclasses.

    The module that defines a result has a function ``report(result)``; screen, page and notebook show what it
    returns.  The fields are the keys of ``--json``; one that is not :func:`described` is none of them, as the
    pictures that a report shows.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Length(Result):
    ...     length_m: float = described("of the path", "m")
    >>> Length(1.5).as_json()
    {'length_m': 1.5}
    >>> Length.schema()["properties"]["length_m"]
    {'type': 'number', 'description': 'of the path', 'unit': 'm'}
    """

    @property
    def report(self) -> Report:
        """What screens, pages and notebooks show."""
        made: Report = sys.modules[type(self).__module__].report(self)
        return made

    def as_json(self) -> Any:
        """Return the fields by name, as :func:`pipelines.report.json_file.as_json` writes them."""
        from pipelines.report.json_file import as_json

        assert is_dataclass(self)
        return {
            each.name: as_json(getattr(self, each.name))
            for each in fields(self)
            if "description" in each.metadata
        }

    def pairs(self, *names: str) -> list[tuple[Any, ...]]:
        """Return rows of :class:`~pipelines.report.tree.Pairs`: what fields are, their values and forms."""
        about = {each.name: each.metadata for each in fields(self)}  # type: ignore[arg-type]
        rows = []
        for name in names:
            value, unit = getattr(self, name), about[name]["unit"]
            if isinstance(value, tuple) and all(isinstance(each, str) for each in value):
                value = ", ".join(value)
            rows.append((about[name]["description"], value, about[name]["form"], "" if unit == "1" else unit))
        return rows

    def to_pandas(self) -> pd.DataFrame:
        """Return the fields that are numbers, texts or intervals as a table of one row."""
        import pandas as pd

        assert is_dataclass(self)
        plain = (bool, int, float, str)
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return pd.DataFrame([{name: value for name, value in values.items() if isinstance(value, plain)}])

    @classmethod
    def schema(cls) -> dict[str, Any]:
        """Return the JSON schema of what ``--json`` writes."""
        return type_schema(cls)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.report.answer}>"

    def __str__(self) -> str:
        return str(self.report)

    def _repr_html_(self) -> str:
        return self.report._repr_html_()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.__repr__ = Result.__repr__  # type: ignore[method-assign]  # dataclass keeps what is defined


def frame(records: Iterable[Any]) -> pd.DataFrame:
    """Return records as a table, their fields as columns, as ``--json`` has them."""
    import pandas as pd

    from pipelines.report.json_file import as_json

    return pd.DataFrame([as_json(record) for record in records])


_PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean", Path: "string"}


class _Names(dict[str, Any]):
    """Names of a module; those that are there for a type checker alone stand for any type."""

    def __init__(self, module: types.ModuleType) -> None:
        super().__init__(vars(module))

    def __missing__(self, name: str) -> Any:
        return getattr(builtins, name, Any)


def type_schema(kind: Any) -> dict[str, Any]:
    """Return the JSON schema of a type: records by their fields, mappings and sequences by what they hold.

    Examples
    --------
    >>> type_schema(tuple[float, float] | None)
    {'anyOf': [{'type': 'array', 'items': {'type': 'number'}}, {'type': 'null'}]}
    """
    if kind in _PLAIN:
        return {"type": _PLAIN[kind]}
    if kind is type(None):
        return {"type": "null"}
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return {"anyOf": [type_schema(each) for each in arguments]}
    if origin is typing.Literal:
        return {"enum": list(arguments)}
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {"type": "object", "additionalProperties": type_schema(arguments[1]) if arguments else {}}
    if origin in (tuple, list) or (isinstance(origin, type) and issubclass(origin, typing.Sequence)):
        kinds = [each for each in dict.fromkeys(arguments) if each is not Ellipsis]
        items = type_schema(kinds[0]) if len(kinds) == 1 else {"anyOf": [type_schema(each) for each in kinds]}
        return {"type": "array", "items": items if kinds else {}}
    if isinstance(kind, type) and issubclass(kind, Enum):
        return {"enum": [each.value for each in kind]}
    if is_dataclass(kind) or hasattr(kind, "_fields"):
        hints = typing.get_type_hints(kind, localns=_Names(sys.modules[kind.__module__]))
        described_fields = {each.name: each.metadata for each in fields(kind)} if is_dataclass(kind) else {}
        names = tuple(described_fields) or kind._fields
        properties = {}
        for name in names:
            if issubclass(kind, Result) and "description" not in described_fields[name]:
                continue
            about = {
                key: text for key, text in described_fields.get(name, {}).items() if text and key != "form"
            }
            properties[name] = type_schema(hints[name]) | about
        return {"type": "object", "properties": properties}
    return {}
