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

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtr
from scipy.stats import chi2

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.discrepancy.differences import BOUNDS, INDEX, in_common
from terrain.discrepancy.noise import ORDER, ORDERS, WHITE, Noise, noise_of, whiten
from terrain.discrepancy.runs import LowPass, Rows, Signals, Simulation, of_each, rows_of
from terrain.effects import CHANNELS, Effect
from terrain.records import Array

N_BLOCKS = 3  #: Time blocks of a run; they serve as clusters where runs are few
N_PROBES = 4  #: Of the inputs that are taken out before the noise is estimated, for each channel

PRIOR_STD = {name: 0.5 * max(abs(low), high) for name, (low, high) in BOUNDS.items()}
"""Prior of a parameter while the whole library is freed to estimate the noise."""

UNKNOWN_STD = 1e-6  #: Prior of one that is not in the library: it stays where it is


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
    vector: Array  #: (len(PARAMETERS),), of two sets twice that, the point from which changes are counted
    origin: Array  #: the point where sensitivities were taken, whatever changes are counted from
    grams: Array
    """(runs, N_BLOCKS, k + 1, k + 1) products of whitened sensitivities and, last, of the residual, in each third
    of each run; nothing is marginalised."""
    scatter: Mapping[str, float]  #: standard deviation of what varies from run to run, by parameter
    rows: tuple[Rows, ...]  #: from which they come
    noise: Noise
    white: tuple[Array, ...]  #: of each run (k + 1, rows, channels) the columns, 0 where nothing was measured
    model_std: Array  #: (k,) error of the simulation itself in units of each parameter, the same in all runs
    session: Array | None = (
        None  #: (runs,) number of the session where these are the clusters, in place of runs
    )

    def places(self, names: Sequence[str]) -> list[int]:
        """Return the positions of parameters in the matrices."""
        return [self.names.index(name) for name in names]

    @cached_property
    def nuisances(self) -> Array:
        """Places (q,) in ``names`` of what varies from run to run."""
        return np.array(self.places([*self.scatter]), dtype=int)

    @cached_property
    def nuisance_std(self) -> Array:
        """Standard deviations (q,) of these."""
        return np.array([*self.scatter.values()])

    @cached_property
    def marginal(self) -> tuple[Array, Array, Array]:
        """Products with what varies integrated out, its shift and covariance: :func:`marginal`."""
        return marginal(self.grams, self.nuisances, self.nuisance_std)

    @property
    def a(self) -> Array:
        """``A`` of each run (runs, k, k)."""
        return self.marginal[0][:, :-1, :-1]

    @property
    def g(self) -> Array:
        """``g`` of each run (runs, k)."""
        return self.marginal[0][:, :-1, -1]

    @property
    def c(self) -> Array:
        """``c`` of each run (runs,)."""
        return self.marginal[0][:, -1, -1]

    @property
    def away(self) -> Array:
        """Where sensitivities were taken, over the point from which changes are counted (k,)."""
        return (self.origin - self.vector)[[INDEX[name] for name in self.names]]

    def residuals(self, change: Array) -> list[Array]:
        """Return the whitened residual (rows, channels) of each run at a change (k,), linearly."""
        return [white[-1] - np.tensordot(change, white[:-1], axes=1) for white in self.white]

    def counted_from(self, vector: Array) -> Evidence:
        """Return the same with changes counted from another point."""
        apart = (self.vector - vector)[[INDEX[name] for name in self.names]]
        columns = np.eye(len(apart) + 1)
        columns[:-1, -1] = apart
        left = self.residuals(-apart)
        white = [np.concatenate([run[:-1], r[None]]) for run, r in zip(self.white, left, strict=True)]
        return replace(self, vector=vector, grams=columns.T @ self.grams @ columns, white=tuple(white))

    def with_columns(self, other: Evidence) -> Evidence:
        """Return the same with the columns and the residual of other evidence on some of the parameters."""
        at, white = [*self.places(other.names), len(self.names)], [run.copy() for run in self.white]
        for run, columns in zip(white, other.white, strict=True):
            run[at] = columns
        return replace(self, grams=np.array([grams_of(run) for run in white]), white=tuple(white))

    def clusters(self, at: Sequence[int], by_run: bool = True) -> tuple[Array, Array]:
        """Return ``A`` (clusters, n, n) and ``g`` (clusters, n) of some places.

        A cluster is a run, its session where that is known, or a third of a run.
        """
        parts = self.marginal[0]
        if by_run and self.session is not None:
            parts = np.tensordot(np.eye(int(self.session.max()) + 1)[:, self.session], parts, axes=1)
        if not by_run:
            parts = marginal_parts(self.grams, self.nuisances, self.nuisance_std)
            parts = parts.reshape(-1, *parts.shape[2:])
        return parts[:, at][:, :, at], parts[:, at, -1]

    def total(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Return ``A`` (n, n) and ``g`` (n,) of some parameters, all runs together."""
        a, g = self.clusters(self.places(names))
        return a.sum(axis=0), g.sum(axis=0)

    def fit(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Return the change (n,) of parameters that fits all runs best, and its covariance by the noise."""
        a, g = self.total(names)
        cov = np.linalg.pinv(a, hermitian=True)
        return cov @ g, cov

    def loss(self, names: Sequence[str]) -> float:
        """Return minus twice the log-likelihood of the best fit of parameters, up to what no fit changes."""
        a, g = self.total(names)
        return -float(g @ np.linalg.lstsq(a, g, rcond=1e-10)[0]) if len(names) else 0.0

    def fits_without_each(self, at: Sequence[int]) -> Array:
        """Return the change (runs, n) of parameters at some places that fits all runs but each of them."""
        a, g = self.clusters(at)
        # in standard deviations of each parameter; one without information in the other runs keeps its value
        unit = np.sqrt(np.maximum(np.einsum("kii->i", a), 1e-30))
        rest = (a.sum(axis=0) - a) / np.outer(unit, unit) + 1e-9 * np.eye(len(at))
        return np.asarray(np.linalg.solve(rest, ((g.sum(axis=0) - g) / unit)[:, :, None])[:, :, 0] / unit)

    def channel_power(self, weights: Array) -> Array:
        """Return the square (channels,) over all runs of combinations (p, k) of the sensitivities."""
        changes = (np.tensordot(weights, white[:-1], axes=1) for white in self.white)
        return np.asarray(sum((change**2).sum(axis=(0, 1)) for change in changes))

    @cached_property
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
    noise: Noise | None = None,
    scatter: Mapping[str, float] | None = None,
    own: Mapping[str, Array] | None = None,
    session: Array | None = None,
) -> Evidence:
    """Return the evidence of runs around a point; noise and scatter are estimated unless the noise is given.

    The scatter is then what is assumed of it, that of the simulation by default.  With ``own`` values (runs,)
    of some of the parameters, sensitivities are those of each run at its own; residuals are counted from the
    point all the same, linearly.
    """
    planar = {terrain: simulation.planar_on(terrain) for terrain in {run.terrain for run in signals}}
    assumed = {n: std for n, std in (simulation.scatter if scatter is None else scatter).items() if std > 0}
    names, own = tuple(dict.fromkeys([*parameters, *assumed])), own or {}
    at, columns = [INDEX[name] for name in own], [names.index(name) for name in own]

    def counted(i: int) -> Rows:
        run, there = signals[i], vector.copy()
        there[at] = [values[i] for values in own.values()]
        run_rows = rows_of(run, planar[run.terrain], there, names, low_pass)
        back = np.tensordot(vector[at] - there[at], run_rows.sensitivity[columns], axes=1)
        return run_rows._replace(predicted=run_rows.predicted + back)

    rows = of_each(counted, range(len(signals)))
    model_std = np.array([simulation.model_error.get(name, 0.0) for name in names])

    def whitened(noise: Noise, scatter: Mapping[str, float]) -> Evidence:
        white = tuple(of_each(partial(whiten_run, noise), rows))
        grams = np.array([grams_of(columns) for columns in white])
        return Evidence(names, vector, vector, grams, scatter, tuple(rows), noise, white, model_std, session)

    if noise is not None:
        return whitened(noise, assumed)
    # by what the whole library and a few probes leave; the first fits weigh all frequencies alike: see WHITE
    speeds, row_s = [run.pace_mps for run in rows], float(np.median(np.diff(rows[0].time_s)))
    noise, varies = noise_of([run.residual for run in rows], speeds, row_s, orders=WHITE), assumed
    for orders in (WHITE, ORDERS, ORDERS):
        loose = whitened(noise, varies)
        if varies:
            # about what the whole library explains of all runs alike
            x = np.linalg.solve(loose.freed, loose.g.sum(axis=0))
            along = loose.grams.sum(axis=1)[:, loose.nuisances]
            score = along[:, :, -1] - along[:, :, :-1] @ x
            std = scatter_of(along[:, :, loose.nuisances], score, np.array([*assumed.values()]))
            varies = dict(zip(assumed, std.tolist(), strict=True))
            loose = replace(loose, scatter=varies)
        _, shift, inner = loose.marginal
        x = np.linalg.solve(loose.freed, loose.g.sum(axis=0))
        changes = np.tile(x, (len(rows), 1))
        changes[:, loose.nuisances] += shift[:, :, -1] - shift[:, :, :-1] @ x
        left = [
            r.residual - np.tensordot(z, r.sensitivity, axes=1) for r, z in zip(rows, changes, strict=True)
        ]
        # how many parameters were fitted to these residuals
        shown = shift.shape[0] * shift.shape[1] - (np.einsum("iqq->iq", inner) / loose.nuisance_std**2).sum()
        n_fitted = float(np.trace(np.linalg.solve(loose.freed, loose.a.sum(axis=0)))) + float(shown)
        noise = noise_of(left, speeds, row_s, n_fitted, orders)
    # what a constant, the speed, the turn and their product explain in all runs alike is no noise
    drives = [run.inputs[:, :2].T for run in rows]
    probes = [np.column_stack([np.ones_like(u), u, turn, u * turn]) for u, turn in drives]
    size = np.concatenate([loose.noise.size(pace_mps) for pace_mps in speeds])
    every, value = np.concatenate(probes), np.concatenate(left)
    for c in range(value.shape[1]):
        shows = np.isfinite(value[:, c] / size[:, c])
        if shows.sum() > 10 * N_PROBES:
            weighted = every[shows] / size[shows, c : c + 1]
            fit = np.linalg.lstsq(weighted, value[shows, c] / size[shows, c], rcond=1e-10)[0]
            for residual, driven in zip(left, probes, strict=True):
                residual[:, c] -= driven @ fit
    plain = noise_of(left, speeds, row_s, n_fitted + len(CHANNELS) * N_PROBES, ORDERS)
    return whitened(noise._replace(std=plain.std), varies)


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


