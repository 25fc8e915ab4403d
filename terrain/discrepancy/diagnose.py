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

import numpy as np

from terrain.discrepancy.clocks import shifts_of
from terrain.discrepancy.health import clocks_of, unfit_runs
from terrain.discrepancy.information import Information, move_point, partial_information, recentre
from terrain.discrepancy.next_drive import next_drive
from terrain.discrepancy.probes import ProbeResult, parameter_drifts, probe_residuals
from terrain.discrepancy.residuals import low_pass_of, measured_channels
from terrain.discrepancy.search import Found, Problem, names_of, search
from terrain.discrepancy.selection import EXCITED_RATIO, Z_EFFECT, fit_change, gain_interval
from terrain.discrepancy.signals import Signals, signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.verdict import (
    Cause,
    Diagnosis,
    Limit,
    Residual,
    RuledOut,
    Unexplained,
    Value,
    Verdict,
)
from terrain.effects import BOUNDS, CHANNELS, INDEX, Effect
from terrain.errors import DataError
from terrain.records import RunLog

MIN_RUNS = 3
"""Least number of runs: with fewer none is left to validate a fit."""

POWER_Z = 1.28
"""Added to the threshold, so that nine in ten are detected."""

BLIND_RATIO = 0.05
"""Ratio of the library that may be not excited before the verdict ``none`` becomes ``not_excited``."""

DRIFT_RATIO, PROBE_RATIO = 0.05, 0.15
"""A cause is withdrawn if the evidence of its drift, or of a probe in its channel, exceeds that ratio of its
own."""

SLOW_CUTOFF_RATIO, SLOW_Z, SLOW_RATIO = 0.5, 3.0, 0.3
"""A cause is withdrawn if its value differs by so many standard deviations and by that ratio, where
sensitivities are computed along instruments of that ratio of the cut-off."""

ENTANGLED = 0.97
"""Correlation of fitted values above which two causes are ambiguous: a collinearity index of 6."""

INTERVAL_T = 2.13
"""Half a 95 % interval in standard deviations: t with the 15 degrees that eight runs and the noise give."""


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
    low_pass = low_pass_of(signals)
    problem = Problem(tuple(signals), simulation, low_pass, effects)
    start = problem.at(simulation.vector)
    shift = shifts_of(start)
    excluded = unfit_runs(problem.signals, start, shift)
    if excluded:
        gone = {run.run_id for run in excluded}
        kept = tuple(run for run in problem.signals if run.run_id not in gone)
        if len(kept) < MIN_RUNS:
            reasons = "; ".join(f"{run.run_id}: {run.reason}" for run in excluded[:3])
            raise DataError(f"runs: only {len(kept)} of {len(signals)} are fit to be compared ({reasons})")
        problem = problem._replace(signals=kept)
        start = problem.at(simulation.vector)
        shift = shifts_of(start)
    found = search(problem, start)
    at_fit = found.info
    results = probe_residuals(at_fit, found.names, found.change)
    drifts = parameter_drifts(at_fit, found.names, found.change)
    unexplained = _unexplained_channels(at_fit, results)
    withdrawn = _reasons_to_withdraw(found, drifts, results) | _frequency_dependent(problem, found)
    named, sets = _named_and_ambiguous(
        found, [cause for cause in found.causes if cause.name not in withdrawn]
    )
    unexplained = _with_drifts(unexplained, found, withdrawn, drifts)
    limits = tuple(_limits(found, problem.library))
    missed = tuple(limit for limit in limits if limit.value > EXCITED_RATIO * _bound(limit.name))
    causes = tuple(_cause(found, effect) for effect in named)
    parameters = names_of(named)
    at = [found.names.index(name) for name in parameters]
    grown = np.array([found.tried[effect.name].inflation for effect in named for _ in effect.parameters])
    if sets:
        verdict = Verdict.AMBIGUOUS
    elif causes:
        verdict = Verdict.EXPLAINED
    elif unexplained:
        verdict = Verdict.UNEXPLAINED
    else:
        verdict = Verdict.NOT_EXCITED if len(missed) > BLIND_RATIO * len(limits) else Verdict.NONE
    after = _information_after(problem, found, named)
    return Diagnosis(
        robot=simulation.robot.name,
        verdict=verdict,
        causes=causes,
        parameters=parameters,
        cov=found.cov[np.ix_(at, at)] * np.sqrt(np.outer(grown, grown)),
        ambiguous_sets=tuple(sets),
        ambiguous_values=_rival_values(found, sets),
        unexplained=unexplained,
        limits=limits,
        not_excited=missed,
        ruled_out=tuple(_ruled_out(found, named, sets, withdrawn, problem.library)),
        excluded_runs=excluded,
        clocks=clocks_of(start, shift),
        next_drive=next_drive(simulation, sets, missed, found.info),
        residual_before=_residuals(start, start),
        residual_after=_residuals(after, start),
        n_runs=len(problem.signals),
    )


