"""Costs of confusing stiffness levels are laws, and figures by level are those of counting."""

import numpy as np
import pytest

from terrain.classify.held_out import HeldOut
from terrain.classify.stiffness import (
    StiffnessLevel,
    cost_matrix,
    least_cost_class,
    stiffness_figures,
)

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


KNOWN = {"asphalt": HARD, "concrete": HARD, "snow": SOFT}


def figures_of(terrain, predicted, certainty=1.0, known=KNOWN):
    """Return the figures of windows of runs of ten, of which ``certainty`` is put on the predicted class."""
    classes = np.unique(terrain)
    probability = np.full((len(terrain), len(classes)), (1 - certainty) / (len(classes) - 1))
    probability[np.arange(len(terrain)), np.searchsorted(classes, predicted)] = certainty
    run_id = np.repeat(np.arange(len(terrain) // 10), 10).astype(str)
    held_out = HeldOut.of_model(classes, probability, terrain)
    return stiffness_figures(held_out, run_id, known, 0)


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
    assert apart.levels == {"asphalt": "HARD", "concrete": "HARD", "snow": "SOFT"}
