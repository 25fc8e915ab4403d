"""Information of runs on the simulation's parameters: a quadratic form a run, its own scatter marginalised.

With whitened residual ``r``, sensitivities ``J`` and, of each run, deviations ``b ~ N(0, D)`` of the
parameters that vary from run to run (sensitivities ``N``), minus twice the log-likelihood of a change ``x``
is, up to a constant,

    c - 2 g'x + x'A x,   A = J'V J,  g = J'V r,  V = I - N (N'N + D^-1)^-1 N'

summed over runs.  All selection works on these small matrices; sensitivities are taken anew where a fit has
moved far.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.noise import ORDER, ORDERS, WHITE, Noise, noise_of, whiten
from terrain.discrepancy.residuals import LowPass, Rows, rows_of
from terrain.discrepancy.scatter import scatter_of
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


class Information(NamedTuple):
    """Information of runs around one point of the parameters.

    Parameters
    ----------
    parameters : names of the k parameters
    vector : the point, (len(PARAMETERS),)
    a, g, c : (runs, k, k), (runs, k) and (runs,) of the quadratic form
    a_blocks, g_blocks : (runs, N_BLOCKS, k, k) and (runs, N_BLOCKS, k), which sum up to ``a`` and ``g``
    rows, noise : from which they come
    white_residual, white_change : of each run (rows, channels) and (k, rows, channels), 0 where nothing was
        measured
    grams : (runs, N_BLOCKS, k + 1, k + 1) products of whitened sensitivities and, last, of the residual at
        ``origin``, in each third of each run; nothing is marginalised
    nuisances : (q,) indices into ``parameters`` of those that vary from run to run
    nuisance_std : (q,)
    shift : of each run (q, k + 1): deviation of its nuisances per unit of each parameter's change (negative),
        and that which its residual shows
    inner : of each run (q, q): covariance of its nuisances given the parameters
    origin, origin_loss : the point where sensitivities were taken, and the sum of ``c`` there; they stay when
        changes are counted from another point
    model_std : (k,) error of the simulation itself in units of each parameter, the same in all runs
    """

    parameters: tuple[str, ...]
    vector: Array
    a: Array
    g: Array
    c: Array
    a_blocks: Array
    g_blocks: Array
    rows: tuple[Rows, ...]
    noise: Noise
    white_residual: tuple[Array, ...]
    white_change: tuple[Array, ...]
    grams: Array
    nuisances: Array
    nuisance_std: Array
    shift: tuple[Array, ...]
    inner: tuple[Array, ...]
    origin: Array
    origin_loss: float
    model_std: Array

    def places(self, names: Sequence[str]) -> list[int]:
        """Return the positions of parameters in the matrices."""
        return [self.parameters.index(name) for name in names]

    @property
    def statistics(self) -> Statistics:
        """Noise and scatter that were estimated or given."""
        names = [self.parameters[i] for i in self.nuisances]
        return Statistics(self.noise, dict(zip(names, self.nuisance_std.tolist(), strict=True)))


def information_at(
    signals: Sequence[Signals],
    simulation: Simulation,
    vector: Array,
    parameters: Sequence[str],
    low_pass: LowPass,
    statistics: Statistics | None = None,
    own: Mapping[str, Array] | None = None,
    scatter: Mapping[str, float] | None = None,
) -> Information:
    """Return the information of runs around a point; noise and scatter are estimated unless given.

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
    return _sum_forms(names, vector, rows, noise, nuisances, std)._replace(model_std=model_std)


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
        loose = _sum_forms(names, vector, rows, noise, nuisances, std)
        if std.size:
            std = _scatter(loose, assumed_std)
            loose = _sum_forms(names, vector, rows, noise, nuisances, std)
        left, n_fitted = _library_residuals(loose)
        noise = noise_of(left, speeds, row_s, n_fitted, orders)
    plain = noise_of(_without_probes(loose, left), speeds, row_s, n_fitted + len(CHANNELS) * N_PROBES, ORDERS)
    return noise._replace(std=plain.std), std


def _scatter(info: Information, assumed_std: Array) -> Array:
    """Return the scatter (q,) of nuisances about what the whole library explains of all runs alike."""
    x = np.linalg.solve(freed_information(info), info.g.sum(axis=0))
    along = info.grams.sum(axis=1)[:, info.nuisances]
    return scatter_of(along[:, :, info.nuisances], along[:, :, -1] - along[:, :, :-1] @ x, assumed_std)


def _sum_forms(
    names: tuple[str, ...],
    vector: Array,
    rows: tuple[Rows, ...],
    noise: Noise,
    nuisances: Array,
    std: Array,
) -> Information:
    k, n = len(names), len(rows)
    a, g, c = np.empty((n, k, k)), np.empty((n, k)), np.empty(n)
    a_blocks, g_blocks = np.empty((n, N_BLOCKS, k, k)), np.empty((n, N_BLOCKS, k))
    white_r, white_j, shifts, inners = [], [], [], []
    every = np.empty((n, N_BLOCKS, k + 1, k + 1))
    for i, run in enumerate(rows):
        residual, change = whiten_run(noise, run)
        every[i] = grams = grams_of(residual, change)
        gram = grams.sum(axis=0)
        inner = np.linalg.inv(gram[np.ix_(nuisances, nuisances)] + np.diag(1.0 / std**2))
        shift = inner @ gram[nuisances]
        taken = gram - gram[:, nuisances] @ shift
        a[i], g[i], c[i] = taken[:k, :k], taken[:k, k], taken[k, k]
        prior = shift.T @ (shift / std[:, None] ** 2) / N_BLOCKS
        for b in range(N_BLOCKS):
            follow = shift.T @ grams[b][nuisances]
            part = grams[b] - follow - follow.T + follow[:, nuisances] @ shift + prior
            a_blocks[i, b], g_blocks[i, b] = part[:k, :k], part[:k, k]
        white_r.append(residual)
        white_j.append(change)
        shifts.append(shift)
        inners.append(inner)
    return Information(
        names,
        vector,
        a,
        g,
        c,
        a_blocks,
        g_blocks,
        rows,
        noise,
        tuple(white_r),
        tuple(white_j),
        every,
        nuisances,
        std,
        tuple(shifts),
        tuple(inners),
        vector,
        float(c.sum()),
        np.zeros(k),
    )


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


def _library_residuals(info: Information) -> tuple[list[Array], float]:
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


def _without_probes(info: Information, left: Sequence[Array]) -> list[Array]:
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


def freed_information(info: Information) -> Array:
    """Return the information (k, k) of all runs with every parameter freed up to its prior."""
    prior = np.array([PRIOR_STD.get(name, 1e-6) for name in info.parameters])
    return np.asarray(info.a.sum(axis=0) + np.diag(1.0 / prior**2))


def recentre(info: Information, base: Array) -> Information:
    """Return the same with changes counted from another point, extrapolated linearly."""
    away = np.array([info.vector[INDEX[name]] - base[INDEX[name]] for name in info.parameters])
    return info._replace(
        vector=base,
        c=info.c + 2.0 * info.g @ away + away @ info.a @ away,
        g=info.g + info.a @ away,
        g_blocks=info.g_blocks + info.a_blocks @ away,
    )


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
        kept = values > 1e-9 * values[-1]
        roots.append(vectors[:, kept] / np.sqrt(values[kept]))
    between = roots[0].T @ a[np.ix_(one, other)] @ roots[1]
    return min(float(np.linalg.norm(between, 2)), 1.0)


def loss_of(info: Information, names: Sequence[str]) -> float:
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
