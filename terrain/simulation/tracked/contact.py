r"""Forces under two tracks that shear the ground, each element by how far it has slid since it touched down.

A body moves by :math:`(V_x, V_y, w)`; a track at :math:`y = \pm d` with the belt speed v touches down at its
front, :math:`x = l/2`, where v > 0, and at its rear where v < 0.  An element that lies :math:`\xi` behind
that end has been on the ground for :math:`t = \xi / |v|`; it slides with :math:`s` and has slid :math:`j`:

.. math::
    s = (v - V_x + w y,\; -(V_y + w x)), \qquad
    j = t\,(v - V_x + w y,\; -(V_y + w \bar x)),

:math:`\bar x` being the middle of where it has been.  The shear stress has the direction of s and the size

.. math:: \tau = (c + p \tan\varphi)(1 - e^{-|j|/K})

(Wong and Chiang, A general theory for skid steering of tracked vehicles on firm ground, 2001; Janosi and
Hanamoto 1961).  In straight motion the sum over a track is Tazzari (7) and the right form of Yamauchi (17).

The pressure p is linear along a track and differs from track to track: gravity on a slope acts at the height
of the centre of mass.  Each track presses a rut (compaction, Bekker), rolls against its own friction, and
pushes soil aside with its sides at their depth z: passive earth pressure
:math:`\gamma z^2 K_p / 2 + 2 c z \sqrt{K_p}` on each metre that slides sideways, mobilised by how far it has.
**Bulldozing on the inner side**: what a turning robot sweeps into the turn lies beside the inner track (of a
turn in place, half beside each) and adds to its depth there, :math:`z^2 + 2 A`; the cross-section A of that
heap grows by what is swept and is left behind as the robot moves on,
:math:`dA/dt = z |w| l / 4 - A |V_x| / l` (this project's; Yamauchi et al. describe the heap, fig. 19, and do
not model it).

What is assumed: loads follow gravity alone, not accelerations; a belt that does not turn counts as creeping
with :data:`CREEP_MPS`, so that a stopped track is dragged at its full friction; unit weight of soil and
mobilisation of the earth pressure are constants.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import TrackedRobot
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import compaction_resistance, plate_sinkage

ELEMENTS = 16
"""Elements along a track: forces are within 1 % of those of 200."""

CREEP_MPS = 1e-3
"""Belt speed that a stopped track counts as having."""

SLIDING_MPS = 1e-5
"""Sliding speed below which friction has no direction of its own."""

ROLLING_MPS = 2e-3
"""Speed over which resistances against motion take their full size."""

UNIT_WEIGHT_NPM3 = 15000.0
"""Of loose dry sand: 14 to 16 kN/m^3 (Terzaghi, Peck and Mesri, Soil Mechanics in Engineering Practice)."""

MOBILISED_M = 0.02
"""Sideways distance over which the earth pressure builds up; assumed, as the shear modulus of loose sand."""

CONTACT_SIZE = 16
(
    HALF,
    LENGTH,
    WIDTH,
    HEIGHT,
    MASS,
    INERTIA,
    COHESION,
    TAN_FRICTION,
    SHEAR_MODULUS,
    KC,
    KPHI,
    EXPONENT,
    ROLLING,
    PASSIVE,
    BULLDOZING,
    AREA,
) = range(CONTACT_SIZE)
"""Places of the numbers of a robot on a soil, as :func:`contact_array` returns them."""


def contact_array(robot: TrackedRobot, soil: Soil, bulldozing_ratio: float = 1.0) -> Array:
    """Return the numbers (CONTACT_SIZE,) of a robot on a soil.

    Parameters
    ----------
    robot : its yaw inertia is that of an even plate over the tracks
    soil : ground that shears; without Bekker's numbers no rut is pressed, and nothing is pushed aside
    bulldozing_ratio : factor on what sides push; 0 for none

    Raises
    ------
    ConfigError
        if the soil does not shear.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.terramechanics.soil import load_soil
    >>> round(float(contact_array(load_robot("patako"), load_soil("dry_sand"))[HALF]), 4)
    0.1965
    """
    if soil.law != "janosi":
        raise ConfigError(
            f"soil {soil.name!r} has the law {soil.law!r}: a tracked robot is simulated on ground that "
            "shears, the law 'janosi'"
        )
    sinks = math.isfinite(soil.kphi_npmn2)
    out = np.zeros(CONTACT_SIZE)
    out[HALF], out[LENGTH], out[WIDTH] = robot.half_track_m, robot.contact_length_m, robot.track_width_m
    out[HEIGHT], out[MASS] = robot.com_height_m, robot.mass_kg
    across_m = robot.track_m + robot.track_width_m
    out[INERTIA] = robot.mass_kg * (robot.contact_length_m**2 + across_m**2) / 12.0
    out[COHESION], out[TAN_FRICTION] = soil.cohesion_pa, math.tan(soil.friction_angle_rad)
    out[SHEAR_MODULUS] = soil.shear_modulus_m
    if sinks:
        out[KC], out[KPHI], out[EXPONENT] = soil.kc_npmn1, soil.kphi_npmn2, soil.sinkage_exponent_ratio
    out[ROLLING] = soil.rolling_resistance_ratio
    out[PASSIVE] = math.tan(math.pi / 4 + soil.friction_angle_rad / 2) ** 2
    out[BULLDOZING] = bulldozing_ratio if sinks else 0.0
    out[AREA] = robot.contact_length_m * robot.track_width_m
    return out


@njit(cache=True)
def track_loads(contact: Array, grade_rad: float, roll_rad: float) -> tuple[float, float, float]:
    """Return the loads of the left and the right track, and how far ahead of the middle they act.

    A track that would lift carries nothing, and the load acts within the middle third, so that no pressure
    is negative.
    """
    weight = contact[MASS] * GRAVITY_MPS2
    normal = weight * math.cos(grade_rad) * math.cos(roll_rad)
    along, across = -weight * math.sin(grade_rad), -weight * math.sin(roll_rad) * math.cos(grade_rad)
    shift = across * contact[HEIGHT] / (2.0 * contact[HALF])
    left = min(max(0.5 * normal + shift, 0.0), normal)
    ahead = along * contact[HEIGHT] / max(normal, 1e-9)
    third = contact[LENGTH] / 6.0
    return left, normal - left, min(max(ahead, -third), third)


@njit(cache=True)
def sinkage_of(contact: Array, load_n: float) -> float:
    """Return the depth of a track's rut; 0 on ground that has no numbers of sinkage."""
    if contact[KPHI] == 0.0:
        return 0.0
    pressure = load_n / contact[AREA]
    return float(plate_sinkage(pressure, contact[WIDTH], contact[KC], contact[KPHI], contact[EXPONENT]))


