"""A number over several simulated runs: its mean and its range."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class OverRuns(NamedTuple):
    """Mean of a number over several runs, and its range (lowest, highest)."""

    mean: float
    spread: tuple[float, float]


def over_runs(values: Sequence[float]) -> OverRuns:
    """Return the mean over runs and their range.

    Examples
    --------
    >>> over_runs([1.0, 2.0, 6.0])
    OverRuns(mean=3.0, spread=(1.0, 6.0))
    """
    return OverRuns(float(np.mean(values)), (float(np.min(values)), float(np.max(values))))
