"""Why causes that reduce the residual are withdrawn all the same: a reason a rule, with its numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.constancy import Constancy, constancy_of
from terrain.discrepancy.evidence import fit_change, move_point, partial_information
from terrain.discrepancy.probes import ProbeResult
from terrain.discrepancy.search import CauseFit, Problem
from terrain.discrepancy.selection import fits_without_each
from terrain.effects import BOUNDS, CHANNELS, Effect
from terrain.records import Array

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
