"""Why causes that reduce the residual are withdrawn all the same: a reason a rule, with its numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.constancy import Constancy, constancy_of
from terrain.discrepancy.evidence import move_point, partial_information, recentre
from terrain.discrepancy.probes import ProbeResult
from terrain.discrepancy.search import Found, Problem
from terrain.discrepancy.selection import fit_change, fits_without_each
from terrain.effects import BOUNDS, CHANNELS, Effect
from terrain.records import Array

NEAR_BOUND = 0.02
"""A value closer to a bound than that ratio of the range, or of twice the bound where the other is further
from 0, is no value: the search would have gone on."""

WORSE_RATIO = 1.1
"""A cause is withdrawn that makes the square of a channel larger by more than that."""

PROBE_RATIO, PROBE_ALIKE = 0.5, 0.3
"""A cause is withdrawn if a nameless input of its channel gains that ratio of its own gain beside it, and
looks like it: a correlation below the second says that the two are different matters."""

SLOW_CUTOFF_RATIO, SLOW_Z, SLOW_RATIO = 0.5, 3.0, 0.3
"""A cause is withdrawn if its value is smaller by so many standard deviations and by that ratio, where
sensitivities are computed along instruments of that ratio of the cut-off."""


class ChannelEffect(NamedTuple):
    """What a cause does to one channel: whitened squares without and with it, and the held-out gain."""

    without: float
    with_cause: float
    held_out_gain: float


def shown_channels(found: Found, cause: Effect) -> tuple[str, ...]:
    """Return the channels in which a cause shows, the clearest first."""
    info = found.info
    at = info.places([p.name for p in cause.parameters])
    own = found.tried[cause.name].change
    power = sum((np.tensordot(own, white[at], axes=1) ** 2).sum(axis=0) for white in info.white_change)
    order = np.argsort(-np.asarray(power))
    return tuple(CHANNELS[i] for i in order if power[i] > 0.1 * power[order[0]])


def shown_beside(found: Found, effect: Effect) -> str:
    """Return the channel in which an effect shows most while the causes are fitted with it.

    A wheel radius beside an effective track shows in the speed alone: the track takes what it does to the
    yaw rate.
    """
    info = found.info
    own = info.places([p.name for p in effect.parameters])
    base = info.places([name for name in found.names if name not in {p.name for p in effect.parameters}])
    follow, _ = partial_information(info.a.sum(axis=0), base, own)
    power = np.zeros(len(CHANNELS))
    for white in info.white_change:
        power += ((white[own] - np.tensordot(follow.T, white[base], axes=1)) ** 2).sum(axis=(0, 1))
    return CHANNELS[int(np.argmax(power))]


def raw_gain(found: Found, cause: Effect) -> float:
    """Return by how much a cause reduces minus twice the log-likelihood, the others refitted.

    It is on the scale of the gain of a probe, without the scatter between runs, which ``z`` has in it.
    """
    info = found.info
    own = [p.name for p in cause.parameters]
    base = info.places([name for name in found.names if name not in own])
    _, free = partial_information(info.a.sum(axis=0), base, info.places(own))
    change = found.change[[found.names.index(name) for name in own]]
    return float(change @ free @ change)


def constancies(found: Found) -> dict[str, Constancy]:
    """Return the values of all causes in parts of the data, by name."""
    return {
        cause.name: constancy_of(
            found.info,
            found.names,
            [p.name for p in cause.parameters],
            found.change,
            found.tried[cause.name].inflation,
        )
        for cause in found.causes
    }


def reasons_to_withdraw(
    problem: Problem, found: Found, probes: Mapping[tuple[str, str], ProbeResult]
) -> dict[str, str]:
    """Return, by name, why significant causes are withdrawn; empty where all of them may be named."""
    significant = [cause for cause in found.causes if found.tried[cause.name].significant]
    constant = constancies(found)
    slow = _slow_values(problem, found) if significant else found.change
    reasons = {}
    for cause in significant:
        reason = (
            _at_bound(problem, found, cause)
            or _varies(constant[cause.name])
            or _probed(found, cause, probes)
            or _worse(found, cause)
            or _frequency_dependent(found, cause, slow)
        )
        if reason:
            reasons[cause.name] = f"it reduces the residual, but {reason}"
    return reasons


def _at_bound(problem: Problem, found: Found, cause: Effect) -> str:
    for p in cause.parameters:
        low, high = BOUNDS[p.name]
        given = dict(problem.simulation.effects).get(p.name, 0.0)
        value = given + float(found.change[found.names.index(p.name)])
        above, below = (NEAR_BOUND * min(high - low, 2.0 * abs(bound)) for bound in (high, low))
        if value > high - above or (low < 0.0 and value < low + below):
            return f"{p.label} ends at the bound of what it may be ({value:.3g} {p.unit})"
    return ""


def _varies(constant: Constancy) -> str:
    return constant.caveat if constant.varies else ""


def _probed(found: Found, cause: Effect, probes: Mapping[tuple[str, str], ProbeResult]) -> str:
    """Return the nameless input that explains much of the cause's main channels beside it."""
    main, own = shown_channels(found, cause), [p.name for p in cause.parameters]
    beside = {
        at: each
        for at, each in probes.items()
        if at[0] in main
        and each.significant
        and max((each.alike[name] for name in own if name in each.alike), default=1.0) > PROBE_ALIKE
    }
    most = max(beside, key=lambda at: beside[at].gain, default=None)
    if most is None or beside[most].gain <= PROBE_RATIO * raw_gain(found, cause):
        return ""
    return f"{most[0]} depends on {most[1]} beside it (z {beside[most].z:.1f})"


