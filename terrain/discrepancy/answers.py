"""What a diagnosis states of what was found: causes, rivals, limits, what is ruled out, and residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from terrain.discrepancy.constancy import CAVEAT_RATIO, constancy_of
from terrain.discrepancy.evidence import Evidence, partial_information
from terrain.discrepancy.residuals import measured_channels
from terrain.discrepancy.robot_terms import UNITS
from terrain.discrepancy.search import Found, names_of
from terrain.discrepancy.selection import Z_EFFECT, gain_interval
from terrain.discrepancy.varying import run_scatter
from terrain.discrepancy.verdict import INTERVAL_T, Cause, Limit, Residual, RuledOut, Value
from terrain.discrepancy.withdrawal import shown_channels
from terrain.effects import CHANNELS, Effect

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
