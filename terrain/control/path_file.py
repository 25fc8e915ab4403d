"""Files of paths: CSV with a header, or two columns of numbers."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from terrain.control.paths import ReferencePath, path_from_points
from terrain.errors import DataError, LogError
from terrain.records import Array

_X = ("x_m", "position_x_m", "x")
_Y = ("y_m", "position_y_m", "y")
_MAX_BYTES = 50_000_000


def read_path(path: Path, std_m: float = 0.0) -> ReferencePath:
    """Read a path.

    Parameters
    ----------
    path : of the file; columns ``x_m`` and ``y_m`` (or ``position_x_m``, ``position_y_m``; or without a
        header the first two), and ``roll_rad`` where the side slope is known
    std_m : standard deviation of the points

    Raises
    ------
    LogError
        if the file cannot be read, has no such columns, or holds something that is no number.
    DataError
        if its points are no path.
    """
    rows = _text_rows(path)
    columns, first = _columns(path, [cell.strip() for cell in rows[0][1]]), 1
    if columns is None:
        columns, first = (0, 1, None), 0
    points = _numbers(path, rows[first:], columns[:2])
    try:
        found = path_from_points(points, std_m)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    if columns[2] is None:
        return found
    roll = _numbers(path, rows[first:], (columns[2],))[:, 0]
    if not (np.abs(roll) < np.deg2rad(45.0)).all():
        raise DataError(f"{path}: roll_rad is beyond 45 degrees, or no number, at point {_first_bad(roll)}")
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    return found.with_roll(along * found.length_m / along[-1], roll)


def _first_bad(roll: Array) -> int:
    return int(np.flatnonzero(~(np.abs(roll) < np.deg2rad(45.0)))[0]) + 1


def _text_rows(path: Path) -> list[tuple[int, list[str]]]:
    """Return the rows that are not empty, with their numbers in the file."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise LogError(f"{path}: {path.stat().st_size} bytes; a path of at most {_MAX_BYTES} is accepted")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is no text"
        raise LogError(f"{path}: cannot be read: {reason}") from None
    separator = ";" if ";" in text.partition("\n")[0] else ","
    try:
        listed = list(csv.reader(text.splitlines(), delimiter=separator))
    except csv.Error as error:
        raise LogError(f"{path}: is no CSV file: {error}") from None
    rows = [(number, row) for number, row in enumerate(listed, 1) if any(cell.strip() for cell in row)]
    if not rows:
        raise LogError(f"{path}: is empty")
    return rows


def _columns(path: Path, names: list[str]) -> tuple[int, int, int | None] | None:
    """Return the places of x, y and roll; None where the first row is one of numbers."""
    x = next((names.index(name) for name in _X if name in names), None)
    y = next((names.index(name) for name in _Y if name in names), None)
    if x is not None and y is not None:
        return x, y, names.index("roll_rad") if "roll_rad" in names else None
    try:
        [float(name) for name in names[:2]]
    except ValueError:
        shown = ", ".join(names[:6])
        raise LogError(f"{path}: columns x_m and y_m are needed, its first row has {shown}") from None
    if len(names) < 2:
        raise LogError(f"{path}: two columns of numbers are needed, its first row has one")
    return None


def _numbers(path: Path, rows: list[tuple[int, list[str]]], columns: tuple[int, ...]) -> Array:
    found = np.empty((len(rows), len(columns)))
    for k, (number, row) in enumerate(rows):
        for j, column in enumerate(columns):
            try:
                found[k, j] = float(row[column])
            except (IndexError, ValueError):
                cell = row[column] if column < len(row) else "nothing"
                raise LogError(f"{path}: row {number} has {cell!r}, a number is needed") from None
    return found
