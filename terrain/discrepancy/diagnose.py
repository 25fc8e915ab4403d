"""Diagnosis: measured runs and a simulation in, what the simulation gets wrong out.

The order is that in which each step was seen to be needed: the health of the logs and gross regimes first,
one low-pass for everything, whitening, then causes by held-out gain and a statistic clustered by run, a refit
where sensitivities have changed, a swap test against all effects that could replace a cause, constancy, and
probes of the remaining residual.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from terrain.discrepancy import constancy, verdict
from terrain.discrepancy.clocks import latencies_of, shifts_of
from terrain.discrepancy.earned import MIN_RUNS, OUTWEIGHS, HeldOut, Judgement, crossed_runs, judge
from terrain.discrepancy.evidence import (
    EXCITED_RATIO,
    Z_EFFECT,
    Evidence,
    WaldTest,
    move_point,
    partial_information,
)
from terrain.discrepancy.gain import THIRDS, earned
from terrain.discrepancy.health.fault import Fault, repaired
from terrain.discrepancy.health.faults import faults_of
from terrain.discrepancy.health.unfit import Clock, clocks_of, unfit_runs
from terrain.discrepancy.next_drive import MOST, next_drive
from terrain.discrepancy.probes import TILT_INPUTS, ProbeResult, probe_residuals
from terrain.discrepancy.robot_terms import UNITS, in_robot_terms, quantity
from terrain.discrepancy.runs import (
    UNLIKE,
    Excluded,
    Signals,
    Simulation,
    low_pass_of,
    measured_channels,
    rows_of,
    signals_of,
)
from terrain.discrepancy.search import (
    RIVAL_LOSS,
    CauseFit,
    Problem,
    fit_again,
    names_of,
    pooled,
    refit,
    rivals_of,
    search,
    search_on,
)
from terrain.discrepancy.verdict import Tier
from terrain.effects import BOUNDS, CHANNELS, Effect, effect_named
from terrain.errors import DataError
from terrain.records import Array, RunLog

BLIND_RATIO = 0.05
"""Ratio of the parameters that may not be shown before a diagnosis without findings is ``not_shown``."""

Z_CANDIDATE = 3.5
"""Evidence below the threshold that makes an effect a candidate: 5e-4, one in a hundred of a library of 26."""

MAX_UNLIKE = 5  #: Most runs that are unlike the others for which it is asked what they are unlike in

MAX_WITHDRAWN = 6  #: Most causes that are withdrawn one after the other

ENTANGLED = 0.97
"""Correlation of fitted values above which two causes are ambiguous: a collinearity index of 6."""

LITTLE_LEFT = 0.05
"""Part of the square of a channel that a withdrawn cause makes, or that the black-box learner removes at the lower end
of its interval, before something is unexplained: less would not change what the simulation is good for."""

POWER_Z = 1.28  #: Added to the threshold, so that nine in ten are detected

MOST_RIVALS = 3  #: Candidates for one channel that a next drive is designed for

REST_MPS = 0.02  #: Fastest that a wheel turns, by its sensor's noise, in a run that does not drive


class Found(NamedTuple):
    """What was found in runs, before it is judged."""

    problem: Problem
    start: Evidence  #: of the simulation as it is given
    fit: CauseFit
    withdrawn: Mapping[str, verdict.Cause]  #: candidates, by name
    varying: tuple[verdict.Varying, ...]
    excluded: tuple[Excluded, ...]
    faults: tuple[Fault, ...]
    clocks: tuple[Clock, ...]

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of the noise by channel that was measured."""
        measured = measured_channels(self.start.rows)
        return {name: float(self.start.noise.std[CHANNELS.index(name)]) for name in measured}

    @property
    def answers(self) -> tuple[list[Effect], list[tuple[str, ...]]]:
        """The effects that may be named, and sets of which one is present, the one that is fitted first."""
        fit = self.fit
        members = {cause.name: (cause.name, *fit.rivals[cause.name]) for cause in fit.causes}
        significant = [cause for cause in fit.causes if fit.tests[cause.name].significant]
        named = [cause for cause in significant if not fit.rivals[cause.name]]
        sets = [members[cause.name] for cause in significant if fit.rivals[cause.name]]
        std = np.sqrt(np.diag(fit.cov))
        for one, other in combinations(fit.causes, 2):
            i, j = fit.at(one), fit.at(other)
            entangled = np.abs(fit.cov[np.ix_(i, j)]) > ENTANGLED * np.outer(std[i], std[j])
            if (one in named or other in named) and entangled.any():
                sets = [names for names in sets if names[0] not in (one.name, other.name)]
                sets.append(tuple(dict.fromkeys((*members[one.name], *members[other.name]))))
                named = [cause for cause in named if cause not in (one, other)]
        return named, sets

    @property
    def built_in(self) -> list[Effect]:
        """The effects that extend the simulation: those named, and of each set those that are fitted."""
        named, sets = self.answers
        of_sets = {name for names in sets for name in names}
        return [cause for cause in self.fit.causes if cause in named or cause.name in of_sets]

    @property
    def extended(self) -> Simulation:
        """The simulation with these built in."""
        fit = self.fit
        names = names_of(self.built_in)
        return self.problem.simulation.with_effects({n: float(fit.change[fit.names.index(n)]) for n in names})


