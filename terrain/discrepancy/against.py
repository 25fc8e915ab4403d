"""What changed between two sets of runs of one robot: deflated tyres, a load, another floor.

Both sets are fitted together.  Each effect has a value that both share, and its difference, which acts in the second
set alone, is an effect of its own (:mod:`terrain.discrepancy.differences`), searched as causes are
(:mod:`terrain.discrepancy.search`) beside the causes of both.  Clusters are runs, or sessions where each set has
several.  A difference whose gain beside the others, on runs held out, has an interval that holds 0 is a candidate.
What both sets have in common, known or not, is in neither column and cancels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.diagnose import shown_channels, values_of
from terrain.discrepancy.diagnosed_runs import DiagnosedRuns
from terrain.discrepancy.differences import INDEX, MORE, PARAMETER, difference, in_common
from terrain.discrepancy.earned import fit_to_judge
from terrain.discrepancy.evidence import Evidence, move_point
from terrain.discrepancy.gain import ratio_of_sums
from terrain.discrepancy.held_out import quarter, repair_held_out
from terrain.discrepancy.patterns import evidence_of_parts
from terrain.discrepancy.probes import Z_PROBE, input_values
from terrain.discrepancy.runs import Excluded, Signals, Simulation, comparable, in_order, low_pass_of
from terrain.discrepancy.search import CauseFit, Problem, names_of, refit, relinearize, rivals_of, search_on
from terrain.discrepancy.verdict import INTERVAL_T, Unexplained, Value
from terrain.effects import CHANNELS, Effect
from terrain.errors import DataError
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.records import Array, RunLog
from terrain.robots import Robot

MIN_RUNS = 3  #: Least number of runs of a set: fewer do not show their scatter
MAX_DIFFERENCES = 5  #: More of them, and the second set is of another robot
MIN_SESSIONS = 2  #: Of each set, for sessions to be the clusters


class Difference(NamedTuple):
    """An effect whose value differs between the sets."""

    name: str
    parameters: tuple[Value, ...]  #: of the second set minus the first
    first: tuple[Value, ...]  #: in the first set
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
    n = quarter(len(second))
    judged = set(np.random.default_rng(seed).permutation(len(second))[:n].tolist())
    used = [run for i, run in enumerate(second) if i not in judged]
    kept = [run for i, run in enumerate(second) if i in judged]
    behind = {run.run_id for run in diagnosed.fit}
    first = [run for run in diagnosed.signals if run.run_id in behind]
    held_out = [run for run in diagnosed.signals if run.run_id not in behind], kept
    causes = [value.name for cause in diagnosis.built_in for value in cause.parameters]
    return compare_sets(first, used, last, causes, library, held_out, seed, (*unread, *unfit))


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
    every = [*first, *[replace(run, is_second=True) for run in second]]
    low_pass, alone = low_pass_of([*every, *held_out[0], *held_out[1]]), simulation.vector
    # noise and scatter are those of the first set, to which the simulation was fitted
    before = Problem(tuple(first), simulation, low_pass, tuple(library)).at(alone)
    n_sessions = tuple([len({run.session for run in runs if run.session}) for runs in (first, second)])
    by_session = min(n_sessions) >= MIN_SESSIONS and all(run.session for run in every)
    keys = [(run.is_second, run.session) for run in every]
    session = np.array([sorted(set(keys)).index(key) for key in keys]) if by_session else None
    given = {"noise": before.noise, "scatter": before.scatter}
    both = [effect for effect in library if set(names_of([effect])) <= set(causes)]
    problem = Problem(
        tuple(every),
        simulation,
        low_pass,
        (*both, *map(difference, library)),
        given={**given, "session": session},
        most=len(both) + MAX_DIFFERENCES,
    )
    # causes are counted from none of them, the rest from what the simulation has
    start = np.concatenate([alone, np.zeros_like(alone)])
    bare = start.copy()
    bare[[INDEX[name] for name in causes]] = 0.0
    info = problem.at(start).counted_from(bare)
    while True:
        fit = search_on(problem, info, both)
        beyond = {effect.name for effect in _differences(fit) if not _is_plausible(fit, effect)}
        if not beyond:
            break
        problem = problem._replace(barred=problem.barred | beyond)

    # what runs of both that were held out lose without each difference, and without all
    judged = problem._replace(
        signals=(*held_out[0], *[replace(run, is_second=True) for run in held_out[1]]), given=given
    )
    found, n_held = _differences(fit), len(judged.signals)
    reduction, ci = math.nan, (math.nan, math.nan)
    candidates: tuple[Difference, ...] = ()
    if found and n_held:

        def gain(fit: CauseFit, out: Sequence[Effect]) -> tuple[float, tuple[float, float]]:
            """Return the part of the square that differences take from values in common, beside the other causes."""
            common = [effect for effect in library if effect.name + MORE in [each.name for each in out]]
            rest = list(dict.fromkeys([*[cause for cause in fit.causes if cause not in out], *common]))
            costs = [
                judged.at(move_point(at.vector, names, at.fit(names)[0]), ()).c
                for at, names in (
                    (relinearize(problem, fit.info, rest), names_of(rest)),
                    (fit.info, fit.names),
                )
            ]
            return ratio_of_sums(costs[0] - costs[1], costs[0], seed)

        weak = []
        for effect in found:
            own, (low, _) = gain(fit, [effect])
            if (
                not (low if n_held >= MIN_RUNS else own) > 0.0
            ):  # of two runs Student's t reaches 13 deviations
                weak.append(effect)
        if weak:
            candidates = _stated(problem, fit, info, weak)
            problem = problem._replace(barred=problem.barred | {effect.name for effect in weak})
            rest = [cause for cause in fit.causes if cause not in weak]
            fit = refit(problem, fit.info, rest)
            found = _differences(fit)
        if found:
            reduction, ci = gain(fit, found)
    return Against(
        _stated(problem, fit, info, found),
        candidates,
        _unnamed(fit, np.array([run.is_second for run in every], dtype=float)),
        (len(first), len(second)),
        (n_sessions[0], n_sessions[1]),
        "sessions" if by_session else "runs",
        n_held,
        reduction,
        ci,
        tuple(excluded),
    )


def _differences(fit: CauseFit) -> list[Effect]:
    """Return the causes of a fit that are differences."""
    return [cause for cause in fit.causes if cause.name.endswith(MORE)]


def _first(fit: CauseFit, name: str) -> float:
    """Return the value of a parameter in the first set."""
    return float(fit.info.vector[INDEX[name]] + fit.change[fit.names.index(name)])


def _is_plausible(fit: CauseFit, effect: Effect) -> bool:
    """Return whether a difference is between values of a size that a builder would believe."""
    for p in effect.parameters:
        first, (low, high) = _first(fit, in_common(p.name)), PARAMETER[in_common(p.name)].plausible
        if not all(low <= value <= high for value in (first, first + _first(fit, p.name))):
            return False
    return True


def _stated(
    problem: Problem, fit: CauseFit, start: Evidence, effects: Sequence[Effect]
) -> tuple[Difference, ...]:
    """Return differences with their intervals, and what explains as much in their place."""
    stated, fit = [], fit._replace(rivals=rivals_of(problem, fit.info, start, fit.causes, effects))
    for effect in effects:
        values = tuple(
            [v._replace(name=in_common(v.name), unit=in_common(v.unit)) for v in values_of(fit, effect)]
        )
        first = []
        for p in effect.parameters:
            at = fit.names.index(in_common(p.name))
            half = INTERVAL_T * math.sqrt(float(fit.cov[at, at]) * fit.tests[effect.name].inflation)
            value = _first(fit, in_common(p.name))
            first.append(Value(in_common(p.name), value, in_common(p.unit), value - half, value + half))
        rivals = tuple([in_common(name) for name in fit.rivals[effect.name]])
        about = fit.tests[effect.name].z, shown_channels(fit, effect)
        stated.append(Difference(in_common(effect.name), values, tuple(first), rivals, *about))
    return tuple(stated)


def _unnamed(fit: CauseFit, second: Array) -> tuple[Unexplained, ...]:
    """Return the channels whose residual depends on an input otherwise in one set than in the other."""
    info = fit.info.counted_from(move_point(fit.info.vector, fit.names, fit.change))
    best: dict[str, Unexplained] = {}
    for c, channel in enumerate(CHANNELS):
        power = sum([float((white[-1, :, c] ** 2).sum()) for white in info.white])
        for name, (value, size) in input_values(info, c).items() if power > 0.0 else ():
            variance = np.where(size > 0.0, 1.0 / np.where(size > 0.0, size, 1.0), np.inf)
            z = evidence_of_parts(value, variance, second > 0)
            if z > Z_PROBE and (channel not in best or z > best[channel].z):
                means = [np.average(value, weights=size * of) for of in (second, 1.0 - second)]
                gain = (means[0] - means[1]) ** 2 * float(size @ second)
                best[channel] = Unexplained(channel, name, z, min(gain / power, 1.0))
    return tuple(sorted(best.values(), key=lambda each: -each.z))
