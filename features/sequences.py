"""Terrain over time: the classifier of a fold follows sequences over several terrains, with the live chain's filter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from features.windows import Layout, WindowRule, cut_windows, regular_starts, span_of
from terrain.classify.folds import Fold
from terrain.classify.metrics import STRIDE_S, Track, last_class, track_of
from terrain.classify.terrain_filter import TerrainFilter, check_filter, filter_run, reported
from terrain.logs.splicing import SplicedRun, parts_under, sequences_of
from terrain.records import Array, RunLog, Windows


class Following(NamedTuple):
    """Follows sequences with a classifier once it is fitted, in whatever process fits it.

    ``rule`` and ``layout`` are of the classifier's windows; ``classes`` and ``prior`` (k,) names in the order of the
    columns, and the part of each among the training windows.
    """

    features: Any
    sequences: tuple[SplicedRun, ...]
    rule: WindowRule
    layout: Layout
    classes: Array
    prior: Array

    def __call__(self, classifier: Any) -> list[Track]:
        """Return what is reported along each sequence."""
        tracks = []
        for log, runs, spliced in self.sequences:
            rule = replace(self.rule, stride_s=STRIDE_S)
            begin_s, end_s = span_of(log, self.layout)
            starts_s = regular_starts(begin_s, end_s, rule.length_s, STRIDE_S)
            probability = np.full((len(starts_s), len(self.classes)), np.nan)
            windows = cut_windows([log], rule, layout=self.layout, skip_short=True).windows
            if len(windows):
                rows = np.rint((windows.start_s - begin_s) / STRIDE_S).astype(int)
                columns = np.searchsorted(self.classes, classifier.classes_)
                probability[rows] = 0.0
                features = np.asarray(self.features.fit_transform(windows))
                probability[np.ix_(rows, columns)] = classifier.predict_proba(features)
            settings = check_filter(TerrainFilter(tuple(self.prior.tolist())))
            belief = filter_run(probability, starts_s + rule.length_s, settings)
            reports = reported(belief, settings.threshold), last_class(probability)
            tracks.append(
                track_of(log.labels, runs, starts_s, rule.length_s, *reports, self.classes, spliced)
            )
        return tracks


def following(
    features: Any,
    windows: Windows,
    runs: Sequence[RunLog],
    rule: WindowRule,
    folds: Sequence[Fold],
    seed: int,
) -> Iterator[Following]:
    """Yield what follows, for each fold, the sequences through its held-out runs.

    ``features`` transforms windows, and learns nothing but their channels and rates; the folds number ``windows``.
    """
    by_id, layout = {run.run_id: run for run in runs}, Layout(windows.channels, windows.rate_hz)
    classes, class_of = np.unique(windows.terrain.astype(str), return_inverse=True)
    for repeat, number, train, test in folds:
        rng = np.random.default_rng((seed, repeat, number))
        parts = parts_under(by_id, windows[test])
        sequences = sequences_of(parts, layout.channels, f"course {repeat} {number}", rng)
        counts = np.bincount(class_of[train], minlength=len(classes)) + 1.0
        yield Following(features, sequences, rule, layout, classes, counts / counts.sum())
