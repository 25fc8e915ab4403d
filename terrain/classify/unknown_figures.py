"""How well a terrain that was never learned is found to be unknown.

Each terrain is left out in turn: a novelty score is fitted on training runs of the others, and compares their
held-out runs with all runs of the terrain that was left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.classify.folds import block_groups, split_runs
from terrain.classify.metrics import N_BOOTSTRAP
from terrain.classify.novelty import KNOWN_KEPT, learn_novelty
from terrain.errors import DataError
from terrain.records import Array

MEAN_SPAN_S = 10.0
"""Novelty scores are averaged over so long: a robot crosses a terrain for longer."""


MIN_TERRAINS = 3
"""Two are needed to train without the third."""


class LeftOutTerrain(NamedTuple):
    """How well the windows of a terrain that was left out differ in score from held-out ones of others.

    Parameters
    ----------
    auroc, auroc_10s : area under the ROC curve of single windows, and of means over 10 s
    accepted : part of its windows that are taken for a known terrain
    known_kept : part of the held-out windows of the other terrains that are not called unknown
    """

    auroc: float
    auroc_10s: float
    accepted: float
    known_kept: float


class UnknownTerrain(NamedTuple):
    """Leave-one-terrain-out: means over the terrains, intervals by bootstrap over runs, and each terrain.

    The threshold of the score keeps ``known_kept_target`` of the known windows of inner held-out runs.
    """

    auroc_unknown: float
    auroc_unknown_ci: tuple[float, float]
    auroc_unknown_10s: float
    auroc_unknown_10s_ci: tuple[float, float]
    unknown_accepted: float
    known_kept: float
    known_kept_target: float
    unknown_by_terrain: Mapping[str, LeftOutTerrain]


class Scored(NamedTuple):
    """Scores of held-out known rows and of all unknown rows by one fold, and the fold's threshold."""

    known: Array
    unknown: Array
    known_scores: Array
    unknown_scores: Array
    threshold: float


def left_out_folds(
    terrain: Array, run_id: Array, n_folds: int, gap: int, seed: int
) -> list[tuple[Array, Array, Array]]:
    """Return training rows, held-out rows and rows of the terrain that is left out, terrain by terrain.

    Parameters
    ----------
    terrain, run_id : (n,) class and run of each window
    n_folds, gap, seed : as :func:`~terrain.classify.folds.split_runs`

    Raises
    ------
    DataError
        if there are fewer than three terrains, or too few runs.
    """
    y, terrains = terrain, np.unique(terrain)
    if len(terrains) < MIN_TERRAINS:
        raise DataError(
            f"the runs are of {len(terrains)} terrains ({', '.join(terrains)}): "
            f"at least {MIN_TERRAINS} are needed to leave one out"
        )
    folds = []
    for name in terrains:
        rows, unknown = np.flatnonzero(y != name), np.flatnonzero(y == name)
        n_groups = len(np.unique(block_groups(y[rows], run_id[rows], n_folds).astype(str)))
        if n_groups < n_folds:
            raise DataError(f"{n_groups} runs without {name} are fewer than {n_folds} folds")
        rng = np.random.default_rng((seed, 0))
        for train, test in split_runs(y[rows], run_id[rows], n_folds, rng, gap):
            if len(test):
                folds.append((rows[train], rows[test], unknown))
    return folds


def score_fold(
    X: Array, y: Array, group: Array, gap: int, seed: int, train: Array, test: Array, unknown: Array
) -> Scored:
    """Return the novelty of held-out and of unknown rows, by a score that is fitted on training rows."""
    fitted = learn_novelty(X[train], y[train], group[train], gap=gap, seed=seed)
    return Scored(test, unknown, fitted.score(X[test]), fitted.score(X[unknown]), fitted.threshold)


