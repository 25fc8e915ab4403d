"""Effects whose size differs from run to run: how much, and whether the runs fall into two groups.

Runs are fitted with values of their own of one effect at a time, by a mixed model in which all else varies by
no more than is assumed.  The answer is the effect with the greatest likelihood: what half of the wheels do is
not the scatter of a track, though a scatter of the track that is estimated beside it would take most of it.

Whether an effect varies is judged by the likelihood that is lost with one value for all runs.  The noise of a
run's value is that between the thirds of each run, since noise that lasts is in both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.evidence import PRIOR_STD, Evidence, marginal_parts, recentre
from terrain.discrepancy.fitting import Problem
from terrain.discrepancy.mixed_model import MixedFit, fit_mixed
from terrain.discrepancy.rivals import RIVAL_LINEAR, RIVAL_LOSS
from terrain.discrepancy.search import Found
from terrain.discrepancy.selection import TRUST_DOF, z_of_t
from terrain.discrepancy.verdict import RunGroup, Varying
from terrain.effects import BOUNDS, CHANNELS, INDEX, Effect
from terrain.records import Array

Z_VARIES = 4.5
"""Evidence of a difference between runs, as of a probe: of some thirty effects."""

Z_NEAR = 3.0
"""Evidence of an effect that may be what varies instead of one whose evidence is enough."""

VARIES_RATIO = 0.5
"""A named value that scatters by more than that ratio of itself is no value of all runs."""

TWO_GROUPS_RATIO = 0.15
"""Part of the scatter that two groups leave: a uniform distribution, cut in its middle, leaves 0.25."""

MIN_GROUP = 2
"""Least number of runs in a group."""

OUT_STDS, OUT_SCATTERS, OUT_RATIO = 3.0, 0.25, 0.2
"""A run's value is out of its bounds by so many standard deviations and scatters, and the ratio of the runs
that may be: a rogue or two, and less than a group of eight runs."""

LEAST_RATIO = 1e-4
"""Least scatter of a parameter of which none is assumed, over the prior of its value."""

NEAR_RATIO, N_STEPS = 0.2, 3
"""Effects whose loss is behind by that ratio of the best one's gain are compared by nonlinear fits of so many
steps: a run's own value may be far from where sensitivities were taken."""

SCATTERS = np.concatenate([[0.0], np.geomspace(1e-3, 1.0, 40)])
"""Scatters that are tried, over the range of the values."""


class _RunValues(NamedTuple):
    """Values (runs,) of a parameter by each run alone, and how far they scatter beyond the noise.

    Parameters
    ----------
    value : over what the simulation has of it
    weight : precision of each, 0 where a run shows nothing
    """

    name: str
    value: Array
    weight: Array
    scatter: float
    z: float


class _Tried(NamedTuple):
    """An effect of which each run has its own values, by parameter, and how well that fits.

    Parameters
    ----------
    gain : fall of the loss from one value in all runs
    """

    effect: Effect
    runs: tuple[_RunValues, ...]
    loss: float
    gain: float

    @property
    def clearest(self) -> _RunValues:
        """The parameter that differs most clearly."""
        return max(self.runs, key=lambda each: each.z)


def run_scatter(found: Found, name: str) -> float:
    """Return the scatter from run to run of a parameter, noise taken off."""
    shared = found.change - found.info.away[found.info.places(found.names)]
    fit = MixedFit(0.0, shared, found.info.nuisance_std)
    return _values_by_run(found, name, found.names, (), fit).scatter


def varying_effects(problem: Problem, found: Found) -> tuple[Varying, ...]:
    """Return the effect whose size differs most clearly from run to run; none where runs are alike.

    Only one is returned: what one effect varies by looks like a variation of all that resemble it.
    """
    info = found.info
    if len(info.rows) < 2 * MIN_GROUP:
        return ()
    clear = {effect.name: _clearness(found, effect) for effect in problem.library}
    if not max(clear.values()) > Z_VARIES:
        return ()
    tried = [_tried(found, effect) for effect in problem.library if clear[effect.name] > Z_NEAR]
    first = min(tried, key=lambda each: each.loss)
    behind = max(RIVAL_LINEAR, NEAR_RATIO * first.gain)
    refitted = [(_refitted(problem, found, each), each) for each in tried if each.loss <= first.loss + behind]
    near = [pair for pair in refitted if _is_possible(info, pair[0].clearest)]
    if not near:
        return ()
    best, linear = min(near, key=lambda pair: pair[0].loss)
    # a mass makes more or less of the noise of the wheels, which a nonlinear fit counts: either may say so
    alike = [
        each for each, before in near if min(each.loss - best.loss, before.loss - linear.loss) < RIVAL_LOSS
    ]
    if not max(each.clearest.z for each in alike) > Z_VARIES:
        return ()
    rivals = [each.effect.name for each in alike if each is not best]
    runs = best.clearest
    parameter = best.effect.parameters[best.runs.index(runs)]
    return (
        Varying(
            best.effect.name,
            parameter.name,
            parameter.unit,
            tuple(rivals),
            float(np.average(runs.value, weights=runs.weight)),
            runs.scatter,
            runs.z,
            _two_groups(runs, [run.run_id for run in info.rows]),
            _clearest_channel(info, runs.name),
        ),
    )


