"""Accuracy, delay and flips along courses, with intervals by bootstrap over the runs behind them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipelines.courses.following import STRIDE_S, Track
from pipelines.courses.results import Breakaway, CourseFigures, DelayFigures, Interval
from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.classify.breakaway import breakaways
from terrain.records import Array, Windows

N_BOOTSTRAP = 2000
LEAST_FOUND = 1
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
"""Counts of a stretch on one ground; flips are changes of the reported terrain less the true one."""


class Stretches(NamedTuple):
    """Counts (m, columns) of every stretch on one ground, its delay (m,), run (m,) and terrain (m,).

    A delay is NaN where the ground did not change before, and infinite where the change was never found.
    """

    counts: Array
    delay_s: Array
    run: Array
    terrain: Array


def judge(tracks: Sequence[Track], seed: int) -> CourseFigures | None:
    """Return the figures of courses; None where there is none.

    Parameters
    ----------
    tracks : what was reported along each
    seed : of the bootstrap
    """
    if not tracks:
        return None
    found = [_stretches(track) for track in tracks]
    stretches = Stretches(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    sums = {name: stretches.counts[:, i].sum() for i, name in enumerate(COLUMNS)}
    draws = _draws(stretches, np.random.default_rng(seed))

    def ratio(above: str, below: str, minus: str | None = None, per: float = 1.0) -> tuple[float, Interval]:
        columns = [COLUMNS.index(name) for name in (above, below)]
        drawn_above, drawn_below = (draws @ stretches.counts[:, column] for column in columns)
        value = sums[above]
        if minus is not None:
            value = value - sums[minus]
            drawn_above = drawn_above - draws @ stretches.counts[:, COLUMNS.index(minus)]
        if sums[below] == 0.0:
            return float("nan"), (float("nan"), float("nan"))
        with np.errstate(invalid="ignore", divide="ignore"):
            return float(value / sums[below] * per), percentile_interval(drawn_above / drawn_below * per)

    a_minute = 60.0 / STRIDE_S
    filtered, filtered_ci = ratio("filtered", "whole")
    single, single_ci = ratio("single", "whole")
    gain, gain_ci = ratio("filtered", "whole", "single")
    filtered_at_end, filtered_at_end_ci = ratio("filtered_all", "all")
    single_at_end, single_at_end_ci = ratio("single_all", "all")
    flips, flips_ci = ratio("flips", "all", per=a_minute)
    single_flips, single_flips_ci = ratio("single_flips", "all", per=a_minute)
    return CourseFigures(
        filtered_accuracy=filtered,
        filtered_accuracy_ci=filtered_ci,
        single_accuracy=single,
        single_accuracy_ci=single_ci,
        gain=gain,
        gain_ci=gain_ci,
        filtered_accuracy_at_end=filtered_at_end,
        filtered_accuracy_at_end_ci=filtered_at_end_ci,
        single_accuracy_at_end=single_at_end,
        single_accuracy_at_end_ci=single_at_end_ci,
        filter_delay_s=_delays(stretches, draws),
        flips_per_minute=flips,
        flips_per_minute_ci=flips_ci,
        single_flips_per_minute=single_flips,
        single_flips_per_minute_ci=single_flips_ci,
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


def _changes(reported: Array) -> Array:
    """Return where another terrain is reported than before; "unknown" between the two is no change."""
    changed = np.zeros(len(reported), dtype=bool)
    known = np.flatnonzero(reported >= 0)
    changed[known[1:]] = np.diff(reported[known]) != 0
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
    if len(found) < LEAST_FOUND:
        nothing = float("nan"), float("nan")
        return DelayFigures(float("nan"), nothing, float("nan"), nothing, n_changes, n_missed, None)
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


def find_breakaways(probability: Array, classes: Array, windows: Windows) -> tuple[Breakaway, ...]:
    """Return the stretches of runs that break away from them, the most probable first.

    Parameters
    ----------
    probability : (n, k) held-out class probabilities of labelled windows
    classes : (k,) their names
    windows : n of them
    """
    run_id, terrain = windows.run_id.astype(str), windows.terrain.astype(str)
    found = []
    for run in np.unique(run_id):
        for label in np.unique(terrain[run_id == run]):
            rows = np.flatnonzero((run_id == run) & (terrain == label))
            rows = rows[np.argsort(windows.start_s[rows], kind="stable")]
            column = int(np.searchsorted(classes, label))
            for each in breakaways(probability[rows], column, windows.start_s[rows], windows.length_s):
                looks_like = str(classes[each.looks_like])
                found.append(Breakaway(str(run), each.start_s, each.end_s, str(label), looks_like, *each[3:]))
    return tuple(sorted(found, key=lambda each: -each.probability * (each.end_s - each.start_s)))
