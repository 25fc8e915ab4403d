"""Numeric columns of a file by name, whatever kind of table it is: CSV, .mat, .xlsx, and Parquet of run folders.

Of a CSV the fast route is pyarrow's reader.  Where it stumbles, the plain route goes cell by cell: it names the row
and the cell, or, when repairing, turns the cell into NaN and counts it.  Rows are numbered as an editor
shows them, the header being row 1.  An empty cell, ``nan`` and ``NA`` are missing values.  A file whose
name ends in ``.gz`` is unpacked as it is read.

In a ``.mat`` a column is a variable, a field of a struct (``log.imu.wz``) or a column of a matrix, counted from
0 (``data[3]``).  Files of version 5 to 7 are read by scipy, those of 7.3, which are HDF5, by h5py.

What a Parquet file says of itself is judged before it is read.
"""

from __future__ import annotations

import csv
import gzip
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TextIO

import numpy as np

from terrain.errors import LogError, library
from terrain.files.names import MEBIBYTE, check_regular, listed, normal_name, printable, shown
from terrain.logs.samples import BAD_CELL, SHORT_ROW, short_name
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
    """Return a column of a CSV file as text, cell by cell, of the rows that have as many cells as the header."""
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


MAX_FOOTER_BYTES = 16 * MEBIBYTE
"""Of the description at the end of a file, which takes many times its size when read; streams have 10 KiB."""

MAX_COLUMNS = 4096
"""Columns of a file; streams have 20."""

MAX_VALUES = 200_000_000
"""Rows times columns that are read, 1.6 GB as numbers: ten hours at 500 Hz of eleven channels.

A file of constant columns has thousands of millions in some kilobytes."""


def read_parquet(path: Path, columns: Sequence[str]) -> list[Array]:
    """Return columns of a file, each (n,) floats, NaN where null.

    Parameters
    ----------
    path : regular file
    columns : names, each of one column of numbers

    Raises
    ------
    LogError
        if the file is damaged or too large, or a column is missing, is there twice or holds no numbers.
    """
    import pyarrow

    place = short_name(path)
    try:
        with path.open("rb") as file:
            _check_footer(place, file)
            return _columns(place, file, columns)
    except MemoryError as error:
        raise LogError(f"{place}: takes more memory than there is") from error
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise LogError(f"{place}: is no whole Parquet file ({_words(error)})") from error


def _words(error: Exception) -> str:
    return printable(" ".join(str(error).split())[:200])


def _check_footer(place: str, file: BinaryIO) -> None:
    """Refuse a description of the file that is too long; the last 8 bytes are its length and a mark."""
    size = file.seek(0, 2)
    file.seek(max(size - 8, 0))
    footer_bytes = int.from_bytes(file.read(4), "little")
    file.seek(0)
    if MAX_FOOTER_BYTES < footer_bytes <= size:  # a longer one than the file is damage
        raise LogError(f"{place}: describes itself in {footer_bytes} bytes, {MAX_FOOTER_BYTES} are read")


def _columns(place: str, file: BinaryIO, columns: Sequence[str]) -> list[Array]:
    from pyarrow import parquet

    with parquet.ParquetFile(file) as content:
        _check_size(place, content.metadata, len(columns))
        schema = content.schema_arrow
        for name in columns:
            _check_column(place, schema, name)
        table = content.read(columns=list(columns), use_threads=False)
    return [table.column(name).cast("float64", safe=False).to_numpy() for name in columns]


def _check_size(place: str, metadata: Any, n_read: int) -> None:
    if metadata.num_columns > MAX_COLUMNS:
        raise LogError(f"{place}: has {metadata.num_columns} columns, at most {MAX_COLUMNS} are read")
    n_rows = max(
        metadata.num_rows, *(metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)), 0
    )
    if n_rows * n_read > MAX_VALUES:
        raise LogError(
            f"{place}: has {n_rows} rows of {n_read} columns, at most {MAX_VALUES} values are read"
        )


def _check_column(place: str, schema: Any, name: str) -> None:
    import pyarrow

    if schema.names.count(name) != 1:
        fault = "is there twice" if name in schema.names else "is missing"
        raise LogError(f"{place}: column {shown(name)} {fault} (the file has {listed(schema.names)})")
    kind = schema.field(name).type
    if not (pyarrow.types.is_floating(kind) or pyarrow.types.is_integer(kind)):
        raise LogError(f"{place}: column {shown(name)} holds {str(kind)[:80]}, numbers are required")


