"""How one ground answers: what responses of the wheels to expect at a regime of motion, and their scatter.

Responses are of a wheel (its current, its slip) or of the whole robot (the slip of its body).  Each quantity
is a process over the regime (:mod:`terrain.classify.regime_process`); what is left of all of them together
has one covariance: that of means of runs that were left out, and that of windows within a run.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.classify.regime_process import MAX_POINTS, Process, fit_process, unit_means, units_of
from terrain.records import Array

FLOOR = 1e-3
"""Of a standard deviation, as a share of the response's spread over the ground: a response that repeats
exactly (a counter that never moves) would outweigh all others."""


class GroundResponse(NamedTuple):
    """Responses of one ground.

    Parameters
    ----------
    processes : one for each quantity of a wheel, then one for each of the body
    n_wheels, n_wheel_quantities : responses are ordered by quantity, then wheel; then those of the body
    covariance : (r, r) of a window's responses about the processes
    """

    processes: tuple[Process, ...]
    n_wheels: int
    n_wheel_quantities: int
    covariance: Array

    def expected(self, regime: Array) -> Array:
        """Return the expected responses (n, r) at regimes (n, wheels, c)."""
        columns = []
        for number, process in enumerate(self.processes):
            if number < self.n_wheel_quantities:
                columns += [process.predict(regime[:, i], i) for i in range(self.n_wheels)]
            else:
                columns.append(process.predict(regime[:, 0], 0))
        return np.column_stack(columns)


def fit_ground(
    regime: Array, responses: Array, groups: Array, n_body: int = 0
) -> tuple[GroundResponse, Array]:
    """Return what a ground answers, and the responses (n, r) to expect of each row without its own run.

    Parameters
    ----------
    regime : (n, wheels, c) of windows on this ground
    responses : (n, r) finite, by quantity, then wheel, then ``n_body`` of the whole body
    groups : (n,) run of each window
    """
    n_wheels = regime.shape[1]
    unit = units_of(regime[:, 0], groups)
    kept = _thinned(unit, n_wheels)
    mean_regime, mean_response = unit_means(regime, unit), unit_means(responses, unit)
    run = np.unique(groups.astype(str), return_inverse=True)[1]
    block = np.zeros(unit.max() + 1, dtype=np.int64)
    block[unit] = run
    processes, left = [], np.zeros_like(mean_response)
    n_quantities = (responses.shape[1] - n_body) // n_wheels
    spans = [range(q * n_wheels, (q + 1) * n_wheels) for q in range(n_quantities)]
    spans += [range(i, i + 1) for i in range(n_quantities * n_wheels, responses.shape[1])]
    for span in spans:
        columns = list(span)
        wheels = range(len(columns))
        points = np.concatenate([mean_regime[kept, i] for i in wheels])
        wheel = np.repeat(np.arange(len(columns)), kept.sum())
        values = mean_response[kept][:, columns].T.ravel()
        process, apart = fit_process(points, wheel, values, np.tile(block[kept], len(columns)))
        processes.append(process)
        left[np.ix_(np.flatnonzero(kept), np.array(columns))] = apart.reshape(len(columns), -1).T
        for i, column in zip(wheels, columns, strict=True):
            rest = ~kept
            left[rest, column] = mean_response[rest, column] - process.predict(mean_regime[rest, i], i)
    ground = GroundResponse(tuple(processes), n_wheels, n_quantities, np.eye(responses.shape[1]))
    between = left.T @ left / len(left)
    within = responses - mean_response[unit]
    spread = within.T @ within / max(len(within) - len(left), 1)
    floor = np.diag((FLOOR * np.maximum(responses.std(axis=0), 1e-12)) ** 2)
    return ground._replace(covariance=between + spread + floor), (mean_response - left)[unit]


def _thinned(unit: Array, n_wheels: int) -> Array:
    """Return which units (units,) the processes are fitted to."""
    n = unit.max() + 1
    most = max(MAX_POINTS // n_wheels, 1)
    kept = np.zeros(n, dtype=bool)
    kept[np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))] = True
    return kept
