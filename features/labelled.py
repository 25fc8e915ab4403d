"""Windows under one label each: by one rule over whole runs, or in partitions of runs as the papers cut them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
from sklearn.model_selection import StratifiedKFold

from features.windows import (
    TIME_TOLERANCE_S,
    WindowCut,
    WindowRule,
    cut_windows,
    label_windows,
    layout_of,
    regular_starts,
    span_of,
)
from terrain.errors import ConfigError, DataError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, RunLog

PARTITION_S = 5.0
PUBLISHED_STRIDE_S = 0.1


def labelled(cut: WindowCut) -> WindowCut:
    """Keep the windows that lie under one label; the others are counted as ``no single label``.

    Raises
    ------
    DataError
        if there is no window, or none with a label.
    """
    known = cut.windows.terrain != ""
    if not len(known):
        dropped = ", ".join(f"{n} {reason}" for reason, n in sorted(cut.dropped.items()))
        raise DataError(f"not one window is left: {dropped or 'no run is long enough'}")
    if not known.any():
        raise DataError("no window has a terrain label: nothing can be trained or tested")
    if known.all():
        return cut
    return WindowCut(cut.windows[known], {**cut.dropped, "no single label": int((~known).sum())})


def cut_labelled(
    runs: Sequence[RunLog],
    rule: WindowRule,
    signal_sets: Iterable[str] = SIGNAL_SETS,
    *,
    skip_short: bool = False,
) -> WindowCut:
    """Cut labelled windows by the rule.

    Raises
    ------
    DataError
        as :func:`labelled` and :func:`~features.windows.cut_windows`.
    """
    layout = layout_of(runs, signal_sets, speeds=rule.steady is not None)
    return labelled(cut_windows(runs, rule, layout=layout, skip_short=skip_short))


def cut_partitions(
    runs: Sequence[RunLog], rule: WindowRule, signal_sets: Iterable[str] = SIGNAL_SETS
) -> tuple[WindowCut, Array]:
    """Cut windows as the papers do: slid inside 5 s partitions, classes balanced by stride.

    The class with the fewest partitions is cut every 0.1 s, the others in proportion to their number.
    No rule of steady motion is applied.

    Returns
    -------
    cut : labelled windows
    partition : (n,) name of the partition of each

    Raises
    ------
    ConfigError
        if a window does not fit into a partition.
    DataError
        if no partition lies under one label.
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
    partition = [
        f"{run_id} part {int((start - begin_s[run_id] + TIME_TOLERANCE_S) // PARTITION_S)}"
        for start, run_id in zip(cut.windows.start_s, cut.windows.run_id, strict=True)
    ]
    return cut, np.array(partition, dtype=object)


def deal_partitions(y: Array, partition: Array, n_folds: int, rng: np.random.Generator) -> Array:
    """Deal partitions of runs into folds at random, stratified by class.

    Parameters
    ----------
    y, partition : (n,) class and partition of each window
    n_folds : at least 2
    rng : source of the deal

    Returns
    -------
    (n,) int
        the fold that tests each window.

    Raises
    ------
    DataError
        if a class has fewer partitions than there are folds.
    """
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
