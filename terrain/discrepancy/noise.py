"""Noise of the residuals: it grows with speed and is coloured; whitening removes both.

A channel's noise is ``s(v) x_k`` with ``s(v)^2 = a_0 + a_1 v + a_2 v^2`` of the wheels' speed ``v``, and
``x`` an autoregression: a robot shakes as it moves, and what shakes it lasts longer than a row.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from terrain.kernels import njit
from terrain.records import Array

#: Least ratio of the mean square that is attributed to noise at rest: starts of a robot are simulated less well than
#: the noise at rest suggests.
FLOOR = 0.2

ORDER = 6  #: Of the autoregression: about a second at the rate of the rows.
#: Orders that are tried: a channel with many holes has few stretches that fill a long one.
ORDERS = (ORDER, 3, 1)
#: The order of noise without memory, with which a fit starts: a memory that is fitted to a residual full of levels
#: would weigh levels down to nothing, and they would never be fitted.
WHITE = (0,)
#: Correlation time of the noise at the most: ground and vibration forget themselves within a second or a metre, and
#: what lasts longer is a level that wants a cause.
LONGEST_MEMORY_S = 1.0

WHOLE_RATIO = 0.7  #: Ratio of the rows of the shortest order that a longer one has to keep.
#: Factors by which the poles of an autoregression are drawn in, from none, until its memory is short enough.
SHRINKS = np.linspace(1.0, 0.0, 51)


class Noise(NamedTuple):
    """Noise of each channel."""

    growth: Array  #: (channels, 3) coefficients of ``s(v)^2``, in the square of the channel's unit
    #: (channels, ORDER + 1) whitens: ``e_k = sum_i filters[i] x_(k-i)`` has the variance 1; NaN where a channel was
    #: never measured
    filters: Array
    std: Array  #: (channels,) of the noise behind the low-pass, in the channel's unit

    def size(self, speed_mps: Array) -> Array:
        """Return ``s`` (m, channels) at speeds (m,) of the wheels, forward or backward."""
        return np.asarray(np.sqrt(_powers(speed_mps) @ self.growth.T))


def _powers(speed_mps: Array) -> Array:
    v = np.abs(speed_mps)
    return np.column_stack([np.ones_like(v), v, v * v])


def noise_of(
    residuals: Sequence[Array],
    speeds_mps: Sequence[Array],
    row_s: float,
    n_fitted: float = 0.0,
    orders: Sequence[int] = ORDERS,
) -> Noise:
    """Return the noise of residuals (m, channels) of several runs, fitted by least squares over all of them.

    Parameters
    ----------
    residuals : of each run, NaN where nothing was measured
    speeds_mps : (m,) of the wheels, of each run
    row_s : from row to row
    n_fitted : number of parameters that were fitted to these residuals and made them smaller
    orders : of the autoregression that are tried, from the longest; :data:`WHITE` for none
    """
    n_channels = residuals[0].shape[1]
    growth, filters = np.full((n_channels, 3), np.nan), np.full((n_channels, ORDER + 1), np.nan)
    noise = Noise(growth, filters, np.full(n_channels, np.nan))
    powers = [_powers(speed) for speed in speeds_mps]
    n_rows = sum(int(np.isfinite(r).sum()) for r in residuals)
    window = np.lib.stride_tricks.sliding_window_view
    for c in range(n_channels):
        square = np.concatenate([r[:, c] for r in residuals]) ** 2
        seen = np.isfinite(square)
        if seen.sum() < 10 * ORDER or not square[seen].any():
            continue
        # squares by powers of the speed, none negative, twice weighted by what was fitted
        known, mean = np.concatenate(powers)[seen], float(square[seen].mean())
        growth[c] = mean, 0.0, 0.0
        for _ in range(3):
            weight = 1.0 / np.maximum(known @ growth[c], 0.02 * mean)
            growth[c] = nnls(known * weight[:, None], square[seen] * weight)[0]
            growth[c, 0] = max(growth[c, 0], FLOOR * mean)
        scaled = [r[:, c] / np.sqrt(power @ growth[c]) for r, power in zip(residuals, powers, strict=True)]
        tables = {}  # by order, rows x_k, x_(k-1), ... x_(k-order) of all runs, as far as they are known
        for order in orders:
            rows = [window(x, order + 1)[:, ::-1] for x in scaled if len(x) > order]
            table = np.concatenate(rows or [np.empty((0, order + 1))])
            tables[order] = table[np.isfinite(table).all(axis=1)]
        order = next(n for n in orders if len(tables[n]) >= WHOLE_RATIO * len(tables[orders[-1]]))
        table = tables[order]
        if len(table) < 10 * ORDER:
            continue
        grow = 1.0 / max(1.0 - n_fitted / n_rows - order / len(table), 0.2)
        weights = _autoregression(table, row_s)
        scale = np.sqrt(np.mean((table[:, 0] - table[:, 1:] @ weights) ** 2) * grow)
        if scale > 0:
            filters[c] = np.concatenate([[1.0], -weights, np.zeros(ORDER - order)]) / scale
            noise.std[c] = np.sqrt(np.mean(square[seen]) * grow)
    return noise


def _autoregression(table: Array, row_s: float) -> Array:
    """Return the weights (order,) of an autoregression whose memory is :data:`LONGEST_MEMORY_S` at the most.

    The density at zero frequency, ``s^2 row / (1 - sum w)^2`` with the variance ``s^2`` of what drives it,
    is at most that of noise with an exponential correlation of that time, ``2 tau`` times its variance.
    Where it is larger, weights are multiplied by ``g^lag``, which draws all poles in by ``g``.
    """
    order = table.shape[1] - 1
    if not order:
        return np.empty(0)
    gram = table[:, 1:].T @ table[:, 1:]
    gram += 1e-9 * np.trace(gram) / order * np.eye(order)
    weights = np.asarray(np.linalg.solve(gram, table[:, 1:].T @ table[:, 0]))
    most = 2.0 * LONGEST_MEMORY_S / row_s * float(np.mean(table[:, 0] ** 2))
    for shrink in SHRINKS:
        drawn_in = weights * shrink ** np.arange(1, order + 1)
        power = float(np.mean((table[:, 0] - table[:, 1:] @ drawn_in) ** 2))
        if power <= most * (1.0 - drawn_in.sum()) ** 2 and drawn_in.sum() < 1.0:
            return np.asarray(drawn_in)
    return np.zeros(order)


@njit
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


TINY = 1e-30  #: A square of nothing, by which is divided
LEAST_VARIANCE = 0.02  #: Ratio of the mean square that a variance has at the least: rest is not all of a fit


def growth_of(powers: Array, square: Array, n_fits: int, cut: float = np.inf) -> Array:
    """Return the coefficients (k,), none negative, by which squares (m,) grow with powers (m, k), the first of them 1.

    Weights are those of squares whose scatter is as large as their mean, by the fit before, of ``n_fits``; ``cut``
    standard deviations are the most that a row counts.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> speed = rng.uniform(0.0, 2.0, 20000)
    >>> square = (0.1 + 0.3 * speed**2) * rng.standard_normal(20000) ** 2
    >>> growth_of(np.column_stack([np.ones_like(speed), speed**2]), square, 5).round(2)
    array([0.1, 0.3])
    """
    from scipy.optimize import nnls

    mean = max(float(square.mean()), TINY)
    growth = np.array([mean, *np.zeros(powers.shape[1] - 1)])
    for _ in range(n_fits):
        variance = np.maximum(powers @ growth, LEAST_VARIANCE * mean)
        growth = nnls(powers / variance[:, None], np.minimum(square / variance, cut**2))[0]
        growth[0] = max(growth[0], LEAST_VARIANCE * mean)
    return growth
