"""Braking by slip: where it stops a robot sooner than wheels that are told to stand.

On ground that shears, thrust rises with slip up to the locked wheel: nothing stops sooner.  On hard ground it
falls again beyond a peak.  Where it falls far enough for a controller to win what building its slip up costs,
and where friction is so small that wheels lock at all, braking is worth a slip.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.control.slip_table import CurveEntry
from terrain.slip_learning.slip_curve import LAW_PARAMETERS, traction_ratio

SLICK_RATIO = 0.5
"""Thrust over load at the peak, up to which ground counts as slick: a robot that grips more stops from 1
m/s in less than two tenths of a second, which is what a loop takes to notice."""

LOCKED_RATIO = 0.88
"""Thrust of a locked wheel over that at the peak, up to which the fall is worth it: with 0.92 a controlled
stop came out longer in simulation, with 0.79 it was 7 to 22 % shorter."""

SHARE = 0.9
"""Of the peak's deceleration that is counted on; over it, the slip would run away from the peak."""


class Braking(NamedTuple):
    """Slip of the peak, and the deceleration that is counted on, on the level."""

    slip_ratio: float
    mps2: float


def braking_by_slip(curve: CurveEntry | None) -> Braking | None:
    """Return how to brake on ground of that curve, or None where locked wheels stop as soon.

    Examples
    --------
    >>> braking_by_slip(None) is None
    True
    """
    if curve is None:
        return None
    slip = np.linspace(0.0, 1.0, 501)
    thrust = traction_ratio(curve.law, [curve.parameters[name] for name in LAW_PARAMETERS[curve.law]], slip)
    peak = int(thrust.argmax())
    if peak == len(slip) - 1 or thrust[peak] > SLICK_RATIO or thrust[-1] > LOCKED_RATIO * thrust[peak]:
        return None
    return Braking(float(slip[peak]), SHARE * float(thrust[peak] + curve.resistance_ratio) * GRAVITY_MPS2)
