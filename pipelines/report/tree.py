"""A report as a tree of parts, which screens, pages and cards are written from.

A report leads with its answer: one sentence and at most one picture; then what a user decides by; then
details, which are folded.  Cells and values are numbers, not texts: their column or pair says how they are
written, so that screen and page show one number in one form.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

from pipelines.report.numbers import format_value
from pipelines.report.settings import ENDINGS, check_file
from terrain.files.atomic import atomic_write

if TYPE_CHECKING:
    from pipelines.report.figure import Figure


class Text(NamedTuple):
    """A paragraph; ``note`` and ``warning`` stand out, ``code`` is written as it is."""

    text: str
    kind: Literal["plain", "note", "warning", "code"] = "plain"


class Column(NamedTuple):
    """Heading of a column, how its values are written, and where a record has them."""

    title: str  #: heading
    form: str = ""  #: format of the values, as :func:`pipelines.report.numbers.format_value` takes it
    unit: str = ""  #: stands in the heading
    #: attribute or key of a record, as ``case.seed``, or a function of it; without one a row is a sequence of
    #: the values of all columns
    of: str | Callable[[Any], Any] | None = None
    shade: bool = False  #: of ratios between 0 and 1: the larger, the darker
    long: bool = False  #: holds sentences, which are wrapped


@dataclass(frozen=True)
class Table:
    """Rows of values, or records, under headings; a heading alone may stand for a :class:`Column`.

    Examples
    --------
    >>> recalls = Table(("terrain", Column("speed", ".1f", "m/s")), [("grass", 0.5), ("ice", None)])
    >>> [(heading, right, texts) for _, heading, right, _, texts in recalls.written]
    [('terrain', False, ['grass', 'ice']), ('speed [m/s]', True, ['0.5', '–'])]
    >>> speeds = Column("speed", of=lambda row: row), Column("ahead", of="real")
    >>> [values for *_, values, _ in Table(speeds, [1.5 + 2j]).written]
    [[(1.5+2j)], [1.5]]
    """

    columns: Sequence[Column | str]
    rows: Collection[Any]
    title: str = ""
    note: str = ""

    @property
    def written(self) -> list[tuple[Column, str, bool, list[Any], list[str]]]:
        """Each column with its heading, whether it is aligned on the right, its values, and these as written."""
        columns = []
        for place, named in enumerate(self.columns):
            column = named if isinstance(named, Column) else Column(named)
            values, texts, numbers, words = [], [], False, False
            for row in self.rows:
                value = value_at(row, place if column.of is None else column.of)
                values.append(value)
                texts.append(format_value(value, column.form))
                numbers |= not (value is None or isinstance(value, str))
                words |= isinstance(value, str)
            heading = f"{column.title} [{column.unit}]" if column.unit else column.title
            columns.append((column, heading, bool(column.form) or (numbers and not words), values, texts))
        return columns


def value_at(record: Any, place: str | int | Callable[[Any], Any]) -> Any:
    """Return what a record has at a place, as ``slip.interval``; None where a mapping has nothing there."""
    if callable(place):
        return place(record)
    if isinstance(place, int):
        return record[place]
    for name in place.split("."):
        if record is None:
            return None
        record = record.get(name) if isinstance(record, Mapping) else getattr(record, name)
    return record


@dataclass(frozen=True)
class Pairs:
    """Names and values: ``(name, value)``, ``(name, value, form)`` or ``(name, value, form, unit)``."""

    rows: Sequence[tuple[Any, ...]]
    title: str = ""

    @property
    def cells(self) -> list[tuple[str, str]]:
        """The names, and the values as they are written."""
        return [(str(row[0]), format_value(*row[1:])) for row in self.rows]


@dataclass(frozen=True)
class Section:
    """Parts under a heading."""

    title: str  #: heading
    #: the parts, or what makes them when a writer comes to them: a screen without details needs none
    given: Sequence[Part] | Callable[[], Sequence[Part]] = ()

    @cached_property
    def parts(self) -> Sequence[Part]:
        """The parts."""
        return self.given() if callable(self.given) else self.given


Part: TypeAlias = "Text | Table | Pairs | Figure | Section"


def sections(*titled: tuple[str, Sequence[Part | str]]) -> tuple[Section, ...]:
    """Return sections of the details, without those that are empty; a sentence becomes a text."""
    found = []
    for title, parts in titled:
        if parts:
            found.append(Section(title, [Text(part) if isinstance(part, str) else part for part in parts]))
    return tuple(found)


@dataclass(frozen=True)
class Report:
    """What a command answers."""

    title: str  #: what was done to what
    answer: str  #: one sentence
    picture: Figure | None = None  #: the one that shows it
    parts: Sequence[Part] = ()  #: what a user decides by
    details: Sequence[Section] = ()  #: folded on a page, behind ``--details`` on a screen
    next_step: str = ""  #: a command line
    lead: str = ""  #: a line below the title: how much data, which settings

    def save(self, path: str | Path) -> Path:
        """Write the report as a page (``.html``) or as Markdown (``.md``), by the ending of the path.

        Raises
        ------
        ConfigError
            if the path has another ending, or cannot be written.
        """
        path = Path(path)
        check_file(path, "--report", ENDINGS)
        as_markdown = path.suffix.lower() == ".md"
        atomic_write(path, self._by("pages:markdown_text" if as_markdown else "pages:html_page"))
        return path

    def __str__(self) -> str:
        return self._by("terminal:terminal_text")

    def _repr_html_(self) -> str:
        return self._by("pages:html_fragment")

    def _by(self, writer: str) -> str:
        """Return what a function of one of the modules that import this one makes of the report."""
        text: str = resolve_name(f"pipelines.report.{writer}")(self)
        return text


def figures_of(report: Report) -> list[Figure]:
    """Return all figures of a report, in their order."""
    from pipelines.report.figure import Figure

    found: list[Figure] = []
    waiting: list[Part | None] = [report.picture, *report.parts, *report.details]
    while waiting:
        part = waiting.pop(0)
        if isinstance(part, Figure):
            found.append(part)
        elif isinstance(part, Section):
            waiting[:0] = part.parts
    return found
