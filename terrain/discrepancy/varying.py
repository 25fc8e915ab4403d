"""Effects whose size differs from run to run: how much, and whether the runs fall into two groups.

Runs are fitted with values of their own of one effect at a time, by a mixed model in which all else varies by
no more than is assumed.  The answer is the effect with the greatest likelihood: what half of the wheels do is
not the scatter of a track, though a scatter of the track that is estimated beside it would take most of it.

Whether an effect varies is judged by the likelihood that is lost with one value for all runs.  The noise of a
run's value is that between the thirds of each run, since noise that lasts is in both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.evidence import PRIOR_STD, Evidence, marginal_parts
from terrain.discrepancy.search import RIVAL_LINEAR, RIVAL_LOSS, CauseFit, Problem, cause_fit
from terrain.discrepancy.selection import TRUST_DOF, z_of_t
from terrain.discrepancy.verdict import RunGroup, Varying
from terrain.effects import BOUNDS, CHANNELS, INDEX, Effect
from terrain.records import Array

Z_VARIES = 4.5  #: Evidence of a difference between runs, as of a probe: of some thirty effects
Z_NEAR = 3.0  #: Evidence of an effect that may be what varies instead of one whose evidence is enough
VARIES_RATIO = 0.5  #: A named value that scatters by more than that ratio of itself is no value of all runs

TWO_GROUPS_RATIO = 0.15
"""Part of the scatter that two groups leave: a uniform distribution, cut in its middle, leaves 0.25."""

MIN_GROUP = 2  #: Least number of runs in a group

OUT_STDS, OUT_SCATTERS, OUT_RATIO = 3.0, 0.25, 0.2
"""A run's value is out of its bounds by so many standard deviations and scatters, and the ratio of the runs
that may be: a rogue or two, and less than a group of eight runs."""

LEAST_RATIO = 1e-4  #: Least scatter of a parameter of which none is assumed, over the prior of its value

NEAR_RATIO, N_STEPS = 0.2, 3
"""Effects whose loss is behind by that ratio of the best one's gain are compared by nonlinear fits of so many
steps: a run's own value may be far from where sensitivities were taken."""

SCATTERS = np.concatenate([[0.0], np.geomspace(1e-3, 1.0, 40)])
"""Scatters that are tried, over the range of the values."""


class _RunValues(NamedTuple):
    """Values (runs,) of a parameter by each run alone, and how far they scatter beyond the noise."""

    name: str
    value: Array  #: over what the simulation has of it
    weight: Array  #: precision of each, 0 where a run shows nothing
    scatter: float
    z: float


class _OwnValues(NamedTuple):
    """An effect of which each run has its own values, by parameter, and how well that fits."""

    effect: Effect
    runs: tuple[_RunValues, ...]
    loss: float
    gain: float  #: fall of the loss from one value in all runs

    @property
    def clearest(self) -> _RunValues:
        """The parameter that differs most clearly."""
        return max(self.runs, key=lambda runs: runs.z)


def run_scatter(fit: CauseFit, name: str) -> float:
    """Return the scatter from run to run of a parameter, noise taken off."""
    return _at_common_fit(fit, name, fit.info.nuisance_std).scatter


def varying_effects(problem: Problem, fit: CauseFit) -> tuple[Varying, ...]:
    """Return the effect whose size differs most clearly from run to run; none where runs are alike.

    Only one is returned: what one effect varies by looks like a variation of all that resemble it.
    """
    info = fit.info
    if len(info.rows) < 2 * MIN_GROUP:
        return ()
    least = _least_std(fit, ())
    common = {
        effect.name: [_at_common_fit(fit, p.name, least) for p in effect.parameters]
        for effect in problem.library
    }
    clear = {name: max(runs.z for runs in values) for name, values in common.items()}
    if not max(clear.values()) > Z_VARIES:
        return ()
    tried = [
        _own_values(fit, effect, [runs.scatter for runs in common[effect.name]])
        for effect in problem.library
        if clear[effect.name] > Z_NEAR
    ]
    first = min(tried, key=lambda own: own.loss)
    behind = max(RIVAL_LINEAR, NEAR_RATIO * first.gain)
    refitted = [(_refitted(problem, fit, own), own) for own in tried if own.loss <= first.loss + behind]
    near = [pair for pair in refitted if _is_possible(info, pair[0].clearest)]
    if not near:
        return ()
    best, linear = min(near, key=lambda pair: pair[0].loss)
    # a mass makes more or less of the noise of the wheels, which a nonlinear fit counts: either may say so
    alike = [own for own, before in near if min(own.loss - best.loss, before.loss - linear.loss) < RIVAL_LOSS]
    if not max(own.clearest.z for own in alike) > Z_VARIES:
        return ()
    runs = best.clearest
    parameter = best.effect.parameters[best.runs.index(runs)]
    channel = CHANNELS[int(np.argmax(info.channel_power(np.eye(len(info.names))[info.places([runs.name])])))]
    return (
        Varying(
            best.effect.name,
            parameter.name,
            parameter.unit,
            tuple(own.effect.name for own in alike if own is not best),
            float(np.average(runs.value, weights=runs.weight)),
            runs.scatter,
            runs.z,
            _two_groups(runs, [run.run_id for run in info.rows]),
            channel,
        ),
    )


