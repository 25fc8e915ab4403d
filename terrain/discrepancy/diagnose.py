"""Diagnosis: measured runs and a simulation in, what the simulation gets wrong out.

The order is that in which each step was seen to be needed: the health of the logs and gross regimes first,
one low-pass for everything, whitening, then causes by held-out gain and a statistic clustered by run, a refit
where sensitivities have changed, a swap test against all effects that could replace a cause, constancy, and
probes of the remaining residual.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.clocks import Latencies, Shift, latencies_of, shifts_of
from terrain.discrepancy.constancy import CAVEAT_RATIO, constancy_of, values_by_session
from terrain.discrepancy.evidence import Evidence, move_point, partial_information, recentre
from terrain.discrepancy.faults import Fault, faults_of, repaired
from terrain.discrepancy.next_drive import next_drive
from terrain.discrepancy.probes import TILT_INPUTS, ProbeResult, probe_residuals
from terrain.discrepancy.residuals import low_pass_of, measured_channels, rows_of
from terrain.discrepancy.robot_terms import UNITS
from terrain.discrepancy.search import Found, Problem, names_of, pooled, refit, search, with_rivals
from terrain.discrepancy.selection import EXCITED_RATIO, Z_EFFECT, gain_interval
from terrain.discrepancy.signals import Signals, signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.unfit import clocks_of, unfit_runs
from terrain.discrepancy.varying import VARIES_RATIO, run_scatter, varying_effects, with_conditions
from terrain.discrepancy.verdict import (
    INTERVAL_T,
    Cause,
    Diagnosis,
    Excluded,
    Limit,
    Residual,
    RuledOut,
    Unexplained,
    Value,
    Varying,
    Verdict,
)
from terrain.discrepancy.withdrawal import raw_gain, reasons_to_withdraw, shown_beside, shown_channels
from terrain.effects import BOUNDS, CHANNELS, INDEX, Effect, effect_named
from terrain.errors import DataError
from terrain.records import RunLog

BLIND_RATIO = 0.05
"""Ratio of the library that may be not excited before the verdict ``none`` becomes ``not_excited``."""

MAX_WITHDRAWN = 6
"""Most causes that are withdrawn one after the other."""

ENTANGLED = 0.97
"""Correlation of fitted values above which two causes are ambiguous: a collinearity index of 6."""


def diagnose(
    runs: Sequence[RunLog], simulation: Simulation, library: Sequence[Effect] | None = None
) -> Diagnosis:
    """Return what a simulation gets wrong about measured runs.

    Parameters
    ----------
    runs : of the simulation's robot, three at the least
    simulation : under test, with the effects that are built in already
    library : effects that may be named; all that apply to the robot by default

    Raises
    ------
    DataError
        if runs are of another robot, too few, of one id, or too short, or have no channel in common with the
        simulation, or if too few are consistent with each other.
    """
    ids = Counter(run.run_id for run in runs)
    if twice := [run_id for run_id, n in ids.items() if n > 1]:
        raise DataError(f"runs: {twice[0]!r} is the id of {ids[twice[0]]} runs; each needs its own")
    if len(runs) < MIN_RUNS:
        raise DataError(f"runs: there are {len(runs)}, at least {MIN_RUNS} are required, to hold some out")
    return diagnose_signals([signals_of(run, simulation.robot) for run in runs], simulation, library)


def diagnose_signals(
    signals: Sequence[Signals], simulation: Simulation, library: Sequence[Effect] | None = None
) -> Diagnosis:
    """Return the diagnosis of runs that are on one clock already; see :func:`diagnose`."""
    effects = simulation.library if library is None else tuple(library)
    prepared = prepare(signals, simulation, effects)
    problem = with_conditions(prepared.problem, prepared.aligned)
    same = problem is prepared.problem and not prepared.seeds
    start = prepared.aligned if same else problem.at(simulation.vector)
    found, withdrawn = _withdraw_wrong(problem, start, search(problem, start, prepared.seeds), {})
    varying = varying_effects(problem, found)
    if _is_beside(problem, found, varying):
        problem = problem._replace(varying={varying[0].parameter: varying[0].scatter})
        info = recentre(problem.at(found.info.origin), start.vector)
        again = list(dict.fromkeys([*found.causes, effect_named(varying[0].name)]))
        found = refit(problem, start, found._replace(info=info), again)
        found, withdrawn = _withdraw_wrong(problem, start, found, withdrawn)
    found, withdrawn = _without_varying(problem, start, found, withdrawn, varying)
    found = pooled(problem, with_rivals(problem, start, found))
    unexplained = _unexplained_channels(problem, found, withdrawn, varying)
    named, sets = _named_and_ambiguous(found, found.causes)
    limits = tuple(limits_of(found, problem.library))
    causes = tuple(cause_of(found, effect) for effect in named)
    detected = {value.name for cause in causes for value in cause.values}
    missed = tuple(
        limit
        for limit in limits
        if limit.value > EXCITED_RATIO * _bound(limit.name) and limit.name not in detected
    )
    parameters = names_of(named)
    at = [found.names.index(name) for name in parameters]
    inflation = np.array([found.tried[effect.name].inflation for effect in named for _ in effect.parameters])
    verdict = _verdict(sets, causes, varying, unexplained)
    if verdict is None:
        verdict = Verdict.NOT_EXCITED if len(missed) > BLIND_RATIO * len(limits) else Verdict.NONE
    after = _information_after(problem, found, named)
    return Diagnosis(
        robot=simulation.robot.name,
        verdict=verdict,
        causes=causes,
        parameters=parameters,
        cov=found.cov[np.ix_(at, at)] * np.sqrt(np.outer(inflation, inflation)),
        ambiguous_sets=tuple(sets),
        ambiguous_values=rival_values(found, sets),
        unexplained=unexplained,
        limits=limits,
        not_excited=missed,
        ruled_out=tuple(ruled_out_of(found, named, sets, withdrawn, problem.library)),
        excluded_runs=prepared.excluded,
        clocks=clocks_of(prepared.aligned, prepared.shift),
        next_drive=next_drive(simulation, sets, missed, found.info),
        residual_before=residuals_of(start, start),
        residual_after=residuals_of(after, start),
        n_runs=len(problem.signals),
        varying=varying,
        faults=prepared.faults,
        by_session=values_by_session(found, problem.signals, named, simulation.robot),
    )


def _withdraw_wrong(
    problem: Problem, start: Evidence, found: Found, withdrawn: dict[str, RuledOut]
) -> tuple[Found, dict[str, RuledOut]]:
    """Return the causes that may be named, and those that were withdrawn, by name.

    One is withdrawn at a time, the one that gains least, and the others are fitted anew: a wrong cause
    distorts the others, and their reasons go with it.
    """
    for _ in range(MAX_WITHDRAWN):
        probes = _probes(problem, found)
        reasons = reasons_to_withdraw(problem, found, probes)
        if not reasons:
            break
        worst = min(
            (cause for cause in found.causes if cause.name in reasons), key=lambda each: raw_gain(found, each)
        )
        found = _withdraw(problem, start, found, worst, reasons[worst.name], withdrawn)
    return found, withdrawn


def _withdraw(
    problem: Problem,
    start: Evidence,
    found: Found,
    cause: Effect,
    reason: str,
    withdrawn: dict[str, RuledOut],
) -> Found:
    """Note why a cause is withdrawn, and return the others, fitted without it."""
    evidence = found.tried[cause.name]
    withdrawn[cause.name] = RuledOut(cause.name, reason, evidence.z, values_of(found, cause))
    others = [other for other in found.causes if other is not cause and other.modifies != cause.name]
    return refit(problem, start, found, others)


def _is_beside(problem: Problem, found: Found, varying: Sequence[Varying]) -> bool:
    """Return whether causes were found beside an effect that varies, of which runs had one value.

    What that value leaves may look like causes: they are fitted again with a value of each run.
    """
    return any(
        each.parameter not in problem.scatter and cause.name not in (each.name, *each.rivals)
        for each in varying
        for cause in found.causes
    )


def _without_varying(
    problem: Problem,
    start: Evidence,
    found: Found,
    withdrawn: dict[str, RuledOut],
    varying: Sequence[Varying],
) -> tuple[Found, dict[str, RuledOut]]:
    """Withdraw causes whose value is no value of all runs, since it differs from run to run."""
    for each in varying:
        for cause in found.causes:
            alike = cause.name in (each.name, *each.rivals)
            sizes = {p.name: abs(found.change[found.names.index(p.name)]) for p in cause.parameters}
            name, value = max(sizes.items(), key=lambda item: item[1])
            scatter = run_scatter(found, name)
            if alike and scatter > VARIES_RATIO * value:
                reason = f"its value differs from run to run, by {scatter:.3g} about a size of {value:.3g}"
                found = _withdraw(problem, start, found, cause, reason, withdrawn)
    return found, withdrawn


def _probes(problem: Problem, found: Found) -> dict[tuple[str, str], ProbeResult]:
    """Return the probes of the residual, those of a tilt that is only in part a slope left out."""
    results = probe_residuals(found.info, found.names, found.change, problem.simulation.probe_error)
    if all(problem.simulation.tilt_is_slope(run.terrain) for run in problem.signals):
        return results
    return {at: each for at, each in results.items() if at[1] not in TILT_INPUTS}


def _unexplained_channels(
    problem: Problem, found: Found, withdrawn: Mapping[str, RuledOut], varying: Sequence[Varying]
) -> tuple[Unexplained, ...]:
    """Return the most significant input of every channel that depends on one."""
    info = found.info
    results = _probes(problem, found)
    best: dict[str, Unexplained] = {}
    size = {c: sum(float((r[:, i] ** 2).sum()) for r in info.white_residual) for i, c in enumerate(CHANNELS)}
    for (channel, name), answer in results.items():
        if answer.significant and (channel not in best or answer.z > best[channel].z):
            best[channel] = Unexplained(channel, name, answer.z, min(answer.gain / size[channel], 1.0))
    for each in withdrawn.values():
        channel = shown_beside(found, effect_named(each.name))
        if channel not in best and not any(each.name in (v.name, *v.rivals) for v in varying):
            best[channel] = Unexplained(channel, each.name, each.z, 0.0)
    return tuple(sorted(best.values(), key=lambda left: -left.z))


def _named_and_ambiguous(
    found: Found, causes: Sequence[Effect]
) -> tuple[list[Effect], list[tuple[str, ...]]]:
    """Return the causes that are named, and the ambiguous sets."""
    named: list[Effect] = []
    sets: list[tuple[str, ...]] = []
    for cause in causes:
        if not found.tried[cause.name].significant:
            continue
        if found.rivals[cause.name]:
            sets.append((cause.name, *_rival_names(found, cause)))
        else:
            named.append(cause)
    for one, other in combinations(causes, 2):
        if (one in named or other in named) and _correlated(found, one, other):
            sets = [names for names in sets if names[0] not in (one.name, other.name)]
            members = (one.name, *_rival_names(found, one), other.name, *_rival_names(found, other))
            sets.append(tuple(dict.fromkeys(members)))
            named = [cause for cause in named if cause not in (one, other)]
    return named, sets


def _rival_names(found: Found, cause: Effect) -> list[str]:
    return [rival.effect.name for rival in found.rivals[cause.name]]


def _correlated(found: Found, one: Effect, other: Effect) -> bool:
    """Return whether the fitted values of two causes are too correlated to distinguish them."""
    i, j = ([found.names.index(p.name) for p in effect.parameters] for effect in (one, other))
    scale = np.sqrt(np.diag(found.cov))
    correlation = found.cov / np.outer(scale, scale)
    return bool(np.abs(correlation[np.ix_(i, j)]).max() > ENTANGLED)


def _verdict(
    sets: Sequence[object], causes: Sequence[Cause], varying: Sequence[object], unexplained: Sequence[object]
) -> Verdict | None:
    """Return the verdict; None where nothing was found."""
    if sets:
        return Verdict.AMBIGUOUS
    if causes:
        return Verdict.EXPLAINED
    if varying:
        return Verdict.VARIES
    return Verdict.UNEXPLAINED if unexplained else None


def _bound(parameter: str) -> float:
    low, high = BOUNDS[parameter]
    return max(abs(low), high)


def _information_after(problem: Problem, found: Found, named: Sequence[Effect]) -> Evidence:
    """Return the information around the simulation with the named causes built in."""
    vector = problem.simulation.vector.copy()
    for name, value in zip(found.names, found.change, strict=True):
        if name in names_of(named):
            vector[INDEX[name]] += value
    return problem.at(vector, (), found.info.statistics)


# -- What is done to runs before causes are searched: faults repaired, lags known, unfit runs excluded -----

MIN_RUNS = 3
"""Least number of runs: with fewer none is left to validate a fit."""

REST_MPS = 0.02
"""Fastest that a wheel turns, by its sensor's noise, in a run that does not drive."""


