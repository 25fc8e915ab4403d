"""All that one wheel gets from the ground: force against its slip, sinkage, and what resists its rolling.

On ground that shears, under an even pressure (Janosi and Hanamoto 1961; Wong, Theory of Ground Vehicles,
chapter 2)::

    F = Fmax (1 - (K / (s l)) (1 - exp(-s l / K)))      Fmax = c A + N tan(phi)

with the slip s, the contact's length l and area A, the load N, cohesion c, friction angle phi and shear
modulus K (as Tazzari (7); corrected: Yamauchi (17) and (19) print ``1 - K/(s l) exp(-s l / K)``, which has no
limit at s = 0).  On hard ground the Magic Formula (Pacejka, Tyre and Vehicle Dynamics)::

    F = N D sin(C atan(B s - E (B s - atan(B s))))

Both take the magnitude of the slip vector (longitudinal, lateral), and the force has its direction: ground is
isotropic, and the force never leaves the circle of the friction limit.  Cohesion holds on the whole contact,
however light the load: these laws know no contact that shrinks under a wheel about to lift.

What resists a wheel is the soil it compacts and its own rolling.  With the wheel's radius r and width b, and
Bekker's kc, kphi and n (Bekker, Theory of Land Locomotion, 1956; Wong, chapter 2)::

    p(z) = (kc / b + kphi) z^n                          pressure at the depth z
    k = kc + b kphi                                     of one metre of a wheel's width: b p(z) = k z^n
    z0 = (3 N / ((3 - n) k sqrt(2 r)))^(2 / (2 n + 1))  sinkage of a rigid wheel
    Rc = k z0^(n + 1) / (n + 1)                         work of pressing a rut of depth z0, a metre travelled

z0 takes the wheel's circumference for a parabola and (z0 - x^2 / 2r)^n to first order in x^2: at that
depth the soil carries N within 9 % for n up to 1.3, beside an error of the order of z0 / 4r.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.optimize import brentq

from terrain.kernels import filled, njit, numbers, record
from terrain.records import Array
from terrain.terramechanics.soil import Soil

#: A soil under a wheel: whether it is a road, whether it carries a plate and no wheel, the wheel, and the numbers of
#: :class:`Soil`, with tan(phi) and k = kc + b kphi.
GROUND = record(
    numbers(
        "wheel_radius_m tyre_width_m contact_length_m cohesion_pa tan_friction shear_modulus_m "
        "stiffness_ratio shape_ratio peak_friction_ratio curvature_ratio sinkage_modulus "
        "sinkage_exponent_ratio rolling_resistance_ratio slip_sinkage_ratio"
    )
    | {"hard": bool, "plate": bool}
)
_SMALL = 0.01  #: Below this s l / K a series is nearer the truth than a difference of nearly equal numbers

#: Steps of slip in which a balance is sought: a reach within the 0.001 beside a peak goes unseen.
_N_BRACKETS = 1000


@njit
def mobilised_ratio(x: float) -> float:
    """Return the share of the limit that shearing by ``x = s l / K >= 0`` mobilises: 1 - (1 - exp(-x)) / x.

    Examples
    --------
    >>> mobilised_ratio(0.0), round(mobilised_ratio(1.0), 4), round(mobilised_ratio(1e6), 4)
    (0.0, 0.3679, 1.0)
    """
    if x < _SMALL:
        return x / 2.0 * (1.0 - x / 3.0 * (1.0 - x / 4.0 * (1.0 - x / 5.0 * (1.0 - x / 6.0))))
    return 1.0 + math.expm1(-x) / x


@njit
def janosi_force(slip: float, limit_n: float, contact_length_m: float, shear_modulus_m: float) -> float:
    """Return the force in N of ground that shears; it has the sign of the slip and rises towards the limit.

    Parameters
    ----------
    slip : any
    limit_n : Fmax, see :func:`friction_limit`
    contact_length_m, shear_modulus_m : l and K

    Examples
    --------
    >>> round(janosi_force(0.1, 170.0, 0.12, 0.02), 2), round(janosi_force(-0.1, 170.0, 0.12, 0.02), 2)
    (42.16, -42.16)
    """
    share: float = mobilised_ratio(abs(slip) * contact_length_m / shear_modulus_m)
    return math.copysign(limit_n, slip) * share


@njit
def friction_limit(normal_n: float, area_m2: float, cohesion_pa: float, tan_friction: float) -> float:
    """Return the largest force in N of Mohr and Coulomb: c A + N tan(phi)."""
    return cohesion_pa * area_m2 + normal_n * tan_friction


@njit
def magic_force(
    slip: float, normal_n: float, stiffness: float, shape: float, peak_friction: float, curvature: float
) -> float:
    """Return the force in N on hard ground; it has the sign of the slip and never exceeds N times D.

    A shape over 2 would turn the force round at large slip; it stays at 0 there.

    Examples
    --------
    >>> round(magic_force(0.05, 300.0, 10.0, 1.9, 1.0, 0.97), 1)
    220.7
    """
    x = stiffness * abs(slip)
    angle = shape * math.atan(x - curvature * (x - math.atan(x)))
    return math.copysign(normal_n * peak_friction, slip) * max(math.sin(angle), 0.0)


@njit
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


@njit
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


@njit
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


@njit
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


@njit
def compaction_resistance(sinkage_m: float, modulus: float, exponent: float) -> float:
    """Return the force in N that presses a rut of that depth: the work of p(z) b, a metre travelled.

    Parameters
    ----------
    sinkage_m : depth of the rut
    modulus, exponent : as for :func:`rigid_wheel_sinkage`
    """
    return modulus * math.pow(sinkage_m, exponent + 1.0) / (exponent + 1.0)


@njit
def rolling_resistance(normal_n: float, ratio: float) -> float:
    """Return the force in N against rolling that goes with the load; no load, no resistance."""
    return max(normal_n, 0.0) * ratio


@njit
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


def ground_record(
    soil: Soil, wheel_radius_m: float, tyre_width_m: float, contact_length_m: float, strips: int = 0
) -> Array:
    """Return a soil under a wheel, (1,) of :data:`GROUND`, whose contact on firm ground has a length.

    Numbers that the soil does not have are 0; a sinkage modulus of 0 is ground that does not yield.  Under a track
    that is cut lengthwise into so many ``strips``, it is that under one of them: together they sink, shear and compact
    as the track does.
    """
    known = {
        "wheel_radius_m": wheel_radius_m,
        "tyre_width_m": tyre_width_m / max(strips, 1),
        "contact_length_m": contact_length_m,
        "tan_friction": math.tan(soil.friction_angle_rad),
        "sinkage_modulus": (soil.kc_npmn1 + tyre_width_m * soil.kphi_npmn2) / max(strips, 1),
    }
    ground = filled(GROUND, hard=soil.law == "magic", plate=strips > 0)
    for name in GROUND.names or ():
        value = known.get(name, getattr(soil, name, math.nan))
        if math.isfinite(value):
            ground[name] = value
    return ground


@njit
def wheel_ground(
    ground: Any, normal_n: float, slip_x: float, slip_y: float
) -> tuple[float, float, float, float]:
    """Return what the ground does to one wheel; the inner loop of the simulator.

    Parameters
    ----------
    ground : a record of :data:`GROUND`
    normal_n : load; a wheel in the air (0 or less) gets nothing
    slip_x : SAE slip ratio, positive in traction
    slip_y : lateral slip, positive where the ground has to push the wheel to +y

    Returns
    -------
    thrust_x_n, force_y_n
        with the signs of the slips.
    resistance_n
        rolling and compaction, not negative; the caller sets it against the rolling.
    sinkage_m
        at most the wheel's radius.
    """
    if normal_n <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    radius, modulus, exponent = ground.wheel_radius_m, ground.sinkage_modulus, ground.sinkage_exponent_ratio
    resistance = rolling_resistance(normal_n, ground.rolling_resistance_ratio)
    sinkage = 0.0
    if modulus > 0.0:
        if ground.plate:
            sinkage = math.pow(normal_n / (modulus * ground.contact_length_m), 1.0 / exponent)
        else:
            sinkage = rigid_wheel_sinkage(normal_n, radius, modulus, exponent)
        sinkage = min(sinkage * slip_sinkage_factor(slip_x, ground.slip_sinkage_ratio), radius)
        resistance += compaction_resistance(sinkage, modulus, exponent)
    slip = math.hypot(slip_x, slip_y)
    if slip == 0.0:
        return 0.0, 0.0, resistance, sinkage
    if ground.hard:
        force = magic_force(
            slip,
            normal_n,
            ground.stiffness_ratio,
            ground.shape_ratio,
            ground.peak_friction_ratio,
            ground.curvature_ratio,
        )
    else:
        length = contact_length(sinkage, radius, ground.contact_length_m)
        limit = friction_limit(
            normal_n, length * ground.tyre_width_m, ground.cohesion_pa, ground.tan_friction
        )
        force = janosi_force(slip, limit, length, ground.shear_modulus_m)
    return force * (slip_x / slip), force * (slip_y / slip), resistance, sinkage


def net_pull(
    soil: Soil,
    normal_n: float,
    slip_ratio: Array,
    wheel_radius_m: float,
    tyre_width_m: float,
    contact_length_m: float,
) -> Array:
    """Return what a wheel that rolls ahead pulls, (n,) N: thrust less resistance at each slip (n,).

    Parameters
    ----------
    soil : the ground
    normal_n : load
    slip_ratio : (n,) SAE slip, positive in traction
    wheel_radius_m, tyre_width_m, contact_length_m : as for :func:`ground_record`
    """
    ground = ground_record(soil, wheel_radius_m, tyre_width_m, contact_length_m)[0]
    forces = [wheel_ground(ground, float(normal_n), float(slip), 0.0) for slip in slip_ratio]
    return np.array([thrust - resistance for thrust, _, resistance, _ in forces])


def equilibrium_slip(
    soil: Soil,
    normal_n: float,
    pull_n: float,
    wheel_radius_m: float,
    tyre_width_m: float,
    contact_length_m: float,
) -> float:
    """Return the slip nearest to 0 at which thrust is resistance plus a pull; NaN beyond the wheel's reach.

    Parameters
    ----------
    soil : the ground
    normal_n : load
    pull_n : what the wheel has to pull beside its own resistance; negative where it is pushed or brakes
    wheel_radius_m, tyre_width_m, contact_length_m : as for :func:`ground_record`

    Examples
    --------
    >>> from terrain.terramechanics.soil import load_soil
    >>> wheel = {"wheel_radius_m": 0.2, "tyre_width_m": 0.1, "contact_length_m": 0.12}
    >>> round(equilibrium_slip(load_soil("clay"), 300.0, 0.0, **wheel), 3)
    0.068
    >>> equilibrium_slip(load_soil("clay"), 300.0, 200.0, **wheel)
    nan
    """
    geometry = wheel_radius_m, tyre_width_m, contact_length_m

    def surplus_n(slips: Any) -> Array:
        return net_pull(soil, normal_n, np.atleast_1d(slips), *geometry) - pull_n

    end = 1.0 if surplus_n(0.0)[0] < 0.0 else -1.0
    slips = np.linspace(0.0, end, _N_BRACKETS + 1)
    reached = np.flatnonzero(surplus_n(slips) * end >= 0.0)
    if normal_n <= 0 or not len(reached):
        return math.nan
    if reached[0] == 0:
        return 0.0
    return float(brentq(lambda slip: surplus_n(slip)[0], *slips[reached[0] - 1 : reached[0] + 1], xtol=1e-12))