def diagnose(
    runs: Sequence[RunLog],
    simulation: Simulation,
    library: Sequence[Effect] | None = None,
    signals: Sequence[Signals] | None = None,
    seed: int = 0,
) -> verdict.Diagnosis:
    """Return what a simulation gets wrong about measured runs, judged by leaving parts of them out in turn.

    Takes and raises what :func:`find_causes` does; the ``seed`` is of the parts and of the bootstrap.
    """
    found = find_causes(runs, simulation, library, signals)
    problem = found.problem
    on = crossed_runs(problem.signals, problem.simulation, problem.low_pass, found.noise, seed)
    return statement_of(*judged(found, on))


def find_causes(
    runs: Sequence[RunLog],
    simulation: Simulation,
    library: Sequence[Effect] | None = None,
    signals: Sequence[Signals] | None = None,
) -> Found:
    """Return what reduces the residual of measured runs, and what speaks against it.

    Parameters
    ----------
    runs : of the simulation's robot, three at the least
    simulation : under test, with the effects that are built in already
    library : effects that may be named; all that apply to the robot by default
    signals : of the runs on one clock each, where they are known already

    Raises
    ------
    DataError
        if runs are of another robot, too few, of one id, or too short, or have no channel in common with the
        simulation, if too few are consistent with each other, or if their clocks are further apart than is searched.
    """
    check_ids(runs)
    if len(runs) < MIN_RUNS:
        raise DataError(f"runs: there are {len(runs)}, at least {MIN_RUNS} are required, to hold some out")
    if signals is None:
        signals = [replace(signals_of(run, simulation.robot), place=float(k)) for k, run in enumerate(runs)]
    effects = simulation.library if library is None else tuple(library)

    # faults are repaired, lags that a search has to start from are known, and unfit runs are excluded
    low_pass, known = low_pass_of(signals), names_of(effects)
    plain = [
        rows_of(run, simulation.planar_on(run.terrain), simulation.vector, (), low_pass) for run in signals
    ]
    latencies = latencies_of(signals, simulation)
    faults = faults_of(signals, plain, simulation, low_pass, latencies)
    fit_runs, checked = repaired(signals, faults), False
    excluded: tuple[Excluded, ...] = ()
    if faults:
        latencies = latencies_of(fit_runs, simulation)
    while True:
        prepared = Problem(fit_runs, simulation, low_pass, effects)
        seeds = {name: value for name, value in latencies.starting_values.items() if name in known}
        aligned = prepared.at(move_point(simulation.vector, [*seeds], [*seeds.values()]))
        shift = shifts_of(aligned)
        if checked or not (excluded := unfit_runs(fit_runs, aligned, shift)):
            break
        unfit, checked = {run.run_id for run in excluded}, True
        fit_runs = tuple([run for run in fit_runs if run.run_id not in unfit])
        if len(fit_runs) < MIN_RUNS:
            why = "; ".join([f"{run.run_id}: {run.reason}" for run in excluded[:3]])
            raise DataError(f"runs: only {len(fit_runs)} of {len(signals)} are fit to be compared ({why})")
        latencies = latencies_of(fit_runs, simulation)
    if not any(np.nanmax(np.abs(run.wheel_speed_mps), initial=0.0) > REST_MPS for run in fit_runs):
        raise DataError(f"runs: in all {len(fit_runs)} the wheels are at rest; runs that drive are required")

    # causes, their values and what they leave, without runs of which one value is unlike that of all others
    while True:
        problem = constancy.with_conditions(prepared, aligned)
        start = aligned if problem is prepared and not seeds else problem.at(simulation.vector)
        withdrawn: dict[str, verdict.Cause] = {}
        fit = _withdraw_wrong(problem, search(problem, start, seeds), withdrawn)
        varying = constancy.varying_effects(problem, fit)
        rogue = constancy.rogue_run(varying)
        if rogue is None or len(prepared.signals) <= MIN_RUNS:
            break
        excluded = (*excluded, rogue)
        rest = tuple([run for run in prepared.signals if run.run_id != rogue.run_id])
        prepared = prepared._replace(signals=rest)
        aligned = prepared.at(aligned.origin)
        shift = shifts_of(aligned)
    varies = {name for effect in varying for name in (effect.name, *effect.rivals)}
    others = [cause for cause in fit.causes if cause.name not in varies]
    if varying and varying[0].parameter not in problem.scatter and others:
        # what one value of all runs leaves of an effect that varies may look like causes: each run has its own
        problem = problem._replace(varying={varying[0].parameter: varying[0].scatter})
        again = list(dict.fromkeys([*fit.causes, effect_named(varying[0].name)]))
        info = problem.at(fit.info.origin).counted_from(start.vector)
        fit = _withdraw_wrong(problem, refit(problem, info, again), withdrawn)
    fit = _withdraw_varying(problem, fit, varies, withdrawn)
    fit = _likeliest(problem, fit, start, withdrawn)
    by_id = {run.run_id: run for run in repaired(signals, faults)}
    unlike = [by_id[run.run_id] for run in excluded if run.reason.startswith(UNLIKE)][:MAX_UNLIKE]
    named_in = {run.run_id: constancy.rogues_among(problem, fit, [run]) for run in unlike}
    excluded = tuple([(*named_in.get(run.run_id, ()), run)[0] for run in excluded])
    return Found(problem, start, fit, withdrawn, varying, excluded, faults, clocks_of(aligned, shift))


