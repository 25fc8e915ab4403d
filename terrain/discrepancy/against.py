"""What changed between two sets of runs of one robot: deflated tyres, a load, another floor.

Both sets are fitted together.  Each effect has a value that both share, and its difference, which acts in the second
set alone, is a candidate: one column of the evidence more, zero in the runs of the first set.  Differences are added
while one is significant and gains on runs left out of the fit, as causes are in :mod:`terrain.discrepancy.search`;
clusters are runs, or sessions where each set has several.  One whose gain beside the others, on runs held out, has an
interval that holds 0 is a candidate.  What both sets have in common, known or not, is in neither column and cancels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from terrain.discrepancy.diagnosed_runs import DiagnosedRuns
from terrain.discrepancy.earned import fit_to_judge
from terrain.discrepancy.evidence import (
    TRUST_DOF,
    Z_EFFECT,
    Evidence,
    clustered_variance,
    partial_information,
    z_of,
    z_of_t,
)
from terrain.discrepancy.gain import ratio_of_sums
from terrain.discrepancy.held_out import HOLD_OUT_EVERY, HOLD_OUT_FROM, repair_held_out
from terrain.discrepancy.patterns import evidence_of_parts
from terrain.discrepancy.probes import Z_PROBE, input_values
from terrain.discrepancy.runs import (
    Excluded,
    Signals,
    Simulation,
    comparable,
    in_order,
    low_pass_of,
)
from terrain.discrepancy.search import CLOSE_GAIN, MAX_FITTED, RIVAL_LOSS, Problem, names_of
from terrain.discrepancy.verdict import Unexplained, Value
from terrain.effects import BOUNDS, CHANNELS, INDEX, Effect
from terrain.errors import DataError
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.records import Array, RunLog
from terrain.robots import Robot

MIN_RUNS = 3  #: Least number of runs of a set: fewer do not show their scatter
MAX_DIFFERENCES = 5  #: More of them, and the second set is of another robot
N_STEPS = 3  #: Sensitivities are taken anew so often at the values of each set
MIN_SESSIONS = 2  #: Of each set, for sessions to be the clusters


class Difference(NamedTuple):
    """An effect whose value differs between the sets."""

    name: str
    parameters: tuple[Value, ...]  #: of the second set minus the first
    first: tuple[Value, ...]  #: in the first set, over what the simulation has of them already
    rivals: tuple[str, ...]  #: effects whose difference explains as much in its place
    z: float  #: evidence, as a standard normal number
    channels: tuple[str, ...]  #: where it shows, the clearest first


class Against(NamedTuple):
    """What changed between two sets of runs, and what predicting it gains on runs of both that were held out."""

    differences: tuple[Difference, ...]
    candidates: tuple[Difference, ...]  #: significant, but without a gain on runs held out
    #: channels that differ between the sets beside these, with an input each
    unnamed: tuple[Unexplained, ...]
    n_runs: tuple[int, int]  #: of the sets that were compared, those held out left out
    n_sessions: tuple[int, int]  #: 0 where runs name none
    clusters: str  #: ``runs`` or ``sessions``
    n_held_out: int
    #: Of the whitened square of held-out runs that the differences take, over values in common; NaN without either.
    reduction: float
    ci: tuple[float, float]
    excluded_runs: tuple[Excluded, ...]  #: of the second set

    @property
    def is_one_session_each(self) -> bool:
        """Whether what a session changes cannot be distinguished from what the set changes."""
        return max(self.n_sessions) < MIN_SESSIONS


def compare_with(
    diagnosed: DiagnosedRuns, robot: Robot, runs: Sequence[RunLog], library: Sequence[Effect], seed: int = 0
) -> Against:
    """Return what changed from diagnosed runs to other runs of the same robot.

    The other runs are simulated on the terrain of the diagnosed ones, where these have one label; a quarter of six or
    more, by the seed, is held out.

    Raises
    ------
    DataError
        if runs are too few, of another robot, or cannot be compared with the simulation.
    """
    last = diagnosed.extended or diagnosed.simulation
    diagnosis, labels = diagnosed.diagnosis, {match.terrain for match in diagnosed.terrains}
    signals, unread = comparable([with_wheel_speeds(run, robot) for run in in_order(runs)], robot)
    if len(labels) == 1:
        signals = tuple([replace(run, terrain=next(iter(labels))) for run in signals])
    noise = {channel: residual.noise for channel, residual in diagnosis.residual_before.items()}
    second = repair_held_out(signals, diagnosis.faults, last, diagnosed.low_pass, noise)
    second, unfit = fit_to_judge(last, second)
    n = math.ceil(len(second) / HOLD_OUT_EVERY) if len(second) >= HOLD_OUT_FROM else 0
    judged = set(np.random.default_rng(seed).permutation(len(second))[:n].tolist())
    used = [run for i, run in enumerate(second) if i not in judged]
    kept = [run for i, run in enumerate(second) if i in judged]
    behind = {run.run_id for run in diagnosed.fit}
    first = [run for run in diagnosed.signals if run.run_id in behind]
    held_out = [run for run in diagnosed.signals if run.run_id not in behind], kept
    causes = [value.name for cause in diagnosis.built_in for value in cause.parameters]
    return compare_sets(first, used, last, causes, library, held_out, seed, (*unread, *unfit))


class _Sets(NamedTuple):
    """Evidence of the runs of both sets, with the set and the cluster of each."""

    info: Evidence
    second: Array  #: (runs,) 1 in the second set
    cluster: Array  #: (runs,) number of its cluster

    def matrices(self, common: Sequence[str], differ: Sequence[str]) -> tuple[Array, Array]:
        """Return ``A`` (runs, n, n) and ``g`` (runs, n) of values in common, then of differences."""
        parts, at = self.info.marginal[0], self.info.places([*common, *differ])
        factor = np.ones((len(self.second), len(at)))
        factor[:, len(common) :] = self.second[:, None]
        return parts[:, at][:, :, at] * factor[:, :, None] * factor[:, None, :], parts[:, at, -1] * factor

    def fit(self, common: Sequence[str], differ: Sequence[str]) -> Array:
        """Return the values (n,) that fit all runs best."""
        a, g = self.matrices(common, differ)
        return np.asarray(np.linalg.pinv(a.sum(axis=0), hermitian=True) @ g.sum(axis=0))

    def loss(self, common: Sequence[str], differ: Sequence[str]) -> float:
        """Return minus twice the log-likelihood of the best fit, up to a constant."""
        return float(
            self.info.c.sum() - self.matrices(common, differ)[1].sum(axis=0) @ self.fit(common, differ)
        )


class _Test(NamedTuple):
    """Evidence of a difference, with its value (p,), the standard deviation, its degrees of freedom, and the gain."""

    z: float
    change: Array
    std: Array
    dof: float
    gain: float  #: on clusters left out of the fit
    dispersion: float

    @property
    def significant(self) -> bool:
        """Whether it is above the threshold and gains."""
        return self.z > Z_EFFECT and self.gain > 0.0


def compare_sets(
    first: Sequence[Signals],
    second: Sequence[Signals],
    simulation: Simulation,
    causes: Sequence[str],
    library: Sequence[Effect],
    held_out: tuple[Sequence[Signals], Sequence[Signals]] = ((), ()),
    seed: int = 0,
    excluded: Sequence[Excluded] = (),
) -> Against:
    """Return what changed from a first set of runs to a second one.

    Parameters
    ----------
    first, second : runs that are fit to be compared, faults repaired
    simulation : of the first set, with its causes built in
    causes : parameters of these, which are fitted anew with both sets
    library : effects that may differ
    held_out : runs of both sets that the gain is measured on
    excluded : runs of the second set that are unfit

    Raises
    ------
    DataError
        if a set has too few runs, or their clocks differ.
    """
    for name, runs in (("first", first), ("second", second)):
        if len(runs) < MIN_RUNS:
            raise DataError(
                f"against: the {name} set has {len(runs)} runs that can be compared; {MIN_RUNS} are required"
            )
    every = (*first, *second)
    low_pass, alone = low_pass_of([*every, *held_out[0], *held_out[1]]), simulation.vector
    # noise and scatter are those of the first set, to which the simulation was fitted
    before = Problem(tuple(first), simulation, low_pass, tuple(library)).at(alone)
    about: dict[str, Any] = {"noise": before.noise, "scatter": before.scatter}
    problem = Problem(every, simulation, low_pass, tuple(library))
    is_second = np.repeat([0.0, 1.0], [len(first), len(second)])
    n_sessions = tuple([len({run.session for run in runs if run.session}) for runs in (first, second)])
    by_session = min(n_sessions) >= MIN_SESSIONS and all(run.session for run in every)
    keys = [(i >= len(first), run.session) if by_session else (i, "") for i, run in enumerate(every)]
    cluster = np.array([sorted(set(keys)).index(key) for key in keys])
    start = _Sets(problem.at(alone, **about), is_second, cluster)

    def refit(chosen: Sequence[Effect]) -> _Sets:
        """Return the evidence with sensitivities at the values of each set."""
        sets, differ = start, names_of(chosen)
        for _ in range(N_STEPS if chosen else 0):
            sets = start._replace(
                info=problem.at(alone, own=_own_values(sets, causes, differ, is_second), **about)
            )
        return sets

    chosen: list[Effect] = []
    sets = start
    while len(chosen) < MAX_DIFFERENCES:
        tests = {e: _test(sets, causes, chosen, e) for e in library if e not in chosen}
        passing = sorted((-test.gain, k) for k, test in enumerate(tests.values()) if test.significant)
        if not passing:
            break
        close = [[*tests][k] for gain, k in passing[:MAX_FITTED] if -gain > -CLOSE_GAIN * passing[0][0]]
        fits = [refit([*chosen, effect]) for effect in close]
        losses = [
            fit.loss(*_names(causes, [*chosen, effect])) for fit, effect in zip(fits, close, strict=True)
        ]
        k = int(np.argmin(losses))
        more = [*chosen, close[k]]
        # a difference that another takes the place of is dropped
        weak = [e for e in more if not _test(fits[k], causes, [o for o in more if o is not e], e).significant]
        if close[k] in weak:
            break
        chosen = [effect for effect in more if effect not in weak]
        sets = fits[k] if not weak else refit(chosen)
    reduction, ci, n_held = math.nan, (math.nan, math.nan), len(held_out[0]) + len(held_out[1])
    candidates: tuple[Difference, ...] = ()
    if chosen and n_held:
        about = {"problem": problem, "causes": causes, "held_out": held_out, "seed": seed}
        earned = []
        for effect in chosen:
            others = [other for other in chosen if other is not effect]
            own, (low, _) = _gain(sets, refit(others), chosen, others, **about)
            if (low if n_held >= MIN_RUNS else own) > 0.0:  # of two runs Student's t reaches 13 deviations
                earned.append(effect)
        weak = [effect for effect in chosen if effect not in earned]
        candidates = tuple([_difference(sets, causes, chosen, effect, library) for effect in weak])
        sets, chosen = refit(earned) if weak else sets, earned
        if chosen:
            reduction, ci = _gain(sets, start, chosen, (), **about)
    return Against(
        tuple([_difference(sets, causes, chosen, effect, library) for effect in chosen]),
        candidates,
        _unnamed(sets, causes, chosen),
        (len(first), len(second)),
        (n_sessions[0], n_sessions[1]),
        "sessions" if by_session else "runs",
        n_held,
        reduction,
        ci,
        tuple(excluded),
    )


def _names(causes: Sequence[str], chosen: Sequence[Effect]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the parameters that have a value in common, and those that differ."""
    differ = names_of(chosen)
    return tuple(dict.fromkeys([*causes, *differ])), differ


