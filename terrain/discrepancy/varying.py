"""Effects whose size differs from run to run: how much, and whether the runs fall into two groups.

Of each run the value ``x_i`` of one parameter is fitted by itself, with what varies from run to run by itself
marginalised.  The scatter of ``x_i`` between runs is compared with that between the thirds of each run (an
analysis of variance): noise that lasts is in both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import f as fisher

from terrain.discrepancy.information import N_BLOCKS
from terrain.discrepancy.search import Found
from terrain.discrepancy.selection import TRUST_DOF, z_of
from terrain.discrepancy.verdict import RunGroup, Varying
from terrain.effects import BOUNDS, CHANNELS, INDEX, Effect
from terrain.records import Array

Z_VARIES = 4.5
"""Evidence of a difference between runs, as of a probe: of some thirty effects."""

VARIES_RATIO = 0.5
"""A named value that scatters by more than that ratio of itself is no value of all runs."""

TWO_GROUPS_RATIO = 0.15
"""Part of the scatter that two groups leave: a uniform distribution, cut in its middle, leaves 0.25."""

MIN_GROUP = 2
"""Least number of runs in a group."""

ALIKE_RATIO = 0.9
"""An effect that explains so much of what the best one explains is not distinguished from it."""


class _RunValues(NamedTuple):
    """Values (runs,) of a parameter by each run alone, and how far they scatter beyond the noise."""

    effect: Effect
    value: Array
    weight: Array
    gain: float
    scatter: float
    z: float
    channel: str


def run_scatter(found: Found, effect: Effect) -> float:
    """Return the scatter from run to run of the first parameter of an effect, noise taken off."""
    return _run_values(found, effect).scatter


def varying_effects(found: Found, library: Sequence[Effect]) -> tuple[Varying, ...]:
    """Return the effect whose size differs most clearly from run to run; none where runs are alike.

    Only one is returned: what one effect varies by looks like a variation of all that resemble it.
    """
    if len(found.info.rows) < 2 * MIN_GROUP:
        return ()
    tried = [_run_values(found, effect) for effect in library if len(effect.parameters) == 1]
    tried = [each for each in tried if each.z > Z_VARIES and _is_possible(each)]
    if not tried:
        return ()
    best = max(tried, key=lambda each: each.gain)
    rivals = [each.effect.name for each in tried if each is not best and each.gain > ALIKE_RATIO * best.gain]
    parameter = best.effect.parameters[0]
    groups = _two_groups(best, [run.run_id for run in found.info.rows])
    mean = float(np.average(best.value, weights=best.weight))
    return (
        Varying(
            best.effect.name,
            parameter.name,
            parameter.unit,
            tuple(rivals),
            mean,
            best.scatter,
            best.z,
            groups,
            best.channel,
        ),
    )


def _is_possible(tried: _RunValues) -> bool:
    """Return whether the values of most runs are what the parameter may be."""
    low, high = BOUNDS[tried.effect.parameters[0].name]
    mean = float(np.average(tried.value, weights=tried.weight))
    return bool(low <= mean - tried.scatter and mean + tried.scatter <= high)


def _run_values(found: Found, effect: Effect) -> _RunValues:
    """Fit a parameter to each run, at the common fit of all."""
    info, name = found.info, effect.parameters[0].name
    place = info.places([name])[0]
    own_nuisance = np.flatnonzero(info.nuisances == place)
    kept = np.delete(info.nuisances, own_nuisance)
    std = np.delete(info.nuisance_std, own_nuisance)
    selected = info.places(found.names)
    fit = found.change - np.array([info.origin[INDEX[n]] - info.vector[INDEX[n]] for n in found.names])
    n = len(info.rows)
    score, weight = np.empty((n, N_BLOCKS)), np.empty((n, N_BLOCKS))
    power = np.zeros(len(CHANNELS))
    for i, (residual, change) in enumerate(zip(info.white_residual, info.white_change, strict=True)):
        left = residual - np.tensordot(fit, change[selected], axes=1) * (residual != 0.0)
        columns = np.concatenate([change[kept], change[place][None], left[None]])
        power += (change[place] ** 2).sum(axis=0)
        edges = [columns.shape[1] * b // N_BLOCKS for b in range(N_BLOCKS + 1)]
        parts = [columns[:, edges[b] : edges[b + 1]].reshape(len(columns), -1) for b in range(N_BLOCKS)]
        grams = np.array([part @ part.T for part in parts])
        q = len(kept)
        gram = grams.sum(axis=0)
        follow = np.linalg.solve(gram[:q, :q] + np.diag(1.0 / std**2), gram[:q, q:])
        for b in range(N_BLOCKS):
            cross = grams[b][:q, q:]
            taken = (
                grams[b][q:, q:] - follow.T @ cross - cross.T @ follow + follow.T @ grams[b][:q, :q] @ follow
            )
            weight[i, b], score[i, b] = taken[0, 0], taken[0, 1]
    assumed = float(info.nuisance_std[own_nuisance[0]]) if own_nuisance.size else 0.0
    given = float(found.change[found.names.index(name)]) if name in found.names else 0.0
    return _scattered(effect, score, weight, _assumed_scatter(found, name, assumed), given, _clearest(power))


def _assumed_scatter(found: Found, name: str, estimated: float) -> float:
    """Return the scatter that is no news: what was assumed of the parameter, not what was estimated."""
    return min(float(found.assumed_scatter.get(name, 0.0)), estimated) if estimated else 0.0


def _clearest(power: Array) -> str:
    return CHANNELS[int(np.argmax(power))]


def _scattered(
    effect: Effect, score: Array, weight: Array, assumed_std: float, given: float, channel: str
) -> _RunValues:
    """Compare values between runs with those between thirds of each run."""
    total = weight.sum(axis=1)
    seen = total > 1e-6 * max(float(total.max()), 1e-30)
    if seen.sum() < 2 * MIN_GROUP or not total.max() > 0:
        nothing = np.zeros(len(total))
        return _RunValues(effect, nothing, np.ones(len(total)), 0.0, 0.0, 0.0, channel)
    value = np.where(seen, score.sum(axis=1) / np.where(seen, total, 1.0), 0.0)
    inside, dof = 0.0, 0
    for i in np.flatnonzero(seen):
        use = weight[i] > 0.05 * total[i]
        inside += float(((score[i] - weight[i] * value[i])[use] ** 2 / weight[i][use]).sum())
        dof += max(int(use.sum()) - 1, 0)
    noise = (TRUST_DOF + inside) / (TRUST_DOF + dof)
    precision = np.where(seen, 1.0 / (noise / np.where(seen, total, 1.0) + assumed_std**2), 0.0)
    square = _squares(value, precision)
    # one run that is far out is no variation from run to run: the others have to differ as well
    rest = np.where(np.arange(len(square)) == np.argmax(square), 0.0, precision)
    n = int(seen.sum())
    z = z_of(float(fisher.logsf(_squares(value, rest).sum() / (n - 2), n - 2, TRUST_DOF + dof)))
    beyond = float(square.sum()) - (n - 1)
    spread = float(precision.sum() - (precision**2).sum() / precision.sum())
    scatter = math.sqrt(max(beyond / spread, 0.0) + assumed_std**2)
    return _RunValues(effect, value + given, precision, float(square.sum()), scatter, z, channel)


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