def check_ids(runs: Sequence[RunLog]) -> None:
    """Raise a DataError where two runs have one id."""
    ids = Counter([run.run_id for run in runs])
    if twice := [run_id for run_id, n in ids.items() if n > 1]:
        raise DataError(f"runs: {twice[0]!r} is the id of {ids[twice[0]]} runs; each needs its own")


def judged(found: Found, on: HeldOut) -> tuple[Found, Judgement]:
    """Return what was found without what did not earn its name on data held out, and how the rest was judged.

    One is withdrawn at a time, the one that removes least, and the others are fitted anew.
    """
    while True:
        judgement = judge(found.fit, found.built_in, on)
        if not judgement.reasons:
            return found, judgement
        doubtful = [cause for cause in found.fit.causes if cause.name in judgement.reasons]
        worst = min(doubtful, key=lambda cause: judgement.removed[cause.name][0])
        problem, withdrawn = found.problem, dict(found.withdrawn)
        fit = _withdraw(problem, found.fit, worst, judgement.reasons[worst.name], withdrawn)
        removed, interval = judgement.removed[worst.name]
        withdrawn[worst.name] = withdrawn[worst.name]._replace(held_out_gain=removed, gain_ci=interval)
        fit = _withdraw_wrong(problem, fit, withdrawn)
        fit = _likeliest(problem, fit, found.start, withdrawn)
        found = found._replace(fit=fit, withdrawn=withdrawn)


