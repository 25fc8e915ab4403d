"""Motion of a swerve robot: all its wheels slip as one contact with the ground, by a twist of three parts.

The parts are the speeds of the centre of mass along and across, and the yaw rate times the root mean square
distance ``r`` of the wheels from it.  Without slip they would be ``u``; slip takes ``l`` of each::

    v = u - l,                  dl/dt = a - N f,          a = du/dt + g sin th + w x v + R v
    f = (z + d dz/dt) / s,      sigma dz/dt = l - |u| c z

with the traction ``f`` over the weight, ``N = (g, g, m g r^2 / I)``, the tilt ``th`` of each axis, a
resistance ``R`` over the mass, the contact's relaxation length ``sigma``, its damping ``d``, the ground's
slip ``s`` per traction, and by how much a load and effects change it, ``c``; where nothing changes
``l = |u| c s f``.  The three parts meet in ``R``, ``s``, ``c`` and ``w x v`` alone, and each is stepped
exactly for an ``a`` that runs straight from sample to sample.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.effects import INDEX
from terrain.records import Array
from terrain.simulation.contact import DEFLECTION_DAMPING_S, shear_softness, softness
from terrain.simulation.planar.model import AMPS, FORCE, N_TRUTH, SLIP, VX, VY, Planar, W
from terrain.simulation.planar.signals import delayed, play, slopes

ROLLING_MPS = 0.02
"""Speed over which a resistance takes its full size, as in the dynamic simulation: it opposes motion and
does not push a robot at rest."""

STIFFEST, STIFFEST_GROUND = 0.1, 1e-6
"""Slip per traction that an effect leaves of the ground's own at the least, and that of the stiffest."""

SHORTEST_M, LIGHTEST_KG = 1e-3, 1e-3
"""Relaxation length of a contact that has none, and what a body without yaw inertia weighs at its wheels."""

_RADIUS = INDEX["wheel_radius_ratio"]
_ONE_SIDED = INDEX["one_sided_radius_ratio"]
_SCALE_1 = INDEX["wheel_scale_1_ratio"]
_OFFSET_1 = INDEX["steering_offset_1_rad"]
_PLAY = INDEX["steering_backlash_rad"]
_STEER_DELAY = INDEX["steering_delay_s"]
_FORCE_SLIP = INDEX["force_slip_ratio"]
_SHEAR_SLIP = INDEX["shear_slip_ratio"]
_SLIP_RESISTANCE = INDEX["slip_resistance_ratio"]
_ROLLING = INDEX["rolling_resistance_ratio"]
_DRAG = INDEX["viscous_drag_nspm"]
_PAYLOAD = INDEX["payload_ratio"]


