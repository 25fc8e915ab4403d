"""The search for causes: greedy addition, refit where sensitivities have changed, drop, swap and rivals."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.evidence import (
    Evidence,
    Nearby,
    Statistics,
    correlation,
    evidence_at,
    loss_of,
    misfit_of,
    move_point,
    nearby,
    partial_information,
    recentre,
)
from terrain.discrepancy.residuals import LowPass
from terrain.discrepancy.selection import WaldTest, fit_change, wald_test
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import BOUNDS, INDEX, Effect
from terrain.records import Array

# -- A problem: runs and a simulation; and nonlinear fits of parameters to all of them ---------------------

PARAMETER_LOSS = 4.0
"""What a fit has to gain by each of its parameters before it counts as better than one with fewer."""

MAX_HALVINGS, RISE = 4, 0.005
"""How often a step is halved that raises the whitened square by more than that ratio of it; a mass or a lag
raises it by less, with the noise of the wheels that is in the prediction."""

MAX_REFITS, SETTLED = 12, 0.3
"""Most relinearisations of the selected causes, and the ratio of its standard deviation below which a step
ends them."""

RIVAL_REFITS = 3
"""Most relinearisations of a rival."""


class Problem(NamedTuple):
    """Runs, the simulation, and the low-pass of all.

    Parameters
    ----------
    varying : standard deviation from run to run, by parameter, beside the scatter that the simulation has
    """

    signals: tuple[Signals, ...]
    simulation: Simulation
    low_pass: LowPass
    library: tuple[Effect, ...]
    varying: Mapping[str, float] = MappingProxyType({})

    @property
    def scatter(self) -> dict[str, float]:
        """Standard deviation from run to run that is assumed, by parameter."""
        return {**self.simulation.scatter, **self.varying}

    @property
    def parameters(self) -> tuple[str, ...]:
        """Of the library."""
        return tuple(p.name for effect in self.library for p in effect.parameters)

    def at(
        self,
        vector: Array,
        names: Sequence[str] | None = None,
        statistics: Statistics | None = None,
        own: Mapping[str, Array] | None = None,
    ) -> Evidence:
        """Return the information of the runs around a point; see :func:`evidence_at`."""
        desired = self.parameters if names is None else names
        return evidence_at(
            self.signals, self.simulation, vector, desired, self.low_pass, statistics, own, self.scatter
        )

    def near(self, info: Evidence, vector: Array, names: Sequence[str]) -> Nearby:
        """Return the information on a few parameters at another point, with the noise of an information."""
        return nearby(info, self.signals, self.simulation, vector, names, self.low_pass)


class Refit(NamedTuple):
    """A nonlinear fit.

    Parameters
    ----------
    loss : how badly it fits, as minus twice a log-likelihood; see
        :func:`~terrain.discrepancy.evidence.misfit_of`
    square : whitened square that it leaves
    change, std : (k,) of its parameters
    """

    loss: float
    square: float
    change: Array
    std: Array


def names_of(effects: Sequence[Effect]) -> tuple[str, ...]:
    """Return the parameters of effects, each once.

    Examples
    --------
    >>> from terrain.effects import effect_named
    >>> names_of([effect_named("lever_arm")])
    ('lever_x_m', 'lever_y_m')
    """
    return tuple(dict.fromkeys(p.name for effect in effects for p in effect.parameters))


def steps_of(
    problem: Problem, info: Evidence, base: Array, names: Sequence[str], n_most: int
) -> Iterator[Nearby]:
    """Yield the information at the points of a nonlinear fit of parameters, until it converges.

    A step that raises the whitened square is halved, and given up after :data:`MAX_HALVINGS`.
    """
    at = [INDEX[name] for name in names]
    others = np.delete(info.origin - base, at)
    here, loss = info.origin[at] - base[at], np.inf if others.any() else info.origin_loss
    change, _ = fit_change(info, names)
    for _ in range(n_most):
        point = problem.near(info, move_point(base, names, change), names)
        for _ in range(MAX_HALVINGS):
            if point.c <= (1.0 + RISE) * loss:
                break
            change = 0.5 * (here + change)
            point = problem.near(info, move_point(base, names, change), names)
        yield point
        cov = np.linalg.pinv(point.a, hermitian=True)
        here, loss = point.vector[at] - base[at], point.c
        change = here + cov @ point.g
        if (np.abs(change - here) < SETTLED * np.sqrt(np.maximum(np.diag(cov), 1e-30))).all():
            return


def relinearize(problem: Problem, info: Evidence, base: Array, causes: Sequence[Effect]) -> Evidence:
    """Fit, and return the information around the fitted point."""
    point = info.origin if causes else base
    for near in steps_of(problem, info, base, names_of(causes), MAX_REFITS):
        point = near.vector
    return recentre(problem.at(point), base)


def penalised_loss(info: Evidence, causes: Sequence[Effect]) -> float:
    """Return minus twice the log-likelihood of causes, with what each of their parameters has to gain."""
    names = names_of(causes)
    return loss_of(info, names) + PARAMETER_LOSS * len(names)


def fit_again(problem: Problem, info: Evidence, base: Array, names: Sequence[str]) -> Refit:
    """Return the best point of a nonlinear fit of parameters."""
    best: tuple[float, Nearby] | None = None
    for near in steps_of(problem, info, base, names, RIVAL_REFITS):
        misfit = misfit_of(info, near.white_residual)
        if best is None or misfit < best[0]:
            best = misfit, near
    assert best is not None
    misfit, near = best
    at = [INDEX[name] for name in names]
    std = np.sqrt(np.maximum(np.diag(np.linalg.pinv(near.a, hermitian=True)), 0.0))
    return Refit(misfit + PARAMETER_LOSS * len(names), near.c, near.vector[at] - base[at], std)


# -- Effects that fit as well as a cause in its place, by nonlinear fits -----------------------------------

RIVAL_LOSS = 8.0
"""Two causes whose best fits differ by less in minus twice the log-likelihood are not distinguished: the
wrong one of two is that much ahead with a chance of 0.3 % at most, whatever the size of the effect."""

TWIN, TWIN_LOSS = 0.99, 30.0
"""The same of two whose sensitivities correlate more, a collinearity index of 8: what distinguishes them is a
small part of what they explain, and may as well be an error of the simulation."""

RIVAL_LINEAR, RIVAL_RATIO = 80.0, 0.5
"""Loss, and ratio of the gain of the cause, above which a rival is not refitted nonlinearly."""

RIVAL_RISE = 0.02
"""Ratio by which a rival may leave a larger square than a cause: a mass that is too small predicts less of
the wheels' noise, which is up to so much of what a slow drive leaves."""

