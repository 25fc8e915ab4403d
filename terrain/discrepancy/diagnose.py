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
from terrain.discrepancy.constancy import CAVEAT_RATIO, Constancy, constancy_of, values_by_session
from terrain.discrepancy.evidence import Evidence, fit_change, move_point, partial_information
from terrain.discrepancy.health import Excluded, Fault, clocks_of, faults_of, repaired, unfit_runs
from terrain.discrepancy.next_drive import MOST, next_drive
from terrain.discrepancy.probes import TILT_INPUTS, ProbeResult, probe_residuals
from terrain.discrepancy.robot_terms import UNITS
from terrain.discrepancy.runs import Signals, Simulation, low_pass_of, measured_channels, rows_of, signals_of
from terrain.discrepancy.search import CauseFit, Problem, names_of, pooled, refit, rivals_of, search
from terrain.discrepancy.selection import EXCITED_RATIO, Z_EFFECT, fits_without_each, gain_interval
from terrain.discrepancy.varying import VARIES_RATIO, run_scatter, varying_effects, with_conditions
from terrain.discrepancy.verdict import (
    INTERVAL_T,
    Cause,
    Covariance,
    Diagnosis,
    Limit,
    Residual,
    RuledOut,
    Unexplained,
    Value,
    Varying,
    Verdict,
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
    missed = tuple(
        limit
        for limit in limits
        if limit.detection_limit > EXCITED_RATIO * MOST[limit.name] and limit.name not in parameters
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


# -- Why causes that reduce the residual are withdrawn all the same: a reason a rule, with its numbers ------

NEAR_BOUND = 0.02
"""A value closer to a bound than that ratio of the range, or of twice the bound where the other is further
from 0, is no value: the search would have gone on."""

WORSE_RATIO = 1.1  #: A cause is withdrawn that makes the square of a channel larger by more than that

PROBE_RATIO, PROBE_ALIKE = 0.5, 0.3
"""A cause is withdrawn if an input of its channel gains that ratio of its own gain beside it, and looks like
it: a correlation below the second says that the two are different matters."""

SLOW_CUTOFF_RATIO, SLOW_Z, SLOW_RATIO = 0.5, 3.0, 0.3
"""A cause is withdrawn if its value is smaller by so many standard deviations and by that ratio, where
sensitivities are computed along instruments of that ratio of the cut-off."""


class ChannelEffect(NamedTuple):
    """What a cause does to one channel: whitened squares without and with it, and the held-out gain."""

    without: float
    with_cause: float
    held_out_gain: float


def _own_and_base(fit: CauseFit, effect: Effect) -> tuple[list[int], list[int]]:
    """Return the places of the parameters of an effect, and of the others that were fitted."""
    own = [p.name for p in effect.parameters]
    return fit.info.places(own), fit.info.places([name for name in fit.names if name not in own])


def shown_channels(fit: CauseFit, cause: Effect) -> tuple[str, ...]:
    """Return the channels in which a cause shows, the clearest first."""
    weights = np.zeros((1, len(fit.info.names)))
    weights[0, _own_and_base(fit, cause)[0]] = fit.tests[cause.name].change
    power = fit.info.channel_power(weights)
    order = np.argsort(-power)
    return tuple(CHANNELS[i] for i in order if power[i] > 0.1 * power[order[0]])


def shown_beside(fit: CauseFit, effect: Effect) -> str:
    """Return the channel in which an effect shows most while the causes are fitted with it.

    A wheel radius beside an effective track shows in the speed alone: the track takes what it does to the
    yaw rate.
    """
    own, base = _own_and_base(fit, effect)
    weights = np.eye(len(fit.info.names))[own]
    weights[:, base] = -partial_information(fit.info.a.sum(axis=0), base, own)[0].T
    return CHANNELS[int(np.argmax(fit.info.channel_power(weights)))]


def raw_gain(fit: CauseFit, cause: Effect) -> float:
    """Return by how much a cause reduces minus twice the log-likelihood, the others refitted.

    It is on the scale of the gain of a probe, without the scatter between runs, which ``z`` has in it.
    """
    own, base = _own_and_base(fit, cause)
    free = partial_information(fit.info.a.sum(axis=0), base, own)[1]
    change = fit.change[[fit.names.index(p.name) for p in cause.parameters]]
    return float(change @ free @ change)


def constancy_of_cause(fit: CauseFit, cause: Effect) -> Constancy:
    """Return the values of a cause in parts of the data."""
    own = [p.name for p in cause.parameters]
    return constancy_of(fit.info, fit.names, own, fit.change, fit.tests[cause.name].inflation)


def reasons_to_withdraw(
    problem: Problem, fit: CauseFit, probes: Mapping[tuple[str, str], ProbeResult]
) -> dict[str, str]:
    """Return, by name, why significant causes are withdrawn; empty where all of them may be named."""
    significant = [cause for cause in fit.causes if fit.tests[cause.name].significant]
    slow = _slow_values(problem, fit) if significant else fit.change
    reasons = {}
    for cause in significant:
        constant = constancy_of_cause(fit, cause)
        reason = (
            _at_bound(problem, fit, cause)
            or (constant.caveat if constant.varies else "")
            or _probed(fit, cause, probes)
            or _worse(fit, cause)
            or _frequency_dependent(fit, cause, slow)
        )
        if reason:
            reasons[cause.name] = f"it reduces the residual, but {reason}"
    return reasons


def _at_bound(problem: Problem, fit: CauseFit, cause: Effect) -> str:
    for p in cause.parameters:
        low, high = BOUNDS[p.name]
        value = problem.simulation.effects.get(p.name, 0.0) + float(fit.change[fit.names.index(p.name)])
        above, below = (NEAR_BOUND * min(high - low, 2.0 * abs(bound)) for bound in (high, low))
        if value > high - above or (low < 0.0 and value < low + below):
            return f"{p.label} ends at the bound of what it may be ({value:.3g} {p.unit})"
    return ""


def _probed(fit: CauseFit, cause: Effect, probes: Mapping[tuple[str, str], ProbeResult]) -> str:
    """Return the input that explains much of the cause's main channels beside it."""
    main, own = shown_channels(fit, cause), [p.name for p in cause.parameters]
    beside = {
        at: probe
        for at, probe in probes.items()
        if at[0] in main
        and probe.significant
        and max((probe.alike[name] for name in own if name in probe.alike), default=1.0) > PROBE_ALIKE
    }
    most = max(beside, key=lambda at: beside[at].gain, default=None)
    if most is None or beside[most].gain <= PROBE_RATIO * raw_gain(fit, cause):
        return ""
    return f"{most[0]} depends on {most[1]} beside it (z {beside[most].z:.1f})"


def _worse(fit: CauseFit, cause: Effect) -> str:
    """Return the channel that a cause makes worse, or its main channel if it gains nothing held out."""
    effect = channel_effects(fit, cause)
    for name, channel in effect.items():
        if channel.with_cause > WORSE_RATIO * channel.without:
            more = channel.with_cause / channel.without - 1.0
            return f"it makes {name} worse, by {more:.0%} of the square"
    main = shown_channels(fit, cause)[0]
    if not effect[main].held_out_gain > 0:
        return f"it gains nothing in {main}, its main channel, on runs left out"
    return ""


def channel_effects(fit: CauseFit, cause: Effect) -> dict[str, ChannelEffect]:
    """Return what a cause does to each channel that was measured.

    What varies from run to run is taken out of each run as its residual shows it, but not the cause's own
    variation, which would take its place.  What that variation costs by its assumed size counts in the
    channels where it shows: in runs of one motion each it would else be a cause of any kind for nothing.
    """
    info, (own, base) = fit.info, _own_and_base(fit, cause)
    beside = ~np.isin(info.nuisances, own)
    free, precision = info.nuisances[beside], np.diag(1.0 / info.nuisance_std[beside] ** 2)
    squares = np.zeros((2, 2, len(CHANNELS)))  # without and with the cause, by all runs and by the others
    for m, places in enumerate((base, info.places(fit.names))):
        common = fit_change(info, [info.names[i] for i in places])[0]
        held_out = fits_without_each(info, places)
        for i, white in enumerate(info.white):
            random = white[free]
            flat = random.reshape(free.size, white[-1].size)
            inner = np.linalg.inv(flat @ flat.T + precision)
            shown = (random**2).sum(axis=1)
            cost = precision @ (shown / np.maximum(shown.sum(axis=1, keepdims=True), 1e-30))
            for kind, x in enumerate((common, held_out[i])):
                fitted = -info.away
                fitted[places] += x
                left = white[-1] - np.tensordot(fitted, white[:-1], axes=1)
                deviation = inner @ (flat @ left.ravel())
                left -= np.tensordot(deviation, random, axes=1)
                squares[m, kind] += (left**2).sum(axis=0) + deviation**2 @ cost
    return {
        CHANNELS[c]: ChannelEffect(squares[0, 0, c], squares[1, 0, c], squares[0, 1, c] - squares[1, 1, c])
        for c in range(len(CHANNELS))
        if squares[1, 0, c] > 0
    }


def _slow_values(problem: Problem, fit: CauseFit) -> Array:
    """Return values and variances (k, 2) where the instruments are filtered more."""
    cutoff_hz = SLOW_CUTOFF_RATIO * problem.low_pass.instrument_cutoff_hz
    slower = problem._replace(low_pass=problem.low_pass._replace(instrument_cutoff_hz=cutoff_hz))
    info = slower.at(move_point(fit.info.vector, fit.names, fit.change), fit.names, fit.info.statistics)
    value, cov = fit_change(replace(info, vector=problem.simulation.vector), fit.names)
    return np.column_stack([value, np.diag(cov)])


def _frequency_dependent(fit: CauseFit, cause: Effect, slow: Array) -> str:
    """Return whether a cause is smaller when quick motion is filtered out of the instruments.

    Both estimate the same quantity, so they agree up to the larger variance of the slower one (Hausman,
    Econometrica 1978); where the slower one is smaller, the cause fits noise of the wheel speeds, which goes
    with it.
    """
    at = [fit.names.index(p.name) for p in cause.parameters]
    size = fit.change[at]
    var = np.maximum(slow[at, 1] - np.diag(fit.cov)[at], 0.0) * fit.tests[cause.name].inflation
    apart = (size - slow[at, 0]) * np.sign(size)
    if (apart > np.maximum(SLOW_Z * np.sqrt(var), SLOW_RATIO * np.linalg.norm(size))).any():
        return "has a smaller value in slow motion: it fits noise of the wheel speeds"
    return ""


# -- What is done to runs before causes are searched: faults repaired, lags known, unfit runs excluded -----

REST_MPS = 0.02  #: Fastest that a wheel turns, by its sensor's noise, in a run that does not drive


class Prepared(NamedTuple):
    """Runs that are fit to be compared."""

    problem: Problem  #: of these runs, faults repaired
    faults: tuple[Fault, ...]  #: that were found and repaired, in all runs that were given
    excluded: tuple[Excluded, ...]  #: runs that are unfit
    seeds: Mapping[str, float]
    """Lags of sensors, by parameter, so large that a search has to start from them."""
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
    faults = faults_of(signals, plain, simulation, low_pass, latencies)
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
    seeds = {name: value for name, value in latencies.starting_values.items() if name in known}
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
    scatter, value = run_scatter(fit, parameter.name), fit.change[fit.names.index(parameter.name)]
    if len(effect.parameters) == 1 and scatter > CAVEAT_RATIO * abs(float(value)):
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
