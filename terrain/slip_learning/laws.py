"""Laws of thrust over load against slip, with the same parameters for all wheel loads.

::

    janosi   f = M (1 - (1 - exp(-s / k)) k / s)                       k = K / l
    magic    f = D sin(C atan(B s - E (B s - atan(B s))))

These are the laws of :mod:`terrain.terramechanics.traction`, divided by the load.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from terrain.records import Array

LAW_PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "janosi": ("limit_ratio", "shear_ratio"),
    "magic": ("stiffness_ratio", "shape_ratio", "peak_friction_ratio", "curvature_ratio"),
}
"""Parameters of each law, in the order of :func:`traction_ratio`: M and k; B, C, D and E."""

LAW_BOUNDS: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "janosi": ((1e-3, 1e-3), (5.0, 20.0)),
    "magic": ((0.1, 1.0, 1e-3, -5.0), (200.0, 2.3, 5.0, 1.0)),
}
"""Lower and upper bounds of each law's parameters, in their order."""


def traction_ratio(law: str, parameters: Sequence[float] | Array, slip_ratio: Array) -> Array:
    """Return the thrust over load (n,) at each slip (n,); odd in the slip.

    Examples
    --------
    >>> traction_ratio("janosi", (0.5, 0.4), np.array([-0.1, 0.0, 0.1, 0.4])).round(3)
    array([-0.058,  0.   ,  0.058,  0.184])
    >>> traction_ratio("magic", (10.0, 1.9, 1.0, 0.97), np.array([0.05, 0.18])).round(3)
    array([0.736, 1.   ])
    """
    magnitude = np.abs(slip_ratio)
    if law == "janosi":
        limit, shear = parameters
        x = magnitude / shear
        small = x < 1e-3
        safe = np.where(small, 1.0, x)
        return np.sign(slip_ratio) * limit * np.where(small, x / 2 - x * x / 6, 1 + np.expm1(-safe) / safe)
    stiffness, shape, peak, curvature = parameters
    x = stiffness * magnitude
    angle = shape * np.arctan(x - curvature * (x - np.arctan(x)))
    return np.sign(slip_ratio) * peak * np.maximum(np.sin(angle), 0.0)


def slip_at(law: str, parameters: Sequence[float], traction: float, high_slip: float = 1.0) -> float:
    """Return the smallest slip with a given thrust over load; NaN where no slip up to ``high_slip`` has it.

    Examples
    --------
    >>> round(slip_at("janosi", (0.5, 0.4), 0.1), 3)
    0.186
    """
    slips = np.linspace(0.0, high_slip, 2001)
    reached = traction_ratio(law, parameters, slips) >= traction
    if not reached.any():
        return math.nan
    first = int(np.argmax(reached))
    if first == 0:
        return 0.0
    f = traction_ratio(law, parameters, slips[first - 1 : first + 1])
    return float(np.interp(traction, f, slips[first - 1 : first + 1]))