_COLUMN = re.compile(r"(.+?)(?:\[(\d{1,6})\])?")


def read_table(
    path: Path,
    columns: Sequence[str],
    *,
    layout: TextLayout = PLAIN,
    sheet: str = "",
    repair: bool = False,
    dropped: Counter[str] | None = None,
) -> Array:
    """Return the named columns of a file as (n, len(columns)) floats, NaN where a cell is missing.

    Parameters
    ----------
    path : of the file; its ending decides how it is read
    columns : names, in the required order
    layout : of a CSV file or a spreadsheet
    sheet : of a spreadsheet; the first by default
    repair : turn cells that are no number into NaN, and count them
    dropped : counts by kind, added to when repairing

    Raises
    ------
    LogError
        if the file cannot be read, lacks a column, or (unless repairing) holds a cell that is no number.
    ConfigError
        if a package is missing.
    """
    kind = path.suffix.lower()
    if kind == ".mat":
        return _mat_columns(path, columns)
    if kind == ".xlsx":
        return _sheet_columns(path, columns, layout, sheet, Counter() if dropped is None else dropped, repair)
    return read_columns(path, columns, layout=layout, repair=repair, dropped=dropped)


def table_row(path: Path, index: int, *, layout: TextLayout = PLAIN) -> int:
    """Return the number of the row of a sample, as an editor shows it; of a ``.mat`` the place, from 1."""
    kind = path.suffix.lower()
    if kind == ".mat":
        return index + 1
    return layout.first_row + index + 1 if kind == ".xlsx" else data_row(path, index, layout=layout)


def _mat_columns(path: Path, columns: Sequence[str]) -> Array:
    """Return variables of a ``.mat``, each a vector of the same length."""
    variables = _mat_variables(path, {column.partition(".")[0].partition("[")[0] for column in columns})
    found = [_mat_column(path, variables, column) for column in columns]
    for column, each in zip(columns, found, strict=True):
        if each.size != found[0].size:
            raise LogError(
                f"{short_name(path)}: variable {shown(column)} has {each.size} values, "
                f"{shown(columns[0])} has {found[0].size}"
            )
    return np.column_stack(found)


def _mat_variables(path: Path, names: set[str]) -> Mapping[str, Any]:
    """Return the variables of some names, structs as mappings; of others only that they are there."""
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError

    try:
        with path.open("rb") as file:
            head = file.read(64)
        if head.startswith((b"\x89HDF", b"MATLAB 7.3")):
            return _hdf5_variables(path, names)
        shapes = {name: shape for name, shape, _ in whosmat(str(path))}
        for name in names & set(shapes):
            if np.prod(shapes[name], dtype=float) > MAX_VALUES:
                raise LogError(
                    f"{short_name(path)}: variable {shown(name)} has more than {MAX_VALUES} values"
                )
        read = loadmat(str(path), variable_names=[*names], simplify_cells=True)
        return dict.fromkeys(shapes) | {name: read[name] for name in names if name in read}
    except OSError as error:
        raise LogError(f"{short_name(path)}: cannot be opened ({error.strerror or error})") from error
    except (
        MatReadError,
        ValueError,
        TypeError,
        NotImplementedError,
        KeyError,
        IndexError,
        MemoryError,
    ) as error:
        text = " ".join(str(error).split())[:160]
        raise LogError(
            f"{short_name(path)}: is no .mat of version 5 to 7.3, or is damaged ({text})"
        ) from error


def _hdf5_variables(path: Path, names: set[str]) -> Mapping[str, Any]:
    h5py = library("h5py", f"{short_name(path)}: needs the package h5py", "logs")

    def content(item: Any) -> Any:
        if isinstance(item, h5py.Group):
            return {name: content(item[name]) for name in item}
        if item.size > MAX_VALUES:
            raise LogError(f"{short_name(path)}: a variable has more than {MAX_VALUES} values")
        return np.asarray(item).T  # MATLAB writes columns first

    with h5py.File(path, "r") as file:
        return {name: content(file[name]) if name in names else None for name in file if name[0] != "#"}


