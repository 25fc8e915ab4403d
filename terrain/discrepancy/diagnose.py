"""Diagnosis: measured runs and a simulation in, what the simulation gets wrong out.

The order is that in which each step was seen to be needed: the health of the logs and gross regimes first,
one low-pass for everything, whitening, then causes by held-out gain and a statistic clustered by run, a refit
where sensitivities have changed, a swap test against all that could take a cause's place, constancy, and
questions without a name for what is left.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from terrain.discrepancy.clocks import shifts_of
from terrain.discrepancy.health import clocks_of, unfit_runs
from terrain.discrepancy.information import Information, counted_from, moved, rest_beside
from terrain.discrepancy.next_drive import next_drive
from terrain.discrepancy.probes import Answer, ask, drift_of
from terrain.discrepancy.residuals import low_pass_of, measured_channels
from terrain.discrepancy.search import Found, Problem, names_of, search
from terrain.discrepancy.selection import SEEN_SHARE, Z_EFFECT, fitted, gain_interval
from terrain.discrepancy.signals import Signals, signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.verdict import (
    Cause,
    Diagnosis,
    Leftover,
    Limit,
    Residual,
    RuledOut,
    Value,
    Verdict,
)
from terrain.effects import BOUNDS, CHANNELS, INDEX, Effect
from terrain.errors import DataError
from terrain.records import RunLog

MIN_RUNS = 3
"""Fewer runs, and there is nothing left to judge a fit by."""

POWER_Z = 1.28
"""Beyond the threshold, so that nine in ten are seen."""

BLIND_SHARE = 0.05
"""Where so large a share of the library is not excited, finding nothing is no answer."""

DRIFT_SHARE, PROBE_SHARE = 0.05, 0.15
"""A cause whose drift, or a nameless input in its channel, tells that share of what it tells is not it."""

CALMER, CALMER_Z, CALMER_SHARE = 0.5, 3.0, 0.3
"""A cause whose value differs by that many standard deviations and by that share of it, where sensitivities
are taken along inputs of that share of the cut-off, is not it."""

ENTANGLED = 0.97
"""Two causes whose fitted values correlate more are one answer with two names: a collinearity index of 6."""

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
        simulation, or if hardly any fits the others.
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
    answers = ask(at_fit, found.names, found.change)
    drifts = drift_of(at_fit, found.names, found.change)
    leftovers = _leftovers(at_fit, answers)
    withdrawn = _withdrawn(found, drifts, answers) | _unsteady(problem, found)
    named, sets = _sorted_out(found, [cause for cause in found.causes if cause.name not in withdrawn])
    leftovers = _with_drifts(leftovers, found, withdrawn, drifts)
    limits = tuple(_limits(found, problem.library))
    missed = tuple(limit for limit in limits if limit.value > SEEN_SHARE * _bound(limit.name))
    causes = tuple(_cause(found, effect) for effect in named)
    parameters = names_of(named)
    at = [found.names.index(name) for name in parameters]
    grown = np.array([found.tried[effect.name].inflation for effect in named for _ in effect.parameters])
    if sets:
        verdict = Verdict.AMBIGUOUS
    elif causes:
        verdict = Verdict.EXPLAINED
    elif leftovers:
        verdict = Verdict.UNEXPLAINED
    else:
        verdict = Verdict.NOT_EXCITED if len(missed) > BLIND_SHARE * len(limits) else Verdict.NONE
    after = _after(problem, found, named)
    return Diagnosis(
        robot=simulation.robot.name,
        verdict=verdict,
        causes=causes,
        parameters=parameters,
        cov=found.cov[np.ix_(at, at)] * np.sqrt(np.outer(grown, grown)),
        ambiguous_sets=tuple(sets),
        ambiguous_values=_rival_values(found, sets),
        unexplained=leftovers,
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


def _leftovers(info: Information, answers: dict[tuple[str, str], Answer]) -> tuple[Leftover, ...]:
    """Return the clearest input of every channel that follows one."""
    best: dict[str, Leftover] = {}
    size = {c: sum(float((r[:, i] ** 2).sum()) for r in info.white_residual) for i, c in enumerate(CHANNELS)}
    for (channel, name), answer in answers.items():
        if answer.stands and (channel not in best or answer.z > best[channel].z):
            best[channel] = Leftover(channel, name, answer.z, min(answer.gain / size[channel], 1.0))
    return tuple(sorted(best.values(), key=lambda left: -left.z))


def _withdrawn(
    found: Found, drifts: dict[str, Answer], answers: dict[tuple[str, str], Answer]
) -> dict[str, str]:
    """Return the causes that fit and are still not it, by name, and why."""
    why = {}
    for cause in found.causes:
        own = found.tried[cause.name]
        if not own.stands:
            continue
        told = own.z**2
        drift = _drift(drifts, cause)
        main = _channels(found, cause)
        beside = {at: answer for at, answer in answers.items() if at[0] in main and answer.stands}
        most = max(beside, key=lambda at: beside[at].gain, default=None)
        if drift.stands and drift.gain > DRIFT_SHARE * told:
            why[cause.name] = f"it helps, but changes from the start of runs to their end (z {drift.z:.1f})"
        elif most is not None and beside[most].gain > PROBE_SHARE * told:
            why[cause.name] = f"it helps, but {most[0]} follows {most[1]} beside it (z {beside[most].z:.1f})"
    return why


def _unsteady(problem: Problem, found: Found) -> dict[str, str]:
    """Return the causes whose values are others where quick motion is not looked at, by name, and why.

    Both are estimates of one thing, so they agree but for what the calmer one knows less (Hausman,
    Econometrica 1978): where they do not, the cause stands for noise of the wheels that drive the simulation.
    """
    if not found.causes:
        return {}
    calmer = problem._replace(low_pass=problem.low_pass._replace(calm_hz=CALMER * problem.low_pass.calm_hz))
    there = moved(found.info.vector, found.names, found.change)
    info = calmer.at(there, found.names, found.info.noise)
    value, cov = fitted(counted_from(info, problem.simulation.vector), found.names)
    why = {}
    for cause in found.causes:
        at = [found.names.index(p.name) for p in cause.parameters]
        size = found.change[at]
        var = np.maximum(np.diag(cov - found.cov)[at], 0.0) * found.tried[cause.name].inflation
        apart = np.abs(value[at] - size)
        if (apart > np.maximum(CALMER_Z * np.sqrt(var), CALMER_SHARE * np.abs(size))).any():
            why[cause.name] = "it helps, but has another value in slow motion alone: noise of the wheels"
    return why


def _drift(drifts: dict[str, Answer], cause: Effect) -> Answer:
    return max((drifts[p.name] for p in cause.parameters), key=lambda answer: answer.z)


def _sorted_out(found: Found, causes: Sequence[Effect]) -> tuple[list[Effect], list[tuple[str, ...]]]:
    """Return the causes that are named, and the sets of which one is there."""
    named: list[Effect] = []
    sets: list[tuple[str, ...]] = []
    for cause in causes:
        if not found.tried[cause.name].stands:
            continue
        if found.rivals[cause.name]:
            sets.append((cause.name, *_rival_names(found, cause)))
        else:
            named.append(cause)
    for one, other in combinations(causes, 2):
        if (one in named or other in named) and _entangled(found, one, other):
            sets = [names for names in sets if names[0] not in (one.name, other.name)]
            members = (one.name, *_rival_names(found, one), other.name, *_rival_names(found, other))
            sets.append(tuple(dict.fromkeys(members)))
            named = [cause for cause in named if cause not in (one, other)]
    return named, sets


def _rival_names(found: Found, cause: Effect) -> list[str]:
    return [rival.effect.name for rival in found.rivals[cause.name]]


def _entangled(found: Found, one: Effect, other: Effect) -> bool:
    """Return whether two causes that were fitted together can hardly be told apart by these runs."""
    i, j = ([found.names.index(p.name) for p in effect.parameters] for effect in (one, other))
    scale = np.sqrt(np.diag(found.cov))
    correlation = found.cov / np.outer(scale, scale)
    return bool(np.abs(correlation[np.ix_(i, j)]).max() > ENTANGLED)


def _with_drifts(
    leftovers: tuple[Leftover, ...], found: Found, withdrawn: Mapping[str, str], drifts: dict[str, Answer]
) -> tuple[Leftover, ...]:
    """Add the channels of causes that were withdrawn since they drift to what is not explained."""
    channels = {left.channel for left in leftovers}
    more = []
    for cause in found.causes:
        channel, drift = _channels(found, cause)[0], _drift(drifts, cause)
        if cause.name in withdrawn and drift.stands and channel not in channels:
            more.append(Leftover(channel, "time", drift.z, 0.0))
            channels.add(channel)
    return (*leftovers, *more)


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
            free = float(rest_beside(a, base, own)[1][0, 0])
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
    told = {effect.name for effect in named} | {name for names in sets for name in names}
    out = []
    for effect in library:
        if effect.name in told:
            continue
        own = found.tried[effect.name]
        values: tuple[Value, ...] = ()
        if effect in found.causes:
            reason = withdrawn.get(effect.name, "it does not stand beside the others that were found")
            values = _values(found, effect)
        elif not own.inside:
            reason = "the value that would fit is out of its bounds"
        elif own.z <= Z_EFFECT:
            reason = "the runs show nothing of it beside what was found"
        else:
            reason = "it does not help on runs that were left out, or differs from run to run"
        out.append(RuledOut(effect.name, reason, own.z, values))
    return out


def _after(problem: Problem, found: Found, named: Sequence[Effect]) -> Information:
    """Return what the runs say around the simulation with the named causes built in."""
    vector = problem.simulation.vector.copy()
    for name, value in zip(found.names, found.change, strict=True):
        if name in names_of(named):
            vector[INDEX[name]] += value
    return problem.at(vector, (), found.info.noise)


def _residuals(info: Information, start: Information) -> dict[str, Residual]:
    """Return how far measured and simulated are apart, by channel."""
    out = {}
    for channel in measured_channels(info.rows):
        c = CHANNELS.index(channel)
        left = np.concatenate([run.residual[:, c] for run in info.rows])
        rms = float(np.sqrt(np.nanmean(left**2)))
        noise = float(start.noise.std[c])
        share = max(1.0 - (noise / rms) ** 2, 0.0) if rms > 0 else 0.0
        out[channel] = Residual(rms, noise, share)
    return out
