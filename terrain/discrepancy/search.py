"""The search for causes: greedy addition, refit where sensitivities have changed, drop, swap and rivals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.evidence import (
    Evidence,
    move_point,
    partial_information,
    recentre,
)
from terrain.discrepancy.fitting import Problem, Refit, fit_again, names_of, penalised_loss, relinearize
from terrain.discrepancy.rivals import RIVAL_LOSS, Rival, rivals_of
from terrain.discrepancy.selection import WaldTest, fit_change, wald_test
from terrain.effects import BOUNDS, INDEX, Effect
from terrain.records import Array

MAX_CAUSES = 8
"""Most causes of a diagnosis: with more the simulation is of another robot.  Lags of two sensors, track, side
slip, drag, and a wrong lever arm are six."""

MAX_STEPS = 12
"""Most steps of the search, successful or not."""

MUCH_GAIN, CLOSE_GAIN, MAX_FITTED = 200.0, 0.3, 6
"""Gain above which the best candidates are compared by nonlinear fits: those with that ratio of the best
one's gain, so many at most."""

Z_PAIR = 4.6
"""Evidence that each of two effects needs beside the other, if neither is significant alone: 4e-6."""

ALIKE = 0.99
"""Two effects whose sensitivities correlate more are not taken for a pair."""


class Found(NamedTuple):
    """Where the search ended.

    Parameters
    ----------
    causes : effects selected, in the order in which they came
    info : of the runs there, changes counted from the simulation that was given
    change : (k,) of the parameters ``names``, and its covariance
    rivals : by cause, the effects that fit as well in its place, once :func:`with_rivals` has looked
    tried : last evidence of every effect
    assumed_scatter : from run to run, by parameter, that is no news
    """

    causes: tuple[Effect, ...]
    info: Evidence
    names: tuple[str, ...]
    change: Array
    cov: Array
    rivals: dict[str, tuple[Rival, ...]]
    tried: dict[str, WaldTest]
    assumed_scatter: Mapping[str, float]


def search(problem: Problem, start: Evidence, seeds: Mapping[str, float] | None = None) -> Found:
    """Return the causes that explain the runs.

    Parameters
    ----------
    problem : of what
    start : information of the runs around the simulation as it is given
    seeds : parameters whose values are so large that sensitivities without them would mislead, as lags of
        sensors: other causes are first searched with them built in, then all are fitted together
    """
    base = start.vector
    causes: list[Effect] = []
    info = start
    if seeds:
        there = move_point(base, tuple(seeds), np.array(list(seeds.values())))
        first, info = _grow(problem, problem.at(there), there, [])
        seeded = [each for each in problem.library if set(names_of([each])) & set(seeds)]
        causes = [*seeded, *(cause for cause in first if cause not in seeded)]
        causes, info = _refit_significant(problem, recentre(info, base), base, causes)
    causes, info = _grow(problem, info, base, causes)
    return _found(problem, info, causes)


def _grow(
    problem: Problem, info: Evidence, base: Array, causes: list[Effect]
) -> tuple[list[Effect], Evidence]:
    """Add effects, refit, drop and swap, until none is significant that is not there."""
    barred: set[str] = set()  # added to the current causes, and dropped again
    seen = {_set_of(causes)}  # sets that were reached; none twice, or the search goes in circles
    fits: dict[tuple[frozenset[str], str], Refit] = {}  # none is made twice

    def fit(effect: Effect) -> Refit:
        key = _set_of(causes), effect.name
        if key not in fits:
            fits[key] = fit_again(problem, info, base, names_of([*causes, effect]))
        return fits[key]

    for _ in range(MAX_STEPS):
        left = [each for each in problem.library if each not in causes and each.name not in barred]
        new = _next(info, base, causes, left, fit)
        if not new or len(causes) + len(new) > MAX_CAUSES:
            break
        more, at = _refit_significant(problem, info, base, [*causes, *new], seen)
        if at is not info:
            more, at = _swap_for_better(problem, at, base, more)
        if _set_of(more) not in seen:
            seen.add(_set_of(more))
            barred = set()
            causes, info = more, at
        barred |= {effect.name for effect in new if effect not in causes}
    return causes, info


def refit(problem: Problem, start: Evidence, found: Found, causes: Sequence[Effect]) -> Found:
    """Return some of the causes that were found, fitted without the others; no other is searched.

    Those that are no longer significant are dropped.
    """
    kept, info = _refit_significant(problem, found.info, start.vector, list(causes))
    return _found(problem, info, kept)


def _found(problem: Problem, info: Evidence, causes: Sequence[Effect]) -> Found:
    """Return what there is to say about causes at their fit, rivals left out."""
    names = names_of(causes)
    change, cov = fit_change(info, names)
    tried = {
        effect.name: wald_test(info, [n for n in names if n not in names_of([effect])], effect)
        for effect in problem.library
    }
    return Found(tuple(causes), info, names, change, cov, {}, tried, problem.simulation.known_scatter)


def with_rivals(problem: Problem, start: Evidence, found: Found) -> Found:
    """Return the same with the effects that fit as well in the place of a cause."""
    return found._replace(rivals=rivals_of(problem, found.info, start, found.causes))


