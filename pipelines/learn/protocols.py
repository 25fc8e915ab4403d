"""Protocols of evaluation: which windows train and which test, as one table of groups and splitters.

A group is what is never divided between training and test: a run, a session, a regime of driving.  A class
that has one group only is cut into contiguous blocks, and training windows beside a test block are left out.
``published`` deals 5 s partitions of runs at random, as the papers do, so that a test partition nearly always
has its own run in training; it serves to compare with papers only.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from sklearn.model_selection import LeaveOneGroupOut, PredefinedSplit, StratifiedKFold

from features.motion import wheel_stream
from features.windows import (
    TIME_TOLERANCE_S,
    WindowCut,
    WindowRule,
    cut_windows,
    label_windows,
    layout_of,
    regular_starts,
    span_of,
    wheel_speeds,
)
from pipelines.learn.settings import WindowSettings
from pipelines.report import format_counts
from terrain.classify.folds import block_groups, fold_numbers, single_run_classes
from terrain.errors import ConfigError, DataError
from terrain.logs.merge import distinct_runs
from terrain.logs.regimes import driven_at, regime_of
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, RunLog, Windows

N_FOLDS = 5
PARTITION_S = 5.0
PUBLISHED_STRIDE_S = 0.1

MIN_RUNS_A_SIDE, MIN_TIME_A_SIDE_S = 2, 60.0
"""Slow and fast runs of a class that are compared: at least so many, of so much time."""
MIN_CLASSES = 3
"""Slow and fast runs are compared where at least so many classes have enough of both."""
MOVING_MPS = 0.03
"""The faster wheel moves above this; it is the steady-motion rule's own threshold."""


class Fold(NamedTuple):
    """Rows that train and rows that test; ``repeat`` numbers the fold assignment."""

    repeat: int
    number: int
    train: Array
    test: Array


class Samples(NamedTuple):
    """Labelled windows, and what protocols need besides.

    Parameters
    ----------
    windows : under one label each
    dropped : how many windows were left out, by reason
    group : (n,) what is never divided: the run, or under ``published`` the partition
    gap : windows beside a window that may share samples with it
    merged : ids of runs that hold the same measurements and were made one
    runs : that the windows were cut from; empty where they are not at hand
    repaired : what a repairing reader changed, by kind
    """

    windows: Windows
    dropped: Mapping[str, int]
    group: Array
    gap: int
    merged: tuple[tuple[str, ...], ...] = ()
    runs: Sequence[RunLog] = ()
    repaired: Mapping[str, int] = MappingProxyType({})

    @property
    def terrain(self) -> Array:
        """Label (n,) of each window, as text."""
        return np.asarray(self.windows.terrain.astype(str))

    @property
    def run_id(self) -> Array:
        """Run (n,) of each window, as text."""
        return np.asarray(self.windows.run_id.astype(str))

    def of(self, rows: Array) -> Samples:
        """Return some of the windows."""
        return self._replace(windows=self.windows[rows], group=self.group[rows])


Splitter: TypeAlias = Any
"""A scikit-learn splitter: ``split(X, y, groups)`` gives training and test rows."""


class Protocol(NamedTuple):
    """What is held out, and how.

    Parameters
    ----------
    held_out : in words
    units : (n,) what is held out together; empty of a window that neither trains nor tests
    splitter : what divides them, by class, unit and random numbers of the repeat
    repeats : fold assignments by default; 1 where there is one only
    whole_runs : whether a run is on one side of a split, but for the blocks of a class with one unit
    """

    held_out: str
    units: Callable[[Samples], Array]
    splitter: Callable[[Array, Array, np.random.Generator], Splitter]
    repeats: int = 1
    whole_runs: bool = True


def deal_groups(y: Array, group: Array, rng: np.random.Generator) -> Splitter:
    """Deal whole groups into folds, evenly within classes (not scikit-learn's: see terrain.classify.folds)."""
    return PredefinedSplit(fold_numbers(y, group, N_FOLDS, rng))


def deal_partitions(y: Array, group: Array, rng: np.random.Generator) -> Splitter:
    """Deal partitions of runs into folds at random, stratified by class.

    Raises
    ------
    DataError
        if a class has fewer partitions than there are folds.
    """
    names, first, group_of = np.unique(group.astype(str), return_index=True, return_inverse=True)
    labels = y[first]
    short = [
        f"{name} ({n})" for name, n in zip(*np.unique(labels, return_counts=True), strict=True) if n < N_FOLDS
    ]
    if short:
        raise DataError(f"fewer than {N_FOLDS} partitions of {PARTITION_S:g} s: {', '.join(short)}")
    number = np.empty(len(names), dtype=int)
    deal = StratifiedKFold(N_FOLDS, shuffle=True, random_state=int(rng.integers(2**31)))
    for fold, (_, test) in enumerate(deal.split(names, labels)):
        number[test] = fold
    return PredefinedSplit(number[group_of])


