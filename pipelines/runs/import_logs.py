"""``terrain import``: any readable layout into run folders."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

from pipelines.data.datasets import data_digest
from pipelines.data.plausibility import counted, doubts_of, refuse_implausible_runs, verdict
from pipelines.data.settings import ImportSettings, load
from pipelines.reporting.progress import Progress, silent
from pipelines.runs.results import Imported
from terrain.errors import LogError
from terrain.logs.duplicates import shared_stretches
from terrain.logs.write import run_folder, write_run
from terrain.robots import load_robot


def import_logs(settings: ImportSettings, progress: Progress = silent) -> Imported:
    """Read every run under a folder, then write each as a run folder under ``settings.out``.

    All runs are read and checked, and all places found free, before the first one is written; nothing that
    is already in the folder is touched.  With ``repair``, an implausible run is written as it is, and counts
    which checks it does not pass.

    Raises
    ------
    LogError
        if a run cannot be read or is implausible, or a place under ``out`` is taken.
    TerrainError
        if ``out`` cannot be written.
    """
    runs, skipped = load(settings)
    for run in runs:
        target = run_folder(run.run_id, settings.out)
        if target.exists():
            raise LogError(f"{target}: is there already, and is left as it is; import into another folder")
    given = None if settings.robot is None else load_robot(settings.robot)
    verdicts = {run.run_id: verdict(run, given) for run in runs}
    doubts = doubts_of(verdicts)
    if not settings.repair:
        refuse_implausible_runs(doubts)
    runs = [counted(run, verdicts[run.run_id]) for run in runs]
    dropped: Counter[str] = Counter()
    labels: Counter[str] = Counter()
    written: list[Path] = []
    try:
        for run in runs:
            written.append(write_run(run, settings.out))
            dropped.update(run.dropped)
            labels.update(run.terrains)
            progress("write runs", len(written), len(runs))
    except BaseException:
        for target in written:
            shutil.rmtree(target, ignore_errors=True)
        raise
    return Imported(
        out=settings.out,
        n_runs=len(runs),
        run_ids=tuple(run.run_id for run in runs),
        labels=dict(sorted(labels.items())),
        dropped=dict(sorted(dropped.items())),
        skipped=tuple(skipped),
        digest=data_digest(runs),
        duplicates=shared_stretches(runs),
        doubts=doubts,
    )