def _next(
    info: Evidence,
    base: Array,
    causes: Sequence[Effect],
    left: Sequence[Effect],
    fit: Callable[[Effect], Refit],
) -> list[Effect]:
    """Return the effect with the largest gain on runs left out, or a pair where none is significant alone.

    Where much is wrong the linear gain is inaccurate: then the best few are compared by nonlinear fits.
    """
    found = [(wald_test(info, names_of(causes), effect), effect) for effect in left]
    candidates = [
        (float(each.gain.sum()), effect)
        for each, effect in found
        if each.significant or _is_inside_by_fit(base, causes, effect, each, fit)
    ]
    if not candidates:
        return _pair(info, causes, left)
    candidates.sort(key=lambda pair: -pair[0])
    best = candidates[0][0]
    close = [effect for gain, effect in candidates[:MAX_FITTED] if gain > CLOSE_GAIN * best]
    if best < MUCH_GAIN or len(close) == 1:
        return [candidates[0][1]]
    return [min(close, key=lambda effect: fit(effect).loss)]


def _is_inside_by_fit(
    base: Array, causes: Sequence[Effect], effect: Effect, found: WaldTest, fit: Callable[[Effect], Refit]
) -> bool:
    """Return whether an effect that gains much is within its bounds by a nonlinear fit alone.

    A robot that turns twice as fast as it should has half the track, which straight lines take for none.
    """
    if found.inside or not found._replace(inside=True).significant or found.gain.sum() < MUCH_GAIN:
        return False
    names = names_of([*causes, effect])
    values = base[[INDEX[name] for name in names]] + fit(effect).change
    return all(BOUNDS[name][0] < value < BOUNDS[name][1] for name, value in zip(names, values, strict=True))


def _refit_significant(
    problem: Problem,
    info: Evidence,
    base: Array,
    causes: list[Effect],
    seen: Set[frozenset[str]] = frozenset(),
) -> tuple[list[Effect], Evidence]:
    """Refit causes, and drop the weakest until all are significant beside the others.

    A set that was reached before is not fitted again: the information is the one given.
    """
    at = info
    while _set_of(causes) not in seen:
        at = relinearize(problem, at, base, causes)
        weak = _weakest(at, causes) if causes else None
        if weak is None:
            return causes, at
        causes = [cause for i, cause in enumerate(causes) if i != weak]
    return causes, info


def _set_of(causes: Sequence[Effect]) -> frozenset[str]:
    return frozenset(cause.name for cause in causes)


def _swap_for_better(
    problem: Problem, info: Evidence, base: Array, causes: list[Effect]
) -> tuple[list[Effect], Evidence]:
    """Replace a cause by an effect that fits better, as long as there is one."""
    for _ in range(MAX_CAUSES):
        better = _better(info, causes, problem.library)
        if better is None:
            break
        swapped, at = _refit_significant(problem, info, base, better)
        if len(swapped) < len(causes):
            break
        causes, info = swapped, at
    return causes, info


def _pair(info: Evidence, causes: Sequence[Effect], library: Sequence[Effect]) -> list[Effect]:
    """Return two effects that are significant beside each other and the causes, where neither is alone.

    Two of opposite sign, as an offset and a rate of a clock, hide each other.
    """
    left = [effect for effect in library if len(effect.parameters) == 1]
    base, own = info.places(names_of(causes)), info.places(names_of(left))
    a, g = info.a.sum(axis=0), info.g.sum(axis=0)
    follow, a_free = partial_information(a, base, own)
    g_free = g[own] - g[base] @ follow
    size = np.maximum(np.diag(a_free), 1e-12)
    z, rho = g_free / np.sqrt(size), a_free / np.sqrt(np.outer(size, size))
    np.fill_diagonal(rho, 0.0)
    apart = np.maximum(1.0 - rho**2, 1.0 - ALIKE**2)
    beside = (z[:, None] - rho * z[None, :]) / np.sqrt(apart)  # of the first, given the second
    both = np.minimum(np.abs(beside), np.abs(beside.T)) * (np.abs(rho) < ALIKE)
    for flat in np.argsort(-both, axis=None)[:8:2]:
        i, j = np.unravel_index(flat, both.shape)
        if both[i, j] < Z_PAIR:
            break
        pair = [left[int(i)], left[int(j)]]
        found = [
            wald_test(info, (*names_of(causes), *names_of([other])), one) for one, other in (pair, pair[::-1])
        ]
        if all(one.significant and one.z > Z_PAIR for one in found):
            return pair
    return []


def _weakest(info: Evidence, causes: Sequence[Effect]) -> int | None:
    """Return the least significant cause, None if all are significant beside the others."""
    z = []
    for cause in causes:
        others = names_of([other for other in causes if other is not cause])
        found = wald_test(info, others, cause)
        z.append(np.inf if found.significant else found.z)
    weakest = int(np.argmin(z))
    return weakest if np.isfinite(z[weakest]) else None


def _better(info: Evidence, causes: Sequence[Effect], library: Sequence[Effect]) -> list[Effect] | None:
    """Return the causes with one replaced by an effect that fits better, if there is one."""
    now = penalised_loss(info, causes)
    best: tuple[float, list[Effect]] = (now - RIVAL_LOSS, [])
    for i, cause in enumerate(causes):
        others = [other for other in causes if other is not cause]
        for effect in library:
            if effect in causes or not wald_test(info, names_of(others), effect).significant:
                continue
            swapped = [*causes[:i], effect, *causes[i + 1 :]]
            loss = penalised_loss(info, swapped)
            if loss < best[0]:
                best = loss, swapped
    return best[1] or None
