"""The search for causes: greedy addition, refit where sensitivities have changed, drop, swap and rivals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from itertools import combinations, permutations
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from terrain.discrepancy.differences import BOUNDS, INDEX, PARAMETER, in_common
from terrain.discrepancy.evidence import (
    Evidence,
    WaldTest,
    correlation,
    evidence_at,
    move_point,
    partial_information,
    wald_test,
    whiten_run,
)
from terrain.discrepancy.runs import LowPass, Signals, Simulation, of_each, rows_of
from terrain.effects import Effect
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

RIVAL_REFITS = 3  #: Most relinearisations of a rival


MAX_CAUSES = 8
"""Most causes of a diagnosis: with more the simulation is of another robot.  Lags of two sensors, track, side
slip, drag, and a wrong lever arm are six."""


class Problem(NamedTuple):
    """Runs, the simulation, the low-pass of all, and the effects that may be named."""

    signals: tuple[Signals, ...]
    simulation: Simulation
    low_pass: LowPass
    library: tuple[Effect, ...]
    varying: Mapping[str, float] = MappingProxyType({})
    """Scatter by parameter, beside that of the simulation."""
    barred: frozenset[str] = frozenset()  #: names of effects of the library that are no causes
    most: int = MAX_CAUSES  #: causes
    given: Mapping[str, Any] = MappingProxyType({})  #: of the evidence, in place of what would be estimated

    @property
    def candidates(self) -> tuple[Effect, ...]:
        """Effects that may be named."""
        return tuple([effect for effect in self.library if effect.name not in self.barred])

    @property
    def scatter(self) -> dict[str, float]:
        """Standard deviation from run to run that is assumed, by parameter."""
        return {**self.simulation.scatter, **self.varying}

    def at(self, vector: Array, names: Sequence[str] | None = None, **about: Any) -> Evidence:
        """Return the evidence of the runs around a point, on the library by default; see :func:`evidence_at`."""
        names, about = (
            names_of(self.library) if names is None else names,
            {"scatter": self.scatter, **self.given, **about},
        )
        return evidence_at(self.signals, self.simulation, vector, names, self.low_pass, **about)

    def near(self, info: Evidence, vector: Array, names: Sequence[str]) -> Evidence:
        """Return the evidence of all runs together on a few parameters at another point, what varies integrated out.

        Noise and scatter are those of the evidence given; it is much faster than the evidence there.
        """
        k, total = len(names), np.zeros((1, 1, len(names) + 1, len(names) + 1))
        planar = {
            terrain: self.simulation.planar_on(terrain) for terrain in {r.terrain for r in self.signals}
        }

        def whitened(run: Signals) -> Array:
            rows = rows_of(run, planar[run.terrain], vector, names, self.low_pass)
            return whiten_run(info.noise, rows)

        white = of_each(whitened, self.signals)
        for columns, around, inner in zip(white, info.white, info.marginal[2], strict=True):
            flat = columns.reshape(k + 1, -1)
            along = around[info.nuisances].reshape(len(info.nuisances), flat.shape[1]) @ flat.T
            total += flat @ flat.T - along.T @ inner @ along
        return Evidence(tuple(names), vector, vector, total, {}, (), info.noise, tuple(white), np.zeros(k))


def misfit_of(info: Evidence, there: Evidence) -> float:
    """Return by how much the whole library could still reduce the residuals at another point.

    Sensitivities and noise of ``info`` are the measure, by which residuals are whitened.  Up to a constant it is
    minus twice the log-likelihood there, as far as the problem is linear.  The sum of squares itself will not do:
    the noise of the wheels is in the prediction, and a cause that makes it larger or smaller, as a mass does, would
    be judged by it.
    """
    score = np.zeros(len(info.names))
    for other, white, shift in zip(there.white, info.white, info.marginal[1], strict=True):
        flat = white[:-1].reshape(len(score), -1) @ other[-1].ravel()
        score += flat - shift[:, :-1].T @ flat[info.nuisances]
    return float(score @ np.linalg.solve(info.freed, score))


def names_of(effects: Sequence[Effect]) -> tuple[str, ...]:
    """Return the parameters of effects, each once, that of both sets before a difference of it.

    Examples
    --------
    >>> from terrain.effects import effect_named
    >>> names_of([effect_named("lever_arm")])
    ('lever_x_m', 'lever_y_m')
    """
    names = [p.name for effect in effects for p in effect.parameters]
    return tuple(dict.fromkeys([each for name in names for each in (in_common(name), name)]))


def steps_of(problem: Problem, info: Evidence, names: Sequence[str], n_most: int) -> Iterator[Evidence]:
    """Yield the evidence at the points of a nonlinear fit of parameters, until it converges.

    A step that raises the whitened square is halved, and given up after :data:`MAX_HALVINGS`.
    """
    base, at = info.vector, [INDEX[name] for name in names]
    here, loss = info.origin[at] - base[at], np.inf
    if not np.delete(info.origin - base, at).any():  # it is where the fit may start
        loss = float((info.c - 2.0 * info.g @ info.away + info.away @ info.a @ info.away).sum())
    change, _ = info.fit(names)
    for _ in range(n_most):
        point = problem.near(info, move_point(base, names, change), names)
        for _ in range(MAX_HALVINGS):
            if point.c[0] <= (1.0 + RISE) * loss:
                break
            change = 0.5 * (here + change)
            point = problem.near(info, move_point(base, names, change), names)
        yield point
        here, loss = point.vector[at] - base[at], float(point.c[0])
        step, cov = point.fit(names)
        change = here + step
        if (np.abs(change - here) < SETTLED * np.sqrt(np.maximum(np.diag(cov), 1e-30))).all():
            return


def relinearize(problem: Problem, info: Evidence, causes: Sequence[Effect]) -> Evidence:
    """Fit, and return the evidence around the fitted point."""
    point = info.vector
    for near in steps_of(problem, info, names_of(causes), MAX_REFITS if causes else 0):
        point = near.vector
    return problem.at(point).counted_from(info.vector)


def fit_again(problem: Problem, info: Evidence, names: Sequence[str]) -> tuple[float, Evidence]:
    """Return how badly the best point of a nonlinear fit fits (:func:`misfit_of`), and the evidence there."""
    points = [(misfit_of(info, near), near) for near in steps_of(problem, info, names, RIVAL_REFITS)]
    misfit, near = min(points, key=lambda pair: pair[0])
    return misfit + PARAMETER_LOSS * len(names), near


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

PLAUSIBLE_STDS = 2.36
"""Standard deviations by which a rival may be beyond its plausible range: the half of a 95 % interval."""

PLAUSIBLE_QUANTILE = 1.96
"""Standard deviations of the prior of a parameter from 0, as described, to the end of its plausible range."""


class Rival(NamedTuple):
    """The fit of an effect in the place of a cause."""

    change: Array  #: (k,) of its parameters
    std: Array
    others: Mapping[str, float]  #: changes of the parameters of the other causes beside it
    behind: float  #: minus twice the logarithm of its posterior over that of the cause


def surprise(vector: Array, names: Sequence[str]) -> float:
    """Return minus twice the logarithm of the prior of parameters at a point, of each in units of its range.

    The prior is normal about 0, as the description has it; its 95 % interval on either side is the plausible range.
    Values are counted over that range, so that the priors of different parameters are one.

    Examples
    --------
    >>> from terrain.effects import vector_of
    >>> point = vector_of({"wheel_radius_ratio": -0.1, "ground_slip_ratio": 0.1})
    >>> [round(surprise(point, [name]), 2) for name in ("wheel_radius_ratio", "ground_slip_ratio")]
    [3.84, 0.15]
    """
    value = vector[[INDEX[name] for name in names]]
    low, high = np.array([PARAMETER[name].plausible for name in names]).reshape(-1, 2).T
    end = np.maximum(np.where(value < 0.0, -low, high), 1e-9)
    return float(((PLAUSIBLE_QUANTILE * value / end) ** 2).sum())


Rivals = Mapping[str, Rival]
"""By effect that fits as well as a cause in its place, the best first."""


def rivals_of(
    problem: Problem,
    info: Evidence,
    start: Evidence,
    causes: Sequence[Effect],
    some: Sequence[Effect] | None = None,
) -> Mapping[str, Rivals]:
    """Return by cause (of ``some``, all by default) the effects that, refitted in its place, fit as well as it does.

    It is compared by the noise that the causes leave and by that of the simulation as it is given: a cause
    that absorbs noise is ahead by only one of them.  Where runs disagree on a cause by more than the noise
    allows, losses count that much less, as a quasi-likelihood has them.  Where much is wrong, neither is a
    likelihood: a rival that leaves a larger square than the noise of the wheels can make is none.  The best of them
    is the measure, where that is not the cause.
    """
    runs_alone = replace(info, model_std=np.zeros_like(info.model_std))  # in what all runs have they agree
    own: list[tuple[float, Evidence]] = []  # the causes by both judges, where anything comes near
    rivals = {}
    for cause in causes if some is None else some:
        others = [other for other in causes if other is not cause]
        inflation = wald_test(runs_alone, names_of(others), cause).inflation
        as_good = []
        for effect, alike in _near(problem, info, cause, others, inflation):
            own = own or [fit_again(problem, judge, names_of(causes)) for judge in (info, start)]
            swapped = names_of([*others, effect])
            fits = [fit_again(problem, judge, swapped) for judge in (info, start)]
            behind = min(fits[0][0] - own[0][0], fits[1][0] - own[1][0]) / inflation
            here, square = fits[0][1], float(own[0][1].c[0])
            worse = float(here.c[0]) > (1.0 + RIVAL_RISE) * square + RIVAL_LOSS * inflation
            most = TWIN_LOSS if alike > TWIN else RIVAL_LOSS
            if not worse and behind < most:
                its = [p.name for p in effect.parameters]
                at, places = [INDEX[name] for name in its], here.places(its)
                std = np.sqrt(np.maximum(np.diag(here.fit(swapped)[1]), 0.0))[places]
                ends = here.vector[at] + np.outer((-PLAUSIBLE_STDS, PLAUSIBLE_STDS), std)
                if all(p.is_plausible(*own) for p, own in zip(effect.parameters, ends.T, strict=True)):
                    moved = dict(zip(INDEX, (here.vector - info.vector).tolist(), strict=False))
                    beside = {name: moved[name] for name in names_of(others)}
                    less = surprise(own[0][1].vector, names_of(causes)) - surprise(here.vector, swapped)
                    rival = Rival(here.vector[at] - info.vector[at], std, beside, behind - less)
                    as_good.append((behind, most, effect.name, rival))
        best = min([0.0, *[behind for behind, *_ in as_good]])
        as_good.sort(key=lambda rival: rival[0])
        rivals[cause.name] = {name: rival for behind, most, name, rival in as_good if behind - best < most}
    return rivals


def _near(
    problem: Problem, info: Evidence, cause: Effect, others: Sequence[Effect], inflation: float
) -> Iterator[tuple[Effect, float]]:
    """Yield the effects that come near a cause beside the others by linear fits, and how alike the two are."""
    now, beside = info.loss(names_of([*others, cause])), names_of(others)
    most = min(RIVAL_LINEAR * inflation, RIVAL_LOSS * inflation + RIVAL_RATIO * (info.loss(beside) - now))
    for effect in problem.library:
        if effect is cause or effect in others or info.loss(names_of([*others, effect])) - now >= most:
            continue
        own, its = [info.places([p.name for p in each.parameters]) for each in (cause, effect)]
        base = [at for at in info.places(names_of([*others, cause, effect])) if at not in (*own, *its)]
        free = partial_information(info.a.sum(axis=0), base, [*own, *its])[1]
        alike = correlation(free, range(len(own)), range(len(own), len(free)))
        if alike > SHARED and wald_test(info, beside, effect).inside:
            yield effect, alike


# -- The search: greedy addition, refit, drop and swap ---------------------------------------------------------

MAX_STEPS = 12  #: Most steps of the search, successful or not

MUCH_GAIN, CLOSE_GAIN, MAX_FITTED = 200.0, 0.3, 6
"""Gain above which the best candidates are compared by nonlinear fits: those with that ratio of the best
one's gain, so many at most."""

