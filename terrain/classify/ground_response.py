r"""How one ground answers: what responses of the wheels to expect at a regime of motion, and their scatter.

Responses are of a wheel (its current, its slip) or of the whole robot (the slip of its body).  Each quantity
is a process over the regime of motion; what is left of all of them together
has one covariance: that of means of runs that were left out, and that of windows within a run.

A motor's current on a given ground depends on how its wheel is driven: how fast, and in which direction
relative to the other wheels.  The *regime* of wheel i among W is what all wheels roll, in order from it,

.. math:: z_i = \left(\frac{u_i}{|u|}, \frac{u_{i+1}}{|u|}, \ldots, \frac{|u|}{u_{max}}\right),
          \qquad |u|^2 = \sum_j u_j^2 ,

so that wheels that are placed alike answer alike.  The response of wheel i is a Gaussian process with the
covariance

.. math:: k\big((i, z), (j, z')\big) = e(z, z') \left(a + b\,\delta_{ij}\right) + c\,\delta ,
          \qquad e = \exp\left(-\tfrac12 \textstyle\sum_m (z_m - z_m')^2 / l_m^2\right) :

a part that all wheels share, one of each wheel alone (its load, its motor), and the scatter of runs.  Units
are means over a run and a regime, and runs are left out whole: windows of one run have its errors in common.
What a run that is left out differs by, in closed form from the inverse covariance (Rasmussen and Williams,
Gaussian Processes for Machine Learning, 5.4.2, for blocks), gives the scatter of a response about it.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from terrain.records import Array

LENGTHS = (0.4, 0.5, 0.6, 0.8)
"""Length scales of the direction among which the likelihood chooses: 0.4 is 23 degrees of an omni robot's
direction of travel; shorter ones would follow single runs."""

SPEED_LENGTH = 1.0
"""Length scale of the speed, over the fastest: responses change little with it."""

MIN_TRACE = 1e-9

SAME_REGIME = 0.1
"""Standard deviation of a run's regime below which it is one; a run that is driven in many is cut into cells
of :data:`CELL`."""

CELL = 0.25

MAX_POINTS = 1200
"""Of a process: its cost grows with their cube.  Where there are more, units are thinned evenly."""


def regimes(wheel_speed_mps: Array, fastest_mps: float) -> Array:
    """Return the regime (n, wheels, wheels + 1) of each wheel; NaN where all stand.

    Parameters
    ----------
    wheel_speed_mps : (n, wheels)
    fastest_mps : norm of the speeds that counts as 1

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


def units_of(regime: Array, groups: Array) -> Array:
    """Return the number (n,) of the unit of each row: its run, and its regime where a run has several.

    Parameters
    ----------
    regime : (n, c) of the first wheel
    groups : (n,) run of each row
    """
    run = np.unique(groups.astype(str), return_inverse=True)[1]
    cell = np.floor(regime / CELL + 0.5).astype(np.int64)
    for number in range(run.max() + 1):
        rows = run == number
        if regime[rows].std(axis=0).max() < SAME_REGIME:
            cell[rows] = 0
    return np.unique(np.column_stack([run, cell]), axis=0, return_inverse=True)[1].ravel()


def unit_means(values: Array, unit: Array) -> Array:
    """Return the mean (units, ...) of rows (n, ...) of each unit."""
    count = np.bincount(unit)
    sums = np.zeros((len(count), *values.shape[1:]))
    np.add.at(sums, unit, values)
    return sums / count.reshape(-1, *[1] * (values.ndim - 1))


class Process(NamedTuple):
    """A fitted process: mean (a number), points and their weights, and its covariance.

    Parameters
    ----------
    mean : of the response
    regime : (m, c) of the points
    wheel : (m,) of the points
    weight : (m,) such that a prediction is the mean and the covariance with the points times the weights
    common, own : a and b of the covariance
    length : of the direction
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
        likeness = _likeness(regime, self.regime, self.length)
        shared = self.common + self.own * (self.wheel == wheel)
        return np.asarray(self.mean + likeness @ (shared * self.weight))


def fit_process(regime: Array, wheel: Array, response: Array, block: Array) -> tuple[Process, Array]:
    """Return the process of responses, and what each differs by from that of the other blocks.

    Parameters
    ----------
    regime : (m, c)
    wheel : (m,) of which each point is
    response : (m,)
    block : (m,) run of each point

    Returns
    -------
    process : its length scale, amplitudes and scatter the most likely
    left : (m,) response less what the process expects there without the point's own block
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    mean, spread = float(response.mean()), float(response.std())
    if len(response) < 3 or spread < MIN_TRACE:
        return Process(mean, regime, wheel, np.zeros(len(response)), 0.0, 0.0, 1.0), response - mean
    n_wheels = len(np.unique(wheel))
    apart = _APART * np.eye(max(int(wheel.max()) + 1, 1))[wheel]
    points = np.column_stack([regime, apart])
    direction = regime.shape[1] - 1
    scaled = (response - mean) / spread
    best: GaussianProcessRegressor | None = None
    length = LENGTHS[0]
    for candidate in LENGTHS:
        scales = [candidate] * direction + [SPEED_LENGTH]
        shared = ConstantKernel(1.0, (1e-4, 1e3)) * RBF([*scales, *[_FAR] * apart.shape[1]], "fixed")
        own = ConstantKernel(0.1, (1e-4, 1e3)) * RBF([*scales, *[1.0] * apart.shape[1]], "fixed")
        kernel = (shared + own if n_wheels > 1 else own) + WhiteKernel(0.05, (1e-4, 10.0))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            found = GaussianProcessRegressor(kernel, alpha=1e-8).fit(points, scaled)
        if best is None or found.log_marginal_likelihood_value_ > best.log_marginal_likelihood_value_:
            best, length = found, candidate
    assert best is not None
    numbers = best.kernel_.get_params()
    common = float(numbers["k1__k1__k1__constant_value"]) if n_wheels > 1 else 0.0
    own_variance = float(numbers["k1__k2__k1__constant_value" if n_wheels > 1 else "k1__k1__constant_value"])
    covariance = best.kernel_(points) + 1e-8 * np.eye(len(points))
    weight = cho_solve(cho_factor(covariance), scaled)
    process = Process(mean, regime, wheel, weight * spread, common, own_variance, length)
    return process, left_out(covariance, scaled, block) * spread


