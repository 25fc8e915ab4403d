"""Whether the value of a cause is one number: by thirds of time, by halves of the runs, by session, run by run.

Every statement is a size, not a test alone: with enough data any difference is significant, and a robot whose
track is 1.4 m early and 1.5 m late still has an effective track.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2
from scipy.stats import f as fisher
from scipy.stats import t as student

from terrain.discrepancy import verdict
from terrain.discrepancy.evidence import (
    N_BLOCKS,
    PRIOR_STD,
    TRUST_DOF,
    Evidence,
    clustered_variance,
    evidence_at,
    marginal,
    marginal_parts,
    z_of_t,
)
from terrain.discrepancy.patterns import MIN_GROUP, SCATTERS, Kind, Pattern, fit_scatter, pattern_of
from terrain.discrepancy.robot_terms import value_in_robot_terms, values_with_intervals
from terrain.discrepancy.runs import UNLIKE, Excluded, Signals
from terrain.discrepancy.search import RIVAL_LINEAR, RIVAL_LOSS, CauseFit, Problem, cause_fit, names_of
from terrain.effects import BOUNDS, CHANNELS, INDEX, PARAMETER, Effect
from terrain.records import Array
from terrain.robots import Robot

VARIES_RATIO = 0.5
"""A value whose groups are further apart than that ratio of it, root mean square by their information, is no
value, and none of all runs is one that scatters by more than that ratio from run to run."""

GROWS_RATIO, GROWTH = 0.25, 2.0
"""Nor is one that is apart by the first and grows along runs by the second: a cause that starts from nothing,
as warmth and the rate of a clock do, has 0.54 between its thirds, and grows five times."""

CAVEAT_RATIO = 0.05  #: A value that differs by more than that ratio is given with what it depends on
CERTAIN_P = 1e-5  #: Chance of differences between groups by noise, below which they are stated
MIN_HALF_RUNS = 3  #: Least number of runs in half of them

THIRDS, HALVES = (
    ("first third", "second third", "last third"),
    ("first half of the runs", "second half"),
)


class Constancy(NamedTuple):
    """Values of a cause in parts of the data: in groups of one kind, or split.

    By ``time`` they are thirds of each run's time, the first first, by ``runs`` halves of the runs in the order
    given, where these are enough.
    """

    values: dict[str, Array]  #: by split (groups, p); NaN where a part shows nothing
    std: dict[str, Array]
    ratio: float
    """Root mean square difference of groups from their mean, each with the weight of its information, over the size
    of the value."""
    split: str  #: where that is largest
    certain: bool  #: whether differences are beyond the noise
    varies: bool  #: whether the value differs so much that it is none
    caveat: str  #: what the value depends on, in words; empty where it is one number


def constancy_of(
    info: Evidence, names: Sequence[str], own: Sequence[str], change: Array, inflation: float
) -> Constancy:
    """Return the values of some (``own``) of the parameters fitted together, to a change (k,), in parts of the data.

    Variances are those from the noise times ``inflation``.
    """
    n, half = len(info.grams), len(info.grams) // 2
    where = {"time": np.tile(np.arange(N_BLOCKS), (n, 1))}
    if half >= MIN_HALF_RUNS:
        where["runs"] = np.repeat((np.arange(n) >= half).astype(int)[:, None], N_BLOCKS, axis=1)
    others = [name for name in names if name not in own]
    values, std, ratio, split, certain = {}, {}, 0.0, "time", False
    size = float(np.linalg.norm(change[[list(names).index(name) for name in own]]))
    p, q = len(own), info.nuisances.size
    for kind, group in where.items():
        # a column for each parameter in each group, the others in common, what varies from run to run marginalised
        n_groups = int(group.max()) + 1
        m = n_groups * p
        design = np.zeros((*group.shape, len(info.names) + 1, q + m + len(others) + 1))
        design[:, :, info.nuisances, np.arange(q)] = 1.0
        design[:, :, info.places(others), np.arange(q + m, q + m + len(others))] = 1.0
        design[:, :, -1, -1] = 1.0
        for (i, b), k in np.ndenumerate(group):
            design[i, b, info.places(own), np.arange(q + k * p, q + (k + 1) * p)] = 1.0
        columns = design.transpose(0, 1, 3, 2) @ info.grams @ design
        free = marginal(columns, np.arange(q), info.nuisance_std)[0][:, q:, q:].sum(axis=0)
        inverse = np.linalg.pinv(free[:-1, :-1], hermitian=True, rcond=1e-12)
        shown = np.diag(free)[:m] > 1e-9 * np.diag(free)[:m].max()
        values[kind] = np.where(shown, (inverse @ free[:-1, -1])[:m], np.nan).reshape(n_groups, p)
        cov = inflation * inverse[:m, :m].reshape(n_groups, p, n_groups, p)
        variance = np.einsum("gpgp->gp", cov)
        std[kind] = np.where(np.isfinite(values[kind]), np.sqrt(np.maximum(variance, 0.0)), np.nan)
        apart, beyond = _difference(values[kind], cov)
        apart = apart / size if size > 0 else math.inf
        if kind == "time" or (beyond and (apart > ratio or not certain)):
            ratio, split, certain = apart, kind, beyond
    largest = int(np.argmax(np.nan_to_num(np.abs(values[split])).max(axis=0)))
    first, *_, last = main = values[split][:, largest].tolist()
    sign = 1.0 if last > 0 else -1.0
    grows = (
        split == "time" and sign * last > GROWTH * abs(first) and sign * last > sign * main[1] > sign * first
    )
    varies = certain and ratio > (GROWS_RATIO if grows else VARIES_RATIO)
    caveat = ""
    if certain and ratio > CAVEAT_RATIO:
        on, words = ("time", THIRDS) if split == "time" else ("the run", HALVES)
        shown = [f"{x:.3g} in the {part}" for x, part in zip(main, words, strict=True) if math.isfinite(x)]
        caveat = f"its value depends on {on}: {', '.join(shown)}"
    return Constancy(values, std, ratio, split, certain, varies, caveat)


def _difference(values: Array, cov: Array) -> tuple[float, bool]:
    """Return how far groups are apart, weighted by their information, and whether it is beyond the noise.

    A group counts for the parameters that it shows; a parameter that is apart by noise counts only where none
    is apart beyond it.
    """
    most = 0.0, False
    for p in range(values.shape[1]):
        known = np.flatnonzero(np.isfinite(values[:, p]))
        if known.size < 2:
            continue
        value, own = values[known, p], cov[known, p][:, known, p]
        precision = np.linalg.pinv(own, hermitian=True)
        ones = np.ones(known.size)
        off = value - (ones @ precision @ value) / (ones @ precision @ ones)
        certain = float(chi2.sf(float(off @ precision @ off), known.size - 1)) < CERTAIN_P
        weight = 1.0 / np.maximum(np.diag(own), 1e-30)
        mean = np.average(value, weights=weight)
        apart = math.sqrt(float(np.average((value - mean) ** 2, weights=weight)))
        most = max(most, (apart, certain), key=lambda pair: (pair[1], pair[0]))
    return most


class PartValues(NamedTuple):
    """A value of a named cause, and those of parts of the data with half their 95 % interval, NaN where not shown."""

    value: verdict.Value
    names: tuple[str, ...]
    values: Array
    halves: Array


def part_values(info: Evidence, causes: Sequence[verdict.Cause]) -> tuple[PartValues, ...]:
    """Return the values of named causes in parts of the data, of evidence with the causes built in."""
    names = [value.name for cause in causes for value in cause.parameters]
    parts = []
    for cause in causes:
        inflation = max(cause.dispersion, 1.0) if math.isfinite(cause.dispersion) else 1.0
        own = [value.name for value in cause.parameters]
        constant = constancy_of(info, names, own, np.zeros(len(names)), inflation)
        off, std = [np.concatenate([*groups.values()]) for groups in (constant.values, constant.std)]
        for k, value in enumerate(cause.parameters):
            half = verdict.INTERVAL_T * std[:, k]
            parts.append(PartValues(value, (*THIRDS, *HALVES)[: len(off)], value.value + off[:, k], half))
    return tuple(parts)


# -- Values of named causes session by session, with the same causes in each, and whether sessions agree ---
# Of each session all causes that were found over all runs are fitted to its runs alone.  Fitted with sets of
# their own, sessions would not be comparable: a track beside a turning slip is another number than one without.
# The variance of a value is that of the scatter between the runs of its session, weighed with that of the noise
# as in :func:`terrain.discrepancy.evidence.wald_test`.
#
# Sessions of one terrain are compared by Welch's test of equal means (Biometrika 1951), which is Cochran's Q
# for variances that are estimated themselves; the standard deviation between sessions beyond these variances is
# that of DerSimonian and Laird (Controlled Clinical Trials 1986).

MIN_RUNS = 3  #: Least number of runs of a session: fewer do not show their scatter

SHOWN_RATIO = 1e-4
"""A session shows a parameter if that ratio of its information is its own beside the others."""


def values_by_session(
    fit: CauseFit, signals: Sequence[Signals], named: Sequence[Effect], robot: Robot
) -> tuple[verdict.BySession, ...]:
    """Return the values of named causes by terrain and session; none where runs (of the fit) are of one session."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, run in enumerate(signals):
        if run.session:
            groups.setdefault((run.terrain, run.session), []).append(i)
    groups = {key: runs for key, runs in groups.items() if len(runs) >= MIN_RUNS}
    if len(groups) < 2:
        return ()
    tables, (every_a, every_g) = [], fit.info.clusters(fit.info.places(fit.names))
    for parameter in [p for effect in named for p in effect.parameters]:
        own, name = fit.names.index(parameter.name), parameter.name
        for terrain in dict.fromkeys([terrain for terrain, _ in groups]):
            sessions, fits = [], []
            for (label, session), runs in groups.items():
                a, g = every_a[runs], every_g[runs]
                total = a.sum(axis=0)
                unit = np.sqrt(np.maximum(np.diag(total), 1e-30))
                scale = np.outer(unit, unit)
                cov = np.linalg.pinv(total / scale, rcond=1e-10, hermitian=True) / scale
                size, information = float(cov[own, own]), float(total[own, own])
                if label != terrain or not (size * information < 1.0 / SHOWN_RATIO and information > 1e-12):
                    continue
                x = cov @ g.sum(axis=0)
                variance, dof = clustered_variance(a, g, x, cov[own], size)
                value, std = float(x[own]), math.sqrt(variance * size)
                half = float(student.ppf(0.975, dof)) * std
                text = value_in_robot_terms(name, value, value - half, value + half, robot)
                about = session, len(runs), value, (value - half, value + half), text
                sessions.append(verdict.SessionValue(*about))
                fits.append((value, std, dof))
            if sessions:
                p, between = agreement(*np.array(fits).T)
                rows, agree = tuple(sessions), not p < verdict.AGREE_P
                tables.append(verdict.BySession(name, parameter.unit, terrain, rows, p, between, agree))
    return tuple(tables)


