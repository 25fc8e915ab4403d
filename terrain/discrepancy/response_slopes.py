"""By which factor, or level, measured and simulated are apart in a channel: a slope through zero, robust."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.compared import ComparedRun
from terrain.effects import CHANNELS
from terrain.records import Array

CLEAR_STDS = 3.0
"""A factor or a level is stated where it is off by so many standard deviations over runs."""

OUTLIER_STDS = 3.0
"""Distance of a run from the others, in their standard deviations, beyond which it is far out."""

LEAST_OFF = 0.03
"""Least ratio by which a factor is off: below it a sentence has nothing to state."""

EXPLAINS = 0.15
"""Least part of the absolute residual that a factor or a level has to remove, to describe it."""

LEVEL_RATIO = 0.3
"""Least ratio of the residual's root mean square that a level has to be."""


class Slope(NamedTuple):
    """Measured over simulated.

    Parameters
    ----------
    ratio, std : of the slope through zero, and its standard deviation over runs; NaN where it is not clear
        from 1, or does not describe the residual
    level, level_std : of measured minus simulated, in the channel's unit; NaN where a factor is stated, or no
        level is clear
    """

    ratio: float
    std: float
    level: float = math.nan
    level_std: float = math.nan


def slope_through_zero(simulated: Array, measured: Array) -> float:
    """Return the slope ``b`` that minimises ``sum |measured - b simulated|``; NaN where nothing is simulated.

    It is the median of ``measured / simulated``, each weighted by ``|simulated|``.

    Parameters
    ----------
    simulated, measured : (n,) rows without NaN

    Examples
    --------
    >>> x = np.array([1.0, -2.0, 3.0, 4.0])
    >>> slope_through_zero(x, 0.4 * x + np.array([0.0, 0.0, 9.0, 0.0]))
    0.4
    """
    weight = np.abs(simulated)
    seen = weight > 0.0
    if not seen.any():
        return math.nan
    ratio, weight = measured[seen] / simulated[seen], weight[seen]
    order = np.argsort(ratio, kind="stable")
    total = np.cumsum(weight[order])
    return float(ratio[order][np.searchsorted(total, total[-1] / 2.0)])


def slopes_of(runs: Sequence[ComparedRun], extended: bool = False) -> dict[str, Slope]:
    """Return the slope of measured on simulated by channel, over all rows of some runs.

    Parameters
    ----------
    runs : compared
    extended : whether with the causes built in
    """
    slopes = {}
    for c, channel in enumerate(CHANNELS):
        pairs = [_known(run, c, extended) for run in runs]
        pairs = [(x, y) for x, y in pairs if x.size]
        if pairs:
            slopes[channel] = _slope(pairs)
    return slopes


def _known(run: ComparedRun, c: int, extended: bool) -> tuple[Array, Array]:
    simulated = run.after if extended else run.before
    assert simulated is not None
    x, y = simulated[:, c], run.measured[:, c]
    seen = np.isfinite(x) & np.isfinite(y)
    return x[seen], y[seen]


def _slope(pairs: Sequence[tuple[Array, Array]]) -> Slope:
    x, y = (np.concatenate([pair[i] for pair in pairs]) for i in range(2))
    ratio = slope_through_zero(x, y)
    each = np.array([slope_through_zero(*pair) for pair in pairs])
    std = _std_of_mean(each - ratio, np.array([np.abs(pair[0]).sum() for pair in pairs]))
    left = np.abs(y - x).sum()
    off = abs(ratio - 1.0)
    scaled = np.abs(y - ratio * x).sum() < (1.0 - EXPLAINS) * left
    if off > max(CLEAR_STDS * std, LEAST_OFF) and scaled:
        return Slope(ratio, std)
    level = float(np.median(y - x))
    means = np.array([float(np.median(pair[1] - pair[0])) for pair in pairs])
    level_std = _std_of_mean(means - level, np.array([float(pair[0].size) for pair in pairs]))
    rms = float(np.sqrt(np.mean((y - x) ** 2)))
    moved = np.abs(y - x - level).sum() < (1.0 - EXPLAINS) * left
    if abs(level) > max(CLEAR_STDS * level_std, LEVEL_RATIO * rms) and moved:
        return Slope(math.nan, math.nan, level, level_std)
    return Slope(math.nan, math.nan)


def _std_of_mean(off: Array, weight: Array) -> float:
    """Return the standard deviation of a weighted mean by how far runs (n,) are from it.

    A run that is far out, as a stalled one, hardly moves a median, and counts as one at the edge.
    """
    known = np.isfinite(off) & (weight > 0.0)
    if known.sum() < 2:
        return math.inf
    edge = OUTLIER_STDS * 1.48 * float(np.median(np.abs(off[known])))
    off = np.clip(off, -edge, edge)
    return float(np.sqrt(((weight * off)[known] ** 2).sum()) / weight[known].sum())
