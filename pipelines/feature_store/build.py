"""``terrain features``: windows and their features of one run after another, each written when it is done.

Two passes, so that memory is bounded by a run: the first finds channels and rates that all runs have in
common, the second cuts, computes and writes.  A run whose file is there and agrees is not computed again.
Fingerprints of each run, kept in files meanwhile, show which pairs of runs may hold the same measurements;
these are read again and compared.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from features.extractor import FeatureExtractor
from features.motion import Motion, window_motion
from features.windows import cut_windows, layout_of
from pipelines.data.datasets import RunLoader, data_digest
from pipelines.feature_store.heads import Head, head_of
from pipelines.feature_store.manifest import (
    RUNS_FILE,
    STORE_FILE,
    WINDOWS_FOLDER,
    Manifest,
    StoredRun,
)
from pipelines.feature_store.print_files import PrintFiles
from pipelines.feature_store.results import StoreReport
from pipelines.feature_store.run_file import RunWindows, file_of, read_run_windows, write_run_windows
from pipelines.feature_store.settings import FeaturesSettings
from pipelines.learn.parallel import parallel
from pipelines.reporting.progress import Progress, silent
from terrain.errors import ConfigError, LogError
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.logs.duplicates import SharedStretch, shared_stretches
from terrain.logs.fingerprints import RunPrint, run_print
from terrain.records import Windows

PRINTS_FOLDER = "prints"


class _Plan(NamedTuple):
    """What every run is given."""

    manifest: Manifest
    extractor: FeatureExtractor
    identity: str
    store: Path


class _Made(NamedTuple):
    run: StoredRun
    computed: bool
    print: RunPrint


def build_store(
    loaders: Sequence[RunLoader], settings: FeaturesSettings, progress: Progress = silent
) -> StoreReport:
    """Write the features of runs, one file a run, and the list of them.

    Parameters
    ----------
    loaders : one a run, as :func:`pipelines.data.datasets.run_loaders`
    settings : how windows are cut, and the folder of the store
    progress : called as runs are done

    Raises
    ------
    LogError
        if a run cannot be read, or two runs have one id.
    DataError
        if the runs have no channels or rates in common, or one is shorter than a window.
    ConfigError
        if the folder holds something else.
    """
    store = settings.out.resolve()
    if store.exists() and not (store / STORE_FILE).is_file() and (not store.is_dir() or any(store.iterdir())):
        raise ConfigError(f"{store}: holds something else than a store of features; choose another --out")
    ensure_writable(store)
    heads = _heads(loaders, settings.jobs, progress)
    kept = [load for load, head in zip(loaders, heads, strict=True) if head.fault is None]
    manifest, extractor = _manifest([head for head in heads if head.fault is None], settings)
    skipped = tuple(f"run skipped: {head.fault}" for head in heads if head.fault is not None)
    del heads
    (store / RUNS_FILE).unlink(missing_ok=True)
    (store / WINDOWS_FOLDER).mkdir(parents=True, exist_ok=True)
    _write_json(store / STORE_FILE, manifest.as_json())
    plan = _Plan(manifest, extractor, manifest.identity, store)
    runs: list[StoredRun] = []
    n_computed = 0
    progress("features", 0, len(kept))
    with PrintFiles(store / PRINTS_FOLDER) as prints:
        for one in parallel(_store_run, (plan,), ((load,) for load in kept), settings.jobs):
            runs.append(one.run)
            prints.add(one.print)
            n_computed += one.computed
            progress("features", len(runs), len(kept))
        pairs = prints.possible_pairs()
    runs.sort()
    shared = _shared([(kept[first], kept[second]) for first, second in pairs], settings.jobs, progress)
    _remove_others(store, runs)
    lists = {"runs": [run._asdict() for run in runs], "shared": [each._asdict() for each in shared]}
    _write_json(store / RUNS_FILE, lists)
    return StoreReport(
        out=settings.out,
        n_runs=len(runs),
        n_computed=n_computed,
        n_windows=sum(run.n_windows for run in runs),
        n_features=len(manifest.features),
        dropped=dict(sum((Counter(run.dropped) for run in runs), Counter())),
        repaired=dict(sum((Counter(run.repaired) for run in runs), Counter())),
        skipped=skipped,
        duplicates=shared,
    )


def _heads(loaders: Sequence[RunLoader], n_jobs: int, progress: Progress) -> list[Head]:
    heads: list[Head] = []
    progress("channels", 0, len(loaders))
    for head in parallel(head_of, (), ((load,) for load in loaders), n_jobs):
        heads.append(head)
        progress("channels", len(heads), len(loaders))
    found = Counter(head.run_id for head in heads if head.fault is None)
    if not found:
        raise LogError(f"not one run could be read, the first for this: {heads[0].fault}")
    run_id, n = found.most_common(1)[0]
    if n > 1:
        raise LogError(f"{n} runs have the id {run_id!r}")
    return heads


def _manifest(heads: Sequence[Head], settings: FeaturesSettings) -> tuple[Manifest, FeatureExtractor]:
    rule = settings.rule
    in_order = sorted(heads, key=lambda head: head.run_id)
    layout = layout_of(
        [head.sketch() for head in in_order], settings.signal_sets, speeds=rule.steady is not None
    )
    extractor = FeatureExtractor(settings.signal_sets).fit(cut_windows([], rule, layout=layout).windows)
    names = tuple(str(name) for name in extractor.get_feature_names_out())
    return Manifest(rule, settings.signal_sets, layout, names), extractor


def _store_run(plan: _Plan, load: RunLoader) -> _Made:
    run = load()
    digest, prints = data_digest([run]), run_print(run)
    try:
        found, _ = read_run_windows(plan.store, run.run_id, plan.identity, len(plan.manifest.features))
        if found.digest == digest:
            return _Made(found, False, prints)
    except LogError:
        pass  # missing, damaged or of other features: it is made again
    cut = cut_windows([run], plan.manifest.rule, layout=plan.manifest.layout, skip_short=load.repair)
    windows = cut.windows
    entry = StoredRun(
        run.run_id, run.robot, run.filter, digest, len(windows), dict(cut.dropped), dict(run.dropped)
    )
    rows = RunWindows(
        windows.start_s, windows.terrain, plan.extractor.transform(windows), _motion_columns(windows)
    )
    write_run_windows(plan.store, entry, plan.identity, rows)
    return _Made(entry, True, prints)


def _motion_columns(windows: Windows) -> Motion:
    """Return the motion of the windows, NaN where it is not known."""
    motion = window_motion(windows)
    return Motion(*np.full((len(Motion._fields), len(windows)), np.nan)) if motion is None else motion


def _shared(
    pairs: Sequence[tuple[RunLoader, RunLoader]], n_jobs: int, progress: Progress
) -> tuple[SharedStretch, ...]:
    """Return the stretches that the two runs of each pair share, in the order of their ids."""
    found: list[SharedStretch] = []
    for done, stretches in enumerate(parallel(_compared, (), pairs, n_jobs)):
        found += stretches
        progress("compare runs", done + 1, len(pairs))
    return tuple(sorted(found))


def _compared(first: RunLoader, second: RunLoader) -> tuple[SharedStretch, ...]:
    return shared_stretches(sorted((first(), second()), key=lambda run: run.run_id))


def _remove_others(store: Path, runs: Sequence[StoredRun]) -> None:
    """Remove the files of runs that are not there any more, and nothing else."""
    kept = {file_of(store, run.run_id).name for run in runs}
    for path in (store / WINDOWS_FOLDER).glob("*.parquet"):
        if path.name not in kept:
            path.unlink()


def _write_json(path: Path, document: object) -> None:
    atomic_write(path, json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n")