class Prepared(NamedTuple):
    """Runs that are fit to be compared.

    Parameters
    ----------
    problem : of these runs, faults repaired
    faults : that were found and repaired, in all runs that were given
    excluded : runs that are unfit
    seeds : lags of sensors, by parameter, that are so large that a search has to start from them
    aligned : information of the runs with these lags built in
    shift : clocks of the runs behind that
    """

    problem: Problem
    faults: tuple[Fault, ...]
    excluded: tuple[Excluded, ...]
    seeds: Mapping[str, float]
    aligned: Evidence
    shift: Shift


def prepare(signals: Sequence[Signals], simulation: Simulation, library: Sequence[Effect]) -> Prepared:
    """Return runs without faults, without unfit ones, and the lags of their sensors.

    Raises
    ------
    DataError
        if too few runs are fit, or their clocks are further apart than is searched.
    """
    low_pass = low_pass_of(signals)
    plain = [
        rows_of(run, simulation.planar_on(run.terrain), simulation.vector, (), low_pass) for run in signals
    ]
    latencies = latencies_of(signals, simulation)
    faults = faults_of(signals, plain, simulation, low_pass, latencies=latencies)
    runs = repaired(signals, faults)
    if faults:
        latencies = latencies_of(runs, simulation)
    problem = Problem(runs, simulation, low_pass, tuple(library))
    seeds, aligned, shift = _aligned(problem, latencies)
    excluded = unfit_runs(runs, aligned, shift)
    if excluded:
        unfit = {run.run_id for run in excluded}
        fit = tuple(run for run in runs if run.run_id not in unfit)
        if len(fit) < MIN_RUNS:
            reasons = "; ".join(f"{run.run_id}: {run.reason}" for run in excluded[:3])
            raise DataError(f"runs: only {len(fit)} of {len(signals)} are fit to be compared ({reasons})")
        problem = problem._replace(signals=fit)
        seeds, aligned, shift = _aligned(problem, latencies_of(fit, simulation))
    if not any(np.nanmax(np.abs(run.wheel_speed_mps), initial=0.0) > REST_MPS for run in problem.signals):
        n = len(problem.signals)
        raise DataError(f"runs: in all {n} the wheels are at rest; runs that drive are required")
    return Prepared(problem, faults, excluded, seeds, aligned, shift)


