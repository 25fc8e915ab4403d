"""A report as a tree of parts, which screens, pages and cards are written from.

A report leads with its answer: one sentence and at most one picture; then what a user decides by; then
details, which are folded.  Cells and values are numbers, not texts: their column or pair says how they are
written, so that screen and page show one number in one form.  A figure describes what is drawn, not how.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

from pipelines.report.numbers import format_value


class Text(NamedTuple):
    """A paragraph; ``note`` and ``warning`` stand out, ``code`` is written as it is."""

    text: str
    kind: Literal["plain", "note", "warning", "code"] = "plain"


class Column(NamedTuple):
    """Heading of a column, how its values are written, and whether their size is shown as a shade.

    Parameters
    ----------
    title : heading
    form : format of the values, as :func:`pipelines.report.numbers.format_value` takes it
    unit : stands in the heading
    shade : of ratios between 0 and 1: the larger, the darker
    long : holds sentences, which are wrapped
    """

    title: str
    form: str = ""
    unit: str = ""
    shade: bool = False
    long: bool = False

    @property
    def heading(self) -> str:
        """The title with its unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


@dataclass(frozen=True)
class Table:
    """Rows of values under headings; a heading alone may stand for a :class:`Column`.

    Examples
    --------
    >>> recalls = Table(("terrain", Column("speed", ".1f", "m/s")), [("grass", 0.5), ("ice", None)])
    >>> recalls.heads[1].heading, recalls.numeric, recalls.cells
    ('speed [m/s]', (False, True), [('grass', '0.5'), ('ice', '–')])
    """

    columns: Sequence[Column | str]
    rows: Sequence[Sequence[Any]]
    title: str = ""
    note: str = ""

    @property
    def heads(self) -> tuple[Column, ...]:
        """The columns, all of them with their format."""
        return tuple(each if isinstance(each, Column) else Column(each) for each in self.columns)

    @property
    def cells(self) -> list[tuple[str, ...]]:
        """The rows as they are written."""
        heads = self.heads
        return [
            tuple(format_value(value, head.form) for value, head in zip(row, heads, strict=True))
            for row in self.rows
        ]

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Whether each column is aligned on the right: it has a format, or holds no text."""
        found = []
        for place, head in enumerate(self.heads):
            known = [row[place] for row in self.rows if row[place] is not None]
            texts = any(isinstance(value, str) for value in known)
            found.append(bool(head.form) or (bool(known) and not texts))
        return tuple(found)


class Shown(NamedTuple):
    """A column of a table of records.

    Parameters
    ----------
    title, form, unit, long : as :class:`Column`
    of : attribute or key of a record, as ``case.seed``, or a function of it
    """

    title: str
    of: str | Callable[[Any], Any]
    form: str = ""
    unit: str = ""
    long: bool = False


def table(rows: Iterable[Any], columns: Sequence[Shown], title: str = "", note: str = "") -> Table:
    """Return a table of records.

    Examples
    --------
    >>> table([1.5, 2.0], [Shown("speed", lambda row: row, ".1f", "m/s"), Shown("whole", "real")]).rows
    ((1.5, 1.5), (2.0, 2.0))
    >>> table([{"speed": 1.5 + 2j}, {"speed": None}], [Shown("ahead", "speed.real", ".1f")]).rows
    ((1.5,), (None,))
    """
    return Table(
        [Column(each.title, each.form, each.unit, long=each.long) for each in columns],
        tuple(
            tuple(each.of(row) if callable(each.of) else value_at(row, each.of) for each in columns)
            for row in rows
        ),
        title,
        note,
    )


def value_at(record: Any, place: str) -> Any:
    """Return what a record has at a place, as ``slip.interval``; None where a mapping has nothing there."""
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


class Card(NamedTuple):
    """A figure that is written large, its name above and a line on it below."""

    title: str
    value: Any
    text: str = ""
    form: str = ""
    unit: str = ""

    @property
    def written(self) -> str:
        """The value as it is written."""
        return format_value(self.value, self.form, self.unit)


@dataclass(frozen=True)
class Cards:
    """Figures side by side."""

    cards: Sequence[Card]


class Line(NamedTuple):
    """A line through points ``x, y`` (n,); NaN is a gap."""

    label: str
    x: Any
    y: Any
    colour: int | None = None
    dashed: bool = False


class Band(NamedTuple):
    """The area between ``low`` and ``high`` (n,) over ``x`` (n,)."""

    label: str
    x: Any
    low: Any
    high: Any
    colour: int | None = None


class Points(NamedTuple):
    """Points ``x, y`` (n,), with bars from ``low`` to ``high`` (n,) where these are given."""

    label: str
    x: Any
    y: Any
    low: Any = None
    high: Any = None
    colour: int | None = None


class Bars(NamedTuple):
    """A horizontal bar for each category, with an interval where one is given; several are grouped."""

    label: str
    categories: Sequence[str]
    values: Any
    low: Any = None
    high: Any = None
    colour: int | None = None


class Strip(NamedTuple):
    """Coloured intervals ``(start, end, name)`` along x; one name has one colour."""

    spans: Sequence[tuple[float, float, str]]


Mark: TypeAlias = Line | Band | Points | Bars | Strip


@dataclass(frozen=True)
class Panel:
    """Axes with marks; ``equal`` where both axes have one scale, as of a path."""

    marks: Sequence[Mark]
    y_label: str = ""
    title: str = ""
    x_label: str = ""
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    equal: bool = False
    log_x: bool = False


@dataclass(frozen=True)
class Figure:
    """Panels below one another.

    Parameters
    ----------
    title : above
    panels : from the top
    caption : below: what is to be seen
    alt : in the place of a picture that cannot be seen; the caption by default
    x_label : of the last panel
    """

    title: str
    panels: Sequence[Panel]
    caption: str = ""
    alt: str = ""
    x_label: str = ""


class Later(Sequence[Any]):
    """Parts of a section that are made when a writer comes to them: a screen without details needs none."""

    def __init__(self, make: Callable[..., Sequence[Part]], *arguments: Any) -> None:
        self._made = cache(lambda: make(*arguments))

    def __getitem__(self, place: Any) -> Any:
        return self._made()[place]

    def __len__(self) -> int:
        return len(self._made())


@dataclass(frozen=True)
class Section:
    """Parts under a heading."""

    title: str
    parts: Sequence[Part] = ()


Part: TypeAlias = Text | Table | Pairs | Cards | Figure | Section


def sections(*titled: tuple[str, Sequence[Part | str]]) -> tuple[Section, ...]:
    """Return sections of the details, without those that are empty; a sentence becomes a text."""
    return tuple(
        Section(title, tuple(Text(part) if isinstance(part, str) else part for part in parts))
        for title, parts in titled
        if parts
    )


@dataclass(frozen=True)
class Report:
    """What a command answers.

    Parameters
    ----------
    title : what was done to what
    answer : one sentence
    picture : the one that shows it
    parts : what a user decides by
    details : folded on a page, behind ``--details`` on a screen
    next_step : a command line
    lead : a line below the title: how much data, which settings
    """

    title: str
    answer: str
    picture: Figure | None = None
    parts: Sequence[Part] = ()
    details: Sequence[Section] = field(default=())
    next_step: str = ""
    lead: str = ""

    def save(self, path: str | Path) -> Path:
        """Write the report as a page (``.html``) or as Markdown (``.md``), by the ending of the path."""
        saved: Path = _writer("writing").save_report(self, Path(path))
        return saved

    def __str__(self) -> str:
        text: str = _writer("terminal").terminal_text(self)
        return text

    def _repr_html_(self) -> str:
        markup: str = _writer("html").html_fragment(self)
        return markup


def _writer(name: str) -> Any:
    """Return a module that writes reports, which imports this one."""
    return import_module(f"pipelines.report.{name}")


def figures_of(report: Report) -> list[Figure]:
    """Return all figures of a report, in their order."""
    found, waiting = [], deque([report.picture, *report.parts, *report.details])
    while waiting:
        part = waiting.popleft()
        if isinstance(part, Figure):
            found.append(part)
        elif isinstance(part, Section):
            waiting.extendleft(reversed(part.parts))
    return found
