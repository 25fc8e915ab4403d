"""The protocols of cross-validation: which windows train and which test.

``grouped`` is the headline: whole runs are held out.  ``leave-one-run-out`` holds out one run at a time.
``leave-sessions-out`` holds out one session at a time; the only session of a class is cut into blocks of
runs.  ``leave-regimes-out`` holds out speeds and directions of driving: runs that were driven alike are on
one side, whatever their terrain.
``leave-terrain-out`` has the folds of ``grouped``, and asks besides whether a terrain that was left out of
training is found to be unknown (:mod:`pipelines.crossval.unknown`).
``slow-fast`` trains on the slow runs of each class and tests on its fast ones, ``fast-slow`` the reverse
(:func:`pipelines.crossval.extras.speed_split`).
``published`` deals 5 s partitions of runs at random into folds, as the papers do, so that a test
partition nearly always has its own run in training; it serves to compare with papers only.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from sklearn.model_selection import StratifiedKFold

from features.windows import (
    TIME_TOLERANCE_S,
    Layout,
    WindowCut,
    WindowRule,
    cut_windows,
    label_windows,
    layout_of,
    regular_starts,
    span_of,
)
from pipelines.data.regimes import regime_of
from pipelines.reporting.numbers import format_counts
from terrain.classify.folds import block_groups, single_run_classes, split_runs
from terrain.errors import ConfigError, DataError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, RunLog

N_FOLDS = 5
PARTITION_S = 5.0
PUBLISHED_STRIDE_S = 0.1


class Fold(NamedTuple):
    """Rows that train and rows that test; ``repeat`` numbers the fold assignment."""

    repeat: int
    number: int
    train: Array
    test: Array


class Samples(NamedTuple):
    """Windows, and what protocols need besides.

    ``group`` is what must not be split: the run, or the partition under ``published``.  ``merged`` has the
    ids of runs that hold the same measurements and were made one, ``runs`` what the windows were cut from.
    """

    cut: WindowCut
    group: Array
    gap: int
    merged: tuple[tuple[str, ...], ...] = ()
    runs: Sequence[RunLog] = ()


def grouped_samples(
    runs: Sequence[RunLog],
    rule: WindowRule,
    signal_sets: Iterable[str] = SIGNAL_SETS,
    *,
    skip_short: bool = False,
) -> Samples:
    """Cut windows by the rule, labelled ones only; the group of a window is its run."""
    layout = layout_of(runs, signal_sets, speeds=rule.steady is not None)
    cut = labelled(cut_windows(runs, rule, layout=layout, skip_short=skip_short))
    return Samples(cut, cut.windows.run_id, rule.overlap, runs=runs)


def labelled(cut: WindowCut) -> WindowCut:
    """Keep the windows that lie under one label; the others are counted as ``no single label``."""
    known = cut.windows.terrain != ""
    if not len(known):
        raise DataError(f"not one window is left: {format_counts(cut.dropped) or 'no run is long enough'}")
    if not known.any():
        raise DataError("no window has a terrain label: nothing can be trained or tested")
    if known.all():
        return cut
    return WindowCut(cut.windows[known], {**cut.dropped, "no single label": int((~known).sum())})


def published_samples(
    runs: Sequence[RunLog], rule: WindowRule, signal_sets: Iterable[str] = SIGNAL_SETS
) -> Samples:
    """Cut windows as the papers do: slid inside 5 s partitions, classes balanced by stride.

    The class with the fewest partitions is cut every 0.1 s, the others in proportion to their number.
    No rule of steady motion is applied.
    """
    if rule.length_s > PARTITION_S:
        raise ConfigError(
            f"a window of {rule.length_s:g} s does not fit into a partition of {PARTITION_S:g} s"
        )
    layout = layout_of(runs, signal_sets, speeds=False)
    places = [
        (run.run_id, terrain, start_s)
        for run in runs
        for start_s, terrain in zip(*_partitions(run, layout), strict=True)
        if terrain
    ]
    if not places:
        raise DataError(f"no partition of {PARTITION_S:g} s lies under one label")
    terrain = np.array([place[1] for place in places])
    names, counts = np.unique(terrain, return_counts=True)
    stride_s = dict(zip(names, PUBLISHED_STRIDE_S * counts / counts.min(), strict=True))
    starts: dict[str, list[float]] = {}
    for run_id, name, begin_s in places:
        starts.setdefault(run_id, []).extend(
            regular_starts(begin_s, begin_s + PARTITION_S, rule.length_s, stride_s[name])
        )
    plain = WindowRule(rule.length_s, rule.stride_s, None, rule.max_gap_periods)
    cut = labelled(
        cut_windows(
            runs, plain, layout=layout, starts_s={k: np.array(v) for k, v in starts.items()}, skip_short=True
        )
    )
    begin_s = {run.run_id: span_of(run, layout)[0] for run in runs}
    windows = cut.windows
    number = [
        int((start - begin_s[run_id] + TIME_TOLERANCE_S) // PARTITION_S)
        for start, run_id in zip(windows.start_s, windows.run_id, strict=True)
    ]
    group = np.array([f"{run} part {n}" for run, n in zip(windows.run_id, number, strict=True)], dtype=object)
    return Samples(cut, group, 0)


def _partitions(run: RunLog, layout: Layout) -> tuple[Array, Array]:
    """Return the starts of a run's partitions, and the terrain where one label covers all of it."""
    starts_s = regular_starts(*span_of(run, layout), PARTITION_S, PARTITION_S)
    return starts_s, label_windows(run, starts_s, PARTITION_S)


