"""Extra of a cross-validation: how often the stiffness level is right, and what confusing levels costs."""

from __future__ import annotations

import numpy as np

from pipelines.crossval.evaluation import HeldOut
from pipelines.crossval.extras import run_speeds
from pipelines.crossval.results import LevelClusters, StiffnessFigures
from pipelines.crossval.splits import Samples
from terrain.classify.metrics import run_bootstrap, runs_by_terrain
from terrain.classify.stiffness import (
    MIN_RUNS,
    StiffnessLevel,
    agreement,
    cluster_runs,
    cost_matrix,
    least_cost_class,
)
from terrain.errors import DataError
from terrain.records import Array
from terrain.terramechanics.stiffness import known_levels


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
    windows = samples.cut.windows
    terrain = windows.terrain.astype(str)
    run_id = runs_by_terrain(windows.run_id.astype(str), terrain)
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
    windows = samples.cut.windows
    run_of, terrain = windows.run_id.astype(str), windows.terrain.astype(str)
    runs = np.unique(run_of)
    if len(runs) < MIN_RUNS:
        return None
    speeds = run_speeds(windows)
    values = np.stack([_medians(features[run_of == run]) for run in runs])
    try:
        found = cluster_runs(values, np.array([speeds[run] for run in runs]), seed)
    except DataError:
        return None
    levels = np.array([_most_frequent(level[run_of == run]) for run in runs])
    classes = np.array([_most_frequent(terrain[run_of == run]) for run in runs])
    by_level, by_class = (
        agreement(found.cluster, each, np.random.default_rng(seed)) for each in (levels, classes)
    )
    return LevelClusters(found.n_clusters, by_level.adjusted_rand, by_level.interval, by_class.adjusted_rand)


def _medians(features: Array) -> Array:
    known = np.isfinite(features).any(axis=0)
    medians = np.full(features.shape[1], np.nan)
    medians[known] = np.nanmedian(features[:, known], axis=0)
    return medians


def _most_frequent(values: Array) -> str:
    names, counts = np.unique(values, return_counts=True)
    return str(names[counts.argmax()])