def statement_of(found: Found, judgement: Judgement) -> verdict.Diagnosis:
    """Return what is stated of what was found."""
    problem, start, fit, withdrawn, varying, excluded, faults, clocks = found
    effects, varies = problem.library, {name for own in varying for name in (own.name, *own.rivals)}

    # channels that depend on an input, the most significant of each, or on a cause that was withdrawn
    best: dict[str, verdict.Unexplained] = {}
    power = sum([(left**2).sum(axis=0) for left in fit.info.residuals(fit.info.away)])
    for (channel, name), probe in _probes(problem, fit).items():
        if probe.significant and (channel not in best or probe.z > best[channel].z):
            ratio = min(probe.gain / float(power[CHANNELS.index(channel)]), 1.0)
            best[channel] = verdict.Unexplained(channel, name, probe.z, ratio)
    for out in withdrawn.values():
        # where it shows most while the causes are fitted with it: a wheel radius beside an effective track shows in
        # the speed alone, as the track takes what it does to the yaw rate
        own, base = _own_and_base(fit, effect_named(out.name))
        weights = np.eye(len(fit.info.names))[own]
        weights[:, base] = -partial_information(fit.info.a.sum(axis=0), base, own)[0].T
        c = int(np.argmax(fit.info.channel_power(weights)))
        changed = fit.info.channel_power(fit.tests[out.name].change[None] @ weights)
        channel, ratio = CHANNELS[c], min(float(changed[c] / power[c]), 1.0)
        unconfirmed = out.gain_ci[0] <= 0.0  # on data held out, where it was judged on these
        if channel in best or out.name in varies or ratio < LITTLE_LEFT or unconfirmed:
            continue
        if fit.tests[out.name].z > Z_EFFECT:
            best[channel] = verdict.Unexplained(channel, out.name, out.z, ratio)
    unexplained = tuple(sorted(best.values(), key=lambda left: -left.z))

    named, sets = found.answers
    built = found.built_in
    values = {cause.name: values_of(fit, cause) for cause in fit.causes}
    for rivals in fit.rivals.values():
        for name, (change, error, *_) in rivals.items():
            values.setdefault(name, _values(effect_named(name), change, error))
    parameters = names_of(built)
    at = [fit.names.index(name) for name in parameters]
    inflation = np.array([fit.tests[effect.name].inflation for effect in built for _ in effect.parameters])
    cov = fit.cov[np.ix_(at, at)] * np.sqrt(np.outer(inflation, inflation))

    stated = []
    for effect in built:
        removed, interval = judgement.removed[effect.name]
        cause = cause_of(problem, fit, effect)._replace(held_out_gain=removed, gain_ci=interval)
        stated.append(cause._replace(tier=Tier.NAMED if effect in named else Tier.SET))

    # what could not have been detected beside it, and what is not the answer
    limits, a = [], fit.info.a.sum(axis=0)
    for effect in effects:
        base = fit.info.places([name for name in fit.names if name not in names_of([effect])])
        for parameter in effect.parameters:
            (k,) = fit.info.places([parameter.name])
            free = float(partial_information(a, base, [k])[1][0, 0])
            shown = free > 1e-9 * max(a[k, k], 1e-12)
            limit = (Z_EFFECT + POWER_Z) / float(np.sqrt(free)) if shown else np.inf
            limits.append(verdict.Limit(parameter.name, limit, parameter.unit, effect.needs))
    missed = [
        limit
        for limit in limits
        if limit.detection_limit > EXCITED_RATIO * MOST[limit.name] and limit.name not in parameters
    ]
    ruled_out, candidates = [], [*withdrawn.values()]
    answered = {*[effect.name for effect in named], *[name for names in sets for name in names], *withdrawn}
    for effect in effects:
        test = fit.tests[effect.name]
        if effect.name in answered:
            continue
        if effect in fit.causes:
            reason = "it is not significant beside the other causes"
        elif not test.inside:
            reason = "the fitted value is out of its bounds"
        elif test.z <= Z_EFFECT:
            reason = "it is not significant beside what was found"
        else:
            reason = "it does not reduce the residual of runs left out, or differs from run to run"
        suggests = test.inside and test.z > Z_CANDIDATE and test.gain_interval[0] > 0
        if effect in fit.causes or suggests:
            candidates.append(cause_of(problem, fit, effect, reason))
        else:
            ruled_out.append(verdict.RuledOut(effect.name, reason, test.z))
    candidates.sort(key=lambda cause: -cause.z)
    causes = tuple(cause for cause in stated if cause.tier is Tier.NAMED)
    of_sets = tuple(cause for cause in stated if cause.tier is Tier.SET)
    missing = {limit.name for limit in missed}
    # what one run has in common in itself is no cause
    channels, shows = [], judgement.gain.clusters != THIRDS
    for name, of in judgement.gain.channels.items():
        acting = [cause for cause in stated if name in judgement.acting[cause.name]]
        hidden = [p for effect in effects if name in effect.channels[:1] for p in effect.parameters]
        tiers = {
            Tier.NAMED: earned(of) and any(cause in causes for cause in acting),
            Tier.SET: earned(of) and any(cause in of_sets for cause in acting),
            Tier.CANDIDATE: any(name in cause.channels for cause in candidates)
            or any(own.channel == name for own in varying),
            Tier.UNEXPLAINED: any(left.channel == name for left in unexplained)
            or (shows and (of.left_ci if stated else of.learner_ci)[0] > LITTLE_LEFT),
            Tier.NOT_SHOWN: sum(p.name in missing for p in hidden) > BLIND_RATIO * len(hidden),
        }
        tier = next((tier for tier, holds in tiers.items() if holds), None)
        names = tuple(cause.name for cause in acting)
        channels.append(verdict.ChannelVerdict(name, tier, names, *of))
    whole = earned(judgement.gain)
    tiers = {
        Tier.NAMED: bool(causes) and whole,
        Tier.SET: bool(of_sets) and whole,
        Tier.CANDIDATE: bool(candidates or varying) and not stated,
        Tier.UNEXPLAINED: bool(stated or unexplained) or any(c.tier is Tier.UNEXPLAINED for c in channels),
        Tier.NOT_SHOWN: len(missed) > BLIND_RATIO * len(limits),
    }
    after = problem.at(found.extended.vector, (), noise=fit.info.noise, scatter=fit.info.scatter)
    return verdict.Diagnosis(
        robot=problem.simulation.robot.name,
        verdict=next((tier for tier, holds in tiers.items() if holds), None),
        causes=causes,
        of_sets=of_sets,
        covariance=verdict.Covariance(parameters, cov),
        ambiguous_sets=tuple(sets),
        ambiguous_values={name: values[name] for names in sets for name in names},
        unexplained=unexplained,
        detection_limits=tuple(limits),
        not_shown=tuple(missed),
        ruled_out=tuple(ruled_out),
        excluded_runs=excluded,
        clocks=clocks,
        next_drive=next_drive(problem.simulation, sets or _rival_candidates(candidates), missed, fit.info),
        residual_before=residuals_of(start, start),
        residual_after=residuals_of(after, start),
        n_runs=len(problem.signals),
        varying=varying,
        faults=faults,
        by_session=constancy.values_by_session(fit, problem.signals, built, problem.simulation.robot),
        candidates=tuple(candidates),
        channels=tuple(channels),
        gain=judgement.gain,
    )


