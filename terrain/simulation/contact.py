"""The contact of wheel and ground: slip over traction of a ground and of a shear curve, and its damping.

Both planar motions slip by these laws, and the dynamic simulation shares their shear and
damping: an effect is the same number in all of them.
"""

from __future__ import annotations

import math

from terrain.kernels import inner, njit
from terrain.records import Array

# Damping of the contact as a lead on its deflection; it vanishes in steady rolling and so moves no slip.
DEFLECTION_DAMPING_S = 0.005


@njit
def shear_slip(force_ratio: float, grip_ratio: float) -> float:
    """Return the slip of a shear curve whose slip per force is 1 at the start; its end at 95 % of the grip.

    ``f/f_max = 1 - (1 - exp(-x))/x`` is solved for ``x``, and ``s = x f_max / 2``: ``x = 2 f/f_max`` for
    small forces.

    Examples
    --------
    >>> round(shear_slip(0.001, 0.5), 5), round(shear_slip(0.25, 0.5), 3)
    (0.001, 0.398)
    """
    part = min(abs(force_ratio) / grip_ratio, 0.95)
    if part < 1e-9:
        return force_ratio
    # start from the two ends' forms, then Newton
    x = 2.0 * part + part * part * part / (1.0 - part)
    for _ in range(6):
        e = math.exp(-x)
        value = 1.0 - (1.0 - e) / x - part if x > 1e-4 else 0.5 * x - x * x / 6.0 - part
        slope = (1.0 - e - x * e) / (x * x) if x > 1e-4 else 0.5 - x / 3.0
        x = max(x - value / slope, 1e-9)
    return math.copysign(0.5 * grip_ratio * x, force_ratio)


@njit
def softness(soft_ratio: Array, slip: float) -> float:
    """Return slip over traction of the ground at a slip.

    Examples
    --------
    >>> import numpy as np
    >>> round(softness(np.array([0.3, 0.4, 0.6]), 0.75), 3)
    0.5
    """
    last = soft_ratio.size - 1
    at = min(slip, 1.0) * last
    i = min(int(at), last - 1)
    return float(soft_ratio[i] + (at - i) * (soft_ratio[i + 1] - soft_ratio[i]))


@inner
def shear_softness(force_ratio: float, grip_ratio: float) -> float:
    """Return slip over traction of a shear curve that starts with 1."""
    return shear_slip(force_ratio, grip_ratio) / force_ratio if abs(force_ratio) > 1e-9 else 1.0
