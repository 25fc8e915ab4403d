"""What reports of the room are made of: tables of records, sections, files of pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipelines.report.figure import Figure
from pipelines.report.numbers import enumerated
from pipelines.report.tree import Column, Part, Table, value_at
from terrain.files.atomic import atomic_write

SHOWN_ROWS = 8  #: Rows of a table that is continued in the details


def named(rows: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of terrains with their names among their values."""
    return [{"terrain": name, **row} for name, row in rows.items()]


def within_one_session(one_session: Mapping[str, bool]) -> str:
    """Return what a report begins with where surfaces, by name, were driven in one session only; empty elsewhere.

    Examples
    --------
    >>> within_one_session({"mud": True, "ice": False}), within_one_session({"mud": True})[:19]
    ('Within one session on mud: what another day does is not shown. ', 'Within one session:')
    """
    names = [name for name, one in one_session.items() if one]
    where = "" if len(names) == len(one_session) else f" on {enumerated(names)}"
    return f"Within one session{where}: what another day does is not shown. " if names else ""


def known_columns(columns: Sequence[Column], rows: Sequence[Any]) -> list[Column]:
    """Return the columns in which any of the records has a value."""
    cells = [(each, [value_at(row, each.of or 0) for row in rows]) for each in columns]
    return [each for each, values in cells if any(value is not None and value == value for value in values)]


def first_rows(
    rows: Sequence[Any], columns: Sequence[Column], title: str
) -> tuple[Table, tuple[str, list[Part]]]:
    """Return a table of the first records, and a section of the details with all, empty where there are no more."""
    n_more = len(rows) - SHOWN_ROWS
    note = f"{n_more} more are in the details." if n_more > 0 else ""
    rest: list[Part] = [Table(columns, rows)] if n_more > 0 else []
    return Table(columns, rows[:SHOWN_ROWS], title, note), ("All of them", rest)


def file_name(text: str, also: str = "") -> str:
    """Return a text as a name of a file: other characters than letters, digits and ``_-.`` are replaced.

    Examples
    --------
    >>> file_name("moon/dust, dry")
    'moon_dust__dry'
    """
    return "".join(letter if letter.isalnum() or letter in "_-." + also else "_" for letter in text)


def write_figures(figures: Mapping[str, Figure], folder: Path, *, svg: bool = True) -> tuple[str, ...]:
    """Write figures as PNG, and as SVG, by their names; return the files.

    Raises
    ------
    TerrainError
        if the folder cannot be written.
    """
    from pipelines.report.drawing import figure_png, figure_svg

    folder.mkdir(parents=True, exist_ok=True)
    files = []
    writers: dict[str, Callable[[Figure], bytes | str]] = {".png": figure_png}
    writers |= {".svg": figure_svg} if svg else {}
    for name, figure in figures.items():
        for ending, written in writers.items():
            files.append(folder / f"{file_name(name)}{ending}")
            atomic_write(files[-1], written(figure))
    return tuple(str(file) for file in files)