def move_point(point: Array, names: Sequence[str], change: Array | Sequence[float]) -> Array:
    """Return the point that lies a change of the parameters named away, within the bounds of the library."""
    vector = point.copy()
    for name, value in zip(names, change, strict=True):
        vector[INDEX[name]] += value
        if name in BOUNDS:
            vector[INDEX[name]] = np.clip(vector[INDEX[name]], *BOUNDS[name])
    return vector


# -- Evidence of an effect: its fit over its noise, and what it gains on runs left out, clustered by run ---

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
        return self.inside and self.z > Z_EFFECT and self.gain_interval[0] > 0

    @property
    def gain_interval(self) -> tuple[float, float]:
        """The 95 % interval of the summed gain, by bootstrap over runs."""
        return percentile_interval(bootstrap_counts(len(self.gain), N_BOOTSTRAP, 0) @ self.gain)

    @property
    def inflation(self) -> float:
        """By how much the variance of its values is larger than by the noise alone; 1 at the least."""
        return max(self.dispersion, 1.0)


def wald_test(info: Evidence, selected: Sequence[str], effect: Effect) -> WaldTest:
    """Return the evidence of an effect beside the parameters selected.

    The scatter between clusters (runs; time blocks where runs are few) gives one estimate of the variance, with as
    many degrees of freedom as there are informative clusters; the noise gives 1 with :data:`TRUST_DOF`.  Both are
    weighted by their degrees of freedom.
    """
    own = [p.name for p in effect.parameters]
    beside = dict.fromkeys([*selected, *map(in_common, own)])
    base = info.places([name for name in beside if name not in own])
    both, n = base + info.places(own), len(base)
    a, g = info.clusters(both)
    total, score = a.sum(axis=0), g.sum(axis=0)
    if not np.diag(total)[n:].min() > 1e-12:
        return WaldTest(np.zeros(len(own)), 0.0, 0.0, np.zeros(len(a)), False)
    # direction in which the new ones change while the selected ones follow
    follow, free = partial_information(total, range(n), range(n, len(both)))
    own_score = score[n:] - follow.T @ score[:n]
    if not np.linalg.eigvalsh(free)[0] > 1e-9 * np.diag(total)[n:].min():
        free = free + 1e-9 * np.diag(np.diag(total)[n:])
    change = np.linalg.solve(free, own_score)
    values = zip(own, info.vector[[INDEX[name] for name in own]] + change, strict=True)
    inside = all(BOUNDS[name][0] - 1e-9 <= value <= BOUNDS[name][1] for name, value in values)
    dispersion, dof, size = 1.0, TRUST_DOF, float(change @ free @ change)
    if size > 0:
        x = np.concatenate([np.zeros(n), change])
        if n:
            x[:n] = np.linalg.lstsq(total[:n, :n], score[:n] - total[:n, n:] @ change, rcond=1e-10)[0]
        few = len(a) < MIN_CLUSTERS and info.session is None
        parts = info.clusters(both, by_run=False) if few else (a, g)
        dispersion, dof = clustered_variance(*parts, x, np.concatenate([-follow @ change, change]), size)
        dispersion += float((((free @ change) * info.model_std[both[n:]]) ** 2).sum()) / size
    root = math.sqrt(statistic := float(own_score @ change))
    if len(own) > 1:  # as improbable with one degree of freedom
        log_p = float(chi2.logsf(statistic, len(own)))
        if math.isinf(log_p):  # it underflows; far out the density falls as the tail does
            log_p = float(chi2.logpdf(statistic, len(own))) + math.log(2.0)
        root = z_of(log_p)
    z = z_of_t(root / math.sqrt(dispersion), dof)
    return WaldTest(change, z, dispersion, held_out_gain(info, base, both), inside)