def unknown_figures(
    scored: Sequence[Scored], terrain: Array, run_id: Array, start_s: Array, seed: int
) -> UnknownTerrain:
    """Return the figures of terrains that were left out in turn.

    Parameters
    ----------
    scored : of each fold
    terrain, run_id, start_s : (n,) class, run and start of each window
    seed : draws runs for the intervals
    """
    y, group, terrains = terrain, run_id, np.unique(terrain)
    of_terrain = {str(name): [each for each in scored if y[each.unknown[0]] == name] for name in terrains}
    names, run_of = np.unique(np.char.add(np.char.add(group, " "), y), return_inverse=True)
    weights = np.zeros((N_BOOTSTRAP, len(names)))
    for number, terrain in enumerate(terrains):  # how often each run is drawn, terrain by terrain
        runs = np.unique(run_of[y == terrain])
        weights[:, runs] = bootstrap_counts(len(runs), N_BOOTSTRAP, seed + number)
    windows = [_compare(parts, run_of) for parts in of_terrain.values()]
    spans = [_compare([_span_means(s, run_of, start_s) for s in p], run_of) for p in of_terrain.values()]
    rows_of = {
        name: LeftOutTerrain(
            float(window[0].sum() / window[1].sum()),
            float(span[0].sum() / span[1].sum()),
            _accepted([(part.unknown_scores, part.threshold) for part in parts]),
            _accepted([(part.known_scores, part.threshold) for part in parts]),
        )
        for (name, parts), window, span in zip(of_terrain.items(), windows, spans, strict=True)
    }
    return UnknownTerrain(
        float(np.mean([row.auroc for row in rows_of.values()])),
        _interval(windows, weights),
        float(np.mean([row.auroc_10s for row in rows_of.values()])),
        _interval(spans, weights),
        float(np.mean([row.accepted for row in rows_of.values()])),
        float(np.mean([row.known_kept for row in rows_of.values()])),
        KNOWN_KEPT,
        rows_of,
    )


def _span_means(scored: Scored, run_of: Array, start_s: Array) -> Scored:
    """Return mean scores of the windows that begin in the same 10 s of a run, at the first of their rows."""
    means = []
    for rows, scores in ((scored.known, scored.known_scores), (scored.unknown, scored.unknown_scores)):
        span = np.stack([run_of[rows], np.floor(start_s[rows] / MEAN_SPAN_S)])
        _, first, which = np.unique(span, axis=1, return_index=True, return_inverse=True)
        means.append((rows[first], np.bincount(which.ravel(), scores) / np.bincount(which.ravel())))
    (known, known_scores), (unknown, unknown_scores) = means
    return Scored(known, unknown, known_scores, unknown_scores, scored.threshold)


def _compare(parts: Sequence[Scored], run_of: Array) -> tuple[Array, Array]:
    """Return, by run of known and unknown windows, how many pairs the unknown one wins, and how many pairs are.

    Pairs are of one fold; ties count one half, NaN as unknown.
    """
    n_runs = int(run_of.max()) + 1
    won, pairs = np.zeros((2, n_runs, n_runs))
    for part in parts:
        known_scores = np.nan_to_num(part.known_scores, nan=np.inf, posinf=np.inf)
        unknown_scores = np.nan_to_num(part.unknown_scores, nan=np.inf, posinf=np.inf)
        known_run, unknown_run = run_of[part.known], run_of[part.unknown]
        for run in np.unique(known_run):
            ordered = np.sort(known_scores[known_run == run])
            below = np.searchsorted(ordered, unknown_scores, "left")
            up_to = np.searchsorted(ordered, unknown_scores, "right")
            won[run] += np.bincount(unknown_run, (below + up_to) / 2.0, n_runs)
            pairs[run] += np.bincount(unknown_run, minlength=n_runs) * len(ordered)
    return won, pairs


def _interval(compared: Sequence[tuple[Array, Array]], weights: Array) -> tuple[float, float]:
    """Return the interval of the mean area over the terrains that were left out."""
    draws = np.zeros(len(weights))
    for won, pairs in compared:
        area = np.einsum("dr,rs,ds->d", weights, won, weights, optimize=True)
        draws += area / np.einsum("dr,rs,ds->d", weights, pairs, weights, optimize=True)
    return percentile_interval(draws / len(compared))


def _accepted(parts: Sequence[tuple[Array, float]]) -> float:
    """Return the part of scores that are within their threshold."""
    return float(np.concatenate([scores <= threshold for scores, threshold in parts]).mean())