def sessions(samples: Samples) -> Array:
    """Return the session (n,) of each window; of a class with one session, a block of its runs."""
    windows = samples.windows
    session = {run.run_id: run.session or run.run_id for run in _logs(samples)}
    group = np.array([session[name] for name in windows.run_id], dtype=object)
    for terrain in single_run_classes(samples.terrain, group.astype(str)):
        rows = np.flatnonzero(windows.terrain == terrain)
        runs = list(dict.fromkeys(windows.run_id[rows]))
        part = {name: i * N_FOLDS // len(runs) + 1 for i, name in enumerate(runs)}
        if len(runs) >= N_FOLDS:
            group[rows] = [f"{group[row]} part {part[windows.run_id[row]]}" for row in rows]
    if len(set(group)) == len(set(windows.run_id)):
        raise DataError("the runs name no sessions that could be held out; 'grouped' holds out runs")
    return group


def regimes(samples: Samples) -> Array:
    """Return what each window's run (n,) was commanded, or, where that varies or is unknown, its speeds."""
    regime = {run.run_id: regime_of(run) for run in _logs(samples)}
    return np.array([regime[name] for name in samples.windows.run_id], dtype=object)


def sides(samples: Samples) -> Array:
    """Return ``slow`` or ``fast`` (n,), on which side of its class's median speed a window's run lies.

    Raises
    ------
    DataError
        if too few classes have enough slow and fast runs.
    """
    split = slow_fast_split(samples)
    if len(split.classes) < MIN_CLASSES:
        raise DataError(
            f"slow and fast runs are compared on {MIN_CLASSES} terrains with at least {MIN_RUNS_A_SIDE} runs "
            f"and {MIN_TIME_A_SIDE_S:g} s of each; there are {len(split.classes)} ({split.reasons})"
        )
    return split.side


def _from_to(trained: str, tested: str) -> Protocol:
    def splitter(y: Array, group: Array, rng: np.random.Generator) -> Splitter:
        return PredefinedSplit(np.where(group == tested, 0, -1))

    return Protocol(f"{tested} runs held out, {trained} ones trained on", sides, splitter, whole_runs=False)


def _groups(samples: Samples) -> Array:
    return samples.group


PROTOCOLS: dict[str, Protocol] = {
    "grouped": Protocol("whole runs held out", _groups, deal_groups, repeats=5),
    "leave-one-run-out": Protocol("one run held out at a time", _groups, lambda *_: LeaveOneGroupOut()),
    "leave-sessions-out": Protocol("one session held out at a time", sessions, lambda *_: LeaveOneGroupOut()),
    "leave-regimes-out": Protocol(
        "speeds and directions of driving held out", regimes, deal_groups, repeats=5
    ),
    "leave-terrain-out": Protocol("whole runs held out", _groups, deal_groups),
    "published": Protocol("parts of the same runs held out", _groups, deal_partitions, 5, whole_runs=False),
    "slow-fast": _from_to("slow", "fast"),
    "fast-slow": _from_to("fast", "slow"),
}
"""By name."""


def folds_of(samples: Samples, protocol: str = "grouped", repeats: int = 1, seed: int = 0) -> list[Fold]:
    """Return the folds of a protocol, repeat by repeat; each repeat deals anew from ``(seed, repeat)``.

    Raises
    ------
    DataError
        if there is one class only, or there are fewer runs than folds.
    """
    scheme = PROTOCOLS[protocol]
    unit = scheme.units(samples)
    used = np.flatnonzero(unit != "")
    y, unit = samples.terrain[used], unit[used]
    if len(np.unique(y)) < 2:
        raise DataError(f"all windows are {str(y[0])!r}: a classifier needs at least two classes")
    n_runs = len(np.unique(samples.run_id))
    if scheme.whole_runs and scheme.splitter is deal_groups and n_runs < N_FOLDS:
        raise DataError(f"{n_runs} runs are fewer than {N_FOLDS} folds")
    alone = single_run_classes(y, unit.astype(str)) if scheme.whole_runs else []
    cut = block_groups(y, unit, N_FOLDS).astype(str) if scheme.whole_runs else unit.astype(str)
    folds = []
    drawn = scheme.splitter in (deal_groups, deal_partitions)
    for repeat in range(repeats if drawn else 1):
        splitter = scheme.splitter(y, cut, np.random.default_rng((seed, repeat)))
        groups = None if isinstance(splitter, PredefinedSplit) else cut
        for number, (train, test) in enumerate(splitter.split(y, y, groups)):
            for terrain in alone:
                train = without_neighbours(train, test, np.flatnonzero(y == terrain), samples.gap)
            folds.append(Fold(repeat, number, used[train], used[test]))
    return folds


def without_neighbours(train: Array, test: Array, rows: Array, gap: int) -> Array:
    """Return the training rows without those of one run, ``rows`` in order, that lie beside a test row.

    Examples
    --------
    >>> without_neighbours(np.array([0, 1, 4, 5]), np.array([2, 3]), np.arange(6), gap=1)
    array([0, 5])
    """
    tested = np.flatnonzero(np.isin(rows, test))
    near = (tested[:, None] + np.arange(-gap, gap + 1)).ravel()
    beside = rows[near[(near >= 0) & (near < len(rows))]]
    return np.asarray(train[~np.isin(train, beside)])


def samples_of(
    runs: Sequence[RunLog],
    settings: WindowSettings,
    protocol: str = "grouped",
    speed_mps: tuple[float, float] | None = None,
) -> Samples:
    """Cut the labelled windows that a protocol asks for, of distinct runs, with their groups.

    Parameters
    ----------
    runs : labelled
    settings : how windows are cut, and of which signal sets
    protocol : one of :data:`PROTOCOLS`
    speed_mps : only runs that were driven between these speeds

    Raises
    ------
    DataError
        if runs hold the same measurements and are not to be merged, or the data do not fit the protocol.
    """
    repaired = dict(sum((Counter(run.dropped) for run in runs), Counter()))
    if speed_mps is not None:
        runs = [run for run in runs if driven_at(run, *speed_mps)]
        if not runs:
            raise DataError(f"no run is driven at a speed of {speed_mps[0]:g} to {speed_mps[1]:g} m/s")
    distinct = distinct_runs(runs, merge=settings.merge_duplicates)
    if protocol == "published":
        samples = published_samples(distinct.runs, settings.rule, settings.signal_sets)
    else:
        samples = grouped_samples(
            distinct.runs, settings.rule, settings.signal_sets, skip_short=settings.skip_short
        )
    values = samples.windows.values
    if not any((each != each[:1, :, :1]).any() for each in values.values()):
        streams = " and ".join(repr(name) for name in values)
        raise DataError(f"no channel of the streams {streams} ever varies: nothing can be learned from them")
    return samples._replace(merged=distinct.merged, runs=distinct.runs, repaired=repaired)


def grouped_samples(
    runs: Sequence[RunLog],
    rule: WindowRule,
    signal_sets: Iterable[str] = SIGNAL_SETS,
    *,
    skip_short: bool = False,
) -> Samples:
    """Cut windows by the rule, labelled ones only; what is held out is a run."""
    layout = layout_of(runs, signal_sets, speeds=rule.steady is not None)
    cut = labelled(cut_windows(runs, rule, layout=layout, skip_short=skip_short))
    return Samples(cut.windows, cut.dropped, cut.windows.run_id, rule.overlap, runs=runs)


def labelled(cut: WindowCut) -> WindowCut:
    """Keep the windows that lie under one label; the others are counted as ``no single label``.

    Raises
    ------
    DataError
        if there is no window, or none with a label.
    """
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
    No rule of steady motion is applied.  What is held out is a partition.
    """
    if rule.length_s > PARTITION_S:
        raise ConfigError(
            f"a window of {rule.length_s:g} s does not fit into a partition of {PARTITION_S:g} s"
        )
    layout = layout_of(runs, signal_sets, speeds=False)
    begin_s = {run.run_id: span_of(run, layout)[0] for run in runs}
    places = []
    for run in runs:
        starts = regular_starts(*span_of(run, layout), PARTITION_S, PARTITION_S)
        labels = label_windows(run, starts, PARTITION_S)
        places += [(run.run_id, name, start) for start, name in zip(starts, labels, strict=True) if name]
    if not places:
        raise DataError(f"no partition of {PARTITION_S:g} s lies under one label")
    names, counts = np.unique(np.array([place[1] for place in places]), return_counts=True)
    stride_s = dict(zip(names, PUBLISHED_STRIDE_S * counts / counts.min(), strict=True))
    starts_s: dict[str, list[float]] = {}
    for run_id, name, start in places:
        inside = regular_starts(start, start + PARTITION_S, rule.length_s, stride_s[name])
        starts_s.setdefault(run_id, []).extend(inside)
    plain = WindowRule(rule.length_s, rule.stride_s, None, rule.max_gap_periods)
    at = {run_id: np.array(each) for run_id, each in starts_s.items()}
    cut = labelled(cut_windows(runs, plain, layout=layout, starts_s=at, skip_short=True))
    group = [
        f"{run_id} part {int((start - begin_s[run_id] + TIME_TOLERANCE_S) // PARTITION_S)}"
        for start, run_id in zip(cut.windows.start_s, cut.windows.run_id, strict=True)
    ]
    return Samples(cut.windows, cut.dropped, np.array(group, dtype=object), 0, runs=runs)


def run_speeds(windows: Windows) -> dict[str, float]:
    """Return the median speed (m/s) of each run's faster wheel where it moves; NaN if it never does."""
    names = windows.run_id.astype(str)
    if wheel_stream(windows.channels) is None:
        return dict.fromkeys(np.unique(names), math.nan)
    fastest = np.abs(wheel_speeds(windows.values, windows.channels)).max(axis=1)
    speeds = {}
    for run_id in np.unique(names):
        moving = fastest[names == run_id].ravel()
        moving = moving[moving > MOVING_MPS]
        speeds[run_id] = float(np.median(moving)) if len(moving) else math.nan
    return speeds


class ClassSpeeds(NamedTuple):
    """Median speeds of the slow and of the fast runs of a class."""

    slow_mps: float
    fast_mps: float


class SlowFastSplit(NamedTuple):
    """Runs of each class on both sides of its median speed.

    Parameters
    ----------
    side : (n,) ``slow`` or ``fast``; empty of a class that is left out, and of a run that is slow on one
        class and fast on another
    classes : speeds of the classes that are kept
    left_out : the reason for each of the others
    """

    side: Array
    classes: dict[str, ClassSpeeds]
    left_out: dict[str, str]

    @property
    def reasons(self) -> str:
        """Why classes are left out, in words."""
        return "; ".join(f"{name}: {reason}" for name, reason in self.left_out.items())


def slow_fast_split(samples: Samples) -> SlowFastSplit:
    """Split the runs of each class at their median speed, taken over the run's time on that class."""
    windows, run_id, y = samples.windows, samples.run_id, samples.terrain
    side = np.full(len(y), "", dtype=object)
    kept: dict[str, ClassSpeeds] = {}
    left_out: dict[str, str] = {}
    for terrain in np.unique(y).tolist():
        speeds = run_speeds(windows[y == terrain])
        known = {run: speed for run, speed in speeds.items() if math.isfinite(speed)}
        median = np.median(list(known.values())) if known else math.nan
        parts = {
            "slow": [run for run, speed in known.items() if speed <= median],
            "fast": [run for run, speed in known.items() if speed > median],
        }
        reason = None
        for name, runs in parts.items():
            starts = (windows.start_s[(run_id == run) & (y == terrain)] for run in runs)
            time_s = sum(covered_s(start_s, windows.length_s) for start_s in starts)
            if len(runs) < MIN_RUNS_A_SIDE:
                reason = reason or f"{name} runs: {len(runs)}"
            elif time_s < MIN_TIME_A_SIDE_S:
                reason = reason or f"{name} runs: {time_s:.0f} s"
        if reason:
            left_out[terrain] = reason
            continue
        kept[terrain] = ClassSpeeds(
            *(float(np.median([known[run] for run in runs])) for runs in parts.values())
        )
        for name, runs in parts.items():
            side[(y == terrain) & np.isin(run_id, runs)] = name
    both = set(run_id[side == "slow"]) & set(run_id[side == "fast"])
    side[np.isin(run_id, list(both))] = ""
    return SlowFastSplit(side, kept, left_out)


def covered_s(start_s: Array, length_s: float) -> float:
    """Return the time that windows of one run cover; where they overlap it counts once.

    Examples
    --------
    >>> covered_s(np.array([0.0, 1.0, 5.0]), 2.0)
    5.0
    """
    return float(np.minimum(np.diff(np.sort(start_s)), length_s).sum() + length_s)


def _logs(samples: Samples) -> Sequence[RunLog]:
    """Return the runs of samples; windows from a cache, or cut by a user, do not have them."""
    if not samples.runs:
        raise DataError(
            "sessions and regimes are those of run logs, which are not at hand beside the windows"
        )
    return samples.runs


def merged_notes(merged: Sequence[Sequence[str]]) -> list[str]:
    """Return in a sentence each what groups of runs were taken for one run."""
    ending = "hold the same measurements: they are one run, in which each stretch counts once"
    return [f"runs {', '.join(group)} {ending}" for group in merged]


def notes_of(samples: Samples, protocol: str) -> Iterator[str]:
    """Yield in sentences what a reader of figures must know of the runs and the windows."""
    yield from merged_notes(samples.merged)
    alone = single_run_classes(samples.terrain, samples.run_id)
    if alone and protocol != "published":
        yield (
            f"{', '.join(alone)}: one run only, cut into {N_FOLDS} contiguous blocks with a gap; "
            "its figures are optimistic, the same run trains and tests"
        )
    if protocol == "published":
        yield (
            "published protocol: parts of one run lie on both sides of the split; for comparison with papers only"
        )
