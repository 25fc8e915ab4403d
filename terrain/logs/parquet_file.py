"""Numeric columns of a Parquet file, by name; what the file says of itself is judged before it is read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

from terrain.errors import LogError
from terrain.files.names import listed, printable, shown
from terrain.files.regular import MEBIBYTE
from terrain.logs.log_files import short_name
from terrain.records import Array

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
