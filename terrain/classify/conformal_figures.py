"""How well sets of classes hold the true one, of windows whose runs were held out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.classify.conformal import LEVEL
from terrain.classify.metrics import run_bootstrap
from terrain.records import Array


class ConformalFigures(NamedTuple):
    """What sets of classes hold, of windows whose runs were held out.

    Parameters
    ----------
    level : that they were calibrated for
    coverage, coverage_ci : fraction of windows whose set holds their class, with its 95 % interval over runs
    coverage_per_run : mean over runs of the fraction of their windows, the level's own measure
    coverage_worst_run : least of a run
    set_size : mean number of classes in a set
    single_ratio : fraction of the sets that name one class
    """

    level: float
    coverage: float
    coverage_ci: tuple[float, float]
    coverage_per_run: float
    coverage_worst_run: float
    set_size: float
    single_ratio: float


def conformal_figures(
    member: Array, class_index: Array, run_id: Array, terrain: Array, rng: np.random.Generator
) -> ConformalFigures:
    """Return the figures of sets of classes.

    Parameters
    ----------
    member : (repeats, n, k) whether a class is in the set of a window
    class_index, run_id, terrain : (n,) true class by number, run, and true class by name
    rng : draws runs for the interval

    Examples
    --------
    >>> member = np.array([[[True, False], [True, True], [True, False], [True, False]]])
    >>> found = conformal_figures(member, np.array([0, 1, 1, 0]), np.array(list("aabb")),
    ...                           np.array(["ice", "mud", "mud", "ice"]), np.random.default_rng(0))
    >>> found.coverage, found.coverage_worst_run, found.set_size, found.single_ratio
    (0.75, 0.5, 1.25, 0.75)
    """
    held = member[:, np.arange(len(class_index)), class_index].mean(axis=0)
    _, run_of = np.unique(run_id, return_inverse=True)
    per_run = np.bincount(run_of, weights=held) / np.bincount(run_of)
    sizes = member.sum(axis=2)
    return ConformalFigures(
        LEVEL,
        float(held.mean()),
        run_bootstrap(held, run_id, terrain, rng),
        float(per_run.mean()),
        float(per_run.min()),
        float(sizes.mean()),
        float((sizes == 1).mean()),
    )