def _unexplained_channels(
    info: Information, results: dict[tuple[str, str], ProbeResult]
) -> tuple[Unexplained, ...]:
    """Return the most significant input of every channel that depends on one."""
    best: dict[str, Unexplained] = {}
    size = {c: sum(float((r[:, i] ** 2).sum()) for r in info.white_residual) for i, c in enumerate(CHANNELS)}
    for (channel, name), answer in results.items():
        if answer.significant and (channel not in best or answer.z > best[channel].z):
            best[channel] = Unexplained(channel, name, answer.z, min(answer.gain / size[channel], 1.0))
    return tuple(sorted(best.values(), key=lambda left: -left.z))


def _reasons_to_withdraw(
    found: Found, drifts: dict[str, ProbeResult], results: dict[tuple[str, str], ProbeResult]
) -> dict[str, str]:
    """Return, by name, why causes that fit are withdrawn all the same."""
    why = {}
    for cause in found.causes:
        own = found.tried[cause.name]
        if not own.significant:
            continue
        evidence = own.z**2
        drift = _drift(drifts, cause)
        main = _channels(found, cause)
        beside = {at: answer for at, answer in results.items() if at[0] in main and answer.significant}
        most = max(beside, key=lambda at: beside[at].gain, default=None)
        if drift.significant and drift.gain > DRIFT_RATIO * evidence:
            why[cause.name] = (
                f"it reduces the residual, but changes from the start of runs to their end (z {drift.z:.1f})"
            )
        elif most is not None and beside[most].gain > PROBE_RATIO * evidence:
            why[cause.name] = (
                f"it reduces the residual, but {most[0]} depends on {most[1]} beside it "
                f"(z {beside[most].z:.1f})"
            )
    return why


def _frequency_dependent(problem: Problem, found: Found) -> dict[str, str]:
    """Return, by name, why causes are withdrawn whose values differ when quick motion is filtered out.

    Both estimate the same quantity, so they agree up to the larger variance of the slower one (Hausman,
    Econometrica 1978); where they do not, the cause fits noise of the wheel speeds.
    """
    if not found.causes:
        return {}
    slower = problem._replace(
        low_pass=problem.low_pass._replace(
            instrument_cutoff_hz=SLOW_CUTOFF_RATIO * problem.low_pass.instrument_cutoff_hz
        )
    )
    there = move_point(found.info.vector, found.names, found.change)
    info = slower.at(there, found.names, found.info.statistics)
    value, cov = fit_change(recentre(info, problem.simulation.vector), found.names)
    why = {}
    for cause in found.causes:
        at = [found.names.index(p.name) for p in cause.parameters]
        size = found.change[at]
        var = np.maximum(np.diag(cov - found.cov)[at], 0.0) * found.tried[cause.name].inflation
        apart = np.abs(value[at] - size)
        if (apart > np.maximum(SLOW_Z * np.sqrt(var), SLOW_RATIO * np.abs(size))).any():
            why[cause.name] = (
                "it reduces the residual, but has another value in slow motion: "
                "it fits noise of the wheel speeds"
            )
    return why


