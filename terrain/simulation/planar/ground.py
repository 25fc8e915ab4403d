"""A soil in the planar simulation: thrust curve, its end, growth with load, and resistances."""

from __future__ import annotations

import math

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.robots import Robot
from terrain.simulation.planar.model import Ground
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import equilibrium_slip, ground_record, wheel_ground

SCRUB_SHARE = 0.4
"""Resistance to turning over the ground's grip; assumed: wheels of a side skid sideways over half the
distance."""

WIDTH_RATIO, CONTACT_RATIO = 0.6, 0.6
"""Width of a tyre, and length of its contact on firm ground, over the wheel's radius, where a description has
no section ``body``; assumed: the described robots have 0.5 to 0.7, and 0.6."""

_SLIPS = np.linspace(0.0, 1.0, 101)

_MORE = 1.01
"""Load for which growth with load is taken."""


def planar_ground(robot: Robot, soil: Soil) -> Ground:
    """Return what a soil is to a robot that carries its weight on all tyres alike.

    The thrust curve is that of one tyre with its share of the weight; ``slip_ratio`` is its chord through the
    slip at which the robot drives steadily on the level.  How thrust grows with load is taken there, too.
    Rollers of omni wheels turn freely where the soil does not say what it does to them.

    Parameters
    ----------
    robot : a tyre that it does not describe has :data:`WIDTH_RATIO` and :data:`CONTACT_RATIO`
    soil : the ground

    Raises
    ------
    ConfigError
        if the robot is stuck on that soil.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.terramechanics.soil import load_soil
    >>> ground = planar_ground(load_robot("agrimaro"), load_soil("grass"))
    >>> [round(number, 3) for number in ground[:4]], round(ground.load_ratio, 2)
    ([1.569, 0.347, 0.08, 0.139], 0.76)
    """
    width_m, contact_m = WIDTH_RATIO * robot.wheel_radius_m, CONTACT_RATIO * robot.wheel_radius_m
    if robot.describes("body"):
        width_m, contact_m = robot.body.tyre_width_m, robot.body.contact_length_m
    wheel = robot.wheel_radius_m, width_m, contact_m
    normal_n = robot.mass_kg * GRAVITY_MPS2 / robot.n_tyres
    slip = equilibrium_slip(soil, normal_n, 0.0, *wheel)
    if math.isnan(slip):
        raise ConfigError(f"robot {robot.name}: it gets stuck on terrain {soil.name!r}")
    ground = ground_record(soil, *wheel)[0]
    thrust_n = wheel_ground(ground, normal_n, max(slip, 1e-3), 0.0)[0]
    more_n = wheel_ground(ground, _MORE * normal_n, max(slip, 1e-3), 0.0)[0]
    thrusts = [wheel_ground(ground, normal_n, float(s), 0.0)[0] / normal_n for s in _SLIPS]
    grip = max(thrusts)
    return Ground(
        slip_ratio=max(slip, 1e-3) * normal_n / thrust_n,
        grip_ratio=grip,
        rolling_ratio=wheel_ground(ground, normal_n, slip, 0.0)[2] / normal_n,
        scrub_ratio=SCRUB_SHARE * grip,
        thrust_ratio=tuple(thrusts),
        load_ratio=(more_n / thrust_n - 1.0) / (_MORE - 1.0),
        roller_ratio=float(np.nan_to_num(soil.roller_friction_ratio)),
    )
