"""Protocols of evaluation: which windows train and which test, as one table of groups and deals.

A unit is what is never divided between training and test: a session where a class has several, otherwise a run; a
regime of driving.  A class that has one unit only is divided as :mod:`terrain.classify.folds` does it.
``published`` deals 5 s partitions of runs at random, as the papers do, so that a test partition nearly always
has its own run in training; it serves to compare with papers only.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from sklearn.model_selection import StratifiedKFold

from features.answers import answers_of
from features.motion import fastest_wheel
from features.windows import (
    TIME_TOLERANCE_S,
    WindowRule,
    cut_windows,
    label_windows,
    labelled,
    layout_of,
    regular_starts,
    span_of,
)
from terrain.classify.answers import Observed
from terrain.classify.folds import (
    N_FOLDS,
    Fold,
    divided_units,
    fold_numbers,
    has_sessions,
    numbered_folds,
    single_run_classes,
    two_classes,
    units_of,
)
from terrain.classify.held_out import (
    MIN_CLASSES,
    MIN_RUNS_A_SIDE,
    MIN_TIME_A_SIDE_S,
    Applicability,
    SlowFast,
    slow_fast_split,
)
from terrain.errors import ConfigError, DataError
from terrain.logs.duplicates import distinct_runs
from terrain.logs.regimes import driven_at, regime_of
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, RunLog, Windows

#: Of the papers: length of a partition, and stride of the class with the fewest.
PARTITION_S, PUBLISHED_STRIDE_S = 5.0, 0.1
#: So few sessions are held out one at a time, more are dealt into folds.
MAX_SESSION_FOLDS = 12


class Samples(NamedTuple):
    """Windows under one label each, how many were left out by reason, and what protocols need besides."""

    windows: Windows
    dropped: Mapping[str, int]
    group: Array  #: (n, 2) session, or run without one, and run; under ``published`` the partition (n,)
    gap: int  #: windows beside a window that may share samples with it
    merged: tuple[tuple[str, ...], ...] = ()  #: ids of runs that hold the same measurements and were made one
    runs: Sequence[RunLog] = ()  #: that the windows were cut from; empty where they are not at hand
    repaired: Mapping[str, int] = MappingProxyType({})  #: what a repairing reader changed, by kind
    cached: Observed | None = None  #: what the ground answered, of windows without samples

    @property
    def observed(self) -> Observed | None:
        """What the ground answered in each window; None where it is not measured."""
        return answers_of(self.windows) if self.windows.values else self.cached

    @property
    def terrain(self) -> Array:
        """Label (n,) of each window, as text."""
        return np.asarray(self.windows.terrain.astype(str))

    @property
    def run_id(self) -> Array:
        """Run (n,) of each window, as text."""
        return np.asarray(self.windows.run_id.astype(str))

    @property
    def unit(self) -> Array:
        """Session (n,) of each window where a class has several, otherwise its run: what intervals are over."""
        return units_of(self.terrain, self.windows.groups)


class Protocol(NamedTuple):
    """What is held out, in words, and how."""

    held_out: str
    #: (n,) or (n, 2) what is held out together; empty of a window that neither trains nor tests
    units: Callable[[Samples], Array]
    #: from class, unit, number of folds and random numbers of the repeat, the fold (n,) that tests each window, -1
    #: for none
    deal: Callable[[Array, Array, int, np.random.Generator], Array]
    repeats: int = 1  #: fold assignments by default; 1 where there is one only
    note: str = ""  #: what a reader of the figures must know of it
    #: whether a run is on one side of a split, but for the blocks of a class with one unit
    whole_runs: bool = True
    whole_sessions: bool = False  #: whether, where a terrain has several sessions, these are on one side, too


def _leave_one_out(y: Array, group: Array, n_folds: int, rng: np.random.Generator) -> Array:
    """Return the number of each group: it is a fold of its own, however many there are."""
    return np.asarray(np.unique(group, return_inverse=True)[1])


def deal_partitions(y: Array, partition: Array, n_folds: int, rng: np.random.Generator) -> Array:
    """Return the fold (n,) that tests each window: partitions (n,) are dealt at random, stratified by class."""
    names, first, group_of = np.unique(partition, return_index=True, return_inverse=True)
    labels = y[first]
    short = [f"{name} ({n})" for name, n in sorted(Counter(labels.tolist()).items()) if n < n_folds]
    if short:
        raise DataError(f"fewer than {n_folds} partitions of {PARTITION_S:g} s: {', '.join(short)}")
    number = np.empty(len(names), dtype=int)
    deal = StratifiedKFold(n_folds, shuffle=True, random_state=int(rng.integers(2**31)))
    for fold, (_, test) in enumerate(deal.split(names, labels)):
        number[test] = fold
    return number[group_of]


def sessions(samples: Samples) -> Array:
    """Return session and run (n, 2) of each window; ``DataError`` where no class has several sessions."""
    if not has_sessions(samples.terrain, samples.group):
        raise DataError(
            "no terrain has several sessions, of which one could be held out; 'grouped' holds out runs"
        )
    return samples.group


def whole_runs(samples: Samples) -> Array:
    """Return the run (n,) of each window."""
    return samples.run_id


def regimes(samples: Samples) -> Array:
    """Return what each window's run (n,) was commanded, or, where that varies or is unknown, its speeds."""
    regime = {run.run_id: regime_of(run) for run in _logs(samples)}
    return np.array([regime[name] for name in samples.windows.run_id], dtype=object)