def _drift(drifts: dict[str, ProbeResult], cause: Effect) -> ProbeResult:
    return max((drifts[p.name] for p in cause.parameters), key=lambda answer: answer.z)


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


def _with_drifts(
    unexplained: tuple[Unexplained, ...],
    found: Found,
    withdrawn: Mapping[str, str],
    drifts: dict[str, ProbeResult],
) -> tuple[Unexplained, ...]:
    """Add the channels of causes that were withdrawn because of a drift to the unexplained ones."""
    channels = {left.channel for left in unexplained}
    more = []
    for cause in found.causes:
        channel, drift = _channels(found, cause)[0], _drift(drifts, cause)
        if cause.name in withdrawn and drift.significant and channel not in channels:
            more.append(Unexplained(channel, "time", drift.z, 0.0))
            channels.add(channel)
    return (*unexplained, *more)


def _channels(found: Found, cause: Effect) -> tuple[str, ...]:
    """Return the channels in which a cause shows, the clearest first."""
    info = found.info
    at = info.places([p.name for p in cause.parameters])
    own = found.tried[cause.name].change
    power = sum((np.tensordot(own, white[at], axes=1) ** 2).sum(axis=0) for white in info.white_change)
    order = np.argsort(-np.asarray(power))
    return tuple(CHANNELS[i] for i in order if power[i] > 0.1 * power[order[0]])


def _values(found: Found, effect: Effect) -> tuple[Value, ...]:
    """Return the fitted values of a cause."""
    values = []
    for parameter in effect.parameters:
        at = found.names.index(parameter.name)
        half = INTERVAL_T * float(np.sqrt(found.cov[at, at] * found.tried[effect.name].inflation))
        value = float(found.change[at])
        values.append(Value(parameter.name, value, parameter.unit, value - half, value + half))
    return tuple(values)


def _cause(found: Found, effect: Effect) -> Cause:
    own = found.tried[effect.name]
    size = float(found.info.c.sum())
    low, high = gain_interval(own.gain)
    return Cause(
        effect.name,
        effect.aliases,
        _values(found, effect),
        float(own.gain.sum()) / size,
        low / size,
        high / size,
        _channels(found, effect),
        own.z,
        own.dispersion,
    )


def _rival_values(found: Found, sets: Sequence[tuple[str, ...]]) -> dict[str, tuple[Value, ...]]:
    """Return the values that every member of an ambiguous set would have."""
    values = {cause.name: _values(found, cause) for cause in found.causes}
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


def _limits(found: Found, library: Sequence[Effect]) -> list[Limit]:
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


def _bound(parameter: str) -> float:
    low, high = BOUNDS[parameter]
    return max(abs(low), high)


def _ruled_out(
    found: Found,
    named: Sequence[Effect],
    sets: Sequence[tuple[str, ...]],
    withdrawn: Mapping[str, str],
    library: Sequence[Effect],
) -> list[RuledOut]:
    answered = {effect.name for effect in named} | {name for names in sets for name in names}
    out = []
    for effect in library:
        if effect.name in answered:
            continue
        own = found.tried[effect.name]
        values: tuple[Value, ...] = ()
        if effect in found.causes:
            reason = withdrawn.get(effect.name, "it is not significant beside the other causes")
            values = _values(found, effect)
        elif not own.inside:
            reason = "the fitted value is out of its bounds"
        elif own.z <= Z_EFFECT:
            reason = "it is not significant beside what was found"
        else:
            reason = "it does not reduce the residual of runs left out, or differs from run to run"
        out.append(RuledOut(effect.name, reason, own.z, values))
    return out


def _information_after(problem: Problem, found: Found, named: Sequence[Effect]) -> Information:
    """Return the information around the simulation with the named causes built in."""
    vector = problem.simulation.vector.copy()
    for name, value in zip(found.names, found.change, strict=True):
        if name in names_of(named):
            vector[INDEX[name]] += value
    return problem.at(vector, (), found.info.statistics)


def _residuals(info: Information, start: Information) -> dict[str, Residual]:
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
