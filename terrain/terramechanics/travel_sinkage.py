"""How deep a rigid wheel stands in sand, from its slip and the angle at which it travels.

With the wheel's circumferential speed v, the speed of travel V, the slip angle beta, and the slip ratio
s = (v - V) / max(v, V) (beta = 0 is travel along the wheel, 90 degrees along its axle)::

    u   = hypot(v - V cos(beta), V sin(beta)) / max(v, V)                 resultant slip
    h_r = h0 (1 + a u) (1 + d max(-s, 0)^e) + t_r max(sqrt(v / V) - 1, 0)  rolled over
    h_s = H r + t_s sqrt(v / V)                                            dragged sideways
    1 / h = (1 - C) / h_s + C / h_r,   C = cos(beta)^m                     in between

Two inflows of soil carry a wheel: what comes in at the front is rolled over and pressed, what comes in from
the side is cut off by the side face.  C is the part of the first, and the two act as springs side by side do,
so that the reciprocals of the depths add.  A spinning wheel moves soil behind itself, a volume that is
proportional to v / V a metre travelled; the trench that it leaves has slopes at the angle of repose, thus a
section that is proportional to the square of its depth, and the depth that is added goes with sqrt(v / V).
The rise with skid has the form of Lyasko's rise with slip, with an exponent of its own.

The law is empirical; of the load it says nothing, since it was found under one.  :func:`lyasko_sinkage` and
:func:`ding_sinkage` are the published laws that it is compared with: they do not know of the angle.
"""

from __future__ import annotations

import numpy as np

from terrain.records import Array
from terrain.terramechanics.traction import rigid_wheel_sinkage, slip_sinkage_factor

#: Parameters h0, a, d, e, H, t_s, t_r and m: where a fit begins, and the standard deviation of its prior.
#: A wheel that is dragged along its axle sinks until its axle is at the surface: from there on its side face
#: does not grow with depth. The others are factors and exponents of the order of 1, and depths of some mm.
TRAVEL: dict[str, tuple[float, float]] = {
    "rolling_m": (0.0144, 0.0072),
    "slip_ratio": (0.9, 0.9),
    "skid_ratio": (1.0, 1.0),
    "skid_exponent": (2.0, 1.0),
    "aside_ratio": (1.0, 0.05),
    "aside_spin_m": (0.004, 0.004),
    "rolling_spin_m": (0.003, 0.003),
    "angle_exponent": (0.6, 0.3),
}
LYASKO: dict[str, tuple[float, float]] = {"rolling_m": (0.0144, 0.0072), "slip_exponent": (1.0, 1.0)}
DING: dict[str, tuple[float, float]] = {"pressure_kpa": (50.0, 50.0), "exponent_slip": (0.5, 0.5)}

DEEPEST_RATIO = 1.9  #: Deepest sinkage over the radius: at 2 the wheel is under the soil


def travel_sinkage(
    parameters: Array, wheel_mps: Array, travel_mps: Array, slip_angle_rad: Array, radius_m: float
) -> Array:
    """Return the sinkage (n,) in m.

    Parameters
    ----------
    parameters : (8,) in the order of :data:`TRAVEL`
    wheel_mps : (n,) circumferential speed, not negative
    travel_mps : (n,) above 0
    slip_angle_rad : (n,) angle between wheel and travel; its sign does not matter
    radius_m : of the wheel, up to the grousers' tips

    Examples
    --------
    >>> start = np.array([value for value, _ in TRAVEL.values()])
    >>> speed = np.array([0.01, 0.01])
    >>> travel_sinkage(start, speed, speed, np.array([0.0, 0.5]), 0.058).round(4)
    array([0.0144, 0.0219])
    """
    rolling, slip, skid, skid_exponent, aside, aside_spin, rolling_spin, angle_exponent = parameters
    fastest = np.maximum(wheel_mps, travel_mps)
    ahead, across = travel_mps * np.cos(slip_angle_rad), travel_mps * np.sin(slip_angle_rad)
    resultant = np.hypot(wheel_mps - ahead, across) / fastest
    skidding = np.maximum((travel_mps - wheel_mps) / fastest, 0.0)
    spin = np.sqrt(wheel_mps / travel_mps)
    rolled = rolling * (1.0 + slip * resultant) * (1.0 + skid * skidding**skid_exponent)
    rolled = rolled + rolling_spin * np.maximum(spin - 1.0, 0.0)
    part = np.abs(np.cos(slip_angle_rad)) ** angle_exponent
    depth: Array = 1.0 / ((1.0 - part) / (aside * radius_m + aside_spin * spin) + part / rolled)
    return depth


def lyasko_sinkage(parameters: Array, slip_ratio: Array) -> Array:
    """Return the sinkage (n,) in m by Lyasko's factor of slip.

    Parameters
    ----------
    parameters : (2,) in the order of :data:`LYASKO`: sinkage without slip, exponent of the factor
    slip_ratio : (n,) from -1 to 1

    Examples
    --------
    >>> lyasko_sinkage(np.array([0.014, 1.0]), np.array([0.0, 0.5, -1.0]))
    array([0.014, 0.028, 0.056])
    """
    rolling_m, exponent = parameters
    return np.array([rolling_m * slip_sinkage_factor(slip, exponent) for slip in slip_ratio])


def ding_sinkage(
    parameters: Array, slip_ratio: Array, load_n: Array, radius_m: float, width_m: float
) -> Array:
    """Return the sinkage (n,) in m by Bekker's law with an exponent that rises with slip.

    ::

        n = 1 + n1 |s|,   z as rigid_wheel_sinkage has it

    Source: Ding et al., Slip sinkage of lunar rover's wheels, Journal of Terramechanics 47 (2010).

    Parameters
    ----------
    parameters : (2,) in the order of :data:`DING`: pressure at a depth of one wheel width in kPa, and n1
    slip_ratio : (n,) from -1 to 1
    load_n : (n,) above 0
    radius_m, width_m : of the wheel

    Examples
    --------
    >>> load_n = np.array([25.0, 25.0])
    >>> ding_sinkage(np.array([50.0, 0.5]), np.array([0.0, 1.0]), load_n, 0.058, 0.05).round(3)
    array([0.017, 0.026])
    """
    pressure_pa, rise = parameters[0] * 1e3, parameters[1]
    exponents = np.minimum(1.0 + rise * np.abs(slip_ratio), 2.5)
    return np.array(
        [
            rigid_wheel_sinkage(load, radius_m, pressure_pa * width_m ** (1.0 - n), n)
            for load, n in zip(load_n, exponents, strict=True)
        ]
    )