SHARED = 0.5
"""Least correlation of what a cause and its rival change: one that shares less with it explains something
else, and is no rival, however little worse it fits."""


class Rival(NamedTuple):
    """An effect that fits as well as a cause in its place.

    Parameters
    ----------
    effect : that
    behind : by how much it fits worse, as minus twice a log-likelihood, over the inflation of the cause
    change, std : (p,) of its parameters, by a fit of its own; a value may be at its bound
    """

    effect: Effect
    behind: float
    change: Array
    std: Array


def rivals_of(
    problem: Problem, info: Evidence, start: Evidence, causes: Sequence[Effect]
) -> dict[str, tuple[Rival, ...]]:
    """Return by cause all effects that, refitted in its place, fit as well as it does, the best first.

    It is compared by the noise that the causes leave and by that of the simulation as it is given: a cause
    that absorbs noise is ahead by only one of them.  Where runs disagree on a cause by more than the noise
    allows, losses count that much less, as a quasi-likelihood has them.  Where much is wrong, neither is a
    likelihood: a rival that leaves a larger square than the noise of the wheels can make is none.
    """
    base, judges = start.vector, (info, start)
    runs_alone = replace(info, model_std=np.zeros_like(info.model_std))  # in what all runs have they agree
    own: list[Refit] = []  # losses of the causes by both judges, where anything comes near
    rivals = {}
    for cause in causes:
        others = [other for other in causes if other is not cause]
        inflation = wald_test(runs_alone, names_of(others), cause).inflation
        found = []
        for effect in _near(problem, info, cause, others, inflation):
            own = own or [fit_again(problem, judge, base, names_of(causes)) for judge in judges]
            swapped = names_of([*others, effect])
            here, there = (fit_again(problem, judge, base, swapped) for judge in judges)
            behind = min(here.loss - own[0].loss, there.loss - own[1].loss) / inflation
            worse = here.square > (1.0 + RIVAL_RISE) * own[0].square + RIVAL_LOSS * inflation
            if not worse and behind < _allowed(info, others, cause, effect):
                at = [swapped.index(p.name) for p in effect.parameters]
                found.append(Rival(effect, behind, here.change[at], here.std[at]))
        rivals[cause.name] = tuple(sorted(found, key=lambda rival: rival.behind))
    return rivals


