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
``estimator``, ``slip`` and ``state``.  Other files in the folder are passed over.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import LogError
from terrain.logs.csv_table import short_name
from terrain.logs.samples import checked_stream, refuse_apart
from terrain.logs.schema import SCHEMA_VERSION, unit_of
from terrain.records import Array, Label, RunLog


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
        that is not accepted there; if a Parquet file is missing, damaged or lacks a column; or if a stream
        is broken.
    """
    folder = Path(folder)
    head = _read_head(folder / "run.json")
    place = short_name(folder / "run.json")
    dropped = Counter(_counts(place, head.get("dropped", {})))
    streams = {}
    for name, entry in _entry(place, head, "streams", dict).items():
        file = _entry(f"{place}: stream {name}", entry, "file", str)
        if Path(file).name != file:
            raise LogError(f"{place}: stream {name}: {file!r} is not the name of a file in the run folder")
        channels = _channels(
            f"{place}: stream {name}", _entry(f"{place}: stream {name}", entry, "channels", dict)
        )
        time_s, values = _read_parquet(folder / file, channels)
        streams[name] = checked_stream(
            short_name(folder / file),
            time_s,
            values,
            channels,
            row_of=lambda index: index + 1,
            repairs=dropped if repair else None,
            unknown_is_a_value=name in ("slip", "truth", "control"),
        )
    if not streams:
        raise LogError(f"{place}: the run has no stream")
    run_id = _entry(place, head, "run_id", str)
    refuse_apart(run_id, streams)
    return RunLog(
        run_id,
        _entry(place, head, "robot", str),
        streams,
        _labels(place, _entry(place, head, "labels", list)),
        source=_entry(place, head, "source", str),
        dropped=dropped,
        session=_entry(place, {"session": ""} | head, "session", str),
        filter=_entry(place, {"filter": ""} | head, "filter", str),
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
        _entry(place, head, "run_id", str), _labels(place, _entry(place, head, "labels", list)), head
    )


def _read_head(path: Path) -> dict[str, Any]:
    place = short_name(path)
    try:
        head = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise LogError(f"{place}: is missing") from error
    except OSError as error:
        raise LogError(f"{place}: cannot be opened ({error.strerror})") from error
    except ValueError as error:
        raise LogError(f"{place}: is no JSON ({error})") from error
    version = _entry(place, head, "schema_version", int)
    if version != SCHEMA_VERSION:
        raise LogError(f"{place}: schema version {version} is unknown, this package reads {SCHEMA_VERSION}")
    return dict(head)


def _entry(place: str, mapping: Any, key: str, kind: type) -> Any:
    if not isinstance(mapping, dict):
        raise LogError(f"{place}: {mapping!r} is no JSON object")
    if key not in mapping:
        raise LogError(f"{place}: key {key!r} is missing")
    if not isinstance(mapping[key], kind):
        words = {str: "a text", int: "a whole number", dict: "an object", list: "a list"}
        raise LogError(f"{place}: {key!r} is {mapping[key]!r}, {words[kind]} is required")
    return mapping[key]


def _channels(place: str, channels: dict[str, Any]) -> list[str]:
    for channel, unit in channels.items():
        if unit_of(channel) != unit:
            raise LogError(f"{place}: channel {channel!r} is declared in {unit!r}, its name states otherwise")
    if not channels:
        raise LogError(f"{place}: has no channel")
    return list(channels)


def _labels(place: str, entries: list[Any]) -> tuple[Label, ...]:
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
        raise LogError(f"{place}: {key} is {value!r}, seconds are required")
    return float(value)


def _counts(place: str, counts: Any) -> Mapping[str, int]:
    if not isinstance(counts, dict) or not all(type(n) is int and n >= 0 for n in counts.values()):
        raise LogError(f"{place}: 'dropped' is {counts!r}, counts by kind are required")
    return counts


def _read_parquet(path: Path, channels: list[str]) -> tuple[Array, Array]:
    import pyarrow
    from pyarrow import parquet

    place = short_name(path)
    try:
        table = parquet.read_table(path, partitioning=None)
    except FileNotFoundError as error:
        raise LogError(f"{place}: is missing") from error
    except (pyarrow.ArrowException, OSError) as error:
        raise LogError(f"{place}: is no whole Parquet file ({' '.join(str(error).split())})") from error
    columns = []
    for name in ["time_s", *channels]:
        if table.column_names.count(name) != 1:
            raise LogError(
                f"{place}: column {name!r} is missing (the file has {', '.join(table.column_names)})"
            )
        column = table.column(name)
        if not (pyarrow.types.is_floating(column.type) or pyarrow.types.is_integer(column.type)):
            raise LogError(f"{place}: column {name!r} holds {column.type}, numbers are required")
        columns.append(column.cast("float64", safe=False).to_numpy())
    return columns[0], np.column_stack(columns[1:])