def _rival_candidates(candidates: Sequence[verdict.Cause]) -> list[tuple[str, ...]]:
    """Return candidates for the same channel, a few of the strongest of each: what a next drive may decide between."""
    of_channel: dict[str, list[str]] = {}
    for cause in candidates:
        for channel in cause.channels[:1]:
            of_channel.setdefault(channel, []).append(cause.name)
    return [tuple(names[:MOST_RIVALS]) for names in of_channel.values() if len(names) > 1]


def _withdraw_wrong(problem: Problem, fit: CauseFit, withdrawn: dict[str, verdict.Cause]) -> CauseFit:
    """Return the causes that may be named; those that were withdrawn are noted by name.

    Those of a size that is not plausible go first.  Of others one is withdrawn at a time, the one that gains least, and
    the rest are fitted anew: a wrong cause distorts the others, and their reasons go with it.  Effects whose place it
    took come in if they fit as well.
    """
    for _ in range(MAX_WITHDRAWN):
        reasons = {cause.name: why for cause in fit.causes if (why := _beyond_belief(problem, fit, cause))}
        first = max if reasons else min
        reasons = reasons or reasons_to_withdraw(problem, fit, _probes(problem, fit))
        if not reasons:
            break
        doubtful = [cause for cause in fit.causes if cause.name in reasons]
        worst = first(doubtful, key=lambda cause: raw_gain(fit, cause))
        left = _withdraw(problem, fit, worst, reasons[worst.name], withdrawn)
        came = [e.name for e in problem.candidates if _took_the_place(fit.tests[e.name], left.tests[e.name])]
        if came:
            barred = frozenset({effect.name for effect in problem.library} - {*came} | {*withdrawn})
            more = search_on(problem._replace(barred=barred), left.info, left.causes)
            with_it, without = (fit_again(problem, fit.info, each.names)[0] for each in (fit, more))
            if without - with_it < RIVAL_LOSS * fit.tests[worst.name].inflation:
                left = more
        fit = left
    return fit


def _took_the_place(beside: WaldTest, without: WaldTest) -> bool:
    """Return whether an effect is significant without a cause, beside which it had less than half of its gain."""
    return without.significant and float(beside.gain.sum()) < 0.5 * float(without.gain.sum())


def _withdraw_varying(
    problem: Problem, fit: CauseFit, varies: set[str], withdrawn: dict[str, verdict.Cause]
) -> CauseFit:
    """Withdraw the causes whose value differs so much from run to run that it is none."""
    for cause in fit.causes:
        if cause.name not in varies or cause not in fit.causes:  # it may have left with one before it
            continue
        k = max(fit.at(cause), key=lambda k: abs(fit.change[k]))
        value, scatter = abs(fit.change[k]), constancy.run_scatter(problem, fit, fit.names[k])
        if scatter > constancy.VARIES_RATIO * value:
            reason = f"its value differs from run to run, by {scatter:.3g} about a size of {value:.3g}"
            fit = _withdraw(problem, fit, cause, reason, withdrawn)
    return fit


def _withdraw(
    problem: Problem, fit: CauseFit, cause: Effect, reason: str, withdrawn: dict[str, verdict.Cause]
) -> CauseFit:
    """Note why a cause is withdrawn, and return the others, fitted without it."""
    withdrawn[cause.name] = cause_of(problem, fit, cause, reason)
    others = [other for other in fit.causes if other is not cause and other.modifies != cause.name]
    return refit(problem, fit.info, others)._replace(pairs=fit.pairs)


