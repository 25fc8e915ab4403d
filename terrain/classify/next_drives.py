r"""Which drives to record next: what more runs of a terrain in a regime would gain.

The errors that are left fall with the number n of training runs near a window's motion, as

.. math:: e(n) = e_\infty + b (1 + n)^{-c},

fitted to held-out windows of all terrains.  A cell, one terrain in one regime, has an error rate of its own,
which few windows state poorly: it is drawn towards the curve by ``PRIOR_WINDOWS`` windows.  With m runs more,
it falls in the proportion in which the curve does.  Weighted by how much of the driving the cell is expected
to be, this is the accuracy that the runs would gain.  The law is that of the learning curve (e.g. Cortes et
al., Learning Curves: Asymptotic Values and Rate of Convergence, 1994).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from terrain.records import Array

ADDED_RUNS = 2
"""Runs that are asked for: a single one may be unlike the others."""

PRIOR_WINDOWS = 10.0
"""Windows that the curve counts as beside those of a cell; a run in a cell has about so many."""

MIN_COUNTS = 3
"""With fewer different numbers of runs there is no curve; its law has three parameters."""


class Growth(NamedTuple):
    """Errors against the number of training runs: ``floor + scale (1 + n) ** -power``."""

    floor: float
    scale: float
    power: float

    def error(self, n_runs: Array) -> Array:
        """Return the error rate with so many training runs."""
        return np.asarray(self.floor + self.scale * (1.0 + np.asarray(n_runs, dtype=float)) ** -self.power)


class Cells(NamedTuple):
    """Cells of a terrain in a regime, each (cells,).

    Parameters
    ----------
    expected_ratio : of the driving that is expected, what takes place in the cell
    n_windows : held-out windows in the cell
    n_errors : how many of them, mean over repeats, were wrong
    held_out_runs : training runs near them when they were held out, mean
    all_runs : training runs near them with all runs in training
    """

    expected_ratio: Array
    n_windows: Array
    n_errors: Array
    held_out_runs: Array
    all_runs: Array


def fit_growth(n_runs: Array, correct: Array) -> Growth | None:
    """Return how errors fall with the number of training runs; None where the data cannot show it.

    Parameters
    ----------
    n_runs : (n,) training runs near each held-out window
    correct : (n,) whether it was classified correctly

    Examples
    --------
    >>> n_runs = np.repeat([0, 1, 3, 7], 1000)
    >>> right = np.tile(np.arange(1000), 4) >= 1000 * 0.8 / (1 + n_runs)
    >>> fit_growth(n_runs, right).error(np.array([0, 3])).round(2).tolist()
    [0.8, 0.2]
    """
    counts, of = np.unique(n_runs, return_inverse=True)
    if len(counts) < MIN_COUNTS:
        return None
    n = np.bincount(of)
    wrong = 1.0 - np.bincount(of, weights=correct.astype(float)) / n
    weight = np.sqrt(n / n.sum())

    def residual(law: Array) -> Array:
        return np.asarray(weight * (Growth(*law).error(counts) - wrong))

    fit = least_squares(residual, x0=[0.05, 0.5, 0.7], bounds=([0.0, 0.0, 0.05], [1.0, 1.0, 3.0]))
    return Growth(*(float(value) for value in fit.x))


def expected_gain(growth: Growth, cells: Cells, added_runs: int = ADDED_RUNS) -> Array:
    """Return the accuracy that so many more runs in each cell would gain (cells,).

    Examples
    --------
    >>> cells = Cells(*np.array([[0.5, 0.5], [100, 100], [80, 20], [0, 3], [0, 3]]))
    >>> expected_gain(Growth(0.0, 0.8, 1.0), cells, 4).round(3).tolist()
    [0.32, 0.05]
    """
    of_curve = growth.error(cells.held_out_runs)
    error = (cells.n_errors + PRIOR_WINDOWS * of_curve) / (cells.n_windows + PRIOR_WINDOWS)
    fall = growth.error(cells.all_runs) - growth.error(cells.all_runs + added_runs)
    relative = np.divide(fall, of_curve, out=np.zeros_like(fall), where=of_curve > 0)
    return np.asarray(cells.expected_ratio * error * relative)
