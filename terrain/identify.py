r"""One identification: least squares over named parameters, with intervals that hold for what was not measured.

Of residuals r (n,) over their standard deviation, with weak priors of the parameters p,

.. math:: \hat p = \arg\min_p \sum_i \rho(r_i(p)^2) + \sum_j \big((p_j - p_{0j}) / s_j\big)^2 ,

the covariance is, with the Jacobian J and :math:`A = J^T J + \mathrm{diag}(s^{-2})`, either :math:`A^{-1}` (the
residuals are independent and as large as stated) or, where residuals of one cluster g of G (a run, a session)
belong together (Liang and Zeger, Biometrika 73, 1986), that of the jackknife to first order,

.. math:: C = \tfrac{G - 1}{G} \sum_g u_g u_g^T, \qquad u_g = (A - J_g^T J_g)^{-1} J_g^T r_g ,

what leaving out each cluster moves the values by (CR3 of Bell and McCaffrey, Survey Methodology 28, 2002: with a dozen
clusters the plain sandwich is too narrow, as a fit goes after the clusters that weigh most),
whose intervals are those of Student's t with G - 1 degrees of freedom.  Where a fit is not linear in what
clusters differ by, :mod:`terrain.bootstrap` draws them with replacement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy import stats
from scipy.optimize import least_squares
from scipy.special import ndtr

from terrain.bootstrap import LEVEL
from terrain.records import Array

#: Standard deviation with the measurements over that of the prior, below which they identify a parameter.
IDENTIFIED_RATIO = 0.5

EDGE = 1e-3  #: In units of the search: a value so near to its bound stands at it.
#: Least weight of a nominal value, over that of a unit of the search: where nothing that is measured depends on a
#: parameter, a search by trust regions would stop anywhere.
REGULAR = 1e-6

PASSES = 4  #: Of a fit that finds the size of its residuals.
UNSEEN = 1e-6  #: Part of a parameter in directions of no curvature from which on it is not identified.
_Candidate = TypeVar("_Candidate")


class Parameter(NamedTuple):
    """A number that is identified."""

    name: str  #: ends in its unit
    nominal: float  #: where the search begins, and the mean of its prior
    low: float = -math.inf  #: bounds
    high: float = math.inf
    prior_std: float = math.inf  #: standard deviation of the prior; infinite of none
    step: float = (
        math.nan
    )  #: size of a usual change, the unit of the search; that of the prior by default, or 1

    @property
    def unit(self) -> float:
        """Unit of the search."""
        if math.isfinite(self.step):
            return self.step
        return self.prior_std if math.isfinite(self.prior_std) else 1.0


class Fit(NamedTuple):
    """Parameters that were identified."""

    parameters: tuple[Parameter, ...]  #: k of them
    value: Array  #: (k,) and (k, k)
    cov: Array
    interval: Array  #: (2, k) lower and upper ends, 95 %
    identified: Array  #: (k,) whether the measurements narrow the prior to less than half, away from a bound
    at_bound: Array  #: (k,)
    influence: Array  #: (G, k) :math:`u_g`, what each cluster moves the values by; (0, k) without clusters
    residual: Array  #: (n,) of the measurements, at the values
    cost: float  #: half of the sum that is minimised

    @property
    def std(self) -> Array:
        """Standard deviations (k,)."""
        return np.asarray(np.sqrt(np.diag(self.cov)))

    def derived(self, function: Callable[[Array], Array]) -> tuple[Array, Array]:
        """Return what follows from the parameters (m,), and its 95 % interval (2, m), to first order.

        Parameters
        ----------
        function : of values (k,)

        Examples
        --------
        >>> x = np.arange(12.0)
        >>> fit = identify(lambda p: p[0] * x - 2.0 * x - np.sin(9 * x), [Parameter("slope_ratio", 1.0)])
        >>> value, (low, high) = fit.derived(lambda p: 10.0 * p)
        >>> bool(np.allclose(value, 10.0 * fit.value)), bool(np.allclose([low, high], 10.0 * fit.interval))
        (True, True)
        """
        value, h = np.asarray(function(self.value)), 1e-5
        steps = h * np.diag([p.unit for p in self.parameters])
        slopes = [
            (function(self.value + step) - function(self.value - step)) / (2 * step.sum()) for step in steps
        ]
        variance = np.einsum("im,ij,jm->m", slopes, self.cov, slopes)
        half = half_width(np.sqrt(variance), len(self.influence) - 1 if len(self.influence) else math.inf)
        return value, np.stack([value - half, value + half])


def identify(
    residual: Callable[[Array], Array],
    parameters: Sequence[Parameter],
    clusters: Array | None = None,
    robust: bool = False,
    starts: Sequence[Array] = (),
    derivative: Callable[[Array], Array] | None = None,
    scale: tuple[float, float] | None = None,
    **search: Any,
) -> Fit:
    r"""Identify parameters.

    Parameters
    ----------
    residual : gives the residuals (n,), or (n, m) of n measurements of m numbers, of values (k,)
    parameters : k of them
    clusters : (n,) number of the cluster of each measurement, 0 to G - 1; None where all are independent
    robust : whether rho is the soft L1, :math:`2 (\sqrt{1 + z} - 1)`, of residuals and priors; else z
    starts : values (k,) to begin at, of which the best end counts; the nominal ones by default
    derivative : of the residuals, flat (n, k), by the values; by small differences otherwise, which see nothing where a
        residual goes in steps
    scale : where the standard deviation is not known: that to begin with, and the least.  Each of :data:`PASSES` takes
        the median length of the residuals that the one before left
    search : further arguments of :func:`scipy.optimize.least_squares`

    Examples
    --------
    >>> x = np.arange(12.0)
    >>> line = [Parameter("intercept_m", 0.0), Parameter("slope_ratio", 1.0)]
    >>> fit = identify(lambda p: p[0] + p[1] * x - (2 + 3 * x), line, clusters=np.arange(12) // 3)
    >>> fit.value.round(6), fit.interval[:, 1].round(6)
    (array([2., 3.]), array([3., 3.]))
    """
    if scale is not None:
        size, least = scale
        for _ in range(PASSES):
            scaled_by = partial(lambda size, values: residual(values) / size, size)
            fit = identify(scaled_by, parameters, clusters, robust, starts, derivative, **search)
            lengths = np.abs(np.hypot.reduce(np.atleast_2d(residual(fit.value).T)))
            starts, size = [fit.value], max(float(np.median(lengths)), least)
        return fit
    nominal, low, high, prior_std = (np.array([p[i] for p in parameters]) for i in range(1, 5))
    unit = np.array([p.unit for p in parameters])
    bounds = (low - nominal) / unit, (high - nominal) / unit

    held = np.maximum(unit / prior_std, REGULAR)

    def whole(scaled: Array) -> Array:
        return np.concatenate([np.ravel(residual(nominal + unit * scaled)), held * scaled])

    if derivative is not None:
        search["jac"] = lambda scaled: np.vstack([derivative(nominal + unit * scaled) * unit, np.diag(held)])
    best, loss = None, "soft_l1" if robust else "linear"
    for start in starts if len(starts) else [nominal]:
        inside = np.clip((start - nominal) / unit, bounds[0] + 1e-6, bounds[1] - 1e-6)
        found = least_squares(whole, inside, bounds=bounds, loss=loss, **search)
        if best is None or found.cost < best.cost:
            best = found
    assert best is not None
    n = len(best.fun) - len(parameters)
    value, left, by = nominal + unit * best.x, best.fun[:n], best.jac[:n]
    normal = by.T @ by + np.diag((unit / prior_std) ** 2)
    inverse = np.linalg.pinv(normal, hermitian=True)
    cov, influence, dof = inverse * np.outer(unit, unit), np.empty((0, len(value))), math.inf
    if clusters is not None:
        # the Jacobian of a robust loss is that of its curvature, (1 + z)^(-3/4) J, and its slope (1 + z)^(-1/2)
        scores = by * (left * (1.0 + left**2) ** 0.25 if robust else left)[:, None]
        influence = leave_out(by, scores, np.repeat(clusters, n // len(clusters)), normal) * unit
        cov, dof = jackknife_covariance(influence), len(influence) - 1
    at_bound = np.minimum(value - low, high - value) < EDGE * unit
    unseen = np.diag(np.eye(len(value)) - inverse @ normal) > UNSEEN  # nothing that is measured depends on it
    std = np.where(unseen, math.inf, np.sqrt(np.diag(cov)))
    half = half_width(std, dof)
    # of clusters that all say nothing, what leaving one out moves is nothing too: the curvature has to narrow it
    narrowed = np.maximum(std, np.sqrt(np.diag(inverse)) * unit)
    identified = ~at_bound & ~unseen & ~(narrowed >= IDENTIFIED_RATIO * prior_std)
    interval = np.stack([value - half, value + half])
    return Fit(
        tuple(parameters), value, cov, interval, identified, at_bound, influence, left, float(best.cost)
    )


def leave_out(by: Array, scores: Array, clusters: Array, normal: Array) -> Array:
    """Return what leaving out each cluster moves a fit by, to first order (G, k).

    Parameters
    ----------
    by : (n, k) derivatives of the residuals
    scores : (n, k) the same times the residuals
    clusters : (n,) number of the cluster of each residual, 0 to G - 1
    normal : (k, k) matrix A of the fit
    """
    moved = []
    for g in range(int(clusters.max()) + 1):
        own = clusters == g
        rest = normal - by[own].T @ by[own]
        moved.append(np.linalg.pinv(rest, hermitian=True) @ scores[own].sum(axis=0))
    return np.array(moved)


def jackknife_covariance(moved: Array) -> Array:
    """Return the covariance (k, k) of a fit by what leaving out each cluster moves it by (G, k)."""
    return np.asarray((len(moved) - 1) / len(moved) * moved.T @ moved)


def half_width(std: Array | float, dof: float, level: float = LEVEL, bounded: float = 0.0) -> Array:
    r"""Return half the interval of a number whose standard deviation has ``dof`` degrees of freedom.

    Beside its normal error it may have one that lies anywhere within ``bounded`` on either side.  Of the sum of both,
    with the normal one's :math:`\sigma` and :math:`G(z) = z \Phi(z) + \varphi(z)`, the part within h is

    .. math:: \tfrac{\sigma}{b} \big(G(\tfrac{h + b}{\sigma}) - G(\tfrac{h - b}{\sigma})\big) - 1 .

    Examples
    --------
    >>> half_width(1.0, 10.0).round(2), half_width(1.0, float("inf")).round(2)
    (np.float64(2.23), np.float64(1.96))
    >>> [half_width(std, float("inf"), bounded=1.0).round(2).item() for std in (0.0, 0.1, 1.0)]
    [0.95, 0.98, 2.25]
    """
    tail = (1 + level) / 2
    half = np.float64(stats.t.ppf(tail, dof)) * np.asarray(std)
    if not bounded > 0.0:
        return half
    sigma = np.maximum(half / stats.norm.ppf(tail), 1e-6 * bounded)

    def integral(z: Array) -> Array:
        return np.asarray(z * ndtr(z) + stats.norm.pdf(z))

    low, high = np.zeros_like(half), half + bounded
    for _ in range(60):
        middle = (low + high) / 2
        apart = integral((middle + bounded) / sigma) - integral((middle - bounded) / sigma)
        less = sigma / bounded * apart - 1.0 < level
        low, high = np.where(less, middle, low), np.where(less, high, middle)
    return np.asarray((low + high) / 2)[()]


def std_interval(variance: float, dof: float, level: float = LEVEL) -> tuple[float, float]:
    """Return the interval of a standard deviation whose variance was found with ``dof`` degrees of freedom.

    Examples
    --------
    >>> low, high = std_interval(4.0, 100.0)
    >>> round(low, 2), round(high, 2)
    (1.76, 2.32)
    """
    low, high = stats.chi2.ppf([(1 - level) / 2, (1 + level) / 2], dof)
    return math.sqrt(variance * dof / high), math.sqrt(variance * dof / low)


def folds(fold: Array) -> Iterator[tuple[Array, Array]]:
    """Yield the places of training and of tested members for each distinct value of ``fold`` (n,) in turn.

    Examples
    --------
    >>> [test.tolist() for _, test in folds(np.array([0, 1, 0]))]
    [[0, 2], [1]]
    """
    for value in np.unique(fold):
        yield np.flatnonzero(fold != value), np.flatnonzero(fold == value)


def deal(clusters: Array, n_folds: int, rng: np.random.Generator) -> Array:
    """Return the fold (n,) of each member, whole clusters dealt at random into folds of about equal number.

    Examples
    --------
    >>> deal(np.array(["a", "a", "b", "c"]), 3, np.random.default_rng(0)).tolist()
    [2, 2, 0, 1]
    """
    names, number = np.unique(clusters, return_inverse=True)
    return np.asarray((rng.permutation(len(names)) % n_folds)[number])


def select(
    score: Callable[[_Candidate, Array, Array], Array],
    candidates: Sequence[_Candidate],
    fold: Array,
    errors: float = 1.0,
) -> tuple[_Candidate, Mapping[_Candidate, Array]]:
    """Return the candidate that predicts clusters best which its fit did not have, and the scores of each.

    Parameters
    ----------
    score : of a candidate fitted to some clusters, for each of others: larger is better
    candidates : the plainest first; a later one is taken where it is better than the one taken before by
        more than ``errors`` standard errors of the difference
    fold : (G,) of each cluster
    errors : 0 where candidates do not contain each other

    Examples
    --------
    >>> values = np.array([1.0, 1.2, 0.9, 1.1])
    >>> miss = lambda power, train, test: -(values[test] - (values[train] ** power).mean()) ** 2
    >>> select(miss, [0, 1, 8], np.arange(4), 0.0)[0]
    0
    """
    scores: dict[_Candidate, Array] = {}
    taken = candidates[0]
    for candidate in candidates:
        scores[candidate] = np.empty(len(fold))
        for train, test in folds(fold):
            scores[candidate][test] = score(candidate, train, test)
        gain = scores[candidate] - scores[taken]
        if gain.mean() > errors * gain.std(ddof=1) / math.sqrt(len(gain)):
            taken = candidate
    return taken, scores
