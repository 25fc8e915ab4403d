"""Numeric columns of a file by name, whatever kind of table it is: CSV, MATLAB's .mat, a spreadsheet's .xlsx.

In a ``.mat`` a column is a variable, a field of a struct (``log.imu.wz``) or a column of a matrix, counted from
0 (``data[3]``).  Files of version 5 to 7 are read by scipy, those of 7.3, which are HDF5, by h5py.
"""

from __future__ import annotations

import re
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from terrain.errors import LogError, library
from terrain.files.names import listed, normal_name, shown
from terrain.logs.csv_table import MAX_UNPACKED_BYTES, PLAIN, TextLayout, data_row, number_in, read_columns
from terrain.logs.log_files import short_name
from terrain.logs.parquet_file import MAX_VALUES
from terrain.logs.samples import BAD_CELL
from terrain.records import Array

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
