"""From a journal to a run folder: what a strict reader would refuse is dropped and counted."""

from __future__ import annotations

import logging
import os
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipelines.data.recorded_windows import WINDOWS_FILE, windows_text
from pipelines.recording.journal import SUFFIX, lock, read_head, read_journal
from terrain.errors import LogError, TerrainError
from terrain.logs.samples import DEAD_CHANNEL, checked_stream
from terrain.logs.write import run_folder, write_run
from terrain.records import Array, RunLog, Stream

SHORT_STREAM = "streams with fewer than 2 samples"
DEAD_STREAM = "streams with nothing finite"
APART = "streams apart in time"

DECIDED = ("commands", "control")
"""Streams that a controller writes; sensors have precedence over them."""

JUST_BEGUN_S = 60.0
"""An empty journal younger than that may be one that another process has only just made."""

_log = logging.getLogger(__name__)


class RecordedRun(NamedTuple):
    """Content of a journal; ``run`` is None where no stream can be used."""

    run: RunLog | None
    windows: list[Mapping[str, Any]]


def run_of_journal(path: Path, note: str = "") -> RecordedRun:
    """Return what a journal holds, as far as it is whole.

    Parameters
    ----------
    path : of the journal
    note : is added to the source of the run

    Raises
    ------
    LogError
        if it is no journal.
    OSError
        if it cannot be read.
    """
    head = read_head(path)
    windows: list[Mapping[str, Any]] = []
    dropped: Counter[str] = Counter()
    n_rows: Counter[str] = Counter()
    channels: dict[str, tuple[str, ...]] = {}
    for record in read_journal(path):
        dropped.update(record.line.get("dropped", {}))
        windows += record.line.get("windows", [])
        for block in record.blocks:
            channels.setdefault(block.stream, block.channels)
            n_rows[block.stream] += len(block.rows)
    streams = {}
    for name, each in channels.items():  # one after the other: a recording is large
        stream = _stream(name, each, _rows(path, name, n_rows[name]), dropped)
        if stream is not None:
            streams[name] = stream
    streams = _overlapping(streams, dropped)
    if not streams:
        return RecordedRun(None, windows)
    run = RunLog(head["run_id"], head["robot"], streams, source=head["source"] + note, dropped=dropped)
    return RecordedRun(run, windows)


def finish(path: Path, note: str = "") -> Path | None:
    """Turn a journal into a run folder and remove it; None where it holds nothing that can be kept.

    Where a run of the name is there already, the new one gets a number behind its name.

    Raises
    ------
    TerrainError, OSError
        if the journal cannot be read or the run not be written; the journal is kept.
    """
    run, windows = run_of_journal(path, note)
    if run is None:
        path.unlink()
        return None
    name, number = run.run_id, 1
    while run_folder(name, path.parent).exists():
        number += 1
        name = f"{run.run_id}_{number}"
    named = RunLog(name, run.robot, run.streams, source=run.source, dropped=run.dropped)
    folder = write_run(named, path.parent, beside={WINDOWS_FILE: windows_text(windows)} if windows else {})
    _settle(folder)
    path.unlink()
    return folder


def recover_recordings(folder: Path) -> list[Path]:
    """Turn the journals that a stopped process left in a folder into run folders; return those.

    Recordings that another process is at are passed over, and so is what cannot be read, with a warning.
    """
    found = []
    try:
        journals = sorted(path for path in folder.glob(f".*{SUFFIX}") if path.is_file())
    except OSError as error:
        _log.warning("recordings in %s are not recovered: %s", folder, error)
        return []
    for path in journals:
        try:
            with path.open("rb") as file:
                if not lock(file) or _just_begun(path):
                    continue
                if not path.stat().st_size:
                    path.unlink()
                    continue
                recovered = finish(path, ", recovered after a stop")
        except (TerrainError, OSError, ValueError, TypeError, KeyError) as error:
            _log.warning("recording %s is not recovered: %s", path.name, error)
            continue
        if recovered is not None:
            found.append(recovered)
    return found


def _just_begun(path: Path) -> bool:
    status = path.stat()
    return not status.st_size and time.time() - status.st_mtime < JUST_BEGUN_S


def _rows(path: Path, stream: str, n_rows: int) -> Array:
    """Return the rows (n, 1 + c) of a stream in the order in which they came."""
    rows, end = np.empty((n_rows, 0)), 0
    for record in read_journal(path):
        for block in record.blocks:
            if block.stream == stream:
                if not end:
                    rows = np.empty((n_rows, block.rows.shape[1]))
                rows[end : end + len(block.rows)] = block.rows
                end += len(block.rows)
    return rows


def _stream(name: str, channels: tuple[str, ...], rows: Array, dropped: Counter[str]) -> Stream | None:
    """Return the samples of a stream in order of time, without channels that never had a value."""
    try:
        stream = checked_stream(
            name,
            rows[:, 0],
            rows[:, 1:],
            channels,
            row_of=lambda index: index + 1,
            repairs=dropped,
            unknown_is_a_value=True,
        )
    except LogError:
        dropped[SHORT_STREAM] += 1
        return None
    if name == "control":  # the figures of a decision may be unknown throughout
        return stream
    alive = np.isfinite(stream.values).any(axis=0)
    if alive.all():
        return stream
    dropped[DEAD_CHANNEL] += int((~alive).sum())
    if not alive.any():
        dropped[DEAD_STREAM] += 1
        return None
    kept = tuple(channels[i] for i in np.flatnonzero(alive))
    return Stream(stream.time_s, stream.values[:, alive], kept)


def _overlapping(streams: Mapping[str, Stream], dropped: Counter[str]) -> dict[str, Stream]:
    """Return the streams that have an instant in common, as the readers require: the longest ones."""
    start_s, end_s, kept = -np.inf, np.inf, set()
    in_order = sorted(streams, key=lambda name: (name in DECIDED, -streams[name].duration_s))
    for name in in_order:
        stream = streams[name]
        latest_s, earliest_s = max(start_s, stream.time_s[0]), min(end_s, stream.time_s[-1])
        if latest_s < earliest_s:
            start_s, end_s = latest_s, earliest_s
            kept.add(name)
    if len(kept) < len(streams):
        dropped[APART] += len(streams) - len(kept)
    return {name: stream for name, stream in streams.items() if name in kept}


def _settle(folder: Path) -> None:
    """Wait until a folder and its files are on the disk."""
    for path in (*folder.iterdir(), folder, folder.parent):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