Z_PAIR = 4.6
"""Evidence that each of two effects needs beside the other, if neither is significant alone: 4e-6."""

ONE_RATIO = 0.8  #: Part of the gain of two causes, from which on one effect is preferred to them

ALIKE = 0.99  #: Two effects whose sensitivities correlate more are not taken for a pair


class CauseFit(NamedTuple):
    """Causes fitted to the runs together."""

    causes: tuple[Effect, ...]  #: effects selected, in the order in which they came
    info: Evidence  #: of the runs there, changes counted from the simulation that was given
    names: tuple[str, ...]  #: of their parameters (k,)
    change: Array
    cov: Array
    tests: dict[str, WaldTest]  #: evidence of every effect of the library beside them
    rivals: Mapping[str, Rivals] = MappingProxyType({})  #: by cause, once they have been looked for
    pairs: Mapping[str, tuple[str, str]] = MappingProxyType({})
    """By cause that is preferred to two, the names of these."""

    def at(self, effect: Effect) -> list[int]:
        """Return the places of the parameters of a cause."""
        return [self.names.index(p.name) for p in effect.parameters]


def search(problem: Problem, start: Evidence, seeds: Mapping[str, float] | None = None) -> CauseFit:
    """Return the causes that explain the runs, from their evidence around the simulation as it is given.

    Where values of parameters (``seeds``) are so large that sensitivities without them would mislead, as lags of
    sensors, other causes are first searched with them built in, then all are fitted together.
    """
    causes, info = [], start
    if seeds:
        there = problem.at(move_point(start.vector, [*seeds], [*seeds.values()]))
        first, info = _add_causes(problem, there, [])
        seeded = [effect for effect in problem.library if set(names_of([effect])) & set(seeds)]
        causes = [*seeded, *[cause for cause in first if cause not in seeded]]
        causes, info = _refit_significant(problem, info.counted_from(start.vector), causes)
    return search_on(problem, info, causes)