@njit(cache=True)
def move_swerve(
    planar: Planar,
    p: Array,
    dt: float,
    wheel_speed_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
    disturbance: Array,
) -> Array:
    """Return motion, traction and current; arguments are those of ``planar.motion.move``."""
    n = wheel_speed_mps.shape[0]
    out = np.zeros((n, N_TRUTH))
    u, pace, mean_wheel_speed, heading = _rolled(planar, p, dt, wheel_speed_mps, steer_rad)
    weight = planar.mass_kg * GRAVITY_MPS2
    load = 1.0 + p[_PAYLOAD]
    pressed = load / (1.0 + planar.load_ratio * p[_PAYLOAD])
    mass = planar.mass_kg * load
    spin_kg = max(planar.yaw_inertia_kgm2 / planar.spread_m**2, LIGHTEST_KG) * load
    rolling = (planar.rolling_ratio + p[_ROLLING]) * (1.0 + p[_PAYLOAD]) * weight
    gravity = GRAVITY_MPS2 * planar.effective_ratio
    ground, sigma, damping = planar.soft_ratio, max(planar.relaxation_m, SHORTEST_M), DEFLECTION_DAMPING_S
    by_sigma, by_dt, by_spread = 1.0 / sigma, 1.0 / dt, 1.0 / planar.spread_m
    # the contact springs as much whatever it carries
    resisting = load * weight / mass, load * weight / mass, load * weight / spin_kg
    yielding = 1.0 / resisting[0], 1.0 / resisting[1], 1.0 / resisting[2]
    by_mass, by_spin = 1.0 / mass, 1.0 / spin_kg
    if disturbance.shape[0] > 0:
        u[0] -= pace * disturbance[:, 0]
    changing = np.empty((3, n))
    for i in range(3):
        rate = slopes(u[i], dt)
        changing[i] = rate
        for k in range(1, n - 1):  # straight lines between what comes out run on average where it goes
            changing[i, k] -= (rate[k - 1] - 2.0 * rate[k] + rate[k + 1]) / 12.0
    lost, z, f = np.zeros(3), np.zeros(3), np.zeros(3)  # speed lost by slip, slip, traction over weight
    pushed, pushed_before, lost_before = np.zeros(3), np.zeros(3), np.zeros(3)
    size, size_before, alpha, beta, kappa = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        v_x = u[0, k] - 2.0 * lost[0] + lost_before[0]  # as slip goes on
        v_y = u[1, k] - 2.0 * lost[1] + lost_before[1]
        v_w = u[2, k] - 2.0 * lost[2] + lost_before[2]
        fast = math.sqrt(v_x * v_x + v_y * v_y + v_w * v_w + ROLLING_MPS * ROLLING_MPS)
        resists = (rolling + p[_SLIP_RESISTANCE] * size * weight) / fast + p[_DRAG]
        w, resists_by_mass = v_w * by_spread, resists * by_mass
        pushed[0] = changing[0, k] + gravity * math.sin(grade_rad[k]) - w * v_y + resists_by_mass * v_x
        pushed[1] = changing[1, k] + gravity * math.sin(roll_rad[k]) + w * v_x + resists_by_mass * v_y
        pushed[2] = changing[2, k] + resists * by_spin * v_w
        soft = max(softness(ground, max(1.5 * size - 0.5 * size_before, 0.0)), STIFFEST_GROUND)
        more = p[_FORCE_SLIP]
        if p[_SHEAR_SLIP] != 0.0:
            traction = load * math.sqrt(f[0] * f[0] + f[1] * f[1])
            more += p[_SHEAR_SLIP] * shear_softness(traction, planar.grip_ratio)
        roll = 0.5 * (pace[k] + pace[k - 1]) if k > 0 else pace[0]
        by_soft = 1.0 / soft
        creep_now = max(pressed + load * more * by_soft, STIFFEST)
        creep, creep_now = roll * creep_now, pace[k] * creep_now
        size_before, size = size, 0.0
        for i in range(3):
            yields = soft * yielding[i]
            if k == 0:
                z[i], lost[i] = yields * pushed[i], creep * yields * pushed[i]
                lost_before[i] = lost[i]
                f[i] = z[i] * by_soft
            else:
                if i != 1:  # the two axes of the ground are alike
                    kappa = by_soft * resisting[i]
                    alpha, beta = decayed(-0.5 * (kappa * damping + creep) * by_sigma, kappa * by_sigma, dt)
                # what lasts, of a push that grows evenly, and what of the rest is left after the step
                z_grows = yields * (pushed[i] - pushed_before[i]) * by_dt
                z_lasts = yields * (pushed_before[i] - creep * z_grows) - damping * z_grows
                lost_before[i] = lost[i]
                off = lost[i] - (creep * z_lasts + sigma * z_grows)
                z_off = z[i] - z_lasts
                z_rate = (off - creep * z_off) * by_sigma
                z[i] = z_lasts + z_grows * dt + alpha * z_off + beta * z_rate
                lost[i] = creep * (z_lasts + z_grows * dt) + sigma * z_grows
                lost[i] += alpha * off - beta * kappa * (z_off + damping * z_rate)
                f[i] = (z[i] + damping * by_sigma * (lost[i] - creep_now * z[i])) * by_soft
            pushed_before[i] = pushed[i]
            size += z[i] * z[i]
        size = pressed * math.sqrt(size)
        w = (u[2, k] - lost[2]) * by_spread
        out[k, VX] = u[0, k] - lost[0] + w * planar.com_y_m
        out[k, VY] = u[1, k] - lost[1] - w * planar.com_x_m
        out[k, W] = w
        out[k, FORCE] = load * weight * f[0]
        out[k, SLIP] = (pressed * soft + load * more) * f[0]
        out[k, AMPS] = load * weight * (heading[0, k] * f[0] + heading[1, k] * f[1] + heading[2, k] * f[2])
    spun = slopes(mean_wheel_speed, dt)
    for k in range(n):
        torque = (out[k, AMPS] + planar.rotating_kg * spun[k]) * planar.radius_m * (1.0 + p[_RADIUS])
        direction = mean_wheel_speed[k] / math.sqrt(
            mean_wheel_speed[k] * mean_wheel_speed[k] + ROLLING_MPS * ROLLING_MPS
        )
        out[k, AMPS] = (torque + planar.friction_nm * direction) / planar.nm_per_a
    return out


