"""Checks beside the headline figure, each a further call of :func:`pipelines.learn.evaluate.evaluate`.

Speed alone, slow runs against fast ones, how many runs are enough, the level of stiffness, and whether a
terrain that was left out of training is found to be unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from sklearn.base import clone

from features.extractor import FeatureExtractor
from features.motion import wheel_stream
from pipelines.learn.evaluate import Examples, HeldOut, evaluate
from pipelines.learn.parallel import parallel
from pipelines.learn.protocols import (
    MIN_CLASSES,
    N_FOLDS,
    ClassSpeeds,
    Fold,
    Samples,
    run_speeds,
    slow_fast_split,
)
from pipelines.report import Progress, silent
from terrain.classify.folds import block_groups, split_runs
from terrain.classify.learning_curve import enough_runs
from terrain.classify.metrics import run_bootstrap, runs_by_terrain
from terrain.classify.novelty import NoveltyScore
from terrain.classify.stiffness import (
    MIN_RUNS,
    StiffnessLevel,
    agreement,
    cluster_runs,
    cost_matrix,
    least_cost_class,
)
from terrain.classify.unknown_figures import Scored, UnknownTerrain, unknown_figures
from terrain.errors import DataError
from terrain.records import Array
from terrain.terramechanics.stiffness import known_levels

CURVE_RUNS = (1, 2, 3, 5, 8, 12)
CURVE_DRAWS = 2

MIN_TERRAINS = 3
"""Two are needed to train without the third."""


def speed_only(
    classifier: Any, samples: Samples, folds: Sequence[Fold], n_jobs: int, progress: Progress = silent
) -> float | None:
    """Return the accuracy that features of the wheel speeds alone give; None where no speed is measured."""
    if wheel_stream(samples.windows.channels) is None:
        return None
    features = FeatureExtractor(("wheels",), ("wheels",)).fit_transform(samples.windows)
    examples = Examples(features, samples.terrain, samples.group)
    return evaluate(clone(classifier), examples, folds, n_jobs, "speed only", progress).accuracies[0]


class Applicability(StrEnum):
    """Whether the data allow a comparison."""

    APPLICABLE = "applicable"
    NOT_APPLICABLE = "not applicable"


class SlowFast(NamedTuple):
    """Accuracy when slow runs train and fast runs test, and the reverse; None where not applicable.

    ``left_out`` gives the reason for each class without enough runs on both sides.
    """

    status: Applicability
    classes: Mapping[str, ClassSpeeds]
    left_out: Mapping[str, str]
    slow_to_fast: float | None = None
    fast_to_slow: float | None = None


def slow_fast(
    classifier: Any, features: Array, samples: Samples, n_jobs: int, progress: Progress = silent
) -> SlowFast:
    """Train on the slow runs of each class and test on the fast ones, and the reverse.

    A run that is slow on one class and fast on another is on neither side.
    """
    side, classes, left_out = slow_fast_split(samples)
    if len(classes) < MIN_CLASSES:
        return SlowFast(Applicability.NOT_APPLICABLE, classes, left_out)
    slow, fast = (np.flatnonzero(side == name) for name in ("slow", "fast"))
    folds = [Fold(0, 0, slow, fast), Fold(1, 0, fast, slow)]
    examples = Examples(features, samples.terrain, samples.group)
    found = evaluate(classifier, examples, folds, n_jobs, "slow to fast", progress)
    return SlowFast(Applicability.APPLICABLE, classes, left_out, *found.accuracies)


class LearningCurve(NamedTuple):
    """Accuracy against the number of training runs of each class.

    Parameters
    ----------
    runs_per_class : mean over classes and folds, since a class may have fewer than were asked for
    accuracy : with so many training runs
    accuracy_spread : over draws of runs; None for all runs
    enough_runs : the number of runs beyond which doubling brings next to nothing; None when not reached
    statement : the same in a sentence
    """

    runs_per_class: tuple[float, ...]
    accuracy: tuple[float, ...]
    accuracy_spread: tuple[float | None, ...]
    enough_runs: int | None
    statement: str


def learning_curve(
    classifier: Any,
    examples: Examples,
    folds: Sequence[Fold],
    full_accuracy: float,
    seed: int,
    n_jobs: int,
    progress: Progress = silent,
) -> LearningCurve:
    """Return the accuracy against the number of training runs of each class.

    The test folds stay the same; of the training runs of each class at most m are drawn.

    Parameters
    ----------
    classifier : unfitted, with ``fit(X, y, groups)``
    examples : rows that the folds number
    folds : the folds of one repeat
    full_accuracy : accuracy on these folds with all training runs
    seed : of the draws
    n_jobs : processes at once
    progress : called as folds are done
    """
    y, group = examples.terrain, examples.group.astype(str)
    available = [
        np.array([len(set(group[train][y[train] == name])) for name in np.unique(y[train])])
        for _, _, train, _ in folds
    ]
    sizes = [size for size in CURVE_RUNS if size < max(counts.max() for counts in available)]
    rng = np.random.default_rng((seed, len(CURVE_RUNS)))
    drawn = []
    for number, size in enumerate(sizes):
        for draw in range(CURVE_DRAWS):
            for _, fold, train, test in folds:
                kept = _rows_of_drawn_runs(y[train], group[train], size, rng)
                drawn.append(Fold(CURVE_DRAWS * number + draw, fold, train[kept], test))
    accuracies = np.empty((0, CURVE_DRAWS))
    if drawn:
        spread_over = examples._replace(group=group)
        found = evaluate(classifier, spread_over, drawn, n_jobs, "learning curve", progress)
        accuracies = np.reshape(found.accuracies, (len(sizes), CURVE_DRAWS))
    runs = [float(np.mean([np.minimum(counts, size).mean() for counts in available])) for size in sizes]
    runs.append(float(np.mean([counts.mean() for counts in available])))
    accuracy = [*accuracies.mean(axis=1).tolist(), full_accuracy]
    enough = enough_runs(np.array(runs), np.array(accuracy))
    spread = (*accuracies.std(axis=1, ddof=1).tolist(), None)
    return LearningCurve(tuple(runs), tuple(accuracy), spread, *enough)


def _rows_of_drawn_runs(y: Array, group: Array, size: int, rng: np.random.Generator) -> Array:
    kept = np.zeros(len(y), dtype=bool)
    for terrain in np.unique(y):
        chosen = rng.permutation(np.unique(group[y == terrain]))[:size]
        kept |= np.isin(group, chosen) & (y == terrain)
    return kept


class LevelClusters(NamedTuple):
    """Clusters of runs without labels, and how far they agree with the stiffness levels.

    Parameters
    ----------
    n_clusters : by the Bayesian information criterion
    adjusted_rand, interval : agreement with the levels, 1 the same, 0 by chance; 95 % over runs
    adjusted_rand_of_classes : the same with the terrains in place of their levels
    """

    n_clusters: int
    adjusted_rand: float
    interval: tuple[float, float]
    adjusted_rand_of_classes: float


class StiffnessFigures(NamedTuple):
    """Accuracy by stiffness level and the cost of confusing levels, all with 95 % intervals over runs.

    Parameters
    ----------
    levels : of each class
    accuracy, accuracy_ci : of the level, whichever the class
    cost, cost_ci : mean cost a window of the most probable class
    least_cost, least_cost_ci : mean cost of the class of least expected cost
    gain, gain_ci : the first less the second, run by run
    least_cost_accuracy : accuracy of the class of least expected cost
    soft_hard_ratio : windows of which soft was taken for hard or hard for soft, by the most probable class
    clusters : None where there are too few runs
    """

    levels: Mapping[str, str]
    accuracy: float
    accuracy_ci: tuple[float, float]
    cost: float
    cost_ci: tuple[float, float]
    least_cost: float
    least_cost_ci: tuple[float, float]
    gain: float
    gain_ci: tuple[float, float]
    least_cost_accuracy: float
    soft_hard_ratio: float
    clusters: LevelClusters | None


def stiffness_figures(
    held_out: HeldOut, features: Array, samples: Samples, seed: int
) -> StiffnessFigures | None:
    """Return the figures; None where the level of a class is not known, or all classes have the same.

    Parameters
    ----------
    held_out : probabilities of windows that took no part in training, repeat by repeat
    features : (n, f) of the windows, for the clusters
    samples : the windows
    seed : of the intervals and the clusters
    """
    known = known_levels()
    names = [str(name) for name in held_out.classes]
    if any(name not in known for name in names) or len({known[name] for name in names}) < 2:
        return None
    levels = np.array([int(known[name]) for name in names])
    cost = cost_matrix(levels.tolist())
    terrain = samples.terrain
    run_id = runs_by_terrain(samples.run_id, terrain)
    true = np.searchsorted(held_out.classes, terrain)
    most = held_out.probability.argmax(axis=2)
    least = np.stack([least_cost_class(each, cost) for each in held_out.probability])

    def over_runs(values: Array) -> tuple[float, tuple[float, float]]:
        rng = np.random.default_rng(seed)
        return float(values.mean()), run_bootstrap(values.mean(axis=0), run_id, terrain, rng)

    apart = np.abs(levels[true][None, :] - levels[most]) == StiffnessLevel.HARD - StiffnessLevel.SOFT
    return StiffnessFigures(
        {name: known[name].name for name in names},
        *over_runs(levels[most] == levels[true]),
        *over_runs(cost[true, most]),
        *over_runs(cost[true, least]),
        *over_runs(cost[true, most] - cost[true, least]),
        least_cost_accuracy=float(np.mean(least == true)),
        soft_hard_ratio=float(apart.mean()),
        clusters=_clusters(features, samples, levels[true], seed),
    )


def _clusters(features: Array, samples: Samples, level: Array, seed: int) -> LevelClusters | None:
    """Cluster runs by the medians of their windows; a run over several levels has that of most windows."""
    run_of, speeds = samples.run_id, run_speeds(samples.windows)
    runs = np.unique(run_of)
    if len(runs) < MIN_RUNS:
        return None
    values = np.full((len(runs), features.shape[1]), np.nan)
    for row, run in zip(values, runs, strict=True):
        known = np.isfinite(features[run_of == run]).any(axis=0)
        row[known] = np.nanmedian(features[run_of == run][:, known], axis=0)
    try:
        found = cluster_runs(values, np.array([speeds[run] for run in runs]), seed)
    except DataError:
        return None
    agreed = []
    for of_window in (level, samples.terrain):
        most = []
        for run in runs:
            names, counts = np.unique(of_window[run_of == run], return_counts=True)
            most.append(str(names[counts.argmax()]))
        agreed.append(agreement(found.cluster, np.array(most), np.random.default_rng(seed)))
    by_level, by_class = agreed
    return LevelClusters(found.n_clusters, by_level.adjusted_rand, by_level.interval, by_class.adjusted_rand)


def leave_terrain_out(
    features: Array, samples: Samples, seed: int, n_jobs: int, progress: Progress = silent
) -> UnknownTerrain:
    """Leave out each terrain in turn: a novelty score is fitted on training runs of the others.

    It compares their held-out runs with all runs of the terrain that was left out.

    Parameters
    ----------
    features : (n, f) of the windows
    samples : the windows
    seed : deals runs into folds, and draws runs for the intervals
    n_jobs : processes at once
    progress : called as folds are done

    Raises
    ------
    DataError
        if there are fewer than three terrains, or too few runs.
    """
    y, group = samples.terrain, samples.group.astype(str)
    terrains = np.unique(y)
    if len(terrains) < MIN_TERRAINS:
        raise DataError(
            f"the runs are of {len(terrains)} terrains ({', '.join(terrains)}): "
            f"at least {MIN_TERRAINS} are needed to leave one out"
        )
    folds = []
    for terrain in terrains:
        rows, unknown = np.flatnonzero(y != terrain), np.flatnonzero(y == terrain)
        n_groups = len(np.unique(block_groups(y[rows], group[rows], N_FOLDS).astype(str)))
        if n_groups < N_FOLDS:
            raise DataError(f"{n_groups} runs without {terrain} are fewer than {N_FOLDS} folds")
        rng = np.random.default_rng((seed, 0))
        for train, test in split_runs(y[rows], group[rows], N_FOLDS, rng, samples.gap):
            if len(test):
                folds.append((rows[train], rows[test], unknown))
    of_terrain: dict[str, list[Scored]] = {str(terrain): [] for terrain in terrains}
    shared = (features, y, group, samples.gap, seed)
    progress("leave-terrain-out", 0, len(folds))
    for number, scored in enumerate(parallel(_score, shared, folds, min(n_jobs, len(folds)))):
        of_terrain[str(y[scored.unknown[0]])].append(scored)
        progress("leave-terrain-out", number + 1, len(folds))
    return unknown_figures(of_terrain, y, group, samples.windows.start_s, seed)


def _score(
    X: Array, y: Array, group: Array, gap: int, seed: int, train: Array, test: Array, unknown: Array
) -> Scored:
    fitted = NoveltyScore(gap=gap, seed=seed).fit(X[train], y[train], group[train])
    return Scored(test, unknown, fitted.score(X[test]), fitted.score(X[unknown]), fitted.numbers_.threshold)
