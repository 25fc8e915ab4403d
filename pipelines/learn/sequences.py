"""Terrain over time: sequences over several terrains, spliced from held-out runs or recorded as such.

A classifier of a fold and the filter over time of the live chain follow each sequence.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from features.windows import TIME_TOLERANCE_S, Layout, WindowRule, cut_windows, regular_starts, span_of
from pipelines.learn.evaluate import HeldOut
from pipelines.learn.protocols import Fold, Samples
from pipelines.learn.recipes import WindowPipeline, feature_matrix
from terrain.classify.breakaway import breakaways
from terrain.classify.sequence_figures import STRIDE_S, Track, last_class
from terrain.classify.terrain_filter import TerrainFilter, check_filter, filter_run, reported
from terrain.logs.splicing import Part, order_stretches, splice_runs, stretches_of
from terrain.records import Array, RunLog, Windows


class Breakaway(NamedTuple):
    """A stretch of a run that looks like another terrain than its label, unlike the rest of the run."""

    run_id: str
    start_s: float
    end_s: float
    label: str
    looks_like: str
    probability: float
    label_probability: float
    rest_probability: float


class SplicedRun(NamedTuple):
    """A log over several terrains; the run behind each of its labels, and whether it was spliced."""

    log: RunLog
    runs: tuple[str, ...]
    spliced: bool


def held_out_parts(runs: Mapping[str, RunLog], windows: Windows) -> list[Part]:
    """Return the parts of runs that held-out windows lie in, one a label.

    A run that was held out in part, as the only one of its class, gives what its held-out windows span.

    Parameters
    ----------
    runs : by id
    windows : held out, of these runs
    """
    run_id, terrain = windows.run_id.astype(str), windows.terrain.astype(str)
    parts = []
    for name in np.unique(run_id):
        for label in runs[name].labels:
            begins_s = windows.start_s[(run_id == name) & (terrain == label.terrain)]
            inside = (begins_s >= label.start_s - TIME_TOLERANCE_S) & (begins_s < label.end_s)
            if inside.any():
                begins_s = begins_s[inside]
                end_s = float(begins_s.max()) + windows.length_s
                parts.append(Part(runs[name], float(begins_s.min()), end_s, label.terrain))
    return parts


def sequences_of(
    parts: Sequence[Part], channels: Mapping[str, Sequence[str]], run_id: str, rng: np.random.Generator
) -> tuple[SplicedRun, ...]:
    """Return a spliced sequence through all parts, each second at most once, and the runs over several terrains.

    None is spliced where the terrain never changes.
    """
    found = []
    ordered = order_stretches([s for part in parts for s in stretches_of(part, rng)], rng)
    if len(ordered) >= 2:
        log = splice_runs(ordered, channels, run_id)
        found.append(SplicedRun(log, tuple(part.run.run_id for part in ordered), True))
    counts = Counter(part.run.run_id for part in parts)
    logs = {part.run.run_id: part.run for part in parts if counts[part.run.run_id] > 1}
    return *found, *(SplicedRun(log, (name,) * len(log.labels), False) for name, log in logs.items())


class Following(NamedTuple):
    """Follows sequences with a classifier once it is fitted, in whatever process fits it.

    Parameters
    ----------
    recipe : whose features are computed
    sequences : to be followed
    rule, layout : of the classifier's windows
    classes : (k,) names in the order of the columns
    prior : (k,) part of each class among the training windows
    """

    recipe: WindowPipeline
    sequences: tuple[SplicedRun, ...]
    rule: WindowRule
    layout: Layout
    classes: Array
    prior: tuple[float, ...]

    def __call__(self, classifier: Any) -> list[Track]:
        """Return what is reported along each sequence."""
        return [self._follow(classifier, each) for each in self.sequences]

    def _follow(self, classifier: Any, sequence: SplicedRun) -> Track:
        log, rule = sequence.log, replace(self.rule, stride_s=STRIDE_S)
        begin_s, end_s = span_of(log, self.layout)
        starts_s = regular_starts(begin_s, end_s, rule.length_s, STRIDE_S)
        time_s = starts_s + rule.length_s
        probability = np.full((len(starts_s), len(self.classes)), np.nan)
        windows = cut_windows([log], rule, layout=self.layout, skip_short=True).windows
        if len(windows):
            rows = np.rint((windows.start_s - begin_s) / STRIDE_S).astype(int)
            probability[rows] = 0.0
            columns = np.searchsorted(self.classes, classifier.classes_)
            features = feature_matrix(self.recipe, windows)
            probability[np.ix_(rows, columns)] = classifier.predict_proba(features)
        settings = check_filter(TerrainFilter(self.prior))
        starts = np.array([label.start_s for label in log.labels])
        ground = np.full(len(time_s), -1)
        for i, label in enumerate(log.labels):
            inside = (time_s > label.start_s + TIME_TOLERANCE_S) & (time_s <= label.end_s + TIME_TOLERANCE_S)
            ground[inside] = i
        return Track(
            time_s,
            ground,
            (ground >= 0) & (starts_s >= starts[ground] - TIME_TOLERANCE_S),
            reported(filter_run(probability, time_s, settings), settings.threshold),
            last_class(probability),
            np.searchsorted(self.classes, [label.terrain for label in log.labels]),
            sequence.runs,
            starts,
            sequence.spliced,
        )


def following(
    recipe: WindowPipeline, samples: Samples, rule: WindowRule, folds: Sequence[Fold], seed: int
) -> list[Following]:
    """Return what follows, for each fold, the sequences through its held-out runs.

    Parameters
    ----------
    recipe : whose features are computed
    samples : windows with their runs, as the folds number them
    rule : of the windows
    folds : training and test rows
    seed : of what is drawn
    """
    by_id = {run.run_id: run for run in samples.runs}
    layout = Layout(samples.windows.channels, samples.windows.rate_hz)
    terrain, classes = samples.terrain, np.unique(samples.terrain)
    found = []
    for repeat, number, train, test in folds:
        rng = np.random.default_rng((seed, repeat, number))
        parts = held_out_parts(by_id, samples.windows[test])
        sequences = sequences_of(parts, layout.channels, f"course {repeat} {number}", rng)
        counts = np.array([np.sum(terrain[train] == name) for name in classes], dtype=float) + 1.0
        prior = tuple((counts / counts.sum()).tolist())
        found.append(Following(recipe, sequences, rule, layout, classes, prior))
    return found


def breakaways_of(held_out: HeldOut, windows: Windows) -> tuple[Breakaway, ...]:
    """Return the stretches of runs that break away from them by their held-out probabilities, the surest first."""
    run_id, terrain = windows.run_id.astype(str), held_out.truth
    probability = held_out.probability.mean(axis=0)
    found = []
    for run in np.unique(run_id):
        for label in np.unique(terrain[run_id == run]):
            rows = np.flatnonzero((run_id == run) & (terrain == label))
            rows = rows[np.argsort(windows.start_s[rows], kind="stable")]
            column = int(np.searchsorted(held_out.classes, label))
            for each in breakaways(probability[rows], column, windows.start_s[rows], windows.length_s):
                looks_like = str(held_out.classes[each.looks_like])
                found.append(Breakaway(str(run), each.start_s, each.end_s, str(label), looks_like, *each[3:]))
    return tuple(sorted(found, key=lambda each: -each.probability * (each.end_s - each.start_s)))