def agreement(value: Array, std: Array, dof: Array) -> tuple[float, float]:
    """Return the probability of such differences between sessions that agree, and their own deviation.

    Parameters
    ----------
    value, std, dof : (sessions,) values, their standard deviations, and the degrees of freedom of these

    Returns
    -------
    p : NaN for fewer than two sessions
    between_std : beyond the standard deviations; 0 where these explain the differences

    Examples
    --------
    >>> p, between = agreement(np.array([0.70, 0.71]), np.array([0.01, 0.01]), np.array([30.0, 30.0]))
    >>> p > 0.3, between
    (True, 0.0)
    >>> p, between = agreement(np.array([0.70, 0.90]), np.array([0.01, 0.01]), np.array([30.0, 30.0]))
    >>> p < 1e-6, round(between, 2)
    (True, 0.14)
    """
    k = len(value)
    if k < 2:
        return math.nan, math.nan
    weight = 1.0 / np.maximum(std, 1e-12) ** 2
    total = float(weight.sum())
    q = float((weight * (value - float((weight * value).sum()) / total) ** 2).sum())
    loose = float(((1.0 - weight / total) ** 2 / dof).sum())
    statistic = q / (k - 1) / (1.0 + 2.0 * (k - 2) / (k**2 - 1) * loose)
    p = float(fisher.sf(statistic, k - 1, (k**2 - 1) / (3.0 * loose)))
    spread = total - float((weight**2).sum()) / total
    return p, math.sqrt(max(q - (k - 1), 0.0) / spread)


