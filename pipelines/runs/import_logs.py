"""``terrain import``: any readable layout into run folders."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipelines.runs.datasets import data_digest, load_runs
from terrain.errors import LogError
from terrain.logs.write import run_folder, write_run


def import_logs(
    folder: str | Path,
    out: str | Path,
    *,
    layout: str = "auto",
    mapping: str | Path | None = None,
    repair: bool = False,
    progress: Callable[[str], None] = lambda run_id: None,
) -> dict[str, Any]:
    """Read every run under a folder, then write each as a run folder under ``out``.

    All runs are read and judged, and all places found free, before the first one is written.

    Parameters
    ----------
    folder, layout, mapping, repair : as in :func:`pipelines.runs.datasets.load_runs`
    out : folder of the new data set; made when missing, and nothing that lies in it is touched
    progress : told the id of each run that has been written

    Returns
    -------
    dict that JSON can hold: ``out``, ``n_runs``, ``run_ids``, ``labels`` (runs by terrain), ``dropped``
    (counts by kind), ``skipped`` (a sentence for each run that could not be read) and ``digest``

    Raises
    ------
    LogError
        if a run cannot be read, or a place under ``out`` is taken.
    TerrainError
        if ``out`` cannot be written.
    """
    skipped: list[str] = []
    runs = load_runs(folder, layout=layout, mapping=mapping, repair=repair, on_skip=skipped.append)
    for run in runs:
        target = run_folder(run.run_id, out)
        if target.exists():
            raise LogError(f"{target}: is there already, and is left as it is; import into another folder")
    dropped: Counter[str] = Counter()
    labels: Counter[str] = Counter()
    written: list[Path] = []
    try:
        for run in runs:
            written.append(write_run(run, out))
            dropped.update(run.dropped)
            labels.update(run.terrains)
            progress(run.run_id)
    except BaseException:
        for target in written:
            shutil.rmtree(target, ignore_errors=True)
        raise
    return {
        "out": str(out),
        "n_runs": len(runs),
        "run_ids": [run.run_id for run in runs],
        "labels": dict(sorted(labels.items())),
        "dropped": dict(sorted(dropped.items())),
        "skipped": skipped,
        "digest": data_digest(runs),
    }
