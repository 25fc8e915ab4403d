"""Run folders, the format in which this package keeps its logs, their CSV form, and a digest that names their content.

One folder per run holds ``run.json``, which states what is in it (``docs/formats.md`` shows one), and one Parquet file
per stream with the columns ``time_s`` and those of its channels (64-bit floats; null and NaN: missing).

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

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from terrain.errors import LogError
from terrain.files.atomic import atomic_folder
from terrain.files.documents import accepted, read_json
from terrain.files.names import name_fault, plain_name, shown
from terrain.logs.samples import check_log_file, checked_names, checked_stream, refuse_apart, short_name
from terrain.logs.schema import unit_of
from terrain.logs.tables import read_parquet
from terrain.records import Label, RunLog, Stream

SCHEMA_VERSION = 1
MAX_STREAMS = 64  #: Streams of a run; each is held in memory, and several may name one file
LABELS_FILE = "labels.csv"

MAY_BE_UNKNOWN = ("slip", "truth", "control", "testbed")
"""Streams of which a channel may hold nothing but NaN."""


class Strict(BaseModel):
    """Part of a file: a text is no number."""

    model_config = ConfigDict(strict=True)


class LabelEntry(Strict):
    """A terrain interval as files state it."""

    start_s: float
    end_s: float
    terrain: str


class RunHead(Strict):
    """What a run states of itself beside its streams, in a run folder and in a file of messages."""

    run_id: str
    robot: str
    session: str = ""
    filter: str = ""
    source: str
    labels: list[LabelEntry]
    dropped: dict[str, Annotated[int, Field(ge=0)]] = {}

    @classmethod
    def of(cls, run: RunLog) -> RunHead:
        """Return what a run states of itself."""
        plain = {name: getattr(run, name) for name in ("run_id", "robot", "session", "filter", "source")}
        labels = [LabelEntry(**label._asdict()) for label in run.labels]
        return cls(**plain, labels=labels, dropped=dict(sorted(run.dropped.items())))

    def checked_labels(self, place: str) -> tuple[Label, ...]:
        """Return the terrain intervals; ``LogError`` where one ends before it starts, or two overlap."""
        labels = [Label(entry.start_s, entry.end_s, entry.terrain) for entry in self.labels]
        for start_s, end_s, terrain in labels:
            if not start_s < end_s:
                raise LogError(f"{place}: label {terrain!r} ends at {end_s} s and starts at {start_s} s")
        for one, other in pairwise(sorted(labels)):
            if other.start_s < one.end_s:
                names = f"{one.terrain!r} and {other.terrain!r}"
                raise LogError(f"{place}: labels {names} overlap at {other.start_s} s")
        return tuple(labels)

    def run(self, place: str, streams: Mapping[str, Stream], dropped: Mapping[str, int]) -> RunLog:
        """Return the run of its streams; names that are no plain ones and streams apart are refused."""
        refuse_apart(self.run_id, streams)
        about = (self.checked_labels(place), self.source, dropped, self.session, self.filter)
        return checked_names(place, RunLog(self.run_id, self.robot, streams, *about))


class StreamFile(Strict):
    """File of a stream, and the unit of each of its channels."""

    file: str
    channels: Annotated[dict[str, str], Field(min_length=1)]


class RunFile(RunHead):
    """What ``run.json`` states."""

    schema_version: int
    streams: dict[str, StreamFile]


def find_runs(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per run folder of :func:`run_folders`; call it with ``repair=``."""
    return [partial(read_run, path) for path in run_folders(folder)]


def run_folders(folder: Path) -> list[Path]:
    """Return the run folders: ``folder`` itself, or those in it, sorted; hidden ones are unfinished writes."""
    if (folder / "run.json").exists():
        return [folder]
    return sorted(path.parent for path in folder.glob("*/run.json") if not path.parent.name.startswith("."))


def read_run_head(folder: str | Path) -> RunFile:
    """Return what ``run.json`` states, without reading the streams.

    ``LogError`` where it is missing, is not JSON, has another schema version, lacks a key or holds something that is
    not accepted there.
    """
    path = Path(folder) / "run.json"
    place = short_name(path)
    document = read_json(check_log_file(path, path.parent), place, LogError)
    version = document.get("schema_version", SCHEMA_VERSION) if isinstance(document, dict) else SCHEMA_VERSION
    if version != SCHEMA_VERSION:
        known = f"this package reads {SCHEMA_VERSION}"
        raise LogError(f"{place}: schema version {shown(version)} is unknown, {known}")
    return accepted(RunFile, document, place, LogError)


