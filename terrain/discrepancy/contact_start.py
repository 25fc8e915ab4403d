"""Where a search starts on omni robots: how rollers resist and how soft the ground is, by a coarse grid.

Steady motion depends on the product of the two, the currents on the friction of the rollers: far from both,
straight lines say neither.  The grid is compared by the profile likelihood of residuals whose noise is not
known, channel by channel, on a few runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np

from terrain.discrepancy.fitting import Problem, names_of
from terrain.discrepancy.information import move_point
from terrain.discrepancy.residuals import rows_of
from terrain.effects import effect_named
from terrain.records import Array

ROLLERS, SOFT = (0.0, 0.05, 0.15, 0.3, 0.5), (0.0, 0.5, 1.5)
"""Friction of the rollers and slip per traction that are tried, beyond what the simulation has: measured
grounds have 0.001 to 0.5 and 0.3 to 2."""

MAX_RUNS = 24
"""Runs that are compared, evenly chosen: of a drive in many directions enough."""

CLEAR_GAIN = 0.1
"""Least gain in the mean logarithm of the square of a channel, over all channels, of a start elsewhere."""


def contact_seeds(problem: Problem) -> Mapping[str, float]:
    """Return the parameters to start from; none of robots without omni wheels, or where none fits better."""
    effects = [effect_named(name) for name in ("roller_friction", "force_slip")]
    if not problem.simulation.planar.omni or not set(effects) <= set(problem.library):
        return {}
    every = max(-(-len(problem.signals) // MAX_RUNS), 1)
    few = problem._replace(signals=problem.signals[::every])
    names = names_of(effects)
    tried = {values: _size_of(few, names, values) for values in product(ROLLERS, SOFT)}
    best = min(tried, key=lambda values: tried[values])
    if tried[0.0, 0.0] - tried[best] < CLEAR_GAIN:
        return {}
    return {name: value for name, value in zip(names, best, strict=True) if value}


def _size_of(problem: Problem, names: tuple[str, ...], values: tuple[float, ...]) -> float:
    """Return the mean logarithm of the residuals' mean square, over channels."""
    vector = move_point(problem.simulation.vector, names, np.array(values))
    parts: list[Array] = []
    for run in problem.signals:
        planar = problem.simulation.planar_on(run.terrain)
        parts.append(rows_of(run, planar, vector, (), problem.low_pass).residual)
    square = np.concatenate(parts) ** 2
    known = np.isfinite(square)
    seen = known.any(axis=0)
    mean = np.where(known, square, 0.0).sum(axis=0)[seen] / known.sum(axis=0)[seen]
    return float(np.log(np.maximum(mean, 1e-30)).mean()) if seen.any() else 0.0
