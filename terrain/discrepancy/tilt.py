"""How much of the measured tilt is a slope to drive up, and how much a body that rides over bumps.

A tilt that is no slope takes no traction, yet it looks like one to a simulation that is fed with it: then
mass, resistance and slip are all off.  Which it is, the runs of a ground tell: with no more than a share of
the tilt felt as a slope, and everything in the library let go, they fit best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from terrain.discrepancy.information import Information, information_at
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.search import names_of
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import Effect
from terrain.records import Array
from terrain.simulation.planar.model import Ground

SHARES = (0.0, 0.5, 1.0)
"""That are tried; the best lies on the parabola through their losses."""

FELT_LOSS = 20.0
"""A tilt counts as felt throughout, unless a smaller share fits better by that in minus twice the
log-likelihood."""


def with_effective_tilt(
    simulation: Simulation, signals: Sequence[Signals], library: Sequence[Effect]
) -> Simulation:
    """Return the simulation with the share of the tilt that the robot feels on each labelled ground.

    Parameters
    ----------
    simulation : with grounds by label; that of runs without one stays as it is
    signals : of runs
    library : effects that are let go meanwhile
    """
    grounds = dict(simulation.grounds)
    for terrain, ground in simulation.grounds.items():
        runs = [run for run in signals if run.terrain == terrain]
        if runs:
            grounds[terrain] = ground._replace(effective_ratio=_felt(simulation, runs, ground, library))
    return replace(simulation, grounds=grounds)


def _felt(
    simulation: Simulation, runs: Sequence[Signals], ground: Ground, library: Sequence[Effect]
) -> float:
    names, low_pass = names_of(library), low_pass_of(runs)
    losses = []
    for share in SHARES:
        tried = replace(simulation, grounds={runs[0].terrain: ground._replace(effective_ratio=share)})
        losses.append(_loss(information_at(runs, tried, simulation.vector, names, low_pass)))
    share, least = best_of(np.array(losses))
    return share if losses[-1] - least > FELT_LOSS else 1.0


def best_of(losses: Array) -> tuple[float, float]:
    """Return the share, 0 to 1, and the loss at the bottom of the parabola through the losses of SHARES.

    Examples
    --------
    >>> best_of(np.array([1.0, 0.0, 1.0]))[0], best_of(np.array([0.0, 2.0, 8.0]))[0]
    (0.5, 0.0)
    """
    a, b, c = np.polyfit(SHARES, losses, 2)
    bottom = min(max(-b / (2.0 * a), 0.0), 1.0) if a > 0.0 else float(SHARES[int(np.argmin(losses))])
    return round(float(bottom), 3), float(a * bottom**2 + b * bottom + c)


def _loss(info: Information) -> float:
    """Return minus twice the log-likelihood of what the whole library leaves, up to a constant."""
    scale = -np.log(np.abs(info.noise.filters[:, 0]))
    total = 0.0
    for run in info.rows:
        each = np.log(info.noise.size(run.pace_mps)) + scale
        total += 2.0 * float(each[np.isfinite(run.residual) & np.isfinite(each)].sum())
    return total
