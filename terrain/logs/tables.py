"""Numeric columns of a file by name, whatever kind of table it is: CSV, .mat, .xlsx, and Parquet of run folders.

Of a CSV the fast route is pyarrow's reader.  Where it stumbles, and in a spreadsheet, the plain route goes cell by
cell: it names the row and the cell, or, when repairing, turns the cell into NaN and counts it.  Rows are numbered as
an editor shows them, the header being row 1.  An empty cell, ``nan`` and ``NA`` are missing values.  A file whose
name ends in ``.gz`` is unpacked as it is read.

In a ``.mat`` a column is a variable, a field of a struct (``log.imu.wz``) or a column of a matrix, counted from
0 (``data[3]``).  Files of version 5 to 7 are read by scipy, those of 7.3, which are HDF5, by h5py.

What a Parquet file states of itself is judged before it is read.
"""

from __future__ import annotations

import csv
import gzip
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from io import BytesIO, TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import LogError, library, one_line
from terrain.files.names import MEBIBYTE, check_regular, listed, normal_name, printable, shown
from terrain.logs.samples import BAD_CELL, SHORT_ROW, refuse_or_count, short_name
from terrain.records import Array

MISSING = ("", "nan", "NaN", "NAN", "NA")  #: Cells that stand for a missing value

MAX_UNPACKED_BYTES = 1024 * MEBIBYTE
"""Of a packed file: 48 hours of DRIVE, and gigabytes of zeros pack to megabytes."""

MAX_FOOTER_BYTES = 16 * MEBIBYTE
"""Of the description at the end of a Parquet file, which takes many times its size when read; streams have 10 KiB."""

MAX_COLUMNS = 4096  #: Columns of a Parquet file; streams have 20

MAX_VALUES = 200_000_000
"""Rows times columns that are read, 1.6 GB as numbers: ten hours at 500 Hz of eleven channels.

A file of constant columns has thousands of millions in some kilobytes."""

_UNREADABLE = (OSError, EOFError, zlib.error, UnicodeDecodeError, csv.Error)
_Rows = Iterable[tuple[int, Sequence[Any]]]


class TextLayout(NamedTuple):
    """How a file holds its table: ``skip_rows`` lines above the names, ``header_rows`` from the names on.

    ``decimal`` stands between the digits of a number; of a header of 2 rows the second has units.
    """

    delimiter: str = ","
    decimal: str = "."
    skip_rows: int = 0
    header_rows: int = 1

    @property
    def first_row(self) -> int:
        """Lines above the first one of data."""
        return self.skip_rows + self.header_rows


PLAIN = TextLayout()  #: Commas, points, and names in the first line


def read_table(
    path: Path,
    columns: Sequence[str],
    *,
    layout: TextLayout = PLAIN,
    sheet: str = "",
    repairs: Counter[str] | None = None,
) -> Array:
    """Return the named columns of a file as (n, len(columns)) floats, NaN where a cell is missing.

    A ``.mat``, an ``.xlsx`` (the first sheet by default) or, with any other ending, a CSV file; in this a delimiter too
    many at the end of each row, or of the header, is passed over.  ``repairs`` counts cells that are no number, which
    become NaN, and rows of the wrong length, which are left out; None refuses both.  ``LogError`` where the file is
    missing, empty or damaged, lacks a column or has it twice, or holds what is refused; ``ConfigError`` where a package
    is missing.
    """
    kind, name = path.suffix.lower(), short_name(path)
    if kind == ".mat":
        return _mat_columns(path, columns)
    content = b"" if kind == ".xlsx" else read_bytes(path)
    header, rows = _sheet_rows(path, layout, sheet) if kind == ".xlsx" else _text_rows(path, content, layout)
    places = [_place(path, header, column) for column in columns]
    if content and (fast := _fast(content, len(header), places, layout)) is not None:
        return fast
    table = []
    for row, cells in rows:
        if len(cells) != len(header):
            fault = f"{name}: row {row} has {len(cells)} cells, the header has {len(header)}"
            refuse_or_count(repairs, SHORT_ROW, fault)
            continue
        numbers = [number_in(cells[place], layout.decimal) for place in places]
        for column, place, number in zip(columns, places, numbers, strict=True):
            if number is None:
                fault = f"{name}: {column} at row {row} is {shown(cells[place])}, which is no number"
                if kind == ".xlsx" and row == layout.first_row + 1:
                    more = layout.header_rows + 1
                    fault += f": a header of {more} rows is read with 'header_rows: {more}'"
                refuse_or_count(repairs, BAD_CELL, fault)
        table.append([np.nan if number is None else number for number in numbers])
    return np.array(table, dtype=np.float64).reshape(len(table), len(columns))


