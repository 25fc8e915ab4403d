"""Evidence of runs on the simulation's parameters: products of whitened columns, one matrix a third of a run.

With whitened residual ``r``, sensitivities ``J`` and, of each run, deviations ``b ~ N(0, D)`` of the
parameters that vary from run to run (sensitivities ``N``), minus twice the log-likelihood of a change ``x``
is, up to a constant,

    c - 2 g'x + x'A x,   A = J'V J,  g = J'V r,  V = I - N (N'N + D^-1)^-1 N'

summed over runs.  Every question is a fit on these small matrices (:meth:`Evidence.fit`): of which
parameters, in which parts of the data each has a value of its own, beside what differs from run to run at
random.  Sensitivities are taken anew where a fit has moved far.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.noise import ORDER, ORDERS, WHITE, Noise, noise_of, whiten
from terrain.discrepancy.residuals import LowPass, Rows, rows_of
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import BOUNDS, CHANNELS, INDEX
from terrain.records import Array
from terrain.simulation.planar.model import Planar

N_BLOCKS = 3
"""Time blocks of a run; they serve as clusters where runs are few."""

N_PROBES = 4
"""Of the inputs that are taken out before the noise is estimated, for each channel."""

PRIOR_STD = {name: 0.5 * max(abs(low), high) for name, (low, high) in BOUNDS.items()}
"""Prior of a parameter while the whole library is freed to estimate the noise."""


class Statistics(NamedTuple):
    """What differs between measurement and simulation at random.

    Parameters
    ----------
    noise : of each channel
    scatter : standard deviation from run to run, by parameter
    """

    noise: Noise
    scatter: Mapping[str, float]


class Marginal(NamedTuple):
    """Products of columns with deviations of each run integrated out.

    Parameters
    ----------
    total : (runs, m, m)
    shift : (runs, q, m) deviation of a run per unit of each column (of parameters, negative), and that which
        its residual shows
    inner : (runs, q, q) covariance of the deviations given the parameters
    """

    total: Array
    shift: Array
    inner: Array


def marginal(grams: Array, random: Sequence[int] | Array, std: Array) -> Marginal:
    """Return products (runs, parts, m, m) of columns, the random ones (q,) of standard deviations integrated out."""
    gram = grams.sum(axis=1)
    inner = np.linalg.inv(gram[:, random][:, :, random] + np.diag(1.0 / std**2))
    shift = inner @ gram[:, random]
    return Marginal(gram - gram[:, :, random] @ shift, shift, inner)


def marginal_parts(grams: Array, random: Sequence[int] | Array, std: Array) -> Array:
    """Return the same for each part of a run, (runs, parts, m, m): they sum up to the total."""
    shift = marginal(grams, random, std).shift
    back = shift.transpose(0, 2, 1)[:, None]
    follow = back @ grams[:, :, random]
    prior = back @ (shift / std[:, None] ** 2)[:, None] / grams.shape[1]
    return np.asarray(
        grams - follow - follow.transpose(0, 1, 3, 2) + follow[..., random] @ shift[:, None] + prior
    )


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of runs around one point of the parameters.

    Parameters
    ----------
    parameters : names of the k parameters
    vector : the point from which changes are counted, (len(PARAMETERS),)
    origin : the point where sensitivities were taken; it stays when changes are counted from another point
    grams : (runs, N_BLOCKS, k + 1, k + 1) products of whitened sensitivities and, last, of the residual at
        ``origin``, in each third of each run; nothing is marginalised
    nuisances : (q,) indices into ``parameters`` of those that vary from run to run
    nuisance_std : (q,)
    rows, noise : from which they come
    white_residual, white_change : of each run (rows, channels) and (k, rows, channels), 0 where nothing was
        measured
    model_std : (k,) error of the simulation itself in units of each parameter, the same in all runs
    """

    parameters: tuple[str, ...]
    vector: Array
    origin: Array
    grams: Array
    nuisances: Array
    nuisance_std: Array
    rows: tuple[Rows, ...]
    noise: Noise
    white_residual: tuple[Array, ...]
    white_change: tuple[Array, ...]
    model_std: Array

    def places(self, names: Sequence[str]) -> list[int]:
        """Return the positions of parameters in the matrices."""
        return [self.parameters.index(name) for name in names]

    @property
    def statistics(self) -> Statistics:
        """Noise and scatter that were estimated or given."""
        names = [self.parameters[i] for i in self.nuisances]
        return Statistics(self.noise, dict(zip(names, self.nuisance_std.tolist(), strict=True)))

    @cached_property
    def away(self) -> Array:
        """Where sensitivities were taken, over the point from which changes are counted (k,)."""
        at = [INDEX[name] for name in self.parameters]
        return self.origin[at] - self.vector[at]

    @cached_property
    def marginal(self) -> Marginal:
        """Products around the origin, what varies from run to run integrated out."""
        return marginal(self.grams, self.nuisances, self.nuisance_std)

    @property
    def shift(self) -> Array:
        """Deviation (runs, q, k + 1) of the nuisances, see :class:`Marginal`."""
        return self.marginal.shift

    @property
    def inner(self) -> Array:
        """Covariance (runs, q, q) of the nuisances given the parameters."""
        return self.marginal.inner

    @property
    def a(self) -> Array:
        """``A`` of each run (runs, k, k)."""
        return self.marginal.total[:, :-1, :-1]

    @cached_property
    def g(self) -> Array:
        """``g`` of each run (runs, k)."""
        return np.asarray(self.marginal.total[:, :-1, -1] + self.a @ self.away)

    @cached_property
    def c(self) -> Array:
        """``c`` of each run (runs,)."""
        return np.asarray(
            self.marginal.total[:, -1, -1]
            + 2.0 * self.marginal.total[:, :-1, -1] @ self.away
            + self.away @ self.a @ self.away
        )

    @property
    def origin_loss(self) -> float:
        """Sum of ``c`` at the origin."""
        return float(self.marginal.total[:, -1, -1].sum())

    @cached_property
    def blocks(self) -> tuple[Array, Array]:
        """``A`` and ``g`` of each third of each run, (runs, N_BLOCKS, k, k) and (runs, N_BLOCKS, k)."""
        parts = marginal_parts(self.grams, self.nuisances, self.nuisance_std)
        a = parts[:, :, :-1, :-1]
        return a, np.asarray(parts[:, :, :-1, -1] + a @ self.away)

    def clusters(self, at: Sequence[int], by_run: bool) -> tuple[Array, Array]:
        """Return ``A`` and ``g`` (clusters, n, n) of some parameters, a cluster a run or a third of one."""
        a, g = (self.a, self.g) if by_run else (x.reshape(-1, *x.shape[2:]) for x in self.blocks)
        return a[:, at][:, :, at], g[:, at]

    def fit(self, own: Sequence[str], others: Sequence[str], where: Array) -> tuple[Array, Array]:
        """Fit parameters in each group of the data, others in common, what varies from run to run marginalised.

        Parameters
        ----------
        own, others : names of p parameters with a value in each group, and of those with one in all
        where : (runs, N_BLOCKS) the group of each third of each run

        Returns
        -------
        values : (groups, p); NaN where a group shows nothing
        cov : (groups, p, groups, p) by the noise
        """
        n_groups, p, q = int(where.max()) + 1, len(own), self.nuisances.size
        k = n_groups * p + len(others)
        design = np.zeros((*where.shape, len(self.parameters) + 1, q + k + 1))
        design[:, :, self.nuisances, np.arange(q)] = 1.0
        design[:, :, self.places(others), np.arange(q + n_groups * p, q + k)] = 1.0
        design[:, :, :, -1] = *self.away, 1.0
        for (i, b), group in np.ndenumerate(where):
            design[i, b, self.places(own), np.arange(q + group * p, q + (group + 1) * p)] = 1.0
        columns = design.transpose(0, 1, 3, 2) @ self.grams @ design
        free = marginal(columns, np.arange(q), self.nuisance_std).total[:, q:, q:].sum(axis=0)
        total, m = free[:-1, :-1], n_groups * p
        cov = np.linalg.pinv(total, hermitian=True, rcond=1e-12)
        shown = np.diag(total)[:m] > 1e-9 * np.diag(total)[:m].max()
        values = np.where(shown, (cov @ free[:-1, -1])[:m], np.nan).reshape(n_groups, p)
        return values, cov[:m, :m].reshape(n_groups, p, n_groups, p)


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
    each = [{name: float(value[i]) for name, value in (own or {}).items()} for i in range(len(signals))]
    rows = tuple(
        _rows_at(run, planar[run.terrain], vector, names, low_pass, mine)
        for run, mine in zip(signals, each, strict=True)
    )
    nuisances = np.array([names.index(name) for name in scattered], dtype=int)
    if statistics is None:
        assumed_std = np.array([assumed[name] for name in scattered])
        noise, std = _noise_and_scatter(names, vector, rows, nuisances, assumed_std)
    else:
        noise, std = statistics.noise, np.array([statistics.scatter[name] for name in scattered])
    model_std = np.array([simulation.model_error.get(name, 0.0) for name in names])
    return replace(_evidence(names, vector, rows, noise, nuisances, std), model_std=model_std)


