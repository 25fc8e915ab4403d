"""How a value differs between runs: by a trend or a change in their order, in two groups, by session, or in one run.

Runs have values ``v_i`` with variances ``s_i^2`` by the noise.  A pattern is a design ``X`` with

    v = X b + e,   e_i ~ N(0, s_i^2 + t^2),

and the scatter ``t`` of greatest likelihood.  Its evidence over one value of all runs is the likelihood ratio as an F
statistic; the probability is multiplied by the number of patterns of its kind (Bonferroni), as two groups may be any.
Runs show their scatter themselves: what robots of a kind differ by from run to run is not asked.

The likelihood is that of normal scatter, where two groups explain a skewed or a heavy tail.  So they need a gap that no
law of one mode has: away from its mode a density falls, and runs beyond a gap are further apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln
from scipy.stats import f as fisher
from scipy.stats import t as student

from terrain.discrepancy.evidence import TRUST_DOF, z_of
from terrain.records import Array

MIN_RUNS, MIN_SIDE, MIN_GROUP = 6, 3, 2
"""Least number of runs, of runs on either side of a change and in a session, and of runs in a group."""

SCATTERS = np.concatenate([[0.0], np.geomspace(1e-3, 1.0, 40)])
"""Scatters that are tried, over the range of the values."""


GROUPS_P = 0.02
"""Two values of runs are groups by less than that probability of such a gap in a law of one mode: either side of it."""

ROGUE_TAIL_DOF, ROGUE_P = 4.0, 0.01
"""A rogue run is improbable even where runs scatter with Student's distribution of so many degrees, as measured ones
do: by less than that probability, all runs together."""


class Kind(StrEnum):
    """How a value differs from run to run."""

    SPREAD = "spread"  #: at random
    TREND = "trend"  #: in proportion to the place in the order of the runs
    CHANGE = "change"  #: one value up to a run, and another from the next
    GROUPS = "groups"  #: one of two values
    SESSIONS = "sessions"  #: one value a session
    TERRAINS = "terrains"  #: one value a terrain
    ROGUE = "rogue"  #: one run has another value than the rest


class Pattern(NamedTuple):
    """A pattern, and its values."""

    kind: Kind
    z: float  #: evidence over one value of all runs, as a standard normal number
    columns: Array  #: (n, m) design: of a trend 1 and the place, else which part a run is in
    coefficients: Array  #: (m,) of a trend the value at place 0 and its growth, else by part
    cov: Array
    dof: int  #: of the scatter

    @property
    def values(self) -> Array:
        """The values (n,) that it gives runs."""
        return np.asarray(self.columns @ self.coefficients)

    def at(self, combination: Array) -> tuple[float, tuple[float, float]]:
        """Return a combination (m,) of the coefficients, and its 95 % interval."""
        value = float(combination @ self.coefficients)
        half = float(student.ppf(0.975, self.dof)) * math.sqrt(float(combination @ self.cov @ combination))
        return value, (value - half, value + half)


def pattern_of(
    value: Array, variance: Array, place: Array, session: Sequence[str], terrain: Sequence[str] = ()
) -> Pattern | None:
    """Return the pattern with the greatest evidence; None for too few runs, or values that do not differ.

    Parameters
    ----------
    value, variance : (n,) by run, the variance by the noise infinite where a run shows nothing
    place : (n,) of the runs in their order
    session, terrain : (n,) of the runs by name, empty where that is not known

    Examples
    --------
    >>> noise, place = 0.001 * np.random.default_rng(0).standard_normal(20), np.arange(20.0)
    >>> trend = pattern_of(noise - 0.004 * place, np.full(20, 1e-6), place, [""] * 20)
    >>> str(trend.kind), trend.z > 6.0, pattern_of(noise, np.full(20, 1e-6), place, [""] * 20).z < 4.0
    ('trend', True, True)
    """
    known = np.isfinite(variance)
    v, s2, at, n = value[known], variance[known], place[known], int(known.sum())
    if n < MIN_RUNS or not np.ptp(v) > 0.0:
        return None
    loss, _, _, weight, _ = fit_scatter(v, s2, np.ones((n, 1)))
    off = v - np.average(v, weights=weight)
    cuts, sizes = np.unique(at)[MIN_SIDE : 1 - MIN_SIDE], np.arange(MIN_GROUP, n - MIN_GROUP + 1)
    cuts_value = np.sort(v)[sizes]
    choices = gammaln(n + 1) - gammaln(sizes + 1) - gammaln(n - sizes + 1) + math.log(sizes.size)
    # of each kind which runs are in the second part, on all runs, and the logarithm of how many there are
    parts = [
        (Kind.CHANGE, place >= cuts[:, None], np.full(cuts.size, math.log(cuts.size))),
        (Kind.GROUPS, (value >= cuts_value[:, None]) & known, choices),
        (Kind.ROGUE, np.eye(len(value), dtype=bool)[known], np.full(n, math.log(n))),
    ]
    designs = [(Kind.TREND, np.column_stack([np.ones_like(place), place]), 0.0)] * bool(np.ptp(at) > 0.0)
    for kind, second, log_choices in parts:
        own = second[:, known] - (second[:, known] @ weight / weight.sum())[:, None]
        square = (own @ (weight * off)) ** 2 / np.maximum(own**2 @ weight, 1e-30)
        left = 1.0 - square / (weight @ off**2)
        k = int(np.argmin(0.5 * n * np.log(np.maximum(left, 1e-12)) + log_choices))
        designs.append((kind, np.column_stack([~second[k], second[k]]).astype(float), float(log_choices[k])))
    for kind, named in ((Kind.SESSIONS, session), (Kind.TERRAINS, terrain)):
        of = np.array([[own == name for name in sorted(set(named))] for own in named], dtype=float)
        if len(named) and of.shape[1] > 1 and of[known].sum(axis=0).min() >= MIN_SIDE:
            designs.append((kind, of, 0.0))
    best: Pattern | None = None
    for kind, columns, log_choice in designs:
        own_loss, coefficients, cov, own_weight, _ = fit_scatter(v, s2, columns[known])
        if kind in (Kind.GROUPS, Kind.ROGUE) and not _is_apart(
            kind, v, columns[known], coefficients, own_weight
        ):
            continue
        z = _z_of_losses(loss, own_loss, n, columns.shape[1], log_choice)
        if best is None or z > best.z:
            best = Pattern(kind, z, columns, coefficients, cov, n - columns.shape[1])
    return best


def evidence_of_parts(value: Array, variance: Array, second: Array) -> float:
    """Return the evidence that runs (n,) of a second part have another value than the others, as a normal number.

    Examples
    --------
    >>> second = np.arange(12) % 2 > 0
    >>> evidence_of_parts(second + 0.1 * np.sin(np.arange(12.0)), np.full(12, 1e-4), second) > 4.5
    True
    """
    known = np.isfinite(variance)
    parts = np.column_stack([~second[known], second[known]]).astype(float)
    if known.sum() < MIN_RUNS or parts.sum(axis=0).min() < MIN_GROUP or not np.ptp(value[known]) > 0.0:
        return 0.0
    losses = [
        fit_scatter(value[known], variance[known], columns).loss
        for columns in (parts.sum(axis=1)[:, None], parts)
    ]
    return _z_of_losses(losses[0], losses[1], int(known.sum()), 2, 0.0)


def _z_of_losses(none: float, own: float, n: int, n_columns: int, log_choices: float) -> float:
    """Return the evidence of a design of n runs over one value, as a standard normal number."""
    more, dof, ratio = n_columns - 1, n + TRUST_DOF - n_columns, max(none - own, 0.0) / (n + TRUST_DOF)
    log_p = float(fisher.logsf(math.expm1(min(ratio, 500.0)) * dof / more, more, dof))
    # where that underflows: far out the tail falls with this power
    return z_of(min(max(log_p, -0.5 * dof * ratio - 50.0) + log_choices, 0.0))


def _is_apart(kind: Kind, value: Array, columns: Array, coefficients: Array, weight: Array) -> bool:
    """Return whether two parts of runs are further apart than the tail of one law is from the rest."""
    left, change = value - columns @ coefficients, abs(float(coefficients[1] - coefficients[0]))
    if kind is Kind.ROGUE:
        rest = columns[:, 0] > 0
        scatter = math.sqrt(float(np.mean(left[rest] ** 2)))
        size = change / max(scatter, 1.0 / math.sqrt(float(weight[~rest][0])))
        # in standard deviations of the others, which are known by n - 2 degrees of freedom
        dof = 1.0 / (1.0 / ROGUE_TAIL_DOF + 1.0 / (len(value) - 2))
        size /= math.sqrt(1.0 - 2.0 / ROGUE_TAIL_DOF)
        return 2.0 * len(value) * float(student.sf(size, dof)) < ROGUE_P
    ends = [np.sort(value[of > 0]) for of in columns.T]
    low, high = sorted(ends, key=lambda own: own[0])
    gap = high[0] - low[-1]
    # away from its one mode a density falls, and is no more than even from the gap on: of m runs there m - 1 lie
    # within the range of these by chance
    within = [float(np.ptp(own) / (gap + np.ptp(own))) ** (len(own) - 1) for own in ends]
    return max(within) < GROUPS_P


class ScatterFit(NamedTuple):
    """A design fitted to values of runs that scatter about it."""

    loss: float  #: minus twice the log-likelihood, up to what no design changes
    coefficients: Array
    cov: Array
    weight: Array  #: (n,) of the runs
    scatter: float  #: beyond the noise


def fit_scatter(
    value: Array, variance: Array, columns: Array, scatters: Array = SCATTERS, trust: float = TRUST_DOF
) -> ScatterFit:
    """Return the fit of a design (n, m), with the scatter of greatest likelihood of some over the range of the values.

    Variances are known up to a factor near 1, as of ``trust`` values more: what is taken for noise of a run may be
    common to all of them.
    """
    scatters = scatters * np.ptp(value)
    weights = 1.0 / (variance + scatters[:, None] ** 2)
    covs = np.linalg.pinv(np.einsum("tn,ni,nj->tij", weights, columns, columns), hermitian=True)
    xs = np.einsum("tij,nj,tn->ti", covs, columns, weights * value)
    squares, n = (weights * (value - xs @ columns.T) ** 2).sum(axis=1), len(value) + trust
    losses = n * np.log1p(squares / trust) - np.log(weights).sum(axis=1)
    k = int(np.argmin(losses))
    factor = (trust + squares[k]) / (n - columns.shape[1])
    return ScatterFit(float(losses[k]), xs[k], covs[k] * factor, weights[k] / factor, float(scatters[k]))
