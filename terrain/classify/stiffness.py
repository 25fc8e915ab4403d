"""Terrains by stiffness: levels, the cost of confusing soft with hard, clusters of runs, and figures by level.

The AgriMaRo thesis (8.1) groups terrains "primarily on the level of stiffness or deformability": compact and
paved surfaces are the low-difficulty extreme, yielding ones the other.  A wrong class within a level costs
little, as the slip to aim for is alike; hard taken for soft, or soft for hard, costs most::

    C_ij = 0                                                  i = j
    C_ij = w + (1 - w) |l_i - l_j| / (HARD - SOFT)            i != j

with the level l of each class and w = :data:`WITHIN_LEVEL_COST`.  The decision of least expected cost under
the probabilities p is ``argmin_j sum_i p_i C_ij`` (Duda, Hart and Stork, Pattern Classification, 2.2).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.classify.held_out import HeldOut
from terrain.classify.metrics import NO_INTERVAL, Interval, run_bootstrap, runs_by_terrain
from terrain.errors import DataError
from terrain.records import Array

#: Cost of a wrong class of the right level, where soft taken for hard costs 1; chosen, not measured: the slip to aim
#: for differs less within a level than between levels, and is not the same.
WITHIN_LEVEL_COST = 0.25
MAX_CLUSTERS = 6  #: More clusters are not tried: with 50 runs each would have eight.
#: Fewer runs are not clustered: two clusters and their covariance have more numbers than these.
MIN_RUNS = 8
#: Principal components in which runs are clustered, at most, one for each four runs; so much of the variance they have
#: to explain: what is left is mostly noise of single features.
N_COMPONENTS, EXPLAINED_RATIO = 5, 0.8
N_STARTS = 10  #: Starts of the mixture model, of which the most likely result is kept.
#: Added to the variance of a cluster, so that two runs alike are no cluster of infinite density.
MIN_VARIANCE = 1e-3
CLIP_STD = 5.0  #: Scaled values are clipped here, so that one run is not a cluster because of one feature.
N_BOOTSTRAP = 1000


class StiffnessLevel(IntEnum):
    """How a terrain carries a wheel.

    ``SOFT``: it sinks in; ``FIRM``: it is carried, and the top layer yields; ``HARD``: nothing yields.
    """

    SOFT = 0
    FIRM = 1
    HARD = 2


def cost_matrix(levels: Sequence[int], within: float = WITHIN_LEVEL_COST) -> Array:
    """Return the cost (k, k) of predicting the class of a column where that of the row is true, from their levels.

    Examples
    --------
    >>> cost_matrix([StiffnessLevel.SOFT, StiffnessLevel.FIRM, StiffnessLevel.HARD, StiffnessLevel.HARD], 0.2)
    array([[0. , 0.6, 1. , 1. ],
           [0.6, 0. , 0.6, 0.6],
           [1. , 0.6, 0. , 0.2],
           [1. , 0.6, 0.2, 0. ]])
    """
    level = np.asarray(levels, dtype=float)
    largest = float(StiffnessLevel.HARD - StiffnessLevel.SOFT)
    cost: Array = within + (1 - within) * np.abs(level[:, None] - level[None, :]) / largest
    np.fill_diagonal(cost, 0.0)
    return cost


def least_cost_class(probability: Array, cost: Array) -> Array:
    """Return the column (n,) of least expected cost (k, k); of equal ones that of the highest probability (n, k).

    Examples
    --------
    >>> cost = cost_matrix([StiffnessLevel.SOFT, StiffnessLevel.HARD, StiffnessLevel.HARD])
    >>> least_cost_class(np.array([[0.4, 0.3, 0.3], [0.9, 0.1, 0.0]]), cost)
    array([1, 0])
    """
    expected = probability @ cost
    best = expected.min(axis=1, keepdims=True)
    candidates = np.where(expected <= best + 1e-12, probability, -1.0)
    return np.asarray(candidates.argmax(axis=1))


def cluster_runs(
    values: Array, speed_mps: Array, seed: int, n_clusters: int | None = None
) -> tuple[Array, Array]:
    """Cluster runs by what they have in common beside their speed.

    Each value is scaled over the runs and freed of its linear dependence on the logarithm of the speed, as
    vibration and current grow with speed on any terrain.  Gaussian mixtures of one covariance are fitted to
    the first principal components; their number is that of the smallest Bayesian information criterion
    (Schwarz 1978).

    Parameters
    ----------
    values : (n_runs, f) features of each run, as medians over its windows; NaN where not defined
    speed_mps : (n_runs,) typical speed of each run; NaN where unknown
    seed, n_clusters : of the starts; a fixed number, by the criterion where None

    Returns
    -------
    cluster : (n_runs,) number of the cluster of each run, from 0
    bic : (k,) the criterion with 1, 2, ... clusters; the smallest is best

    Raises
    ------
    DataError
        if there are fewer than :data:`MIN_RUNS` runs, or no value differs between them.
    """
    from sklearn.decomposition import PCA
    from sklearn.mixture import GaussianMixture

    n_runs = len(values)
    if n_runs < MIN_RUNS:
        raise DataError(f"{n_runs} runs are too few to be clustered; at least {MIN_RUNS} are needed")
    scaled = values[:, np.isfinite(values).all(axis=0)]
    scaled = scaled[:, scaled.std(axis=0) > 0]
    if not scaled.size:
        raise DataError("no feature differs between the runs: they cannot be clustered")
    scaled = np.clip((scaled - scaled.mean(axis=0)) / scaled.std(axis=0), -CLIP_STD, CLIP_STD)
    pca = PCA(min(N_COMPONENTS, max(n_runs // 4, 1), scaled.shape[1]), svd_solver="full")
    if (np.isfinite(speed_mps) & (speed_mps > 0)).all() and np.ptp(speed_mps) > 0:
        line = np.column_stack([np.ones(n_runs), np.log(speed_mps)])
        scaled = scaled - line @ np.linalg.lstsq(line, scaled, rcond=None)[0]
    reduced = pca.fit_transform(scaled)
    explained = np.cumsum(pca.explained_variance_ratio_)
    reduced = reduced[:, : 1 + int(np.sum(explained < EXPLAINED_RATIO))]
    numbers = range(1, min(MAX_CLUSTERS, n_runs - 1) + 1) if n_clusters is None else (n_clusters,)
    settings = {
        "covariance_type": "tied",
        "n_init": N_STARTS,
        "reg_covar": MIN_VARIANCE,
        "random_state": seed,
    }
    mixtures = [GaussianMixture(number, **settings).fit(reduced) for number in numbers]
    bic = np.array([float(mixture.bic(reduced)) for mixture in mixtures])
    return np.asarray(mixtures[int(bic.argmin())].predict(reduced)), bic


def agreement(one: Array, other: Array, rng: np.random.Generator) -> tuple[float, Interval]:
    """Return the adjusted Rand index of two groupings, 1 the same, 0 as by chance, and its 95 % interval over runs.

    Source: Hubert and Arabie (1985).  A bootstrap over runs repeats runs, which always agree with themselves, so its
    index is taken over pairs of *different* runs only.
    """
    first, second = (np.unique(each, return_inverse=True)[1] for each in (one, other))
    n = len(first)
    same_one, same_other = first[:, None] == first[None, :], second[:, None] == second[None, :]

    def index(weight: Array) -> float:
        pairs = np.outer(weight, weight)
        np.fill_diagonal(pairs, 0.0)
        total = pairs.sum()
        in_one, in_other = (pairs * same_one).sum(), (pairs * same_other).sum()
        both = (pairs * (same_one & same_other)).sum()
        by_chance = in_one * in_other / total if total else 0.0
        most = (in_one + in_other) / 2
        return float((both - by_chance) / (most - by_chance)) if most > by_chance else float("nan")

    rows = bootstrap_rows(n, N_BOOTSTRAP, rng)
    draws = np.array([index(np.bincount(each, minlength=n).astype(float)) for each in rows])
    return index(np.ones(n)), percentile_interval(draws) if np.isfinite(draws).any() else NO_INTERVAL


class LevelClusters(NamedTuple):
    """Clusters of runs without labels, and how far they agree with the stiffness levels, and with the terrains.

    Agreement is 1 where they are the same, 0 as by chance; the interval is of 95 % over runs.
    """

    n_clusters: int
    adjusted_rand: float
    interval: Interval
    adjusted_rand_of_classes: float


class StiffnessFigures(NamedTuple):
    """Accuracy by stiffness level and the cost of confusing levels, all with 95 % intervals over runs."""

    levels: Mapping[str, str]  #: of each class
    accuracy: float  #: accuracy, accuracy_ci: of the level, whichever the class
    accuracy_ci: Interval
    cost: float  #: cost, cost_ci: mean cost a window of the most probable class
    cost_ci: Interval
    least_cost: float  #: least_cost, least_cost_ci: mean cost of the class of least expected cost
    least_cost_ci: Interval
    gain: float  #: gain, gain_ci: the first less the second, run by run
    gain_ci: Interval
    least_cost_accuracy: float  #: accuracy of the class of least expected cost
    #: windows of which soft was taken for hard or hard for soft, by the most probable class
    soft_hard_ratio: float
    clusters: LevelClusters | None  #: None where there are too few runs


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
    held_out, run_id : of windows that took no part in training, repeat by repeat, and their runs (n,)
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
    runs = runs_by_terrain(run_id, terrain)

    def over_runs(values: Array) -> tuple[float, Interval]:
        interval = run_bootstrap(values.mean(axis=0), runs, terrain, np.random.default_rng(seed))
        return float(values.mean()), interval

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
        cluster, bic = cluster_runs(values, np.array([speed_mps[run] for run in runs]), seed)
    except DataError:
        return None
    agreed = []
    for of_window in groupings:
        groups = [np.unique(of_window[run_id == run], return_counts=True) for run in runs]
        most = np.array([str(names[counts.argmax()]) for names, counts in groups])
        agreed.append(agreement(cluster, most, np.random.default_rng(seed)))
    (by_level, interval), (by_class, _) = agreed
    return LevelClusters(int(bic.argmin()) + 1, by_level, interval, by_class)
