"""Costs of confusing stiffness levels are laws; clusters of runs without labels find a hidden grouping."""

import numpy as np
import pytest
from sklearn.metrics import adjusted_rand_score

from terrain.classify.held_out import HeldOut
from terrain.classify.stiffness import (
    MIN_RUNS,
    StiffnessLevel,
    agreement,
    cluster_runs,
    cost_matrix,
    least_cost_class,
    stiffness_figures,
)
from terrain.errors import DataError

SOFT, FIRM, HARD = StiffnessLevel


@pytest.mark.parametrize("within", [0.0, 0.25, 1.0])
def test_costs_grow_with_the_distance_in_stiffness(within):
    cost = cost_matrix([SOFT, SOFT, FIRM, HARD], within)
    assert np.array_equal(cost, cost.T)
    assert np.all(np.diag(cost) == 0)
    assert cost[0, 3] == 1.0
    assert within == cost[0, 1] <= cost[0, 2] <= cost[0, 3]


def test_the_decision_of_least_cost_has_the_least_cost_of_all_decisions():
    """Two routes: the vectorised decision, and every decision tried on its own."""
    rng = np.random.default_rng(0)
    probability = rng.dirichlet([0.5] * 4, size=200)
    cost = cost_matrix([SOFT, FIRM, HARD, HARD])
    chosen = least_cost_class(probability, cost)
    for p, column in zip(probability, chosen, strict=True):
        expected = [sum(p[i] * cost[i, j] for i in range(4)) for j in range(4)]
        assert expected[column] == pytest.approx(min(expected))
    assert np.any(chosen != probability.argmax(axis=1))


def hidden_groups(seed, n_runs=30, speed_gain=3.0):
    """Return run features of three groups, on which speed acts more than the group does."""
    rng = np.random.default_rng(seed)
    group = np.arange(n_runs) % 3
    speed = rng.uniform(0.2, 1.2, n_runs)
    values = rng.normal(size=(3, 8))[group] * 2 + 0.25 * rng.normal(size=(n_runs, 8))
    return values + speed_gain * np.log(speed)[:, None], speed, group


@pytest.mark.parametrize("seed", range(3))
def test_groups_behind_a_strong_effect_of_speed_are_found(seed):
    values, speed, group = hidden_groups(seed)
    found, _ = cluster_runs(values, speed, 0)
    assert agreement(found, group, np.random.default_rng(0))[0] > 0.8
    blind, _ = cluster_runs(values, np.full(len(speed), np.nan), 0, n_clusters=3)
    assert agreement(blind, group, np.random.default_rng(0))[0] < 0.8


@pytest.mark.parametrize("seed", range(5))
def test_the_index_is_that_of_the_library(seed):
    rng = np.random.default_rng(seed)
    one, other = rng.integers(4, size=25), rng.integers(3, size=25)
    assert agreement(one, other, rng)[0] == pytest.approx(adjusted_rand_score(one, other))


def test_what_cannot_be_clustered_is_refused():
    with pytest.raises(DataError, match=f"at least {MIN_RUNS} are needed"):
        cluster_runs(np.zeros((MIN_RUNS - 1, 3)), np.ones(MIN_RUNS - 1), 0)
    with pytest.raises(DataError, match="no feature differs"):
        cluster_runs(np.zeros((10, 3)), np.ones(10), 0)
    with pytest.raises(DataError, match="no feature differs"):
        cluster_runs(np.full((10, 3), np.nan), np.ones(10), 0)


KNOWN = {"asphalt": HARD, "concrete": HARD, "snow": SOFT}


def figures_of(terrain, predicted, certainty=1.0, known=KNOWN):
    """Return the figures of windows of runs of ten, of which ``certainty`` is put on the predicted class."""
    classes = np.unique(terrain)
    probability = np.full((len(terrain), len(classes)), (1 - certainty) / (len(classes) - 1))
    probability[np.arange(len(terrain)), np.searchsorted(classes, predicted)] = certainty
    run_id, rng = np.repeat(np.arange(len(terrain) // 10), 10).astype(str), np.random.default_rng(0)
    speeds = dict.fromkeys(run_id, 0.5)
    held_out = HeldOut.of_model(classes, probability, terrain)
    return stiffness_figures(held_out, run_id, known, rng.normal(size=(len(terrain), 6)), speeds, 0)


TERRAIN = np.repeat(["asphalt", "concrete", "snow"], [50, 40, 30])


def test_a_wrong_class_of_the_right_level_costs_little():
    right = figures_of(TERRAIN, TERRAIN)
    assert (right.accuracy, right.cost, right.soft_hard_ratio) == (1.0, 0.0, 0.0)
    within = figures_of(TERRAIN, np.where(TERRAIN == "asphalt", "concrete", TERRAIN))
    assert (within.accuracy, within.cost) == (1.0, pytest.approx(0.25 * 50 / 120))
    apart = figures_of(TERRAIN, np.where(TERRAIN == "asphalt", "snow", TERRAIN))
    assert apart.cost == apart.soft_hard_ratio == pytest.approx(50 / 120)
    assert apart.accuracy == pytest.approx(70 / 120)
    assert apart.cost_ci[0] <= apart.cost <= apart.cost_ci[1]
    assert -1.0 <= apart.clusters.interval[0] <= apart.clusters.interval[1] <= 1.0
    assert apart.levels == {"asphalt": "HARD", "concrete": "HARD", "snow": "SOFT"}