def search_on(problem: Problem, info: Evidence, causes: Sequence[Effect]) -> CauseFit:
    """Return the causes that explain the runs, from some that are fitted to them."""
    more, at = _add_causes(problem, info, list(causes))
    pairs: dict[str, tuple[str, str]] = {}
    while (one := _one_for_two(at, problem.candidates, more)) is not None:
        effect, pair = one
        single, there = _refit_significant(problem, at, [*[c for c in more if c not in pair], effect])
        if effect not in single or len(single) >= len(more):
            break
        more, at, pairs[effect.name] = single, there, (pair[0].name, pair[1].name)
    return cause_fit(problem, at, more)._replace(pairs=pairs)


def refit(problem: Problem, info: Evidence, causes: Sequence[Effect]) -> CauseFit:
    """Return some causes, fitted without others; those that are no longer significant are dropped."""
    significant, info = _refit_significant(problem, info, list(causes))
    return cause_fit(problem, info, significant)


def cause_fit(problem: Problem, info: Evidence, causes: Sequence[Effect]) -> CauseFit:
    """Return the values of causes by the evidence at their fit, and the evidence of every effect beside them."""
    names = names_of(causes)
    tests = {effect.name: wald_test(info, names, effect) for effect in problem.library}
    return CauseFit(tuple(causes), info, names, *info.fit(names), tests)


