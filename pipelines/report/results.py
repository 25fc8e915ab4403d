"""Results of commands: frozen records whose fields say what they are, and all that derives from them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, field, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.report.tree import Report

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
    form : how it is written, as :func:`pipelines.report.numbers.format_value` takes it
    optional : None, and then left out of JSON, where it was not asked for or is not known
    """
    metadata = {"description": text, "unit": unit, "form": form, "optional": optional}
    return field(default=None if optional else default, metadata=metadata)


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
    >>> Length.schema()["properties"]
    {'length_m': {'description': 'of the path', 'unit': 'm'}}
    """

    @property
    def report(self) -> Report:
        """What screens, pages and notebooks show."""
        made: Report = sys.modules[type(self).__module__].report(self)
        return made

    def as_json(self) -> Any:
        """Return the fields by name, as :func:`pipelines.report.json_file.as_json` writes them."""
        from pipelines.report.json_file import as_json

        values = {name: getattr(self, name) for name in self.about()}
        shown = (name for name in values if values[name] is not None or not self.about()[name]["optional"])
        return {name: as_json(values[name]) for name in shown}

    def pairs(self, *names: str) -> list[tuple[Any, ...]]:
        """Return rows of :class:`~pipelines.report.tree.Pairs`: what fields are, their values and forms."""
        rows = []
        for name in names:
            value, about = getattr(self, name), self.about()[name]
            if isinstance(value, tuple) and all(isinstance(each, str) for each in value):
                value = ", ".join(value)
            unit = "" if about["unit"] == "1" else about["unit"]
            rows.append((about["description"], value, about["form"], unit))
        return rows

    def records(self) -> Iterable[Any]:
        """Return the rows of :meth:`to_pandas`; one of the fields that are numbers or texts where none are natural."""
        plain = (bool, int, float, str)
        return [{name: each for name, each in vars(self).items() if isinstance(each, plain)}]

    def to_pandas(self) -> pd.DataFrame:
        """Return a table, the fields of its rows as ``--json`` has them."""
        import pandas as pd

        from pipelines.report.json_file import as_json

        return pd.DataFrame([as_json(record) for record in self.records()])

    @classmethod
    def about(cls) -> dict[str, Mapping[str, Any]]:
        """Return what :func:`described` was given for each field, by its name."""
        named = {each.name: each.metadata for each in fields(cls)}  # type: ignore[arg-type]
        return {name: about for name, about in named.items() if "description" in about}

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
        super().__init_subclass__(**options)
        cls.__repr__ = Result.__repr__  # type: ignore[method-assign]  # dataclass keeps what is defined