def _likeliest(
    problem: Problem, fit: CauseFit, start: Evidence, withdrawn: Mapping[str, verdict.Cause]
) -> CauseFit:
    """Return the causes with their rivals, of each set the member of greatest posterior by evidence and size.

    What the evidence hardly distinguishes the plausible sizes may: a wheel radius 10 % off is stranger than wheels that
    slip by 10 %.  A member that something speaks against in the place of the cause does not take it.
    """
    fit, tried = fit._replace(rivals=rivals_of(problem, fit.info, start, fit.causes)), {*withdrawn}
    tried |= {cause.name for cause in fit.causes}
    while True:
        ahead = [
            (rival.behind, name, cause)
            for cause in fit.causes
            for name, rival in fit.rivals[cause.name].items()
            if rival.behind < 0.0 and name not in tried
        ]
        if not ahead:
            return pooled(problem, fit)
        _, name, cause = min(ahead, key=lambda swap: swap[0])
        tried.add(name)
        swapped = [effect_named(name) if own is cause else own for own in fit.causes]
        other = refit(problem, fit.info, swapped)
        if len(other.causes) == len(swapped) and not (
            {*reasons_to_withdraw(problem, other, _probes(problem, other))}
            - {*reasons_to_withdraw(problem, fit, _probes(problem, fit))}
        ):
            fit = other._replace(pairs=fit.pairs, rivals=rivals_of(problem, other.info, start, other.causes))


def _probes(problem: Problem, fit: CauseFit) -> dict[tuple[str, str], ProbeResult]:
    """Return the probes of the residual, those of a tilt that is only in part a slope left out."""
    results = probe_residuals(fit.info, fit.names, fit.change, problem.simulation.probe_error)
    simulation = problem.simulation
    grounds = [simulation.grounds.get(run.terrain, simulation.ground) for run in problem.signals]
    if all(ground.effective_ratio >= 1.0 for ground in grounds):
        return results
    return {at: probe for at, probe in results.items() if at[1] not in TILT_INPUTS}


# -- Why causes that reduce the residual are withdrawn all the same: a reason a rule, with its numbers ------

NEAR_BOUND = 0.02
"""A value closer to a bound than that ratio of the range, or of twice the bound where the other is further
from 0, is no value: the search would have gone on."""

WORSE_RATIO = 1.1
"""A cause is withdrawn that makes the square of a channel larger by more than that, if what it changes there itself
can make half of the rise: the rest is of the causes that were fitted with it.  What it removes from other channels may
outweigh that, as on data held out (:data:`terrain.discrepancy.earned.OUTWEIGHS`)."""

PROBE_RATIO, PROBE_ALIKE = 0.5, 0.3
"""A cause is withdrawn if an input of its channel gains that ratio of its own gain beside it, and looks like
it: a correlation below the second says that the two are different matters."""

SLOW_CUTOFF_RATIO, SLOW_Z, SLOW_RATIO = 0.5, 3.0, 0.3
"""A cause is withdrawn if its value is smaller by so many standard deviations and by that ratio, where
sensitivities are computed along instruments of that ratio of the cut-off."""


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
    return tuple([CHANNELS[i] for i in order if power[i] > 0.1 * power[order[0]]])


def raw_gain(fit: CauseFit, cause: Effect) -> float:
    """Return by how much a cause reduces minus twice the log-likelihood, the others refitted.

    It is on the scale of the gain of a probe, without the scatter between runs, which ``z`` has in it.
    """
    own, base = _own_and_base(fit, cause)
    change = fit.change[fit.at(cause)]
    return float(change @ partial_information(fit.info.a.sum(axis=0), base, own)[1] @ change)


def constancy_of_cause(fit: CauseFit, cause: Effect) -> constancy.Constancy:
    """Return the values of a cause in parts of the data."""
    own, inflation = [p.name for p in cause.parameters], fit.tests[cause.name].inflation
    return constancy.constancy_of(fit.info, fit.names, own, fit.change, inflation)


