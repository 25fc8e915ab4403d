"""Reading a store of features: windows without their samples, their features and how the robot moved."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from features.motion import Motion, wheel_stream
from features.windows import WindowCut, WindowRule
from pipelines.crossval.splits import Samples
from pipelines.data.datasets import joint_digest
from pipelines.data.duplicates import sentences
from pipelines.data.settings import AlignedRunsSettings, chosen_runs
from pipelines.feature_store.manifest import STORE_FILE, Manifest, StoredRun, read_manifest, read_runs
from pipelines.feature_store.run_file import read_run_windows
from pipelines.report.settings import option_name
from pipelines.reporting.numbers import format_counts
from pipelines.reporting.progress import Progress, silent
from terrain.errors import ConfigError, DataError, LogError
from terrain.logs.duplicates import SharedStretch
from terrain.records import Array, Windows


class FeatureStore(NamedTuple):
    """A finished store.

    Parameters
    ----------
    folder, manifest : where it lies, and how its features were made
    runs : that are used, sorted by their id
    shared : stretches that two of them have in common
    """

    folder: Path
    manifest: Manifest
    runs: tuple[StoredRun, ...]
    shared: tuple[SharedStretch, ...] = ()

    @property
    def digest(self) -> str:
        """SHA-256 over the digests of the runs.

        It is not the digest of the same runs read whole, which would need all of them one after another.
        """
        return joint_digest([run.digest for run in self.runs])

    def of(self, runs: Sequence[StoredRun]) -> FeatureStore:
        """Return the store with some of its runs only."""
        kept = {run.run_id for run in runs}
        shared = tuple(each for each in self.shared if {each.first, each.second} <= kept)
        return self._replace(runs=tuple(runs), shared=shared)

    @property
    def repaired(self) -> dict[str, int]:
        """What a repairing reader dropped, as counts by kind."""
        return dict(sum((Counter(run.repaired) for run in self.runs), Counter()))


class Stored(NamedTuple):
    """Labelled windows of a store.

    Parameters
    ----------
    samples : windows without their samples
    features : (n, f) in 64 bits
    motion : how the robot moved in each window; None where no wheel speed was measured
    """

    samples: Samples
    features: Array
    motion: Motion | None


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
    return FeatureStore(folder, manifest, *read_runs(folder))


def store_of(source: AlignedRunsSettings, rule: WindowRule, signal_sets: tuple[str, ...]) -> FeatureStore:
    """Return the store that a command works on, with the runs that it asks for.

    Raises
    ------
    ConfigError
        if an option states how runs are read, or as :func:`pipelines.data.settings.chosen_runs`.
    LogError, ConfigError
        as :func:`open_store`.
    """
    for name in ("layout", "mapping", "repair", "align", "robot"):
        if getattr(source, name) != AlignedRunsSettings.model_fields[name].default:
            option = option_name(AlignedRunsSettings, name)
            raise ConfigError(
                f"{option}: {source.data} is a store of features, whose runs were read when it was made; "
                f"give {option} to terrain features"
            )
    store = open_store(source.data, rule, signal_sets)
    return store.of(chosen_runs(store.runs, source))


def read_store(store: FeatureStore, progress: Progress = silent) -> Stored:
    """Return the labelled windows of all runs, run by run and in order of time.

    Memory is that of the feature matrix and one run: 8 bytes a window and feature.

    Raises
    ------
    LogError
        if a file of it is missing, damaged or of another store.
    DataError
        if two runs hold the same measurements, no window has a label, or no feature ever varies.
    """
    if store.shared:
        raise DataError(
            f"{'; '.join(sentences(store.shared))}: held out, they would be recognised and not classified; "
            "leave one of them out by --without, or merge them from the runs by --merge-duplicates"
        )
    manifest, n_runs = store.manifest, len(store.runs)
    n, width = sum(run.n_windows for run in store.runs), len(manifest.features)
    features = np.empty((n, width))
    start_s, motion = np.empty(n), np.empty((len(Motion._fields), n))
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
        motion[:, here] = np.stack(rows.motion)[:, known]
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
    if np.array_equal(features[:end], np.broadcast_to(features[:1], (end, width)), equal_nan=True):
        raise DataError(f"{store.folder}: no feature ever varies: nothing can be learned from them")
    windows = Windows({}, {}, {}, manifest.rule.length_s, start_s[:end], run_id[:end], terrain[:end])
    moved = None if wheel_stream(manifest.layout.channels) is None else Motion(*motion[:, :end])
    samples = Samples(WindowCut(windows, dict(dropped)), windows.run_id, manifest.rule.overlap)
    return Stored(samples, features[:end], moved)