def _aligned(problem: Problem, latencies: Latencies) -> tuple[dict[str, float], Evidence, Shift]:
    """Return lags to start from, the information of the runs with them built in, and their clocks there."""
    values = latencies.starting_values()
    seeds = {name: value for name, value in values.items() if name in problem.parameters}
    there = move_point(problem.simulation.vector, tuple(seeds), np.array(list(seeds.values())))
    aligned = problem.at(there)
    return seeds, aligned, shifts_of(aligned)


# -- What a diagnosis states of what was found: causes, rivals, limits, what is ruled out, and residuals ---

POWER_Z = 1.28
"""Added to the threshold, so that nine in ten are detected."""


def values_of(found: Found, effect: Effect) -> tuple[Value, ...]:
    """Return the fitted values of a cause."""
    values = []
    for parameter in effect.parameters:
        at = found.names.index(parameter.name)
        half = INTERVAL_T * float(np.sqrt(found.cov[at, at] * found.tried[effect.name].inflation))
        value = float(found.change[at])
        values.append(Value(parameter.name, value, parameter.unit, value - half, value + half))
    return tuple(values)


def cause_of(found: Found, effect: Effect) -> Cause:
    """Return what is stated of a cause that is named."""
    own = found.tried[effect.name]
    size = float(found.info.c.sum())
    low, high = gain_interval(own.gain)
    return Cause(
        effect.name,
        effect.aliases,
        values_of(found, effect),
        float(own.gain.sum()) / size,
        low / size,
        high / size,
        shown_channels(found, effect),
        own.z,
        own.dispersion,
        caveat_of(found, effect),
    )


