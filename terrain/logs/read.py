"""Reader of run folders, the format in which this package keeps its logs.

One folder per run holds ``run.json`` and one Parquet file per stream::

    SNOW_07/
      run.json
      imu.parquet        columns time_s, gyro_x_radps, ... (64-bit floats; null and NaN: missing)
      wheels.parquet     columns time_s, speed_left_mps, ...

``run.json`` says what is in them::

    {
      "schema_version": 1,
      "run_id": "SNOW_07",
      "robot": "husky",
      "session": "monday",
      "source": "where the log comes from, in words",
      "labels": [{"start_s": 0.0, "end_s": 54.92, "terrain": "SNOW"}],
      "streams": {
        "imu": {"file": "imu.parquet", "channels": {"gyro_x_radps": "radps"}}
      },
      "dropped": {"rows with a bad time": 3}
    }

Times are seconds on the clock of the run and strictly increase.  A label holds from ``start_s`` to just
before ``end_s``; labels do not overlap.  Each channel is named with its SI unit word, which is written
beside it too.  ``dropped`` (may be left out) counts what a repairing reader took away before; ``session``
(may be left out) names the outing that the run is part of, ``filter`` the one that made the streams
``estimator``, ``slip`` and ``state``.

Run id, robot, session, terrains, streams, channels and files are plain names, in letters of any language: no
path separator, no control character, no dot in front, 128 characters at most.  A robot is one of the package,
or one that the user gives; a log names no file.  The folder may be a link, its files may not lead out of it.
Other files in the folder are passed over.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import LogError
from terrain.files.documents import read_json
from terrain.files.names import name_fault, shown
from terrain.logs.log_files import check_log_file, checked_names, short_name
from terrain.logs.parquet_file import read_parquet
from terrain.logs.samples import checked_stream, refuse_apart
from terrain.logs.schema import SCHEMA_VERSION, unit_of
from terrain.records import Label, RunLog

MAX_STREAMS = 64
"""Streams of a run; each is held in memory, and several may name one file."""

MAY_BE_UNKNOWN = ("slip", "truth", "control", "testbed")
"""Streams of which a channel may hold nothing but NaN."""


def find_runs(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per run folder of :func:`run_folders`; call it with ``repair=``."""
    return [partial(read_run, path) for path in run_folders(folder)]


def run_folders(folder: Path) -> list[Path]:
    """Return the run folders: ``folder`` itself, or those in it, sorted.

    Hidden folders (unfinished writes) are passed over.
    """
    if (folder / "run.json").exists():
        return [folder]
    return sorted(path.parent for path in folder.glob("*/run.json") if not path.parent.name.startswith("."))


def read_run(folder: str | Path, *, repair: bool = False) -> RunLog:
    """Return the run that a run folder holds.

    Parameters
    ----------
    folder : folder with ``run.json``
    repair : drop and count what a strict read refuses in the streams

    Raises
    ------
    LogError
        if ``run.json`` is missing, is not JSON, has another schema version, lacks a key or holds something
        that is not accepted there; if a name in it is no plain one; if a Parquet file is missing, damaged,
        too large or lacks a column; if a file is a link that leads out of the folder; or if a stream is
        broken.
    """
    folder = Path(folder)
    head = _read_head(folder / "run.json")
    place = short_name(folder / "run.json")
    dropped = Counter(_counts(place, head.get("dropped", {})))
    streams = {}
    described = _entry(place, head, "streams", dict)
    if len(described) > MAX_STREAMS:
        raise LogError(f"{place}: the run has {len(described)} streams, at most {MAX_STREAMS} are read")
    for name, entry in described.items():
        file = _entry(f"{place}: stream {name}", entry, "file", str)
        if (fault := name_fault(file)) is not None:
            raise LogError(
                f"{place}: stream {name}: {shown(file)} is not the name of a file in the run folder: "
                f"it {fault}"
            )
        channels = _channels(
            f"{place}: stream {name}", _entry(f"{place}: stream {name}", entry, "channels", dict)
        )
        time_s, *values = read_parquet(check_log_file(folder / file, folder), ["time_s", *channels])
        streams[name] = checked_stream(
            short_name(folder / file),
            time_s,
            np.column_stack(values),
            channels,
            row_of=lambda index: index + 1,
            repairs=dropped if repair else None,
            unknown_is_a_value=name in MAY_BE_UNKNOWN,
        )
    if not streams:
        raise LogError(f"{place}: the run has no stream")
    run_id = _entry(place, head, "run_id", str)
    refuse_apart(run_id, streams)
    return checked_names(
        place,
        RunLog(
            run_id,
            _entry(place, head, "robot", str),
            streams,
            read_labels(place, _entry(place, head, "labels", list)),
            source=_entry(place, head, "source", str),
            dropped=dropped,
            session=_entry(place, {"session": ""} | head, "session", str),
            filter=_entry(place, {"filter": ""} | head, "filter", str),
        ),
    )


