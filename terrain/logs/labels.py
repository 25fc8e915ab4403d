"""Labels of runs: intervals as the terrains change, those that are set, and those of run folders.

Beside them lie the windows that were recorded with a run: what the model gave for each, in ``windows.json`` or in a
bag.  Class names can be any text, so they are no channels of a stream; readers of run folders pass the file over.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, BeforeValidator, ConfigDict

from terrain.errors import ConfigError, LogError
from terrain.files.atomic import atomic_write
from terrain.files.documents import accepted, read_json
from terrain.files.names import MEBIBYTE, read_regular
from terrain.logs.run_folders import read_run, read_run_head, run_folders
from terrain.logs.samples import short_name, whole_run_label
from terrain.logs.schema import TIME_TOLERANCE_S
from terrain.records import Label, Stream

SLACK_S = 0.01  #: An interval may be that far outside of a run: times are typed with two digits

WINDOWS_FILE = "windows.json"

MAX_BYTES = 64 * MEBIBYTE  #: Windows each second of a week with ten classes

Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
"""A number that is null in JSON where it is not finite."""


class ChangedLabels(NamedTuple):
    """Interval whose label was set or removed, and all labels of the run."""

    folder: Path
    start_s: float
    end_s: float
    labels: tuple[Label, ...]


class RecordedWindow(BaseModel):
    """A window of a recorded run, on the clock of the run.

    ``terrain`` and ``probability`` are of the class of the largest probability; empty and NaN, as all
    ``probabilities``, where the model refused the window, for the reason in ``refused``.  It is ``doubtful`` where the
    probability is below that from which an output counts, or no terrain is named.
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
    version: Literal[1]
    windows: list[RecordedWindow]


class DoubtfulWindow(NamedTuple):
    """A recorded window whose output does not count; ``label`` is that of the run which covers all of it."""

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


def label_intervals(
    texts: Sequence[tuple[int, str]], start_ns: int, streams: Mapping[str, Stream]
) -> tuple[Label, ...]:
    """Return the terrain intervals of a run from the terrains as they change, by log time in ns, in order.

    An empty text ends a terrain; the last one lasts until the end of the streams.

    Examples
    --------
    >>> imu = Stream([0.0, 1.0, 2.0], [[0.0]] * 3, ("gyro_z_radps",))
    >>> label_intervals([(10**9, "ICE"), (10**9 + 5 * 10**8, "ICE"), (2 * 10**9, "")], 0, {"imu": imu})
    (Label(start_s=1.0, end_s=2.0, terrain='ICE'),)
    """
    end_s = whole_run_label(streams, "all").end_s
    changes = [((log_ns - start_ns) / 1e9, terrain.strip()) for log_ns, terrain in texts]
    spans = (
        Label(begin_s, min(stop_s, end_s), name)
        for (begin_s, name), (stop_s, _) in pairwise([*changes, (end_s, "")])
    )
    return _joined(label for label in spans if label.terrain and label.start_s < label.end_s)


def _joined(labels: Iterable[Label]) -> tuple[Label, ...]:
    """Return labels in order, of which those of one terrain that meet are one."""
    joined: list[Label] = []
    for label in labels:
        if joined and joined[-1].terrain == label.terrain and joined[-1].end_s == label.start_s:
            joined[-1] = joined[-1]._replace(end_s=label.end_s)
        else:
            joined.append(label)
    return tuple(joined)


def label_changes(labels: Iterable[Label]) -> list[tuple[float, str]]:
    """Return the terrains as they change, the inverse of :func:`label_intervals`; an empty one where none holds."""
    changes: list[tuple[float, str]] = []
    for label in sorted(labels):
        if changes and changes[-1] == (label.start_s, ""):
            changes.pop()
        changes += [(label.start_s, label.terrain), (label.end_s, "")]
    return changes


def set_label(
    data: Path, run_id: str, terrain: str, start_s: float | None = None, end_s: float | None = None
) -> ChangedLabels:
    """Set a label of a run, or remove it by an empty terrain; all else in its ``run.json`` stays.

    ``data`` is a run folder or has them.  The whole run, with labels beyond its samples, is taken where no interval is
    given.  ``ConfigError`` where there is no such run, or the interval is outside of it; ``LogError`` where it is
    damaged.
    """
    (folder,) = run_folders_of(data, run_id)
    run = read_run(folder, repair=True)
    streams = run.streams.values()
    first_s = min(float(stream.time_s[0]) for stream in streams)
    last_s = max(float(stream.time_s[-1]) + 1.0 / stream.rate_hz for stream in streams)
    if start_s is None or end_s is None:  # labels may have been set beyond the samples
        start_s = min([first_s, *(label.start_s for label in run.labels)])
        end_s = max([last_s, *(label.end_s for label in run.labels)])
    elif start_s < first_s - SLACK_S or end_s > last_s + SLACK_S:
        raise ConfigError(
            f"run {run_id} is from {first_s:.6g} to {last_s:.6g} s: "
            f"{start_s:g} to {end_s:g} s is not within it"
        )
    labels = relabelled(run.labels, start_s, end_s, terrain)
    document = read_json(folder / "run.json", run_id, LogError)
    document["labels"] = [label._asdict() for label in labels]
    atomic_write(folder / "run.json", json.dumps(document, indent=2, allow_nan=False) + "\n")
    return ChangedLabels(folder, start_s, end_s, labels)


