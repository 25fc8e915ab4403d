r"""Terrain by what wheels answer to how they are driven: motor currents, or slip, of wheels or of the whole robot.

A motor's current on a given ground depends on how its wheel is driven: how fast, and in which direction
relative to the other wheels.  The *regime* of wheel i among W is what all wheels roll, in order from it,

.. math:: z_i = \left(\frac{u_i}{|u|}, \frac{u_{i+1}}{|u|}, \ldots, \frac{|u|}{u_{max}}\right),
          \qquad |u|^2 = \sum_j u_j^2 ,

so that wheels that are placed alike answer alike.  On one ground each quantity is a Gaussian process over the regime,
with the covariance of the responses of wheels i and j

.. math:: k\big((i, z), (j, z')\big) = e(z, z') \left(a + b\,\delta_{ij}\right) + c\,\delta ,
          \qquad e = \exp\left(-\tfrac12 \textstyle\sum_m (z_m - z_m')^2 / l_m^2\right) :

a part that all wheels share, one of each wheel alone (its load, its motor), and the scatter of runs.  Units
are means over a run and a regime, and runs are left out whole: windows of one run have its errors in common.
What is left of all responses together has one covariance S: that of means of runs that were left out (in closed form
from the inverse covariance, Rasmussen and Williams, Gaussian Processes for Machine Learning, 5.4.2, for blocks), and
that of windows within a run.

The terrain is the more likely the better it expects the responses of a window, which differ from that by d,

.. math:: \log p = -\tfrac{\nu + r}{2} \log\left(1 + \tfrac1\nu d^T S^{-1} d\right) - \tfrac12\log|S| ,

a Student distribution of few degrees of freedom, since runs differ more at times than most do.  A terrain is
distinguished from another only where both are expected to answer differently: what a direction or a speed of
driving says of the terrain, because some terrains were driven in it and others not, does not count.  A
response that is missing is left out of d; a robot that stands says nothing.

Probabilities are ``softmax(T log p)``: the temperature T makes the terrains of training windows most likely,
each expected by the other runs alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize, minimize_scalar
from scipy.special import softmax

from terrain.classify.folds import run_of
from terrain.classify.grouped import GroupedClassifier
from terrain.errors import DataError
from terrain.records import Array

#: Length scales of the direction among which the likelihood chooses: 0.4 is 23 degrees of an omni robot's direction of
#: travel; shorter ones would follow single runs.
LENGTHS = (0.4, 0.5, 0.6, 0.8)
SPEED_LENGTH = 1.0  #: Length scale of the speed, over the fastest: responses change little with it.
MIN_SPREAD = 1e-9

#: Standard deviation of a run's regime below which it is one; a run that is driven in many is cut into cells.
SAME_REGIME, CELL = 0.1, 0.25
#: Of a process: its cost grows with their cube. Where there are more, units are thinned evenly.
MAX_POINTS = 1200
#: Where the search for a, b and c begins, in variances of the responses, and the bounds of each.
START, BOUNDS = (1.0, 0.1, 0.05), ((1e-4, 1e3), (1e-4, 1e3), (1e-4, 10.0))
#: Of a standard deviation, as a share of the response's spread over the ground: a response that repeats exactly (a
#: counter that never moves) would outweigh all others.
FLOOR = 1e-3
DEGREES_OF_FREEDOM = 5.0
LOG_TEMPERATURE_BOUNDS = (-3.0, 1.0)

MIN_SPEED_RATIO = 0.05  #: Of the fastest window of training: slower, a robot stands.


def regimes(wheel_speed_mps: Array, fastest_mps: float) -> Array:
    """Return the regime (n, wheels, wheels + 1) of each wheel from speeds (n, wheels); NaN where all stand.

    ``fastest_mps`` is the norm of the speeds that counts as 1.

    Examples
    --------
    >>> regimes(np.array([[3.0, 4.0]]), 10.0)
    array([[[0.6, 0.8, 0.5],
            [0.8, 0.6, 0.5]]])
    """
    norm = np.linalg.norm(wheel_speed_mps, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = np.where(norm[:, None] > 0.0, wheel_speed_mps / norm[:, None], np.nan)
    n_wheels = unit.shape[1]
    order = (np.arange(n_wheels)[:, None] + np.arange(n_wheels)) % n_wheels
    speed = np.broadcast_to((norm / fastest_mps)[:, None, None], (len(unit), n_wheels, 1))
    return np.concatenate([unit[:, order], speed], axis=2)


class Process(NamedTuple):
    """A fitted process of a response: its mean, points (m,) and their weights, and its covariance.

    A prediction is the mean and the covariance with the points times the weights; ``common`` and ``own`` are a and b of
    the covariance, ``length`` is the length scale of the direction.
    """

    mean: float
    regime: Array
    wheel: Array
    weight: Array
    common: float
    own: float
    length: float

    def predict(self, regime: Array, wheel: int) -> Array:
        """Return the expected response (n,) of a wheel at regimes (n, c)."""
        shared = self.common + self.own * (self.wheel == wheel)
        return np.asarray(self.mean + _alike(regime, self.regime, self.length) @ (shared * self.weight))


def _alike(one: Array, other: Array, length: float) -> Array:
    """Return e (n, m) of regimes (n, c) and (m, c)."""
    scale = np.full(one.shape[1], length)
    scale[-1] = SPEED_LENGTH
    a, b = one / scale, other / scale
    squared = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
    return np.asarray(np.exp(-0.5 * np.maximum(squared, 0.0)))


def fit_process(regime: Array, wheel: Array, response: Array, block: Array) -> tuple[Process, Array]:
    """Return the most likely process of responses (m,) of wheels (m,) at regimes (m, c), and what other blocks leave.

    That is, of each response, what it differs by from the process without its own block (m,), its run.
    """
    mean, spread = float(response.mean()), float(response.std())
    if len(response) < 3 or spread < MIN_SPREAD:
        return Process(mean, regime, wheel, np.zeros(len(response)), 0.0, 0.0, 1.0), response - mean
    scaled, none = (response - mean) / spread, np.eye(len(response))
    first = 0 if len(np.unique(wheel)) > 1 else 1  # one wheel shares nothing
    best, likeliest = None, math.inf
    for length in LENGTHS:
        alike = _alike(regime, regime, length)
        parts = np.array([alike, alike * (wheel[:, None] == wheel), none][first:])

        def unlikely(logs: Array, parts: Array = parts) -> tuple[float, Array]:
            """Return the negative log likelihood of a, b and c by their logarithms, and its gradient."""
            scaled_parts = np.exp(logs)[:, None, None] * parts
            factor = cho_factor(scaled_parts.sum(axis=0) + 1e-8 * none, lower=True)
            weight = cho_solve(factor, scaled)
            value = 0.5 * scaled @ weight + np.log(np.diag(factor[0])).sum()
            apart = cho_solve(factor, none) - np.outer(weight, weight)
            return float(value), 0.5 * np.einsum("pij,ij->p", scaled_parts, apart)

        logs, bounds = np.log(START[first:]), np.log(BOUNDS[first:])
        found = minimize(unlikely, logs, method="L-BFGS-B", jac=True, bounds=bounds)
        if best is None or found.fun < likeliest:
            best, likeliest = (length, np.exp(found.x), parts), found.fun
    assert best is not None
    length, numbers, parts = best
    covariance = np.einsum("p,pij->ij", numbers, parts) + 1e-8 * none
    weight = cho_solve(cho_factor(covariance), scaled) * spread
    common = 0.0 if first else float(numbers[0])
    process = Process(mean, regime, wheel, weight, common, float(numbers[-2]), length)
    return process, left_out(covariance, scaled, block) * spread


def left_out(covariance: Array, response: Array, block: Array) -> Array:
    """Return each response (m,) less its expectation by the other blocks.

    With the inverse Q of the covariance (m, m), that of block B is ``(Q_BB)^-1 (Q y)_B``.
    """
    inverse = np.linalg.inv(covariance)
    whole = inverse @ response
    out = np.empty_like(response)
    for number in np.unique(block):
        rows = np.flatnonzero(block == number)
        out[rows] = np.linalg.solve(inverse[np.ix_(rows, rows)], whole[rows])
    return out


class GroundResponse(NamedTuple):
    """What one ground answers: a process for each quantity of a wheel, then one for each of the body.

    Responses are ordered by quantity, then wheel; then those of the body.  ``covariance`` (r, r) is of a window's
    responses about the processes.
    """

    processes: tuple[Process, ...]
    n_wheels: int
    n_wheel_quantities: int
    covariance: Array

    def expected(self, regime: Array) -> Array:
        """Return the expected responses (n, r) at regimes (n, wheels, c)."""
        columns = []
        for number, process in enumerate(self.processes):
            wheels = range(self.n_wheels if number < self.n_wheel_quantities else 1)
            columns += [process.predict(regime[:, i], i) for i in wheels]
        return np.column_stack(columns)


def fit_ground(
    regime: Array, responses: Array, groups: Array, n_body: int = 0
) -> tuple[GroundResponse, Array]:
    """Return what a ground answers, and the responses (n, r) to expect of each row without its own run.

    Parameters
    ----------
    regime : (n, wheels, c) of windows on this ground
    responses : (n, r) finite, by quantity, then wheel, then ``n_body`` of the whole body
    groups : (n,) run of each window
    """
    n_wheels = regime.shape[1]
    run = np.unique(groups.astype(str), return_inverse=True)[1]
    cell = np.floor(regime[:, 0] / CELL + 0.5).astype(np.int64)
    for number in range(run.max() + 1):  # a unit is a run, and its regime where a run has several
        rows = run == number
        if regime[rows, 0].std(axis=0).max() < SAME_REGIME:
            cell[rows] = 0
    unit = np.unique(np.column_stack([run, cell]), axis=0, return_inverse=True)[1].ravel()
    count, n_units = np.bincount(unit), unit.max() + 1
    kept = np.zeros(n_units, dtype=bool)
    n_kept = min(n_units, max(MAX_POINTS // n_wheels, 1))
    kept[np.unique(np.linspace(0, n_units - 1, n_kept).round().astype(int))] = True
    mean_regime, mean_response = (
        np.zeros((n_units, *regime.shape[1:])),
        np.zeros((n_units, responses.shape[1])),
    )
    np.add.at(mean_regime, unit, regime)
    np.add.at(mean_response, unit, responses)
    mean_regime, mean_response = mean_regime / count[:, None, None], mean_response / count[:, None]
    block = np.zeros(n_units, dtype=np.int64)
    block[unit] = run
    processes, left = [], np.zeros_like(mean_response)
    n_quantities = (responses.shape[1] - n_body) // n_wheels
    widths = [n_wheels] * n_quantities + [1] * n_body
    for n, end in zip(widths, np.cumsum(widths), strict=True):
        columns = np.arange(end - n, end)
        points = np.concatenate([mean_regime[kept, i] for i in range(n)])
        wheel, values = np.repeat(np.arange(n), kept.sum()), mean_response[kept][:, columns].T.ravel()
        process, apart = fit_process(points, wheel, values, np.tile(block[kept], n))
        processes.append(process)
        left[np.ix_(np.flatnonzero(kept), columns)] = apart.reshape(n, -1).T
        for i, column in enumerate(columns):
            left[~kept, column] = mean_response[~kept, column] - process.predict(mean_regime[~kept, i], i)
    within = responses - mean_response[unit]
    # the responses of a single unit have no spread, and their differences have rank 1
    spread = np.maximum(responses.std(axis=0), FLOOR * np.abs(responses).max(axis=0))
    floor = np.diag((FLOOR * np.maximum(spread, 1e-12)) ** 2)
    covariance = left.T @ left / len(left) + within.T @ within / max(len(within) - len(left), 1) + floor
    ground = GroundResponse(tuple(processes), n_wheels, n_quantities, covariance)
    return ground, (mean_response - left)[unit]


class ResponseColumns(NamedTuple):
    """Columns of a matrix: wheel speeds, then responses by quantity and wheel."""

    n_wheels: int
    n_responses: int


class ResponseChoice(NamedTuple):
    """What training rows chose: the temperature of the probabilities."""

    temperature: float


@dataclass(eq=False, repr=False)
class GroupedResponse(GroupedClassifier):
    """Terrain by the responses of wheels, with whole runs left out where it judges itself.

    Attributes
    ----------
    grounds_ : :class:`GroundResponse` of each class
    fastest_mps_ : norm of the wheel speeds that counts as 1
    temperature_, best_ : T, also as what was chosen
    inner_probability_ : (n, k) of each training row, its own terrain expected by other runs; NaN where the
        robot stands
    """

    columns: Any = ()  #: :class:`ResponseColumns` of the matrix, or () until they are known

    def fit(
        self, X: Array, y: Array, groups: Array | None = None, body: Array | None = None
    ) -> GroupedResponse:
        """Fit the responses of each terrain to wheel speeds in m/s and responses, NaN where missing.

        Parameters
        ----------
        X, y, groups : (n, columns) speeds and responses, and terrain and run (n,) of each row
        body : (n, b) what grounds expect of the whole robot beside the responses; it names no terrain

        Raises
        ------
        DataError
            if there is one class only, the columns are others, or a class has no window in which the robot
            moves and all responses are known.
        """
        X, y, groups = self._training_rows(X, y, groups)
        groups = run_of(groups)
        if not self.columns or sum(self.columns) != X.shape[1]:
            raise DataError(f"the columns of wheels and responses do not describe rows of {X.shape[1]}")
        responses, n = X[:, self.columns[0] :], self.columns[1]
        both = responses if body is None else np.column_stack([responses, body])
        self.fastest_mps_ = float(np.nanmax(np.linalg.norm(X[:, : self.columns[0]], axis=1), initial=0.0))
        regime, moving = self._regimes(X)
        usable = moving & np.isfinite(X).all(axis=1) & np.isfinite(both).all(axis=1)
        grounds, expected = [], np.full(responses.shape, np.nan)
        for name in self.classes_:
            rows = np.flatnonzero(usable & (y == name))
            if not rows.size:
                raise DataError(
                    f"no window of class {str(name)!r} has a robot that moves and all of its responses"
                )
            ground, awaited = fit_ground(regime[rows], both[rows], groups[rows], both.shape[1] - n)
            expected[rows] = awaited[:, :n]
            grounds.append(ground)
        self.grounds_ = tuple(grounds)
        likely = np.full((len(X), len(self.classes_)), np.nan)
        likely[usable] = self._log_likelihood(regime[usable], responses[usable])
        for j, name in enumerate(self.classes_):
            own = usable & (y == name)
            likely[own, j] = log_density(responses[own] - expected[own], grounds[j].covariance[:n, :n])
        rows = np.flatnonzero(usable)
        truth = np.searchsorted(self.classes_, y[rows])

        def loss(log_temperature: float) -> float:
            stated = softmax(np.exp(log_temperature) * likely[rows], axis=1)[np.arange(len(rows)), truth]
            return -float(np.log(np.maximum(stated, 1e-12)).mean())

        found = minimize_scalar(loss, bounds=LOG_TEMPERATURE_BOUNDS, method="bounded")
        self.temperature_ = float(np.exp(found.x))
        self.best_ = ResponseChoice(self.temperature_)
        self.inner_probability_ = softmax(self.temperature_ * likely, axis=1)
        return self

    def predict_proba(self, X: Array) -> Array:
        """Return the probability (n, k) of each class; equal ones where the robot stands."""
        X = self._rows(X)
        regime, moving = self._regimes(X)
        likely = np.zeros((len(X), len(self.classes_)))
        likely[moving] = self._log_likelihood(regime[moving], X[moving, self.columns[0] :])
        return np.asarray(softmax(self.temperature_ * likely, axis=1))

    def _regimes(self, X: Array) -> tuple[Array, Array]:
        """Return the regimes of rows, and in which of them the robot moves."""
        speed = X[:, : self.columns[0]]
        norm = np.linalg.norm(speed, axis=1)
        moving = np.isfinite(norm) & (norm > MIN_SPEED_RATIO * self.fastest_mps_)
        return regimes(speed, self.fastest_mps_), moving

    def _log_likelihood(self, regime: Array, responses: Array) -> Array:
        n = responses.shape[1]
        return np.column_stack(
            [log_density(responses - g.expected(regime)[:, :n], g.covariance[:n, :n]) for g in self.grounds_]
        )


def log_density(apart: Array, covariance: Array) -> Array:
    """Return the logarithm (n,) of the Student density of differences (n, r); NaN does not count.

    Constants that do not depend on the covariance are left out.
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