# -- Effects whose size differs from run to run: how much, and in which pattern ------------------------------
# Runs are fitted with values of their own of one effect at a time, by a mixed model in which all else varies by
# no more than is assumed.  The answer is the effect with the greatest likelihood: what half of the wheels do is
# not the scatter of a track, though a scatter of the track that is estimated beside it would take most of it.
#
# Whether an effect varies is judged by the likelihood that is lost with one value for all runs, beyond what robots
# are known to vary by, or by a pattern of the runs' values, which no such scatter makes
# (:mod:`terrain.discrepancy.patterns`).  With a pattern, effects are compared with one value for each of its columns.
# The noise of a run's value is that between the thirds of each run, since noise that lasts is in both.

Z_VARIES = 4.5  #: Evidence of a difference between runs, as of a probe: of some thirty effects
Z_NEAR = 3.0  #: Evidence of an effect that may be what varies instead of one whose evidence is enough

OUT_STDS, OUT_SCATTERS, OUT_RATIO = 3.0, 0.25, 0.2
"""A run's value is out of its bounds by so many standard deviations and scatters, and the ratio of the runs
that may be: a rogue or two, and less than a group of eight runs."""

CERTAIN_DOF = 1e9  #: Of variances that are known: the noise is that between thirds of each run already

LEAST_RATIO = 1e-4  #: Least scatter of a parameter of which none is assumed, over the prior of its value

