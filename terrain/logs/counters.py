"""Counters as encoders log them: counts that wrap, and the rate at which they change.

The rate at a sample is what was counted from the sample before to the one after it over the time between: sums of
rates are the counts, whatever the steps of the counter, and nothing is late.
"""

from __future__ import annotations

import numpy as np

from terrain.records import Array


def unwrapped_counts(counts: Array, period: float) -> Array:
    """Return the counts (n,) of a counter that begins anew after so many, from its first; NaN stays.

    It changes by less than half its period from one known sample to the next.

    Examples
    --------
    >>> unwrapped_counts(np.array([2.0**32 - 2, np.nan, 3.0, -1.0 + 2**32]), 2.0**32) - 2.0**32
    array([-2., nan,  3., -1.])
    """
    known = np.isfinite(counts)
    out = np.array(counts, dtype=np.float64)
    out[known] = np.unwrap(out[known], period=period)
    return out


def count_rates(time_s: Array, counted: Array) -> Array:
    """Return the rate of change (n,) of what was counted (n,) at times (n,); NaN where it is not known.

    Examples
    --------
    >>> count_rates(np.array([0.0, 1.0, 2.0, 4.0]), np.array([0.0, 1.0, 3.0, 3.0]))
    array([1.        , 1.5       , 0.66666667, 0.        ])
    """
    out = np.full(len(counted), np.nan)
    known = np.flatnonzero(np.isfinite(counted))
    if known.size > 1:
        before, after = known[[0, *range(known.size - 1)]], known[[*range(1, known.size), known.size - 1]]
        span_s = time_s[after] - time_s[before]
        change = counted[after] - counted[before]
        out[known] = np.divide(change, span_s, out=np.full(known.size, np.nan), where=span_s > 0.0)
    return out
