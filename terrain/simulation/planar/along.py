"""Slip along a robot's heading, of skid-steer and of car-like robots.

With ``f = (m dv/dt + F) / (m g)`` and ``F`` what slope and resistances ask for, ``v = u - |u| c f`` is a
low-pass of ``u - |u| c F / (m g)`` with the time constant ``|u| c / g``, stepped exactly for what runs
straight from sample to sample; of car-like robots, which are fast, the time constant does, too.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.effects import INDEX
from terrain.records import Array
from terrain.simulation.contact import shear_softness, softness
from terrain.simulation.planar.model import Planar

STANDSTILL_MPS = 0.05
"""Speed over which a resistance takes its full size: it opposes motion and does not push a robot at rest."""

MAX_SLIP = 0.9
"""Slip that forces take at the most, of either sign; assumed: a straight thrust curve has no end of its
own."""

SHORTEST_S, FALLS_MOST = 1e-6, -0.9
"""Shorter time constants are none; one that falls faster than the second, in s/s, is taken as even."""

_FORCE_SLIP = INDEX["force_slip_ratio"]
_SHEAR_SLIP = INDEX["shear_slip_ratio"]
_SLIP_RESISTANCE = INDEX["slip_resistance_ratio"]
_ROLLING = INDEX["rolling_resistance_ratio"]
_DRAG = INDEX["viscous_drag_nspm"]
_PAYLOAD = INDEX["payload_ratio"]


@njit(cache=True)
def direction(speed_mps: float) -> float:
    """Return the direction of a motion, -1 to 1, and 0 at rest.

    Examples
    --------
    >>> round(direction(0.5), 3), direction(0.0)
    (0.995, 0.0)
    """
    return speed_mps / math.sqrt(speed_mps * speed_mps + STANDSTILL_MPS * STANDSTILL_MPS)


@njit(cache=True)
def _kept(before_s: float, after_s: float, dt: float) -> float:
    """Return what a step leaves of an offset where the time constant runs straight: ``v' = -v / tau``."""
    change = math.log(after_s / before_s)
    if abs(change) < 1e-3:
        return math.exp(-2.0 * dt / (before_s + after_s))
    return math.exp(-dt * change / (after_s - before_s))


@njit(cache=True)
def slip_along(
    planar: Planar, p: Array, dt: float, u: Array, scrub_n: Array, grade_rad: Array, disturbance: Array
) -> tuple[Array, Array, Array]:
    """Return speed over ground, resistance with the slope, and slip (n,).

    Parameters
    ----------
    u, scrub_n : (n,) speed without slip, and what resists in turns
    planar, p, dt, grade_rad, disturbance : as ``planar.motion.move`` has them
    """
    n = u.size
    weight = planar.mass_kg * GRAVITY_MPS2
    mass = planar.mass_kg * (1.0 + p[_PAYLOAD])
    carried = weight * (1.0 + planar.load_ratio * p[_PAYLOAD])
    rolling = (planar.rolling_ratio + p[_ROLLING]) * (1.0 + p[_PAYLOAD]) * weight
    speed, rest, slips, ground = np.zeros(n), np.zeros(n), np.zeros(n), planar.soft_ratio
    target_before, tau_before, force_ratio, slip = 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        v = speed[k - 1] + u[k] - u[k - 1] if k > 0 else u[0]  # without the lag of a step
        smooth = math.sqrt(v * v + STANDSTILL_MPS * STANDSTILL_MPS)
        force = mass * GRAVITY_MPS2 * planar.effective_ratio * math.sin(grade_rad[k]) + rolling * v / smooth
        force += p[_DRAG] * v + p[_SLIP_RESISTANCE] * abs(slip) * weight * v / smooth
        force += scrub_n[k]
        rest[k] = force
        compliance = softness(ground, abs(slip)) + p[_FORCE_SLIP]
        if p[_SHEAR_SLIP] != 0.0:
            compliance += p[_SHEAR_SLIP] * shear_softness(force_ratio, planar.grip_ratio)
        fastest = abs(u[k])
        target = u[k] - fastest * min(max(compliance * force / carried, -MAX_SLIP), MAX_SLIP)
        if disturbance.shape[0] > 0:
            target -= fastest * disturbance[k, 0]
        tau = fastest * compliance * mass / carried
        grows = (tau - tau_before) / dt
        if planar.bicycle and min(tau, tau_before) > SHORTEST_S and grows > FALLS_MOST:
            slope = (target - target_before) / (dt * (1.0 + grows))
            off = speed[k - 1] - target_before + tau_before * slope
            speed[k] = target - tau * slope + _kept(tau_before, tau, dt) * off
        elif k > 0 and tau > SHORTEST_S:
            lead = tau * (target - target_before) / dt
            speed[k] = target - lead + math.exp(-dt / tau) * (speed[k - 1] - target_before + lead)
        else:
            speed[k] = target
        target_before, tau_before = target, tau
        rate = (speed[k] - speed[k - 1]) / dt if k > 0 else 0.0
        force_ratio = (mass * rate + force) / carried
        slip = min(max(compliance * force_ratio, -MAX_SLIP), MAX_SLIP)
        slips[k] = slip
    return speed, rest, slips