NEAR_RATIO, N_STEPS = 0.2, 3
"""Effects whose loss is behind by that ratio of the best one's gain are compared by nonlinear fits of so many
steps: a run's own value may be far from where sensitivities were taken."""


class RunValues(NamedTuple):
    """Values (runs,) of a parameter by each run alone, and how far they scatter beyond the noise."""

    name: str
    value: Array  #: over what the simulation has of it
    weight: Array  #: precision of each, 0 where a run shows nothing
    scatter: float
    z: float  #: evidence of the scatter
    variance: Array  #: of each by the noise alone, infinite where a run shows nothing
    pattern: Pattern | None = None

    @property
    def evidence(self) -> float:
        """Evidence that runs differ, as a standard normal number."""
        return max(self.z, self.pattern.z if self.pattern else 0.0)

    @property
    def mean(self) -> float:
        """Mean value by information."""
        return float(np.average(self.value, weights=self.weight))

    def about(self, mean: float) -> RunValues:
        """Return the same about another mean."""
        return self._replace(value=self.value + mean - self.mean)

    def in_pattern(self, signals: Sequence[Signals]) -> RunValues:
        """Return the same with the pattern of the values of these runs."""
        place, of = (
            np.array([run.place for run in signals]),
            ([r.session for r in signals], [r.terrain for r in signals]),
        )
        place = place if np.isfinite(place).all() else np.arange(len(place), dtype=float)
        return self._replace(pattern=pattern_of(self.value, self.variance, place, *of))


class _OwnValues(NamedTuple):
    """An effect of which each run has its own values, by parameter, and how well that fits."""

    effect: Effect
    runs: list[RunValues]
    loss: float
    gain: float  #: fall of the loss from one value in all runs
    common: Mapping[str, float] = MappingProxyType({})  #: what all runs share beside these, by parameter

    @property
    def clearest(self) -> RunValues:
        """The parameter that differs most clearly."""
        return max(self.runs, key=lambda runs: runs.evidence)


def run_scatter(problem: Problem, fit: CauseFit, name: str) -> float:
    """Return the scatter from run to run of a parameter, noise taken off."""
    assumed = problem.simulation.known_scatter.get(name, 0.0)
    return values_by_run(fit.info, name, fit.names, fit.change, fit.info.scatter, assumed).scatter