@njit(cache=True)
def decayed(half_trace: float, determinant: float, dt: float) -> tuple[float, float]:
    """Return ``a, b`` of ``exp(A dt) = a 1 + b A`` of a matrix (2, 2) that does not grow.

    Where roots are close to each other, two cosines are series: they take no more time than a square root.
    """
    x = (half_trace * half_trace - determinant) * dt * dt
    if x > 4.0:
        root = math.sqrt(x)
        quick = half_trace * dt - root
        slow = math.exp(determinant * dt * dt / quick)
        quick = math.exp(quick)
        both, b = 0.5 * (slow + quick), 0.5 * (slow - quick) / root * dt
    else:
        both = b = math.exp(half_trace * dt)
        if x < -4.0:
            root = math.sqrt(-x)
            both *= math.cos(root)
            b *= math.sin(root) / root * dt
        else:
            both *= 1.0 + x / 2.0 * (1.0 + x / 12.0 * (1.0 + x / 30.0 * (1.0 + x / 56.0 * (1.0 + x / 90.0))))
            b *= dt * (
                1.0 + x / 6.0 * (1.0 + x / 20.0 * (1.0 + x / 42.0 * (1.0 + x / 72.0 * (1.0 + x / 110.0))))
            )
    return both - half_trace * b, b


@njit(cache=True)
def _rolled(
    planar: Planar, p: Array, dt: float, wheel_speed_mps: Array, steer_rad: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the twist without slip, the wheel speeds' root mean square and mean, and the pull of tractions.

    (3, n), (n,), (n,), and (3, n): what a traction in each direction of the twist pulls along the wheels.
    """
    n = wheel_speed_mps.shape[0]
    scale = 1.0 + p[_RADIUS]
    right, left = 1.0 + 0.5 * p[_ONE_SIDED], 1.0 - 0.5 * p[_ONE_SIDED]
    u, heading, angle = np.zeros((3, n)), np.zeros((3, n)), np.empty((3, n))
    pace, mean_wheel_speed = np.empty(n), np.empty(n)
    for i in range(3):
        angle[i] = steer_rad[:, i] + p[_OFFSET_1 + i]
        if p[_STEER_DELAY] != 0.0:
            angle[i] = delayed(angle[i], p[_STEER_DELAY] / dt, 0.0)
        if p[_PLAY] > 0.0:
            play(angle[i], p[_PLAY])
    for k in range(n):
        square, total = 0.0, 0.0
        for i in range(3):
            wheel_speed = (
                wheel_speed_mps[k, i] * scale * (right if i == 2 else left) * (1.0 + p[_SCALE_1 + i])
            )
            square += wheel_speed * wheel_speed
            total += wheel_speed
            cos, sin = math.cos(angle[i, k]), math.sin(angle[i, k])
            for j in range(3):
                gain = planar.to_twist[j, 2 * i] * cos + planar.to_twist[j, 2 * i + 1] * sin
                u[j, k] += wheel_speed * gain
            heading[0, k] += cos / 3.0
            heading[1, k] += sin / 3.0
            heading[2, k] += (planar.arm_ratio[i, 0] * sin - planar.arm_ratio[i, 1] * cos) / 3.0
        u[0, k] -= u[2, k] * planar.com_y_m
        u[1, k] += u[2, k] * planar.com_x_m
        u[2, k] *= planar.spread_m
        pace[k], mean_wheel_speed[k] = math.sqrt(square / 3.0), total / 3.0
    return u, pace, mean_wheel_speed, heading