@njit(cache=True)
def track_forces(
    contact: Array,
    belt_mps: Array,
    twist: Array,
    grade_rad: float,
    roll_rad: float,
    heap_m2: float,
    out: Array,
) -> None:
    """Write the force along x, that along y and the moment (3,) of the ground and of gravity on the body.

    Parameters
    ----------
    contact : numbers of :func:`contact_array`
    belt_mps : (2,) speeds of the belts, left and right
    twist : (3,) speeds of the body's origin in body axes and yaw rate
    grade_rad, roll_rad : of the body, uphill and left side up positive
    heap_m2 : cross-section of the soil beside the inner track
    out : (3,)
    """
    weight = contact[MASS] * GRAVITY_MPS2
    out[0], out[1] = -weight * math.sin(grade_rad), -weight * math.sin(roll_rad) * math.cos(grade_rad)
    out[2] = 0.0
    left, right, ahead = track_loads(contact, grade_rad, roll_rad)
    for side in range(2):
        load = left if side == 0 else right
        y = contact[HALF] if side == 0 else -contact[HALF]
        heap = inner_share(twist, y) * heap_m2
        _add_track(contact, belt_mps[side], twist, load, ahead, y, heap, out)


@njit(cache=True)
def inner_share(twist: Array, y: float) -> float:
    """Return how far the track at y is the inner one of a turn, from 0 to 1; half of it in turning in place.

    Examples
    --------
    >>> inner_share(np.array([0.1, 0.0, 0.0]), 0.2), inner_share(np.array([0.0, 0.0, 0.5]), 0.2)
    (0.5, 0.5)
    >>> round(inner_share(np.array([1.0, 0.0, 0.5]), 0.2), 3)  # to the left
    0.955
    """
    turning = abs(twist[2] * y)
    if turning == 0.0:
        return 0.5
    side = twist[0] * twist[2] * y
    tight = abs(twist[0]) / (abs(twist[0]) + turning)
    return 0.5 * (1.0 + math.copysign(tight, side))


