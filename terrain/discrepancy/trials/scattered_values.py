"""Values of an effect that differ from run to run, as they do on measured robots."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from terrain.effects import BOUNDS
from terrain.records import Array

SCATTER_RATIO = (0.1, 0.35)
"""Range of the standard deviation from run to run over the value, as measured robots show it."""

TRACK = "effective_track"
"""Effect whose track scatters as well on a skid-steer robot."""

TRACK_RATIO = "effective_track_ratio"


def factors(rng: np.random.Generator, ratio: float, n_runs: int) -> Array:
    """Return log-normal factors (n,) of mean 1: a factor never turns a sign.

    Examples
    --------
    >>> drawn = factors(np.random.default_rng(0), 0.3, 100_000)
    >>> round(float(drawn.mean()), 2), round(float(drawn.std()), 2), bool((drawn > 0).all())
    (1.0, 0.3, True)
    """
    std = math.sqrt(math.log(1.0 + ratio**2))
    return np.asarray(np.exp(std * rng.standard_normal(n_runs) - std**2 / 2))


def scattered_values(
    values: Mapping[str, float], rng: np.random.Generator, ratio: float, n_runs: int, *, track: bool
) -> list[dict[str, float]]:
    """Return the values of each run, within the bounds of the effects.

    Parameters
    ----------
    values : by parameter, the mean of all runs
    ratio : standard deviation over the value
    track : whether the effective track scatters as well, by the same ratio of the track
    """
    each: list[dict[str, float]] = [{} for _ in range(n_runs)]
    for name, value in values.items():
        if name == TRACK_RATIO and track:
            continue
        low, high = BOUNDS[name]
        for run, factor in zip(each, factors(rng, ratio, n_runs), strict=True):
            run[name] = float(np.clip(value * factor, low, high))
    if track:
        low, high = BOUNDS[TRACK_RATIO]
        mean = 1.0 + values.get(TRACK_RATIO, 0.0)
        for run, factor in zip(each, factors(rng, ratio, n_runs), strict=True):
            run[TRACK_RATIO] = float(np.clip(mean * factor - 1.0, low, high))
    return each