def _add_causes(problem: Problem, info: Evidence, causes: list[Effect]) -> tuple[list[Effect], Evidence]:
    """Add effects, refit, drop and swap, until none is significant that is not there.

    The next effect is that with the largest gain on runs left out, or a pair where none is significant alone.
    Where much is wrong the linear gain is inaccurate: then the best few are compared by nonlinear fits.
    """
    barred: set[str] = set()  # added to the current causes, and dropped again
    seen = {frozenset(causes)}  # sets that were reached; none twice, or the search goes in circles
    fits: dict[tuple[frozenset[Effect], Effect], tuple[float, Evidence]] = {}  # none is made twice

    def fit(effect: Effect) -> tuple[float, Evidence]:
        key = frozenset(causes), effect
        if key not in fits:
            fits[key] = fit_again(problem, info, names_of([*causes, effect]))
        return fits[key]

    for _ in range(MAX_STEPS):
        names, candidates = names_of(causes), []
        left = [e for e in problem.candidates if e not in causes and e.name not in barred]
        for effect in left:
            test = wald_test(info, names, effect)
            gain, passes = float(test.gain.sum()), test.significant
            if not test.inside and gain >= MUCH_GAIN and test._replace(inside=True).significant:
                # a robot that turns twice as fast as it should has half the track, which straight lines take for
                # none
                vector = fit(effect)[1].vector
                own = [(vector[INDEX[name]], *BOUNDS[name]) for name in names_of([*causes, effect])]
                passes = all(low < value < high for value, low, high in own)
            if passes:
                candidates.append((gain, effect))
        candidates.sort(key=lambda pair: -pair[0])
        close = [e for gain, e in candidates[:MAX_FITTED] if gain > CLOSE_GAIN * candidates[0][0]]
        new = [effect for _, effect in candidates[:1]] or _pair(info, names, left)
        if len(close) > 1 and candidates[0][0] >= MUCH_GAIN:
            new = [min(close, key=lambda effect: fit(effect)[0])]
        if not new or len(causes) + len(new) > problem.most:
            break
        more, at = _refit_significant(problem, info, [*causes, *new], seen)
        if at is not info:
            more, at = _swap_for_better(problem, at, more)
        if frozenset(more) not in seen:
            seen.add(frozenset(more))
            barred, causes, info = set(), more, at  # one that another replaced may come in beside it
        else:
            barred |= {effect.name for effect in new}
    return causes, info


def _refit_significant(
    problem: Problem, info: Evidence, causes: list[Effect], seen: Set[frozenset[Effect]] = frozenset()
) -> tuple[list[Effect], Evidence]:
    """Refit causes, and drop the weakest until all are significant beside the others.

    A set that was reached before is not fitted again: the information is the one given.
    """
    at = info
    while frozenset(causes) not in seen:
        at = relinearize(problem, at, causes)
        weak = _weakest(at, causes) if causes else None
        if weak is None:
            return causes, at
        causes = [cause for cause in causes if cause is not weak]
    return causes, info