def varying_effects(problem: Problem, fit: CauseFit) -> tuple[verdict.Varying, ...]:
    """Return the effect whose size differs most clearly from run to run; none where runs are alike.

    Only one is returned: what one effect varies by looks like a variation of all that resemble it.
    """
    info, known = fit.info, problem.simulation.known_scatter
    if len(info.rows) < 2 * MIN_GROUP:
        return ()
    # what was assumed of a parameter is no news, other than what was estimated
    least = {name: known.get(name, 0.0) or LEAST_RATIO * PRIOR_STD[name] for name in info.scatter}
    # what all runs have in common is not asked: the whole library is freed, and values are about those of the fit
    common = np.linalg.solve(info.freed, info.g.sum(axis=0))
    tried = []
    for effect in problem.library:
        values = []
        for name in names_of([effect]):
            its = least, known.get(name, 0.0)
            mean = values_by_run(info, name, fit.names, fit.change, *its).mean
            values.append(values_by_run(info, name, info.names, common, *its).about(mean))
        tried.append(_OwnValues(effect, [each.in_pattern(problem.signals) for each in values], 0.0, 0.0))
    most = max(tried, key=lambda own: own.clearest.evidence)
    if not most.clearest.evidence > Z_VARIES:
        return ()
    pattern = max([own.clearest.pattern for own in tried], key=lambda found: found.z if found else 0.0)
    columns = pattern.columns[:, 1:] if pattern and pattern.z > Z_VARIES else np.zeros((len(info.rows), 0))
    tried = [_own_values(info, own, known, columns) for own in tried if own.clearest.evidence > Z_NEAR]
    first = min(tried, key=lambda own: own.loss)
    behind = max(RIVAL_LINEAR, NEAR_RATIO * first.gain)
    near: list[tuple[_OwnValues, _OwnValues]] = []
    for linear in tried:
        if linear.loss > first.loss + behind:
            continue
        # by a nonlinear fit: sensitivities of each run at its own values.  What all runs have in common beside the
        # causes stays: columns of other effects beside those at own values make up for what differs
        own, names = linear, tuple(dict.fromkeys([*fit.names, *[runs.name for runs in linear.runs]]))
        base = info.vector.copy()
        for name, value in linear.common.items():
            base[INDEX[name]] += 0.0 if name in names else value
        for _ in range(N_STEPS):
            at = {
                runs.name: np.clip(info.vector[INDEX[runs.name]] + runs.value, *BOUNDS[runs.name])
                for runs in own.runs
            }
            there = problem.at(info.origin, names, noise=info.noise, scatter={}, own=at)
            there = info.counted_from(info.origin).with_columns(there).counted_from(base)
            own = _own_values(there, own, known, columns, names)
        # common values that only cancel each other linearly are no point to go on from; a scatter has to be in both
        own = min(own, linear, key=lambda each: each.loss) if columns.size else own
        own = own._replace(runs=[runs.in_pattern(problem.signals) for runs in own.runs])
        of = own.clearest
        (low, high), seen = BOUNDS[of.name], of.weight > 0
        value = info.vector[INDEX[of.name]] + of.value[seen]
        margin = OUT_STDS / np.sqrt(of.weight[seen]) + OUT_SCATTERS * of.scatter
        # parts of the runs are apart by what a builder would believe; what is wrong in all of them is in their mean
        apart = np.ptp(of.pattern.values[seen]) if columns.size and of.pattern is not None else 0.0
        believed = apart <= np.ptp(PARAMETER[of.name].plausible)
        # values of runs by themselves may have a pattern that runs together do not confirm
        if (
            own.gain > RIVAL_LOSS
            and believed
            and np.mean((value < low - margin) | (value > high + margin)) <= OUT_RATIO
        ):
            near.append((own, linear))
    if not near:
        return ()
    best, straight = min(near, key=lambda pair: pair[0].loss)
    # a mass makes more or less of the noise of the wheels, which a nonlinear fit counts: either may say so, unless
    # values of a pattern are so far from where sensitivities were taken that nothing else explains it
    alike = [
        own
        for own, linear in near
        if own.loss - best.loss < RIVAL_LOSS
        or (not columns.size and linear.loss - straight.loss < RIVAL_LOSS)
    ]
    if not max([own.clearest.evidence for own in alike]) > Z_VARIES:
        return ()
    of, rivals = best.clearest, tuple([own.effect.name for own in alike if own is not best])
    name, mean = best.effect.name, of.mean
    channel = CHANNELS[int(np.argmax(info.channel_power(np.eye(len(info.names))[info.places([of.name])])))]
    about = of.name.rpartition("_")[2], rivals, mean, of.scatter, of.evidence
    return (verdict.Varying(name, of.name, *about, *_in_words(of, problem.signals, channel, rivals)),)


