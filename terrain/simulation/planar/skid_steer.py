"""Motion of a skid-steer robot: slip along its heading is a low-pass, turning a matter of its two sides.

Slip along is that of :mod:`~terrain.simulation.planar.along`.  Turning slip takes of the difference of the
sides by how tight the turn is, turn drag of the mean by the yaw rate; in fast arcs the track acts narrower.
With friction against lateral motion, ``m (dv_y/dt + w v) = -K v_y``, it slips to the outside of a turn:
``T dv_y/dt + v_y = -c v w``, ``c = T = m/K``; the two are parameters of their own.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.effects import INDEX
from terrain.records import Array
from terrain.simulation.planar.along import direction, slip_along
from terrain.simulation.planar.model import AMPS, FORCE, N_TRUTH, SLIP, TURNING_AMPS, VX, VY, Planar, W
from terrain.simulation.planar.signals import delayed, lagged, slopes

ENDO_POWER = 0.5
"""Exponent n of the turning slip; assumed, Endo et al. fitted one to each ground, and ``turning_slip_power``
does on tracks."""

SLIDING_RADPS = 1.0
"""Yaw rate from which the wheels mostly slide sideways, and below which they mostly deflect; of a Warthog on
asphalt and gravel."""

_RADIUS = INDEX["wheel_radius_ratio"]
_ONE_SIDED = INDEX["one_sided_radius_ratio"]
_YAW_DELAY = INDEX["yaw_delay_s"]
_TRACK = INDEX["effective_track_ratio"]
_NARROWING = INDEX["track_narrowing_s2pm2"]
_TURN_SLIP = INDEX["turning_slip_ratio"]
_TURN_POWER = INDEX["turning_slip_power_ratio"]
_TURN_DRAG = INDEX["turn_drag_s2"]
_SIDE_SLIP = INDEX["turn_side_slip_s"]
_BUILD_UP = INDEX["side_slip_build_up_s"]
_PAYLOAD = INDEX["payload_ratio"]
_SCRUB = INDEX["scrub_ratio"]


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
    mass = planar.mass_kg * (1.0 + p[_PAYLOAD])
    scrub = (planar.scrub_ratio + p[_SCRUB]) * (planar.mass_kg * GRAVITY_MPS2)
    radius_m = planar.radius_m * (1.0 + p[_RADIUS])
    u, turn, tight, difference = _differed(planar, p, dt, wheel_speed_mps)
    scrub_n = np.empty(n)
    for k in range(n):
        scrub_n[k] = scrub * tight[k] * direction(u[k])
    speed, rest, slip = slip_along(planar, p, dt, u, scrub_n, grade_rad, disturbance)
    out[:, VX], out[:, W], out[:, SLIP] = speed, turn, slip
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
            share = 1.0 - ENDO_POWER - (p[_TURN_POWER] if planar.tracked else 0.0)
            a, b = abs(v_r) ** share, abs(v_l) ** share
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
