"""Motion of a skid-steer robot: slip along its heading is a low-pass, turning a matter of its two sides.

With ``f = (m dv/dt + F) / (m g)`` and ``F`` what slope and resistances ask for, ``v = u - |u| c f`` is a
low-pass of ``u - |u| c F / (m g)`` with the time constant ``|u| c / g``, stepped exactly for what runs
straight from sample to sample.  Turning slip takes of the difference of the sides by how tight the turn is,
turn drag of the mean by the yaw rate; in fast arcs the track acts narrower.  With friction against lateral
motion, ``m (dv_y/dt + w v) = -K v_y``, the robot slips to the outside of a turn:
``T dv_y/dt + v_y = -c v w``, ``c = T = m/K``; the two are parameters of their own.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.effects import INDEX
from terrain.records import Array
from terrain.simulation.contact import shear_softness, softness
from terrain.simulation.planar.model import AMPS, FORCE, N_TRUTH, SLIP, TURNING_AMPS, VX, VY, Planar, W
from terrain.simulation.planar.signals import delayed, lagged, slopes

STANDSTILL_MPS = 0.05
"""Speed over which a resistance takes its full size: it opposes motion and does not push a robot at rest."""

ENDO_POWER = 0.5
"""Exponent n of the turning slip; assumed, Endo et al. fitted one to each ground."""

MAX_SLIP = 0.9
"""Slip that forces take at the most, of either sign; assumed: a straight thrust curve has no end of its
own."""

SLIDING_RADPS = 1.0
"""Yaw rate from which the wheels mostly slide sideways, and below which they mostly deflect; of a Warthog on
asphalt and gravel."""

_RADIUS = INDEX["wheel_radius_ratio"]
_ONE_SIDED = INDEX["one_sided_radius_ratio"]
_YAW_DELAY = INDEX["yaw_delay_s"]
_TRACK = INDEX["effective_track_ratio"]
_NARROWING = INDEX["track_narrowing_s2pm2"]
_TURN_SLIP = INDEX["turning_slip_ratio"]
_TURN_DRAG = INDEX["turn_drag_s2"]
_SIDE_SLIP = INDEX["turn_side_slip_s"]
_BUILD_UP = INDEX["side_slip_build_up_s"]
_FORCE_SLIP = INDEX["force_slip_ratio"]
_SHEAR_SLIP = INDEX["shear_slip_ratio"]
_SLIP_RESISTANCE = INDEX["slip_resistance_ratio"]
_ROLLING = INDEX["rolling_resistance_ratio"]
_DRAG = INDEX["viscous_drag_nspm"]
_PAYLOAD = INDEX["payload_ratio"]
_SCRUB = INDEX["scrub_ratio"]


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
def move_skid(
    planar: Planar,
    p: Array,
    dt: float,
    wheel_speed_mps: Array,
    grade_rad: Array,
    disturbance: Array,
) -> Array:
    """Return motion, traction and currents; arguments are those of ``planar.motion.move``."""
    n = wheel_speed_mps.shape[0]
    out = np.zeros((n, N_TRUTH))
    weight = planar.mass_kg * GRAVITY_MPS2
    mass = planar.mass_kg * (1.0 + p[_PAYLOAD])
    carried = weight * (1.0 + planar.load_ratio * p[_PAYLOAD])
    rolling = (planar.rolling_ratio + p[_ROLLING]) * (1.0 + p[_PAYLOAD]) * weight
    scrub = (planar.scrub_ratio + p[_SCRUB]) * weight
    radius_m = planar.radius_m * (1.0 + p[_RADIUS])
    u, turn, tight, difference = _differed(planar, p, dt, wheel_speed_mps)
    speed, rest, ground = np.zeros(n), np.zeros(n), planar.soft_ratio
    target_before, force_ratio, slip = 0.0, 0.0, 0.0
    for k in range(n):
        v = speed[k - 1] + u[k] - u[k - 1] if k > 0 else u[0]  # without the lag of a step
        smooth = math.sqrt(v * v + STANDSTILL_MPS * STANDSTILL_MPS)
        force = mass * GRAVITY_MPS2 * planar.effective_ratio * math.sin(grade_rad[k]) + rolling * v / smooth
        force += p[_DRAG] * v + p[_SLIP_RESISTANCE] * abs(slip) * weight * v / smooth
        force += scrub * tight[k] * direction(u[k])
        rest[k] = force
        compliance = softness(ground, abs(slip)) + p[_FORCE_SLIP]
        if p[_SHEAR_SLIP] != 0.0:
            compliance += p[_SHEAR_SLIP] * shear_softness(force_ratio, planar.grip_ratio)
        fastest = abs(u[k])
        target = u[k] - fastest * min(max(compliance * force / carried, -MAX_SLIP), MAX_SLIP)
        if disturbance.shape[0] > 0:
            target -= fastest * disturbance[k, 0]
        tau = fastest * compliance * mass / carried
        if k > 0 and tau > 1e-6:
            lead = tau * (target - target_before) / dt
            speed[k] = target - lead + math.exp(-dt / tau) * (speed[k - 1] - target_before + lead)
        else:
            speed[k] = target
        target_before = target
        rate = (speed[k] - speed[k - 1]) / dt if k > 0 else 0.0
        force_ratio = (mass * rate + force) / carried
        slip = min(max(compliance * force_ratio, -MAX_SLIP), MAX_SLIP)
        out[k, VX], out[k, W], out[k, SLIP] = speed[k], turn[k], slip
    accel, wheel, spin = slopes(speed, dt), slopes(u, dt), slopes(turn, dt)
    for k in range(n):
        out[k, FORCE] = mass * accel[k] + rest[k]
        torque = (out[k, FORCE] + planar.rotating_kg * wheel[k]) * radius_m
        out[k, AMPS] = (torque + planar.friction_nm * direction(u[k])) / planar.nm_per_a
        moment = planar.yaw_inertia_kgm2 * (1.0 + p[_PAYLOAD]) * spin[k]
        force = 2.0 * moment / planar.track_m + scrub * tight[k] * direction(difference[k])
        out[k, TURNING_AMPS] = force * radius_m / planar.nm_per_a
    if p[_SIDE_SLIP] != 0.0:
        out[:, VY] = lagged(-p[_SIDE_SLIP] * speed * turn, p[_BUILD_UP], dt)
    return out


@njit(cache=True)
def _differed(
    planar: Planar, p: Array, dt: float, wheel_speed_mps: Array
) -> tuple[Array, Array, Array, Array]:
    """Return speed without slip, yaw rate, how tight the turn is and the difference of the sides (n,)."""
    n = wheel_speed_mps.shape[0]
    u, turn, tight, difference = np.empty(n), np.empty(n), np.zeros(n), np.empty(n)
    scale = 1.0 + p[_RADIUS]
    right, left = 1.0 + 0.5 * p[_ONE_SIDED], 1.0 - 0.5 * p[_ONE_SIDED]
    for k in range(n):
        v_l, v_r = wheel_speed_mps[k, 0] * scale * left, wheel_speed_mps[k, 1] * scale * right
        dv = v_r - v_l
        u[k] = 0.5 * (v_r + v_l)
        size = abs(dv) + 2.0 * abs(u[k])
        tight[k] = abs(dv) / size if size > 1e-6 else 0.0
        lost = p[_TURN_SLIP] * tight[k] * dv
        if lost != 0.0:
            a, b = abs(v_r) ** (1.0 - ENDO_POWER), abs(v_l) ** (1.0 - ENDO_POWER)
            u[k] -= 0.5 * lost * (a - b) / (a + b)
        difference[k] = dv
        turn[k] = (dv - lost) / (planar.track_m * (1.0 + p[_TRACK]))
        if p[_NARROWING] != 0.0:
            x = p[_NARROWING] * (u[k] * turn[k]) ** 2 / (1.0 + (turn[k] / SLIDING_RADPS) ** 2)
            turn[k] *= 1.0 + x / (1.0 + abs(x))
    if p[_YAW_DELAY] != 0.0:
        turn = delayed(turn, p[_YAW_DELAY] / dt, 0.0)
    if p[_TURN_DRAG] != 0.0:
        for k in range(n):
            drag = p[_TURN_DRAG] * turn[k] * turn[k]
            u[k] *= 1.0 / (1.0 + drag) if drag > 0.0 else 1.0 - drag  # never turns the motion about
    return u, turn, tight, difference
