"""``terrain export``: runs of any readable layout as MCAP files or ROS 2 bags, one a run."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from pathlib import Path

import numpy as np

from pipelines.bags.exported import WINDOW_TOPIC
from pipelines.data.datasets import data_digest
from pipelines.data.recorded_windows import RecordedWindow, read_windows
from pipelines.data.settings import InspectSettings, load
from pipelines.export.outgoing import Outgoing, outgoing_topics, text_topic
from pipelines.export.results import Exported
from pipelines.export.settings import ExportSettings, Target
from pipelines.export.write import write_mcap, write_ros2
from pipelines.reporting.json_file import as_json
from pipelines.reporting.progress import Progress, silent
from terrain.errors import LogError
from terrain.files.atomic import atomic_file, atomic_folder
from terrain.logs.read import read_run_head, run_folders
from terrain.logs.write import run_folder
from terrain.records import RunLog


def export_runs(source: InspectSettings, settings: ExportSettings, progress: Progress = silent) -> Exported:
    """Read every run under a folder, then write each under ``settings.out``.

    All runs are read, and all places found free, before the first one is written; nothing that is already in
    the folder is touched.  Windows that were recorded with a run are a topic beside its streams.

    Raises
    ------
    LogError
        if a run cannot be read, or a place under ``out`` is taken.
    DataError
        if a run is longer than stamps can tell apart.
    TerrainError
        if ``out`` cannot be written.
    """
    runs, skipped = load(source)
    targets = {run.run_id: _place(run.run_id, settings) for run in runs}
    for target in targets.values():
        if target.exists():
            raise LogError(f"{target}: is there already, and is left as it is; export into another folder")
    windows = _recorded_windows(source.data)
    dropped: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    written: list[Path] = []
    try:
        for run in runs:
            topics = [*outgoing_topics(run), *_window_topic(run, windows.get(run.run_id, []))]
            _write(targets[run.run_id], run, topics, settings.target)
            written.append(targets[run.run_id])
            dropped.update(run.dropped)
            for topic in topics:  # several streams may share one
                counts[topic.topic] += len(topic.messages)
            progress("write runs", len(written), len(runs))
    except BaseException:
        for target in written:
            shutil.rmtree(target) if target.is_dir() else target.unlink()
        raise
    return Exported(
        out=settings.out,
        n_runs=len(runs),
        files={run_id: target.name for run_id, target in targets.items()},
        topics=dict(sorted(counts.items())),
        dropped=dict(sorted(dropped.items())),
        skipped=tuple(skipped),
        digest=data_digest(runs),
    )


def _place(run_id: str, settings: ExportSettings) -> Path:
    folder = run_folder(run_id, settings.out)
    return folder.with_name(f"{folder.name}.mcap") if settings.target == "mcap" else folder


def _write(target: Path, run: RunLog, topics: list[Outgoing], kind: Target) -> None:
    if kind == "mcap":
        head = {"run_id": run.run_id, "robot": run.robot, "session": run.session, "filter": run.filter}
        with atomic_file(target) as file:
            write_mcap(file, topics, head)
        return
    with atomic_folder(target) as unfinished:
        # a bag's files bear the name of its folder
        write_ros2(unfinished / target.name, topics, "sqlite3" if kind == "ros2" else "mcap")
        for path in (unfinished / target.name).iterdir():
            path.rename(unfinished / path.name)
        (unfinished / target.name).rmdir()


def _recorded_windows(folder: Path) -> dict[str, list[RecordedWindow]]:
    """Return the windows that lie beside the streams of run folders, by run."""
    places = run_folders(folder) if folder.is_dir() else []
    found = {place: read_windows(place) for place in places}
    return {read_run_head(place).run_id: windows for place, windows in found.items() if windows}


def _window_topic(run: RunLog, windows: list[RecordedWindow]) -> list[Outgoing]:
    """Return the topic of recorded windows: each as JSON, at its end."""
    if not windows:
        return []
    texts = [json.dumps(as_json(window)) for window in windows]
    return [text_topic(WINDOW_TOPIC, np.array([window.end_s for window in windows]), texts, run)]