def reasons_to_withdraw(
    problem: Problem, fit: CauseFit, probes: Mapping[tuple[str, str], ProbeResult]
) -> dict[str, str]:
    """Return, by name, why significant causes are withdrawn; empty where all of them may be named.

    Where the instruments are filtered more, values agree up to the larger variance of these (Hausman, Econometrica
    1978); where such a value is smaller, the cause fits noise of the wheel speeds, which goes with it.
    """
    significant = [cause for cause in fit.causes if fit.tests[cause.name].significant]
    if not significant:
        return {}
    cutoff_hz = SLOW_CUTOFF_RATIO * problem.low_pass.instrument_cutoff_hz
    slower = problem._replace(low_pass=problem.low_pass._replace(instrument_cutoff_hz=cutoff_hz))
    point, about = move_point(fit.info.vector, fit.names, fit.change), (fit.info.noise, fit.info.scatter)
    info = slower.at(point, fit.names, noise=about[0], scatter=about[1]).counted_from(fit.info.vector)
    slow, slow_cov = info.fit(fit.names)
    reasons = {}
    for cause in significant:
        constant, at, main = constancy_of_cause(fit, cause), fit.at(cause), shown_channels(fit, cause)
        reason = _at_bound(problem, fit, cause) or (constant.caveat if constant.varies else "")
        if not reason:
            # an input that explains much of its main channels beside it
            gain = PROBE_RATIO * raw_gain(fit, cause)
            for (channel, name), probe in probes.items():
                alike = [probe.alike[p.name] for p in cause.parameters if p.name in probe.alike]
                beside = channel in main and probe.significant and max(alike, default=1.0) > PROBE_ALIKE
                if beside and probe.gain > gain:
                    reason, gain = f"{channel} depends on {name} beside it (z {probe.z:.1f})", probe.gain
        if not reason:
            effects = channel_effects(fit, cause)
            if not effects[main[0]][2] > 0:
                reason = f"it gains nothing in {main[0]}, its main channel, on runs left out"
            weights = np.zeros((1, len(fit.info.names)))
            weights[0, _own_and_base(fit, cause)[0]] = fit.change[at]
            acts = dict(zip(CHANNELS, fit.info.channel_power(weights).tolist(), strict=True))
            net = sum([without - with_cause for without, with_cause, _ in effects.values()])
            for name, (without, with_cause, _) in reversed(effects.items()):
                most, rise = acts[name] + 2.0 * math.sqrt(acts[name] * without), with_cause - without
                outweighed = net + rise > OUTWEIGHS * rise
                if with_cause > WORSE_RATIO * without and most > 0.5 * rise and not outweighed:
                    reason = f"it makes {name} worse, by {with_cause / without - 1.0:.0%} of the square"
        size, var = fit.change[at], np.maximum(np.diag(slow_cov - fit.cov)[at], 0.0)
        least = SLOW_Z * np.sqrt(var * fit.tests[cause.name].inflation), SLOW_RATIO * np.linalg.norm(size)
        if not reason and ((size - slow[at]) * np.sign(size) > np.maximum(*least)).any():
            reason = "has a smaller value in slow motion: it fits noise of the wheel speeds"
        if reason:
            reasons[cause.name] = f"it reduces the residual, but {reason}"
    return reasons


def _beyond_belief(problem: Problem, fit: CauseFit, cause: Effect) -> str:
    """Return why a cause is larger than a builder would believe, empty where its interval reaches that range."""
    robot, values = problem.simulation.robot, values_of(fit, cause)
    for p, value in zip(cause.parameters, values, strict=True):
        given = problem.simulation.effects.get(p.name, 0.0)
        if not p.is_plausible(given + value.low, given + value.high):
            low, high = (quantity(p.name, end) for end in p.plausible)
            return (
                f"something that is missing acts like {in_robot_terms(cause.name, values, robot)}, and is not that: "
                f"{p.label} {low} to {high} is plausible ({p.plausible_source})"
            )
    return ""


def _at_bound(problem: Problem, fit: CauseFit, cause: Effect) -> str:
    for p in cause.parameters:
        low, high = BOUNDS[p.name]
        value = problem.simulation.effects.get(p.name, 0.0) + float(fit.change[fit.names.index(p.name)])
        above, below = [NEAR_BOUND * min(high - low, 2.0 * abs(bound)) for bound in (high, low)]
        if value > high - above or (low < 0.0 and value < low + below):
            return f"{p.label} ends at the bound of what it may be ({value:.3g} {p.unit})"
    return ""