def _own_values(sets: _Sets, causes: Sequence[str], differ: Sequence[str], second: Array) -> dict[str, Array]:
    """Return the values (runs,) of each set by parameter, within the bounds."""
    common = tuple(dict.fromkeys([*causes, *differ]))
    x = dict(zip([*common, *[f"+{name}" for name in differ]], sets.fit(common, differ).tolist(), strict=True))
    return {
        name: np.clip(
            sets.info.vector[INDEX[name]] + x[name] + x.get(f"+{name}", 0.0) * second, *BOUNDS[name]
        )
        for name in common
    }


def _test(sets: _Sets, causes: Sequence[str], chosen: Sequence[Effect], effect: Effect) -> _Test:
    """Return the evidence of a difference beside those chosen; its value in common is fitted with it."""
    common, differ = _names(causes, [*chosen, effect])
    own = [p.name for p in effect.parameters]
    differ = (*[name for name in differ if name not in own], *own)
    a, g = sets.matrices(common, differ)
    n = a.shape[1] - len(own)
    clusters = int(sets.cluster.max()) + 1
    parts, scores = np.zeros((clusters, *a.shape[1:])), np.zeros((clusters, a.shape[1]))
    np.add.at(parts, sets.cluster, a)
    np.add.at(scores, sets.cluster, g)
    total, score = parts.sum(axis=0), scores.sum(axis=0)
    nothing = _Test(0.0, np.zeros(len(own)), np.full(len(own), math.inf), 1.0, 0.0, 1.0)
    if not np.diag(total)[n:].min() > 1e-12:
        return nothing
    follow, free = partial_information(total, range(n), range(n, n + len(own)))
    if not np.linalg.eigvalsh(free)[0] > 1e-9 * np.diag(total)[n:].min():
        return nothing
    cov = np.linalg.inv(free)
    change = cov @ (score[n:] - follow.T @ score[:n])
    size = float(change @ free @ change)
    if not size > 0.0:
        return nothing
    x = np.linalg.pinv(total, hermitian=True) @ score
    direction = np.concatenate([-follow @ change, change])
    dispersion, dof = clustered_variance(parts, scores, x, direction, size)
    dispersion = max(dispersion, 1.0) if clusters > 2 else dispersion
    root = math.sqrt(size) if len(own) == 1 else z_of(float(chi2.logsf(min(size, 1400.0), len(own))))
    z = z_of_t(root / math.sqrt(dispersion), max(dof, TRUST_DOF if clusters < 2 else dof))
    gains = []
    for k in range(clusters):
        rest, right = total - parts[k], score - scores[k]
        fits = []
        for m in (n, n + len(own)):
            there = np.linalg.pinv(rest[:m, :m], hermitian=True, rcond=1e-12) @ right[:m]
            fits.append(float(there @ parts[k][:m, :m] @ there - 2.0 * there @ scores[k][:m]))
        gains.append(fits[0] - fits[1])
    std = np.sqrt(np.maximum(np.diag(cov), 0.0) * dispersion)
    # in neither set is it of a size that no builder would believe
    for p, more in zip(effect.parameters, change.tolist(), strict=True):
        first = float(sets.info.vector[INDEX[p.name]] + x[common.index(p.name)])
        if not all(p.plausible[0] <= value <= p.plausible[1] for value in (first, first + more)):
            return nothing
    return _Test(z, change, std, dof, float(np.sum(gains)), dispersion)


