"""Reader of run folders, the format in which this package keeps its logs.

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

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from terrain.errors import LogError
from terrain.files.documents import accepted, read_json
from terrain.files.names import name_fault, shown
from terrain.logs.samples import check_log_file, checked_names, checked_stream, refuse_apart, short_name
from terrain.logs.schema import SCHEMA_VERSION, unit_of
from terrain.logs.tables import read_parquet
from terrain.records import Label, RunLog, Stream

MAX_STREAMS = 64  #: Streams of a run; each is held in memory, and several may name one file

MAY_BE_UNKNOWN = ("slip", "truth", "control", "testbed")
"""Streams of which a channel may hold nothing but NaN."""


def find_runs(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per run folder of :func:`run_folders`; call it with ``repair=``."""
    return [partial(read_run, path) for path in run_folders(folder)]


def run_folders(folder: Path) -> list[Path]:
    """Return the run folders: ``folder`` itself, or those in it, sorted; hidden ones are unfinished writes."""
    if (folder / "run.json").exists():
        return [folder]
    return sorted(path.parent for path in folder.glob("*/run.json") if not path.parent.name.startswith("."))


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
                raise LogError(
                    f"{place}: labels {one.terrain!r} and {other.terrain!r} overlap at {other.start_s} s"
                )
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


def read_run_head(folder: str | Path) -> RunFile:
    """Return what ``run.json`` states, without reading the streams.

    ``LogError`` where it is missing, is not JSON, has another schema version, lacks a key or holds something that is
    not accepted there.
    """
    path = Path(folder) / "run.json"
    place = short_name(path)
    described = read_json(check_log_file(path, path.parent), place, LogError)
    version = (
        described.get("schema_version", SCHEMA_VERSION) if isinstance(described, dict) else SCHEMA_VERSION
    )
    if version != SCHEMA_VERSION:
        raise LogError(
            f"{place}: schema version {shown(version)} is unknown, this package reads {SCHEMA_VERSION}"
        )
    return accepted(RunFile, described, place, LogError)


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
        if (fault := name_fault(entry.file)) is not None:
            raise LogError(
                f"{place}: stream {name}: {shown(entry.file)} is not the name of a file in the run folder: "
                f"it {fault}"
            )
        for channel, unit in entry.channels.items():
            if unit_of(channel) != unit:
                raise LogError(
                    f"{place}: stream {name}: channel {channel!r} is declared in {shown(unit)}, "
                    "its name states otherwise"
                )
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
