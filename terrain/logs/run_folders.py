"""Run folders, the format in which this package keeps its logs: read, written, labelled, and a digest of their content.

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

Beside them lie the windows that were recorded with a run: what the model gave for each, in ``windows.json`` or in a
bag.  Class names can be any text, so they are no channels of a stream; readers of run folders pass the file over.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from terrain.errors import ConfigError, LogError
from terrain.files.atomic import atomic_folder, atomic_write
from terrain.files.documents import accepted, read_json
from terrain.files.names import MEBIBYTE, name_fault, plain_name, read_regular, shown
from terrain.logs.samples import (
    check_log_file,
    checked_names,
    checked_stream,
    refuse_apart,
    short_name,
    whole_run_label,
)
from terrain.logs.schema import TIME_TOLERANCE_S, unit_of
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


# -- Labels, and the windows that were recorded ---------------------------------------------------------------

SLACK_S = 0.01  #: An interval may be that far outside of a run: times are typed with two digits

WINDOWS_FILE = "windows.json"

MAX_BYTES = 64 * MEBIBYTE  #: Windows each second of a week with ten classes

Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
"""A number that is null in JSON where it is not finite."""


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
) -> dict[str, Any]:
    """Set a label of a run, or remove it by an empty terrain; return its folder, the interval and all labels, by name.

    All else in its ``run.json`` stays.

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
    return {"folder": folder, "start_s": start_s, "end_s": end_s, "labels": labels}


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