def _is_possible(info: Evidence, runs: _RunValues) -> bool:
    """Return whether the values of most runs are what the parameter may be."""
    low, high = BOUNDS[runs.name]
    seen = runs.weight > 0
    value = info.vector[INDEX[runs.name]] + runs.value[seen]
    margin = OUT_STDS / np.sqrt(runs.weight[seen]) + OUT_SCATTERS * runs.scatter
    return bool(np.mean((value < low - margin) | (value > high + margin)) <= OUT_RATIO)


def _clearness(found: Found, effect: Effect) -> float:
    """Return the evidence that an effect varies by itself, at the common fit of all runs."""
    return max(each.z for each in _at_common_fit(found, effect))


def _at_common_fit(found: Found, effect: Effect) -> list[_RunValues]:
    fit = MixedFit(0.0, found.change - found.info.away[found.info.places(found.names)], _least_std(found, ()))
    return [_values_by_run(found, p.name, found.names, (), fit) for p in effect.parameters]


def _tried(found: Found, effect: Effect, scatter: Sequence[float] = ()) -> _Tried:
    """Fit runs with values of their own of an effect, all else as it is assumed.

    Parameters
    ----------
    scatter : of its parameters, to start from; estimated at the common fit by default
    """
    info, own = found.info, tuple(p.name for p in effect.parameters)
    names = (*found.names, *(name for name in own if name not in found.names))
    least = _least_std(found, own)
    free = np.arange(len(least)) >= len(least) - len(own)
    start = least.copy()
    start[free] = scatter or [each.scatter for each in _at_common_fit(found, effect)]
    varies = [*info.nuisances[_kept(info, own)], *info.places(own)]
    gram, shared = info.grams.sum(axis=1), info.places(names)
    fit = fit_mixed(gram, shared, varies, least, start, free)
    alike = fit_mixed(gram, shared, varies, least, least, np.zeros_like(free))
    runs = tuple(_values_by_run(found, name, names, own, fit) for name in own)
    return _Tried(effect, runs, fit.loss, alike.loss - fit.loss)


def _refitted(problem: Problem, found: Found, tried: _Tried) -> _Tried:
    """Return the same by a nonlinear fit: sensitivities of each run at its own values."""
    base = found.info.vector
    names = tuple(dict.fromkeys([*found.names, *(p.name for p in tried.effect.parameters)]))
    for _ in range(N_STEPS):
        own: Mapping[str, Array] = {
            runs.name: np.clip(base[INDEX[runs.name]] + runs.value, *BOUNDS[runs.name]) for runs in tried.runs
        }
        there = problem.at(found.info.origin, names, found.info.statistics, own)
        scatter = [runs.scatter for runs in tried.runs]
        tried = _tried(found._replace(info=recentre(there, base)), tried.effect, scatter)
    return tried


def _kept(info: Evidence, own: Sequence[str]) -> Array:
    """Return which of the nuisances are of no effect of their own."""
    return ~np.isin(info.nuisances, info.places(own))


def _least_std(found: Found, own: Sequence[str]) -> Array:
    """Return the standard deviations assumed of nuisances, and those of an effect, last."""
    info = found.info
    names = [info.parameters[i] for i in info.nuisances[_kept(info, own)]]
    return np.array([_assumed(found, name) or LEAST_RATIO * PRIOR_STD[name] for name in (*names, *own)])


def _assumed(found: Found, name: str) -> float:
    """Return the scatter that is no news: what was assumed of the parameter, not what was estimated."""
    return float(found.assumed_scatter.get(name, 0.0))


def _values_by_run(
    found: Found, name: str, names: Sequence[str], own: Sequence[str], fit: MixedFit
) -> _RunValues:
    """Return the values of a parameter by each run, with all that varies beside it marginalised.

    Parameters
    ----------
    names : of the parameters whose shared values ``fit`` has
    own : parameters that ``fit`` has deviations of beside the nuisances, last
    """
    info = found.info
    varies = np.array([*info.nuisances[_kept(info, own)], *info.places(own)], dtype=int)
    beside = varies != info.places([name])[0]
    kept, q = varies[beside], int(beside.sum())
    columns = np.zeros((len(info.parameters) + 1, q + 2))  # what varies, the parameter, and the residual
    columns[kept, np.arange(q)] = 1.0
    columns[info.places([name])[0], q] = 1.0
    columns[info.places(names), -1] = -fit.shared
    columns[-1, -1] = 1.0
    taken = marginal_parts(columns.T @ info.grams @ columns, np.arange(q), fit.std[beside])[:, :, q:, q:]
    mean = info.away[info.places([name])[0]] + (fit.shared[list(names).index(name)] if name in names else 0.0)
    return _between_runs(name, taken[:, :, 0, 1], taken[:, :, 0, 0], _assumed(found, name), float(mean))


