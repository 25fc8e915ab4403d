"""Forces on a rigid wheel in sand at a slip and a slip angle: stresses of its arc, pressure on its side face.

In the wheel's axes, x ahead, y towards where the ground pushes a wheel of positive slip angle beta, z up,
with the circumferential speed v = r omega, the speed of travel V, the sinkage h and the load W.

Arc (Wong and Reece, Journal of Terramechanics 4, 1967; Wong, Theory of Ground Vehicles, 2.5), from the angle
of entry tf = acos(1 - h / r) to that of exit tr = -(l0 + l1 s+) tf, highest at tm = (c1 + c2 s+) tf, where
s+ = max(s, 0): a skidding wheel has the angles of one that rolls, as Pavlov and Johnson take them::

    p(t) = A (f(t) (r (cos te - cos tf) / b)^n  +  g sin(beta) (r (cos t - cos tf) / b)^n)
    te   = t in front of tm, tf - (t - tr) / (tm - tr) (tf - tm) behind it
    q(t) = (c + p tan(phi)) (1 - exp(-j / K)),      j = hypot(jx, jy)

    jx = r ((tf - t) - V cos(beta) / v (sin tf - sin t))     Wong and Reece
    jy = r (tf - t) V sin(beta) / v                          Ishigami et al., J. Field Robotics 24, 2007

The shear stress q points along the velocity (v - V cos(beta) cos t, V sin(beta)) of the wheel's surface over
the ground.  c1, c2 and l0 are Wong and Reece's and Ishigami's; l1 lets the soil that a spinning wheel moves
behind itself carry it there.

Inflow.  A wheel that travels at an angle cuts its contact off: a strip of soil carries it from where it comes
in at the front until the side face has passed over it.  With the time t_in from the entry to the angle t, by
the wheel's turning or by its travel, whichever is shorter, a fraction of the width is soil from the front::

    f(t) = max(0, 1 - V sin(beta) t_in / b) cos(beta)^0.2
    t_in = min((tf - t) / omega, r (sin tf - sin t) / (V cos(beta)))

The last factor is 1 but near 90 degrees, where nothing comes in at the front.  What comes in from the side
carries a fraction g of that, in front of and behind the axle alike.

Side face, over the area of the disc below the soil's surface, d below it and e below the axle::

    N(d)  = gamma Kp b (d / b)^ns sin(beta)^ab (V / hypot(V, omega e))^a
    side  = sum of N;   traction += mu_s N (omega e - V cos(beta)) / l;   lift += L N V sin(beta) / l
    l     = hypot(omega e - V cos(beta), V sin(beta))

With ns = 1, ab = 1, a = 0, mu_s = L = 0 and Kp = D1 D2 of their bulldozing resistance this is Ishigami's side
force, integrated over the area of the side face: printed is (r - h cos t) dt where the width of a strip is
r cos t dt.  The side face presses the wedge of soil before it sideways and up: L is that friction.

The amplitude A follows from the load, W = (arc's push up) + lift; A in Pa is the pressure at a depth of one
wheel width, an apparent modulus, and never below what carries a tenth of the load.  The measured traction
may hold a fraction x of the side force (``coupling_ratio``): a locked wheel that is dragged along its axle
has no traction, by symmetry; where such trials are there, it is not fitted but taken from them.
"""

from __future__ import annotations

import math

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.kernels import njit
from terrain.records import Array

