"""Terrain over time: sequences over several terrains, spliced from held-out runs or recorded as such.

A classifier of a fold and the filter over time of the live chain follow each sequence; figures are by time,
with intervals by bootstrap over the runs behind the sequences.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from features.windows import Layout, WindowRule, cut_windows, regular_starts, span_of
from pipelines.learn.evaluate import HeldOut
from pipelines.learn.protocols import Fold, Samples
from pipelines.learn.recipes import WindowPipeline, feature_matrix
from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.classify.breakaway import breakaways
from terrain.classify.terrain_filter import TerrainFilter, check_filter, filter_run, reported
from terrain.logs.splicing import Part, splice_runs
from terrain.records import Array, RunLog, Windows

STRIDE_S = 0.25
"""A window comes so often: four times as often as terrain has to be known at 1 Hz, an eighth of a window."""

SHORTEST_S, LONGEST_S = 10.0, 30.0
"""Time on a terrain before the next: shorter ones are no more than five windows, longer ones hardly ever
change."""

N_BOOTSTRAP = 2000
TIME_TOLERANCE_S = 1e-6

Interval = tuple[float, float]


class DelayFigures(NamedTuple):
    """Time from a change of terrain to where the new terrain is reported.

    Parameters
    ----------
    p50, p90, p50_ci, p90_ci : quantiles over the changes that were found before the next one, in s
    n_changes, n_missed : changes, and those among them that were never found
    p90_of_all : quantile with missed changes as infinite; None where it is
    """

    p50: float
    p50_ci: Interval
    p90: float
    p90_ci: Interval
    n_changes: int
    n_missed: int
    p90_of_all: float | None


class SequenceFigures(NamedTuple):
    """How well single windows and the filter follow sequences; every ``_ci`` is 95 % by bootstrap over runs.

    Parameters
    ----------
    filtered_accuracy : fraction of the time at which the right terrain was reported, where the window that
        ends then lies wholly on one terrain; "unknown" counts as wrong
    single_accuracy : the same of the last window's own class
    gain : filtered minus single, paired
    filtered_accuracy_at_end, single_accuracy_at_end : the same over all time, where windows across a change
        are judged by the terrain at their end
    filter_delay_s : from a change to its report
    flips_per_minute, single_flips_per_minute : changes of the reported terrain, less the true ones
    unknown_ratio : fraction of the time at which "unknown" was reported
    n_courses, n_grounds, duration_s : sequences, stretches on one terrain, and time
    """

    filtered_accuracy: float
    filtered_accuracy_ci: Interval
    single_accuracy: float
    single_accuracy_ci: Interval
    gain: float
    gain_ci: Interval
    filtered_accuracy_at_end: float
    filtered_accuracy_at_end_ci: Interval
    single_accuracy_at_end: float
    single_accuracy_at_end_ci: Interval
    filter_delay_s: DelayFigures
    flips_per_minute: float
    flips_per_minute_ci: Interval
    single_flips_per_minute: float
    single_flips_per_minute_ci: Interval
    unknown_ratio: float
    n_courses: int
    n_grounds: int
    duration_s: float


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


def stretches_of(part: Part, rng: np.random.Generator) -> list[Part]:
    """Cut a part of a run into stretches of random lengths without remainder; none where it is too short."""
    found = []
    start_s, left_s = part.start_s, part.end_s - part.start_s
    while left_s >= SHORTEST_S:
        length_s = float(rng.uniform(SHORTEST_S, LONGEST_S))
        if left_s - length_s < SHORTEST_S:
            length_s = left_s if left_s <= LONGEST_S else left_s / 2
        found.append(part._replace(start_s=start_s, end_s=start_s + length_s))
        start_s, left_s = start_s + length_s, left_s - length_s
    return found


def order_stretches(stretches: Sequence[Part], rng: np.random.Generator) -> list[Part]:
    """Order stretches at random so that the terrain changes from each to the next.

    The terrain with the most left comes next where otherwise too much of it would be left at the end;
    what cannot be placed is left out.
    """
    waiting: dict[str, list[Part]] = {}
    for i in rng.permutation(len(stretches)):
        waiting.setdefault(stretches[i].terrain, []).append(stretches[i])
    found: list[Part] = []
    while True:
        last = found[-1].terrain if found else ""
        names = sorted(name for name, kept in waiting.items() if kept and name != last)
        if not names:
            return found
        counts = Counter({name: len(waiting[name]) for name in names})
        n_left = sum(len(kept) for kept in waiting.values())
        most, n_most = counts.most_common(1)[0]
        weights = np.array([counts[name] for name in names], dtype=float)
        chosen = most if 2 * n_most > n_left else names[rng.choice(len(names), p=weights / weights.sum())]
        found.append(waiting[chosen].pop())


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


class Track(NamedTuple):
    """What was reported along a sequence, at the end of each window of a regular grid.

    Parameters
    ----------
    time_s : (n,) since the start of the log
    ground : (n,) which of the labels holds; -1 where none does
    whole : (n,) whether the window lies under that label only
    filtered, single : (n,) column of the class that the filter and the last window give; -1 for unknown
    terrain, run : column of the class, and the run, of each label
    begin_s : (labels,) start of each
    spliced : whether the sequence was spliced
    """

    time_s: Array
    ground: Array
    whole: Array
    filtered: Array
    single: Array
    terrain: Array
    run: tuple[str, ...]
    begin_s: Array
    spliced: bool


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


def last_class(probability: Array) -> Array:
    """Return the class (n,) of the last window that had an output; -1 before the first.

    Examples
    --------
    >>> last_class(np.array([[np.nan, np.nan], [0.2, 0.8], [np.nan, np.nan], [0.7, 0.3]])).tolist()
    [-1, 1, 1, 0]
    """
    there = np.asarray(np.isfinite(probability).all(axis=1))
    best = np.where(there, np.where(there[:, None], probability, 0.0).argmax(axis=1), -1)
    latest = np.maximum.accumulate(np.where(there, np.arange(len(there)), -1))
    return np.where(latest >= 0, best[latest], -1)


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


COLUMNS = (
    "whole",
    "filtered",
    "single",
    "all",
    "filtered_all",
    "single_all",
    "unknown",
    "flips",
    "single_flips",
)
"""Counts of a stretch on one terrain; flips are changes of the reported terrain less the true one."""


class Stretches(NamedTuple):
    """Counts (m, columns) of every stretch on one terrain, its delay (m,), run (m,) and terrain (m,).

    A delay is NaN where the terrain did not change before, and infinite where the change was never found.
    """

    counts: Array
    delay_s: Array
    run: Array
    terrain: Array


def sequence_figures(tracks: Sequence[Track], seed: int) -> SequenceFigures | None:
    """Return the figures of sequences; None where there is none.

    Parameters
    ----------
    tracks : what was reported along each
    seed : of the bootstrap
    """
    if not tracks:
        return None
    found = [_stretches(track) for track in tracks]
    stretches = Stretches(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    sums = dict(zip(COLUMNS, stretches.counts.sum(axis=0), strict=True))
    draws = _draws(stretches, np.random.default_rng(seed))
    drawn = dict(zip(COLUMNS, (draws @ stretches.counts).T, strict=True)) | {"": np.zeros(len(draws))}

    def ratio(above: str, below: str, minus: str = "", per: float = 1.0) -> tuple[float, Interval]:
        if sums[below] == 0.0:
            return float("nan"), (float("nan"), float("nan"))
        value = sums[above] - (sums[minus] if minus else 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            each = (drawn[above] - drawn[minus]) / drawn[below] * per
        return float(value / sums[below] * per), percentile_interval(each)

    a_minute = 60.0 / STRIDE_S
    return SequenceFigures(
        *ratio("filtered", "whole"),
        *ratio("single", "whole"),
        *ratio("filtered", "whole", "single"),
        *ratio("filtered_all", "all"),
        *ratio("single_all", "all"),
        _delays(stretches, draws),
        *ratio("flips", "all", per=a_minute),
        *ratio("single_flips", "all", per=a_minute),
        unknown_ratio=ratio("unknown", "all")[0],
        n_courses=len(tracks),
        n_grounds=len(stretches.run),
        duration_s=float(sums["all"] * STRIDE_S),
    )


def _stretches(track: Track) -> Stretches:
    n = len(track.run)
    counts, delay_s = np.zeros((n, len(COLUMNS))), np.full(n, np.nan)
    changes = [_changes(track.filtered), _changes(track.single)]
    for i in range(n):
        here = track.ground == i
        true = track.terrain[i]
        right = [(found == true) & here for found in (track.filtered, track.single)]
        changed = i > 0 and bool(track.terrain[i - 1] != true)
        counts[i] = [
            np.sum(here & track.whole),
            *(np.sum(each & track.whole) for each in right),
            np.sum(here),
            *(np.sum(each) for each in right),
            np.sum(here & (track.filtered < 0)),
            *(np.sum(each & here) - changed for each in changes),
        ]
        if changed:
            at = np.flatnonzero(right[0])
            delay_s[i] = max(track.time_s[at[0]] - track.begin_s[i], 0.0) if len(at) else np.inf
    return Stretches(counts, delay_s, np.array(track.run, dtype=str), track.terrain)


def _changes(labels: Array) -> Array:
    """Return where another terrain is reported than before; "unknown" between the two is no change."""
    changed = np.zeros(len(labels), dtype=bool)
    known = np.flatnonzero(labels >= 0)
    changed[known[1:]] = np.diff(labels[known]) != 0
    return changed


def _draws(stretches: Stretches, rng: np.random.Generator) -> Array:
    """Return how often each stretch counts in each bootstrap sample of runs within their classes."""
    names = [f"{run}\n{terrain}" for run, terrain in zip(stretches.run, stretches.terrain, strict=True)]
    _, first, run_of = np.unique(names, return_index=True, return_inverse=True)
    terrain_of = stretches.terrain[first]
    times = np.zeros((N_BOOTSTRAP, len(first)))
    for terrain in np.unique(terrain_of):
        members = np.flatnonzero(terrain_of == terrain)
        drawn = members[bootstrap_rows(len(members), N_BOOTSTRAP, rng)]
        np.add.at(times, (np.arange(N_BOOTSTRAP)[:, None], drawn), 1.0)
    return times[:, run_of]


def _delays(stretches: Stretches, draws: Array) -> DelayFigures:
    changes = ~np.isnan(stretches.delay_s)
    found = np.flatnonzero(np.isfinite(stretches.delay_s))
    n_changes, n_missed = int(changes.sum()), int(changes.sum()) - len(found)
    if not len(found):
        nothing = float("nan"), (float("nan"), float("nan"))
        return DelayFigures(*nothing, *nothing, n_changes, n_missed, None)
    order = found[np.argsort(stretches.delay_s[found], kind="stable")]
    delay_s, weights = stretches.delay_s[order], draws[:, order].cumsum(axis=1)

    def quantile(ratio: float) -> tuple[float, Interval]:
        at = (weights < ratio * weights[:, -1:]).sum(axis=1)
        drawn = np.where(weights[:, -1] > 0, delay_s[np.minimum(at, len(delay_s) - 1)], np.nan)
        return float(np.quantile(delay_s, ratio, method="inverted_cdf")), percentile_interval(drawn)

    of_all = float(np.quantile(stretches.delay_s[changes], 0.9, method="inverted_cdf"))
    return DelayFigures(
        *quantile(0.5), *quantile(0.9), n_changes, n_missed, of_all if np.isfinite(of_all) else None
    )


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
