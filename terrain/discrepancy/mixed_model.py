"""Linear mixed model of runs: parameters that all runs share, and such of which each run has its own value.

Of each run ``i`` the whitened residual is ``X_i x + N_i b_i + e_i`` with ``b_i ~ N(0, D)``, ``D`` diagonal.
Shared values ``x``, and those of the variances ``D`` that are free, are of greatest likelihood, found by
expectation and maximisation (Laird and Ware, Biometrics 1982): with ``G = N'N``,

    V = (G + D^-1)^-1,   x = generalised least squares,   b = V N'(r - X x),   D <- mean of b^2 + V over runs.

Minus twice the log-likelihood is, up to a constant, ``sum |r - X x|^2 - b'(G + D^-1) b + log det(1 + G D)``:
what a parameter costs that may differ from run to run is the last term.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.records import Array

EM_STEPS = 30
"""Enough from a start that is not far too small: variances then fall to where they belong."""


class MixedFit(NamedTuple):
    """A fit of runs.

    Parameters
    ----------
    loss : minus twice the log-likelihood, up to what no choice of parameters changes
    shared : (m,) values that all runs share
    std : (q,) standard deviations of the values that each run has of its own
    """

    loss: float
    shared: Array
    std: Array


def fit_mixed(
    gram: Array, shared: Sequence[int], own: Sequence[int], least_std: Array, start_std: Array, free: Array
) -> MixedFit:
    """Return the fit of greatest likelihood.

    Parameters
    ----------
    gram : (runs, k + 1, k + 1) products of the whitened columns of each run, the residual last
    shared, own : places of the m parameters that all runs share, and of the q that differ about them
    least_std, start_std : (q,) least standard deviations, and those to start from, both above zero
    free : (q,) whether a standard deviation is estimated; the others stay as they start

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> columns = rng.standard_normal((200, 50, 1))
    >>> values = 1.0 + 0.5 * rng.standard_normal((200, 1))
    >>> residual = columns[:, :, 0] * values + 0.1 * rng.standard_normal((200, 50))
    >>> both = np.concatenate([columns, residual[:, :, None]], axis=2) / 0.1
    >>> gram, least = both.transpose(0, 2, 1) @ both, np.array([1e-3])
    >>> fit = fit_mixed(gram, [0], [0], least, np.ones(1), np.array([True]))
    >>> bool(abs(fit.shared[0] - 1.0) < 0.1), bool(abs(fit.std[0] - 0.5) < 0.1)
    (True, True)
    """
    last = gram.shape[1] - 1
    kept, m = [*shared, last], len(shared)
    inside, cross = gram[:, own][:, :, own], gram[:, own][:, :, kept]
    outside = gram[:, kept][:, :, kept].sum(axis=0)
    std = np.maximum(start_std, least_std)
    values, loss = np.zeros(m), 0.0
    for step in range(EM_STEPS + 1):
        inner = np.linalg.inv(inside + np.diag(1.0 / std**2))
        follow = inner @ cross
        total = outside - (cross.transpose(0, 2, 1) @ follow).sum(axis=0)
        values = np.linalg.lstsq(total[:m, :m], total[:m, m], rcond=1e-10)[0] if m else values
        if step == EM_STEPS:
            scaled = np.eye(len(std)) + std[:, None] * inside * std
            loss = float(total[m, m] - values @ total[:m, m] + np.linalg.slogdet(scaled)[1].sum())
            break
        deviation = follow @ np.concatenate([-values, [1.0]])
        square = (deviation**2 + np.einsum("iqq->iq", inner)).mean(axis=0)
        std = np.where(free, np.maximum(np.sqrt(square), least_std), std)
    return MixedFit(loss, values, std)
