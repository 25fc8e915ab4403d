"""Windows that were recorded with a run: what the model gave for each, in ``windows.json`` or in a bag.

Class names can be any text, so they are no channels of a stream.  Readers of run folders pass the file over.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from terrain.errors import LogError
from terrain.files.documents import first_fault
from terrain.files.regular import MEBIBYTE, read_regular
from terrain.logs.labels import folder_of, label_over, labelled_folders
from terrain.logs.log_files import short_name
from terrain.logs.read import read_run_head

WINDOWS_FILE = "windows.json"

MAX_BYTES = 64 * MEBIBYTE
"""Windows each second of a week with ten classes."""

Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
"""A number that is null in JSON where it is not finite."""


class RecordedWindow(BaseModel):
    """A window of a recorded run.

    Parameters
    ----------
    start_s, end_s : on the clock of the run
    terrain, probability : class of the largest probability; empty and NaN where the model refused the window
    probabilities : of each class; NaN where it was refused
    doubtful : the probability is below that from which an output counts, or no terrain is named
    refused : why; empty where there is an output
    """

    model_config = ConfigDict(frozen=True)

    start_s: float
    end_s: float
    terrain: str
    probability: Number
    probabilities: dict[str, Number]
    doubtful: bool
    refused: str = ""


class _File(BaseModel):
    """Content of ``windows.json``."""

    version: Literal[1]
    windows: list[RecordedWindow]


def windows_text(windows: Iterable[RecordedWindow]) -> str:
    """Return the content of ``windows.json``; a number that is not finite is null."""
    return _File(version=1, windows=list(windows)).model_dump_json(indent=1) + "\n"


def read_windows(run_folder: Path) -> list[RecordedWindow] | None:
    """Return the windows that were recorded with a run; None where none were.

    Raises
    ------
    LogError
        if the file is damaged.
    """
    path = run_folder / WINDOWS_FILE
    if not path.exists():
        return None
    place = short_name(path)
    try:
        return _File.model_validate_json(read_regular(path, place, LogError, MAX_BYTES)).windows
    except ValidationError as error:
        raise LogError(f"{place}: is damaged ({first_fault(error)})") from error


def window_of_text(place: str, text: str) -> RecordedWindow:
    """Return a window of its entry as JSON, as a bag has it.

    Raises
    ------
    LogError
        if it is damaged.
    """
    try:
        return RecordedWindow.model_validate_json(text)
    except ValidationError as error:
        raise LogError(f"{place}: a recorded window is damaged ({first_fault(error)})") from error


class DoubtfulWindow(NamedTuple):
    """A window whose output does not count.

    Parameters
    ----------
    run_id, start_s, end_s : which one
    terrain, probability : output of the model; empty and NaN where it refused the window
    refused : why it did
    label : of the run, where one covers the whole window
    """

    run_id: str
    start_s: float
    end_s: float
    terrain: str
    probability: float
    refused: str
    label: str | None


class RunWindows(NamedTuple):
    """Windows of a run: how many there are, are doubtful, and of those lack a label; None: none recorded."""

    run_id: str
    n_windows: int | None
    n_doubtful: int
    n_without_label: int


def doubtful_windows(
    data: Path, run_id: str | None = None
) -> tuple[tuple[RunWindows, ...], tuple[DoubtfulWindow, ...]]:
    """Return the windows whose outputs do not count, of all runs or of one, and how many each run has.

    Raises
    ------
    LogError
        if there is no run, or a file of a run is damaged.
    ConfigError
        if there is no run of the id.
    """
    folders = labelled_folders(data)
    if run_id is not None:
        folders = [folder_of(run_id, folders, data)]
    runs: list[RunWindows] = []
    found: list[DoubtfulWindow] = []
    for folder in folders:
        head, windows = read_run_head(folder), read_windows(folder)
        labels = head.checked_labels(short_name(folder / "run.json"))
        if windows is None:
            runs.append(RunWindows(head.run_id, None, 0, 0))
            continue
        rows = [
            DoubtfulWindow(
                head.run_id,
                window.start_s,
                window.end_s,
                window.terrain,
                window.probability,
                window.refused,
                label_over(labels, window.start_s, window.end_s),
            )
            for window in windows
            if window.doubtful
        ]
        runs.append(RunWindows(head.run_id, len(windows), len(rows), sum(row.label is None for row in rows)))
        found += rows
    return tuple(runs), tuple(found)
