"""Signals (n,) at even steps as both motions and the sensors take them: rates, delays, play."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.records import Array


@njit(cache=True)
def slopes(values: Array, dt: float) -> Array:
    """Return the rate (n,) of a signal, right to the fourth order where two neighbours are there.

    Examples
    --------
    >>> round(float(slopes(np.sin(np.arange(9) * 0.2), 0.2)[4]) - math.cos(0.8), 5)
    -4e-05
    """
    n = values.size
    out = np.zeros(n)
    for k in range(2, n - 2):
        out[k] = (8.0 * (values[k + 1] - values[k - 1]) - (values[k + 2] - values[k - 2])) / (12.0 * dt)
    for k in (0, 1, n - 2, n - 1):
        before, after = max(k - 1, 0), min(k + 1, n - 1)
        if after > before:
            out[k] = (values[after] - values[before]) / ((after - before) * dt)
    return out


@njit(cache=True)
def delayed(values: Array, late: float, rate: float) -> Array:
    """Return a signal (n,) that shows at sample k what was at ``k - late - rate k``; its ends are held.

    Between samples it runs along the cubic through the four nearest: straight lines would smooth it.

    Examples
    --------
    >>> delayed(np.array([0.0, 1.0, 2.0, 3.0]), 0.5, 0.0)
    array([0. , 0.5, 1.5, 2.5])
    """
    n = values.size
    out = np.empty(n)
    if rate == 0.0:  # the same weights everywhere but at the ends
        whole = math.floor(-late)
        x = -late - whole
        first, last = min(max(1 - whole, 0), n), max(min(n - 2 - whole, n), 0)
        if first < last:
            a, b = -x * (x - 1.0) * (x - 2.0) / 6.0, (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0
            c, d = -(x + 1.0) * x * (x - 2.0) / 2.0, (x + 1.0) * x * (x - 1.0) / 6.0
            i = first + whole
            m = last - first
            out[first:last] = a * values[i - 1 : i - 1 + m] + b * values[i : i + m]
            out[first:last] += c * values[i + 1 : i + 1 + m] + d * values[i + 2 : i + 2 + m]
        else:
            first = last = n
        for k in range(first):
            out[k] = _between(values, k - late)
        for k in range(last, n):
            out[k] = _between(values, k - late)
        return out
    for k in range(n):
        out[k] = _between(values, k - late - rate * k)
    return out


@njit(cache=True)
def _between(values: Array, at: float) -> float:
    """Return a signal between its samples; its ends are held."""
    n = values.size
    at = min(max(at, 0.0), n - 1.0)
    i = min(int(at), n - 2)
    x = at - i
    if 1 <= i < n - 2:
        return float(
            -x * (x - 1.0) * (x - 2.0) / 6.0 * values[i - 1]
            + (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0 * values[i]
            - (x + 1.0) * x * (x - 2.0) / 2.0 * values[i + 1]
            + (x + 1.0) * x * (x - 1.0) / 6.0 * values[i + 2]
        )
    return float(values[i] + x * (values[i + 1] - values[i]))


@njit(cache=True)
def lagged(values: Array, tau_s: float, dt: float) -> Array:
    """Return a signal (n,) behind a first-order lag, exact for what runs straight from sample to sample.

    It starts at rest at its first value; without a time constant it is returned as it is.

    Examples
    --------
    >>> lagged(np.array([0.0, 1.0, 2.0, 3.0]), 1e-3, 1.0).round(3)
    array([0.   , 0.999, 1.999, 2.999])
    """
    if tau_s <= 0.0:
        return values
    out = np.empty(values.size)
    keep = math.exp(-dt / tau_s)
    out[0] = values[0]
    for k in range(1, values.size):
        lead = tau_s * (values[k] - values[k - 1]) / dt
        out[k] = values[k] - lead + keep * (out[k - 1] - values[k - 1] + lead)
    return out


@njit(cache=True)
def play(angle: Array, half: float) -> None:
    """Let an angle follow itself through a play of half width ``half``, from the middle; in place."""
    follower = angle[0]
    for k in range(angle.size):
        follower = min(max(follower, angle[k] - half), angle[k] + half)
        angle[k] = follower
