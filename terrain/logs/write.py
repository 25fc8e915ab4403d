"""Writers of run folders (``terrain.logs.read`` documents the format) and of CSV files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from terrain.errors import LogError
from terrain.files.atomic import atomic_folder
from terrain.files.names import plain_name, shown
from terrain.logs.read import RunFile, RunHead, StreamFile
from terrain.logs.samples import checked_names
from terrain.logs.schema import SCHEMA_VERSION, unit_of
from terrain.records import RunLog, Stream

LABELS_FILE = "labels.csv"


def run_folder(run_id: str, folder: str | Path) -> Path:
    """Return where a run lies within a data-set folder; ``LogError`` where its id cannot name one."""
    if not plain_name(run_id):
        raise LogError(f"run id {shown(run_id)} cannot name a folder: use letters, digits and ' ._+-'")
    return Path(folder) / run_id


def write_run(
    run: RunLog,
    folder: str | Path,
    *,
    replace: bool = False,
    beside: Mapping[str, str] = MappingProxyType({}),
) -> Path:
    """Write one run as ``<folder>/<run_id>/``, whole or not at all, and return that folder.

    The same run gives the same bytes.  ``replace`` replaces a run folder of that name, which is refused otherwise;
    ``beside`` has the texts of further files, by name, which readers pass over.

    Raises
    ------
    LogError
        if the run is there already, or its id, a stream or a channel has a name that is not accepted.
    TerrainError
        if the place cannot be written; nothing is left behind.
    """
    target = run_folder(run.run_id, folder)
    checked_names(f"run {run.run_id}", run)
    if target.exists() and not (replace and (target / "run.json").is_file()):
        kind = "a run folder" if (target / "run.json").is_file() else "something else"
        raise LogError(f"{target}: {kind} is there already, and is left as it is")
    streams = {
        name: StreamFile(file=_file_name(name), channels={each: unit_of(each) for each in stream.channels})
        for name, stream in run.streams.items()
    }
    head = RunFile(**dict(RunHead.of(run)), schema_version=SCHEMA_VERSION, streams=streams)
    document = head.model_dump(exclude={name for name in ("session", "filter") if not getattr(run, name)})
    with atomic_folder(target) as unfinished:
        for name, stream in run.streams.items():
            _write_parquet(stream, unfinished / _file_name(name))
        for file, text in beside.items():
            (unfinished / file).write_text(text, encoding="utf-8")
        (unfinished / "run.json").write_text(
            json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8"
        )
    return target


def _file_name(stream: str) -> str:
    if not plain_name(stream):
        raise LogError(f"stream {shown(stream)} cannot name a file: use letters, digits and ' ._+-'")
    return f"{stream}.parquet"


def _write_parquet(stream: Stream, path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    columns = {"time_s": stream.time_s}
    columns |= {channel: stream.channel(channel) for channel in stream.channels}
    parquet.write_table(pyarrow.table(columns), path, compression="zstd")


def write_csv(place: Path, run: RunLog) -> dict[str, int]:
    """Write a run as a folder with a CSV file a stream, and its labels; return the number of rows of each.

    Numbers are written with as many digits as give them back.
    """
    import pandas as pd

    with atomic_folder(place) as folder:
        for name, stream in run.streams.items():
            table = pd.DataFrame(stream.values, columns=list(stream.channels))
            table.insert(0, "time_s", stream.time_s, allow_duplicates=True)
            table.to_csv(folder / f"{name}.csv", index=False, lineterminator="\n")
        if run.labels:
            labels = pd.DataFrame(run.labels, columns=["start_s", "end_s", "terrain"])
            labels.to_csv(folder / LABELS_FILE, index=False, lineterminator="\n")
    rows = {f"{name}.csv": len(stream) for name, stream in run.streams.items()}
    return rows | ({LABELS_FILE: len(run.labels)} if run.labels else {})
