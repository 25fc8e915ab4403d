"""Results of commands: frozen records whose fields say what they are, and all that derives from them, as JSON."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, dataclass_transform

from terrain.files.atomic import atomic_write

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.report.tree import Report

MAX_DOUBTS = 6  #: A page begins with so many doubts; the others are folded

Progress = Callable[[str, int, int], None]
"""Called with the task, how many of its steps are done, and how many there are."""


def silent(task: str, done: int, total: int) -> None:
    """Report no progress."""


def described(
    text: str, unit: str = "", *, default: Any = MISSING, form: str = "", optional: bool = False
) -> Any:
    """Return a field of a result.

    Parameters
    ----------
    text : what it is
    unit : in SI, ``1`` of a ratio, empty where there is none
    default : where it may be left out
    form : how it is written, as :func:`pipelines.report.numbers.format_value` takes it; a ratio in percent by default
    optional : None, and then left out of JSON, where it was not asked for or is not known
    """
    form = form or (".1%" if unit == "1" else "")
    metadata = {"description": text, "unit": unit, "form": form, "optional": optional}
    return field(default=None if optional else default, metadata=metadata)


def as_json(value: Any) -> Any:
    """Return what JSON can hold of a result: a number that is not finite is None.

    Parameters
    ----------
    value : a record (dataclass or named tuple), a mapping, a sequence, an array, an enum, a path, a number
        or a text; a record with a method ``as_json`` decides itself what it shows

    Examples
    --------
    >>> from typing import NamedTuple
    >>> class Figure(NamedTuple):
    ...     mean: float
    ...     ci: tuple[float, float] | None
    >>> as_json({"energy": Figure(1.5, None), "bad": float("nan")})
    {'energy': {'mean': 1.5, 'ci': None}, 'bad': None}
    """
    if value is None or (isinstance(value, bool | str | int) and not isinstance(value, Enum)):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "as_json"):
        return as_json(value.as_json())
    if is_dataclass(value) and not isinstance(value, type):
        return {each.name: as_json(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return {name: as_json(each) for name, each in zip(value._fields, value, strict=True)}
    if isinstance(value, Mapping):
        return {str(key): as_json(each) for key, each in value.items()}
    if hasattr(value, "tolist"):
        return as_json(value.tolist())
    return [as_json(each) for each in value]


def write_json(path: Path, result: Any) -> None:
    """Write a result to a file, whole or not at all."""
    atomic_write(path, json.dumps(as_json(result), indent=2, allow_nan=False) + "\n")


#: What a description says of a value that stands for something, which is of no use where a page shows the value.
_SPECIAL_VALUE = re.compile(r"; (?:null|NaN|none|empty|infinite|0)\b.*")


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True, repr=False)
class Result:
    """Base of the results of commands: what derives from it is a frozen dataclass by that, with the options of one.

    The module that defines a result has a function ``report(result)``; screen, page and notebook show what it
    returns, below what is doubtful about the runs that were read.  The fields are the keys of ``--json``; one
    that is not :func:`described` is none of them, as the pictures that a report shows.

    Examples
    --------
    >>> class Length(Result):
    ...     length_m: float = described("of the path", "m")
    >>> Length(1.5).as_json(), Length.of(Length(2.5)).length_m
    ({'length_m': 1.5}, 2.5)
    >>> Length.schema()["properties"]["length_m"]
    {'description': 'of the path', 'unit': 'm'}
    """

    #: on the runs that were read
    doubtful: tuple[str, ...] | None = field(
        default=None,
        kw_only=True,
        metadata=described("what is doubtful about runs that were read", optional=True).metadata,
    )

    def with_doubts(self, sentences: Iterable[str]) -> Self:
        """Return the result of runs about which something is doubtful, a sentence each; nothing of none."""
        doubtful = tuple(sentences)
        return replace(self, doubtful=doubtful) if doubtful else self

    @classmethod
    def of(cls, *sources: Any, **values: Any) -> Self:
        """Return a result of values and, by their names, of the first of the sources, as settings, that has a field.

        A field with a default is that, unless its value is given.
        """
        all_fields = fields(cls)
        needed = {each.name for each in all_fields if each.default is each.default_factory is MISSING}
        for source in sources:
            names = [name for name in needed - values.keys() if hasattr(source, name)]
            values |= {name: getattr(source, name) for name in names}
        return cls(**values)

    @property
    def report(self) -> Report:
        """What screens, pages and notebooks show."""
        made: Report = sys.modules[type(self).__module__].report(self)
        if not self.doubtful:
            return made
        from pipelines.report.tree import Text, sections

        first, more = self.doubtful[:MAX_DOUBTS], self.doubtful[MAX_DOUBTS:]
        warned = (*(Text(each, "warning") for each in first), *made.parts)
        return replace(
            made, parts=warned, details=(*made.details, *sections(("More doubts on the runs", more)))
        )

    def as_json(self) -> Any:
        """Return the fields by name, as :func:`as_json` writes them."""
        return {
            name: as_json(value)
            for name, about in self.about().items()
            if (value := getattr(self, name)) is not None or not about["optional"]
        }

    def pairs(self, *names: str) -> list[tuple[Any, ...]]:
        """Return rows of :class:`~pipelines.report.tree.Pairs`: what fields are, their values and forms."""
        rows = []
        for name in names:
            value, about = getattr(self, name), self.about()[name]
            if isinstance(value, tuple) and all(isinstance(each, str) for each in value):
                value = ", ".join(value)
            unit = "" if about["unit"] == "1" else about["unit"].replace("^2", "²")
            rows.append((_SPECIAL_VALUE.sub("", about["description"]), value, about["form"], unit))
        return rows

    def records(self) -> Iterable[Any]:
        """Return the rows of :meth:`to_pandas`; one of the fields that are numbers or texts where none are natural."""
        plain = (bool, int, float, str)
        return [{name: each for name, each in vars(self).items() if isinstance(each, plain)}]

    def to_pandas(self) -> pd.DataFrame:
        """Return a table, the fields of its rows as ``--json`` has them."""
        import pandas as pd

        return pd.DataFrame([as_json(record) for record in self.records()])

    @classmethod
    def about(cls) -> dict[str, Mapping[str, Any]]:
        """Return what :func:`described` was given for each field, by its name."""
        return {each.name: each.metadata for each in fields(cls) if each.metadata}

    @classmethod
    def schema(cls) -> dict[str, Any]:
        """Return the JSON schema of what ``--json`` writes: its keys, what each is, and its unit."""
        keys = ("description", "unit")
        properties = {
            name: {key: about[key] for key in keys if about[key]} for name, about in cls.about().items()
        }
        return {"type": "object", "properties": properties}

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.report.answer}>"

    def __str__(self) -> str:
        return str(self.report)

    def _repr_html_(self) -> str:
        return self.report._repr_html_()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__()
        dataclass(frozen=True, repr=False, **options)(cls)
