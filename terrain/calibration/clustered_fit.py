r"""Linear regression on samples of several runs, with intervals that hold for a run that was not among them.

.. math::
    \hat a = (X^T X + \Lambda)^{-1} X^T y, \qquad
    C = \tfrac{G}{G - 1} (X^T X + \Lambda)^{-1} \Big(\sum_g X_g^T e_g e_g^T X_g\Big) (X^T X + \Lambda)^{-1} :

errors of one run g of G belong together, so that samples of a run are not counted as independent (Liang and
Zeger 1986); p values are those of t with G - 1 degrees of freedom.  Where the columns, scaled to length 1,
have a condition number above :data:`ILL_CONDITIONED`, Lambda is that of ridge regression on centred and
scaled columns, its size the one that predicts runs left out best; with 0 among the choices.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

from terrain.calibration.finding import CONFIDENCE
from terrain.errors import DataError
from terrain.records import Array

ILL_CONDITIONED = 30.0
"""Belsley, Kuh and Welsch, Regression Diagnostics (1980): 30 and more is a harmful collinearity."""

RIDGES = (0.0, *np.geomspace(1e-6, 1.0, 13).tolist())
"""Sizes of the ridge that are tried, over the number of samples."""


class LinearFit(NamedTuple):
    """Coefficients of a regression, and what they are worth.

    Parameters
    ----------
    names : of the k columns
    coefficient, std, p_value : (k,)
    covariance : (k, k)
    r2_ratio : part of the variance that is explained; about 0 where there is no intercept
    residual_std, run_std : within the runs, and of their means
    condition : number of the columns, scaled to length 1
    inflation : (k,) variance inflation factors; NaN of the intercept
    ridge_ratio : that was chosen, over the number of samples
    n, n_runs : samples and runs
    """

    names: tuple[str, ...]
    coefficient: Array
    std: Array
    p_value: Array
    covariance: Array
    r2_ratio: float
    residual_std: float
    run_std: float
    condition: float
    inflation: Array
    ridge_ratio: float
    n: int
    n_runs: int

    @property
    def interval(self) -> Array:
        """Lower and upper ends (2, k) of the 95 % intervals."""
        half = stats.t.ppf((1 + CONFIDENCE) / 2, self.n_runs - 1) * self.std
        return np.stack((self.coefficient - half, self.coefficient + half))


def fit_runs(x: Array, y: Array, run: Array, names: tuple[str, ...], *, ridge: bool = False) -> LinearFit:
    """Fit a regression to samples of several runs.

    Parameters
    ----------
    x : (n, k) columns; an intercept is a column of ones
    y : (n,)
    run : (n,) number of the run of each sample
    names : of the columns
    ridge : whether to regularise where the condition number asks for it

    Raises
    ------
    DataError
        if there are fewer than three runs, no more samples than columns, or a column is the sum of others.

    Examples
    --------
    >>> x = np.column_stack([np.ones(6), np.arange(6.0)])
    >>> found = fit_runs(x, 2 + 3 * x[:, 1], np.arange(6) // 2, ("intercept", "slope"))
    >>> found.coefficient.round(6), found.n_runs
    (array([2., 3.]), 3)
    """
    runs, number = np.unique(run, return_inverse=True)
    n, k = x.shape
    if len(runs) < 3 or n <= k:
        raise DataError(f"{n} samples of {len(runs)} runs: more than {k} of three or more runs are required")
    length = np.linalg.norm(x, axis=0)
    condition = float(np.linalg.cond(x / np.where(length > 0, length, 1.0))) if (length > 0).all() else np.inf
    if condition > 1e10:
        raise DataError(f"columns {', '.join(names)} are not independent: the runs do not vary them apart")
    size = 0.0
    if ridge and condition > ILL_CONDITIONED:
        errors = [_left_out_error(x, y, number, each) for each in RIDGES]
        size = RIDGES[int(np.argmin(errors))]
    inverse = np.linalg.inv(x.T @ x + _penalty(x, size))
    coefficient = inverse @ (x.T @ y)
    residual = y - x @ coefficient
    covariance = clustered_covariance(inverse, x * residual[:, None], number)
    std = np.sqrt(np.diag(covariance))
    means = np.bincount(number, residual) / np.bincount(number)
    constant = bool((x == 1.0).all(axis=0).any())
    total = float(np.sum((y - y.mean() if constant else y) ** 2))
    p_value = 2 * stats.t.sf(np.abs(coefficient) / np.maximum(std, 1e-300), len(runs) - 1)
    return LinearFit(
        names,
        coefficient,
        std,
        p_value,
        covariance,
        1.0 - float(residual @ residual) / max(total, 1e-300),
        float(np.sqrt(np.sum((residual - means[number]) ** 2) / max(n - len(runs), 1))),
        float(np.sqrt(np.mean(means**2))),
        condition,
        _inflation(x),
        size,
        n,
        len(runs),
    )


def clustered_covariance(inverse: Array, by_error: Array, number: Array) -> Array:
    """Return the covariance C (k, k) of a fit whose errors belong together within a run.

    Parameters
    ----------
    inverse : (k, k) of the normal matrix
    by_error : (n, k) derivatives of each error by the coefficients, times the error
    number : (n,) of the run of each error, 0 to G - 1
    """
    n = int(number.max()) + 1
    scores = np.zeros((n, by_error.shape[1]))
    np.add.at(scores, number, by_error)
    return np.asarray(n / max(n - 1, 1) * inverse @ (scores.T @ scores) @ inverse)


def _penalty(x: Array, size: float) -> Array:
    """Return the ridge (k, k) on columns as if they were scaled to a standard deviation of 1."""
    return np.diag(size * len(x) * x.var(axis=0))


def _left_out_error(x: Array, y: Array, number: Array, size: float) -> float:
    """Return the squared error of runs that are left out one after the other."""
    gram, moment, total = x.T @ x, x.T @ y, 0.0
    penalty = _penalty(x, size)
    for run in range(int(number.max()) + 1):
        own = number == run
        left = np.linalg.lstsq(gram - x[own].T @ x[own] + penalty, moment - x[own].T @ y[own], rcond=None)[0]
        total += float(np.sum((y[own] - x[own] @ left) ** 2))
    return total


def _inflation(x: Array) -> Array:
    """Return by how much each column's own variance grows by what it shares with the others."""
    out = np.full(x.shape[1], np.nan)
    for j in range(x.shape[1]):
        variance = float(np.sum((x[:, j] - x[:, j].mean()) ** 2))
        if variance > 0.0:
            others = np.column_stack([np.ones(len(x)), np.delete(x, j, axis=1)])
            rest = x[:, j] - others @ np.linalg.lstsq(others, x[:, j], rcond=None)[0]
            out[j] = variance / max(float(rest @ rest), 1e-300)
    return out
