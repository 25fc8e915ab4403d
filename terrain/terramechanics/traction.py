"""Force of a wheel against its slip, and all that one wheel gets from the ground.

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
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from scipy.optimize import brentq
from scipy.special import lambertw

from terrain.records import Array
from terrain.terramechanics.resistance import (
    compaction_resistance,
    contact_length,
    rigid_wheel_sinkage,
    rolling_resistance,
    slip_sinkage_factor,
)
from terrain.terramechanics.soil import Soil

GROUND_SIZE = 15
"""Numbers in what :func:`ground_array` returns, at the places that follow."""

(
    HARD,
    RADIUS,
    WIDTH,
    CONTACT,
    COHESION,
    TAN_FRICTION,
    SHEAR_MODULUS,
    STIFFNESS,
    SHAPE,
    PEAK,
    CURVATURE,
    SINKAGE_MODULUS,
    SINKAGE_EXPONENT,
    ROLLING,
    SLIP_SINKAGE,
) = range(GROUND_SIZE)

_SMALL = 0.01
"""Below this s l / K a series is nearer the truth than a difference of nearly equal numbers."""

_N_BRACKETS = 1000
"""Steps of slip in which a balance is sought: a reach within the 0.001 beside a peak goes unseen."""


@njit(cache=True)
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


@njit(cache=True)
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


def shear_of_ratio(ratio: Any) -> Array:
    """Return the shearing ``x = s l / K`` (...) of a share of the limit; inverts :func:`mobilised_ratio`.

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
    limit_n, contact_length_m, shear_modulus_m : as for :func:`janosi_force`

    Examples
    --------
    >>> janosi_slip([42.1565, -42.1565, 170.0], 170.0, 0.12, 0.02).round(4)
    array([ 0.1, -0.1,  nan])
    """
    force = np.asarray(force_n, float)
    slip = shear_of_ratio(np.abs(force) / limit_n) * (shear_modulus_m / contact_length_m)
    return np.asarray(np.copysign(slip, force))


@njit(cache=True)
def friction_limit(normal_n: float, area_m2: float, cohesion_pa: float, tan_friction: float) -> float:
    """Return the largest force in N of Mohr and Coulomb: c A + N tan(phi)."""
    return cohesion_pa * area_m2 + normal_n * tan_friction


@njit(cache=True)
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


def ground_array(soil: Soil, wheel_radius_m: float, tyre_width_m: float, contact_length_m: float) -> Array:
    """Return what :func:`wheel_ground` needs of a soil and a wheel, (GROUND_SIZE,).

    Numbers that the soil does not have are 0; a sinkage modulus of 0 is ground that does not yield.

    Parameters
    ----------
    soil : the ground
    wheel_radius_m, tyre_width_m : of the wheel
    contact_length_m : of the tyre on firm ground
    """
    ground = np.zeros(GROUND_SIZE)
    ground[HARD] = soil.law == "magic"
    ground[RADIUS], ground[WIDTH], ground[CONTACT] = wheel_radius_m, tyre_width_m, contact_length_m
    ground[COHESION], ground[TAN_FRICTION] = soil.cohesion_pa, math.tan(soil.friction_angle_rad)
    ground[SHEAR_MODULUS] = soil.shear_modulus_m
    ground[STIFFNESS], ground[SHAPE] = soil.stiffness_ratio, soil.shape_ratio
    ground[PEAK], ground[CURVATURE] = soil.peak_friction_ratio, soil.curvature_ratio
    ground[SINKAGE_MODULUS] = soil.kc_npmn1 + tyre_width_m * soil.kphi_npmn2
    ground[SINKAGE_EXPONENT] = soil.sinkage_exponent_ratio
    ground[ROLLING], ground[SLIP_SINKAGE] = soil.rolling_resistance_ratio, soil.slip_sinkage_ratio
    return np.nan_to_num(ground)


@njit(cache=True)
def wheel_ground(
    ground: Array, normal_n: float, slip_x: float, slip_y: float
) -> tuple[float, float, float, float]:
    """Return what the ground does to one wheel; the inner loop of the simulator.

    Parameters
    ----------
    ground : as :func:`ground_array` gives it
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
    radius, modulus, exponent = ground[RADIUS], ground[SINKAGE_MODULUS], ground[SINKAGE_EXPONENT]
    resistance = rolling_resistance(normal_n, ground[ROLLING])
    sinkage = 0.0
    if modulus > 0.0:
        sinkage = rigid_wheel_sinkage(normal_n, radius, modulus, exponent)
        sinkage = min(sinkage * slip_sinkage_factor(slip_x, ground[SLIP_SINKAGE]), radius)
        resistance += compaction_resistance(sinkage, modulus, exponent)
    slip = math.hypot(slip_x, slip_y)
    if slip == 0.0:
        return 0.0, 0.0, resistance, sinkage
    if ground[HARD] > 0.0:
        force = magic_force(slip, normal_n, ground[STIFFNESS], ground[SHAPE], ground[PEAK], ground[CURVATURE])
    else:
        length = contact_length(sinkage, radius, ground[CONTACT])
        limit = friction_limit(normal_n, length * ground[WIDTH], ground[COHESION], ground[TAN_FRICTION])
        force = janosi_force(slip, limit, length, ground[SHEAR_MODULUS])
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
    wheel_radius_m, tyre_width_m, contact_length_m : as for :func:`ground_array`
    """
    ground = ground_array(soil, wheel_radius_m, tyre_width_m, contact_length_m)
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
    wheel_radius_m, tyre_width_m, contact_length_m : as for :func:`ground_array`

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