def rogue_run(varying: Sequence[verdict.Varying]) -> Excluded | None:
    """Return the run whose value is unlike that of all others, with what it is unlike in; None where there is none."""
    for effect in varying:
        if effect.pattern is Kind.ROGUE:
            others, own = effect.groups
            low, high = effect.change_ci
            value = verdict.Value(effect.parameter, effect.change, effect.unit, low, high)
            reason = f"its {PARAMETER[effect.parameter].label} differs from theirs by {values_with_intervals([value])}"
            return Excluded(own.runs[0], f"{UNLIKE} {len(others.runs)} runs: {reason}")
    return None


def rogues_among(problem: Problem, fit: CauseFit, runs: Sequence[Signals]) -> tuple[Excluded, ...]:
    """Return runs beside those of a fit that are unlike them in one value each, with what that is."""
    left, rogues = list(runs), []
    info = fit.info
    while left:
        both = problem._replace(signals=(*problem.signals, *left))
        at = evidence_at(
            left, problem.simulation, info.origin, info.names, problem.low_pass, info.noise, info.scatter
        )
        at = at.counted_from(info.vector)
        joint = replace(
            info,
            grams=np.concatenate([info.grams, at.grams]),
            rows=(*info.rows, *at.rows),
            white=(*info.white, *at.white),
        )
        found = rogue_run(varying_effects(both, cause_fit(both, joint, fit.causes)))
        if found is None or found.run_id not in [run.run_id for run in left]:
            break
        rogues.append(found)
        left = [run for run in left if run.run_id != found.run_id]
    return tuple(rogues)


def _own_values(
    info: Evidence,
    tried: _OwnValues,
    known: Mapping[str, float],
    columns: Array,
    shared: Sequence[str] | None = None,
) -> _OwnValues:
    """Fit runs with values of their own of an effect, all else as it is assumed, from a scatter of its parameters.

    All runs have values in common of the parameters ``shared``, of the whole library by default.  With the columns
    (runs, m) of a pattern, the effect has a value for each of these, and scatters about them.
    """
    own = [runs.name for runs in tried.runs]
    least = {
        name: known.get(name, 0.0) or LEAST_RATIO * PRIOR_STD[name]
        for name in [*[name for name in info.scatter if name not in own], *own]
    }
    least_std, q = np.array([*least.values()]), len(least) - len(own)
    free = np.arange(len(least)) >= q
    start = np.concatenate([least_std[:q], [runs.scatter for runs in tried.runs]])
    if columns.size:  # what robots differ by at random makes no pattern
        least_std = np.concatenate([least_std[:q], [LEAST_RATIO * PRIOR_STD[name] for name in own]])
    gram, n, k = info.grams.sum(axis=1), len(info.rows), len(info.names)
    # the columns of the evidence, a parameter's own for each column of the pattern, and the residual
    design = np.zeros((n, k + 1, k + len(own) * columns.shape[1] + 1))
    design[:, np.arange(k), np.arange(k)] = design[:, -1, -1] = 1.0
    for j, place in enumerate(info.places(own)):
        first = k + j * columns.shape[1]
        design[:, place, first : first + columns.shape[1]] = columns
    gram = design.transpose(0, 2, 1) @ gram @ design
    random = info.places([*least])
    # the whole library up to its prior, as one more run has it
    prior = np.zeros((1, *gram.shape[1:]))
    prior[0, :k, :k] = info.prior
    gram, shared = np.concatenate([gram, prior]), info.names if shared is None else shared
    common, of_pattern = info.places(shared), range(k, design.shape[2] - 1)
    loss, values, std = fit_mixed(gram, [*common, *of_pattern], random, least_std, start, free)
    alike, *_ = fit_mixed(gram, common, random, least_std, least_std, np.zeros_like(free))
    varies = dict(zip(least, std.tolist(), strict=True))
    values = values[: len(common)]
    runs = [
        values_by_run(info, of.name, shared, values, varies, known.get(of.name, 0.0)).about(of.mean)
        for of in tried.runs
    ]
    together = dict(zip(shared, values.tolist(), strict=True))
    return _OwnValues(tried.effect, runs, loss, alike - loss, together)


