"""Costs of confusing stiffness levels are laws, and soils are ordered as the thesis orders them."""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from terrain.terramechanics.soil import load_soil, soil_names

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "papers"))

from stiffness import StiffnessLevel, cost_matrix, least_cost_class, response_of

SOFT, FIRM, HARD = StiffnessLevel


@pytest.mark.parametrize("within", [0.0, 0.25, 1.0])
def test_costs_grow_with_the_distance_in_stiffness(within):
    cost = cost_matrix([SOFT, SOFT, FIRM, HARD], within)
    assert np.array_equal(cost, cost.T)
    assert np.all(np.diag(cost) == 0)
    assert within == cost[0, 1] <= cost[0, 2] <= cost[0, 3] == 1.0


def test_the_decision_of_least_cost_has_the_least_cost_of_all_decisions():
    probability = np.random.default_rng(0).dirichlet([0.5] * 4, size=200)
    cost = cost_matrix([SOFT, FIRM, HARD, HARD])
    chosen = least_cost_class(probability, cost)
    for p, column in zip(probability, chosen, strict=True):
        expected = [sum(p[i] * cost[i, j] for i in range(4)) for j in range(4)]
        assert expected[column] == pytest.approx(min(expected))
    assert np.any(chosen != probability.argmax(axis=1))


def test_harder_levels_are_less_difficult_only_soft_ground_sinks_and_sand_is_the_most_difficult():
    found = {name: response_of(load_soil(name), 294.3, 0.2, 0.1, 0.12) for name in soil_names()}
    order = sorted(found, key=lambda name: found[name].difficulty_ratio)
    assert (order[:2], order[-1]) == (["tiles", "asphalt"], "dry_sand")
    by_level = [
        [each.difficulty_ratio for each in found.values() if each.level is level] for level in StiffnessLevel
    ]
    for softer, harder in pairwise(by_level):
        assert min(softer) > max(harder)
    assert all((each.sinkage_m > 0) == (each.level is SOFT) for each in found.values())