#: Parameters n, c1, c2, l0, l1, tan(phi), K, g, Kp, ns, ab, a, mu_s, L, x, c, whether f is taken (or 1).
#: Each with where a fit begins, the standard deviation of its prior, and its bounds. Sources of the centres:
#: n, K and phi, Wong, table 2.3 and chapter 2, sand, and the angle of repose of 29 degrees that the authors
#: of the trials measured; c1, c2, l0, Ishigami 2007, Wong and Reece 1967; Kp, Ishigami's D1 D2 at 29 degrees
#: is 11.
FORCE: dict[str, tuple[float, float, float, float]] = {
    "pressure_exponent": (0.8, 0.3, 0.1, 2.5),
    "peak_ratio": (0.5, 0.2, 0.0, 0.95),
    "peak_slip_ratio": (0.0, 0.2, -1.0, 1.0),
    "exit_ratio": (0.3, 0.2, 0.0, 1.0),
    "exit_slip_ratio": (0.1, 0.2, -1.0, 1.5),
    "tan_friction": (0.55, 0.1, 0.1, 1.2),
    "shear_modulus_m": (0.01, 0.01, 5e-4, 0.1),
    "side_inflow_ratio": (0.3, 0.3, 0.0, 1.0),
    "side_pressure_ratio": (15.0, 10.0, 0.0, 80.0),
    "side_depth_exponent": (1.0, 0.4, 0.1, 2.0),
    "travel_exponent": (1.0, 0.3, 0.0, 3.0),
    "rotation_exponent": (0.5, 0.5, 0.0, 5.0),
    "side_friction_ratio": (0.4, 0.2, 0.0, 1.2),
    "side_lift_ratio": (0.2, 0.2, 0.0, 2.0),
    "coupling_ratio": (0.0, 0.1, -0.5, 0.5),
    "cohesion_pa": (0.0, 300.0, 0.0, 5e3),
    "inflow": (1.0, 1.0, 0.0, 1.0),
}
NAMES = tuple(FORCE)
#: Of the dry sand, by the density that the authors of the trials measured.
UNIT_WEIGHT_NPM3 = 1330.0 * GRAVITY_MPS2
INFLOW_EXPONENT = 0.2
_N_ARC, _N_SIDE = 40, 20
#: Circumferential speed over that of travel below which a wheel shears as one that stands still.
_SLOWEST = 1e-2
#: Part of the load that the arc carries at least; and its least push up, over that of its pressure alone.
_LEAST = 0.1


def bulldozing_ratio(tan_friction: float) -> float:
    """Return D1 D2 of the bulldozing resistance of cohesionless soil, whose pressure is D1 D2 gamma d.

    ::

        X = 45 deg - phi / 2,   D1 = cot X + tan(X + phi),   D2 = cot X + cot(X)^2 / cot(phi)

    Source: Hegedus 1960, as in Ishigami et al. 2007.

    Examples
    --------
    >>> round(bulldozing_ratio(math.tan(math.radians(29.0))), 1)
    11.2
    """
    phi = math.atan(tan_friction)
    broken = math.pi / 4.0 - phi / 2.0
    cot = 1.0 / math.tan(broken)
    return (cot + math.tan(broken + phi)) * (cot + cot**2 * tan_friction)


