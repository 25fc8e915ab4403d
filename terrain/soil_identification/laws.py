"""Candidate laws: which terms of the wheel's stresses are there, and which law gives the sinkage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from terrain.records import Array
from terrain.soil_identification.trials import Trials, Wheel
from terrain.terramechanics.inflow_wheel import FORCE, NAMES, bulldozing_ratio, wheel_forces
from terrain.terramechanics.travel_sinkage import (
    DEEPEST_RATIO,
    DING,
    LYASKO,
    TRAVEL,
    ding_sinkage,
    lyasko_sinkage,
    travel_sinkage,
)

SINKAGES: dict[str, dict[str, tuple[float, float]]] = {"travel": TRAVEL, "lyasko": LYASKO, "ding": DING}
"""Parameters of each law of sinkage."""


class Law(NamedTuple):
    """A law of the forces and one of the sinkage.

    Parameters
    ----------
    name : of both
    sinkage : one of :data:`SINKAGES`
    free : parameters of :data:`~terrain.terramechanics.inflow_wheel.FORCE` that are fitted
    fixed : value of each other one that is not where its fit would begin
    tied : whether the side face's pressure is that of the friction angle
    text : what it is, for readers
    """

    name: str
    sinkage: str
    free: tuple[str, ...]
    fixed: Mapping[str, float]
    tied: bool
    text: str


_ARC = ("pressure_exponent", "peak_ratio", "peak_slip_ratio", "exit_ratio", "tan_friction", "shear_modulus_m")
_NO_SIDE = {
    "exit_slip_ratio": 0.0,
    "side_inflow_ratio": 0.0,
    "side_pressure_ratio": 0.0,
    "side_friction_ratio": 0.0,
    "side_lift_ratio": 0.0,
    "inflow": 0.0,
}
_BULLDOZING = _NO_SIDE | {"side_depth_exponent": 1.0, "travel_exponent": 1.0, "rotation_exponent": 0.0}
_BEKKER = {"peak_ratio": 0.0, "peak_slip_ratio": 0.0, "exit_ratio": 0.0}
ALL = tuple(name for name in NAMES if name not in ("cohesion_pa", "inflow"))

LAWS: dict[str, Law] = {
    law.name: law
    for law in (
        Law(
            "bekker",
            "lyasko",
            ("pressure_exponent", "tan_friction", "shear_modulus_m"),
            _NO_SIDE | _BEKKER,
            False,
            "Bekker's pressure by depth in front of the axle, Janosi's shear, Lyasko's sinkage",
        ),
        Law(
            "wong_reece", "lyasko", _ARC, _NO_SIDE, False, "Wong and Reece's peak and exit, Lyasko's sinkage"
        ),
        Law("ishigami", "lyasko", _ARC, _BULLDOZING, True, "and Ishigami's bulldozing of the side face"),
        Law("ishigami_ding", "ding", _ARC, _BULLDOZING, True, "the same with Ding's sinkage"),
        Law("ishigami_travel", "travel", _ARC, _BULLDOZING, True, "the same with the sinkage by travel"),
        Law("inflow", "travel", ALL, {}, False, "inflow of soil, friction and lift of the side face"),
    )
}
"""By name, from the plainest to the one that holds."""


class Prediction(NamedTuple):
    """Forces in N, sinkage in m and apparent modulus in Pa of each trial, (n,)."""

    pull_n: Array
    side_n: Array
    sinkage_m: Array
    modulus_pa: Array


def force_vector(law: Law, values: Array) -> Array:
    """Return all parameters of the forces (17,), the free ones being ``values``."""
    named = {name: entry[0] for name, entry in FORCE.items()} | dict(law.fixed)
    named |= dict(zip(law.free, np.asarray(values).tolist(), strict=True))
    if law.tied:
        named["side_pressure_ratio"] = bulldozing_ratio(named["tan_friction"])
    return np.array([named[name] for name in NAMES])


def sinkage_of(law: Law, values: Array, trials: Trials, wheel: Wheel) -> Array:
    """Return the sinkage (n,) in m that a law predicts from slip and angle, and Ding's from the load."""
    if law.sinkage == "travel":
        wheel_mps = trials.wheel_radps * wheel.tip_radius_m
        depth = travel_sinkage(
            values, wheel_mps, trials.travel_mps, trials.slip_angle_rad, wheel.tip_radius_m
        )
    elif law.sinkage == "lyasko":
        depth = lyasko_sinkage(values, trials.slip_ratio)
    else:
        depth = ding_sinkage(values, trials.slip_ratio, trials.load_n, wheel.tip_radius_m, wheel.width_m)
    return np.clip(depth, 1e-4, DEEPEST_RATIO * wheel.tip_radius_m)


def forces_of(law: Law, values: Array, trials: Trials, wheel: Wheel, sinkage_m: Array) -> Prediction:
    """Return the forces of each trial for a sinkage (n,) in m."""
    vector = force_vector(law, values)
    depths = np.ascontiguousarray(sinkage_m)
    found = wheel_forces(vector, wheel.tip_radius_m, wheel.width_m, trials.motion, depths)
    return Prediction(found[:, 0], found[:, 1], depths, found[:, 2])
