"""Convert logs of any readable layout into run folders, or into MCAP files, bags of ROS 2 and CSV files."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pipelines.data.settings import MAPPING_TEXT, ROBOT_TEXT, RunsSettings, load
from pipelines.report import (
    Progress,
    Report,
    Result,
    Section,
    Table,
    Text,
    described,
    format_counts,
    plural,
    silent,
)
from pipelines.report.settings import setting
from terrain.errors import LogError, TerrainError

if TYPE_CHECKING:
    from pipelines.data.plausibility import Doubt
    from pipelines.data.recorded_windows import RecordedWindow
    from terrain.logs.duplicates import SharedStretch
    from terrain.records import RunLog

EXAMPLE = "terrain convert logs/ --mapping mapping.yaml --out runs/"


class Settings(RunsSettings):
    """What is read, and what is written."""

    data: Path = setting(..., "Folder to read, or a file of MCAP or a bag.", option="FOLDER")
    robot: str | None = setting(None, ROBOT_TEXT)
    mapping: Path | None = setting(None, MAPPING_TEXT)
    out: Path = setting(..., "Folder of the new runs; what is there is left as it is.")
    to: Literal["runs", "mcap", "ros2", "ros2-mcap", "csv"] = setting(
        "runs",
        "What is written: runs, folders that all commands read; mcap, a file a run; ros2 or ros2-mcap, a bag a "
        "run in SQLite or MCAP; csv, a folder of tables a run.",
    )


@dataclass(frozen=True)
class ImportResult(Result):
    """Run folders that were written."""

    out: Path = described("folder that the runs were written to")
    n_runs: int = described("number of runs")
    run_ids: tuple[str, ...] = described("ids of the runs, sorted")
    labels: Mapping[str, int] = described("runs by terrain")
    dropped: Mapping[str, int] = described("what a repairing reader dropped, as counts by kind")
    skipped: tuple[str, ...] = described("a sentence for each run that could not be read")
    digest: str = described("SHA-256 of all runs")
    duplicates: tuple[SharedStretch, ...] = described("stretches that two of the runs share", default=())
    doubts: tuple[Doubt, ...] = described("checks that are doubtful or implausible", default=())


@dataclass(frozen=True)
class ExportResult(Result):
    """Files or bags for other programs that were written."""

    out: Path = described("folder that the runs were written to")
    n_runs: int = described("number of runs")
    files: Mapping[str, str] = described("name of each run's file or folder, by run")
    topics: Mapping[str, int] = described(
        "number of messages of each topic, or rows of each table, of all runs"
    )
    dropped: Mapping[str, int] = described("what a repairing reader dropped, as counts by kind")
    skipped: tuple[str, ...] = described("a sentence for each run that could not be read")
    digest: str = described("SHA-256 of all runs; messages that are converted back have the same")


def run(settings: Settings, progress: Progress = silent) -> ImportResult | ExportResult:
    """Read every run under a folder, then write each under ``settings.out``.

    All runs are read and checked, and all places found free, before the first one is written; nothing that
    is already in the folder is touched.  Windows that were recorded with a run go with it.  An implausible
    run becomes no run folder; with ``repair`` it is written as it is, and counts which checks it does not
    pass.

    Raises
    ------
    LogError
        if a run cannot be read or is implausible, or a place under ``out`` is taken.
    DataError
        if a run is longer than stamps can tell apart.
    ConfigError
        if a package is missing.
    TerrainError
        if ``out`` cannot be written.
    """
    from pipelines.data.run_writers import target_place

    runs, skipped = load(settings)
    places = {run.run_id: target_place(run.run_id, settings.out, settings.to) for run in runs}
    for place in places.values():
        if place.exists():
            raise LogError(f"{place}: is there already, and is left as it is; write into another folder")
    if settings.to == "runs":
        return _import(runs, skipped, settings, progress)
    return _export(runs, skipped, places, settings, progress)


def _import(
    runs: Sequence[RunLog], skipped: Sequence[str], settings: Settings, progress: Progress
) -> ImportResult:
    from pipelines.data.datasets import data_digest
    from pipelines.data.plausibility import counted, doubts_of, refuse_implausible_runs, verdict
    from pipelines.data.recorded_windows import WINDOWS_FILE, windows_text
    from pipelines.report.json_file import as_json
    from terrain.logs.duplicates import shared_stretches
    from terrain.logs.write import write_run
    from terrain.robots import load_robot

    given = None if settings.robot is None else load_robot(settings.robot)
    verdicts = {run.run_id: verdict(run, given) for run in runs}
    doubts = doubts_of(verdicts)
    if not settings.repair:
        refuse_implausible_runs(doubts)
    runs = [counted(run, verdicts[run.run_id]) for run in runs]
    windows = _recorded_windows(settings.data)
    dropped: Counter[str] = Counter()
    labels: Counter[str] = Counter()
    written: list[Path] = []
    try:
        for each in runs:
            of_run = windows.get(each.run_id, [])
            text = windows_text(as_json(window) for window in of_run)
            written.append(write_run(each, settings.out, beside={WINDOWS_FILE: text} if of_run else {}))
            dropped.update(each.dropped)
            labels.update(each.terrains)
            progress("write runs", len(written), len(runs))
    except BaseException:
        _remove(written)
        raise
    return ImportResult(
        out=settings.out,
        n_runs=len(runs),
        run_ids=tuple(each.run_id for each in runs),
        labels=dict(sorted(labels.items())),
        dropped=dict(sorted(dropped.items())),
        skipped=tuple(skipped),
        digest=data_digest(runs),
        duplicates=shared_stretches(runs),
        doubts=doubts,
    )


def _export(
    runs: Sequence[RunLog],
    skipped: Sequence[str],
    places: Mapping[str, Path],
    settings: Settings,
    progress: Progress,
) -> ExportResult:
    from pipelines.data.datasets import data_digest
    from pipelines.data.run_writers import csv_mapping, write_csv, write_messages
    from terrain.files.atomic import atomic_write

    windows = _recorded_windows(settings.data)
    dropped: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    written: list[Path] = []
    try:
        for each in runs:
            place = places[each.run_id]
            if settings.to == "csv":
                counts.update(write_csv(place, each))
            else:
                counts.update(write_messages(place, each, windows.get(each.run_id, []), settings.to))
            written.append(place)
            dropped.update(each.dropped)
            progress("write runs", len(written), len(runs))
        mapping = csv_mapping(runs) if settings.to == "csv" else None
        if mapping is not None and not (settings.out / "mapping.yaml").exists():
            atomic_write(settings.out / "mapping.yaml", mapping)
    except BaseException:
        _remove(written)
        raise
    return ExportResult(
        out=settings.out,
        n_runs=len(runs),
        files={run_id: place.name for run_id, place in places.items()},
        topics=dict(sorted(counts.items())),
        dropped=dict(sorted(dropped.items())),
        skipped=tuple(skipped),
        digest=data_digest(runs),
    )


def _remove(written: Sequence[Path]) -> None:
    for place in written:
        shutil.rmtree(place, ignore_errors=True) if place.is_dir() else place.unlink(missing_ok=True)


def _recorded_windows(place: Path) -> dict[str, list[RecordedWindow]]:
    """Return the windows that lie beside the streams of run folders, or in recordings, by run."""
    from pipelines.data.bag_files import find_bags
    from pipelines.data.bag_runs import recorded_windows
    from pipelines.data.recorded_windows import read_windows
    from terrain.logs.read import read_run_head, run_folders

    folders = run_folders(place) if place.is_dir() else []
    found = {read_run_head(folder).run_id: read_windows(folder) or [] for folder in folders}
    for bag in find_bags(place) if not folders else ():
        with suppress(TerrainError):  # a bag that was read, and is damaged, was refused by then
            recorded = recorded_windows(bag)
            found.update([recorded] if recorded is not None else [])
    return {run_id: windows for run_id, windows in found.items() if windows}


def report(result: ImportResult | ExportResult) -> Report:
    """Return how many runs were written where, what was left out, and what is odd about them."""
    counts = f", {format_counts(result.dropped)}" if result.dropped else ""
    notes = [Text(f"skipped: {sentence}", kind="warning") for sentence in result.skipped]
    if isinstance(result, ExportResult):
        n = sum(result.topics.values())
        return Report(
            title="Converted runs",
            answer=f"{plural(result.n_runs, 'run')}, {n} messages on {plural(len(result.topics), 'topic')}, "
            f"written to {result.out}{counts}",
            parts=tuple(notes),
            details=(Section("Messages", (Table(("topic", "messages"), tuple(result.topics.items())),)),),
            next_step=f"terrain convert {result.out} --out runs/",
        )
    from pipelines.data.duplicates import sentences
    from pipelines.data.plausibility import doubt_sentences

    notes += [Text(sentence, kind="warning") for sentence in doubt_sentences(result.doubts)]
    notes += [Text(sentence, kind="warning") for sentence in sentences(result.duplicates)]
    labels = tuple(result.labels.items())
    return Report(
        title="Converted runs",
        answer=f"{plural(result.n_runs, 'run')} written to {result.out}{counts}",
        parts=(*notes, *((Table(("terrain", "runs"), labels),) if labels else ())),
        next_step=f"terrain inspect {result.out}",
    )