def _mat_column(path: Path, variables: Mapping[str, Any], column: str) -> Array:
    match = _COLUMN.fullmatch(column)
    name, index = (match[1], match[2]) if match is not None else (column, None)
    value: Any = variables
    for part in name.split("."):
        if not isinstance(value, Mapping) or part not in value:
            there = listed(sorted(map(str, value))) if isinstance(value, Mapping) else "no fields"
            raise LogError(f"{short_name(path)}: variable {shown(column)} is missing (there are {there})")
        value = value[part]
    if isinstance(value, Mapping):
        raise LogError(
            f"{short_name(path)}: variable {shown(column)} is a struct: name a field, "
            f"as {name}.{next(iter(value), 'x')}"
        )
    array = np.asarray(value)
    if array.dtype.kind not in "buif":
        raise LogError(f"{short_name(path)}: variable {shown(column)} holds no numbers ({array.dtype})")
    array = array.astype(np.float64)
    if index is not None:
        if array.ndim != 2 or int(index) >= array.shape[1]:
            raise LogError(
                f"{short_name(path)}: variable {shown(name)} is {_shape(array)}, {column} is not in it"
            )
        return array[:, int(index)]
    if array.size != max(array.shape, default=1):
        raise LogError(
            f"{short_name(path)}: variable {shown(column)} is {_shape(array)}, a vector is required: "
            f"{name}[0] is its first column"
        )
    return array.reshape(-1)


def _shape(array: Array) -> str:
    return " x ".join(map(str, array.shape)) or "a number"


def _sheet_columns(
    path: Path, columns: Sequence[str], layout: TextLayout, sheet: str, dropped: Counter[str], repair: bool
) -> Array:
    """Return columns of a sheet; dates are seconds since 1970."""
    import pandas as pd

    place = short_name(path)
    library("openpyxl", f"{place}: needs the package openpyxl", "logs")
    try:
        with zipfile.ZipFile(path) as packed:
            if sum(each.file_size for each in packed.infolist()) > MAX_UNPACKED_BYTES:
                raise LogError(f"{place}: has more than {MAX_UNPACKED_BYTES} bytes when unpacked")
        with pd.ExcelFile(path, engine="openpyxl") as book:
            if sheet and sheet not in book.sheet_names:
                raise LogError(
                    f"{place}: has no sheet {shown(sheet)} (it has {listed([*map(str, book.sheet_names)])})"
                )
            table = pd.read_excel(book, sheet_name=sheet or 0, header=None, dtype=object)
    except OSError as error:
        raise LogError(f"{place}: cannot be opened ({error.strerror or error})") from error
    except (zipfile.BadZipFile, ValueError, KeyError, TypeError, SyntaxError) as error:
        raise LogError(
            f"{place}: is no .xlsx, or is damaged ({' '.join(str(error).split())[:160]})"
        ) from error
    rows = table.to_numpy(dtype=object)
    if len(rows) <= layout.skip_rows:
        raise LogError(f"{place}: is empty (a header and at least 2 rows are needed)")
    header = [normal_name(str(name).strip()) for name in rows[layout.skip_rows]]
    found = []
    for column in columns:
        if header.count(column) != 1:
            fault = "is missing" if column not in header else "is there twice"
            raise LogError(f"{place}: column {column!r} {fault} (the sheet has {listed(header)})")
        cells = rows[layout.first_row :, header.index(column)]
        numbers = [_cell(cell) for cell in cells]
        for index in (index for index, number in enumerate(numbers) if number is None):
            if repair:
                dropped[BAD_CELL] += 1
                continue
            row, value = layout.first_row + index + 1, shown(cells[index])
            if index == 0 and all(number is not None for number in numbers[1:]):
                raise LogError(
                    f"{place}: row {row} has {value} in column {column!r}, which is no number: a header of "
                    f"{layout.header_rows + 1} rows is read with 'header_rows: {layout.header_rows + 1}'"
                )
            raise LogError(f"{place}: {column} at row {row} is {value}, which is no number")
        found.append([np.nan if number is None else number for number in numbers])
    return np.array(found, dtype=np.float64).reshape(len(columns), -1).T


def _cell(cell: Any) -> float | None:
    """Return the number in a cell: NaN where it is empty, None where it is no number."""
    if cell is None or (isinstance(cell, float) and np.isnan(cell)):
        return float("nan")
    if isinstance(cell, datetime):
        import pandas as pd

        return float(pd.Timestamp(cell).value) / 1e9
    return number_in(cell) if isinstance(cell, str) else float(cell)