def _is_possible(info: Evidence, runs: _RunValues) -> bool:
    """Return whether the values of most runs are what the parameter may be."""
    low, high = BOUNDS[runs.name]
    seen = runs.weight > 0
    value = info.vector[INDEX[runs.name]] + runs.value[seen]
    margin = OUT_STDS / np.sqrt(runs.weight[seen]) + OUT_SCATTERS * runs.scatter
    return bool(np.mean((value < low - margin) | (value > high + margin)) <= OUT_RATIO)


def _at_common_fit(fit: CauseFit, name: str, std: Array) -> _RunValues:
    """Return the values of a parameter by each run at the common fit, beside nuisances of standard deviations (q,)."""
    shared = fit.change - fit.info.away[fit.info.places(fit.names)]
    return _values_by_run(fit, name, fit.names, shared, fit.info.nuisances, std)


def _own_values(fit: CauseFit, effect: Effect, scatter: Sequence[float]) -> _OwnValues:
    """Fit runs with values of their own of an effect, all else as it is assumed, from a scatter of its parameters."""
    info, own = fit.info, tuple(p.name for p in effect.parameters)
    names = tuple(dict.fromkeys([*fit.names, *own]))
    beside = info.nuisances[~np.isin(info.nuisances, info.places(own))]
    varies = np.array([*beside, *info.places(own)], dtype=int)
    least = _least_std(fit, own)
    free = np.arange(len(least)) >= len(beside)
    start = np.where(free, 0.0, least)
    start[free] = scatter
    gram, shared = info.grams.sum(axis=1), info.places(names)
    mixed = fit_mixed(gram, shared, varies, least, start, free)
    alike = fit_mixed(gram, shared, varies, least, least, np.zeros_like(free))
    runs = tuple(_values_by_run(fit, name, names, mixed.shared, varies, mixed.std) for name in own)
    return _OwnValues(effect, runs, mixed.loss, alike.loss - mixed.loss)


def _refitted(problem: Problem, fit: CauseFit, tried: _OwnValues) -> _OwnValues:
    """Return the same by a nonlinear fit: sensitivities of each run at its own values."""
    base = fit.info.vector
    names = tuple(dict.fromkeys([*fit.names, *(p.name for p in tried.effect.parameters)]))
    for _ in range(N_STEPS):
        own = {
            runs.name: np.clip(base[INDEX[runs.name]] + runs.value, *BOUNDS[runs.name]) for runs in tried.runs
        }
        there = problem.at(fit.info.origin, names, fit.info.statistics, own)
        moved = fit._replace(info=replace(there, vector=base))
        tried = _own_values(moved, tried.effect, [runs.scatter for runs in tried.runs])
    return tried


def _least_std(fit: CauseFit, own: Sequence[str]) -> Array:
    """Return the standard deviations assumed of nuisances, and those of an effect, last.

    What was assumed of a parameter is no news, other than what was estimated.
    """
    info = fit.info
    names = [info.names[i] for i in info.nuisances if info.names[i] not in own]
    return np.array([fit.assumed_scatter.get(n, 0.0) or LEAST_RATIO * PRIOR_STD[n] for n in (*names, *own)])


def _values_by_run(
    fit: CauseFit, name: str, names: Sequence[str], shared: Array, varies: Array, std: Array
) -> _RunValues:
    """Return the values of a parameter by each run, with all that varies (places and std, (q,)) beside it marginalised.

    All runs share values (m,) of parameters by name, over where sensitivities were taken.
    """
    info, (place,) = fit.info, fit.info.places([name])
    random, std = varies[varies != place], std[varies != place]
    q = len(random)
    columns = np.zeros((len(info.names) + 1, q + 2))  # what varies, the parameter, and the residual
    columns[random, np.arange(q)] = 1.0
    columns[place, q] = 1.0
    columns[info.places(names), -1] = -shared
    columns[-1, -1] = 1.0
    taken = marginal_parts(columns.T @ info.grams @ columns, np.arange(q), std)[:, :, q:, q:]
    mean = info.away[place] + (shared[list(names).index(name)] if name in names else 0.0)
    assumed = float(fit.assumed_scatter.get(name, 0.0))
    return _between_runs(name, taken[:, :, 0, 1], taken[:, :, 0, 0], assumed, float(mean))