def values_by_run(
    info: Evidence,
    name: str,
    names: Sequence[str],
    shared: Array,
    scatter: Mapping[str, float],
    assumed_std: float,
) -> RunValues:
    """Return the values of a parameter by each run, with all that varies (``scatter``) beside it marginalised.

    All runs share values (m,) of parameters by name.  Values are compared between runs with those between thirds of
    each run; ``assumed_std`` is what they may differ by.
    """
    (place,), beside = info.places([name]), [other for other in scatter if other != name]
    q, std = len(beside), np.array([scatter[other] for other in beside])
    columns = np.zeros((len(info.names) + 1, q + 2))  # what varies, the parameter, and the residual
    columns[info.places(beside), np.arange(q)] = 1.0
    columns[place, q] = 1.0
    columns[info.places(names), -1] = -shared
    columns[-1, -1] = 1.0
    taken = marginal_parts(columns.T @ info.grams @ columns, np.arange(q), std)[:, :, q:, q:]
    mean = float(shared[list(names).index(name)]) if name in names else 0.0
    score, weight = taken[:, :, 0, 1], taken[:, :, 0, 0]
    total = weight.sum(axis=1)
    seen = total > 1e-6 * max(float(total.max()), 1e-30)
    if seen.sum() < 2 * MIN_GROUP or not total.max() > 0:
        nothing = np.full(len(total), math.inf)
        return RunValues(name, np.zeros(len(total)), np.ones(len(total)), 0.0, 0.0, nothing)
    use = seen[:, None] & (weight > 0.05 * total[:, None])
    weight, value, dof = _of_thirds(np.where(use, score, 0.0), np.where(use, weight, 0.0))
    variance = np.where(seen, 1.0 / np.where(seen, weight, 1.0), math.inf)
    precision = 1.0 / (variance + assumed_std**2)
    # one run that is far out is no variation from run to run: the others have to differ as well
    known = np.flatnonzero(seen)
    likelihood, own_std = math.inf, 0.0  # that a scatter of their own gains, twice its logarithm
    for rest in [np.delete(known, i) for i in range(len(known))]:
        about = value[rest], 1.0 / precision[rest], np.ones((len(rest), 1))
        none, free = (fit_scatter(*about, tried, CERTAIN_DOF) for tried in (SCATTERS[:1], SCATTERS))
        if none.loss - free.loss < likelihood:
            likelihood, own_std = none.loss - free.loss, free.scatter * math.sqrt(len(rest) / (len(rest) - 1))
    z = z_of_t(math.sqrt(max(likelihood, 0.0)), TRUST_DOF + dof)
    beyond_noise = math.hypot(own_std, assumed_std)
    return RunValues(name, value + mean, precision, beyond_noise, z, variance)


def _of_thirds(score: Array, weight: Array) -> tuple[Array, Array, float]:
    """Return the precision and value (n,) of runs, and the degrees of freedom of their noise.

    Scores and precisions (n, thirds) are 0 where a third shows nothing.  Values of thirds differ by a scatter of their
    own beyond the noise, of greatest restricted likelihood (Patterson and Thompson, Biometrika 1971): where a parameter
    acts most, what the model gets wrong is more than noise, and much information does not make a third as certain.
    """
    shows = weight > 0
    third = np.where(shows, score / np.where(shows, weight, 1.0), 0.0)
    scatters = SCATTERS * np.ptp(third[shows])
    own = np.where(shows, 1.0 / (1.0 / np.where(shows, weight, 1.0) + scatters[:, None, None] ** 2), 0.0)
    total = own.sum(axis=2)
    some = total[0] > 0
    value = (own * third).sum(axis=2) / np.where(some, total, 1.0)
    squares = (own * (third - value[:, :, None]) ** 2).sum(axis=(1, 2))
    dof = int(shows.sum() - some.sum())
    determinant = np.log(total[:, some]).sum(axis=1) - np.log(own[:, shows]).sum(axis=1)
    k = int(np.argmin((dof + TRUST_DOF) * np.log1p(squares / TRUST_DOF) + determinant))
    # thirds of a run share its deviations, most of the variance of a short one: no less than by whitening
    noise = max((TRUST_DOF + float(squares[k])) / (TRUST_DOF + dof), 1.0)
    # a third that has all the information of its run does not show how much the noise is
    share = own[k] / np.where(some, total[k], 1.0)[:, None]
    return total[k] / noise, value[k], float((1.0 / (share[some] ** 2).sum(axis=1) - 1.0).sum())


