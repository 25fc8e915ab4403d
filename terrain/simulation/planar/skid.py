"""Motion of skid-steer and tracked robots in the planar plant, and slip along a heading.

**Slip along the heading**, of skid-steer and of car-like robots.  With ``f = (m dv/dt + F) / (m g)`` and ``F`` what
slope and resistances ask for, ``v = u - |u| c f`` is a low-pass of ``u - |u| c F / (m g)`` with the time constant
``|u| c / g``, stepped exactly for what runs straight from sample to sample; of car-like robots, which are fast, the
time constant does, too.

**Turning** is a matter of the two sides.  Turning slip takes of the difference of the sides by how tight the turn is,
turn drag of the mean by the yaw rate; in fast arcs the track acts narrower.  With friction against lateral motion,
``m (dv_y/dt + w v) = -K v_y``, the robot slips to the outside of a turn: ``T dv_y/dt + v_y = -c v w``,
``c = T = m/K``; the two are parameters of their own.  The difference of the currents of the sides is that of yaw
inertia and scrub.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.effects import EFFECTS, SLIDING_RADPS
from terrain.kernels import inner, njit, record
from terrain.records import Array
from terrain.robots import TrackedRobot
from terrain.simulation.contact import shear_softness, softness
from terrain.simulation.planar.model import BODY, TRUTH, Drive, Inputs, delayed, lagged, slopes

# Speed over which a resistance takes its full size: it opposes motion and does not push a robot at rest.
STANDSTILL_MPS = 0.05
# Slip that forces take at the most, of either sign; assumed: a straight thrust curve has no end of its own.
MAX_SLIP = 0.9
# Shorter time constants are none; one that falls faster than the second, in s/s, is taken as even.
SHORTEST_S, FALLS_MOST = 1e-6, -0.9
# Exponent n of the turning slip; assumed, Endo et al. fitted one to each ground, and ``turning_slip_power`` does on
# tracks.
ENDO_POWER = 0.5

SIDES = record({"body": BODY, "tracked": bool})


@njit
def direction(speed_mps: float) -> float:
    """Return the direction of a motion, -1 to 1, and 0 at rest.

    Examples
    --------
    >>> round(direction(0.5), 3), direction(0.0)
    (0.995, 0.0)
    """
    return speed_mps / math.sqrt(speed_mps * speed_mps + STANDSTILL_MPS * STANDSTILL_MPS)


@inner
def _remaining(before_s: float, after_s: float, dt: float) -> float:
    """Return what a step leaves of an offset where the time constant runs straight: ``v' = -v / tau``."""
    change = math.log(after_s / before_s)
    if abs(change) < 1e-3:
        return math.exp(-2.0 * dt / (before_s + after_s))
    return math.exp(-dt * change / (after_s - before_s))


@inner
def slip_along(
    body: Any, p: Any, dt: float, u: Array, scrub_n: Array, grade_rad: Array, disturbance: Array, fast: bool
) -> tuple[Array, Array, Array]:
    """Return speed over ground, resistance with the slope, and slip (n,)."""
    n = u.size
    weight = body.mass_kg * GRAVITY_MPS2
    mass = body.mass_kg * (1.0 + p.payload_ratio)
    carried = weight * (1.0 + body.load_ratio * p.payload_ratio)
    rolling = (body.rolling_ratio + p.rolling_resistance_ratio) * (1.0 + p.payload_ratio) * weight
    speed, rest, slips, ground = np.zeros(n), np.zeros(n), np.zeros(n), body.soft_ratio
    target_before, tau_before, force_ratio, slip = 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        v = speed[k - 1] + u[k] - u[k - 1] if k > 0 else u[0]  # without the lag of a step
        smooth = math.sqrt(v * v + STANDSTILL_MPS * STANDSTILL_MPS)
        force = mass * GRAVITY_MPS2 * body.effective_ratio * math.sin(grade_rad[k]) + rolling * v / smooth
        force += p.viscous_drag_nspm * v + p.slip_resistance_ratio * abs(slip) * weight * v / smooth
        force += scrub_n[k]
        rest[k] = force
        compliance = softness(ground, abs(slip)) + p.force_slip_ratio
        if p.shear_slip_ratio != 0.0:
            compliance += p.shear_slip_ratio * shear_softness(force_ratio, body.grip_ratio)
        fastest = abs(u[k])
        target = u[k] - fastest * min(max(compliance * force / carried, -MAX_SLIP), MAX_SLIP)
        if disturbance.shape[0] > 0:
            target -= fastest * disturbance[k, 0]
        tau = fastest * compliance * mass / carried
        grows = (tau - tau_before) / dt
        if fast and min(tau, tau_before) > SHORTEST_S and grows > FALLS_MOST:
            slope = (target - target_before) / (dt * (1.0 + grows))
            off = speed[k - 1] - target_before + tau_before * slope
            speed[k] = target - tau * slope + _remaining(tau_before, tau, dt) * off
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


