"""Windows that were recorded with a run: what the model gave for each, in ``windows.json`` or in a bag.

Class names can be any text, so they are no channels of a stream.  Readers of run folders pass the file over.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from terrain.control.switching import SWITCHING
from terrain.errors import LogError
from terrain.files.regular import MEBIBYTE, read_regular
from terrain.logs.log_files import short_name
from terrain.logs.mapping import first_fault

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
    probability_least: float = SWITCHING.probability_least
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