def slow_and_fast(samples: Samples) -> tuple[Array, SlowFast]:
    """Return on which side of its class's median speed each window's run lies (n,), and how classes divide."""
    windows, run_id = samples.windows, samples.run_id
    return slow_fast_split(fastest_wheel(windows), run_id, samples.terrain, windows.start_s, windows.length_s)


def _from_to(trained: str, tested: str) -> Protocol:
    """Return the protocol of slow and fast runs; ``DataError`` where too few classes have enough of both."""

    def sides(samples: Samples) -> Array:
        side, split = slow_and_fast(samples)
        if split.status is Applicability.NOT_APPLICABLE:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in split.left_out.items())
            raise DataError(
                f"slow and fast runs are compared on {MIN_CLASSES} terrains with at least {MIN_RUNS_A_SIDE} runs "
                f"and {MIN_TIME_A_SIDE_S:g} s of each; there are {len(split.classes)} ({reasons})"
            )
        return side

    def deal(_: Array, side: Array, *__: Any) -> Array:
        return np.where(side == tested, 0, -1)

    held_out = f"{tested} runs held out, {trained} ones trained on"
    note = f"{held_out}, on either side of the median speed of each terrain"
    return Protocol(held_out, sides, deal, note=note, whole_runs=False)


def _groups(samples: Samples) -> Array:
    return samples.group


#: By name.
PROTOCOLS: dict[str, Protocol] = {
    "grouped": Protocol("whole runs held out", _groups, fold_numbers, 5, whole_sessions=True),
    "grouped-by-run": Protocol(
        "whole runs held out",
        whole_runs,
        fold_numbers,
        5,
        "runs of one session lie on both sides of the split: what another day does is not shown",
    ),
    "leave-one-run-out": Protocol("one run held out at a time", whole_runs, _leave_one_out),
    "leave-sessions-out": Protocol(
        "one session held out at a time", sessions, _leave_one_out, whole_sessions=True
    ),
    "leave-regimes-out": Protocol("speeds and directions of driving held out", regimes, fold_numbers, 5),
    "leave-terrain-out": Protocol(
        "whole runs held out",
        _groups,
        fold_numbers,
        note="accuracy and the table of classes are of folds in which all terrains are known",
        whole_sessions=True,
    ),
    "published": Protocol(
        "parts of the same runs held out",
        _groups,
        deal_partitions,
        5,
        "published protocol: parts of one run lie on both sides of the split; for comparison with papers only",
        whole_runs=False,
    ),
    "slow-fast": _from_to("slow", "fast"),
    "fast-slow": _from_to("fast", "slow"),
}


def folds_of(samples: Samples, protocol: str = "grouped", repeats: int = 1, seed: int = 0) -> list[Fold]:
    """Return the folds of a protocol, repeat by repeat; each repeat deals anew from ``(seed, repeat)``.

    ``DataError`` where there is one class only, or there are fewer runs than folds.
    """
    scheme = PROTOCOLS[protocol]
    unit = scheme.units(samples)
    used = np.flatnonzero(unit.reshape(len(unit), -1)[:, 0] != "")
    y, unit = samples.terrain[used], unit[used]
    two_classes(y)
    n_runs = len(np.unique(samples.run_id))
    if scheme.whole_runs and scheme.deal is fold_numbers and n_runs < N_FOLDS:
        raise DataError(f"{n_runs} runs are fewer than {N_FOLDS} folds")
    cut, alone, n_folds = unit, [], N_FOLDS
    if scheme.whole_runs:
        alone = [np.flatnonzero(y == name) for name in single_run_classes(y, unit)]
        cut = divided_units(y, unit, N_FOLDS)
        n_units = len(np.unique(cut))
        if has_sessions(y, unit):
            n_folds = n_units if n_units <= MAX_SESSION_FOLDS else N_FOLDS
    drawn = scheme.deal in (fold_numbers, deal_partitions) and (not scheme.whole_runs or n_folds < n_units)
    return [
        Fold(repeat, number, used[train], used[test])
        for repeat in range(repeats if drawn else 1)
        for number, (train, test) in enumerate(
            numbered_folds(
                scheme.deal(y, cut.astype(str), n_folds, np.random.default_rng((seed, repeat))),
                alone,
                samples.gap,
            )
        )
    ]


