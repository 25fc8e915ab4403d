"""Fingerprints of many runs in files by their value: equal ones are in one file, one is read at a time."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from terrain.logs.duplicates import EqualCodes, equal_codes, pairs_of
from terrain.logs.fingerprints import RunPrint

N_FILES = 32
RECORD = np.dtype([("code", "<i8"), ("time_s", "<f8"), ("run", "<i4")])
SPREADING = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio: the first bits of a product with it are spread evenly (Knuth, The Art of
Computer Programming 3, section 6.4)."""


class PrintFiles:
    """The fingerprints of runs, on disk while the block lasts.

    Parameters
    ----------
    folder : of the files; what it holds is removed before and after

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> codes, time_s = np.arange(9), np.arange(9.0)
    >>> with TemporaryDirectory() as folder, PrintFiles(Path(folder) / "prints") as prints:
    ...     prints.add(RunPrint(codes, time_s, b""))
    ...     prints.add(RunPrint(codes[1:], 50.0 + time_s[1:], b""))
    ...     prints.possible_pairs()
    [(0, 1)]
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._digests: list[bytes] = []

    def __enter__(self) -> Self:
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir()
        self._files = [(self._folder / str(number)).open("w+b") for number in range(N_FILES)]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for file in self._files:
            file.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def add(self, prints: RunPrint) -> None:
        """Take the fingerprints of the next run."""
        records = np.empty(len(prints.codes), RECORD)
        records["code"], records["time_s"], records["run"] = prints.codes, prints.time_s, len(self._digests)
        self._digests.append(prints.digest)
        number = (prints.codes.astype(np.uint64) * SPREADING) // np.uint64(2**64 // N_FILES)
        for each in np.unique(number).tolist():
            self._files[each].write(records[number == each].tobytes())

    def possible_pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of runs, by their places, that may share a stretch.

        :func:`~terrain.logs.duplicates.shared_stretches` decides.
        """
        found = []
        for file in self._files:
            file.seek(0)
            records = np.frombuffer(file.read(), RECORD)
            found.append(equal_codes(records["code"], records["run"], records["time_s"]))
        return pairs_of(EqualCodes(*map(np.concatenate, zip(*found, strict=True))), self._digests)