def read_groups(path: Path, groups: Mapping[str, Sequence[str]], **options: Any) -> dict[str, Array]:
    """Return groups of named columns of a file, each (n, c), as :func:`read_table` reads them."""
    table = read_table(path, [column for columns in groups.values() for column in columns], **options)
    ends = np.cumsum([len(columns) for columns in groups.values()])
    return dict(zip(groups, np.split(table, ends[:-1], axis=1), strict=True))


def row_number(path: Path, index: int, *, layout: TextLayout = PLAIN) -> int:
    """Return the number of the row of a sample, as an editor shows it (blank ones count); of a ``.mat`` its place."""
    kind = path.suffix.lower()
    if kind in (".mat", ".xlsx"):
        return index + 1 + (layout.first_row if kind == ".xlsx" else 0)
    return next(islice(_text_rows(path, read_bytes(path), layout)[1], index, None))[0]


def text_rows(path: Path, columns: Sequence[str]) -> list[tuple[int, tuple[str, ...] | None]]:
    """Return the number of each row of a CSV file, as an editor shows it, and the texts of its named columns.

    The texts are None of a row that is shorter or longer than the header.
    """
    header, rows = _text_rows(path, read_bytes(path), PLAIN)
    places = [_place(path, header, column) for column in columns]
    return [
        (row, tuple(cells[place] for place in places) if len(cells) == len(header) else None)
        for row, cells in rows
    ]


def header_of(path: Path, layout: TextLayout) -> list[str]:
    """Return the names of the columns of a CSV file."""
    return _text_rows(path, read_bytes(path), layout)[0]


def number_in(cell: Any, decimal: str = ".") -> float | None:
    """Return the number in a cell of a text or a sheet: NaN where it is missing, None where it is no number.

    Dates in a sheet are seconds since 1970.

    Examples
    --------
    >>> number_in(" 1.5 "), number_in("NA"), number_in("wet")
    (1.5, nan, None)
    """
    if cell is None:
        return float("nan")
    if isinstance(cell, datetime):
        import pandas as pd

        return float(pd.Timestamp(cell).value) / 1e9
    if isinstance(cell, str):
        cell = cell.strip()
        if cell in MISSING:
            return float("nan")
        if "_" in cell or (decimal != "." and "." in cell):
            return None
        cell = cell.replace(decimal, ".")
    try:
        return float(cell)
    except (TypeError, ValueError):  # a time without a date, or a word
        return None


def _place(path: Path, header: Sequence[str], column: str) -> int:
    if header.count(column) != 1:
        fault = "is missing" if column not in header else "is there twice"
        raise LogError(f"{short_name(path)}: column {shown(column)} {fault} (the file has {listed(header)})")
    return header.index(column)


def read_bytes(path: Path) -> bytes:
    """Return the bytes of a regular file, unpacked."""
    check_regular(path, short_name(path), LogError)
    try:
        if path.suffix != ".gz":
            return path.read_bytes()
        with gzip.open(path, "rb") as file:
            content = file.read(MAX_UNPACKED_BYTES + 1)
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error
    if len(content) > MAX_UNPACKED_BYTES:
        most = MAX_UNPACKED_BYTES // MEBIBYTE
        raise LogError(f"{short_name(path)}: unpacks to more than {most} MiB, the most that is read")
    return content


def _text_rows(path: Path, content: bytes, layout: TextLayout) -> tuple[list[str], _Rows]:
    """Return the names of the columns, and the rows of data that are not blank with their numbers.

    The names are with or without an empty last one, as the first row of data has it.
    """

    def lines() -> Iterator[tuple[int, list[str]]]:
        text = TextIOWrapper(BytesIO(content), encoding="utf-8-sig", newline="")
        reader = csv.reader(text, delimiter=layout.delimiter)
        try:
            for cells in reader:
                yield reader.line_num, cells
        except _UNREADABLE as error:
            raise _unreadable(path, error) from error

    rows = [cells for _, cells in islice(lines(), layout.skip_rows, layout.first_row + 1)]
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
    return names, (line for line in islice(lines(), layout.first_row, None) if line[1])


