r"""Classifier of the ground by what wheels answer to how they are driven.

For each terrain, the responses of a window (motor currents, say) are expected by a process over the regime of
motion (:mod:`terrain.classify.ground_response`), and scatter about it with one covariance S.  The terrain is
the more likely the better it expects them,

.. math:: \log p = -\tfrac{\nu + r}{2} \log\left(1 + \tfrac1\nu d^T S^{-1} d\right) - \tfrac12\log|S| ,

a Student distribution of few degrees of freedom, since runs differ more at times than most do.  A terrain is
distinguished from another only where both are expected to answer differently: what a direction or a speed of
driving says of the terrain, because some terrains were driven in it and others not, does not count.  A
response that is missing is left out of d; a robot that stands says nothing.

Probabilities are ``softmax(T log p)``: the temperature T makes the terrains of training windows most likely,
each expected by the other runs alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from terrain.classify.ground_response import fit_ground, regimes
from terrain.classify.grouped import GroupedClassifier
from terrain.errors import DataError
from terrain.records import Array

DEGREES_OF_FREEDOM = 5.0

LOG_TEMPERATURE_BOUNDS = (-3.0, 1.0)

MIN_SPEED_RATIO = 0.05
"""Of the fastest window of training: slower, a robot stands."""


class ResponseColumns(NamedTuple):
    """Columns of a matrix: wheel speeds, then responses by quantity and wheel."""

    n_wheels: int
    n_responses: int


class ResponseChoice(NamedTuple):
    """What training rows chose: the temperature of the probabilities."""

    temperature: float


class GroupedResponse(GroupedClassifier):
    """Terrain by the responses of wheels, with whole runs left out where it judges itself.

    Parameters
    ----------
    columns : :class:`ResponseColumns` of the matrix, or () until they are known

    Attributes
    ----------
    classes_ : (k,) class names
    grounds_ : :class:`~terrain.classify.ground_response.GroundResponse` of each class
    fastest_mps_ : norm of the wheel speeds that counts as 1
    temperature_, best_ : T, also as what was chosen
    inner_probability_ : (n, k) of each training row, its own terrain expected by other runs; NaN where the
        robot stands
    """

    def __init__(self, columns: Any = ()) -> None:
        self.columns = columns

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> GroupedResponse:
        """Fit the responses of each terrain.

        Parameters
        ----------
        X : (n, n_wheels + n_responses) wheel speeds in m/s and responses, NaN where missing
        y : (n,) classes
        groups : (n,) run of each row; every row is its own run when missing

        Raises
        ------
        DataError
            if there is one class only, the columns are others, or a class has no window in which the robot
            moves and all responses are known.
        """
        X, y, groups = self._training_rows(X, y, groups)
        if not self.columns or sum(self.columns) != X.shape[1]:
            raise DataError(f"the columns of wheels and responses do not describe rows of {X.shape[1]}")
        n_wheels = self.columns[0]
        norm = np.linalg.norm(X[:, :n_wheels], axis=1)
        self.fastest_mps_ = float(np.nanmax(norm, initial=0.0))
        regime, moving = self._regimes(X)
        usable = moving & np.isfinite(X).all(axis=1)
        grounds, left = [], np.full((len(X), X.shape[1] - n_wheels), np.nan)
        for name in self.classes_:
            rows = np.flatnonzero(usable & (y == name))
            if not rows.size:
                raise DataError(
                    f"no window of class {str(name)!r} has a robot that moves and all of its responses"
                )
            ground, expected = fit_ground(regime[rows], X[rows, n_wheels:], groups[rows])
            grounds.append(ground)
            left[rows] = expected
        self.grounds_ = tuple(grounds)
        likely = np.full((len(X), len(self.classes_)), np.nan)
        rows = np.flatnonzero(usable)
        likely[rows] = self._log_likelihood(regime[rows], X[rows, n_wheels:])
        for j, name in enumerate(self.classes_):
            own = np.flatnonzero(usable & (y == name))
            likely[own, j] = log_density(X[own, n_wheels:] - left[own], grounds[j].covariance)
        truth = np.searchsorted(self.classes_, y[rows])
        self.temperature_ = _temperature(likely[rows], truth)
        self.best_ = ResponseChoice(self.temperature_)
        self.inner_probability_ = _softmax(self.temperature_ * likely)
        return self

    def predict_proba(self, X: Array) -> Array:
        """Return the probability (n, k) of each class; equal ones where the robot stands."""
        X = self._rows(X)
        regime, moving = self._regimes(X)
        likely = np.zeros((len(X), len(self.classes_)))
        likely[moving] = self._log_likelihood(regime[moving], X[moving, self.columns[0] :])
        return _softmax(self.temperature_ * likely)

    def _regimes(self, X: Array) -> tuple[Array, Array]:
        speed = X[:, : self.columns[0]]
        norm = np.linalg.norm(speed, axis=1)
        moving = np.isfinite(norm) & (norm > MIN_SPEED_RATIO * self.fastest_mps_)
        return regimes(speed, self.fastest_mps_), moving

    def _log_likelihood(self, regime: Array, responses: Array) -> Array:
        return np.column_stack(
            [log_density(responses - g.expected(regime), g.covariance) for g in self.grounds_]
        )


def log_density(apart: Array, covariance: Array) -> Array:
    """Return the logarithm (n,) of the Student density of differences (n, r); NaN does not count.

    Constants that do not depend on the covariance are left out.

    Examples
    --------
    >>> log_density(np.array([[0.0, np.nan], [2.0, np.nan]]), np.eye(2)).round(3) + 0.0
    array([ 0.   , -1.763])
    """
    out = np.zeros(len(apart))
    known = np.isfinite(apart)
    for pattern in np.unique(known, axis=0):
        if not pattern.any():
            continue
        rows = (known == pattern).all(axis=1)
        lower = np.linalg.cholesky(covariance[np.ix_(pattern, pattern)])
        scaled = np.linalg.solve(lower, apart[rows][:, pattern].T)
        squared = (scaled**2).sum(axis=0)
        power = 0.5 * (DEGREES_OF_FREEDOM + pattern.sum())
        out[rows] = -power * np.log1p(squared / DEGREES_OF_FREEDOM) - np.log(np.diag(lower)).sum()
    return out


def _softmax(score: Array) -> Array:
    score = score - score.max(axis=1, keepdims=True)
    weight = np.exp(score)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _temperature(likely: Array, truth: Array) -> float:
    """Return what makes the true classes most likely."""

    def loss(log_temperature: float) -> float:
        probability = _softmax(np.exp(log_temperature) * likely)
        return -float(np.log(np.maximum(probability[np.arange(len(truth)), truth], 1e-12)).mean())

    return float(np.exp(minimize_scalar(loss, bounds=LOG_TEMPERATURE_BOUNDS, method="bounded").x))