def folds_of(samples: Samples, protocol: str, repeats: int, seed: int) -> list[Fold]:
    """Return the folds of a protocol, repeat by repeat.

    Each repeat deals anew from ``(seed, repeat)``; ``leave-one-run-out`` has a single fold assignment.

    Raises
    ------
    DataError
        if there is one class only, or there are fewer runs than folds.
    """
    y, group = samples.cut.windows.terrain.astype(str), samples.group
    if protocol == "leave-one-run-out":
        return _leave_one_out(y, group, samples.gap)
    if protocol == "leave-sessions-out":
        return _leave_one_out(y, _sessions(samples), samples.gap)
    if protocol == "leave-regimes-out":
        group = _regimes(samples)
    n_runs = len(np.unique(samples.cut.windows.run_id.astype(str)))
    whole_runs = protocol in ("grouped", "leave-regimes-out", "leave-terrain-out")
    if whole_runs and n_runs < N_FOLDS:
        raise DataError(f"{n_runs} runs are fewer than {N_FOLDS} folds")
    folds = []
    for repeat in range(repeats):
        rng = np.random.default_rng((seed, repeat))
        splits = (
            split_runs(y, group, N_FOLDS, rng, samples.gap)
            if whole_runs
            else _stratified_partitions(y, group, rng)
        )
        folds += [Fold(repeat, number, train, test) for number, (train, test) in enumerate(splits)]
    return folds


def _logs(samples: Samples) -> Sequence[RunLog]:
    """Return the runs of samples; a store of features does not have them."""
    if not samples.runs:
        raise DataError("sessions and regimes are those of run logs; a store of features does not hold them")
    return samples.runs


def _sessions(samples: Samples) -> Array:
    """Return the session (n,) of each window; of a class with one session, a block of its runs."""
    windows = samples.cut.windows
    sessions = {run.run_id: run.session or run.run_id for run in _logs(samples)}
    group = np.array([sessions[name] for name in windows.run_id], dtype=object)
    for terrain in single_run_classes(windows.terrain.astype(str), group.astype(str)):
        rows = np.flatnonzero(windows.terrain == terrain)
        runs = list(dict.fromkeys(windows.run_id[rows]))
        part = {name: i * N_FOLDS // len(runs) + 1 for i, name in enumerate(runs)}
        if len(runs) >= N_FOLDS:
            group[rows] = [f"{group[row]} part {part[windows.run_id[row]]}" for row in rows]
    if len(set(group)) == len(set(windows.run_id)):
        raise DataError("the runs name no sessions that could be held out; 'grouped' holds out runs")
    return group


def _regimes(samples: Samples) -> Array:
    """Return what each window's run (n,) was commanded, or, where that varies or is unknown, its speeds."""
    regime = {run.run_id: regime_of(run) for run in _logs(samples)}
    return np.array([regime[name] for name in samples.cut.windows.run_id], dtype=object)


def _leave_one_out(y: Array, run_id: Array, gap: int) -> list[Fold]:
    alone = single_run_classes(y, run_id)
    if len(np.unique(y)) < 2:
        raise DataError(f"all windows are {str(y[0])!r}: a classifier needs at least two classes")
    group = block_groups(y, run_id, N_FOLDS)
    folds = []
    for number, name in enumerate(dict.fromkeys(group)):
        testing = group == name
        training = ~testing
        rows = np.flatnonzero(y == y[testing][0])
        if y[testing][0] in alone:
            at = np.flatnonzero(testing[rows])
            training[rows[max(at[0] - gap, 0) : at[-1] + gap + 1]] = False
        folds.append(Fold(0, number, np.flatnonzero(training), np.flatnonzero(testing)))
    return folds


def _stratified_partitions(y: Array, group: Array, rng: np.random.Generator) -> list[tuple[Array, Array]]:
    names, first, group_of = np.unique(group.astype(str), return_index=True, return_inverse=True)
    labels = y[first]
    counts = dict(zip(*np.unique(labels, return_counts=True), strict=True))
    if len(counts) < 2:
        raise DataError(f"all windows are {str(labels[0])!r}: a classifier needs at least two classes")
    short = [f"{name} ({n})" for name, n in counts.items() if n < N_FOLDS]
    if short:
        raise DataError(f"fewer than {N_FOLDS} partitions of {PARTITION_S:g} s: {', '.join(short)}")
    deal = StratifiedKFold(N_FOLDS, shuffle=True, random_state=int(rng.integers(2**31)))
    splits = []
    for _, test in deal.split(names, labels):
        testing = np.isin(group_of, test)
        splits.append((np.flatnonzero(~testing), np.flatnonzero(testing)))
    return splits
