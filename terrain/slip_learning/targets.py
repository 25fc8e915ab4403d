"""Target slips of a terrain from its slip curve, for traction, braking and steady motion.

With thrust f(s) and resistance rho over load, weight W, wheel radius r and bearing friction T_f::

    eta(s) = (f - rho) / f (1 - s)      tractive efficiency
    E(s)   = (f W r + 3 T_f) w / v      energy a metre at the wheels

where w r / v is 1 / (1 - s) in traction and 1 - |s| in braking.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.robots import Robot
from terrain.slip_learning.curve import SlipCurve
from terrain.slip_learning.peak import SYSTEMATIC_SLIP_STD, PeakStatus

PEAK_SLIP_RATIO = 0.9
"""Target of traction over the peak slip: beyond the peak more slip gives less traction and a wheel spins up,
and the thrust at nine tenths of the peak slip is within a hundredth of it."""

MIN_ABOVE_BALANCE_SLIP = 0.03
"""Traction has to differ from steady motion by more than the error of the slip, or no robot would start."""

BRAKING_CAP_SLIP = 0.3
"""Where thrust rises monotonically, a wheel is not braked further: it would gain little, lose its side force
with the slip, and plough instead of roll."""


class TargetSlip(NamedTuple):
    """A target slip, its standard deviation, and what it is derived from."""

    slip_ratio: float
    slip_std: float
    source: str


class Targets(NamedTuple):
    """Targets of a terrain, and the two slips of which that of traction is the lesser.

    ``peak_based_slip_ratio`` is :data:`PEAK_SLIP_RATIO` of the peak slip, ``working_slip_ratio`` the slip
    with the net traction of a start.
    """

    traction: TargetSlip
    braking: TargetSlip
    steady: TargetSlip
    peak_based_slip_ratio: float
    working_slip_ratio: float

    def of(self, drive_state: str) -> TargetSlip:
        """Return the target of ``traction``, ``braking`` or ``steady``."""
        return {"traction": self.traction, "braking": self.braking, "steady": self.steady}[drive_state]


def targets_of(curve: SlipCurve) -> Targets:
    """Return the targets of a terrain: braking <= 0 <= steady <= traction."""
    n = f"{curve.n_runs} runs, {curve.law}"
    steady = TargetSlip(
        max(curve.balance_slip_ratio, 0.0), curve.balance_std, f"balance with the resistance; {n}"
    )
    traction, braking = _traction(curve, steady.slip_ratio), _braking(curve)
    return Targets(
        traction._replace(source=f"{traction.source}; {n}"),
        braking._replace(source=f"{braking.source}; {n}"),
        steady,
        PEAK_SLIP_RATIO * curve.peak.slip_ratio,
        curve.working_slip_ratio,
    )


def _traction(curve: SlipCurve, steady_slip_ratio: float) -> TargetSlip:
    """Return the target near the peak, but not beyond what a start requires: more slip only costs energy.

    It is at least :data:`MIN_ABOVE_BALANCE_SLIP` above the steady one.
    """
    by_peak = PEAK_SLIP_RATIO * curve.peak.slip_ratio
    of = (
        "the peak slip"
        if curve.peak.status is PeakStatus.PEAK
        else "the slip at 95 % of the largest traction"
    )
    target = TargetSlip(by_peak, PEAK_SLIP_RATIO * curve.peak_std, f"{PEAK_SLIP_RATIO:g} of {of}")
    if curve.working_slip_ratio < by_peak:
        target = TargetSlip(curve.working_slip_ratio, curve.working_std, "net traction of a start")
    least = steady_slip_ratio + MIN_ABOVE_BALANCE_SLIP
    return TargetSlip(least, curve.balance_std, "just above balance") if target.slip_ratio < least else target


def _braking(curve: SlipCurve) -> TargetSlip:
    """Return the peak slip mirrored; where there is no peak, at most :data:`BRAKING_CAP_SLIP`."""
    slip, std = curve.peak.slip_ratio, curve.peak_std
    if curve.peak.status is PeakStatus.PEAK:
        return TargetSlip(-slip, std, "the peak slip mirrored")
    if slip > BRAKING_CAP_SLIP:
        return TargetSlip(-BRAKING_CAP_SLIP, SYSTEMATIC_SLIP_STD, "capped: thrust rises monotonically")
    return TargetSlip(-slip, std, "the slip at 95 % of the largest traction, mirrored")


def tractive_efficiency(curve: SlipCurve, slip_ratio: float) -> float:
    """Return the work of net traction over that of a wheel; NaN without thrust."""
    thrust = float(curve.thrust_ratio(np.array([slip_ratio]))[0])
    return (thrust - curve.resistance_ratio) / thrust * (1.0 - slip_ratio) if thrust > 0 else math.nan


def energy_jpm(curve: SlipCurve, slip_ratio: float, robot: Robot) -> float:
    """Return the energy in J a metre at the wheels of the robot without payload; negative in recuperation."""
    thrust = float(curve.thrust_ratio(np.array([slip_ratio]))[0])
    turns = 1.0 / (1.0 - slip_ratio) if slip_ratio >= 0 else 1.0 + slip_ratio
    friction_n = len(robot.wheels) * robot.motors.friction_nm / robot.wheel_radius_m
    return (thrust * robot.mass_kg * GRAVITY_MPS2 + friction_n) * turns
