"""Fit of a law of thrust over load to the bins of several runs, and the choice of the law.

Samples (slip s, thrust over load mu) of a run are correlated in time and share the run's terrain, load and
tyres, so they are gathered in bins of slip first, and each run has a factor g_r and an offset of slip b_r of
its own::

    mu = g_r f(s + b_r; theta)      g_r about 1, RUN_STD_RATIO; b_r about 0, SLIP_OFFSET_STD

with a law f of :mod:`terrain.slip_learning.laws`.  Errors are in both axes: where the curve has the slope f',
a bin has the variance ``var(mu) + f'^2 var(s)`` (effective variance; Orear, American Journal of Physics 50,
1982).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from terrain.records import Array
from terrain.slip_learning.laws import LAW_BOUNDS, LAW_PARAMETERS, traction_ratio
from terrain.slip_learning.samples import RunBins

RUN_STD_RATIO = 0.15
"""Prior standard deviation of a run's factor about 1: friction from place to place (8 %), and load."""

SLIP_OFFSET_STD = 0.004
"""Prior standard deviation of the offset of all slips of a run: half a percent of rolling radius a wheel
(data/spread), of three wheels."""

NO_CURVE = "none"
"""Name of the reference model of :func:`left_out_scores`, which does not depend on the slip."""

_MAGIC_PRIOR = {"shape_ratio": (1.65, 1.0), "curvature_ratio": (0.5, 2.0)}
"""Mean and standard deviation: Pacejka's usual C of pure longitudinal slip, and E up to 1; they matter where
the data end before the peak."""

_MIN_VARIANCE = 1e-9


class Fit(NamedTuple):
    """A law with its parameters, the factor of each run, and the mean squared normalized residual."""

    law: str
    parameters: tuple[float, ...]
    run_factors: tuple[float, ...]
    misfit: float


class _RunTerms(NamedTuple):
    """Factor less 1 and offset of slip of each run (runs,), and the residual of each bin (k,)."""

    factor: Array
    offset: Array
    residual: Array


class _Pooled:
    """All bins of all runs, one after the other."""

    def __init__(self, runs: Sequence[RunBins]) -> None:
        self.n = len(runs)
        self.run = np.repeat(np.arange(self.n), [len(run.slip_ratio) for run in runs])
        self.slip, self.slip_std, self.traction, self.std = (
            np.concatenate([getattr(run, name) for run in runs])
            for name in ("slip_ratio", "slip_std", "traction_ratio", "traction_std")
        )

    def curve(self, law: str, theta: Sequence[float] | Array) -> tuple[Array, Array]:
        """Return value and slope (k,) of the curve at each bin."""
        f = traction_ratio(law, theta, self.slip)
        return f, (traction_ratio(law, theta, self.slip + 1e-4) - f) / 1e-4

    def variance(self, law: str, theta: Sequence[float] | Array) -> Array:
        """Return the effective variance (k,) of each bin."""
        by_slip = self.curve(law, theta)[1] * self.slip_std
        return np.asarray(np.maximum(self.std**2 + by_slip**2, _MIN_VARIANCE))

    def run_terms(self, law: str, theta: Array, variance: Array) -> _RunTerms:
        """Return the most likely factor and offset of each run.

        ``mu = (1 + g) f + b f'`` is linear in both, with a prior on each: the solution is in closed form.
        """
        f, slope = self.curve(law, theta)
        residual = self.traction - f
        sums = [
            np.bincount(self.run, product / variance, self.n)
            for product in (f * f, f * slope, slope * slope, f * residual, slope * residual)
        ]
        gg, gb, bb = sums[0] + RUN_STD_RATIO**-2, sums[1], sums[2] + SLIP_OFFSET_STD**-2
        det = gg * bb - gb**2
        factor, offset = (bb * sums[3] - gb * sums[4]) / det, (gg * sums[4] - gb * sums[3]) / det
        return _RunTerms(factor, offset, residual - factor[self.run] * f - offset[self.run] * slope)

    def residuals(self, theta: Array, law: str, variance: Array) -> Array:
        """Return normalized residuals of bins, of the runs' priors, and of the law's priors."""
        terms = self.run_terms(law, theta, variance)
        parts = [
            terms.residual / np.sqrt(variance),
            terms.factor / RUN_STD_RATIO,
            terms.offset / SLIP_OFFSET_STD,
        ]
        if law == "magic":
            place = LAW_PARAMETERS[law].index
            priors = [(theta[place(name)] - mean) / std for name, (mean, std) in _MAGIC_PRIOR.items()]
            parts.append(np.array(priors))
        return np.concatenate(parts)

    def log_likelihood(self, f: Array, slope: Array, variance: Array) -> float:
        """Return the log density of the bins of a single run, its factor and its offset integrated out."""
        effects = np.column_stack([f * RUN_STD_RATIO, slope * SLIP_OFFSET_STD])
        cov = np.diag(variance) + effects @ effects.T
        residual = self.traction - f
        _, log_det = np.linalg.slogdet(cov)
        mahalanobis = residual @ np.linalg.solve(cov, residual)
        return -0.5 * float(mahalanobis + log_det + len(f) * math.log(2 * math.pi))