def caveat_of(found: Found, effect: Effect) -> str:
    """Return what the value of a cause depends on, in words; empty where it is one number."""
    names = [p.name for p in effect.parameters]
    constant = constancy_of(found.info, found.names, names, found.change, found.tried[effect.name].inflation)
    caveats = [constant.caveat] if constant.caveat else []
    value = abs(float(found.change[found.names.index(names[0])]))
    scatter = run_scatter(found, names[0])
    if len(names) == 1 and scatter > CAVEAT_RATIO * value:
        unit = effect.parameters[0].unit
        caveats.append(f"it differs from run to run by {scatter:.2g} {UNITS.get(unit, unit)}".strip())
    return "; ".join(caveats)


def rival_values(found: Found, sets: Sequence[tuple[str, ...]]) -> dict[str, tuple[Value, ...]]:
    """Return the values that every member of an ambiguous set would have."""
    values = {cause.name: values_of(found, cause) for cause in found.causes}
    for rivals in found.rivals.values():
        for rival in rivals:
            half = INTERVAL_T * rival.std
            values.setdefault(
                rival.effect.name,
                tuple(
                    Value(p.name, float(x), p.unit, float(x - h), float(x + h))
                    for p, x, h in zip(rival.effect.parameters, rival.change, half, strict=True)
                ),
            )
    return {name: values[name] for names in sets for name in names}