def _rows_at(
    run: Signals,
    planar: Planar,
    vector: Array,
    names: Sequence[str],
    low_pass: LowPass,
    own: Mapping[str, float],
) -> Rows:
    """Return a run with sensitivities at its own values, and its prediction extrapolated to the point."""
    at = [INDEX[name] for name in own]
    there = vector.copy()
    there[at] = list(own.values())
    rows = rows_of(run, planar, there, names, low_pass)
    back = np.tensordot(vector[at] - there[at], rows.sensitivity[[names.index(name) for name in own]], axes=1)
    return rows._replace(predicted=rows.predicted + back)


def _noise_and_scatter(
    names: tuple[str, ...], vector: Array, rows: tuple[Rows, ...], nuisances: Array, assumed_std: Array
) -> tuple[Noise, Array]:
    """Return noise and scatter from run to run, by what the whole library and a few probes leave.

    The first fits weigh all frequencies alike: see :data:`terrain.discrepancy.noise.WHITE`.
    """
    speeds = [run.pace_mps for run in rows]
    row_s = float(np.median(np.diff(rows[0].time_s)))
    noise, std = noise_of([run.residual for run in rows], speeds, row_s, orders=WHITE), assumed_std
    for orders in (WHITE, ORDERS, ORDERS):
        loose = _evidence(names, vector, rows, noise, nuisances, std)
        if std.size:
            std = _scatter(loose, assumed_std)
            loose = _evidence(names, vector, rows, noise, nuisances, std)
        left, n_fitted = _library_residuals(loose)
        noise = noise_of(left, speeds, row_s, n_fitted, orders)
    plain = noise_of(_without_probes(loose, left), speeds, row_s, n_fitted + len(CHANNELS) * N_PROBES, ORDERS)
    return noise._replace(std=plain.std), std