@njit(cache=True)
def _add_track(
    contact: Array,
    belt_mps: float,
    twist: Array,
    load_n: float,
    ahead_m: float,
    y: float,
    heap_m2: float,
    out: Array,
) -> None:
    """Add the forces of one track."""
    length, width, modulus = contact[LENGTH], contact[WIDTH], contact[SHEAR_MODULUS]
    step = length / ELEMENTS
    front = 0.5 * length if belt_mps >= 0.0 else -0.5 * length
    creep = max(abs(belt_mps), CREEP_MPS)
    along = belt_mps - twist[0] + twist[2] * y
    depth = sinkage_of(contact, load_n)
    flank = _earth_pressure(contact, depth, 0.0)
    heaped = _earth_pressure(contact, depth, heap_m2)
    for i in range(ELEMENTS):
        x = 0.5 * length - (i + 0.5) * step
        age = abs(front - x) / creep
        across = -(twist[1] + twist[2] * x)
        slid_x, slid_y = along * age, -(twist[1] + twist[2] * 0.5 * (x + front)) * age
        pressure = load_n / contact[AREA] * (1.0 + 12.0 * ahead_m * x / (length * length))
        stress = contact[COHESION] + pressure * contact[TAN_FRICTION]
        stress *= -math.expm1(-math.hypot(slid_x, slid_y) / modulus)
        per_speed = stress * width * step / math.sqrt(along * along + across * across + SLIDING_MPS**2)
        force_x, force_y = per_speed * along, per_speed * across
        if flank > 0.0:
            pushed = heaped if across * y < 0.0 else flank  # the inner track's side that faces the turn
            share = -math.expm1(-abs(slid_y) / MOBILISED_M)
            force_y += pushed * share * step * across / math.sqrt(across * across + SLIDING_MPS**2)
        out[0] += force_x
        out[1] += force_y
        out[2] += x * force_y - y * force_x
    moving = twist[0] - twist[2] * y
    resists = contact[ROLLING] * load_n
    if depth > 0.0:
        modulus_b = contact[KC] + contact[WIDTH] * contact[KPHI]
        resists += compaction_resistance(depth, modulus_b, contact[EXPONENT])
    resists *= moving / math.sqrt(moving * moving + ROLLING_MPS**2)
    out[0] -= resists
    out[2] += y * resists


@njit(cache=True)
def _earth_pressure(contact: Array, depth_m: float, heap_m2: float) -> float:
    """Return the force on each metre of a side that pushes soil of a depth, and of a heap on it."""
    if contact[BULLDOZING] == 0.0:
        return 0.0
    square = depth_m * depth_m + 2.0 * heap_m2
    passive = contact[PASSIVE]
    cohesive = 2.0 * contact[COHESION] * depth_m * math.sqrt(passive)
    return float(contact[BULLDOZING] * (0.5 * UNIT_WEIGHT_NPM3 * square * passive + cohesive))