def _clearest_channel(info: Evidence, name: str) -> str:
    place = info.places([name])[0]
    power = sum((change[place] ** 2).sum(axis=0) for change in info.white_change)
    return CHANNELS[int(np.argmax(power))]


def _between_runs(name: str, score: Array, weight: Array, assumed_std: float, mean: float) -> _RunValues:
    """Compare values between runs with those between thirds of each run, all (runs, N_BLOCKS)."""
    total = weight.sum(axis=1)
    seen = total > 1e-6 * max(float(total.max()), 1e-30)
    if seen.sum() < 2 * MIN_GROUP or not total.max() > 0:
        nothing = np.zeros(len(total))
        return _RunValues(name, nothing, np.ones(len(total)), 0.0, 0.0)
    value = np.where(seen, score.sum(axis=1) / np.where(seen, total, 1.0), 0.0)
    inside, dof = 0.0, 0
    for i in np.flatnonzero(seen):
        use = weight[i] > 0.05 * total[i]
        inside += float(((score[i] - weight[i] * value[i])[use] ** 2 / weight[i][use]).sum())
        dof += max(int(use.sum()) - 1, 0)
    # thirds of a run share its deviations, most of the variance of a short one: no less than by whitening
    noise = max((TRUST_DOF + inside) / (TRUST_DOF + dof), 1.0)
    precision = np.where(seen, 1.0 / (noise / np.where(seen, total, 1.0) + assumed_std**2), 0.0)
    square = _squares(value, precision)
    # one run that is far out is no variation from run to run: the others have to differ as well
    known = np.flatnonzero(seen)
    likelihood = min(_likelihood_ratio(value[rest], precision[rest]) for rest in _left_out(known))
    z = z_of_t(math.sqrt(max(likelihood, 0.0)), TRUST_DOF + dof)
    square = _squares(value, precision)
    beyond = float(square.sum()) - (len(known) - 1)
    spread = float(precision.sum() - (precision**2).sum() / precision.sum())
    scatter = math.sqrt(max(beyond / spread, 0.0) + assumed_std**2)
    return _RunValues(name, value + mean, precision, scatter, z)


def _left_out(places: Array) -> list[Array]:
    return [np.delete(places, i) for i in range(len(places))]


def _likelihood_ratio(value: Array, precision: Array) -> float:
    """Return the fall of minus twice the log-likelihood where values have a scatter of their own."""
    variance = 1.0 / precision + (SCATTERS[:, None] * np.ptp(value)) ** 2
    mean = (value / variance).sum(axis=1) / (1.0 / variance).sum(axis=1)
    loss = (np.log(variance) + (value - mean[:, None]) ** 2 / variance).sum(axis=1)
    return float(loss[0] - loss.min())


def _squares(value: Array, precision: Array) -> Array:
    """Return the squares (runs,) of values about their mean, in variances, those far out limited."""
    square = precision * (value - (precision * value).sum() / precision.sum()) ** 2
    return np.asarray(np.minimum(square, 9.0 * max(float(np.median(square[precision > 0])), 1.0)))


def _two_groups(best: _RunValues, run_ids: Sequence[str]) -> tuple[RunGroup, ...]:
    """Return two groups of runs, if values fall into two; none if they do not."""
    order = [i for i in np.argsort(best.value, kind="stable") if best.weight[i] > 0]
    value, weight = best.value[order], best.weight[order]
    mean = np.average(value, weights=weight)
    total = float((weight * (value - mean) ** 2).sum())
    least, cut = math.inf, 0
    for k in range(MIN_GROUP, len(order) - MIN_GROUP + 1):
        left = sum(
            float((w * (v - np.average(v, weights=w)) ** 2).sum())
            for v, w in ((value[:k], weight[:k]), (value[k:], weight[k:]))
        )
        if left < least:
            least, cut = left, k
    if not cut or max(least - (len(order) - 2), 0.0) > TWO_GROUPS_RATIO * total:
        return ()
    groups = []
    for part in (slice(0, cut), slice(cut, None)):
        w = weight[part]
        ids = tuple(sorted(run_ids[i] for i in order[part]))
        groups.append(
            RunGroup(float(np.average(value[part], weights=w)), float(1.0 / math.sqrt(w.sum())), ids)
        )
    return tuple(groups)
