"""Differences between two sets of runs, as parameters of their own that act in runs of the second set alone.

A point of parameters has the values of the first set, then what the second set has more of each.
"""

from __future__ import annotations

import numpy as np

from terrain import effects
from terrain.effects import Effect, Parameter
from terrain.records import Array

MORE = "+"  #: Last sign of the name of a difference


def difference(effect: Effect) -> Effect:
    """Return what a second set has more of an effect, as an effect.

    Examples
    --------
    >>> of = difference(effects.effect_named("wheel_radius"))
    >>> of.name, [(p.name, p.low, p.high) for p in of.parameters]
    ('wheel_radius+', [('wheel_radius_ratio+', -0.6, 0.6)])
    """
    return effect._replace(name=effect.name + MORE, parameters=tuple(map(_difference, effect.parameters)))


def _difference(p: Parameter) -> Parameter:
    low, high = p.plausible
    return p._replace(
        name=p.name + MORE, low=p.low - p.high, high=p.high - p.low, plausible=(low - high, high - low)
    )


#: Of all parameters, those of one set first.
PARAMETER = effects.PARAMETER | {p.name + MORE: _difference(p) for p in effects.PARAMETER.values()}
BOUNDS = {name: (p.low, p.high) for name, p in PARAMETER.items()}
INDEX = {name: i for i, name in enumerate([*effects.PARAMETERS, *[p + MORE for p in effects.PARAMETERS]])}


def in_common(name: str) -> str:
    """Return the parameter of both sets that a parameter is, or is the difference of."""
    return name.removesuffix(MORE)


def in_set(vector: Array, second: bool) -> Array:
    """Return the parameters (len(PARAMETERS),) of one of the sets, within their bounds."""
    both = vector.reshape(-1, len(effects.PARAMETERS))
    own = both.sum(axis=0) if second else both[0].copy()
    at = [INDEX[name] for name in effects.BOUNDS]
    own[at] = np.clip(own[at], *np.transpose([*effects.BOUNDS.values()]))
    return np.asarray(own)
