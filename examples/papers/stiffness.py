"""Stiffness of grounds: levels, how difficult a ground is by its soil's numbers, and the cost of confusing levels.

The AgriMaRo thesis (8.1) groups terrains "primarily on the level of stiffness or deformability": compact and
paved surfaces are the low-difficulty extreme, yielding ones the other::

    level = HARD   a road law of traction: nothing yields
            FIRM   ground that shears under the wheel and carries it
            SOFT   ground that sinks by Bekker's pressure-sinkage law

    difficulty = R / (P + R)     R resistance at no slip, P largest net pull: the part of the wheel's largest
                                 thrust that its own resistance takes; 0 none, 1 the wheel is stuck

A wrong class within a level costs little, as the slip to aim for is alike; hard taken for soft, or soft for
hard, costs most::

    C_ij = 0                                                  i = j
    C_ij = w + (1 - w) |l_i - l_j| / (HARD - SOFT)            i != j

with the level l of each class and w = :data:`WITHIN_LEVEL_COST`.  The decision of least expected cost under
the probabilities p is ``argmin_j sum_i p_i C_ij`` (Duda, Hart and Stork, Pattern Classification, 2.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from terrain.records import Array
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import ground_record, net_pull, wheel_ground

#: Cost of a wrong class of the right level, where soft taken for hard costs 1; chosen, not measured: the slip to aim
#: for differs less within a level than between levels, and is not the same.
WITHIN_LEVEL_COST = 0.25
N_SLIPS = 100  #: Slips from 0 to 0.99 among which the largest net pull is found


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


class GroundResponse(NamedTuple):
    """What a ground does under a wheel."""

    level: StiffnessLevel  #: by which :func:`response_of` orders grounds first
    sinkage_m: float  #: of the wheel that rolls without slip
    difficulty_ratio: float  #: resistance over the largest thrust


def stiffness_level(soil: Soil) -> StiffnessLevel:
    """Return the level of a described soil.

    Examples
    --------
    >>> [stiffness_level(load_soil(name)).name for name in ("asphalt", "grass", "clay")]
    ['HARD', 'FIRM', 'SOFT']
    """
    if soil.law == "magic":
        return StiffnessLevel.HARD
    return StiffnessLevel.FIRM if math.isnan(soil.kphi_npmn2) else StiffnessLevel.SOFT


def response_of(
    soil: Soil, normal_n: float, wheel_radius_m: float, tyre_width_m: float, contact_length_m: float
) -> GroundResponse:
    """Return how a soil yields under a wheel.

    Parameters
    ----------
    soil : the ground
    normal_n : load of the wheel, above 0
    wheel_radius_m, tyre_width_m, contact_length_m : as for :func:`~terrain.terramechanics.traction.net_pull`

    Examples
    --------
    >>> found = response_of(load_soil("clay"), 294.3, 0.2, 0.1, 0.12)
    >>> found.level.name, round(found.sinkage_m, 4), round(found.difficulty_ratio, 2)
    ('SOFT', 0.0068, 0.34)
    """
    geometry = wheel_radius_m, tyre_width_m, contact_length_m
    _, _, resistance_n, sinkage_m = wheel_ground(ground_record(soil, *geometry)[0], float(normal_n), 0.0, 0.0)
    pull_n = float(net_pull(soil, normal_n, np.linspace(0.0, 0.99, N_SLIPS), *geometry).max())
    difficulty = min(resistance_n / (pull_n + resistance_n), 1.0) if pull_n > -resistance_n else 1.0
    return GroundResponse(stiffness_level(soil), float(sinkage_m), float(difficulty))
