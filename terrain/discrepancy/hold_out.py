"""Which runs are held out of a diagnosis, to measure on them what an extension gains."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from terrain.discrepancy.preparation import MIN_RUNS
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
