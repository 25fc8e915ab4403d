"""Intervals of equal length over which samples are averaged."""

from __future__ import annotations

import numpy as np

from terrain.records import Array


def valid_intervals(time_s: Array, valid: Array, length_s: float) -> list[slice]:
    """Return consecutive slices of one length in which every sample is valid.

    Examples
    --------
    >>> valid = np.array([True, True, True, False, True, True, True, True])
    >>> valid_intervals(np.arange(8) * 0.1, valid, 0.2)
    [slice(0, 2, None), slice(4, 6, None), slice(6, 8, None)]
    """
    if time_s.size < 2:
        return []
    size = max(2, round(length_s / float(np.median(np.diff(time_s)))))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], valid.astype(int), [0]])))
    return [
        slice(begin, begin + size)
        for first, last in edges.reshape(-1, 2)
        for begin in range(int(first), int(last) - size + 1, size)
    ]
