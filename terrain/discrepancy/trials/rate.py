"""Rates with exact intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from scipy.stats import beta


class Rate(NamedTuple):
    """A rate, and its 95 % interval by Clopper and Pearson (Biometrika 1934).

    Parameters
    ----------
    hits, of : counts
    rate : NaN where nothing was counted
    low, high : ends of the interval
    """

    hits: int
    of: int
    rate: float
    low: float
    high: float


def rate_of(outcomes: Iterable[bool]) -> Rate:
    """Return the rate of outcomes that are true.

    Examples
    --------
    >>> [round(x, 4) for x in rate_of([False] * 300)[2:]]
    [0.0, 0.0, 0.0122]
    """
    counted = [bool(outcome) for outcome in outcomes]
    n, k = len(counted), sum(counted)
    if n == 0:
        return Rate(0, 0, math.nan, 0.0, 1.0)
    low = float(beta.ppf(0.025, k, n - k + 1)) if k > 0 else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    return Rate(k, n, k / n, low, high)