def _near(
    problem: Problem, info: Evidence, cause: Effect, others: Sequence[Effect], inflation: float
) -> list[Effect]:
    """Return the effects that come near a cause beside the others, by linear fits."""
    causes = [*others, cause]
    now = loss_of(info, names_of(causes))
    gain = loss_of(info, names_of(others)) - now
    most = min(RIVAL_LINEAR * inflation, RIVAL_LOSS * inflation + RIVAL_RATIO * gain)
    return [
        effect
        for effect in problem.library
        if effect not in causes
        and loss_of(info, names_of([*others, effect])) - now < most
        and _alike(info, others, cause, effect) > SHARED
        and wald_test(info, names_of(others), effect).inside
    ]


def _allowed(info: Evidence, others: Sequence[Effect], cause: Effect, rival: Effect) -> float:
    """Return by how much a rival may fit worse than a cause and still be a rival."""
    return TWIN_LOSS if _alike(info, others, cause, rival) > TWIN else RIVAL_LOSS


def _alike(info: Evidence, others: Sequence[Effect], cause: Effect, rival: Effect) -> float:
    """Return the correlation of what a cause and another effect change beside the others."""
    base, own, its = (info.places(names_of(effects)) for effects in (others, [cause], [rival]))
    free = partial_information(info.a.sum(axis=0), base, [*own, *its])[1]
    return correlation(free, range(len(own)), range(len(own), len(own) + len(its)))


# -- The search: greedy addition, refit, drop and swap ---------------------------------------------------------

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
        first, info = _add_causes(problem, problem.at(there), there, [])
        seeded = [each for each in problem.library if set(names_of([each])) & set(seeds)]
        causes = [*seeded, *(cause for cause in first if cause not in seeded)]
        causes, info = _refit_significant(problem, recentre(info, base), base, causes)
    causes, info = _add_causes(problem, info, base, causes)
    return _found(problem, info, causes)


def _add_causes(
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
    significant, info = _refit_significant(problem, found.info, start.vector, list(causes))
    return _found(problem, info, significant)


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


# -- Values of named causes that one simulation has for all runs -------------------------------------------
# While causes are searched, a parameter that differs from run to run has a deviation of its own in each, and
# the fit is the mean over runs.  A simulation has one value, and the best one is that which leaves the least
# square over all of them: runs count by how much they show of it.  The two agree where runs are alike.
#
# With the information ``A_i`` of each run without such deviations, and their variances ``D``, the covariance of
# that fit is ``A^-1 B A^-1``, ``A = sum A_i``, ``B = sum (A_i + A_i D A_i)``.

SCATTERS_RATIO = 1.5
"""A parameter whose scatter is estimated to be so many times what was assumed is fitted anew."""

N_STEPS = 4
"""Gauss-Newton steps from the mean over runs: more than linear problems need, and these are nearly so."""


def pooled(problem: Problem, found: Found) -> Found:
    """Return what was found with the values that leave the least square over all runs."""
    scatter = dict(found.info.statistics.scatter)
    assumed = problem.simulation.scatter
    scatter = {name: std for name, std in scatter.items() if name in assumed}
    own = [n for n in found.names if n in scatter and scatter[n] > SCATTERS_RATIO * assumed[n]]
    if not own and not problem.varying:
        return found
    problem = problem._replace(varying={})
    statistics = Statistics(found.info.noise, scatter | {name: assumed[name] for name in own})
    base = problem.simulation.vector
    point, change = found.info.origin, found.change
    for _ in range(N_STEPS):
        info = recentre(problem.at(point, found.names, statistics), base)
        change = fit_change(info, found.names)[0]
        point = base.copy()
        for name, value in zip(found.names, change, strict=True):
            point[INDEX[name]] += value
    at, mine = info.places(found.names), [found.names.index(name) for name in own]
    a = info.a[:, at][:, :, at]
    more = np.diag([scatter[name] ** 2 - assumed[name] ** 2 for name in own])
    b = a.sum(axis=0) + np.einsum("nip,pq,njq->ij", a[:, :, mine], more, a[:, :, mine])
    inverse = np.linalg.pinv(a.sum(axis=0), hermitian=True)
    return found._replace(change=change, cov=inverse @ b @ inverse)