def _fast(content: bytes, width: int, places: Sequence[int], layout: TextLayout) -> Array | None:
    """Return the columns at some places that pyarrow reads; None where it stumbles."""
    from pyarrow import ArrowException
    from pyarrow import csv as arrow_csv

    names = [str(place) for place in range(width)]
    chosen = [names[place] for place in places]
    try:
        table = arrow_csv.read_csv(
            BytesIO(content),
            read_options=arrow_csv.ReadOptions(column_names=names, skip_rows=layout.first_row),
            parse_options=arrow_csv.ParseOptions(delimiter=layout.delimiter),
            convert_options=arrow_csv.ConvertOptions(
                include_columns=list(dict.fromkeys(chosen)),
                column_types=dict.fromkeys(chosen, "float64"),
                null_values=list(MISSING),
                quoted_strings_can_be_null=True,
                decimal_point=layout.decimal,
            ),
        )
    except (ArrowException, OSError):
        return None
    return np.column_stack([table.column(name).to_numpy() for name in chosen])


def _unreadable(path: Path, error: Exception) -> LogError:
    if isinstance(error, gzip.BadGzipFile | EOFError | zlib.error):
        return LogError(f"{short_name(path)}: is no whole gzip file ({error})")
    if isinstance(error, OSError):
        return LogError(f"{short_name(path)}: cannot be opened ({error.strerror or error})")
    return LogError(f"{short_name(path)}: is no CSV text ({error})")


def _sheet_rows(path: Path, layout: TextLayout, sheet: str) -> tuple[list[str], _Rows]:
    """Return the names of the columns of a sheet, and its rows with their numbers."""
    import pandas as pd

    place = short_name(path)
    library("openpyxl", f"{place}: needs the package openpyxl", "logs")
    try:
        with zipfile.ZipFile(path) as packed:
            if sum(each.file_size for each in packed.infolist()) > MAX_UNPACKED_BYTES:
                raise LogError(f"{place}: has more than {MAX_UNPACKED_BYTES} bytes when unpacked")
        with pd.ExcelFile(path, engine="openpyxl") as book:
            if sheet and sheet not in book.sheet_names:
                there = listed([*map(str, book.sheet_names)])
                raise LogError(f"{place}: has no sheet {shown(sheet)} (it has {there})")
            table = pd.read_excel(book, sheet_name=sheet or 0, header=None, dtype=object)
    except OSError as error:
        raise _unreadable(path, error) from error
    except (zipfile.BadZipFile, ValueError, KeyError, TypeError, SyntaxError) as error:
        raise LogError(f"{place}: is no .xlsx, or is damaged ({one_line(error)})") from error
    rows = table.to_numpy(dtype=object).tolist()
    if len(rows) <= layout.skip_rows:
        raise LogError(f"{place}: is empty (a header and at least 2 rows are needed)")
    header = [normal_name(str(name).strip()) for name in rows[layout.skip_rows]]
    return header, enumerate(rows[layout.first_row :], layout.first_row + 1)


def _mat_columns(path: Path, columns: Sequence[str]) -> Array:
    """Return variables of a ``.mat``, each a vector of the same length."""
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError

    name = short_name(path)
    asked = {column.partition(".")[0].partition("[")[0] for column in columns}
    variables: Mapping[str, Any]
    try:
        with path.open("rb") as file:
            head = file.read(64)
        if head.startswith((b"\x89HDF", b"MATLAB 7.3")):
            h5py = library("h5py", f"{name}: needs the package h5py", "logs")

            def content(item: Any) -> Any:
                if isinstance(item, h5py.Group):
                    return {field: content(item[field]) for field in item}
                if item.size > MAX_VALUES:
                    raise LogError(f"{name}: a variable has more than {MAX_VALUES} values")
                return np.asarray(item).T  # MATLAB writes columns first

            with h5py.File(path, "r") as packed:
                variables = {
                    each: content(packed[each]) if each in asked else None
                    for each in packed
                    if each[0] != "#"
                }
        else:
            shapes = {each: shape for each, shape, _ in whosmat(str(path))}
            for each in asked & set(shapes):
                if np.prod(shapes[each], dtype=float) > MAX_VALUES:
                    raise LogError(f"{name}: variable {shown(each)} has more than {MAX_VALUES} values")
            variables = dict.fromkeys(shapes) | loadmat(
                str(path), variable_names=[*asked], simplify_cells=True
            )
    except OSError as error:
        raise _unreadable(path, error) from error
    except (MatReadError, ValueError, TypeError, NotImplementedError, LookupError, MemoryError) as error:
        raise LogError(
            f"{name}: is no .mat of version 5 to 7.3, or is damaged ({one_line(error)})"
        ) from error
    vectors: list[Array] = []
    for column in columns:
        vectors.append(_mat_column(f"{name}: variable", variables, column))
        if vectors[-1].size != vectors[0].size:
            sizes = f"{vectors[-1].size} values, {shown(columns[0])} has {vectors[0].size}"
            raise LogError(f"{name}: variable {shown(column)} has {sizes}")
    return np.column_stack(vectors)


