"""Numeric columns of a CSV file, by name.

The fast route is pyarrow's reader.  Where it stumbles, the plain route goes cell by cell: it names the row
and the cell, or, when repairing, turns the cell into NaN and counts it.  Rows are numbered as an editor
shows them, the header being row 1.  An empty cell, ``nan`` and ``NA`` are missing values.  A file whose
name ends in ``.gz`` is unpacked as it is read.
"""

from __future__ import annotations

import csv
import gzip
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from terrain.errors import LogError
from terrain.files.names import listed, normal_name, shown
from terrain.files.regular import MEBIBYTE, check_regular
from terrain.logs.log_files import short_name
from terrain.logs.samples import BAD_CELL, SHORT_ROW
from terrain.records import Array

MISSING = ("", "nan", "NaN", "NAN", "NA")
"""Cells that stand for a missing value."""

MAX_UNPACKED_BYTES = 1024 * MEBIBYTE
"""Of a packed file: 48 hours of DRIVE, and gigabytes of zeros pack to megabytes."""

_UNREADABLE = (OSError, EOFError, zlib.error, UnicodeDecodeError, csv.Error)


class TextLayout(NamedTuple):
    """How a text file holds its table.

    Parameters
    ----------
    delimiter : one character
    decimal : character between the digits of a number: a point or a comma
    skip_rows : lines above the names of the columns
    header_rows : lines of the header from the names on: 2 where units stand below them
    """

    delimiter: str = ","
    decimal: str = "."
    skip_rows: int = 0
    header_rows: int = 1

    @property
    def first_row(self) -> int:
        """Lines above the first one of data."""
        return self.skip_rows + self.header_rows


PLAIN = TextLayout()
"""Commas, points, and names in the first line."""


def read_columns(
    path: Path,
    columns: Sequence[str],
    *,
    layout: TextLayout = PLAIN,
    repair: bool = False,
    dropped: Counter[str] | None = None,
) -> Array:
    """Return the named columns of a CSV file as (n, len(columns)) floats, NaN where a cell is missing.

    A delimiter too many at the end of each row, or of the header, is passed over.

    Parameters
    ----------
    path : file with a header
    columns : names in the header, in the required order
    layout : of the file
    repair : turn cells that are no number into NaN, leave out rows of the wrong length, and count both
    dropped : counts by kind, added to when repairing

    Raises
    ------
    LogError
        if the file is missing, empty, no text, lacks a column or has it twice, or (unless repairing) holds
        a cell that is no number or a row of the wrong length.
    """
    _refuse_too_large(path)
    header = header_of(path, layout)
    for column in columns:
        _place(path, header, column)
    fast = _fast_columns(path, header, columns, layout)
    if fast is not None:
        return fast
    counts: Counter[str] = Counter() if dropped is None else dropped
    places = [header.index(column) for column in columns]
    table = []
    for row, cells in _rows(path, layout):
        if len(cells) != len(header):
            if not repair:
                raise LogError(
                    f"{short_name(path)}: row {row} has {len(cells)} cells, the header has {len(header)}"
                )
            counts[SHORT_ROW] += 1
            continue
        numbers = [number_in(cells[place], layout.decimal) for place in places]
        for column, place, number in zip(columns, places, numbers, strict=True):
            if number is None:
                if not repair:
                    raise LogError(
                        f"{short_name(path)}: {column} at row {row} is {shown(cells[place])}, which is no "
                        "number"
                    )
                counts[BAD_CELL] += 1
        table.append([np.nan if number is None else number for number in numbers])
    return np.array(table, dtype=np.float64).reshape(len(table), len(columns))


def read_words(path: Path, column: str) -> list[str]:
    """Return a column of a CSV file as text, cell by cell, of the rows that have as many cells as the header.

    Raises
    ------
    LogError
        if the file is missing, empty, no text, or lacks the column or has it twice.
    """
    _refuse_too_large(path)
    header = header_of(path, PLAIN)
    place = _place(path, header, column)
    fast = _fast(path, header, {place: "string"}, PLAIN)
    if fast is not None:
        return ["" if cell is None else cell for cell in fast.column(str(place)).to_pylist()]
    return [cells[place] for _, cells in _rows(path, PLAIN) if len(cells) == len(header)]


def text_rows(path: Path, columns: Sequence[str]) -> list[tuple[int, tuple[str, ...] | None]]:
    """Return the number of each row, as an editor shows it, and the texts of its named columns.

    The texts are None of a row that is shorter or longer than the header.

    Parameters
    ----------
    path : file whose first line is a header, comma-separated
    columns : names in the header, in the required order

    Raises
    ------
    LogError
        if the file is missing, empty or no text, or lacks a column or has it twice.
    """
    _refuse_too_large(path)
    header = header_of(path, PLAIN)
    places = [_place(path, header, column) for column in columns]
    return [
        (row, tuple(cells[place] for place in places) if len(cells) == len(header) else None)
        for row, cells in _rows(path, PLAIN)
    ]