def channel_effects(fit: CauseFit, cause: Effect) -> dict[str, tuple[float, float, float]]:
    """Return what a cause does to each channel: whitened squares without and with it, and the held-out gain.

    What varies from run to run is taken out of each run as its residual shows it, but not the cause's own
    variation, which would take its place.  What that variation costs by its assumed size counts in the
    channels where it shows: in runs of one motion each it would else be a cause of any kind for nothing.
    """
    info, (own, base) = fit.info, _own_and_base(fit, cause)
    beside = ~np.isin(info.nuisances, own)
    free, precision = info.nuisances[beside], np.diag(1.0 / info.nuisance_std[beside] ** 2)
    squares = np.zeros((2, 2, len(CHANNELS)))  # without and with the cause, by all runs and by the others
    for m, places in enumerate((base, info.places(fit.names))):
        common = info.fit([info.names[i] for i in places])[0]
        held_out = info.fits_without_each(places)
        for i, white in enumerate(info.white):
            random = white[free]
            flat = random.reshape(free.size, white[-1].size)
            inner = np.linalg.inv(flat @ flat.T + precision)
            shown = (random**2).sum(axis=1)
            cost = precision @ (shown / np.maximum(shown.sum(axis=1, keepdims=True), 1e-30))
            for kind, x in enumerate((common, held_out[i])):
                left = white[-1] - np.tensordot(x, white[places], axes=1)
                deviation = inner @ (flat @ left.ravel())
                left -= np.tensordot(deviation, random, axes=1)
                squares[m, kind] += (left**2).sum(axis=0) + deviation**2 @ cost
    (without, without_held), (with_cause, with_held) = squares
    of_channels = zip(CHANNELS, without, with_cause, without_held - with_held, strict=True)
    return {name: (a, b, gain) for name, a, b, gain in of_channels if b > 0}


# -- What a diagnosis states of what was found ---------------------------------------------------------------


def cause_of(problem: Problem, fit: CauseFit, effect: Effect, reason: str = "") -> verdict.Cause:
    """Return a cause, named or, where a reason speaks against that, a candidate; one not fitted by its linear fit."""
    test, caveats = fit.tests[effect.name], []
    if effect in fit.causes:
        values, parameter = values_of(fit, effect), effect.parameters[0]
        caveat = constancy_of_cause(fit, effect).caveat
        caveats = [caveat] if caveat else []
        if effect.name in fit.pairs:
            caveats.append(f"{' with '.join(fit.pairs[effect.name])} does little more in its place")
        scatter = constancy.run_scatter(problem, fit, parameter.name)
        value = float(fit.change[fit.names.index(parameter.name)])
        if len(effect.parameters) == 1 and scatter > constancy.CAVEAT_RATIO * abs(value):
            unit = UNITS.get(parameter.unit, parameter.unit)
            caveats.append(f"it differs from run to run by {scatter:.2g} {unit}".strip())
    else:
        own, base = _own_and_base(fit, effect)
        free = partial_information(fit.info.a.sum(axis=0), base, own)[1]
        values = _values(effect, test.change, np.sqrt(np.diag(np.linalg.pinv(free)) * test.inflation))
    return verdict.Cause(
        name=effect.name,
        aliases=effect.aliases,
        parameters=values,
        held_out_gain=math.nan,
        gain_ci=(math.nan, math.nan),
        channels=shown_channels(fit, effect),
        z=test.z,
        dispersion=test.dispersion,
        caveat="; ".join(caveats),
        tier=Tier.CANDIDATE if reason else Tier.NAMED,
        reason=reason,
    )


def values_of(fit: CauseFit, effect: Effect) -> tuple[verdict.Value, ...]:
    """Return the fitted values of a cause; intervals reach to its values beside each member of another set."""
    at, values = fit.at(effect), []
    rivals = [rival for of, each in fit.rivals.items() if of != effect.name for rival in each.values()]
    for own in _values(effect, fit.change[at], np.sqrt(fit.cov[at, at] * fit.tests[effect.name].inflation)):
        half = own.high - own.value
        beside = [own.value, *[rival.others[own.name] for rival in rivals if own.name in rival.others]]
        values.append(own._replace(low=min(beside) - half, high=max(beside) + half))
    return tuple(values)


def _values(effect: Effect, change: Array, std: Array) -> tuple[verdict.Value, ...]:
    numbers = zip(effect.parameters, change.tolist(), (verdict.INTERVAL_T * std).tolist(), strict=True)
    return tuple([verdict.Value(p.name, x, p.unit, x - half, x + half) for p, x, half in numbers])


def residuals_of(info: Evidence, start: Evidence) -> dict[str, verdict.Residual]:
    """Return how far measured and simulated are apart, by channel."""
    out = {}
    for channel in measured_channels(info.rows):
        c = CHANNELS.index(channel)
        rms = float(np.sqrt(np.nanmean(np.concatenate([run.residual[:, c] for run in info.rows]) ** 2)))
        noise = float(start.noise.std[c])
        systematic = max(1.0 - (noise / rms) ** 2, 0.0) if rms > 0 else 0.0
        out[channel] = verdict.Residual(rms, noise, systematic)
    return out