def _worse(found: Found, cause: Effect) -> str:
    """Return the channel that a cause makes worse, or its main channel if it gains nothing held out."""
    effect = channel_effects(found, cause)
    for name, each in effect.items():
        if each.with_cause > WORSE_RATIO * each.without:
            more = each.with_cause / each.without - 1.0
            return f"it makes {name} worse, by {more:.0%} of the square"
    main = shown_channels(found, cause)[0]
    if not effect[main].held_out_gain > 0:
        return f"it gains nothing in {main}, its main channel, on runs left out"
    return ""


def channel_effects(found: Found, cause: Effect) -> dict[str, ChannelEffect]:
    """Return what a cause does to each channel that was measured.

    What varies from run to run is taken out of each run as its residual shows it, but not the cause's own
    variation, which would take its place.  What that variation costs by its assumed size counts in the
    channels where it shows: in runs of one motion each it would else be a cause of any kind for nothing.
    """
    info = found.info
    own = [p.name for p in cause.parameters]
    beside = ~np.isin(info.nuisances, info.places(own))
    free, precision = info.nuisances[beside], np.diag(1.0 / info.nuisance_std[beside] ** 2)
    squares = np.zeros((2, 2, len(CHANNELS)))  # without and with the cause, by all runs and by the others
    for m, names in enumerate(([n for n in found.names if n not in own], found.names)):
        places = info.places(names)
        common, held_out = fit_change(info, names)[0], fits_without_each(info, places)
        for i, (residual, change) in enumerate(zip(info.white_residual, info.white_change, strict=True)):
            scatter = change[free].reshape(free.size, residual.size)
            inner = np.linalg.inv(scatter @ scatter.T + precision)
            shown = (change[free] ** 2).sum(axis=1)
            cost = precision @ (shown / np.maximum(shown.sum(axis=1, keepdims=True), 1e-30))
            for kind, x in enumerate((common, held_out[i])):
                fitted = -info.away
                fitted[places] += x
                left = residual - np.tensordot(fitted, change, axes=1)
                deviation = inner @ (scatter @ left.ravel())
                left -= np.tensordot(deviation, change[free], axes=1)
                squares[m, kind] += (left**2).sum(axis=0) + deviation**2 @ cost
    return {
        CHANNELS[c]: ChannelEffect(squares[0, 0, c], squares[1, 0, c], squares[0, 1, c] - squares[1, 1, c])
        for c in range(len(CHANNELS))
        if squares[1, 0, c] > 0
    }


def _slow_values(problem: Problem, found: Found) -> Array:
    """Return the values (k,) and covariance where the instruments are filtered more."""
    slower = problem._replace(
        low_pass=problem.low_pass._replace(
            instrument_cutoff_hz=SLOW_CUTOFF_RATIO * problem.low_pass.instrument_cutoff_hz
        )
    )
    there = move_point(found.info.vector, found.names, found.change)
    info = slower.at(there, found.names, found.info.statistics)
    value, cov = fit_change(recentre(info, problem.simulation.vector), found.names)
    return np.column_stack([value, np.diag(cov)])


def _frequency_dependent(found: Found, cause: Effect, slow: Array) -> str:
    """Return whether a cause is smaller when quick motion is filtered out of the instruments.

    Both estimate the same quantity, so they agree up to the larger variance of the slower one (Hausman,
    Econometrica 1978); where the slower one is smaller, the cause fits noise of the wheel speeds, which goes
    with it.
    """
    at = [found.names.index(p.name) for p in cause.parameters]
    size = found.change[at]
    var = np.maximum(slow[at, 1] - np.diag(found.cov)[at], 0.0) * found.tried[cause.name].inflation
    apart = (size - slow[at, 0]) * np.sign(size)
    if (apart > np.maximum(SLOW_Z * np.sqrt(var), SLOW_RATIO * np.linalg.norm(size))).any():
        return "has a smaller value in slow motion: it fits noise of the wheel speeds"
    return ""
