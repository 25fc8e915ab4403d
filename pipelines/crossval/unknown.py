"""Leave one terrain out: how well a terrain that was never learned is found to be unknown.

For each terrain, the runs of the others are dealt into folds; a novelty score is fitted on the training runs
and compares their held-out runs with all runs of the terrain that was left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from joblib import Parallel, delayed

from pipelines.crossval.evaluation import Examples
from pipelines.crossval.results import LeftOutTerrain, UnknownTerrain
from pipelines.crossval.splits import N_FOLDS, Fold, Samples
from pipelines.reporting.progress import Progress, silent
from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.classify.folds import block_groups, split_runs
from terrain.classify.metrics import N_BOOTSTRAP
from terrain.classify.novelty import KNOWN_KEPT, NoveltyScore
from terrain.errors import DataError
from terrain.records import Array

MEAN_SPAN_S = 10.0
"""Scores are averaged over so long: a robot crosses a terrain for longer."""
MIN_TERRAINS = 3
"""Two are needed to train without the third."""


class _Scored(NamedTuple):
    """Scores of held-out known rows and of all unknown rows by one fold, and the fold's threshold."""

    known: Array
    unknown: Array
    known_scores: Array
    unknown_scores: Array
    threshold: float


class _Compared(NamedTuple):
    """By run of known and unknown windows: how many pairs the unknown one wins, and how many pairs are."""

    won: Array
    pairs: Array


def leave_terrain_out(
    examples: Examples, samples: Samples, seed: int, n_jobs: int, progress: Progress = silent
) -> UnknownTerrain:
    """Leave out each terrain in turn.

    Parameters
    ----------
    examples : features, terrain and run of each window
    samples : the windows
    seed : deals runs into folds, and draws runs for the intervals
    n_jobs : processes at once
    progress : called as folds are done

    Raises
    ------
    DataError
        if there are fewer than three terrains, or too few runs.
    """
    X, y, group = examples.features, examples.terrain, np.asarray(examples.group, dtype=str)
    terrains = np.unique(y)
    if len(terrains) < MIN_TERRAINS:
        raise DataError(
            f"the runs are of {len(terrains)} terrains ({', '.join(terrains)}): "
            f"at least {MIN_TERRAINS} are needed to leave one out"
        )
    folds = [
        Fold(number, fold, train, test)
        for number, terrain in enumerate(terrains)
        for fold, (train, test) in enumerate(_known_folds(y, group, terrain, seed, samples.gap))
    ]
    jobs = (
        delayed(_score)(X, y, group, fold, np.flatnonzero(y == terrains[fold.repeat]), samples.gap, seed)
        for fold in folds
    )
    scored: list[_Scored] = []
    progress("leave-terrain-out", 0, len(folds))
    for result in Parallel(n_jobs=max(min(n_jobs, len(folds)), 1), return_as="generator")(jobs):
        scored.append(result)
        progress("leave-terrain-out", len(scored), len(folds))
    of_terrain = [
        [s for s, fold in zip(scored, folds, strict=True) if fold.repeat == number]
        for number in range(len(terrains))
    ]
    names, run_of = np.unique(np.char.add(np.char.add(group, " "), y), return_inverse=True)
    start_s = samples.cut.windows.start_s
    windows = [_compare(parts, run_of, len(names)) for parts in of_terrain]
    spans = [_compare([_span_means(s, run_of, start_s) for s in p], run_of, len(names)) for p in of_terrain]
    weights = _drawn_runs(y, run_of, len(names), seed)
    rows = {
        str(name): LeftOutTerrain(
            _auroc(windows[i]), _auroc(spans[i]), _accepted(parts, known=False), _accepted(parts, known=True)
        )
        for i, (name, parts) in enumerate(zip(terrains, of_terrain, strict=True))
    }
    return UnknownTerrain(
        float(np.mean([row.auroc for row in rows.values()])),
        _interval(windows, weights),
        float(np.mean([row.auroc_10s for row in rows.values()])),
        _interval(spans, weights),
        float(np.mean([row.accepted for row in rows.values()])),
        float(np.mean([row.known_kept for row in rows.values()])),
        KNOWN_KEPT,
        rows,
    )


def _known_folds(y: Array, group: Array, left_out: str, seed: int, gap: int) -> list[tuple[Array, Array]]:
    rows = np.flatnonzero(y != left_out)
    n_groups = len(np.unique(block_groups(y[rows], group[rows], N_FOLDS).astype(str)))
    if n_groups < N_FOLDS:
        raise DataError(f"{n_groups} runs without {left_out} are fewer than {N_FOLDS} folds")
    splits = split_runs(y[rows], group[rows], N_FOLDS, np.random.default_rng((seed, 0)), gap)
    return [(rows[train], rows[test]) for train, test in splits if len(test)]


def _score(X: Array, y: Array, group: Array, fold: Fold, unknown: Array, gap: int, seed: int) -> _Scored:
    train, test = fold.train, fold.test
    fitted = NoveltyScore(gap=gap, seed=seed).fit(X[train], y[train], group[train])
    return _Scored(test, unknown, fitted.score(X[test]), fitted.score(X[unknown]), fitted.numbers_.threshold)


def _span_means(scored: _Scored, run_of: Array, start_s: Array) -> _Scored:
    """Return mean scores of the windows that begin in the same 10 s of a run, at the first of their rows."""
    known, known_scores = _means(scored.known, scored.known_scores, run_of, start_s)
    unknown, unknown_scores = _means(scored.unknown, scored.unknown_scores, run_of, start_s)
    return _Scored(known, unknown, known_scores, unknown_scores, scored.threshold)


def _means(rows: Array, scores: Array, run_of: Array, start_s: Array) -> tuple[Array, Array]:
    span = np.stack([run_of[rows], np.floor(start_s[rows] / MEAN_SPAN_S)])
    _, first, which = np.unique(span, axis=1, return_index=True, return_inverse=True)
    return rows[first], np.bincount(which.ravel(), scores) / np.bincount(which.ravel())


def _compare(parts: Sequence[_Scored], run_of: Array, n_runs: int) -> _Compared:
    """Compare known and unknown windows that one fold scored; ties count one half, NaN as unknown."""
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
    return _Compared(won, pairs)


def _auroc(compared: _Compared) -> float:
    return float(compared.won.sum() / compared.pairs.sum())


def _drawn_runs(y: Array, run_of: Array, n_runs: int, seed: int) -> Array:
    """Return how often each run is drawn in each bootstrap sample (n_draws, n_runs), terrain by terrain."""
    weights = np.zeros((N_BOOTSTRAP, n_runs))
    for number, terrain in enumerate(np.unique(y)):
        runs = np.unique(run_of[y == terrain])
        weights[:, runs] = bootstrap_counts(len(runs), N_BOOTSTRAP, seed + number)
    return weights


def _interval(compared: Sequence[_Compared], weights: Array) -> tuple[float, float]:
    """Return the interval of the mean area over the terrains that were left out."""
    draws = np.zeros(len(weights))
    for won, pairs in compared:
        area = np.einsum("dr,rs,ds->d", weights, won, weights, optimize=True)
        draws += area / np.einsum("dr,rs,ds->d", weights, pairs, weights, optimize=True)
    return percentile_interval(draws / len(compared))


def _accepted(parts: Sequence[_Scored], *, known: bool) -> float:
    """Return the part of the known, or of the unknown, windows whose score is within the threshold."""
    within = [(part.known_scores if known else part.unknown_scores) <= part.threshold for part in parts]
    return float(np.concatenate(within).mean())
