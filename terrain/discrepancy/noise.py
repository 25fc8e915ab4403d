"""Noise of the residuals: it grows with speed and is coloured; whitening removes both.

A channel's noise is ``s(v) x_k`` with ``s(v)^2 = a_0 + a_1 v + a_2 v^2`` of the wheels' speed ``v``, and
``x`` an autoregression: a robot shakes as it moves, and what shakes it lasts longer than a row.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.optimize import nnls

from terrain.records import Array

FLOOR = 0.2
"""Least ratio of the mean square that is attributed to noise at rest: starts of a robot are simulated less
well than the noise at rest suggests."""

ORDER = 6
"""Of the autoregression: about a second at the rate of the rows."""

ORDERS = (ORDER, 3, 1)
"""Orders that are tried: a channel with many holes has few stretches that fill a long one."""

WHOLE_RATIO = 0.7
"""Ratio of the rows of the shortest order that a longer one has to keep."""


class Noise(NamedTuple):
    """Noise of each channel.

    Parameters
    ----------
    growth : (channels, 3) coefficients of ``s(v)^2``, in the square of the channel's unit
    filters : (channels, ORDER + 1) whitens: ``e_k = sum_i filters[i] x_(k-i)`` has the variance 1; NaN where
        a channel was never measured
    std : (channels,) of the noise behind the low-pass, in the channel's unit
    """

    growth: Array
    filters: Array
    std: Array

    def size(self, speed_mps: Array) -> Array:
        """Return ``s`` (m, channels) at speeds (m,) of the wheels, forward or backward."""
        return np.asarray(np.sqrt(_powers(speed_mps) @ self.growth.T))


def _powers(speed_mps: Array) -> Array:
    v = np.abs(speed_mps)
    return np.column_stack([np.ones_like(v), v, v * v])


def noise_of(residuals: Sequence[Array], speeds_mps: Sequence[Array], n_fitted: float) -> Noise:
    """Return the noise of residuals (m, channels) of several runs, fitted by least squares over all of them.

    Parameters
    ----------
    residuals : of each run, NaN where nothing was measured
    speeds_mps : (m,) of the wheels, of each run
    n_fitted : number of parameters that were fitted to these residuals and made them smaller
    """
    n_channels = residuals[0].shape[1]
    filters, stds = np.full((n_channels, ORDER + 1), np.nan), np.full(n_channels, np.nan)
    growth = np.full((n_channels, 3), np.nan)
    powers = np.concatenate([_powers(speed) for speed in speeds_mps])
    n_rows = sum(int(np.isfinite(r).sum()) for r in residuals)
    for c in range(n_channels):
        square = np.concatenate([r[:, c] for r in residuals]) ** 2
        seen = np.isfinite(square)
        if seen.sum() < 10 * ORDER or not square[seen].any():
            continue
        growth[c] = _growth(square[seen], powers[seen])
        scaled = [
            r[:, c] / np.sqrt(_powers(v) @ growth[c]) for r, v in zip(residuals, speeds_mps, strict=True)
        ]
        tables = {order: _lag_table(scaled, order) for order in ORDERS}
        enough = [order for order in ORDERS if len(tables[order]) >= WHOLE_RATIO * len(tables[ORDERS[-1]])]
        table, order = tables[enough[0]], enough[0]
        if len(table) < 10 * ORDER:
            continue
        grow = 1.0 / max(1.0 - n_fitted / n_rows - order / len(table), 0.2)
        gram = table[:, 1:].T @ table[:, 1:]
        gram += 1e-9 * np.trace(gram) / order * np.eye(order)
        weights = np.linalg.solve(gram, table[:, 1:].T @ table[:, 0])
        left = table[:, 0] - table[:, 1:] @ weights
        scale = np.sqrt(np.mean(left**2) * grow)
        if not scale > 0:
            continue
        filters[c] = np.concatenate([[1.0], -weights, np.zeros(ORDER - order)]) / scale
        stds[c] = np.sqrt(np.mean(square[seen]) * grow)
    return Noise(growth, filters, stds)


def _growth(square: Array, powers: Array) -> Array:
    """Fit squares (m,) by their powers of speed (m, 3), none negative, twice weighted by what was fitted."""
    mean = float(square.mean())
    fitted = np.array([mean, 0.0, 0.0])
    for _ in range(3):
        weight = 1.0 / np.maximum(powers @ fitted, 0.02 * mean)
        fitted = nnls(powers * weight[:, None], square * weight)[0]
        fitted[0] = max(fitted[0], FLOOR * mean)
    return fitted


def _lag_table(signals: Sequence[Array], order: int) -> Array:
    """Return rows ``x_k, x_(k-1), ... x_(k-order)`` of all signals, as far as they are known."""
    rows = [
        np.lib.stride_tricks.sliding_window_view(x, order + 1)[:, ::-1] for x in signals if len(x) > order
    ]
    table = np.concatenate(rows) if rows else np.empty((0, order + 1))
    return np.asarray(table[np.isfinite(table).all(axis=1)])


@njit(cache=True)
def whiten(filters: Array, x: Array) -> Array:
    """Return signals (k, m, c) behind the whitening filters (c, order + 1); 0 where that meets a NaN.

    The rows before the filter is filled are 0 too.
    """
    k, m, c = x.shape
    order = filters.shape[1] - 1
    out = np.zeros((k, m, c))
    for j in range(k):
        for row in range(m):
            for i in range(c):
                total = 0.0
                for lag in range(order + 1):
                    if filters[i, lag] != 0.0:  # also where it is NaN
                        total += filters[i, lag] * x[j, row - lag, i] if row >= lag else np.nan
                if total == total:
                    out[j, row, i] = total
    return out
