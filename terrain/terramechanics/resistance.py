"""What resists a wheel: the soil it compacts, its own rolling, and the grade.

With the load N, the wheel's radius r and width b, and Bekker's kc, kphi and n (Bekker, Theory of Land
Locomotion, 1956; Wong, Theory of Ground Vehicles, chapter 2)::

    p(z) = (kc / b + kphi) z^n                          pressure at the depth z
    k = kc + b kphi                                     of one metre of a wheel's width: b p(z) = k z^n
    z0 = (3 N / ((3 - n) k sqrt(2 r)))^(2 / (2 n + 1))  sinkage of a rigid wheel
    Rc = k z0^(n + 1) / (n + 1)                         work of pressing a rut of depth z0, a metre travelled

z0 takes the wheel's circumference for a parabola and (z0 - x^2 / 2r)^n to first order in x^2: at that
depth the soil carries N within 9 % for n up to 1.3, beside an error of the order of z0 / 4r.
"""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True)
def bekker_pressure(
    sinkage_m: float, width_m: float, kc_npmn1: float, kphi_npmn2: float, exponent: float
) -> float:
    """Return the pressure in Pa under a plate of the smaller side ``width_m`` at a depth.

    Examples
    --------
    >>> bekker_pressure(0.01, 0.1, 13190.0, 692150.0, 0.5)
    82405.0
    """
    return (kc_npmn1 / width_m + kphi_npmn2) * math.pow(sinkage_m, exponent)


@njit(cache=True)
def rigid_wheel_sinkage(normal_n: float, wheel_radius_m: float, modulus: float, exponent: float) -> float:
    """Return the depth in m at which soil carries a rigid wheel.

    Parameters
    ----------
    normal_n : load, not negative
    wheel_radius_m : radius of the wheel
    modulus : k = kc + b kphi in N/m^(n+1)
    exponent : n, below 3

    Examples
    --------
    >>> round(rigid_wheel_sinkage(300.0, 0.2, 153833.0, 1.1), 4)
    0.0359
    """
    first = 3.0 * normal_n / ((3.0 - exponent) * modulus * math.sqrt(2.0 * wheel_radius_m))
    return math.pow(first, 2.0 / (2.0 * exponent + 1.0))


@njit(cache=True)
def plate_sinkage(
    pressure_pa: float, width_m: float, kc_npmn1: float, kphi_npmn2: float, exponent: float
) -> float:
    """Return the depth in m at which soil carries a plate, a track, say: (p / (kc / b + kphi))^(1 / n).

    Corrected: Yamauchi (8) prints n times the root; it is the n-th root.

    Parameters
    ----------
    pressure_pa : not negative
    width_m : smaller side of the plate
    kc_npmn1, kphi_npmn2, exponent : of Bekker

    Examples
    --------
    >>> depth_m = plate_sinkage(5000.0, 0.15, 990.0, 1528430.0, 1.1)
    >>> round(bekker_pressure(depth_m, 0.15, 990.0, 1528430.0, 1.1))
    5000
    """
    return math.pow(pressure_pa / (kc_npmn1 / width_m + kphi_npmn2), 1.0 / exponent)


@njit(cache=True)
def slip_sinkage_factor(slip_ratio: float, exponent: float) -> float:
    """Return by what slip multiplies sinkage: ((1 + |s|) / (1 - |s| / 2))^exponent, 1 for an exponent of 0.

    Lyasko, Slip sinkage effect in soil-vehicle mechanics, Journal of Terramechanics 47 (2010), with an
    exponent, so that the effect can be absent.

    Examples
    --------
    >>> slip_sinkage_factor(0.5, 1.0), slip_sinkage_factor(0.5, 0.0)
    (2.0, 1.0)
    """
    if exponent == 0.0:
        return 1.0
    slip = min(abs(slip_ratio), 1.0)
    return math.pow((1.0 + slip) / (1.0 - 0.5 * slip), exponent)


@njit(cache=True)
def compaction_resistance(sinkage_m: float, modulus: float, exponent: float) -> float:
    """Return the force in N that presses a rut of that depth: the work of p(z) b, a metre travelled.

    Parameters
    ----------
    sinkage_m : depth of the rut
    modulus, exponent : as for :func:`rigid_wheel_sinkage`
    """
    return modulus * math.pow(sinkage_m, exponent + 1.0) / (exponent + 1.0)


@njit(cache=True)
def rolling_resistance(normal_n: float, ratio: float) -> float:
    """Return the force in N against rolling that goes with the load; no load, no resistance."""
    return max(normal_n, 0.0) * ratio


@njit(cache=True)
def grade_resistance(weight_n: float, grade_rad: float) -> float:
    """Return the part of the weight in N that pulls back; uphill positive, ``grade = -pitch`` in body frames.

    Corrected: Yamauchi (10) prints ``W cos(roll) sin(pitch)``.

    Examples
    --------
    >>> round(grade_resistance(900.0, 0.1), 1), round(grade_resistance(900.0, -0.1), 1)
    (89.9, -89.9)
    """
    return weight_n * math.sin(grade_rad)


@njit(cache=True)
def contact_length(sinkage_m: float, wheel_radius_m: float, tyre_contact_m: float) -> float:
    """Return over which length in m the wheel shears: its arc in the ground, at least the tyre's own contact.

    The arc runs from where the wheel enters the soil to its lowest point, r acos(1 - z / r).

    Examples
    --------
    >>> contact_length(0.0, 0.2, 0.12), round(contact_length(0.05, 0.2, 0.12), 4)
    (0.12, 0.1445)
    """
    depth = min(max(sinkage_m / wheel_radius_m, 0.0), 1.0)
    return max(tyre_contact_m, wheel_radius_m * math.acos(1.0 - depth))