def _scatter(info: Evidence, assumed_std: Array) -> Array:
    """Return the scatter (q,) of nuisances about what the whole library explains of all runs alike."""
    x = np.linalg.solve(freed_information(info), info.g.sum(axis=0))
    along = info.grams.sum(axis=1)[:, info.nuisances]
    return scatter_of(along[:, :, info.nuisances], along[:, :, -1] - along[:, :, :-1] @ x, assumed_std)


def _evidence(
    names: tuple[str, ...], vector: Array, rows: tuple[Rows, ...], noise: Noise, nuisances: Array, std: Array
) -> Evidence:
    white = [whiten_run(noise, run) for run in rows]
    grams = np.array([grams_of(residual, change) for residual, change in white])
    residuals, changes = zip(*white, strict=True)
    error = np.zeros(len(names))
    return Evidence(names, vector, vector, grams, nuisances, std, rows, noise, residuals, changes, error)


def grams_of(residual: Array, change: Array) -> Array:
    """Return the products (N_BLOCKS, k + 1, k + 1) of columns of a run in each third of its rows.

    Parameters
    ----------
    residual : (rows, channels), the last column
    change : (k, rows, channels)
    """
    columns = np.concatenate([change, residual[None]])
    edges = [len(residual) * b // N_BLOCKS for b in range(N_BLOCKS + 1)]
    parts = [columns[:, edges[b] : edges[b + 1]].reshape(len(columns), -1) for b in range(N_BLOCKS)]
    return np.array([part @ part.T for part in parts])


def whiten_run(noise: Noise, run: Rows) -> tuple[Array, Array]:
    """Return residual (m, c) and sensitivities (k, m, c) whitened, both 0 where the residual is not known."""
    residual = run.residual
    known = np.isfinite(residual)
    measured = np.isfinite(noise.filters).all(axis=1)
    valid = known & measured
    for lag in range(1, ORDER + 1):
        used = measured & (noise.filters[:, lag] != 0.0)
        valid[lag:] &= known[:-lag] | ~used
        valid[:lag] &= ~used
    both = np.concatenate([residual[None], run.sensitivity]) / noise.size(run.pace_mps)
    white = whiten(noise.filters, both)
    white *= valid
    return white[0], white[1:]


def _library_residuals(info: Evidence) -> tuple[list[Array], float]:
    """Return the residuals with the whole library and probes freed, and how many parameters were fitted."""
    total, bound = info.a.sum(axis=0), freed_information(info)
    x = np.linalg.solve(bound, info.g.sum(axis=0))
    left = []
    for run, shift in zip(info.rows, info.shift, strict=True):
        move = x.copy()
        move[info.nuisances] += shift[:, -1] - shift[:, :-1] @ x
        left.append(run.residual - np.tensordot(move, run.sensitivity, axes=1))
    n_fitted = float(np.trace(np.linalg.solve(bound, total)))
    for inner in info.inner:
        n_fitted += info.nuisances.size - float((np.diag(inner) / info.nuisance_std**2).sum())
    return left, n_fitted


def _without_probes(info: Evidence, left: Sequence[Array]) -> list[Array]:
    """Return residuals (rows, channels) without what a few probes explain in all runs alike.

    A constant, the speed, the turn and their product: what the library does not have is no noise.
    """
    probes = []
    for run in info.rows:
        speed, turn = run.inputs[:, 0], run.inputs[:, 1]
        probes.append(np.column_stack([np.ones_like(speed), speed, turn, speed * turn]))
    sizes = [info.noise.size(run.pace_mps) for run in info.rows]
    out = [residual.copy() for residual in left]
    every, size, value = np.concatenate(probes), np.concatenate(sizes), np.concatenate(left)
    for c in range(value.shape[1]):
        known = np.isfinite(value[:, c] / size[:, c])
        if known.sum() > 10 * N_PROBES:
            weighted = every[known] / size[known, c : c + 1]
            fit = np.linalg.lstsq(weighted, value[known, c] / size[known, c], rcond=1e-10)[0]
            for residual, columns in zip(out, probes, strict=True):
                residual[:, c] -= columns @ fit
    return out


def freed_information(info: Evidence) -> Array:
    """Return the information (k, k) of all runs with every parameter freed up to its prior."""
    prior = np.array([PRIOR_STD.get(name, 1e-6) for name in info.parameters])
    return np.asarray(info.a.sum(axis=0) + np.diag(1.0 / prior**2))


def recentre(info: Evidence, base: Array) -> Evidence:
    """Return the same with changes counted from another point, extrapolated linearly."""
    return replace(info, vector=base)


def partial_information(a: Array, base: Sequence[int], own: Sequence[int]) -> tuple[Array, Array]:
    """Return the information on parameters while others are fitted with them.

    Parameters
    ----------
    a : (k, k)
    base, own : places of the n others and of the q parameters

    Returns
    -------
    follow : (n, q) by how much the others go back where the parameters go ahead
    free : (q, q) information that is left, the Schur complement
    """
    if not len(base):
        return np.zeros((0, len(own))), a[np.ix_(own, own)]
    follow = np.linalg.lstsq(a[np.ix_(base, base)], a[np.ix_(base, own)], rcond=1e-10)[0]
    return follow, a[np.ix_(own, own)] - a[np.ix_(own, base)] @ follow


def correlation(a: Array, one: Sequence[int], other: Sequence[int]) -> float:
    """Return the largest correlation of what parameters at the places one and other change.

    It is 1 where one of them does nothing.
    """
    roots = []
    for at in (one, other):
        values, vectors = np.linalg.eigh(a[np.ix_(at, at)])
        if not values[-1] > 1e-12:
            return 1.0
        shown = values > 1e-9 * values[-1]
        roots.append(vectors[:, shown] / np.sqrt(values[shown]))
    between = roots[0].T @ a[np.ix_(one, other)] @ roots[1]
    return min(float(np.linalg.norm(between, 2)), 1.0)


def loss_of(info: Evidence, names: Sequence[str]) -> float:
    """Return minus twice the log-likelihood of the best fit of parameters, up to what no fit changes."""
    at = info.places(names)
    a, g = info.a[:, at][:, :, at].sum(axis=0), info.g[:, at].sum(axis=0)
    return -float(g @ np.linalg.lstsq(a, g, rcond=1e-10)[0]) if at else 0.0


def move_point(point: Array, names: Sequence[str], change: Array) -> Array:
    """Return the point that lies a change of the parameters named away, kept in the bounds of the library."""
    vector = point.copy()
    for name, value in zip(names, change, strict=True):
        vector[INDEX[name]] += value
        if name in BOUNDS:
            vector[INDEX[name]] = np.clip(vector[INDEX[name]], *BOUNDS[name])
    return vector


# -- The same runs at another point, with the noise and scatter of an evidence ------------------------------


class Nearby(NamedTuple):
    """Information on a few parameters at another point, with the noise and scatter of an evidence.

    Parameters
    ----------
    vector : the point
    a, g, c : (k, k), (k,) and the constant of the quadratic form of these parameters, all runs together
    white_residual : of each run (rows, channels)
    """

    vector: Array
    a: Array
    g: Array
    c: float
    white_residual: tuple[Array, ...]


def nearby(
    info: Evidence,
    signals: Sequence[Signals],
    simulation: Simulation,
    vector: Array,
    parameters: Sequence[str],
    low_pass: LowPass,
) -> Nearby:
    """Return the information of the same runs at another point; much faster than computing it anew."""
    planar = {terrain: simulation.planar_on(terrain) for terrain in {run.terrain for run in signals}}
    k, white = len(parameters), []
    total = np.zeros((k + 1, k + 1))
    for run, its_change, inner in zip(signals, info.white_change, info.inner, strict=True):
        rows = rows_of(run, planar[run.terrain], vector, parameters, low_pass)
        residual, change = whiten_run(info.noise, rows)
        nuisances = its_change[info.nuisances].reshape(len(info.nuisances), residual.size)
        both = np.concatenate([change, residual[None]]).reshape(k + 1, -1)
        along = nuisances @ both.T
        total += both @ both.T - along.T @ inner @ along
        white.append(residual)
    return Nearby(vector, total[:k, :k], total[:k, k], float(total[k, k]), tuple(white))


def misfit_of(info: Evidence, white_residual: Sequence[Array]) -> float:
    """Return by how much the whole library could still reduce residuals (rows, channels) at another point.

    Parameters
    ----------
    info : whose sensitivities and noise are the measure
    white_residual : of each run, whitened by the noise of ``info``

    Notes
    -----
    Up to a constant it is minus twice the log-likelihood there, as far as the problem is linear.  The sum of
    squares itself will not do: the noise of the wheels is in the prediction, and a cause that makes it larger
    or smaller, as a mass does, would be judged by it.
    """
    score = np.zeros(len(info.parameters))
    for residual, change, shift in zip(white_residual, info.white_change, info.shift, strict=True):
        flat = change.reshape(len(change), -1) @ residual.ravel()
        score += flat - shift[:, : len(flat)].T @ flat[info.nuisances]
    return float(score @ np.linalg.solve(freed_information(info), score))


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

PRIOR_RUNS = 4.0
"""What was assumed counts as so many runs: enough that three runs do not deny it."""

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

    Parameters
    ----------
    gram : (runs, q, q) of whitened sensitivities of each run
    score : (runs, q) of the whitened residual along them, what all runs have in common taken out
    assumed_std : (q,) the least

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
