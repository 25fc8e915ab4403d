"""Changes of the mean of a sequence, without labels: the partition of least cost.

``sum over segments of sum_i |z_i - mean|^2 + penalty`` is minimised exactly by dynamic programming over the
last change (Jackson et al. 2005, "An algorithm for optimal partitioning of data on an interval"), with the
scatter of each column taken from its differences from one row to the next, which a change of the mean hardly
touches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.records import Array

PENALTY = 3.0
"""A change costs this times the number of columns times the logarithm of the number of rows: three times what
the criterion of Schwarz asks, as neighbouring windows resemble each other."""

SHIFT_LEAST = 4.0
"""A segment that differs from the longest by so many times the scatter, in the root mean square of all
columns, stands out.  Both were chosen with the runs of BorealTC and Vulpi in view: 10 of 69 have one."""

LEAST_ROWS = 3
MIN_SCATTER = 0.05


class Break(NamedTuple):
    """Rows ``[first, end)`` that differ from most of the others, and by how many times the scatter."""

    first: int
    end: int
    shift: float


def change_points(values: Array) -> list[Break]:
    """Return the segments of rows (n, c) that stand out from the longest one, in order.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> rows = rng.standard_normal((60, 4))
    >>> rows[20:30] += 8.0
    >>> [(each.first, each.end) for each in change_points(rows)], change_points(rng.standard_normal((60, 4)))
    ([(20, 30)], [])
    """
    n, c = values.shape
    if n < 2 * LEAST_ROWS:
        return []
    scatter = 1.4826 * np.median(np.abs(np.diff(values, axis=0)), axis=0) / np.sqrt(2.0)
    z = np.ascontiguousarray(values / np.maximum(scatter, MIN_SCATTER), dtype=np.float64)
    ends = _partition(z - z.mean(axis=0), LEAST_ROWS, PENALTY * c * np.log(n))
    parts = list(zip([0, *ends[:-1]], ends, strict=True))
    usual = max(parts, key=lambda part: part[1] - part[0])
    centre = np.median(z[usual[0] : usual[1]], axis=0)
    shifts = [float(np.sqrt(np.square(z[a:b].mean(axis=0) - centre).mean())) for a, b in parts]
    return [
        Break(*part, shift)
        for part, shift in zip(parts, shifts, strict=True)
        if part != usual and shift >= SHIFT_LEAST
    ]


def _partition(z: Array, least: int, penalty: float) -> list[int]:
    """Return the end of each segment, in order."""
    origin = _origins(z, least, penalty)
    ends, end = [], len(z)
    while end > 0:
        ends.append(end)
        end = int(origin[end])
    return ends[::-1]


@njit(cache=True, nogil=True, error_model="numpy")
def _origins(z: Array, least: int, penalty: float) -> Array:
    """Return, for each end (n + 1,), where the last segment of the best partition up to it begins."""
    n, c = z.shape
    sums, squares = np.zeros((n + 1, c)), np.zeros(n + 1)
    for i in range(n):
        squares[i + 1] = squares[i]
        for j in range(c):
            sums[i + 1, j] = sums[i, j] + z[i, j]
            squares[i + 1] += z[i, j] * z[i, j]
    best = np.full(n + 1, np.inf)
    origin = np.zeros(n + 1, dtype=np.int64)
    best[0] = -penalty
    for end in range(least, n + 1):
        for first in range(end - least + 1):
            if best[first] < np.inf:
                cost = squares[end] - squares[first]
                for j in range(c):
                    total = sums[end, j] - sums[first, j]
                    cost -= total * total / (end - first)
                if best[first] + cost + penalty < best[end]:
                    best[end] = best[first] + cost + penalty
                    origin[end] = first
    return origin