def relabelled(labels: Iterable[Label], start_s: float, end_s: float, terrain: str) -> tuple[Label, ...]:
    """Return labels with ``[start_s, end_s)`` of a terrain, or without any where it is empty.

    A label that reaches over an end of the interval is cut there; labels of one terrain that meet become
    one, as a window across their boundary is of that terrain.

    Examples
    --------
    >>> relabelled([Label(0.0, 9.0, "a")], 2.0, 4.0, "b")  # doctest: +NORMALIZE_WHITESPACE
    (Label(start_s=0.0, end_s=2.0, terrain='a'), Label(start_s=2.0, end_s=4.0, terrain='b'),
     Label(start_s=4.0, end_s=9.0, terrain='a'))
    >>> relabelled([Label(0.0, 2.0, "a"), Label(4.0, 9.0, "a")], 2.0, 4.0, "a")
    (Label(start_s=0.0, end_s=9.0, terrain='a'),)
    """
    kept = [Label(start_s, end_s, terrain)] if terrain else []
    for label in labels:
        parts = (label.start_s, min(label.end_s, start_s)), (max(label.start_s, end_s), label.end_s)
        kept += [Label(begin_s, until_s, label.terrain) for begin_s, until_s in parts if begin_s < until_s]
    return _joined(sorted(kept))


def run_folders_of(data: Path, run_id: str | None = None) -> list[Path]:
    """Return the run folders under a folder, which are the ones that labels can be set of, or the one of a run.

    None is refused, and so are several of one run.
    """
    if not data.is_dir():
        raise LogError(f"{data}: {'is no folder' if data.exists() else 'does not exist'}")
    folders = run_folders(data)
    if not folders:
        raise LogError(f"{data}: holds no run folder (run.json); 'terrain convert' makes them of other logs")
    if run_id is None:
        return folders
    named = [folder for folder in folders if read_run_head(folder).run_id == run_id]
    if len(named) > 1:
        raise LogError(f"{data}: {len(named)} runs have the id {run_id!r}")
    if not named:
        raise ConfigError(f"{data}: there is no run {run_id!r}")
    return named


def windows_text(windows: Iterable[RecordedWindow]) -> str:
    """Return the content of ``windows.json``; a number that is not finite is null."""
    return _File(version=1, windows=list(windows)).model_dump_json(indent=1) + "\n"


def read_windows(run_folder: Path) -> list[RecordedWindow] | None:
    """Return the windows that were recorded with a run; None where none were."""
    path = run_folder / WINDOWS_FILE
    if not path.exists():
        return None
    place = short_name(path)
    text = read_regular(path, place, LogError, MAX_BYTES)
    return accepted(_File, text, place, LogError, "is damaged").windows


def window_of_text(place: str, text: str) -> RecordedWindow:
    """Return a window of its entry as JSON, as a bag has it."""
    return accepted(RecordedWindow, text, place, LogError, "a recorded window is damaged")


def doubtful_windows(
    data: Path, run_id: str | None = None
) -> tuple[tuple[RunWindows, ...], tuple[DoubtfulWindow, ...]]:
    """Return the windows whose outputs do not count, of all runs or of one, and how many each run has."""
    runs: list[RunWindows] = []
    doubtful: list[DoubtfulWindow] = []
    for folder in run_folders_of(data, run_id):
        head, windows = read_run_head(folder), read_windows(folder)
        labels = head.checked_labels(short_name(folder / "run.json"))
        n_doubtful = n_bare = 0
        for w in windows or ():
            if w.doubtful:
                first_s, last_s = w.start_s + TIME_TOLERANCE_S, w.end_s - TIME_TOLERANCE_S
                over = [each.terrain for each in labels if each.start_s <= first_s and last_s <= each.end_s]
                label = over[0] if over else None  # that covers all of it
                about = (w.start_s, w.end_s, w.terrain, w.probability, w.refused, label)
                doubtful.append(DoubtfulWindow(head.run_id, *about))
                n_doubtful, n_bare = n_doubtful + 1, n_bare + (label is None)
        n_windows = None if windows is None else len(windows)
        runs.append(RunWindows(head.run_id, n_windows, n_doubtful, n_bare))
    return tuple(runs), tuple(doubtful)
