"""Which slip to aim for, from what a terrain's curve tells: traction, braking and steady motion.

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
from terrain.slip_learning.slip_curve import SYSTEMATIC_SLIP_STD, SlipCurve, traction_ratio

PEAK_SHARE = 0.9
"""Traction keeps below the peak: behind it more slip gives less pull and a wheel runs away, and the thrust at
nine tenths of the peak's slip is within a hundredth of it."""

MIN_ABOVE_BALANCE_SLIP = 0.03
"""Traction has to differ from steady motion by more than slip is measured to, or it would not drive off."""

BRAKING_CAP_SLIP = 0.3
"""Where thrust rises for ever, a wheel is not braked further: it would gain little, lose its side force with
the slip, and plough instead of roll."""


class TargetSlip(NamedTuple):
    """A slip to aim for, and one standard deviation of what is known of it."""

    slip_ratio: float
    slip_std: float
    source: str


class Targets(NamedTuple):
    """Targets of a terrain, and what stands behind that of traction.

    ``peak_based_slip_ratio`` is :data:`PEAK_SHARE` of the peak, ``working_slip_ratio`` the slip that gives
    the working pull; the lesser of the two is aimed for.
    """

    traction: TargetSlip
    braking: TargetSlip
    steady: TargetSlip
    peak_based_slip_ratio: float
    working_slip_ratio: float


def targets_of(curve: SlipCurve) -> Targets:
    """Return the targets of a terrain: braking <= 0 <= steady <= traction.

    Traction is near the peak but not beyond what the work asks for: slip over that buys nothing and costs
    energy.  It is never under :data:`MIN_ABOVE_BALANCE_SLIP` over the steady one.
    """
    n = f"{curve.n_runs} runs, {curve.law}"
    steady = max(curve.balance_slip_ratio, 0.0)
    peak, peak_std = curve.peak.slip_ratio, curve.peak_std
    by_peak, working = PEAK_SHARE * peak, curve.working_slip_ratio
    traction, std, why = by_peak, PEAK_SHARE * peak_std, f"{PEAK_SHARE:g} of the peak"
    if curve.peak.status == "no_peak":
        why = f"{PEAK_SHARE:g} of the slip at 95 % of the largest pull seen"
    if working < by_peak:
        traction, std, why = working, curve.working_std, "working pull"
    if traction < steady + MIN_ABOVE_BALANCE_SLIP:
        traction, std, why = steady + MIN_ABOVE_BALANCE_SLIP, curve.balance_std, "just above balance"
    braking, braking_std, how = peak, peak_std, "the peak mirrored"
    if curve.peak.status == "no_peak":
        braking, how = min(peak, BRAKING_CAP_SLIP), "95 % of the largest pull seen, mirrored"
        if peak > BRAKING_CAP_SLIP:
            braking_std, how = SYSTEMATIC_SLIP_STD, "capped: thrust rises on"
    return Targets(
        TargetSlip(traction, std, f"{why}; {n}"),
        TargetSlip(-braking, braking_std, f"{how}; {n}"),
        TargetSlip(steady, curve.balance_std, f"balance of the resistance; {n}"),
        by_peak,
        working,
    )


def tractive_efficiency(curve: SlipCurve, slip_ratio: float) -> float:
    """Return the share of a wheel's work that becomes net pull times way; NaN without thrust."""
    thrust = float(traction_ratio(curve.law, curve.parameters, np.array([slip_ratio]))[0])
    return (thrust - curve.resistance_ratio) / thrust * (1.0 - slip_ratio) if thrust > 0 else math.nan


def energy_jpm(curve: SlipCurve, slip_ratio: float, robot: Robot) -> float:
    """Return the energy in J a metre that the wheels of the unladen robot take; negative where they give."""
    motors = robot.equipment.motors
    thrust = float(traction_ratio(curve.law, curve.parameters, np.array([slip_ratio]))[0])
    turns = 1.0 / (1.0 - slip_ratio) if slip_ratio >= 0 else 1.0 + slip_ratio
    friction_n = len(robot.wheels) * motors.friction_nm / robot.wheel_radius_m
    return (thrust * robot.mass_kg * GRAVITY_MPS2 + friction_n) * turns
