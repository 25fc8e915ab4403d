"""What a table of target slips aims for on each terrain, ready for the control loop.

Braking by controlled slip is aimed for where it stops a robot sooner than locked wheels.  On terrain that
shears, thrust rises with slip up to the locked wheel: nothing stops sooner.  On hard terrain it falls again
beyond a peak.  Slip is controlled in braking where it falls by more than the controller loses while slip
builds up, and where friction is so small that wheels lock at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.control.slip_table import CurveEntry, SlipTable
from terrain.control.traction import TractionTarget
from terrain.records import SlipTarget

SLICK_RATIO = 0.5
"""Thrust over load at the peak, up to which terrain counts as slick: with more, a robot stops from 1 m/s in
less than two tenths of a second, which is the response time of a slip controller."""

LOCKED_RATIO = 0.88
"""Thrust of a locked wheel over that at the peak, up to which slip is controlled: with 0.92 a controlled
stop came out longer in simulation, with 0.79 it was 7 to 22 % shorter."""

DECELERATION_RATIO = 0.9
"""Planned deceleration over that at the peak; with more, the slip would diverge from the peak."""


def braking_by_slip(curve: CurveEntry | None) -> tuple[float, float] | None:
    """Return slip of the peak and planned deceleration on level terrain; None where locked wheels stop as soon.

    Examples
    --------
    >>> braking_by_slip(None) is None
    True
    """
    if curve is None:
        return None
    slip = np.linspace(0.0, 1.0, 501)
    thrust = curve.thrust_ratio(slip)
    peak = int(thrust.argmax())
    if peak == len(slip) - 1 or thrust[peak] > SLICK_RATIO or thrust[-1] > LOCKED_RATIO * thrust[peak]:
        return None
    deceleration_mps2 = DECELERATION_RATIO * float(thrust[peak] + curve.resistance_ratio) * GRAVITY_MPS2
    return float(slip[peak]), deceleration_mps2


MARGIN_MAX_RATIO = 0.06
"""The difference of a table's targets in traction and in steady motion is the slip above the balance that
gives the working pull; up to this much is added to the measured balance.  A larger difference is that of a
table that aims for a peak."""


class Aim(NamedTuple):
    """What a table aims for on a terrain: its targets by drive state, and those of traction control on the level."""

    slip_targets: Mapping[str, SlipTarget]
    level: TractionTarget


class Aims(dict[str, Aim]):
    """The aims of a table by terrain; that of its fallback for any other.

    Examples
    --------
    >>> from terrain.control.slip_table import load_slip_table
    >>> aims = Aims(load_slip_table())
    >>> aims["mud"] == aims[""]
    True
    """

    def __init__(self, table: SlipTable) -> None:
        super().__init__({terrain: _aim(table, terrain) for terrain in table.targets})
        self._fallback = self[table.fallback]

    def __missing__(self, terrain: str) -> Aim:
        return self._fallback


def _aim(table: SlipTable, terrain: str) -> Aim:
    targets = table.lookup(terrain)
    traction = targets["traction"]
    margin = min(traction.slip_ratio - targets["steady"].slip_ratio, MARGIN_MAX_RATIO)
    braking = braking_by_slip(table.curves.get(traction.terrain)) or (0.0, 0.0)
    return Aim(targets, TractionTarget(traction.slip_ratio, *braking, margin))
