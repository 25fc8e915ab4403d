"""A target slip of one session taken for another session of the same surface: by how much it is off."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.measured_slip.slips import MeasuredSlip
from terrain.records import Array, RunLog

MIN_RUNS = 3
"""From fewer, how a median differs from run to run is not known."""

N_DRAWS = 1000


class Transfer(NamedTuple):
    """The slip of one session taken for another of the same surface: what it costs.

    Parameters
    ----------
    terrain, learned, driven : surface, and the two sessions
    slip_learned, slip_driven : medians over runs
    n_learned, n_driven : runs with a slip in steady motion
    difference : of what was driven from what was learned
    interval : its 95 % interval, by draws of runs of both; NaN where a session has fewer than
        :data:`MIN_RUNS` runs
    """

    terrain: str
    learned: str
    driven: str
    slip_learned: float
    slip_driven: float
    n_learned: int
    n_driven: int
    difference: float
    interval: tuple[float, float]


def transfers(
    runs: Sequence[RunLog], slips: Sequence[MeasuredSlip], rng: np.random.Generator
) -> list[Transfer]:
    """Return what each session shows beside each other one of the same surface.

    Parameters
    ----------
    runs : labelled with one terrain each
    slips : of each run
    rng : draws runs
    """
    medians: dict[tuple[str, str], list[float]] = {}
    for run, slip in zip(runs, slips, strict=True):
        known = slip.body_slip[slip.steady & np.isfinite(slip.body_slip)]
        if known.size:
            medians.setdefault((run.terrains[0], run.session), []).append(float(np.median(known)))
    return [
        _transfer(terrain, learned, driven, medians, rng)
        for terrain, learned in sorted(medians)
        for other, driven in sorted(medians)
        if other == terrain and driven != learned
    ]


def _transfer(
    terrain: str,
    learned: str,
    driven: str,
    medians: dict[tuple[str, str], list[float]],
    rng: np.random.Generator,
) -> Transfer:
    one, two = np.array(medians[terrain, learned]), np.array(medians[terrain, driven])
    interval = (np.nan, np.nan)
    if min(one.size, two.size) >= MIN_RUNS:
        interval = percentile_interval(_drawn_medians(two, rng) - _drawn_medians(one, rng))
    slip_learned, slip_driven = float(np.median(one)), float(np.median(two))
    return Transfer(
        terrain,
        learned,
        driven,
        slip_learned,
        slip_driven,
        one.size,
        two.size,
        slip_driven - slip_learned,
        interval,
    )


def _drawn_medians(values: Array, rng: np.random.Generator) -> Array:
    return np.asarray(np.median(values[bootstrap_rows(values.size, N_DRAWS, rng)], axis=1))
