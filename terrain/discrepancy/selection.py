"""Selection of effects: evidence and gain on runs left out, clustered by run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, norm
from scipy.stats import t as student

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.discrepancy.evidence import Evidence, partial_information
from terrain.effects import BOUNDS, INDEX, Effect
from terrain.records import Array

Z_EFFECT = 4.0  #: Evidence an effect needs, as a standard normal number: 6e-5, times a library of 26
EXCITED_RATIO = 0.1  #: An effect counts as not excited if its detection limit exceeds this ratio of its bound

TRUST_DOF = 8.0
"""Degrees of freedom of the noise found by whitening, beside those of the scatter between clusters."""

MIN_CLUSTERS = 6  #: With fewer runs, their time blocks are the clusters

N_BOOTSTRAP = 1000


class WaldTest(NamedTuple):
    """Evidence of an effect beside those selected.

    It is the fit over its noise, whose variance is weighed from whitening and from the scatter between clusters,
    as a t statistic.
    """

    change: Array  #: (p,) of its parameters, fitted together with the selected ones
    z: float  #: the standard normal number of the same improbability
    dispersion: float  #: scatter between clusters over that which the noise allows, as variances
    gain: Array  #: (runs,) fall of minus twice the log-likelihood of each run when it is left out of the fit
    inside: bool  #: whether the fitted values lie within their bounds

    @property
    def significant(self) -> bool:
        """Whether the effect is within its bounds, above the threshold, and gains on runs left out."""
        return self.inside and self.z > Z_EFFECT and gain_interval(self.gain)[0] > 0

    @property
    def inflation(self) -> float:
        """By how much the variance of its values is larger than by the noise alone; 1 at the least."""
        return max(self.dispersion, 1.0)


def wald_test(info: Evidence, selected: Sequence[str], effect: Effect) -> WaldTest:
    """Return the evidence of an effect beside the parameters selected."""
    own = [p.name for p in effect.parameters]
    base = info.places([name for name in selected if name not in own])
    both, n = base + info.places(own), len(base)
    total, score = info.total([*(info.names[i] for i in base), *own])
    if not np.diag(total)[n:].min() > 1e-12:
        return WaldTest(np.zeros(len(own)), 0.0, 0.0, np.zeros(len(info.a)), False)
    # direction in which the new ones change while the selected ones follow
    follow, free = partial_information(total, range(n), range(n, len(both)))
    own_score = score[n:] - follow.T @ score[:n]
    if not np.linalg.eigvalsh(free)[0] > 1e-9 * np.diag(total)[n:].min():
        free = free + 1e-9 * np.diag(np.diag(total)[n:])
    change = np.linalg.solve(free, own_score)
    statistic = float(own_score @ change)
    inside = all(
        BOUNDS[name][0] - 1e-9 <= info.vector[INDEX[name]] + value <= BOUNDS[name][1]
        for name, value in zip(own, change, strict=True)
    )
    dispersion, dof = _dispersion(info, both, n, follow, free, change)
    z = z_of_t(math.sqrt(_one_degree(statistic, len(own))) / math.sqrt(dispersion), dof)
    return WaldTest(change, z, dispersion, held_out_gain(info, base, both), inside)


def _one_degree(statistic: float, degrees: int) -> float:
    """Return the chi^2 of one degree that is as improbable as one of several."""
    if degrees == 1:
        return statistic
    log_p = float(chi2.logsf(statistic, degrees))
    if math.isinf(log_p):  # it underflows; far out the density falls as the tail does
        log_p = float(chi2.logpdf(statistic, degrees)) + math.log(2.0)
    return z_of(log_p) ** 2


def _dispersion(
    info: Evidence, both: list[int], n: int, follow: Array, free: Array, change: Array
) -> tuple[float, float]:
    """Return the variance of a change along itself over that from the noise, and its degrees of freedom.

    The scatter between clusters (runs; time blocks where runs are few) gives one estimate, with as many
    degrees of freedom as there are informative clusters; the noise gives 1 with :data:`TRUST_DOF`.  Both are
    weighted by their degrees of freedom.
    """
    a, g = info.clusters(both, len(info.a) >= MIN_CLUSTERS)
    direction = np.concatenate([-follow @ change, change])
    size = float(change @ free @ change)
    if not size > 0:
        return 1.0, TRUST_DOF
    x = np.concatenate([np.zeros(n), change])
    if n:
        total, score = a.sum(axis=0), g.sum(axis=0)
        x[:n] = np.linalg.lstsq(total[:n, :n], score[:n] - total[:n, n:] @ change, rcond=1e-10)[0]
    variance, dof = clustered_variance(a, g, x, direction, size)
    of_model = (free @ change) * info.model_std[both[n:]]
    return variance + float((of_model**2).sum()) / size, dof


def clustered_variance(a: Array, g: Array, x: Array, direction: Array, size: float) -> tuple[float, float]:
    """Return the variance of a fit ``x`` (k,) along a direction over that from the noise, and its degrees of freedom.

    ``size`` is the information along it, of all clusters (a, k, k) together.
    """
    part = (g - a @ x) @ direction
    fraction = np.clip(np.einsum("i,kij,j->k", direction, a, direction) / size, 0.0, 0.9)
    return pooled_variance(part, fraction, size)


def pooled_variance(part: Array, fraction: Array, size: float) -> tuple[float, float]:
    """Return a variance over that from the noise, and its degrees of freedom.

    Of each cluster there is what is left of its score at the fit (``part``) and its ``fraction`` of the
    information; ``size`` is the information in all, which is the variance of the score by the noise.
    """
    m = len(part)
    variance = float(((part / (1.0 - fraction)) ** 2).sum()) * (m - 1) / m / size
    dof = max(min(1.0 / (float((fraction**2).sum()) + 1e-12), m) - 1.0, 1.0)
    both = TRUST_DOF + dof * variance
    # Satterthwaite: where clusters scatter far more than the noise allows, only their degrees count
    return both / (TRUST_DOF + dof), both**2 / (TRUST_DOF + dof * variance**2)


def z_of_t(t: float, dof: float) -> float:
    """Return the normal number that is as improbable as a t statistic, both two-sided."""
    return z_of(float(student.logsf(t, dof)) + math.log(2.0))


def z_of(log_p: float) -> float:
    """Return the normal number of a two-sided log probability.

    Examples
    --------
    >>> round(z_of(math.log(0.05)), 2)
    1.96
    """
    if log_p > -600.0:
        return max(float(norm.isf(math.exp(log_p) / 2)), 0.0)
    return math.sqrt(-2.0 * log_p)


def held_out_gain(info: Evidence, base: list[int], both: list[int]) -> Array:
    """Return the fall (runs,) of each run's loss when it is left out of the fit, of ``both`` over ``base``."""
    losses = []
    for at in (base, both):
        x, (a, g) = fits_without_each(info, at), info.clusters(at)
        losses.append(np.einsum("ki,kij,kj->k", x, a, x) - 2 * (x * g).sum(axis=1))
    return np.asarray(losses[0] - losses[1])


def fits_without_each(info: Evidence, at: Sequence[int]) -> Array:
    """Return the change (runs, k) of parameters that fits all runs but each of them."""
    a, g = info.clusters(at)
    # in standard deviations of each parameter; one without information in the other runs keeps its value
    unit = np.sqrt(np.maximum(np.einsum("kii->i", a), 1e-30))
    rest = (a.sum(axis=0) - a) / np.outer(unit, unit) + 1e-9 * np.eye(len(at))
    return np.asarray(np.linalg.solve(rest, ((g.sum(axis=0) - g) / unit)[:, :, None])[:, :, 0] / unit)


def gain_interval(gain: Array, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of the summed gain, by bootstrap over runs."""
    return percentile_interval(bootstrap_counts(len(gain), N_BOOTSTRAP, seed) @ gain)
