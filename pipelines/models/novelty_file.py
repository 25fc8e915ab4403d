"""A fitted novelty score beside a model, as plain arrays: nothing is unpickled."""

from __future__ import annotations

import io
import zipfile

import numpy as np

from terrain.classify.novelty_numbers import NoveltyNumbers, check_novelty
from terrain.errors import DataError

NOVELTY_FILE = "novelty.npz"
MAX_UNPACKED_BYTES = 1 << 28


def novelty_bytes(numbers: NoveltyNumbers) -> bytes:
    """Return the content of the file."""
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **numbers._asdict())
    return stream.getvalue()


def read_novelty(content: bytes, n_classes: int) -> NoveltyNumbers:
    """Return the numbers that a file's content holds.

    Raises
    ------
    DataError
        if it is no such file, or its numbers do not fit each other or the number of classes.
    """
    try:
        members = zipfile.ZipFile(io.BytesIO(content)).infolist()
        if sum(member.file_size for member in members) > MAX_UNPACKED_BYTES:
            raise DataError("it unpacks to more than 256 MiB")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            numbers = NoveltyNumbers(*(arrays[name] for name in NoveltyNumbers._fields))
    except DataError:
        raise
    except Exception as error:  # whatever a damaged archive leads to
        raise DataError(f"the novelty score cannot be read ({str(error) or type(error).__name__})") from error
    check_novelty(numbers, n_classes)
    return numbers
