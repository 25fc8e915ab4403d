"""Evidence of runs on the simulation's parameters: products of whitened columns, one matrix a third of a run.

With whitened residual ``r``, sensitivities ``J`` and, of each run, deviations ``b ~ N(0, D)`` of the
parameters that vary from run to run (sensitivities ``N``), minus twice the log-likelihood of a change ``x``
is, up to a constant,

    c - 2 g'x + x'A x,   A = J'V J,  g = J'V r,  V = I - N (N'N + D^-1)^-1 N'

summed over runs.  Every question is a fit on these small matrices: of which parameters, in which parts of the
data each has a value of its own, beside what differs from run to run at random.  Sensitivities are taken anew
where a fit has moved far.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.noise import ORDER, ORDERS, WHITE, Noise, noise_of, whiten
from terrain.discrepancy.runs import LowPass, Rows, Signals, Simulation, rows_of
from terrain.effects import BOUNDS, CHANNELS, INDEX
from terrain.records import Array

N_BLOCKS = 3  #: Time blocks of a run; they serve as clusters where runs are few
N_PROBES = 4  #: Of the inputs that are taken out before the noise is estimated, for each channel

PRIOR_STD = {name: 0.5 * max(abs(low), high) for name, (low, high) in BOUNDS.items()}
"""Prior of a parameter while the whole library is freed to estimate the noise."""

UNKNOWN_STD = 1e-6  #: Prior of one that is not in the library: it stays where it is


class Statistics(NamedTuple):
    """What differs at random: noise of each channel, and standard deviation from run to run by parameter."""

    noise: Noise
    scatter: Mapping[str, float]


def marginal(grams: Array, random: Sequence[int] | Array, std: Array) -> tuple[Array, Array, Array]:
    """Integrate random columns, at places (q,) and of standard deviations (q,), out of grams (runs, parts, m, m).

    Returns
    -------
    total : (runs, m, m) products that are left
    shift : (runs, q, m) deviation of a run per unit of each column (of parameters, negative), and that which
        its residual shows
    inner : (runs, q, q) covariance of the deviations given the parameters
    """
    gram = grams.sum(axis=1)
    inner = np.linalg.inv(gram[:, random][:, :, random] + np.diag(1.0 / std**2))
    shift = inner @ gram[:, random]
    return gram - gram[:, :, random] @ shift, shift, inner


def marginal_parts(grams: Array, random: Sequence[int] | Array, std: Array) -> Array:
    """Return what is left of each part of a run, (runs, parts, m, m): they sum up to the total."""
    shift = marginal(grams, random, std)[1]
    back = shift.transpose(0, 2, 1)[:, None]
    follow = back @ grams[:, :, random]
    prior = back @ (shift / std[:, None] ** 2)[:, None] / grams.shape[1]
    return np.asarray(
        grams - follow - follow.transpose(0, 1, 3, 2) + follow[..., random] @ shift[:, None] + prior
    )


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of runs around one point of the parameters."""

    names: tuple[str, ...]  #: of the k parameters
    vector: Array  #: (len(PARAMETERS),) the point from which changes are counted
    origin: Array  #: the point where sensitivities were taken, whatever changes are counted from
    grams: Array
    """(runs, N_BLOCKS, k + 1, k + 1) products of whitened sensitivities and, last, of the residual at ``origin``,
    in each third of each run; nothing is marginalised."""
    nuisances: Array  #: (q,) places in ``names`` of what varies from run to run
    nuisance_std: Array  #: (q,) by how much
    rows: tuple[Rows, ...]  #: from which they come
    noise: Noise
    white: tuple[Array, ...]  #: of each run (k + 1, rows, channels) the columns, 0 where nothing was measured
    model_std: Array  #: (k,) error of the simulation itself in units of each parameter, the same in all runs

    def places(self, names: Sequence[str]) -> list[int]:
        """Return the positions of parameters in the matrices."""
        return [self.names.index(name) for name in names]

    @property
    def statistics(self) -> Statistics:
        """Noise and scatter that were estimated or given."""
        names = [self.names[i] for i in self.nuisances]
        return Statistics(self.noise, dict(zip(names, self.nuisance_std.tolist(), strict=True)))

    @cached_property
    def away(self) -> Array:
        """Where sensitivities were taken, over the point from which changes are counted (k,)."""
        at = [INDEX[name] for name in self.names]
        return self.origin[at] - self.vector[at]

    @cached_property
    def marginal(self) -> tuple[Array, Array, Array]:
        """Products around the origin with what varies integrated out, its shift and covariance: :func:`marginal`."""
        return marginal(self.grams, self.nuisances, self.nuisance_std)

    @property
    def a(self) -> Array:
        """``A`` of each run (runs, k, k)."""
        return self.marginal[0][:, :-1, :-1]

    @cached_property
    def g(self) -> Array:
        """``g`` of each run (runs, k)."""
        return np.asarray(self.marginal[0][:, :-1, -1] + self.a @ self.away)

    @cached_property
    def c(self) -> Array:
        """``c`` of each run (runs,)."""
        last = self.marginal[0][:, :, -1]
        return np.asarray(last[:, -1] + 2.0 * last[:, :-1] @ self.away + self.away @ self.a @ self.away)

    @property
    def origin_loss(self) -> float:
        """Sum of ``c`` at the origin."""
        return float(self.marginal[0][:, -1, -1].sum())

    @cached_property
    def blocks(self) -> tuple[Array, Array]:
        """``A`` and ``g`` of each third of each run, (runs, N_BLOCKS, k, k) and (runs, N_BLOCKS, k)."""
        parts = marginal_parts(self.grams, self.nuisances, self.nuisance_std)
        a = parts[:, :, :-1, :-1]
        return a, np.asarray(parts[:, :, :-1, -1] + a @ self.away)

    def clusters(self, at: Sequence[int], by_run: bool = True) -> tuple[Array, Array]:
        """Return ``A`` (clusters, n, n) and ``g`` (clusters, n) of some places, a cluster a run or a third of one."""
        a, g = (self.a, self.g) if by_run else (x.reshape(-1, *x.shape[2:]) for x in self.blocks)
        return a[:, at][:, :, at], g[:, at]

    def total(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Return ``A`` (n, n) and ``g`` (n,) of some parameters, all runs together."""
        a, g = self.clusters(self.places(names))
        return a.sum(axis=0), g.sum(axis=0)

    def fit(self, own: Sequence[str], others: Sequence[str], where: Array) -> tuple[Array, Array]:
        """Fit parameters in each group of the data, others in common, what varies from run to run marginalised.

        ``where`` (runs, N_BLOCKS) is the group of each third of each run.  Returned are values (groups, p), NaN
        where a group shows nothing, and their covariance (groups, p, groups, p) by the noise.
        """
        n_groups, p, q = int(where.max()) + 1, len(own), self.nuisances.size
        k = n_groups * p + len(others)
        design = np.zeros((*where.shape, len(self.names) + 1, q + k + 1))
        design[:, :, self.nuisances, np.arange(q)] = 1.0
        design[:, :, self.places(others), np.arange(q + n_groups * p, q + k)] = 1.0
        design[:, :, :, -1] = *self.away, 1.0
        for (i, b), group in np.ndenumerate(where):
            design[i, b, self.places(own), np.arange(q + group * p, q + (group + 1) * p)] = 1.0
        columns = design.transpose(0, 1, 3, 2) @ self.grams @ design
        free = marginal(columns, np.arange(q), self.nuisance_std)[0][:, q:, q:].sum(axis=0)
        total, m = free[:-1, :-1], n_groups * p
        cov = np.linalg.pinv(total, hermitian=True, rcond=1e-12)
        shown = np.diag(total)[:m] > 1e-9 * np.diag(total)[:m].max()
        values = np.where(shown, (cov @ free[:-1, -1])[:m], np.nan).reshape(n_groups, p)
        return values, cov[:m, :m].reshape(n_groups, p, n_groups, p)

    def channel_power(self, weights: Array) -> Array:
        """Return the square (channels,) over all runs of combinations (p, k) of the sensitivities."""
        changes = (np.tensordot(weights, white[:-1], axes=1) for white in self.white)
        return np.asarray(sum((change**2).sum(axis=(0, 1)) for change in changes))

    @property
    def freed(self) -> Array:
        """The information (k, k) of all runs with every parameter freed up to its prior."""
        return np.asarray(self.a.sum(axis=0) + self.prior)

    @property
    def prior(self) -> Array:
        """The information (k, k) of the priors."""
        return np.diag([1.0 / PRIOR_STD.get(name, UNKNOWN_STD) ** 2 for name in self.names])


def evidence_at(
    signals: Sequence[Signals],
    simulation: Simulation,
    vector: Array,
    parameters: Sequence[str],
    low_pass: LowPass,
    statistics: Statistics | None = None,
    own: Mapping[str, Array] | None = None,
    scatter: Mapping[str, float] | None = None,
) -> Evidence:
    """Return the evidence of runs around a point; noise and scatter are estimated unless given.

    What is assumed of the scatter is that of the simulation by default.  With ``own`` values (runs,) of some
    of the parameters, sensitivities are those of each run at its own; residuals are counted from the point
    all the same, linearly.
    """
    planar = {terrain: simulation.planar_on(terrain) for terrain in {run.terrain for run in signals}}
    assumed = simulation.scatter if scatter is None else scatter
    scattered = [name for name in assumed if assumed[name] > 0]
    names = tuple(dict.fromkeys([*parameters, *scattered]))
    own = own or {}
    at, columns = [INDEX[name] for name in own], [names.index(name) for name in own]
    rows = []
    for i, run in enumerate(signals):
        there = vector.copy()
        there[at] = [values[i] for values in own.values()]
        run_rows = rows_of(run, planar[run.terrain], there, names, low_pass)
        back = np.tensordot(vector[at] - there[at], run_rows.sensitivity[columns], axes=1)
        rows.append(run_rows._replace(predicted=run_rows.predicted + back))
    model_std = np.array([simulation.model_error.get(name, 0.0) for name in names])
    nuisances = np.array([names.index(name) for name in scattered], dtype=int)

    def whitened(noise: Noise, std: Array) -> Evidence:
        white = tuple(whiten_run(noise, run) for run in rows)
        grams = np.array([grams_of(columns) for columns in white])
        about = nuisances, std, tuple(rows), noise, white, model_std
        return Evidence(names, vector, vector, grams, *about)

    if statistics is not None:
        return whitened(statistics.noise, np.array([statistics.scatter[name] for name in scattered]))
    # by what the whole library and a few probes leave; the first fits weigh all frequencies alike: see WHITE
    speeds, row_s = [run.pace_mps for run in rows], float(np.median(np.diff(rows[0].time_s)))
    std = assumed_std = np.array([assumed[name] for name in scattered])
    noise = noise_of([run.residual for run in rows], speeds, row_s, orders=WHITE)
    for orders in (WHITE, ORDERS, ORDERS):
        loose = whitened(noise, std)
        if std.size:
            # about what the whole library explains of all runs alike
            x = np.linalg.solve(loose.freed, loose.g.sum(axis=0))
            along = loose.grams.sum(axis=1)[:, nuisances]
            std = scatter_of(along[:, :, nuisances], along[:, :, -1] - along[:, :, :-1] @ x, assumed_std)
            loose = replace(loose, nuisance_std=std)
        left, n_fitted = _library_residuals(loose)
        noise = noise_of(left, speeds, row_s, n_fitted, orders)
    plain = noise_of(_without_probes(loose, left), speeds, row_s, n_fitted + len(CHANNELS) * N_PROBES, ORDERS)
    return whitened(noise._replace(std=plain.std), std)


def grams_of(columns: Array) -> Array:
    """Return the products (N_BLOCKS, k, k) of columns (k, rows, channels) of a run in each third of its rows."""
    k, n, _ = columns.shape
    edges = [n * b // N_BLOCKS for b in range(N_BLOCKS + 1)]
    parts = [columns[:, edges[b] : edges[b + 1]].reshape(k, -1) for b in range(N_BLOCKS)]
    return np.array([part @ part.T for part in parts])


def whiten_run(noise: Noise, run: Rows) -> Array:
    """Return sensitivities and, last, the residual of a run whitened (k + 1, m, c), 0 where it is not known."""
    residual = run.residual
    known = np.isfinite(residual)
    measured = np.isfinite(noise.filters).all(axis=1)
    valid = known & measured
    for lag in range(1, ORDER + 1):
        used = measured & (noise.filters[:, lag] != 0.0)
        valid[lag:] &= known[:-lag] | ~used
        valid[:lag] &= ~used
    both = np.concatenate([run.sensitivity, residual[None]]) / noise.size(run.pace_mps)
    return np.asarray(whiten(noise.filters, both) * valid)


def _library_residuals(info: Evidence) -> tuple[list[Array], float]:
    """Return the residuals with the whole library and probes freed, and how many parameters were fitted."""
    _, shifts, inner = info.marginal
    x = np.linalg.solve(info.freed, info.g.sum(axis=0))
    left = []
    for run, shift in zip(info.rows, shifts, strict=True):
        move = x.copy()
        move[info.nuisances] += shift[:, -1] - shift[:, :-1] @ x
        left.append(run.residual - np.tensordot(move, run.sensitivity, axes=1))
    n_fitted = float(np.trace(np.linalg.solve(info.freed, info.a.sum(axis=0))))
    unknown = float((np.einsum("iqq->iq", inner) / info.nuisance_std**2).sum())
    return left, n_fitted + len(inner) * info.nuisances.size - unknown


def _without_probes(info: Evidence, left: Sequence[Array]) -> list[Array]:
    """Return residuals (rows, channels) without what a few probes explain in all runs alike.

    A constant, the speed, the turn and their product: what the library does not have is no noise.
    """
    probes = []
    for run in info.rows:
        speed, turn = run.inputs[:, 0], run.inputs[:, 1]
        probes.append(np.column_stack([np.ones_like(speed), speed, turn, speed * turn]))
    out = [residual.copy() for residual in left]
    size = np.concatenate([info.noise.size(run.pace_mps) for run in info.rows])
    every, value = np.concatenate(probes), np.concatenate(left)
    for c in range(value.shape[1]):
        known = np.isfinite(value[:, c] / size[:, c])
        if known.sum() > 10 * N_PROBES:
            weighted = every[known] / size[known, c : c + 1]
            fit = np.linalg.lstsq(weighted, value[known, c] / size[known, c], rcond=1e-10)[0]
            for residual, columns in zip(out, probes, strict=True):
                residual[:, c] -= columns @ fit
    return out


def fit_change(info: Evidence, names: Sequence[str]) -> tuple[Array, Array]:
    """Return the change (k,) of parameters that fits all runs best, and its covariance by the noise."""
    a, g = info.total(names)
    cov = np.linalg.pinv(a, hermitian=True)
    return cov @ g, cov


def loss_of(info: Evidence, names: Sequence[str]) -> float:
    """Return minus twice the log-likelihood of the best fit of parameters, up to what no fit changes."""
    a, g = info.total(names)
    return -float(g @ np.linalg.lstsq(a, g, rcond=1e-10)[0]) if len(names) else 0.0


def partial_information(a: Array, base: Sequence[int], own: Sequence[int]) -> tuple[Array, Array]:
    """Return the information on parameters at places ``own`` (q) while others (n) are fitted with them.

    First is by how much (n, q) the others go back where the parameters go ahead, then the information (q, q) that
    is left, the Schur complement.
    """
    if not len(base):
        return np.zeros((0, len(own))), a[np.ix_(own, own)]
    follow = np.linalg.lstsq(a[np.ix_(base, base)], a[np.ix_(base, own)], rcond=1e-10)[0]
    return follow, a[np.ix_(own, own)] - a[np.ix_(own, base)] @ follow


def correlation(a: Array, one: Sequence[int], other: Sequence[int]) -> float:
    """Return the largest correlation of what parameters at two sets of places change; 1 where one does nothing."""
    roots = []
    for at in (one, other):
        values, vectors = np.linalg.eigh(a[np.ix_(at, at)])
        if not values[-1] > 1e-12:
            return 1.0
        shown = values > 1e-9 * values[-1]
        roots.append(vectors[:, shown] / np.sqrt(values[shown]))
    between = roots[0].T @ a[np.ix_(one, other)] @ roots[1]
    return min(float(np.linalg.norm(between, 2)), 1.0)


def move_point(point: Array, names: Sequence[str], change: Array) -> Array:
    """Return the point that lies a change of the parameters named away, within the bounds of the library."""
    vector = point.copy()
    for name, value in zip(names, change, strict=True):
        vector[INDEX[name]] += value
        if name in BOUNDS:
            vector[INDEX[name]] = np.clip(vector[INDEX[name]], *BOUNDS[name])
    return vector


# -- Scatter from run to run of the parameters that vary by themselves, estimated from the runs -------------
#
# Of each run ``i`` the whitened residual, with what all runs have in common taken out, is ``N_i (m + b_i) +
# e_i`` with ``b_i ~ N(0, D)``.  The variances in ``D`` are those of greatest likelihood, by expectation and
# maximisation (Laird and Ware, Biometrics 1982): with ``G = N'N`` and ``s = N'r``,
#
#     V = (G + D^-1)^-1,   b = V (s - G m),   u = (n + 1)/(n + b^2 / D),
#     D <- mean of u b^2 + V over runs,   m <- m + mean of b weighted by u.
#
# The mean ``m`` is there since what was taken out is a fit to all runs: one run of another robot moves it, and
# all others deviate from it alike.  The weight ``u`` is that of deviations with Student's distribution of ``n``
# degrees (Lange et al., JASA 1989): one run of another robot is no scatter.  Variances that were assumed count
# as some runs more, and are the least: a few runs that happen to be alike do not show that a robot never
# varies.

PRIOR_RUNS = 4.0  #: What was assumed counts as so many runs: enough that three runs do not deny it

TAIL_DOF = 4.0
"""Degrees of freedom of deviations from run to run: few enough for a run in twenty that is far out."""

NORMAL_RATIO = 0.786
"""Mean of ``u z^2`` of normal deviations ``z``, by which estimates are divided to be right for them."""

MORE_RATIO = 1.5
"""An estimate counts from that ratio of what was assumed: eight runs determine it to a quarter, and
what is within that is no news."""

EM_STEPS = 60
"""Enough for a scatter that is ten times what was assumed; one that runs hardly show stays as assumed."""


def scatter_of(gram: Array, score: Array, assumed_std: Array) -> Array:
    """Return the standard deviation (q,) of parameters from run to run.

    ``gram`` (runs, q, q) is of whitened sensitivities, ``score`` (runs, q) of the whitened residual along them, what
    all runs have in common taken out; ``assumed_std`` (q,) is the least.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> value = 0.3 * rng.standard_normal((200, 1))
    >>> bool(abs(scatter_of(np.full((200, 1, 1), 1e4), 1e4 * value, np.array([0.02]))[0] - 0.3) < 0.03)
    True
    """
    assumed = assumed_std**2
    variance, mean = assumed.copy(), np.zeros(len(assumed))
    for _ in range(EM_STEPS):
        inner = np.linalg.inv(gram + np.diag(1.0 / variance))
        own = np.einsum("iqp,ip->iq", inner, score - gram @ mean)
        weight = (TAIL_DOF + 1.0) / (TAIL_DOF + own**2 / variance)
        mean = mean + (weight * own).sum(axis=0) / weight.sum(axis=0)
        square = weight / NORMAL_RATIO * own**2 + np.einsum("iqq->iq", inner)
        variance = (PRIOR_RUNS * assumed + square.sum(axis=0)) / (PRIOR_RUNS + len(gram))
        variance = np.maximum(variance, assumed)
    std = np.sqrt(variance)
    return np.where(std > MORE_RATIO * assumed_std, std, assumed_std)