def _difference(
    sets: _Sets, causes: Sequence[str], chosen: Sequence[Effect], effect: Effect, library: Sequence[Effect]
) -> Difference:
    """Return a difference with its intervals, and what explains as much in its place."""
    others = [other for other in chosen if other is not effect]
    test = _test(sets, causes, others, effect)
    half = float(student.ppf(0.975, test.dof)) * test.std
    numbers = zip(effect.parameters, test.change.tolist(), half.tolist(), strict=True)
    values = tuple([Value(p.name, x, p.unit, x - h, x + h) for p, x, h in numbers])
    common, differ = _names(causes, chosen)
    x, a = sets.fit(common, differ), sets.matrices(common, differ)[0].sum(axis=0)
    std = np.sqrt(np.maximum(np.diag(np.linalg.pinv(a, hermitian=True)), 0.0) * max(test.dispersion, 1.0))
    first = []
    for p in effect.parameters:
        at = common.index(p.name)
        value, h = float(x[at]), float(student.ppf(0.975, test.dof) * std[at])
        first.append(Value(p.name, value, p.unit, value - h, value + h))
    # in its place: its own value in common stays, so that only the difference is asked for
    own, rivals = [p.name for p in effect.parameters], []
    for other in library:
        if other in chosen:
            continue
        swapped = names_of([*others, other])
        with_it = tuple(dict.fromkeys([*common, *names_of([other])]))
        behind = sets.loss(with_it, swapped) - sets.loss(with_it, differ)
        if (
            behind < RIVAL_LOSS * max(test.dispersion, 1.0)
            and _test(sets, [*causes, *own], others, other).significant
        ):
            rivals.append((behind, other.name))
    weights = np.zeros((1, len(sets.info.names)))
    weights[0, sets.info.places(own)] = test.change
    power = sets.info.channel_power(weights)
    order = np.argsort(-power)
    shown = tuple([CHANNELS[i] for i in order if power[i] > 0.1 * power[order[0]]])
    return Difference(
        effect.name, values, tuple(first), tuple([name for _, name in sorted(rivals)]), test.z, shown
    )