def _in_words(
    of: RunValues, signals: Sequence[Signals], channel: str, rivals: Sequence[str]
) -> tuple[Any, ...]:
    """Return the last fields of a :class:`verdict.Varying`: groups, channel, pattern and what it changes by."""
    found = of.pattern
    if found is None or not found.z > (Z_NEAR if of.z > Z_VARIES else Z_VARIES):
        return (), channel

    def latest(combination: Array) -> verdict.Value | None:
        seen = np.isfinite(of.variance)
        left = (of.value - found.values)[seen]
        value, ends = found.at(combination)
        half = math.hypot(0.5 * (ends[1] - ends[0]), verdict.INTERVAL_T * float(np.sqrt(np.mean(left**2))))
        return (
            None
            if rivals
            else verdict.Value(of.name, value, of.name.rpartition("_")[2], value - half, value + half)
        )

    if found.kind is Kind.TREND:
        span = float(np.ptp(found.columns[:, 1]))
        at_last = latest(np.array([1.0, float(found.columns[:, 1].max())]))
        return (), channel, found.kind, *found.at(np.array([0.0, span])), at_last, round(span) + 1
    # of two groups the smaller value first, of a change what was before, of a rogue the others
    order, groups = range(len(found.coefficients)), []
    if found.kind in (Kind.GROUPS, Kind.SESSIONS, Kind.TERRAINS):
        order = np.argsort(found.coefficients, kind="stable").tolist()
    for k in order:
        mine = np.flatnonzero((found.columns[:, k] > 0) & np.isfinite(of.variance))
        std = math.sqrt(float(found.cov[k, k]))
        runs = tuple(signals[i].run_id for i in mine.tolist())
        named = {Kind.SESSIONS: signals[mine[0]].session, Kind.TERRAINS: signals[mine[0]].terrain}
        value, name = float(found.coefficients[k]), named.get(found.kind, "")
        groups.append(verdict.RunGroup(value, std, runs, name))
    apart = np.zeros(len(found.coefficients))
    apart[order[-1]], apart[order[0]] = 1.0, -1.0
    last = latest(np.array([0.0, 1.0])) if found.kind is Kind.CHANGE else None
    return tuple(groups), channel, found.kind, *found.at(apart), last


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


def fit_mixed(
    gram: Array, shared: Sequence[int], own: Sequence[int], least_std: Array, start_std: Array, free: Array
) -> tuple[float, Array, Array]:
    """Return the fit of greatest likelihood.

    Parameters
    ----------
    gram : (runs, k + 1, k + 1) products of the whitened columns of each run, the residual last
    shared, own : places of the m parameters that all runs share, and of the q that differ about them
    least_std, start_std : (q,) least standard deviations, and those to start from, both above zero
    free : (q,) whether a standard deviation is estimated; the others stay as they start

    Returns
    -------
    loss : minus twice the log-likelihood, up to what no choice of parameters changes
    values : (m,) that all runs share
    std : (q,) standard deviations of the values that each run has of its own

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> columns = rng.standard_normal((200, 50, 1))
    >>> values = 1.0 + 0.5 * rng.standard_normal((200, 1))
    >>> residual = columns[:, :, 0] * values + 0.1 * rng.standard_normal((200, 50))
    >>> both = np.concatenate([columns, residual[:, :, None]], axis=2) / 0.1
    >>> gram, least = both.transpose(0, 2, 1) @ both, np.array([1e-3])
    >>> _, shared, std = fit_mixed(gram, [0], [0], least, np.ones(1), np.array([True]))
    >>> bool(abs(shared[0] - 1.0) < 0.1), bool(abs(std[0] - 0.5) < 0.1)
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
    return loss, values, std


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
    error = dict(simulation.model_error)
    for name, most in simulation.varied_error.items():
        if name in [effect.parameters[0].name for effect in problem.library]:
            assumed = simulation.scatter.get(name, 0.0)
            scatter = values_by_run(info, name, (), np.zeros(0), info.scatter, assumed).scatter
            error[name] = math.hypot(error.get(name, 0.0), min(MEAN_PER_SCATTER * scatter, most))
    return problem._replace(simulation=replace(simulation, model_error=error))
