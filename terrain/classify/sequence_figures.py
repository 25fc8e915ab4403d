"""How well a classifier and its filter over time follow sequences over several terrains.

Figures are by time, with intervals by bootstrap over the runs behind the sequences.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.classify.metrics import TIME_TOLERANCE_S, runs_of_classes
from terrain.classify.terrain_filter import TerrainFilter, check_filter, filter_run, reported
from terrain.records import Array, Label

STRIDE_S = 0.25
"""A window comes so often: four times as often as terrain has to be known at 1 Hz, an eighth of a window."""

N_BOOTSTRAP = 2000

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


def track_of(
    labels: Sequence[Label],
    runs: tuple[str, ...],
    starts_s: Array,
    length_s: float,
    probability: Array,
    classes: Array,
    prior: Array,
    spliced: bool,
) -> Track:
    """Return what the last window and the filter over time report along a sequence.

    Parameters
    ----------
    labels, runs : terrain and run of each stretch of the sequence
    starts_s, length_s : (n,) starts of windows on a regular grid, and their length
    probability : (n, k) of each window; NaN of one that was refused
    classes, prior : (k,) sorted, and what the filter expects of each
    spliced : whether the sequence was spliced
    """
    time_s = starts_s + length_s
    settings = check_filter(TerrainFilter(tuple(prior.tolist())))
    begin_s = np.array([label.start_s for label in labels])
    ground = np.full(len(time_s), -1)
    for i, label in enumerate(labels):
        inside = (time_s > label.start_s + TIME_TOLERANCE_S) & (time_s <= label.end_s + TIME_TOLERANCE_S)
        ground[inside] = i
    return Track(
        time_s,
        ground,
        (ground >= 0) & (starts_s >= begin_s[ground] - TIME_TOLERANCE_S),
        reported(filter_run(probability, time_s, settings), settings.threshold),
        last_class(probability),
        np.searchsorted(classes, [label.terrain for label in labels]),
        runs,
        begin_s,
        spliced,
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
    terrain_of, run_of = runs_of_classes(stretches.run, stretches.terrain)
    times = np.zeros((N_BOOTSTRAP, len(terrain_of)))
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