_APART, _FAR = 10.0, 1e6
"""Distance of two wheels as the kernel sees it: far for a wheel's own part, nothing for the shared one."""


def left_out(covariance: Array, response: Array, block: Array) -> Array:
    """Return each response (m,) less its expectation by the other blocks.

    With the inverse Q of the covariance (m, m), that of block B is ``(Q_BB)^-1 (Q y)_B``.

    Examples
    --------
    >>> left_out(np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, 3.0]), np.array([0, 1])).round(6)
    array([-0.5,  2.5])
    """
    inverse = np.linalg.inv(covariance)
    whole = inverse @ response
    out = np.empty_like(response)
    for number in np.unique(block):
        rows = np.flatnonzero(block == number)
        out[rows] = np.linalg.solve(inverse[np.ix_(rows, rows)], whole[rows])
    return out


def _likeness(one: Array, other: Array, length: float) -> Array:
    scale = np.full(one.shape[1], length)
    scale[-1] = SPEED_LENGTH
    a, b = one / scale, other / scale
    squared = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
    return np.asarray(np.exp(-0.5 * np.maximum(squared, 0.0)))


FLOOR = 1e-3
"""Of a standard deviation, as a share of the response's spread over the ground: a response that repeats
exactly (a counter that never moves) would outweigh all others."""


class GroundResponse(NamedTuple):
    """Responses of one ground.

    Parameters
    ----------
    processes : one for each quantity of a wheel, then one for each of the body
    n_wheels, n_wheel_quantities : responses are ordered by quantity, then wheel; then those of the body
    covariance : (r, r) of a window's responses about the processes
    """

    processes: tuple[Process, ...]
    n_wheels: int
    n_wheel_quantities: int
    covariance: Array

    def expected(self, regime: Array) -> Array:
        """Return the expected responses (n, r) at regimes (n, wheels, c)."""
        columns = []
        for number, process in enumerate(self.processes):
            if number < self.n_wheel_quantities:
                columns += [process.predict(regime[:, i], i) for i in range(self.n_wheels)]
            else:
                columns.append(process.predict(regime[:, 0], 0))
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
    unit = units_of(regime[:, 0], groups)
    kept = _thinned(unit, n_wheels)
    mean_regime, mean_response = unit_means(regime, unit), unit_means(responses, unit)
    run = np.unique(groups.astype(str), return_inverse=True)[1]
    block = np.zeros(unit.max() + 1, dtype=np.int64)
    block[unit] = run
    processes, left = [], np.zeros_like(mean_response)
    n_quantities = (responses.shape[1] - n_body) // n_wheels
    spans = [range(q * n_wheels, (q + 1) * n_wheels) for q in range(n_quantities)]
    spans += [range(i, i + 1) for i in range(n_quantities * n_wheels, responses.shape[1])]
    for span in spans:
        columns = list(span)
        wheels = range(len(columns))
        points = np.concatenate([mean_regime[kept, i] for i in wheels])
        wheel = np.repeat(np.arange(len(columns)), kept.sum())
        values = mean_response[kept][:, columns].T.ravel()
        process, apart = fit_process(points, wheel, values, np.tile(block[kept], len(columns)))
        processes.append(process)
        left[np.ix_(np.flatnonzero(kept), np.array(columns))] = apart.reshape(len(columns), -1).T
        for i, column in zip(wheels, columns, strict=True):
            rest = ~kept
            left[rest, column] = mean_response[rest, column] - process.predict(mean_regime[rest, i], i)
    ground = GroundResponse(tuple(processes), n_wheels, n_quantities, np.eye(responses.shape[1]))
    between = left.T @ left / len(left)
    within = responses - mean_response[unit]
    spread = within.T @ within / max(len(within) - len(left), 1)
    floor = np.diag((FLOOR * np.maximum(responses.std(axis=0), 1e-12)) ** 2)
    return ground._replace(covariance=between + spread + floor), (mean_response - left)[unit]


def _thinned(unit: Array, n_wheels: int) -> Array:
    """Return which units (units,) the processes are fitted to."""
    n = unit.max() + 1
    most = max(MAX_POINTS // n_wheels, 1)
    kept = np.zeros(n, dtype=bool)
    kept[np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))] = True
    return kept