def _weakest(info: Evidence, causes: Sequence[Effect]) -> Effect | None:
    """Return the least significant cause, None if all are significant beside the others."""
    tests = [
        wald_test(info, names_of([other for other in causes if other is not cause]), cause)
        for cause in causes
    ]
    z = [np.inf if test.significant else test.z for test in tests]
    return None if min(z) == np.inf else causes[int(np.argmin(z))]


def _swap_for_better(problem: Problem, info: Evidence, causes: list[Effect]) -> tuple[list[Effect], Evidence]:
    """Replace a cause by an effect that fits better, as long as there is one."""
    for _ in range(MAX_CAUSES):
        names = names_of(causes)
        least, better = info.loss(names) + PARAMETER_LOSS * len(names) - RIVAL_LOSS, None
        for i, cause in enumerate(causes):
            others = names_of([other for other in causes if other is not cause])
            for effect in problem.candidates:
                if effect in causes or not wald_test(info, others, effect).significant:
                    continue
                changed = [*causes[:i], effect, *causes[i + 1 :]]
                names = names_of(changed)
                if (loss := info.loss(names) + PARAMETER_LOSS * len(names)) < least:
                    least, better = loss, changed
        if better is None:
            break
        swapped, at = _refit_significant(problem, info, better)
        if len(swapped) < len(causes):
            break
        causes, info = swapped, at
    return causes, info


def _one_for_two(
    info: Evidence, library: Sequence[Effect], causes: Sequence[Effect]
) -> tuple[Effect, tuple[Effect, Effect]] | None:
    """Return an effect that does nearly as much as two causes, one of which is nothing without the other.

    Each may take back what the other does wrong in a channel, where one effect does that by itself.  It has to be
    clearly better than either of the two alone.
    """
    for pair in combinations(causes, 2):
        if any(one.modifies == other.name for one, other in permutations(pair)):
            continue
        others = names_of([cause for cause in causes if cause not in pair])
        alone = [wald_test(info, others, cause) for cause in pair]
        if all(test.significant for test in alone):
            continue
        left = info.loss(others)
        both, *each = [left - info.loss((*others, *names_of(few))) for few in (pair, pair[:1], pair[1:])]
        gains = {}
        for effect in library:
            if effect not in causes and wald_test(info, others, effect).inside:
                gain = left - info.loss((*others, *names_of([effect])))
                if gain > ONE_RATIO * both and both - gain < 0.5 * (both - max(each)):
                    gains[effect] = gain
        if gains:
            return max(gains, key=lambda effect: gains[effect]), pair
    return None


def _pair(info: Evidence, names: Sequence[str], library: Sequence[Effect]) -> list[Effect]:
    """Return two effects that are significant beside each other and the causes, where neither is alone.

    Two of opposite sign, as an offset and a rate of a clock, hide each other.
    """
    left = [effect for effect in library if len(effect.parameters) == 1]
    own = info.places([effect.parameters[0].name for effect in left])
    base = [at for at in info.places(list(dict.fromkeys([*names, *names_of(left)]))) if at not in own]
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
        tests = [wald_test(info, (*names, *names_of([other])), one) for one, other in (pair, pair[::-1])]
        if all(test.significant and test.z > Z_PAIR for test in tests):
            return pair
    return []


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


def pooled(problem: Problem, fit: CauseFit) -> CauseFit:
    """Return the causes with the values that leave the least square over all runs."""
    assumed = problem.simulation.scatter
    scatter = {name: std for name, std in fit.info.scatter.items() if name in assumed}
    own = [n for n in fit.names if n in scatter and scatter[n] > SCATTERS_RATIO * assumed[n]]
    if not own and not problem.varying:
        return fit
    held = scatter | {name: assumed[name] for name in own}
    point, change = fit.info.origin, fit.change
    for _ in range(N_STEPS):
        info = problem.at(point, fit.names, noise=fit.info.noise, scatter=held)
        info = info.counted_from(problem.simulation.vector)
        change, inverse = info.fit(fit.names)
        point = problem.simulation.vector
        point[[INDEX[name] for name in fit.names]] += change
    a, _ = info.clusters(info.places(fit.names))
    mine = [fit.names.index(name) for name in own]
    more = np.diag([scatter[name] ** 2 - assumed[name] ** 2 for name in own])
    b = a.sum(axis=0) + np.einsum("nip,pq,njq->ij", a[:, :, mine], more, a[:, :, mine])
    return fit._replace(change=change, cov=inverse @ b @ inverse)