class RunHead(NamedTuple):
    """What ``run.json`` states of a run.

    Parameters
    ----------
    run_id : of the run
    labels : terrain intervals
    document : all of the file
    """

    run_id: str
    labels: tuple[Label, ...]
    document: dict[str, Any]


def read_run_head(folder: str | Path) -> RunHead:
    """Return what ``run.json`` states, without reading the streams.

    Raises
    ------
    LogError
        if ``run.json`` is not accepted.
    """
    path = Path(folder) / "run.json"
    head, place = _read_head(path), short_name(path)
    return RunHead(
        _entry(place, head, "run_id", str), read_labels(place, _entry(place, head, "labels", list)), head
    )


def _read_head(path: Path) -> dict[str, Any]:
    place = short_name(path)
    head = read_json(check_log_file(path, path.parent), place, LogError)
    version = _entry(place, head, "schema_version", int)
    if version != SCHEMA_VERSION:
        raise LogError(f"{place}: schema version {version} is unknown, this package reads {SCHEMA_VERSION}")
    return dict(head)


def _entry(place: str, mapping: Any, key: str, kind: type) -> Any:
    if not isinstance(mapping, dict):
        raise LogError(f"{place}: {shown(mapping)} is no JSON object")
    if key not in mapping:
        raise LogError(f"{place}: key {key!r} is missing")
    if not isinstance(mapping[key], kind):
        words = {str: "a text", int: "a whole number", dict: "an object", list: "a list"}
        raise LogError(f"{place}: {key!r} is {shown(mapping[key])}, {words[kind]} is required")
    return mapping[key]


def _channels(place: str, channels: dict[str, Any]) -> list[str]:
    for channel, unit in channels.items():
        if unit_of(channel) != unit:
            raise LogError(
                f"{place}: channel {channel!r} is declared in {shown(unit)}, its name states otherwise"
            )
    if not channels:
        raise LogError(f"{place}: has no channel")
    return list(channels)


def read_labels(place: str, entries: list[Any]) -> tuple[Label, ...]:
    """Return the terrain intervals that ``run.json`` lists; ``LogError`` where they are broken or overlap."""
    labels = []
    for entry in entries:
        terrain = _entry(f"{place}: labels", entry, "terrain", str)
        start_s, end_s = (_time(f"{place}: label {terrain!r}", entry, key) for key in ("start_s", "end_s"))
        if not start_s < end_s:
            raise LogError(f"{place}: label {terrain!r} ends at {end_s} s and starts at {start_s} s")
        labels.append(Label(start_s, end_s, terrain))
    in_time = sorted(labels)
    for one, other in pairwise(in_time):
        if other.start_s < one.end_s:
            raise LogError(
                f"{place}: labels {one.terrain!r} and {other.terrain!r} overlap at {other.start_s} s"
            )
    return tuple(labels)


def _time(place: str, entry: dict[str, Any], key: str) -> float:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise LogError(f"{place}: {key} is {shown(value)}, seconds are required")
    return float(value)


def _counts(place: str, counts: Any) -> Mapping[str, int]:
    if not isinstance(counts, dict) or not all(type(n) is int and n >= 0 for n in counts.values()):
        raise LogError(f"{place}: 'dropped' is {shown(counts)}, counts by kind are required")
    return counts
