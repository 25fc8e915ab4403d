"""Labels of run folders: intervals that are set, windows that the model was in doubt about."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from features.windows import TIME_TOLERANCE_S
from pipelines.data.recorded_windows import read_windows
from terrain.errors import ConfigError, LogError
from terrain.files.atomic import atomic_write
from terrain.logs.read import read_run, read_run_head, run_folders
from terrain.records import Label

SLACK_S = 0.01
"""An interval may be that far outside of a run: times are typed with two digits."""


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


class ChangedLabels(NamedTuple):
    """Interval whose label was set or removed, and all labels of the run."""

    folder: Path
    start_s: float
    end_s: float
    labels: tuple[Label, ...]


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
    folders = _folders(data)
    if run_id is not None:
        folders = [_folder_of(run_id, folders, data)]
    runs: list[RunWindows] = []
    found: list[DoubtfulWindow] = []
    for folder in folders:
        head, windows = read_run_head(folder), read_windows(folder)
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
                label_over(head.labels, window.start_s, window.end_s),
            )
            for window in windows
            if window.doubtful
        ]
        runs.append(RunWindows(head.run_id, len(windows), len(rows), sum(row.label is None for row in rows)))
        found += rows
    return tuple(runs), tuple(found)


def set_label(
    data: Path, run_id: str, terrain: str, start_s: float | None = None, end_s: float | None = None
) -> ChangedLabels:
    """Set or remove a label of a run; all else in its ``run.json`` stays.

    Parameters
    ----------
    data : a run folder, or a folder of run folders
    run_id : of the run
    terrain : of the label; an empty one removes what is there
    start_s, end_s : of the interval; the whole run, with labels beyond its samples, where neither is given

    Raises
    ------
    LogError
        if there is no run, or the run is damaged.
    ConfigError
        if there is no run of the id, or the interval is outside of it.
    TerrainError
        if the file cannot be written; it is as it was then.
    """
    folder = _folder_of(run_id, _folders(data), data)
    head = read_run_head(folder)
    streams = read_run(folder, repair=True).streams.values()
    first_s = min(float(stream.time_s[0]) for stream in streams)
    last_s = max(float(stream.time_s[-1]) + 1.0 / stream.rate_hz for stream in streams)
    if start_s is None or end_s is None:  # labels may have been set beyond the samples
        start_s = min([first_s, *(label.start_s for label in head.labels)])
        end_s = max([last_s, *(label.end_s for label in head.labels)])
    elif start_s < first_s - SLACK_S or end_s > last_s + SLACK_S:
        raise ConfigError(
            f"run {run_id} is from {first_s:.6g} to {last_s:.6g} s: "
            f"{start_s:g} to {end_s:g} s is not within it"
        )
    labels = relabelled(head.labels, start_s, end_s, terrain)
    document = head.document | {"labels": [label._asdict() for label in labels]}
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
    joined: list[Label] = []
    for label in sorted(kept):
        if joined and joined[-1].terrain == label.terrain and joined[-1].end_s == label.start_s:
            joined[-1] = joined[-1]._replace(end_s=label.end_s)
        else:
            joined.append(label)
    return tuple(joined)


def label_over(labels: Sequence[Label], start_s: float, end_s: float) -> str | None:
    """Return the terrain of the label that covers an interval; None where none covers all of it."""
    for label in labels:
        if label.start_s - TIME_TOLERANCE_S <= start_s and end_s <= label.end_s + TIME_TOLERANCE_S:
            return label.terrain
    return None


def _folders(data: Path) -> list[Path]:
    if not data.is_dir():
        raise LogError(f"{data}: {'is no folder' if data.exists() else 'does not exist'}")
    found = run_folders(data)
    if not found:
        raise LogError(f"{data}: holds no run folder (run.json); 'terrain convert' makes them of other logs")
    return found


def _folder_of(run_id: str, folders: Sequence[Path], data: Path) -> Path:
    found = [folder for folder in folders if read_run_head(folder).run_id == run_id]
    if len(found) > 1:
        raise LogError(f"{data}: {len(found)} runs have the id {run_id!r}")
    if not found:
        raise ConfigError(f"{data}: there is no run {run_id!r}")
    return found[0]
