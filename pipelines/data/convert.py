"""Convert logs of any readable layout into run folders, or into MCAP files, bags of ROS 2 and CSV files."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.data.datasets import read
from pipelines.data.settings import MAPPING_TEXT, RunsSettings, Target
from pipelines.report.numbers import format_counts, plural
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import setting
from pipelines.report.tree import Report, Table, Text, sections
from terrain.errors import LogError, TerrainError

if TYPE_CHECKING:
    from terrain.logs.duplicates import SharedStretch
    from terrain.logs.plausibility import Doubt
    from terrain.logs.run_folders import RecordedWindow

EXAMPLE = "terrain convert logs/ --mapping mapping.yaml --out runs/"


class Settings(RunsSettings):
    """What is read, and what is written."""

    data: Path = setting(..., "Folder to read, or a file of MCAP or a bag.", option="FOLDER")
    mapping: Path | None = setting(None, MAPPING_TEXT)
    out: Path = setting(..., "Folder of the new runs; what is there is left as it is.")
    to: Target = setting("runs")
    """What is written: runs, folders that all commands read; mcap, a file a run; ros2 or ros2-mcap, a bag a run in
    SQLite or MCAP; csv, a folder of tables a run."""


class ConvertResult(Result):
    """Runs that were written."""

    out: Path = described("folder that the runs were written to")
    n_runs: int = described("number of runs")
    dropped: Mapping[str, int] = described("what a repairing reader dropped, as counts by kind")
    skipped: tuple[str, ...] = described("a sentence for each run that could not be read")
    digest: str = described("SHA-256 of all runs; messages that are converted back have the same")
    doubts: tuple[Doubt, ...] = described("checks that are doubtful or implausible")


class ImportResult(ConvertResult):
    """Run folders that were written."""

    run_ids: tuple[str, ...] = described("ids of the runs, sorted")
    labels: Mapping[str, int] = described("runs by terrain")
    duplicates: tuple[SharedStretch, ...] = described("stretches that two of the runs share", default=())


class ExportResult(ConvertResult):
    """Files or bags for other programs that were written."""

    files: Mapping[str, str] = described("name of each run's file or folder, by run")
    topics: Mapping[str, int] = described("messages of each topic, or rows of each table, of all runs")


def run(settings: Settings, progress: Progress = silent) -> ImportResult | ExportResult:
    """Read every run under a folder, then write each under ``settings.out``.

    All runs are read and checked, and all places found free, before the first one is written; nothing that
    is already in the folder is touched.  Windows that were recorded with a run go with it.
    """
    from pipelines.data.run_writers import target_place, write
    from terrain.files.atomic import atomic_write
    from terrain.logs.duplicates import shared_stretches
    from terrain.logs.mapping import csv_mapping
    from terrain.logs.run_folders import data_digest

    runs, skipped, doubts, _ = read(settings)
    places = {run.run_id: target_place(run.run_id, settings.out, settings.to) for run in runs}
    for place in places.values():
        if place.exists():
            raise LogError(f"{place}: is there already, and is left as it is; write into another folder")
    windows = _recorded_windows(settings.data)
    counts: Counter[str] = Counter()
    written: list[Path] = []
    try:
        for each in runs:
            counts.update(write(places[each.run_id], each, windows.get(each.run_id, []), settings.to))
            written.append(places[each.run_id])
            progress("write runs", len(written), len(runs))
        mapping = csv_mapping(runs) if settings.to == "csv" else None
        if mapping is not None and not (settings.out / "mapping.yaml").exists():
            atomic_write(settings.out / "mapping.yaml", mapping)
    except BaseException:
        for place in written:
            shutil.rmtree(place, ignore_errors=True) if place.is_dir() else place.unlink(missing_ok=True)
        raise
    dropped = sum((Counter(each.dropped) for each in runs), Counter[str]())
    found = settings.out, len(runs), dict(sorted(dropped.items())), tuple(skipped), data_digest(runs), doubts
    if settings.to != "runs":
        files = {run_id: place.name for run_id, place in places.items()}
        return ExportResult(*found, files, dict(sorted(counts.items())))
    labels = Counter(terrain for each in runs for terrain in each.terrains)
    return ImportResult(
        *found,
        tuple(each.run_id for each in runs),
        dict(sorted(labels.items())),
        shared_stretches(runs),
    )


def _recorded_windows(place: Path) -> dict[str, list[RecordedWindow]]:
    """Return the windows that lie beside the streams of run folders, or in recordings, by run."""
    from pipelines.data.bag_files import find_bags
    from pipelines.data.bag_runs import recorded_windows
    from terrain.logs.run_folders import read_run_head, read_windows, run_folders

    folders = run_folders(place) if place.is_dir() else []
    found = {read_run_head(folder).run_id: read_windows(folder) or [] for folder in folders}
    for bag in find_bags(place) if not folders else ():
        with suppress(TerrainError):  # a bag that was read, and is damaged, was refused by then
            recorded = recorded_windows(bag)
            found.update([recorded] if recorded is not None else [])
    return {run_id: windows for run_id, windows in found.items() if windows}


def report(result: ImportResult | ExportResult) -> Report:
    """Return how many runs were written where, what was left out, and what is odd about them."""
    from terrain.logs.duplicates import sentences
    from terrain.logs.plausibility import doubt_sentences

    runs = plural(result.n_runs, "run")
    counts = f", {format_counts(result.dropped)}" if result.dropped else ""
    warnings = [*result.skipped, *doubt_sentences(result.doubts)]
    if isinstance(result, ExportResult):
        runs += f", {sum(result.topics.values())} messages on {plural(len(result.topics), 'topic')},"
        table = Table(("topic", "messages"), tuple(result.topics.items()))
        parts, details = [], sections(("Messages", [table]))
        next_step = f"terrain convert {result.out} --out runs/"
    else:
        warnings += sentences(result.duplicates)
        parts = [Table(("terrain", "runs"), tuple(result.labels.items()))] if result.labels else []
        details, next_step = (), f"terrain inspect {result.out}"
    return Report(
        "Converted runs",
        f"{runs} written to {result.out}{counts}",
        parts=(*(Text(each, kind="warning") for each in warnings), *parts),
        details=details,
        next_step=next_step,
    )
