"""Slow runs against fast ones: what is learned of a terrain at one speed, and whether it applies at another."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from terrain.records import Array

MIN_RUNS_A_SIDE, MIN_TIME_A_SIDE_S = 2, 60.0
"""Slow and fast runs of a class that are compared: at least so many, of so much time."""
MIN_CLASSES = 3
"""Slow and fast runs are compared where at least so many classes have enough of both."""
MOVING_MPS = 0.03
"""The faster wheel moves above this; it is the steady-motion rule's own threshold."""


class Applicability(StrEnum):
    """Whether the data allow a comparison."""

    APPLICABLE = "applicable"
    NOT_APPLICABLE = "not applicable"


class ClassSpeeds(NamedTuple):
    """Median speeds of the slow and of the fast runs of a class."""

    slow_mps: float
    fast_mps: float


class SlowFast(NamedTuple):
    """Accuracy when slow runs train and fast runs test, and the reverse; None where not applicable.

    Parameters
    ----------
    status : applicable where :data:`MIN_CLASSES` are kept
    classes : speeds of the classes that are kept
    left_out : the reason for each of the others
    slow_to_fast, fast_to_slow : accuracies
    """

    status: Applicability
    classes: Mapping[str, ClassSpeeds]
    left_out: Mapping[str, str]
    slow_to_fast: float | None = None
    fast_to_slow: float | None = None


def run_speeds(fastest_mps: Array, run_id: Array) -> dict[str, float]:
    """Return the median speed (m/s) of each run's faster wheel where it moves; NaN if it never does.

    Parameters
    ----------
    fastest_mps : (n, samples) magnitude of the speed of the faster wheel in n windows; NaN where unknown
    run_id : (n,) run of each window

    Examples
    --------
    >>> run_speeds(np.array([[0.0, 0.4], [0.6, 0.6], [0.0, 0.01]]), np.array(["a", "a", "b"]))
    {'a': 0.6, 'b': nan}
    """
    speeds = {}
    for run in np.unique(run_id).tolist():
        moving = fastest_mps[run_id == run].ravel()
        moving = moving[moving > MOVING_MPS]
        speeds[run] = float(np.median(moving)) if len(moving) else math.nan
    return speeds


def slow_fast_split(
    fastest_mps: Array, run_id: Array, terrain: Array, start_s: Array, length_s: float
) -> tuple[Array, SlowFast]:
    """Split the runs of each class at their median speed, taken over the run's time on that class.

    Parameters
    ----------
    fastest_mps : (n, samples) as :func:`run_speeds`
    run_id, terrain, start_s : (n,) run, class and start of each window
    length_s : of a window

    Returns
    -------
    side : (n,) ``slow`` or ``fast``; empty of a class that is left out, and of a run that is slow on one class
        and fast on another
    split : of the classes, without accuracies
    """
    side = np.full(len(terrain), "", dtype=object)
    kept: dict[str, ClassSpeeds] = {}
    left_out: dict[str, str] = {}
    for name in np.unique(terrain).tolist():
        of_class = terrain == name
        speeds = run_speeds(fastest_mps[of_class], run_id[of_class])
        known = {run: speed for run, speed in speeds.items() if math.isfinite(speed)}
        median = np.median(list(known.values())) if known else math.nan
        parts = {
            "slow": [run for run, speed in known.items() if speed <= median],
            "fast": [run for run, speed in known.items() if speed > median],
        }
        reasons = []
        for each, runs in parts.items():
            time_s = sum(covered_s(start_s[of_class & (run_id == run)], length_s) for run in runs)
            if len(runs) < MIN_RUNS_A_SIDE:
                reasons.append(f"{each} runs: {len(runs)}")
            elif time_s < MIN_TIME_A_SIDE_S:
                reasons.append(f"{each} runs: {time_s:.0f} s")
        if reasons:
            left_out[name] = reasons[0]
            continue
        kept[name] = ClassSpeeds(*(float(np.median([known[run] for run in runs])) for runs in parts.values()))
        for each, runs in parts.items():
            side[of_class & np.isin(run_id, runs)] = each
    both = set(run_id[side == "slow"]) & set(run_id[side == "fast"])
    side[np.isin(run_id, list(both))] = ""
    enough = len(kept) >= MIN_CLASSES
    status = Applicability.APPLICABLE if enough else Applicability.NOT_APPLICABLE
    return side, SlowFast(status, kept, left_out)


def covered_s(start_s: Array, length_s: float) -> float:
    """Return the time that windows of one run cover; where they overlap it counts once.

    Examples
    --------
    >>> covered_s(np.array([0.0, 1.0, 5.0]), 2.0)
    5.0
    """
    return float(np.minimum(np.diff(np.sort(start_s)), length_s).sum() + length_s)
