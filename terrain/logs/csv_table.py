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
from pathlib import Path
from typing import TextIO

import numpy as np

from terrain.errors import LogError
from terrain.files.names import listed, shown
from terrain.files.regular import MEBIBYTE, check_regular
from terrain.logs.log_files import short_name
from terrain.logs.samples import BAD_CELL, SHORT_ROW
from terrain.records import Array

MISSING = ("", "nan", "NaN", "NAN", "NA")
"""Cells that stand for a missing value."""

MAX_UNPACKED_BYTES = 1024 * MEBIBYTE
"""Of a packed file: 48 hours of DRIVE, and gigabytes of zeros pack to megabytes."""

_UNREADABLE = (OSError, EOFError, zlib.error, UnicodeDecodeError, csv.Error)


def read_columns(
    path: Path,
    columns: Sequence[str],
    *,
    delimiter: str = ",",
    repair: bool = False,
    dropped: Counter[str] | None = None,
) -> Array:
    """Return the named columns of a CSV file as (n, len(columns)) floats, NaN where a cell is missing.

    Parameters
    ----------
    path : file whose first line is a header
    columns : names in the header, in the required order
    delimiter : one character
    repair : turn cells that are no number into NaN, leave out rows of the wrong length, and count both
    dropped : counts by kind, added to when repairing

    Raises
    ------
    LogError
        if the file is missing, empty, no text, lacks a column or has it twice, or (unless repairing) holds
        a cell that is no number or a row of the wrong length.
    """
    _refuse_too_large(path)
    header = _checked_header(path, columns, delimiter)
    fast = _fast_columns(path, header, columns, delimiter)
    if fast is not None:
        return fast
    counts: Counter[str] = Counter() if dropped is None else dropped
    places = [header.index(column) for column in columns]
    table = []
    for row, cells in _rows(path, delimiter):
        if len(cells) != len(header):
            if not repair:
                raise LogError(
                    f"{short_name(path)}: row {row} has {len(cells)} cells, the header has {len(header)}"
                )
            counts[SHORT_ROW] += 1
            continue
        numbers = [number_in(cells[place]) for place in places]
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
    header = _checked_header(path, columns, ",")
    places = [header.index(column) for column in columns]
    return [
        (row, tuple(cells[place] for place in places) if len(cells) == len(header) else None)
        for row, cells in _rows(path, ",")
    ]


def number_in(cell: str) -> float | None:
    """Return the number in a cell: NaN where it is missing, None where it is no number.

    Examples
    --------
    >>> number_in(" 1.5 "), number_in("NA"), number_in("wet")
    (1.5, nan, None)
    """
    text = cell.strip()
    if text in MISSING:
        return float("nan")
    try:
        return None if "_" in text else float(text)
    except ValueError:
        return None


def data_row(path: Path, index: int, *, delimiter: str = ",") -> int:
    """Return the row number, as an editor shows it, of the data row ``index`` (blank rows count)."""
    for number, (row, _) in enumerate(_rows(path, delimiter)):
        if number == index:
            return row
    raise IndexError(index)


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


def _header(path: Path, delimiter: str) -> list[str]:
    try:
        with _open(path) as file:
            first = next(csv.reader(file, delimiter=delimiter), [])
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error
    names = [name.strip() for name in first]
    if not any(names):
        raise LogError(f"{short_name(path)}: is empty (a header and at least 2 rows are needed)")
    return names


def _checked_header(path: Path, columns: Sequence[str], delimiter: str) -> list[str]:
    header = _header(path, delimiter)
    for column in columns:
        if header.count(column) != 1:
            fault = "is missing" if column not in header else "is there twice"
            raise LogError(f"{short_name(path)}: column {column!r} {fault} (the file has {listed(header)})")
    return header


def _fast_columns(path: Path, header: list[str], columns: Sequence[str], delimiter: str) -> Array | None:
    from pyarrow import ArrowException
    from pyarrow import csv as arrow_csv

    places = [str(header.index(column)) for column in columns]
    try:
        table = arrow_csv.read_csv(
            path,
            read_options=arrow_csv.ReadOptions(
                column_names=[str(place) for place in range(len(header))], skip_rows=1
            ),
            parse_options=arrow_csv.ParseOptions(delimiter=delimiter),
            convert_options=arrow_csv.ConvertOptions(
                include_columns=places,
                column_types=dict.fromkeys(places, "float64"),
                null_values=list(MISSING),
                quoted_strings_can_be_null=True,
            ),
        )
    except (ArrowException, OSError):
        return None
    return np.column_stack([table.column(place).to_numpy() for place in places])


def _rows(path: Path, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    try:
        with _open(path) as file:
            reader = csv.reader(file, delimiter=delimiter)
            next(reader, None)
            for cells in reader:
                if cells:
                    yield reader.line_num, cells
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> LogError:
    if isinstance(error, FileNotFoundError):
        return LogError(f"{short_name(path)}: is missing")
    if isinstance(error, gzip.BadGzipFile | EOFError | zlib.error):
        return LogError(f"{short_name(path)}: is no whole gzip file ({error})")
    if isinstance(error, OSError):
        return LogError(f"{short_name(path)}: cannot be opened ({error.strerror})")
    return LogError(f"{short_name(path)}: is no CSV text ({error})")