def _unnamed(sets: _Sets, causes: Sequence[str], chosen: Sequence[Effect]) -> tuple[Unexplained, ...]:
    """Return the channels whose residual depends on an input otherwise in one set than in the other."""
    common, differ = _names(causes, chosen)
    x = sets.fit(common, differ)
    base = dict(zip(common, x[: len(common)].tolist(), strict=True))
    more = dict(zip(differ, x[len(common) :].tolist(), strict=True))
    left = []
    for white, second in zip(sets.info.white, sets.second, strict=True):
        change = np.zeros(len(sets.info.names))
        for name, value in base.items():
            change[sets.info.names.index(name)] = value + more.get(name, 0.0) * second
        left.append(
            np.concatenate([white[:-1], (white[-1] - np.tensordot(change, white[:-1], axes=1))[None]])
        )
    info = replace(sets.info, white=tuple(left))
    best: dict[str, Unexplained] = {}
    for c, channel in enumerate(CHANNELS):
        power = sum([float((white[-1, :, c] ** 2).sum()) for white in left])
        for name, (value, size) in input_values(info, c).items() if power > 0.0 else ():
            variance = np.where(size > 0.0, 1.0 / np.where(size > 0.0, size, 1.0), np.inf)
            z = evidence_of_parts(value, variance, sets.second > 0)
            if z > Z_PROBE and (channel not in best or z > best[channel].z):
                means = [np.average(value, weights=size * of) for of in (sets.second, 1.0 - sets.second)]
                gain = (means[0] - means[1]) ** 2 * float(size @ sets.second)
                best[channel] = Unexplained(channel, name, z, min(gain / power, 1.0))
    return tuple(sorted(best.values(), key=lambda each: -each.z))


