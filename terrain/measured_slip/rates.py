"""Mean rates over windows, as slopes of sums, with their standard deviation.

Over a window of samples ``t_k`` of a sum ``y_k`` that grows steadily,

    r = sum (t_k - t) y_k / S,    S = sum (t_k - t)^2,    var r = s^2 / S (1 + q) / (1 - q)

with the variance s^2 of the residuals about the straight line and their correlation q from sample to sample:
noise of a filtered or matched measurement is not white (first-order correction of an autocorrelated error,
Bence, Ecology 76, 1995).  A motion that is not steady shows in s, so that its rate is stated as less certain.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from terrain.records import Array

MAX_CORRELATION = 0.95
"""Of residuals; beyond, too few independent samples are left for a variance."""


@njit(cache=True)
def window_rates(
    time_s: Array, sums: Array, part: Array, start_s: Array, end_s: Array, min_samples: int, coverage: float
) -> tuple[Array, Array]:
    """Return rates (k, c) and their standard deviations (k, c); NaN where a window has too little.

    Parameters
    ----------
    time_s : (n,) increasing
    sums : (n, c)
    part : (n,) integers; a window across two parts has no rate
    start_s, end_s : (k,) of the windows, the end included
    min_samples : fewest samples of a window, three or more
    coverage : least share of a window that its samples span

    Examples
    --------
    >>> time_s = np.arange(5.0)
    >>> rates, std = window_rates(time_s, 2.0 * time_s[:, None], np.zeros(5, np.int64), np.zeros(1),
    ...                           np.full(1, 4.0), 3, 0.5)
    >>> float(rates[0, 0]), float(std[0, 0])
    (2.0, 0.0)
    """
    k, c = start_s.size, sums.shape[1]
    rate, std = np.full((k, c), np.nan), np.full((k, c), np.nan)
    for w in range(k):
        first = np.searchsorted(time_s, start_s[w] - 1e-9)
        last = np.searchsorted(time_s, end_s[w] + 1e-9)
        n = last - first
        if n < max(min_samples, 3) or part[first] != part[last - 1]:
            continue
        if time_s[last - 1] - time_s[first] < coverage * (end_s[w] - start_s[w]):
            continue
        middle_s = time_s[first:last].mean()
        size = ((time_s[first:last] - middle_s) ** 2).sum()
        for j in range(c):
            mean = sums[first:last, j].mean()
            slope = ((time_s[first:last] - middle_s) * (sums[first:last, j] - mean)).sum() / size
            before, squared, crossed = 0.0, 0.0, 0.0
            for i in range(first, last):
                left = sums[i, j] - mean - slope * (time_s[i] - middle_s)
                squared += left * left
                if i > first:
                    crossed += left * before
                before = left
            rate[w, j] = slope
            q = min(max(crossed / squared, 0.0), MAX_CORRELATION) if squared > 0.0 else 0.0
            std[w, j] = np.sqrt(squared / (n - 2) / size * (1.0 + q) / (1.0 - q))
    return rate, std
