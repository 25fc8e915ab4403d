"""How well held-out windows are classified by stiffness level, and whether clusters of runs are these levels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.classify.held_out import HeldOut
from terrain.classify.metrics import run_bootstrap, runs_by_terrain
from terrain.classify.stiffness import StiffnessLevel, agreement, cluster_runs, cost_matrix, least_cost_class
from terrain.errors import DataError
from terrain.records import Array


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
    held_out: HeldOut,
    run_id: Array,
    known: Mapping[str, StiffnessLevel],
    features: Array,
    run_speed_mps: Mapping[str, float],
    seed: int,
) -> StiffnessFigures | None:
    """Return the figures; None where the level of a class is not known, or all classes have the same.

    Parameters
    ----------
    held_out : probabilities of windows that took no part in training, repeat by repeat
    run_id : (n,) run of each window
    known : level of terrains by name
    features, run_speed_mps : (n, f) of the windows and typical speed of each run, for the clusters
    seed : of the intervals and the clusters
    """
    names = [str(name) for name in held_out.classes]
    if any(name not in known for name in names) or len({known[name] for name in names}) < 2:
        return None
    levels = np.array([int(known[name]) for name in names])
    cost, terrain = cost_matrix(levels.tolist()), held_out.truth
    true = np.searchsorted(held_out.classes, terrain)
    most = held_out.probability.argmax(axis=2)
    least = np.stack([least_cost_class(each, cost) for each in held_out.probability])

    def over_runs(values: Array) -> tuple[float, tuple[float, float]]:
        rng, runs = np.random.default_rng(seed), runs_by_terrain(run_id, terrain)
        return float(values.mean()), run_bootstrap(values.mean(axis=0), runs, terrain, rng)

    apart = np.abs(levels[true][None, :] - levels[most]) == StiffnessLevel.HARD - StiffnessLevel.SOFT
    return StiffnessFigures(
        {name: known[name].name for name in names},
        *over_runs(levels[most] == levels[true]),
        *over_runs(cost[true, most]),
        *over_runs(cost[true, least]),
        *over_runs(cost[true, most] - cost[true, least]),
        least_cost_accuracy=float(np.mean(least == true)),
        soft_hard_ratio=float(apart.mean()),
        clusters=_level_clusters(features, run_id, (levels[true], terrain), run_speed_mps, seed),
    )


def _level_clusters(
    features: Array, run_id: Array, groupings: Sequence[Array], speed_mps: Mapping[str, float], seed: int
) -> LevelClusters | None:
    """Cluster runs by the medians of their windows; a run over several groups has that of most windows."""
    runs = np.unique(run_id)
    values = np.full((len(runs), features.shape[1]), np.nan)
    for row, run in zip(values, runs, strict=True):
        known = np.isfinite(features[run_id == run]).any(axis=0)
        row[known] = np.nanmedian(features[run_id == run][:, known], axis=0)
    try:
        found = cluster_runs(values, np.array([speed_mps[run] for run in runs]), seed)
    except DataError:
        return None
    agreed = []
    for of_window in groupings:
        most = []
        for run in runs:
            names, counts = np.unique(of_window[run_id == run], return_counts=True)
            most.append(str(names[counts.argmax()]))
        agreed.append(agreement(found.cluster, np.array(most), np.random.default_rng(seed)))
    by_level, by_class = agreed
    return LevelClusters(found.n_clusters, by_level.adjusted_rand, by_level.interval, by_class.adjusted_rand)