def read_run(folder: str | Path, *, repair: bool = False) -> RunLog:
    """Return the run of a folder with ``run.json``; a repairing read drops and counts what is wrong with streams.

    Raises
    ------
    LogError
        as :func:`read_run_head`; if a name in ``run.json`` is no plain one; if a Parquet file is missing,
        damaged, too large or lacks a column; if a file is a link that leads out of the folder; or if a
        stream is broken.
    """
    folder = Path(folder)
    head, place = read_run_head(folder), short_name(folder / "run.json")
    if len(head.streams) > MAX_STREAMS:
        raise LogError(f"{place}: the run has {len(head.streams)} streams, at most {MAX_STREAMS} are read")
    if not head.streams:
        raise LogError(f"{place}: the run has no stream")
    dropped = Counter(head.dropped)
    streams = {}
    for name, entry in head.streams.items():
        at = f"{place}: stream {name}:"
        if (fault := name_fault(entry.file)) is not None:
            of_file = "is not the name of a file in the run folder"
            raise LogError(f"{at} {shown(entry.file)} {of_file}: it {fault}")
        for channel, unit in entry.channels.items():
            if unit_of(channel) != unit:
                stated = f"declared in {shown(unit)}, its name states otherwise"
                raise LogError(f"{at} channel {channel!r} is {stated}")
        file = check_log_file(folder / entry.file, folder)
        time_s, *values = read_parquet(file, ["time_s", *entry.channels])
        streams[name] = checked_stream(
            short_name(file),
            time_s,
            np.column_stack(values),
            list(entry.channels),
            repairs=dropped if repair else None,
            unknown_is_a_value=name in MAY_BE_UNKNOWN,
        )
    return head.run(place, streams, dropped)


def run_folder(run_id: str, folder: str | Path) -> Path:
    """Return where a run lies within a data-set folder; ``LogError`` where its id cannot name one."""
    return Path(folder) / _file_name("run id", run_id, "folder")


def _file_name(what: str, name: str, kind: str) -> str:
    if not plain_name(name):
        raise LogError(f"{what} {shown(name)} cannot name a {kind}: use letters, digits and ' ._+-'")
    return name


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
    import pyarrow
    from pyarrow import parquet

    target = run_folder(run.run_id, folder)
    checked_names(f"run {run.run_id}", run)
    is_run = (target / "run.json").is_file()
    if target.exists() and not (replace and is_run):
        kind = "a run folder" if is_run else "something else"
        raise LogError(f"{target}: {kind} is there already, and is left as it is")
    streams = {
        name: StreamFile(
            file=f"{_file_name('stream', name, 'file')}.parquet",
            channels={channel: unit_of(channel) for channel in stream.channels},
        )
        for name, stream in run.streams.items()
    }
    head = RunFile(**dict(RunHead.of(run)), schema_version=SCHEMA_VERSION, streams=streams)
    document = head.model_dump(exclude={name for name in ("session", "filter") if not getattr(run, name)})
    texts = dict(beside) | {"run.json": json.dumps(document, indent=2, allow_nan=False) + "\n"}
    with atomic_folder(target) as unfinished:
        for name, stream in run.streams.items():
            columns = {"time_s": stream.time_s}
            columns |= {channel: stream.channel(channel) for channel in stream.channels}
            parquet.write_table(pyarrow.table(columns), unfinished / streams[name].file, compression="zstd")
        for file, text in texts.items():
            (unfinished / file).write_text(text, encoding="utf-8")
    return target


def data_digest(runs: Sequence[RunLog]) -> str:
    """Return a SHA-256 over the content of the runs, in hexadecimal, wherever and however they lie.

    It covers ids, robots, sessions, labels, channels, times and values, and neither order nor source nor
    layout on disk: a data set read from CSV and from the run folders it was imported into has one digest.
    """
    digest = hashlib.sha256()
    for run in sorted(runs, key=lambda run: run.run_id):
        orders = {name: np.argsort(stream.channels) for name, stream in sorted(run.streams.items())}
        head = {
            "run_id": run.run_id,
            "robot": run.robot,
            "labels": [list(label) for label in run.labels],
            **({"session": run.session} if run.session else {}),
            "streams": {
                name: [len(run.streams[name]), [run.streams[name].channels[i] for i in order]]
                for name, order in orders.items()
            },
        }
        digest.update(json.dumps(head, sort_keys=True).encode())
        for name, order in orders.items():
            for array in (run.streams[name].time_s, run.streams[name].values[:, order]):
                one_form = np.where(np.isnan(array), np.nan, array) + 0.0  # of NaN, and of zero
                digest.update(one_form.astype("<f8").tobytes())
    return digest.hexdigest()


def joint_digest(digests: Sequence[str]) -> str:
    """Return a SHA-256 over the digests of runs, whatever their order."""
    return hashlib.sha256("".join(f"{digest}\n" for digest in sorted(digests)).encode()).hexdigest()


def write_csv(place: Path, run: RunLog) -> dict[str, int]:
    """Write a run as a folder with a CSV file a stream, and its labels; return the number of rows of each.

    Numbers are written with as many digits as give them back.
    """
    import pandas as pd

    tables = {}
    for name, stream in run.streams.items():
        tables[f"{name}.csv"] = pd.DataFrame(stream.values, columns=list(stream.channels))
        tables[f"{name}.csv"].insert(0, "time_s", stream.time_s, allow_duplicates=True)
    if run.labels:
        tables[LABELS_FILE] = pd.DataFrame(run.labels, columns=["start_s", "end_s", "terrain"])
    with atomic_folder(place) as folder:
        for file, table in tables.items():
            table.to_csv(folder / file, index=False, lineterminator="\n")
    return {file: len(table) for file, table in tables.items()}
