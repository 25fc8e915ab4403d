"""Terrain over time: the classifier of a fold follows sequences over several terrains, with the live chain's filter."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from features.windows import Layout, WindowRule, cut_windows, regular_starts, span_of
from terrain.classify.folds import Fold
from terrain.classify.held_out import inner_probability
from terrain.classify.metrics import STRIDE_S, Track, last_class, track_of
from terrain.classify.terrain_filter import FilterSettings, choose_settings, filter_run, reported
from terrain.logs.splicing import order_stretches, parts_under, splice_runs, stretches_of
from terrain.records import Array, RunLog, Windows

#: A log over several grounds; the run behind each of its labels, and whether it was spliced.
SplicedRun = tuple[RunLog, tuple[str, ...], bool]


def follow(
    features: Any,
    sequences: Sequence[SplicedRun],
    rule: WindowRule,
    layout: Layout,
    classes: Array,
    choose: Callable[[Array | None], FilterSettings | None],
    classifier: Any,
) -> list[Track]:
    """Return what a fitted classifier and its filter report along each sequence.

    ``choose`` gives the settings of the filter from what inner folds held out; None to take single windows.
    """
    settings, tracks, rule = (
        choose(inner_probability(classifier, classes)),
        [],
        replace(rule, stride_s=STRIDE_S),
    )
    for log, runs, spliced in sequences:
        begin_s, end_s = span_of(log, layout)
        starts_s = regular_starts(begin_s, end_s, rule.length_s, STRIDE_S)
        probability = np.full((len(starts_s), len(classes)), np.nan)
        windows = cut_windows([log], rule, layout=layout, skip_short=True).windows
        if len(windows):
            rows = np.rint((windows.start_s - begin_s) / STRIDE_S).astype(int)
            probability[rows] = 0.0
            found = classifier.predict_proba(np.asarray(features.fit_transform(windows)))
            probability[np.ix_(rows, np.searchsorted(classes, classifier.classes_))] = found
        single = filtered = last_class(probability)
        if settings is not None:
            filtered = reported(filter_run(probability, starts_s + rule.length_s, settings))
        tracks.append(track_of(log.labels, runs, starts_s, rule.length_s, filtered, single, classes, spliced))
    return tracks


def following(
    features: Any,
    windows: Windows,
    runs: Sequence[RunLog],
    rule: WindowRule,
    folds: Sequence[Fold],
    seed: int,
) -> Iterator[Callable[[Any], list[Track]]]:
    """Yield, for each fold, what follows the sequences through its held-out runs with a classifier once it is fitted.

    These are one that is spliced of all parts of the runs, each second at most once, and the runs over several grounds.
    ``features`` transforms windows, and learns nothing but their channels and rates; the folds number ``windows``.
    """
    by_id = {run.run_id: run for run in runs}
    layout = Layout(windows.channels, windows.rate_hz, windows.rate_hz)
    classes, class_of = np.unique(windows.terrain.astype(str), return_inverse=True)
    for repeat, number, train, test in folds:
        rng = np.random.default_rng((seed, repeat, number))
        parts = parts_under(by_id, windows[test])
        ordered = order_stretches([part for whole in parts for part in stretches_of(whole, rng)], rng)
        sequences: list[SplicedRun] = []
        if len(ordered) >= 2:  # else the terrain never changes
            log = splice_runs(ordered, layout.channels, f"course {repeat} {number}")
            sequences.append((log, tuple(part.run.run_id for part in ordered), True))
        for name, n in Counter(part.run.run_id for part in parts).items():
            if n > 1:  # a run over several grounds
                sequences.append((by_id[name], (name,) * len(by_id[name].labels), False))
        counts = np.bincount(class_of[train], minlength=len(classes)) + 1.0
        choose = partial(
            choose_settings,
            terrain=windows.terrain[train].astype(str),
            end_s=windows.start_s[train] + windows.length_s,
            groups=windows.groups[train],
            length_s=windows.length_s,
            prior=dict(zip(classes.tolist(), (counts / counts.sum()).tolist(), strict=True)),
        )
        yield partial(follow, features, sequences, rule, layout, classes, choose)