@njit
def _move(params: Array, vector: Array, dt: float, inputs: Inputs) -> Array:
    wheel_speed_mps, _steer_rad, grade_rad, _roll_rad, disturbance = inputs
    body, p, n = params[0].body, vector.view(EFFECTS)[0], wheel_speed_mps.shape[0]
    out = np.zeros(n, TRUTH)
    mass = body.mass_kg * (1.0 + p.payload_ratio)
    scrub = (body.scrub_ratio + p.scrub_ratio) * (body.mass_kg * GRAVITY_MPS2)
    radius_m = body.radius_m * (1.0 + p.wheel_radius_ratio)
    u, turn, tight, difference = _differed(params[0], p, dt, wheel_speed_mps)
    scrub_n = np.empty(n)
    for k in range(n):
        scrub_n[k] = scrub * tight[k] * direction(u[k])
    speed, rest, slip = slip_along(body, p, dt, u, scrub_n, grade_rad, disturbance, False)
    out["speed_x_mps"][:], out["yaw_rate_radps"][:], out["slip_ratio"][:] = speed, turn, slip
    accel, wheel, spin = slopes(speed, dt), slopes(u, dt), slopes(turn, dt)
    for k in range(n):
        row = out[k]
        row.force_n = mass * accel[k] + rest[k]
        torque = (row.force_n + body.rotating_kg * wheel[k]) * radius_m
        row.current_a = (torque + body.friction_nm * direction(u[k])) / body.nm_per_a
        moment = body.yaw_inertia_kgm2 * (1.0 + p.payload_ratio) * spin[k]
        force = 2.0 * moment / body.track_m + scrub * tight[k] * direction(difference[k])
        row.turning_current_a = force * radius_m / body.nm_per_a
    if p.turn_side_slip_s != 0.0:
        out["speed_y_mps"][:] = lagged(-p.turn_side_slip_s * speed * turn, p.side_slip_build_up_s, dt)
    return out


@inner
def _differed(sides: Any, p: Any, dt: float, wheel_speed_mps: Array) -> tuple[Array, Array, Array, Array]:
    """Return speed without slip, yaw rate, how tight the turn is and the difference of the sides (n,)."""
    n = wheel_speed_mps.shape[0]
    u, turn, tight, difference = np.empty(n), np.empty(n), np.zeros(n), np.empty(n)
    scale = 1.0 + p.wheel_radius_ratio
    right, left = 1.0 + 0.5 * p.one_sided_radius_ratio, 1.0 - 0.5 * p.one_sided_radius_ratio
    for k in range(n):
        v_l, v_r = wheel_speed_mps[k, 0] * scale * left, wheel_speed_mps[k, 1] * scale * right
        dv = v_r - v_l
        u[k] = 0.5 * (v_r + v_l)
        size = abs(dv) + 2.0 * abs(u[k])
        tight[k] = abs(dv) / size if size > 1e-6 else 0.0
        lost = p.turning_slip_ratio * tight[k] * dv
        if lost != 0.0:
            share = 1.0 - ENDO_POWER - (p.turning_slip_power_ratio if sides.tracked else 0.0)
            a, b = abs(v_r) ** share, abs(v_l) ** share
            u[k] -= 0.5 * lost * (a - b) / (a + b)
        difference[k] = dv
        turn[k] = (dv - lost) / (sides.body.track_m * (1.0 + p.effective_track_ratio))
        if p.track_narrowing_s2pm2 != 0.0:
            x = p.track_narrowing_s2pm2 * (u[k] * turn[k]) ** 2 / (1.0 + (turn[k] / SLIDING_RADPS) ** 2)
            turn[k] *= 1.0 + x / (1.0 + abs(x))
    if p.yaw_delay_s != 0.0:
        turn = delayed(turn, p.yaw_delay_s / dt, 0.0)
    if p.turn_drag_s2 != 0.0:
        for k in range(n):
            drag = p.turn_drag_s2 * turn[k] * turn[k]
            u[k] *= 1.0 / (1.0 + drag) if drag > 0.0 else 1.0 - drag  # never turns the motion about
    return u, turn, tight, difference


SKID = Drive(SIDES, lambda robot, ground: {"tracked": isinstance(robot, TrackedRobot)}, _move)