@njit
def arc_sums(p: Array, r: float, b: float, motion: tuple[float, float, float], h: float) -> Array:
    """Return forces (2, 3) in N of the arc: for a pressure amplitude of 1 Pa, and of the cohesion.

    Parameters
    ----------
    p : (17,) in the order of :data:`FORCE`
    r, b : radius and width of the wheel
    motion : omega in rad/s, V cos(beta) and V sin(beta) in m/s, the last not negative
    h : sinkage
    """
    n, c1, c2, l0, l1, tan_phi, shear, g = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7]
    omega, ahead, across = motion
    travel, speed = math.hypot(ahead, across), r * omega
    slip = max((speed - travel) / max(speed, travel), 0.0)
    entry = math.acos(max(1.0 - h / r, -0.999))
    leave = -min(max(l0 + l1 * slip, 0.0), 1.0) * entry
    peak = min(max(c1 + c2 * slip, -0.2), 0.98) * entry
    slowest = max(speed, _SLOWEST * travel)
    sine_entry = math.sin(min(entry, math.pi / 2.0))
    sine, cosine = across / travel, max(ahead / travel, 0.0)
    out = np.zeros((2, 3))
    step = 2.0 * entry / _N_ARC
    for i in range(_N_ARC):
        t = entry - (i + 0.5) * step
        pressure = 0.0
        if t > leave:
            seen = t if t >= peak else entry - (t - leave) / (peak - leave) * (entry - peak)
            depth = max(r * (math.cos(seen) - math.cos(entry)), 0.0)
            part = 1.0
            if p[16] > 0.0:
                by_travel = max(r * (sine_entry - math.sin(t)), 0.0) / max(ahead, 1e-12)
                since = min(by_travel, (entry - t) / max(omega, 1e-12))
                part = max(1.0 - across * since / b, 0.0) * cosine**INFLOW_EXPONENT
            pressure = part * (depth / b) ** n
        if g > 0.0 and across > 0.0:
            depth = max(r * (math.cos(t) - math.cos(entry)), 0.0)
            pressure += g * sine * (depth / b) ** n
        over_x, over_y = speed - ahead * math.cos(t), across
        over = math.hypot(over_x, over_y) + 1e-12
        jx = r * ((entry - t) - ahead / slowest * (sine_entry - math.sin(t)))
        jy = r * (entry - t) * across / slowest
        sheared = 1.0 - math.exp(-math.hypot(jx, jy) / shear)
        for row in range(2):
            normal = pressure if row == 0 else 0.0
            stress = (pressure * tan_phi if row == 0 else (p[15] if t > leave else 0.0)) * sheared
            along = stress * over_x / over
            area = r * b * step
            out[row, 0] += (along * math.cos(t) - normal * math.sin(t)) * area
            out[row, 1] += stress * over_y / over * area
            out[row, 2] += (normal * math.cos(t) + along * math.sin(t)) * area
    return out


@njit
def side_sums(p: Array, r: float, b: float, motion: tuple[float, float, float], h: float) -> Array:
    """Return forces (3,) in N on the side face; parameters as :func:`arc_sums`."""
    omega, ahead, across = motion
    out = np.zeros(3)
    if across <= 0.0:
        return out
    travel = math.hypot(ahead, across)
    step = h / _N_SIDE
    for i in range(_N_SIDE):
        depth = (i + 0.5) * step
        below_axle = r - h + depth
        half = r * r - below_axle * below_axle
        if half <= 0.0:
            continue
        area = 2.0 * math.sqrt(half) * step
        pressure = UNIT_WEIGHT_NPM3 * p[8] * b * (depth / b) ** p[9] * (across / travel) ** p[10]
        normal = pressure * (travel / math.hypot(travel, omega * below_axle)) ** p[11] * area
        over = omega * below_axle - ahead
        length = math.hypot(over, across)
        out[0] += p[12] * normal * over / length
        out[1] += normal
        out[2] += p[13] * normal * across / length
    return out


@njit
def wheel_forces(p: Array, r: float, b: float, trials: Array, depths: Array) -> Array:
    """Return traction and side force in N and the apparent modulus A in Pa of each trial (n, 3).

    Parameters
    ----------
    p : (17,) in the order of :data:`FORCE`
    r, b : radius, up to the grousers' tips, and width of the wheel
    trials : (n, 4): omega in rad/s, speed of travel in m/s, slip angle in rad within 90 degrees, load in N
    depths : (n,) sinkage in m
    """
    out = np.zeros((trials.shape[0], 3))
    for k in range(trials.shape[0]):
        omega, travel, angle, load = trials[k, 0], trials[k, 1], trials[k, 2], trials[k, 3]
        motion = (omega, travel * math.cos(angle), travel * abs(math.sin(angle)))
        arc = arc_sums(p, r, b, motion, depths[k])
        side = side_sums(p, r, b, motion, depths[k])
        push = max(arc[0, 2], 1e-3 * r * b)
        amplitude = max(load - side[2] - arc[1, 2], _LEAST * load) / push
        across = amplitude * arc[0, 1] + arc[1, 1] + side[1]
        out[k, 0] = amplitude * arc[0, 0] + arc[1, 0] + side[0] + p[14] * across
        out[k, 1] = math.copysign(across, angle) if angle != 0.0 else 0.0
        out[k, 2] = amplitude
    return out
