"""What reports of the room are made of: thinned lines, intervals, files of pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.report import Band, Line, Shown, Table, table
from terrain.files.atomic import atomic_write
from terrain.records import Array

if TYPE_CHECKING:
    from pipelines.report import Figure, Part

MAX_POINTS = 2000
"""More points a line than this are more than a picture can show."""

TRUTH_COLOUR = 6
"""Grey, for what was true, of every estimate."""

MAX_PICTURED = 3
"""Runs whose pictures a page has; ``--figures`` writes those of all."""


SHOWN_ROWS = 8
"""Rows of a table that is continued in the details."""


def first_rows(
    rows: Sequence[Any], columns: Sequence[Shown], title: str
) -> tuple[Table, tuple[str, list[Part]]]:
    """Return a table of the first records, and a section of the details with all, empty where there are no more."""
    n_more = len(rows) - SHOWN_ROWS
    note = f"{n_more} more are in the details." if n_more > 0 else ""
    rest: list[Part] = [table(rows, columns)] if n_more > 0 else []
    return table(rows[:SHOWN_ROWS], columns, title, note), ("All of them", rest)


def line(
    label: str, time_s: Array, values: Array, colour: int | None = None, *, dashed: bool = False
) -> Line:
    """Return a line of thinned points.

    Parameters
    ----------
    label, colour, dashed : as :class:`pipelines.report.Line`
    time_s, values : (n,)
    """
    every = max(1, len(time_s) // MAX_POINTS)
    return Line(label, time_s[::every], np.asarray(values)[::every], colour=colour, dashed=dashed)


def band(label: str, time_s: Array, mean: Array, std: Array, colour: int | None = None) -> Band:
    """Return the band of a standard deviation, ``mean - std`` to ``mean + std``, all (n,)."""
    every = max(1, len(time_s) // MAX_POINTS)
    mean, std = mean[::every], std[::every]
    return Band(label, time_s[::every], mean - std, mean + std, colour=colour)


def spans(time_s: Array, marked: Array, name: str) -> tuple[tuple[float, float, str], ...]:
    """Return the intervals in which instants are marked.

    Parameters
    ----------
    time_s : (n,)
    marked : (n,) of booleans
    name : of what the intervals show

    Examples
    --------
    >>> spans(np.arange(5.0), np.array([False, True, True, False, True]), "stuck")
    ((1.0, 3.0, 'stuck'), (4.0, 4.0, 'stuck'))
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(int)))
    last = len(time_s) - 1
    return tuple(
        (float(time_s[begin]), float(time_s[min(end, last)]), name) for begin, end in edges.reshape(-1, 2)
    )


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
    for name, figure in figures.items():
        contents: dict[str, bytes | str] = {".png": figure_png(figure)}
        if svg:
            contents[".svg"] = figure_svg(figure)
        for ending, content in contents.items():
            files.append(folder / f"{file_name(name)}{ending}")
            atomic_write(files[-1], content)
    return tuple(str(file) for file in files)
