"""Diagnosis: measured runs and a simulation in, what the simulation gets wrong out.

The order is that in which each step was seen to be needed: the health of the logs and gross regimes first,
one low-pass for everything, whitening, then causes by held-out gain and a statistic clustered by run, a refit
where sensitivities have changed, a swap test against all effects that could replace a cause, constancy, and
probes of the remaining residual.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.clocks import Latencies, Shift, latencies_of, shifts_of
from terrain.discrepancy.constancy import CAVEAT_RATIO, values_by_session
from terrain.discrepancy.evidence import Evidence, move_point, partial_information
from terrain.discrepancy.faults import Fault, faults_of, repaired
from terrain.discrepancy.next_drive import next_drive
from terrain.discrepancy.probes import TILT_INPUTS, ProbeResult, probe_residuals
from terrain.discrepancy.residuals import low_pass_of, measured_channels, rows_of
from terrain.discrepancy.robot_terms import UNITS
from terrain.discrepancy.search import CauseFit, Problem, names_of, pooled, refit, rivals_of, search
from terrain.discrepancy.selection import EXCITED_RATIO, Z_EFFECT, gain_interval
from terrain.discrepancy.signals import Signals, signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.unfit import clocks_of, unfit_runs
from terrain.discrepancy.varying import VARIES_RATIO, run_scatter, varying_effects, with_conditions
from terrain.discrepancy.verdict import (
    INTERVAL_T,
    Cause,
    Covariance,
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
from terrain.discrepancy.withdrawal import (
    constancy_of_cause,
    raw_gain,
    reasons_to_withdraw,
    shown_beside,
    shown_channels,
)
from terrain.effects import BOUNDS, CHANNELS, Effect, effect_named
from terrain.errors import DataError
from terrain.records import Array, RunLog

MIN_RUNS = 3  #: Least number of runs: with fewer none is left to validate a fit

BLIND_RATIO = 0.05
"""Ratio of the library that may be not excited before the verdict ``none`` becomes ``not_excited``."""

MAX_WITHDRAWN = 6  #: Most causes that are withdrawn one after the other

ENTANGLED = 0.97
"""Correlation of fitted values above which two causes are ambiguous: a collinearity index of 6."""

POWER_Z = 1.28  #: Added to the threshold, so that nine in ten are detected


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
    effects = simulation.library if library is None else tuple(library)
    prepared = prepare([signals_of(run, simulation.robot) for run in runs], simulation, effects)
    problem = with_conditions(prepared.problem, prepared.aligned)
    same = problem is prepared.problem and not prepared.seeds
    start = prepared.aligned if same else problem.at(simulation.vector)
    withdrawn: dict[str, RuledOut] = {}
    fit = _withdraw_wrong(problem, start, search(problem, start, prepared.seeds), withdrawn)
    varying = varying_effects(problem, fit)
    if _is_beside(problem, fit, varying):
        problem = problem._replace(varying={varying[0].parameter: varying[0].scatter})
        info = replace(problem.at(fit.info.origin), vector=start.vector)
        again = list(dict.fromkeys([*fit.causes, effect_named(varying[0].name)]))
        fit = _withdraw_wrong(problem, start, refit(problem, start, info, again), withdrawn)
    fit = _withdraw_varying(problem, start, fit, withdrawn, varying)
    fit = pooled(problem, fit._replace(rivals=rivals_of(problem, fit.info, start, fit.causes)))
    unexplained = _unexplained_channels(problem, fit, withdrawn, varying)
    named, sets = _named_and_ambiguous(fit)
    causes, parameters = tuple(cause_of(fit, effect) for effect in named), names_of(named)
    limits = limits_of(fit, problem.library)
    most = {name: max(abs(low), high) for name, (low, high) in BOUNDS.items()}
    missed = tuple(
        limit
        for limit in limits
        if limit.detection_limit > EXCITED_RATIO * most[limit.name] and limit.name not in parameters
    )
    at = [fit.names.index(name) for name in parameters]
    inflation = np.array([fit.tests[effect.name].inflation for effect in named for _ in effect.parameters])
    cov = fit.cov[np.ix_(at, at)] * np.sqrt(np.outer(inflation, inflation))
    verdicts = {
        Verdict.AMBIGUOUS: sets,
        Verdict.EXPLAINED: causes,
        Verdict.VARIES: varying,
        Verdict.UNEXPLAINED: unexplained,
        Verdict.NOT_EXCITED: len(missed) > BLIND_RATIO * len(limits),
        Verdict.NONE: True,
    }
    built_in = problem.simulation.with_effects(dict(zip(parameters, fit.change[at].tolist(), strict=True)))
    return Diagnosis(
        robot=simulation.robot.name,
        verdict=next(verdict for verdict, holds in verdicts.items() if holds),
        causes=causes,
        covariance=Covariance(parameters, cov),
        ambiguous_sets=tuple(sets),
        ambiguous_values=rival_values(fit, sets),
        unexplained=unexplained,
        detection_limits=limits,
        not_excited=missed,
        ruled_out=ruled_out_of(fit, named, sets, withdrawn, problem.library),
        excluded_runs=prepared.excluded,
        clocks=clocks_of(prepared.aligned, prepared.shift),
        next_drive=next_drive(simulation, sets, missed, fit.info),
        residual_before=residuals_of(start, start),
        residual_after=residuals_of(problem.at(built_in.vector, (), fit.info.statistics), start),
        n_runs=len(problem.signals),
        varying=varying,
        faults=prepared.faults,
        by_session=values_by_session(fit, problem.signals, named, simulation.robot),
    )


def _withdraw_wrong(
    problem: Problem, start: Evidence, fit: CauseFit, withdrawn: dict[str, RuledOut]
) -> CauseFit:
    """Return the causes that may be named; those that were withdrawn are noted by name.

    One is withdrawn at a time, the one that gains least, and the others are fitted anew: a wrong cause
    distorts the others, and their reasons go with it.
    """
    for _ in range(MAX_WITHDRAWN):
        reasons = reasons_to_withdraw(problem, fit, _probes(problem, fit))
        if not reasons:
            break
        doubtful = [cause for cause in fit.causes if cause.name in reasons]
        gains = [raw_gain(fit, cause) for cause in doubtful]
        worst = doubtful[int(np.argmin(gains))]
        fit = _withdraw(problem, start, fit, worst, reasons[worst.name], withdrawn)
    return fit


def _withdraw(
    problem: Problem,
    start: Evidence,
    fit: CauseFit,
    cause: Effect,
    reason: str,
    withdrawn: dict[str, RuledOut],
) -> CauseFit:
    """Note why a cause is withdrawn, and return the others, fitted without it."""
    withdrawn[cause.name] = RuledOut(cause.name, reason, fit.tests[cause.name].z, values_of(fit, cause))
    others = [other for other in fit.causes if other is not cause and other.modifies != cause.name]
    return refit(problem, start, fit.info, others)


def _is_beside(problem: Problem, fit: CauseFit, varying: Sequence[Varying]) -> bool:
    """Return whether causes were found beside an effect that varies, of which runs had one value.

    What that value leaves may look like causes: they are fitted again with a value of each run.
    """
    return any(
        effect.parameter not in problem.scatter and cause.name not in (effect.name, *effect.rivals)
        for effect in varying
        for cause in fit.causes
    )


def _withdraw_varying(
    problem: Problem,
    start: Evidence,
    fit: CauseFit,
    withdrawn: dict[str, RuledOut],
    varying: Sequence[Varying],
) -> CauseFit:
    """Withdraw causes whose value is no value of all runs, since it differs from run to run."""
    for effect in varying:
        for cause in fit.causes:
            sizes = {p.name: abs(fit.change[fit.names.index(p.name)]) for p in cause.parameters}
            name, value = max(sizes.items(), key=lambda item: item[1])
            scatter = run_scatter(fit, name)
            if cause.name in (effect.name, *effect.rivals) and scatter > VARIES_RATIO * value:
                reason = f"its value differs from run to run, by {scatter:.3g} about a size of {value:.3g}"
                fit = _withdraw(problem, start, fit, cause, reason, withdrawn)
    return fit


def _probes(problem: Problem, fit: CauseFit) -> dict[tuple[str, str], ProbeResult]:
    """Return the probes of the residual, those of a tilt that is only in part a slope left out."""
    results = probe_residuals(fit.info, fit.names, fit.change, problem.simulation.probe_error)
    if all(problem.simulation.tilt_is_slope(run.terrain) for run in problem.signals):
        return results
    return {at: probe for at, probe in results.items() if at[1] not in TILT_INPUTS}


def _unexplained_channels(
    problem: Problem, fit: CauseFit, withdrawn: Mapping[str, RuledOut], varying: Sequence[Varying]
) -> tuple[Unexplained, ...]:
    """Return the most significant input of every channel that depends on one."""
    best: dict[str, Unexplained] = {}
    size = dict(zip(CHANNELS, sum((white[-1] ** 2).sum(axis=0) for white in fit.info.white), strict=True))
    for (channel, name), probe in _probes(problem, fit).items():
        if probe.significant and (channel not in best or probe.z > best[channel].z):
            best[channel] = Unexplained(channel, name, probe.z, min(probe.gain / float(size[channel]), 1.0))
    varies = {name for effect in varying for name in (effect.name, *effect.rivals)}
    for cause in withdrawn.values():
        channel = shown_beside(fit, effect_named(cause.name))
        if channel not in best and cause.name not in varies:
            best[channel] = Unexplained(channel, cause.name, cause.z, 0.0)
    return tuple(sorted(best.values(), key=lambda left: -left.z))


def _named_and_ambiguous(fit: CauseFit) -> tuple[list[Effect], list[tuple[str, ...]]]:
    """Return the causes that are named, and the ambiguous sets."""
    members = {
        cause.name: (cause.name, *(rival.effect.name for rival in fit.rivals[cause.name]))
        for cause in fit.causes
    }
    significant = [cause for cause in fit.causes if fit.tests[cause.name].significant]
    named = [cause for cause in significant if not fit.rivals[cause.name]]
    sets = [members[cause.name] for cause in significant if fit.rivals[cause.name]]
    std = np.sqrt(np.diag(fit.cov))
    for one, other in combinations(fit.causes, 2):
        i, j = ([fit.names.index(p.name) for p in effect.parameters] for effect in (one, other))
        entangled = np.abs(fit.cov[np.ix_(i, j)]) > ENTANGLED * np.outer(std[i], std[j])
        if (one in named or other in named) and entangled.any():
            sets = [names for names in sets if names[0] not in (one.name, other.name)]
            sets.append(tuple(dict.fromkeys((*members[one.name], *members[other.name]))))
            named = [cause for cause in named if cause not in (one, other)]
    return named, sets


# -- What is done to runs before causes are searched: faults repaired, lags known, unfit runs excluded -----

REST_MPS = 0.02  #: Fastest that a wheel turns, by its sensor's noise, in a run that does not drive


class Prepared(NamedTuple):
    """Runs that are fit to be compared."""

    problem: Problem  #: of these runs, faults repaired
    faults: tuple[Fault, ...]  #: that were found and repaired, in all runs that were given
    excluded: tuple[Excluded, ...]  #: runs that are unfit
    seeds: Mapping[
        str, float
    ]  #: lags of sensors, by parameter, so large that a search has to start from them
    aligned: Evidence  #: of the runs with these lags built in
    shift: Shift  #: clocks of the runs behind that


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
    known = names_of(problem.library)
    seeds = {name: value for name, value in latencies.starting_values().items() if name in known}
    aligned = problem.at(move_point(problem.simulation.vector, tuple(seeds), np.array(list(seeds.values()))))
    return seeds, aligned, shifts_of(aligned)


# -- What a diagnosis states of what was found: causes, rivals, limits, what is ruled out, and residuals ---


def values_of(fit: CauseFit, effect: Effect) -> tuple[Value, ...]:
    """Return the fitted values of a cause."""
    at = [fit.names.index(p.name) for p in effect.parameters]
    return _values(effect, fit.change[at], np.sqrt(fit.cov[at, at] * fit.tests[effect.name].inflation))


def _values(effect: Effect, change: Array, std: Array) -> tuple[Value, ...]:
    half = INTERVAL_T * std
    return tuple(
        Value(p.name, float(x), p.unit, float(x - h), float(x + h))
        for p, x, h in zip(effect.parameters, change, half, strict=True)
    )


def cause_of(fit: CauseFit, effect: Effect) -> Cause:
    """Return what is stated of a cause that is named."""
    test, size = fit.tests[effect.name], float(fit.info.c.sum())
    low, high = gain_interval(test.gain)
    constant, parameter = constancy_of_cause(fit, effect), effect.parameters[0]
    caveats = [constant.caveat] if constant.caveat else []
    scatter = run_scatter(fit, parameter.name)
    if len(effect.parameters) == 1 and scatter > CAVEAT_RATIO * abs(
        float(fit.change[fit.names.index(parameter.name)])
    ):
        unit = UNITS.get(parameter.unit, parameter.unit)
        caveats.append(f"it differs from run to run by {scatter:.2g} {unit}".strip())
    return Cause(
        name=effect.name,
        aliases=effect.aliases,
        parameters=values_of(fit, effect),
        held_out_gain=float(test.gain.sum()) / size,
        gain_ci=(low / size, high / size),
        channels=shown_channels(fit, effect),
        z=test.z,
        dispersion=test.dispersion,
        caveat="; ".join(caveats),
    )


def rival_values(fit: CauseFit, sets: Sequence[tuple[str, ...]]) -> dict[str, tuple[Value, ...]]:
    """Return the values that every member of an ambiguous set would have."""
    values = {cause.name: values_of(fit, cause) for cause in fit.causes}
    for rivals in fit.rivals.values():
        for rival in rivals:
            values.setdefault(rival.effect.name, _values(rival.effect, rival.change, rival.std))
    return {name: values[name] for names in sets for name in names}


def limits_of(fit: CauseFit, library: Sequence[Effect]) -> tuple[Limit, ...]:
    """Return the detection limit of every effect beside what was found."""
    a, limits = fit.info.a.sum(axis=0), []
    for effect in library:
        base = fit.info.places([name for name in fit.names if name not in names_of([effect])])
        for parameter in effect.parameters:
            own = fit.info.places([parameter.name])
            free = float(partial_information(a, base, own)[1][0, 0])
            known = free > 1e-9 * max(a[own[0], own[0]], 1e-12)
            value = (Z_EFFECT + POWER_Z) / float(np.sqrt(free)) if known else np.inf
            limits.append(Limit(parameter.name, value, parameter.unit, effect.needs))
    return tuple(limits)


def ruled_out_of(
    fit: CauseFit,
    named: Sequence[Effect],
    sets: Sequence[tuple[str, ...]],
    withdrawn: Mapping[str, RuledOut],
    library: Sequence[Effect],
) -> tuple[RuledOut, ...]:
    """Return the effects that are not the answer, those that were withdrawn first."""
    answered = {effect.name for effect in named} | {name for names in sets for name in names} | {*withdrawn}
    out = list(withdrawn.values())
    for effect in library:
        if effect.name in answered:
            continue
        test = fit.tests[effect.name]
        values: tuple[Value, ...] = ()
        if effect in fit.causes:
            reason = "it is not significant beside the other causes"
            values = values_of(fit, effect)
        elif not test.inside:
            reason = "the fitted value is out of its bounds"
        elif test.z <= Z_EFFECT:
            reason = "it is not significant beside what was found"
        else:
            reason = "it does not reduce the residual of runs left out, or differs from run to run"
        out.append(RuledOut(effect.name, reason, test.z, values))
    return tuple(out)


def residuals_of(info: Evidence, start: Evidence) -> dict[str, Residual]:
    """Return how far measured and simulated are apart, by channel."""
    out = {}
    for channel in measured_channels(info.rows):
        c = CHANNELS.index(channel)
        rms = float(np.sqrt(np.nanmean(np.concatenate([run.residual[:, c] for run in info.rows]) ** 2)))
        noise = float(start.noise.std[c])
        systematic = max(1.0 - (noise / rms) ** 2, 0.0) if rms > 0 else 0.0
        out[channel] = Residual(rms, noise, systematic)
    return out
