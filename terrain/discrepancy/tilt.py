"""Which part of the measured tilt is a slope, and which part a body that rides over bumps.

A tilt that is no slope takes no traction; simulated as a slope it biases mass, resistance and slip.  The part
that acts as a slope is estimated for each terrain: the runs fit best with it, all parameters of the library
freed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from terrain.discrepancy.evidence import Evidence, evidence_at
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.search import names_of
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import Effect
from terrain.records import Array
from terrain.simulation.planar.model import Ground

RATIOS = (0.0, 0.5, 1.0)
"""Effective ratios that are tried; the best lies on the parabola through their losses."""

TILT_LOSS = 20.0
"""All of the tilt counts as a slope, unless a smaller part fits better by that in minus twice the
log-likelihood."""


def with_effective_tilt(
    simulation: Simulation, signals: Sequence[Signals], library: Sequence[Effect]
) -> Simulation:
    """Return the simulation with the effective ratio of the tilt on each labelled terrain.

    Parameters
    ----------
    simulation : with terrains by label; that of runs without one stays as it is
    signals : of runs
    library : effects that are freed meanwhile
    """
    grounds = dict(simulation.grounds)
    for terrain, ground in simulation.grounds.items():
        runs = [run for run in signals if run.terrain == terrain]
        if runs:
            grounds[terrain] = ground._replace(
                effective_ratio=_best_effective_ratio(simulation, runs, ground, library)
            )
    return replace(simulation, grounds=grounds)


def _best_effective_ratio(
    simulation: Simulation, runs: Sequence[Signals], ground: Ground, library: Sequence[Effect]
) -> float:
    names, low_pass = names_of(library), low_pass_of(runs)
    losses = []
    for ratio in RATIOS:
        tried = replace(simulation, grounds={runs[0].terrain: ground._replace(effective_ratio=ratio)})
        losses.append(_loss(evidence_at(runs, tried, simulation.vector, names, low_pass)))
    ratio, least = best_ratio(np.array(losses))
    return ratio if losses[-1] - least > TILT_LOSS else 1.0


def best_ratio(losses: Array) -> tuple[float, float]:
    """Return the ratio, 0 to 1, and the loss at the minimum of the parabola through the losses of RATIOS.

    Examples
    --------
    >>> best_ratio(np.array([1.0, 0.0, 1.0]))[0], best_ratio(np.array([0.0, 2.0, 8.0]))[0]
    (0.5, 0.0)
    """
    a, b, c = np.polyfit(RATIOS, losses, 2)
    bottom = min(max(-b / (2.0 * a), 0.0), 1.0) if a > 0.0 else float(RATIOS[int(np.argmin(losses))])
    return round(float(bottom), 3), float(a * bottom**2 + b * bottom + c)


def _loss(info: Evidence) -> float:
    """Return minus twice the log-likelihood of what the whole library leaves, up to a constant."""
    scale = -np.log(np.abs(info.noise.filters[:, 0]))
    total = 0.0
    for run in info.rows:
        each = np.log(info.noise.size(run.pace_mps)) + scale
        total += 2.0 * float(each[np.isfinite(run.residual) & np.isfinite(each)].sum())
    return total