def fit_curve(law: str, runs: Sequence[RunBins], start: Sequence[float] | None = None) -> Fit:
    """Return a law fitted to runs, each with a factor and an offset of its own.

    Parameters
    ----------
    law : one of :data:`terrain.slip_learning.laws.LAW_PARAMETERS`
    runs : at least one with a bin
    start : parameters to start from, of a fit to nearly the same runs; by default several starts are tried

    Notes
    -----
    The effective variance of a bin depends on the slope, hence on the fit: it is held constant during a
    search and then renewed.  If it changed within the search, a steep curve would excuse its own residuals.
    """
    pooled = _Pooled(runs)
    candidates = []
    for guess in [np.asarray(start)] if start is not None else _starts(law, pooled):
        theta = _search(pooled, law, guess, renew=start is None)
        variance = pooled.variance(law, theta)
        cost = float(np.sum(pooled.residuals(theta, law, variance) ** 2) + np.sum(np.log(variance)))
        candidates.append((cost, theta))
    theta = min(candidates, key=lambda each: each[0])[1]
    variance = pooled.variance(law, theta)
    terms = pooled.run_terms(law, theta, variance)
    misfit = float(np.mean(terms.residual**2 / variance))
    return Fit(law, tuple(float(x) for x in theta), tuple(1.0 + float(g) for g in terms.factor), misfit)


def _search(pooled: _Pooled, law: str, guess: Array, renew: bool) -> Array:
    """Return the parameters of least cost near a guess, with the variance of bins renewed twice or never."""
    low, high = (np.array(bound) for bound in LAW_BOUNDS[law])
    theta = np.clip(guess, low + 1e-6, high - 1e-6)
    variance = pooled.std**2 if renew else pooled.variance(law, theta)
    for _ in range(3 if renew else 1):
        found = least_squares(
            pooled.residuals,
            theta,
            args=(law, variance),
            bounds=(low, high),
            x_scale=np.maximum(np.abs(theta), 0.1),
            xtol=1e-5,
            ftol=1e-5,
            gtol=1e-8,
            max_nfev=60,
        )
        theta = np.clip(found.x, low + 1e-6, high - 1e-6)
        variance = pooled.variance(law, theta)
    return theta


def _starts(law: str, pooled: _Pooled) -> list[Array]:
    top = max(float(np.quantile(pooled.traction, 0.95)), 0.02)
    reach = max(float(np.max(pooled.slip)), 0.05)
    if law == "janosi":
        return [
            np.array([top * scale, reach * part]) for scale, part in ((1.2, 0.05), (1.5, 0.3), (3.0, 1.0))
        ]
    return [
        np.array([math.tan(math.pi / (2 * shape)) / (reach * part), shape, top, curvature])
        for part in (0.2, 0.5, 1.0)
        for shape, curvature in ((1.4, 0.0), (1.9, 0.9))
    ]


def left_out_scores(runs: Sequence[RunBins]) -> dict[str, Array]:
    """Return the log likelihood (n,) of each run under a fit to the others, by law.

    :data:`NO_CURVE` is a model that does not depend on the slip: the mean of the others' bins.
    """
    scores: dict[str, list[float]] = {law: [] for law in (*LAW_PARAMETERS, NO_CURVE)}
    of_all = {law: fit_curve(law, runs).parameters for law in LAW_PARAMETERS}
    for number, run in enumerate(runs):
        others = [*runs[:number], *runs[number + 1 :]]
        left_out = _Pooled([run])
        for law in LAW_PARAMETERS:
            theta = fit_curve(law, others, of_all[law]).parameters
            f, slope = left_out.curve(law, theta)
            scores[law].append(left_out.log_likelihood(f, slope, left_out.variance(law, theta)))
        traction = np.concatenate([other.traction_ratio for other in others])
        variance = left_out.std**2 + float(np.var(traction)) + _MIN_VARIANCE
        level = np.full(len(left_out.slip), float(traction.mean()))
        scores[NO_CURVE].append(left_out.log_likelihood(level, np.zeros_like(level), variance))
    return {law: np.array(values) for law, values in scores.items()}


def chosen_law(scores: Mapping[str, Array]) -> str:
    """Return the law that predicts left-out runs better.

    ``magic`` has to do so by more than a standard error, since it nearly contains the other.

    Examples
    --------
    >>> chosen_law({"janosi": np.array([1.0, 2.0, 3.0]), "magic": np.array([4.0, 5.5, 6.0])})
    'magic'
    """
    gain = scores["magic"] - scores["janosi"]
    error = float(np.std(gain, ddof=1)) / math.sqrt(len(gain))
    return "magic" if float(np.mean(gain)) > error else "janosi"
