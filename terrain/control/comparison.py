"""Means with their 95 % intervals over simulated runs, by Student's distribution, and paired differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from terrain.records import Array


class MeanInterval(NamedTuple):
    """A mean and its 95 % interval; None where it is not known.

    Parameters
    ----------
    mean : None without a known value
    ci : lower and upper end; None with fewer than two values
    n : number of known values
    """

    mean: float | None
    ci: tuple[float, float] | None
    n: int


class Difference(NamedTuple):
    """Mean difference and its 95 % interval, which is NaN where one pair gives none."""

    mean: float
    low: float
    high: float

    @property
    def is_significant(self) -> bool:
        """Whether the interval excludes zero."""
        return self.low > 0.0 or self.high < 0.0


def mean_interval(values: Sequence[float]) -> MeanInterval:
    """Return the mean of the finite values and its 95 % interval.

    Examples
    --------
    >>> found = mean_interval([1.0, 2.0, 3.0, float("nan")])
    >>> found.mean, [round(end, 3) for end in found.ci], found.n
    (2.0, [-0.484, 4.484], 3)
    """
    known = np.array([value for value in values if math.isfinite(value)])
    if not known.size:
        return MeanInterval(None, None, 0)
    mean, half = float(known.mean()), _half_interval(known)
    ci = None if math.isnan(half) else (mean - half, mean + half)
    return MeanInterval(mean, ci, int(known.size))


def paired_difference(
    values: Sequence[float | None], base: Sequence[float | None], relative: bool
) -> Difference | None:
    """Return the mean of ``values - base``, pair by pair; None without a pair of which both are known.

    Parameters
    ----------
    values, base : of the same runs; None or NaN where a value is not known
    relative : divide by the mean of ``base``, which then has to be above zero
    """
    pairs = np.array(
        [(a, b) for a, b in zip(values, base, strict=True) if _is_known(a) and _is_known(b)], dtype=float
    ).reshape(-1, 2)
    if not len(pairs):
        return None
    each = pairs[:, 0] - pairs[:, 1]
    mean, half, scale = float(each.mean()), _half_interval(each), float(pairs[:, 1].mean())
    if relative:
        if scale <= 0.0:
            return None
        mean, half = mean / scale, half / scale
    return Difference(mean, mean - half, mean + half)


def _is_known(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _half_interval(values: Array) -> float:
    """Return half the 95 % interval of a mean; NaN of a single value."""
    n = len(values)
    if n < 2:
        return math.nan
    return float(student.ppf(0.975, n - 1) * values.std(ddof=1) / math.sqrt(n))
