"""``windows.json`` beside the streams of a recorded run: what the model gave for each window.

Class names can be any text, so they are no channels of a stream.  Readers of run folders pass the file over.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from terrain.control.switching import SWITCHING
from terrain.errors import LogError
from terrain.logs.log_files import short_name
from terrain.records import Array

WINDOWS_FILE = "windows.json"

VERSION = 1


class WindowResult(Protocol):
    """What a model gives for a window, as the live classifier does."""

    @property
    def start_s(self) -> float: ...  # noqa: D102
    @property
    def end_s(self) -> float: ...  # noqa: D102
    @property
    def terrain(self) -> str: ...  # noqa: D102
    @property
    def probability(self) -> float: ...  # noqa: D102
    @property
    def probabilities(self) -> Array: ...  # noqa: D102
    @property
    def classes(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def refused(self) -> str: ...  # noqa: D102


class RecordedWindow(NamedTuple):
    """A window of a recorded run.

    Parameters
    ----------
    start_s, end_s : on the clock of the run
    terrain, probability : class of the largest probability; empty and NaN where the model refused the window
    probabilities : of each class; NaN where it was refused
    doubtful : the probability is below that from which an output counts, or no terrain is named
    refused : why; empty where there is an output
    """

    start_s: float
    end_s: float
    terrain: str
    probability: float
    probabilities: Mapping[str, float]
    doubtful: bool
    refused: str = ""


def window_entry(output: WindowResult) -> dict[str, Any]:
    """Return the entry of a window in ``windows.json``; a number that is not finite is None."""
    probability = float(output.probability)
    return {
        "start_s": float(output.start_s),
        "end_s": float(output.end_s),
        "terrain": str(output.terrain),
        "probability": _or_none(probability),
        "probabilities": {
            str(name): _or_none(float(each))
            for name, each in zip(output.classes, output.probabilities, strict=True)
        },
        "doubtful": not (output.terrain and probability >= SWITCHING.probability_least),
        "refused": str(output.refused),
    }


def windows_text(entries: Iterable[Mapping[str, Any]]) -> str:
    """Return the content of ``windows.json``, an entry a line."""
    lines = ",\n".join(json.dumps(entry, allow_nan=False) for entry in entries)
    head = f'{{"version": {VERSION}, "probability_least": {SWITCHING.probability_least}, "windows": [\n'
    return head + lines + "\n]}\n"


def read_windows(run_folder: Path) -> list[RecordedWindow] | None:
    """Return the windows that were recorded with a run; None where none were.

    Raises
    ------
    LogError
        if the file is damaged.
    """
    path = run_folder / WINDOWS_FILE
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"{short_name(path)}: cannot be read ({error})") from error
    try:
        document = json.loads(text)
        if document["version"] != VERSION:
            raise LogError(f"{short_name(path)}: version {document['version']!r} is unknown")
        return [_window(entry) for entry in document["windows"]]
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise LogError(f"{short_name(path)}: is damaged ({type(error).__name__}: {error})") from error


def window_of_text(place: str, text: str) -> RecordedWindow:
    """Return a window of its entry as JSON, as a bag has it.

    Raises
    ------
    LogError
        if it is damaged.
    """
    try:
        return _window(json.loads(text))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise LogError(f"{place}: a recorded window is damaged ({type(error).__name__}: {error})") from error


def _window(entry: Mapping[str, Any]) -> RecordedWindow:
    return RecordedWindow(
        float(entry["start_s"]),
        float(entry["end_s"]),
        str(entry["terrain"]),
        _or_nan(entry["probability"]),
        {str(name): _or_nan(each) for name, each in entry["probabilities"].items()},
        bool(entry["doubtful"]),
        str(entry.get("refused", "")),
    )


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else float(value)