def samples_of(
    runs: Sequence[RunLog],
    rule: WindowRule,
    signal_sets: Iterable[str] = SIGNAL_SETS,
    protocol: str = "grouped",
    *,
    speed_mps: tuple[float, float] | None = None,
    merge_duplicates: bool = False,
    skip_short: bool = False,
    rate_hz: Mapping[str, float] | None = None,
) -> Samples:
    """Cut the labelled windows that a protocol asks for, of distinct runs, with their groups.

    Parameters
    ----------
    speed_mps : only runs that were driven between these speeds
    merge_duplicates : whether runs that hold the same measurements are one run, in place of being refused
    skip_short : whether runs shorter than a window are left out and counted
    rate_hz : of streams whose windows are resampled to a lower rate

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
    distinct, merged = distinct_runs(runs, merge=merge_duplicates)
    is_published = protocol == "published"
    if is_published and rule.length_s > PARTITION_S:
        raise ConfigError(
            f"a window of {rule.length_s:g} s does not fit into a partition of {PARTITION_S:g} s"
        )
    speeds = rule.steady is not None and not is_published
    layout = layout_of(distinct, signal_sets, speeds=speeds, rate_hz=rate_hz)
    if is_published:
        # slid inside partitions of 5 s, that with the fewest of a class every 0.1 s, the others in proportion to their
        # number, so that classes are balanced; no rule of steady motion is applied
        begin_s = {run.run_id: span_of(run, layout)[0] for run in distinct}
        places = []
        for run in distinct:
            starts = regular_starts(*span_of(run, layout), PARTITION_S, PARTITION_S)
            labels = label_windows(run, starts, PARTITION_S)
            places += [(run.run_id, name, start) for start, name in zip(starts, labels, strict=True) if name]
        if not places:
            raise DataError(f"no partition of {PARTITION_S:g} s lies under one label")
        names, counts = np.unique(np.array([place[1] for place in places]), return_counts=True)
        each_s = dict(zip(names, PUBLISHED_STRIDE_S * counts / counts.min(), strict=True))
        starts_s: dict[str, list[float]] = {}
        for run_id, name, start in places:
            inside = regular_starts(start, start + PARTITION_S, rule.length_s, each_s[name])
            starts_s.setdefault(run_id, []).extend(inside)
        at = {run_id: np.array(each) for run_id, each in starts_s.items()}
        plain = WindowRule(rule.length_s, rule.stride_s, None)
        cut = labelled(cut_windows(distinct, plain, layout=layout, starts_s=at, skip_short=True))
        windows, gap = cut.windows, 0
        partition = [
            f"{run_id} part {int((start - begin_s[run_id] + TIME_TOLERANCE_S) // PARTITION_S)}"
            for start, run_id in zip(windows.start_s, windows.run_id, strict=True)
        ]
        group: Array = np.array(partition, dtype=object)
    else:
        cut = labelled(cut_windows(distinct, rule, layout=layout, skip_short=skip_short))
        group, gap = cut.windows.groups, rule.overlap
    values = cut.windows.values
    if not any((each != each[:1, :, :1]).any() for each in values.values()):
        streams = " and ".join(repr(name) for name in values)
        raise DataError(f"no channel of the streams {streams} ever varies: nothing can be learned from them")
    repaired = dict(Counter(repaired) + Counter(cut.filled))
    return Samples(cut.windows, cut.dropped, group, gap, merged, distinct, repaired)


def _logs(samples: Samples) -> Sequence[RunLog]:
    """Return the runs of samples; windows from a cache, or cut by a user, do not have them."""
    if not samples.runs:
        raise DataError("regimes of driving are those of run logs, which are not at hand beside the windows")
    return samples.runs