def _between_runs(name: str, score: Array, weight: Array, assumed_std: float, mean: float) -> _RunValues:
    """Compare values between runs with those between thirds of each run, all (runs, N_BLOCKS)."""
    total = weight.sum(axis=1)
    seen = total > 1e-6 * max(float(total.max()), 1e-30)
    if seen.sum() < 2 * MIN_GROUP or not total.max() > 0:
        return _RunValues(name, np.zeros(len(total)), np.ones(len(total)), 0.0, 0.0)
    value = np.where(seen, score.sum(axis=1) / np.where(seen, total, 1.0), 0.0)
    use = seen[:, None] & (weight > 0.05 * total[:, None])
    apart = (score - weight * value[:, None]) ** 2 / np.where(use, weight, 1.0)
    inside, dof = float(apart[use].sum()), int(np.maximum(use.sum(axis=1) - 1, 0).sum())
    # thirds of a run share its deviations, most of the variance of a short one: no less than by whitening
    noise = max((TRUST_DOF + inside) / (TRUST_DOF + dof), 1.0)
    precision = np.where(seen, 1.0 / (noise / np.where(seen, total, 1.0) + assumed_std**2), 0.0)
    # one run that is far out is no variation from run to run: the others have to differ as well
    known = np.flatnonzero(seen)
    rests = [np.delete(known, i) for i in range(len(known))]
    likelihood = min(_likelihood_ratio(value[rest], precision[rest]) for rest in rests)
    z = z_of_t(math.sqrt(max(likelihood, 0.0)), TRUST_DOF + dof)
    # squares about the mean, in variances, those far out limited
    square = precision * (value - (precision * value).sum() / precision.sum()) ** 2
    square = np.minimum(square, 9.0 * max(float(np.median(square[precision > 0])), 1.0))
    beyond = float(square.sum()) - (len(known) - 1)
    spread = float(precision.sum() - (precision**2).sum() / precision.sum())
    scatter = math.sqrt(max(beyond / spread, 0.0) + assumed_std**2)
    return _RunValues(name, value + mean, precision, scatter, z)


def _likelihood_ratio(value: Array, precision: Array) -> float:
    """Return the fall of minus twice the log-likelihood where values have a scatter of their own."""
    variance = 1.0 / precision + (SCATTERS[:, None] * np.ptp(value)) ** 2
    mean = (value / variance).sum(axis=1) / (1.0 / variance).sum(axis=1)
    loss = (np.log(variance) + (value - mean[:, None]) ** 2 / variance).sum(axis=1)
    return float(loss[0] - loss.min())


def _two_groups(best: _RunValues, run_ids: Sequence[str]) -> tuple[RunGroup, ...]:
    """Return two groups of runs, if values fall into two; none if they do not."""
    order = [i for i in np.argsort(best.value, kind="stable") if best.weight[i] > 0]
    value, weight = best.value[order], best.weight[order]

    def square(part: slice) -> float:
        v, w = value[part], weight[part]
        return float((w * (v - np.average(v, weights=w)) ** 2).sum())

    cuts = range(MIN_GROUP, len(order) - MIN_GROUP + 1)
    left = {k: square(slice(0, k)) + square(slice(k, None)) for k in cuts}
    cut = min(left, key=lambda k: left[k], default=0)
    if not cut or max(left[cut] - (len(order) - 2), 0.0) > TWO_GROUPS_RATIO * square(slice(None)):
        return ()
    return tuple(
        RunGroup(
            float(np.average(value[part], weights=weight[part])),
            float(1.0 / math.sqrt(weight[part].sum())),
            tuple(sorted(run_ids[i] for i in order[part])),
        )
        for part in (slice(0, cut), slice(cut, None))
    )


