"""Reading a store of features: the windows without their samples, and the feature matrix."""

from __future__ import annotations

import hashlib
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from features.windows import WindowCut, WindowRule
from pipelines.crossval.splits import Samples
from pipelines.feature_store.manifest import STORE_FILE, Manifest, StoredRun, read_manifest, read_runs
from pipelines.feature_store.run_file import read_run_windows
from pipelines.reporting.numbers import format_counts
from pipelines.reporting.progress import Progress, silent
from terrain.errors import DataError, LogError
from terrain.records import Array, Windows


class FeatureStore(NamedTuple):
    """A finished store: its folder, how its features were made, and its runs sorted by their id."""

    folder: Path
    manifest: Manifest
    runs: tuple[StoredRun, ...]

    @property
    def digest(self) -> str:
        """SHA-256 over ids and digests of the runs.

        It is not the digest of the same runs read whole, which would need all of them one after another.
        """
        lines = "".join(f"{run.run_id} {run.digest}\n" for run in self.runs)
        return hashlib.sha256(lines.encode()).hexdigest()

    @property
    def repaired(self) -> dict[str, int]:
        """What a repairing reader dropped, as counts by kind."""
        return dict(sum((Counter(run.repaired) for run in self.runs), Counter()))


class Stored(NamedTuple):
    """Labelled windows of a store without their samples, and their features ``(n, f)`` in 64 bits."""

    samples: Samples
    features: Array


def is_store(folder: Path) -> bool:
    """Return whether a folder is a store of features, finished or not."""
    return (folder / STORE_FILE).is_file()


def open_store(folder: Path, rule: WindowRule, signal_sets: tuple[str, ...]) -> FeatureStore:
    """Return a store whose windows were cut by a rule, of some signal sets.

    Raises
    ------
    LogError
        if there is none, or it is unfinished or damaged.
    ConfigError
        if another version made it, or with another rule or other signal sets.
    """
    manifest = read_manifest(folder)
    manifest.check(rule, signal_sets, folder)
    return FeatureStore(folder, manifest, read_runs(folder))


def read_store(store: FeatureStore, progress: Progress = silent) -> Stored:
    """Return the labelled windows of all runs, run by run and in order of time.

    Memory is that of the feature matrix and one run: 8 bytes a window and feature.

    Raises
    ------
    LogError
        if a file of it is missing, damaged or of another store.
    DataError
        if no window has a label.
    """
    manifest, n_runs = store.manifest, len(store.runs)
    n, width = sum(run.n_windows for run in store.runs), len(manifest.features)
    features = np.empty((n, width))
    start_s = np.empty(n)
    run_id, terrain = np.empty(n, dtype=object), np.empty(n, dtype=object)
    dropped: Counter[str] = Counter()
    end = 0
    for number, run in enumerate(store.runs):
        entry, rows = read_run_windows(store.folder, run.run_id, manifest.identity, width)
        if entry != run:
            raise LogError(
                f"{store.folder}: the file of run {run.run_id} is not that of {STORE_FILE}'s list: "
                "run terrain features again"
            )
        known = rows.terrain != ""
        here = slice(end, end + int(known.sum()))
        features[here], start_s[here] = rows.features[known], rows.start_s[known]
        run_id[here], terrain[here] = run.run_id, rows.terrain[known]
        dropped.update(run.dropped)
        if not known.all():
            dropped["no single label"] += int((~known).sum())
        end = here.stop
        progress("read features", number + 1, n_runs)
    if not n:
        raise DataError(f"not one window is left: {format_counts(dropped) or 'no run is long enough'}")
    if not end:
        raise DataError("no window has a terrain label: nothing can be trained or tested")
    windows = Windows({}, {}, {}, manifest.rule.length_s, start_s[:end], run_id[:end], terrain[:end])
    return Stored(
        Samples(WindowCut(windows, dict(dropped)), windows.run_id, manifest.rule.overlap), features[:end]
    )
