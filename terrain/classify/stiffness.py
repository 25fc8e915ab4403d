"""Terrains by stiffness: levels, the cost of confusing soft with hard, and figures by level.

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

from terrain.classify.held_out import HeldOut
from terrain.classify.metrics import Interval, run_bootstrap, runs_by_terrain
from terrain.records import Array

#: Cost of a wrong class of the right level, where soft taken for hard costs 1; chosen, not measured: the slip to aim
#: for differs less within a level than between levels, and is not the same.
WITHIN_LEVEL_COST = 0.25


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


def stiffness_figures(
    held_out: HeldOut,
    run_id: Array,
    known: Mapping[str, StiffnessLevel],
    seed: int,
) -> StiffnessFigures | None:
    """Return the figures; None where the level of a class is not known, or all classes have the same.

    Parameters
    ----------
    held_out, run_id : of windows that took no part in training, repeat by repeat, and their runs (n,)
    known : level of terrains by name
    seed : of the intervals
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
    )