def clustered_variance(a: Array, g: Array, x: Array, direction: Array, size: float) -> tuple[float, float]:
    """Return the variance of a fit ``x`` (k,) along a direction over that from the noise, and its degrees of freedom.

    ``size`` is the information along it, of all clusters (a, k, k) together.
    """
    fraction = np.clip(np.einsum("i,kij,j->k", direction, a, direction) / size, 0.0, 0.9)
    return pooled_variance((g - a @ x) @ direction, fraction, size)


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
    with np.errstate(
        divide="ignore"
    ):  # functions of scipy.special: those of its distributions take ten times as long
        return z_of(float(np.log(stdtr(dof, -t))) + math.log(2.0))


def z_of(log_p: float) -> float:
    """Return the normal number of a two-sided log probability.

    Examples
    --------
    >>> round(z_of(math.log(0.05)), 2)
    1.96
    """
    if log_p > -600.0:
        return max(-float(ndtri(math.exp(log_p) / 2)), 0.0)
    return math.sqrt(-2.0 * log_p)


def held_out_gain(info: Evidence, base: list[int], both: list[int]) -> Array:
    """Return the fall (runs,) of each run's loss when it is left out of the fit, of ``both`` over ``base``."""
    losses = []
    for at in (base, both):
        x, (a, g) = info.fits_without_each(at), info.clusters(at)
        losses.append(np.einsum("ki,kij,kj->k", x, a, x) - 2 * (x * g).sum(axis=1))
    return np.asarray(losses[0] - losses[1])


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