# -- Linear mixed model of runs: parameters that all runs share, and such of which each run has its own value --
# Of each run ``i`` the whitened residual is ``X_i x + N_i b_i + e_i`` with ``b_i ~ N(0, D)``, ``D`` diagonal.
# Shared values ``x``, and those of the variances ``D`` that are free, are of greatest likelihood, found by
# expectation and maximisation (Laird and Ware, Biometrics 1982): with ``G = N'N``,
#
#     V = (G + D^-1)^-1,   x = generalised least squares,   b = V N'(r - X x),   D <- mean of b^2 + V over runs.
#
# Minus twice the log-likelihood is, up to a constant, ``sum |r - X x|^2 - b'(G + D^-1) b + log det(1 + G D)``:
# what a parameter costs that may differ from run to run is the last term.

EM_STEPS = 30  #: Enough from a start that is not far too small: variances then fall to where they belong


class MixedFit(NamedTuple):
    """A fit of runs."""

    loss: float  #: minus twice the log-likelihood, up to what no choice of parameters changes
    shared: Array  #: (m,) values that all runs share
    std: Array  #: (q,) standard deviations of the values that each run has of its own


def fit_mixed(
    gram: Array,
    shared: Sequence[int],
    own: Sequence[int] | Array,
    least_std: Array,
    start_std: Array,
    free: Array,
) -> MixedFit:
    """Return the fit of greatest likelihood.

    Parameters
    ----------
    gram : (runs, k + 1, k + 1) products of the whitened columns of each run, the residual last
    shared, own : places of the m parameters that all runs share, and of the q that differ about them
    least_std, start_std : (q,) least standard deviations, and those to start from, both above zero
    free : (q,) whether a standard deviation is estimated; the others stay as they start

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> columns = rng.standard_normal((200, 50, 1))
    >>> values = 1.0 + 0.5 * rng.standard_normal((200, 1))
    >>> residual = columns[:, :, 0] * values + 0.1 * rng.standard_normal((200, 50))
    >>> both = np.concatenate([columns, residual[:, :, None]], axis=2) / 0.1
    >>> gram, least = both.transpose(0, 2, 1) @ both, np.array([1e-3])
    >>> fit = fit_mixed(gram, [0], [0], least, np.ones(1), np.array([True]))
    >>> bool(abs(fit.shared[0] - 1.0) < 0.1), bool(abs(fit.std[0] - 0.5) < 0.1)
    (True, True)
    """
    outer, m = [*shared, gram.shape[1] - 1], len(shared)
    inside, cross = gram[:, own][:, :, own], gram[:, own][:, :, outer]
    outside = gram[:, outer][:, :, outer].sum(axis=0)
    std = np.maximum(start_std, least_std)
    for step in range(EM_STEPS + 1):
        inner = np.linalg.inv(inside + np.diag(1.0 / std**2))
        follow = inner @ cross
        total = outside - (cross.transpose(0, 2, 1) @ follow).sum(axis=0)
        values = np.linalg.lstsq(total[:m, :m], total[:m, m], rcond=1e-10)[0] if m else np.zeros(0)
        if step < EM_STEPS:
            deviation = follow @ np.concatenate([-values, [1.0]])
            square = (deviation**2 + np.einsum("iqq->iq", inner)).mean(axis=0)
            std = np.where(free, np.maximum(np.sqrt(square), least_std), std)
    scaled = np.eye(len(std)) + std[:, None] * inside * std
    loss = float(total[m, m] - values @ total[:m, m] + np.linalg.slogdet(scaled)[1].sum())
    return MixedFit(loss, values, std)


# -- Conditions that differ from run to run, as the load or the moisture of the soil: what they may explain --
# A quantity that is never below none, as a load, has a mean of ``sqrt(3)`` times its standard deviation where
# it is spread evenly from none.  So where the values of single runs scatter by ``s``, a mean over runs of up to
# ``sqrt(3) s`` is what conditions explain, up to what they are known to make; the rest is news.

MEAN_PER_SCATTER = math.sqrt(3.0)  #: Mean over standard deviation of what is spread evenly from none


def with_conditions(problem: Problem, info: Evidence) -> Problem:
    """Return the problem with the error that conditions make which differ between its runs.

    Its simulation has what they may make at the most.
    """
    simulation = problem.simulation
    if not simulation.varied_error:
        return problem
    fit = cause_fit(problem._replace(library=()), info, ())._replace(assumed_scatter=simulation.scatter)
    error = dict(simulation.model_error)
    for effect in problem.library:
        name = effect.parameters[0].name
        if name in simulation.varied_error:
            mean = min(MEAN_PER_SCATTER * run_scatter(fit, name), simulation.varied_error[name])
            error[name] = math.hypot(error.get(name, 0.0), mean)
    return problem._replace(simulation=replace(simulation, model_error=error))
