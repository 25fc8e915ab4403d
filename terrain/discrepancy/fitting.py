"""A problem: runs and a simulation; and nonlinear fits of parameters to all of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.evidence import (
    Evidence,
    Nearby,
    Statistics,
    evidence_at,
    loss_of,
    misfit_of,
    move_point,
    nearby,
    recentre,
)
from terrain.discrepancy.residuals import LowPass
from terrain.discrepancy.selection import fit_change
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import INDEX, Effect
from terrain.records import Array

PARAMETER_LOSS = 4.0
"""What a fit has to gain by each of its parameters before it counts as better than one with fewer."""

MAX_HALVINGS, RISE = 4, 0.005
"""How often a step is halved that raises the whitened square by more than that ratio of it; a mass or a lag
raises it by less, with the noise of the wheels that is in the prediction."""

MAX_REFITS, SETTLED = 12, 0.3
"""Most relinearisations of the selected causes, and the ratio of its standard deviation below which a step
ends them."""

RIVAL_REFITS = 3
"""Most relinearisations of a rival."""


class Problem(NamedTuple):
    """Runs, the simulation, and the low-pass of all.

    Parameters
    ----------
    varying : standard deviation from run to run, by parameter, beside the scatter that the simulation has
    """

    signals: tuple[Signals, ...]
    simulation: Simulation
    low_pass: LowPass
    library: tuple[Effect, ...]
    varying: Mapping[str, float] = MappingProxyType({})

    @property
    def scatter(self) -> dict[str, float]:
        """Standard deviation from run to run that is assumed, by parameter."""
        return {**self.simulation.scatter, **self.varying}

    @property
    def parameters(self) -> tuple[str, ...]:
        """Of the library."""
        return tuple(p.name for effect in self.library for p in effect.parameters)

    def at(
        self,
        vector: Array,
        names: Sequence[str] | None = None,
        statistics: Statistics | None = None,
        own: Mapping[str, Array] | None = None,
    ) -> Evidence:
        """Return the information of the runs around a point; see :func:`evidence_at`."""
        desired = self.parameters if names is None else names
        return evidence_at(
            self.signals, self.simulation, vector, desired, self.low_pass, statistics, own, self.scatter
        )

    def near(self, info: Evidence, vector: Array, names: Sequence[str]) -> Nearby:
        """Return the information on a few parameters at another point, with the noise of an information."""
        return nearby(info, self.signals, self.simulation, vector, names, self.low_pass)


class Refit(NamedTuple):
    """A nonlinear fit.

    Parameters
    ----------
    loss : how badly it fits, as minus twice a log-likelihood; see
        :func:`~terrain.discrepancy.evidence.misfit_of`
    square : whitened square that it leaves
    change, std : (k,) of its parameters
    """

    loss: float
    square: float
    change: Array
    std: Array


def names_of(effects: Sequence[Effect]) -> tuple[str, ...]:
    """Return the parameters of effects, each once.

    Examples
    --------
    >>> from terrain.effects import effect_named
    >>> names_of([effect_named("lever_arm")])
    ('lever_x_m', 'lever_y_m')
    """
    return tuple(dict.fromkeys(p.name for effect in effects for p in effect.parameters))


def steps_of(
    problem: Problem, info: Evidence, base: Array, names: Sequence[str], n_most: int
) -> Iterator[Nearby]:
    """Yield the information at the points of a nonlinear fit of parameters, until it converges.

    A step that raises the whitened square is halved, and given up after :data:`MAX_HALVINGS`.
    """
    at = [INDEX[name] for name in names]
    others = np.delete(info.origin - base, at)
    here, loss = info.origin[at] - base[at], np.inf if others.any() else info.origin_loss
    change, _ = fit_change(info, names)
    for _ in range(n_most):
        point = problem.near(info, move_point(base, names, change), names)
        for _ in range(MAX_HALVINGS):
            if point.c <= (1.0 + RISE) * loss:
                break
            change = 0.5 * (here + change)
            point = problem.near(info, move_point(base, names, change), names)
        yield point
        cov = np.linalg.pinv(point.a, hermitian=True)
        here, loss = point.vector[at] - base[at], point.c
        change = here + cov @ point.g
        if (np.abs(change - here) < SETTLED * np.sqrt(np.maximum(np.diag(cov), 1e-30))).all():
            return


def relinearize(problem: Problem, info: Evidence, base: Array, causes: Sequence[Effect]) -> Evidence:
    """Fit, and return the information around the fitted point."""
    point = info.origin if causes else base
    for near in steps_of(problem, info, base, names_of(causes), MAX_REFITS):
        point = near.vector
    return recentre(problem.at(point), base)


def penalised_loss(info: Evidence, causes: Sequence[Effect]) -> float:
    """Return minus twice the log-likelihood of causes, with what each of their parameters has to gain."""
    names = names_of(causes)
    return loss_of(info, names) + PARAMETER_LOSS * len(names)


def fit_again(problem: Problem, info: Evidence, base: Array, names: Sequence[str]) -> Refit:
    """Return the best point of a nonlinear fit of parameters."""
    best: tuple[float, Nearby] | None = None
    for near in steps_of(problem, info, base, names, RIVAL_REFITS):
        misfit = misfit_of(info, near.white_residual)
        if best is None or misfit < best[0]:
            best = misfit, near
    assert best is not None
    misfit, near = best
    at = [INDEX[name] for name in names]
    std = np.sqrt(np.maximum(np.diag(np.linalg.pinv(near.a, hermitian=True)), 0.0))
    return Refit(misfit + PARAMETER_LOSS * len(names), near.c, near.vector[at] - base[at], std)