def limits_of(found: Found, library: Sequence[Effect]) -> list[Limit]:
    """Return the detection limit of every effect beside what was found."""
    info, limits = found.info, []
    a = info.a.sum(axis=0)
    for effect in library:
        others = [name for name in found.names if name not in names_of([effect])]
        base = info.places(others)
        for parameter in effect.parameters:
            own = info.places([parameter.name])
            free = float(partial_information(a, base, own)[1][0, 0])
            known = free > 1e-9 * max(a[own[0], own[0]], 1e-12)
            value = (Z_EFFECT + POWER_Z) / float(np.sqrt(free)) if known else np.inf
            limits.append(Limit(parameter.name, value, parameter.unit, effect.needs))
    return limits


def ruled_out_of(
    found: Found,
    named: Sequence[Effect],
    sets: Sequence[tuple[str, ...]],
    withdrawn: Mapping[str, RuledOut],
    library: Sequence[Effect],
) -> list[RuledOut]:
    """Return the effects that are not the answer, those that were withdrawn first."""
    answered = {effect.name for effect in named} | {name for names in sets for name in names}
    out = list(withdrawn.values())
    for effect in library:
        if effect.name in answered or effect.name in withdrawn:
            continue
        own = found.tried[effect.name]
        values: tuple[Value, ...] = ()
        if effect in found.causes:
            reason = "it is not significant beside the other causes"
            values = values_of(found, effect)
        elif not own.inside:
            reason = "the fitted value is out of its bounds"
        elif own.z <= Z_EFFECT:
            reason = "it is not significant beside what was found"
        else:
            reason = "it does not reduce the residual of runs left out, or differs from run to run"
        out.append(RuledOut(effect.name, reason, own.z, values))
    return out


def residuals_of(info: Evidence, start: Evidence) -> dict[str, Residual]:
    """Return how far measured and simulated are apart, by channel."""
    out = {}
    for channel in measured_channels(info.rows):
        c = CHANNELS.index(channel)
        left = np.concatenate([run.residual[:, c] for run in info.rows])
        rms = float(np.sqrt(np.nanmean(left**2)))
        noise = float(start.noise.std[c])
        systematic = max(1.0 - (noise / rms) ** 2, 0.0) if rms > 0 else 0.0
        out[channel] = Residual(rms, noise, systematic)
    return out