def _gain(
    sets: _Sets,
    start: _Sets,
    chosen: Sequence[Effect],
    others: Sequence[Effect],
    problem: Problem,
    causes: Sequence[str],
    held_out: tuple[Sequence[Signals], Sequence[Signals]],
    seed: int,
) -> tuple[float, tuple[float, float]]:
    """Return by how much the square of held-out runs falls where each set has its own values, and its interval.

    It falls from that of the fit ``start``, in which those of ``others`` alone differ.
    """
    common, differ = _names(causes, chosen)
    second = np.repeat([0.0, 1.0], [len(runs) for runs in held_out])
    judged = problem._replace(signals=(*held_out[0], *held_out[1]))
    costs = []
    for of, names in ((start, names_of(others)), (sets, differ)):
        own: Mapping[str, Array] = _own_values(of, common, names, second)
        info = judged.at(sets.info.vector, noise=sets.info.noise, scatter=sets.info.scatter, own=own)
        there = np.column_stack([values - sets.info.vector[INDEX[name]] for name, values in own.items()])
        at = info.places([*own])
        a, g = info.clusters(at)
        costs.append(info.c + np.einsum("ri,rij,rj->r", there, a, there) - 2.0 * (there * g).sum(axis=1))
    return ratio_of_sums(costs[0] - costs[1], costs[0], seed)
