"""Information of the same runs at another point, with the noise and scatter of an information."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.information import Information, freed_information, whiten_run
from terrain.discrepancy.residuals import LowPass, rows_of
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.records import Array


class Nearby(NamedTuple):
    """Information on a few parameters at another point, with the noise and scatter of an information.

    Parameters
    ----------
    vector : the point
    a, g, c : (k, k), (k,) and the constant of the quadratic form of these parameters, all runs together
    white_residual : of each run (rows, channels)
    """

    vector: Array
    a: Array
    g: Array
    c: float
    white_residual: tuple[Array, ...]


def nearby(
    info: Information,
    signals: Sequence[Signals],
    simulation: Simulation,
    vector: Array,
    parameters: Sequence[str],
    low_pass: LowPass,
) -> Nearby:
    """Return the information of the same runs at another point; much faster than computing it anew."""
    planar = {terrain: simulation.planar_on(terrain) for terrain in {run.terrain for run in signals}}
    k, white = len(parameters), []
    total = np.zeros((k + 1, k + 1))
    for run, its_change, inner in zip(signals, info.white_change, info.inner, strict=True):
        rows = rows_of(run, planar[run.terrain], vector, parameters, low_pass)
        residual, change = whiten_run(info.noise, rows)
        nuisances = its_change[info.nuisances].reshape(len(info.nuisances), residual.size)
        both = np.concatenate([change, residual[None]]).reshape(k + 1, -1)
        along = nuisances @ both.T
        total += both @ both.T - along.T @ inner @ along
        white.append(residual)
    return Nearby(vector, total[:k, :k], total[:k, k], float(total[k, k]), tuple(white))


def misfit_of(info: Information, white_residual: Sequence[Array]) -> float:
    """Return by how much the whole library could still reduce residuals (rows, channels) at another point.

    Parameters
    ----------
    info : whose sensitivities and noise are the measure
    white_residual : of each run, whitened by the noise of ``info``

    Notes
    -----
    Up to a constant it is minus twice the log-likelihood there, as far as the problem is linear.  The sum of
    squares itself will not do: the noise of the wheels is in the prediction, and a cause that makes it larger
    or smaller, as a mass does, would be judged by it.
    """
    score = np.zeros(len(info.parameters))
    for residual, change, shift in zip(white_residual, info.white_change, info.shift, strict=True):
        flat = change.reshape(len(change), -1) @ residual.ravel()
        score += flat - shift[:, : len(flat)].T @ flat[info.nuisances]
    return float(score @ np.linalg.solve(freed_information(info), score))
