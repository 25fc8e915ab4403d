"""Changes of the mean of a sequence, without labels: the partition of least cost.

``sum over segments of sum_i |z_i - mean|^2 + penalty`` is minimised exactly by dynamic programming over the
last change (Jackson et al. 2005, "An algorithm for optimal partitioning of data on an interval"), with the
scatter of each column taken from its differences from one row to the next, which a change of the mean hardly
touches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
    """Return the end of each segment of the best partition, in order."""
    n = len(z)
    sums = np.concatenate([np.zeros((1, z.shape[1])), np.cumsum(z, axis=0)])
    squares = np.concatenate([[0.0], np.cumsum(np.square(z).sum(axis=1))])
    best, origin = np.full(n + 1, np.inf), np.zeros(n + 1, dtype=int)
    best[0] = -penalty
    for end in range(least, n + 1):
        first = np.arange(end - least + 1)
        within = (
            squares[end] - squares[first] - np.square(sums[end] - sums[first]).sum(axis=1) / (end - first)
        )
        costs = best[first] + within + penalty
        origin[end] = costs.argmin()
        best[end] = costs[origin[end]]
    ends = [n]
    while origin[ends[-1]] > 0:
        ends.append(int(origin[ends[-1]]))
    return ends[::-1]