def data_row(path: Path, index: int, *, layout: TextLayout = PLAIN) -> int:
    """Return the row number, as an editor shows it, of the data row ``index`` (blank rows count)."""
    for number, (row, _) in enumerate(_rows(path, layout)):
        if number == index:
            return row
    raise IndexError(index)


def _place(path: Path, header: list[str], column: str) -> int:
    if header.count(column) != 1:
        fault = "is missing" if column not in header else "is there twice"
        raise LogError(f"{short_name(path)}: column {column!r} {fault} (the file has {listed(header)})")
    return header.index(column)


def _refuse_too_large(path: Path) -> None:
    if path.suffix != ".gz":
        return
    check_regular(path, short_name(path), LogError)
    n_bytes = 0
    try:
        with gzip.open(path, "rb") as file:
            while n_bytes <= MAX_UNPACKED_BYTES and (part := file.read(MEBIBYTE)):
                n_bytes += len(part)
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error
    if n_bytes > MAX_UNPACKED_BYTES:
        raise LogError(
            f"{short_name(path)}: unpacks to more than {MAX_UNPACKED_BYTES // MEBIBYTE} MiB, the most that "
            "is read"
        )


def _open(path: Path) -> TextIO:
    check_regular(path, short_name(path), LogError)
    if path.suffix == ".gz":
        return gzip.open(path, "rt", encoding="utf-8-sig", newline="")
    return path.open(encoding="utf-8-sig", newline="")


def header_of(path: Path, layout: TextLayout) -> list[str]:
    """Return the names of the columns, with or without an empty last one as the first row of data has it."""
    try:
        with _open(path) as file:
            reader = csv.reader(file, delimiter=layout.delimiter)
            rows = list(islice(reader, layout.skip_rows, layout.first_row + 1))
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error
    names = [normal_name(name.strip()) for name in (rows[0] if rows else [])]
    if not any(names):
        if layout.skip_rows:
            raise LogError(f"{short_name(path)}: has no names of columns in row {layout.skip_rows + 1}")
        raise LogError(f"{short_name(path)}: is empty (a header and at least 2 rows are needed)")
    first = rows[layout.header_rows] if len(rows) > layout.header_rows else names
    if len(first) == len(names) + 1 and not first[-1].strip():
        names.append("")
    if len(first) == len(names) - 1 and not names[-1]:
        names.pop()
    return names


def _fast_columns(path: Path, header: list[str], columns: Sequence[str], layout: TextLayout) -> Array | None:
    places = [header.index(column) for column in columns]
    table = _fast(path, header, dict.fromkeys(places, "float64"), layout)
    return None if table is None else np.column_stack([table.column(str(i)).to_numpy() for i in places])


def _fast(path: Path, header: list[str], types: dict[int, str], layout: TextLayout) -> Any:
    """Return the table of some columns, by their place, that pyarrow reads; None where it stumbles."""
    from pyarrow import ArrowException
    from pyarrow import csv as arrow_csv

    try:
        return arrow_csv.read_csv(
            path,
            read_options=arrow_csv.ReadOptions(
                column_names=[str(place) for place in range(len(header))], skip_rows=layout.first_row
            ),
            parse_options=arrow_csv.ParseOptions(delimiter=layout.delimiter),
            convert_options=arrow_csv.ConvertOptions(
                include_columns=[str(place) for place in types],
                column_types={str(place): kind for place, kind in types.items()},
                null_values=list(MISSING),
                quoted_strings_can_be_null=True,
                decimal_point=layout.decimal,
            ),
        )
    except (ArrowException, OSError):
        return None


def _rows(path: Path, layout: TextLayout) -> Iterator[tuple[int, list[str]]]:
    try:
        with _open(path) as file:
            reader = csv.reader(file, delimiter=layout.delimiter)
            for cells in islice(reader, layout.first_row, None):
                if cells:
                    yield reader.line_num, cells
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error


def number_in(cell: str, decimal: str = ".") -> float | None:
    """Return the number in a cell: NaN where it is missing, None where it is no number.

    Examples
    --------
    >>> number_in(" 1.5 "), number_in("NA"), number_in("wet")
    (1.5, nan, None)
    """
    text = cell.strip()
    if text in MISSING:
        return float("nan")
    if decimal != ".":
        if "." in text:
            return None
        text = text.replace(decimal, ".")
    try:
        return None if "_" in text else float(text)
    except ValueError:
        return None


def _unreadable(path: Path, error: Exception) -> LogError:
    if isinstance(error, FileNotFoundError):
        return LogError(f"{short_name(path)}: is missing")
    if isinstance(error, gzip.BadGzipFile | EOFError | zlib.error):
        return LogError(f"{short_name(path)}: is no whole gzip file ({error})")
    if isinstance(error, OSError):
        return LogError(f"{short_name(path)}: cannot be opened ({error.strerror})")
    return LogError(f"{short_name(path)}: is no CSV text ({error})")
