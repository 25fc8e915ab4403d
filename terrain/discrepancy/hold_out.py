"""Which runs are held out of a diagnosis, to measure on them what an extension gains, and their repair."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from terrain.discrepancy.health.faults import Fault, without
from terrain.discrepancy.preparation import MIN_RUNS
from terrain.discrepancy.residuals import LowPass, rows_of
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import CHANNELS
from terrain.errors import DataError
from terrain.records import RunLog

HOLD_OUT_FROM, HOLD_OUT_EVERY = 6, 4
"""With so many runs or more, one in every so many is held out."""


def split_runs(runs: Sequence[RunLog], hold_out: int | None, seed: int) -> tuple[list[RunLog], list[RunLog]]:
    """Return the runs for the diagnosis and those held out.

    Runs are put in a random order, terrain after terrain, and of ``n`` that are held out every
    ``len(runs) / n``-th is taken, so that each terrain contributes in proportion.

    Parameters
    ----------
    hold_out : number of runs held out; by default a quarter of six or more
    seed : of the order

    Raises
    ------
    DataError
        if too few would be left for the diagnosis.
    """
    n = hold_out
    if n is None:
        n = math.ceil(len(runs) / HOLD_OUT_EVERY) if len(runs) >= HOLD_OUT_FROM else 0
    elif n and len(runs) - n < MIN_RUNS:
        raise DataError(f"--hold-out is {n} of {len(runs)} runs; the diagnosis requires at least {MIN_RUNS}")
    if not n:
        return list(runs), []
    drawn = np.random.default_rng(seed).permutation(len(runs))
    order = sorted(drawn, key=lambda i: runs[i].terrains)
    held_out = {order[k * len(runs) // n] for k in range(n)}
    used = [run for i, run in enumerate(runs) if i not in held_out]
    return used, [run for i, run in enumerate(runs) if i in held_out]


def repair_held_out(
    signals: Sequence[Signals],
    faults: Sequence[Fault],
    simulation: Simulation,
    low_pass: LowPass,
    noise: Mapping[str, float],
) -> tuple[Signals, ...]:
    """Return runs held out without the faults that were found in the others.

    A run has a fault if it is nearer to the simulation without it; a channel whose readings could not be
    distinguished is left out of all of them.

    Parameters
    ----------
    signals : of the runs held out
    faults : found in the runs behind the diagnosis, in the order in which they are repaired
    simulation : with the causes built in
    low_pass : of the comparison
    noise : by channel, over which squares are added
    """
    size = np.array([noise.get(name) or math.nan for name in CHANNELS])

    def misfit(run: Signals) -> float:
        planar = simulation.planar_on(run.terrain)
        residual = rows_of(run, planar, simulation.vector, (), low_pass).residual
        return float(np.nansum((residual / size) ** 2))

    fixed = []
    for run in signals:
        for fault in faults:
            if math.isnan(fault.factor):
                run = without(fault, run)
            else:
                run = min(run, fault.change.applied(run), key=misfit)
        fixed.append(run)
    return tuple(fixed)