def _mat_column(place: str, variables: Mapping[str, Any], column: str) -> Array:
    match = re.fullmatch(r"(.+?)(?:\[(\d{1,6})\])?", column)
    name, index = (match[1], match[2]) if match is not None else (column, None)
    value: Any = variables
    for part in name.split("."):
        if not isinstance(value, Mapping) or part not in value:
            there = listed(sorted(map(str, value))) if isinstance(value, Mapping) else "no fields"
            raise LogError(f"{place} {shown(column)} is missing (there are {there})")
        value = value[part]
    if isinstance(value, Mapping):
        field = f"{name}.{next(iter(value), 'x')}"
        raise LogError(f"{place} {shown(column)} is a struct: name a field, as {field}")
    array = np.asarray(value)
    if array.dtype.kind not in "buif":
        raise LogError(f"{place} {shown(column)} holds no numbers ({array.dtype})")
    array = array.astype(np.float64)
    shape = " x ".join(map(str, array.shape)) or "a number"
    if index is not None:
        if array.ndim != 2 or int(index) >= array.shape[1]:
            raise LogError(f"{place} {shown(name)} is {shape}, {column} is not in it")
        return array[:, int(index)]
    if array.size != max(array.shape, default=1):
        raise LogError(
            f"{place} {shown(column)} is {shape}, a vector is required: {name}[0] is its first column"
        )
    return array.reshape(-1)


def read_parquet(path: Path, columns: Sequence[str]) -> list[Array]:
    """Return columns of a regular file, each (n,) floats, NaN where null.

    Raises
    ------
    LogError
        if the file is damaged or too large, or a column is missing, is there twice or holds no numbers.
    """
    import pyarrow
    from pyarrow import parquet

    place = short_name(path)
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(size - 8, 0))  # the last 8 bytes are the length of the description and a mark
            footer_bytes = int.from_bytes(file.read(4), "little")
            file.seek(0)
            if MAX_FOOTER_BYTES < footer_bytes <= size:  # a longer one than the file is damage
                fault = f"describes itself in {footer_bytes} bytes, {MAX_FOOTER_BYTES} are read"
                raise LogError(f"{place}: {fault}")
            with parquet.ParquetFile(file) as content:
                metadata, schema = content.metadata, content.schema_arrow
                if metadata.num_columns > MAX_COLUMNS:
                    fault = f"has {metadata.num_columns} columns, at most {MAX_COLUMNS} are read"
                    raise LogError(f"{place}: {fault}")
                groups = (metadata.row_group(i).num_rows for i in range(metadata.num_row_groups))
                n_rows = max(metadata.num_rows, *groups, 0)
                if n_rows * len(columns) > MAX_VALUES:
                    fault = (
                        f"has {n_rows} rows of {len(columns)} columns, at most {MAX_VALUES} values are read"
                    )
                    raise LogError(f"{place}: {fault}")
                for name in columns:
                    kind = schema.field(_place(path, schema.names, name)).type
                    if not (pyarrow.types.is_floating(kind) or pyarrow.types.is_integer(kind)):
                        fault = f"column {shown(name)} holds {str(kind)[:80]}, numbers are required"
                        raise LogError(f"{place}: {fault}")
                table = content.read(columns=list(columns), use_threads=False)
    except MemoryError as error:
        raise LogError(f"{place}: takes more memory than there is") from error
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise LogError(f"{place}: is no whole Parquet file ({printable(one_line(error, 200))})") from error
    return [table.column(name).cast("float64", safe=False).to_numpy() for name in columns]
