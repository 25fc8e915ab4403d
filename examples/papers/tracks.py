r"""A track in steady straight motion: its sinkage, what resists it on a grade, and the slip that it needs.

Of a robot of weight W on two tracks, each b wide and l long, on a grade (Yamauchi et al., (8) to (22))::

    p = W cos(grade) / (2 b l),      z0 = (p / (kc / b + kphi))^(1 / n)      (8)
    Rc = 2 b int_0^z0 p dz = 2 (kc + b kphi) z0^(n + 1) / (n + 1)            (9)
    Rt = W sin(grade)                                                        (10)
    (A c + W cos(grade) tan phi) (1 - (1 - exp(-x)) / x) = R,  x = alpha l / K   (17), (19)
    alpha = (Rc + Rt) / C,  C = (A c + W tan phi) l / (2 K)                   (22), of small slip

**Corrected**: (8) prints n times the root, it is the n-th root; (10) is the grade, uphill positive, whatever
the roll; (17) and (19) print ``1 - exp(-x) / x``.  Rolling resistance of the tracks is added to Rc.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import lambertw

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import TrackedRobot
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import (
    compaction_resistance,
    friction_limit,
    mobilised_ratio,
    plate_sinkage,
    rolling_resistance,
)

LARGEST_SLIP = 1.0


class TrackBalance(NamedTuple):
    """Forces on a tracked robot in steady straight motion up a grade.

    Parameters
    ----------
    sinkage_m : z0
    compaction_n, rolling_n, grade_n : resistances of both tracks
    limit_n : the largest thrust
    slip_ratio : at which the thrust is what resists; NaN beyond the tracks' reach
    """

    sinkage_m: float
    compaction_n: float
    rolling_n: float
    grade_n: float
    limit_n: float
    slip_ratio: float


def shear_of_ratio(ratio: Any) -> Array:
    """Return the shearing ``x = s l / K`` (...) of a share of the limit; inverts ``mobilised_ratio``.

    ``f = 1 - (1 - exp(-x)) / x`` is ``x = g + W(-g exp(-g))`` with ``g = 1 / (1 - f)`` and the branch W_0 of
    Lambert's function.  Near f = 0 that is at the branch point, where half of the digits are lost: there a
    series is taken, and a step of Newton's method follows everywhere.

    Parameters
    ----------
    ratio : shares of the limit; NaN comes out for negative ones, and at or beyond the limit

    Examples
    --------
    >>> shear_of_ratio([0.0, 0.367879441171, 0.99, 1.0]).round(6)
    array([  0.,   1., 100.,  nan])
    """
    f = np.asarray(ratio, float)
    f = np.where((f >= 0.0) & (f < 1.0), f, np.nan)
    g = 1.0 / (1.0 - f)
    closed = g + lambertw(-g * np.exp(-g)).real
    x = np.where(f < 0.01, f * (2.0 + f * (4.0 / 3.0 + f * 10.0 / 9.0)), closed)
    for _ in range(2):
        shares = np.vectorize(mobilised_ratio, otypes=[float])(np.nan_to_num(x))
        slope = np.where(x > 1e-4, (np.exp(-x) - (1.0 - shares)) / -np.maximum(x, 1e-4), 0.5 - x / 3.0)
        x = np.where(x < 30.0, x - (shares - f) / slope, x)
    return np.asarray(x)


def janosi_slip(force_n: Any, limit_n: float, contact_length_m: float, shear_modulus_m: float) -> Array:
    """Return the slip (...) that a force takes on ground that shears, with its sign: (7) of Tazzari inverted.

    Parameters
    ----------
    force_n : any; NaN comes out at or beyond the limit
    limit_n, contact_length_m, shear_modulus_m : as for :func:`~terrain.terramechanics.traction.janosi_force`

    Examples
    --------
    >>> janosi_slip([42.1565, -42.1565, 170.0], 170.0, 0.12, 0.02).round(4)
    array([ 0.1, -0.1,  nan])
    """
    force = np.asarray(force_n, float)
    slip = shear_of_ratio(np.abs(force) / limit_n) * (shear_modulus_m / contact_length_m)
    return np.asarray(np.copysign(slip, force))


def grade_resistance(weight_n: float, grade_rad: float) -> float:
    """Return the part of the weight in N that pulls back; uphill positive, ``grade = -pitch`` in body frames.

    Corrected: Yamauchi (10) prints ``W cos(roll) sin(pitch)``.

    Examples
    --------
    >>> round(grade_resistance(900.0, 0.1), 1), round(grade_resistance(900.0, -0.1), 1)
    (89.9, -89.9)
    """
    return weight_n * math.sin(grade_rad)


def _check(soil: Soil) -> None:
    if soil.law != "janosi":
        raise ConfigError(f"soil {soil.name!r} has the law {soil.law!r}; tracks need the law 'janosi'")


def track_balance(robot: TrackedRobot, soil: Soil, grade_rad: float) -> TrackBalance:
    """Return what resists a tracked robot on a grade, and the slip that it climbs with.

    Parameters
    ----------
    robot : its weight, and the size of its tracks
    soil : ground that shears; without Bekker's numbers it does not yield
    grade_rad : uphill positive

    Raises
    ------
    ConfigError
        if the soil does not shear.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.terramechanics.soil import load_soil
    >>> robot, sand = load_robot("patako"), load_soil("toyoura_sand")
    >>> [round(track_balance(robot, sand, grade).grade_n, 1) for grade in (0.0, 0.3)]
    [0.0, 72.5]
    >>> [round(track_balance(robot, sand, grade).slip_ratio, 4) for grade in (0.0, 0.3)]
    [0.0043, 0.0773]
    """
    _check(soil)
    weight = robot.mass_kg * GRAVITY_MPS2
    normal = weight * math.cos(grade_rad)
    area = 2.0 * robot.track_width_m * robot.contact_length_m
    depth = compaction = 0.0
    if math.isfinite(soil.kphi_npmn2):
        exponent, width = soil.sinkage_exponent_ratio, robot.track_width_m
        depth = float(plate_sinkage(normal / area, width, soil.kc_npmn1, soil.kphi_npmn2, exponent))
        compaction = 2.0 * compaction_resistance(depth, soil.kc_npmn1 + width * soil.kphi_npmn2, exponent)
    rolling = rolling_resistance(normal, soil.rolling_resistance_ratio)
    grade = grade_resistance(weight, grade_rad)
    limit = friction_limit(normal, area, soil.cohesion_pa, math.tan(soil.friction_angle_rad))
    slip = _slip_for(compaction + rolling + grade, limit, robot.contact_length_m / soil.shear_modulus_m)
    return TrackBalance(depth, compaction, rolling, grade, limit, slip)


def _slip_for(force_n: float, limit_n: float, length_ratio: float) -> float:
    """Return the slip at which a track pushes with a force; NaN where it cannot."""
    share = abs(force_n) / limit_n
    if share >= mobilised_ratio(LARGEST_SLIP * length_ratio):
        return math.nan
    found = brentq(lambda slip: mobilised_ratio(slip * length_ratio) - share, 0.0, LARGEST_SLIP, xtol=1e-12)
    return math.copysign(float(found), force_n)


def straight_slip_line(robot: TrackedRobot, soil: Soil) -> tuple[float, float]:
    """Return intercept and slope, per rad, of the slip ratio over the grade, (22).

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.terramechanics.soil import load_soil
    >>> [round(number, 4) for number in straight_slip_line(load_robot("patako"), load_soil("toyoura_sand"))]
    [0.0042, 0.1334]
    """
    level = track_balance(robot, soil, 0.0)
    stiffness = level.limit_n * robot.contact_length_m / (2.0 * soil.shear_modulus_m)
    weight = robot.mass_kg * GRAVITY_MPS2
    return (level.compaction_n + level.rolling_n) / stiffness, weight / stiffness
