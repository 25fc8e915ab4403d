"""Motion of swerve robots in the planar plant: all wheels slip as one contact with the ground.

It slips by a twist of three parts: the speeds of the centre of mass along and across, and the yaw rate times the root
mean square distance ``r`` of the wheels from it.  Without slip they would be ``u``; slip takes ``l`` of each::

    v = u - l,                  dl/dt = a - N f,          a = du/dt + g sin th + w x v + R v
    f = (z + d dz/dt) / s,      sigma dz/dt = l - |u| c z

with the traction ``f`` over the weight, ``N = (g, g, m g r^2 / I)``, the tilt ``th`` of each axis, a resistance ``R``
over the mass, the contact's relaxation length ``sigma``, its damping ``d``, the ground's slip ``s`` per traction, and
by how much a load and effects change it, ``c``; where nothing changes ``l = |u| c s f``.  The three parts meet in
``R``, ``s``, ``c`` and ``w x v`` alone, and each is stepped exactly for an ``a`` that runs straight from sample to
sample.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.effects import EFFECTS
from terrain.kernels import inner, njit, numbers, record
from terrain.kinematics.wheels import velocity_matrix
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.contact import DEFLECTION_DAMPING_S, shear_softness, softness
from terrain.simulation.planar.model import BODY, TRUTH, Drive, Ground, Inputs, decayed, slopes, steered
from terrain.simulation.planar.omni import STIFFEST, STIFFEST_GROUND

# Speed over which a resistance takes its full size, as in the dynamic simulation: it opposes motion and does not
# push a robot at rest.
ROLLING_MPS = 0.02
# Relaxation length of a contact that has none, and what a body without yaw inertia weighs at its wheels.
SHORTEST_M, LIGHTEST_KG = 1e-3, 1e-3

CONTACT = record(
    {
        "body": BODY,
        "to_twist": (float, (3, 6)),
        "arm_ratio": (float, (3, 2)),
        **numbers("spread_m relaxation_m"),
    }
)
"""``to_twist`` gives the twist of the wheels' velocities; ``spread_m`` is the distance r, and ``arm_ratio`` the wheels'
places about the centre of mass over it."""


def _numbers(robot: Robot, ground: Ground) -> dict[str, Any]:
    body = robot.completed.body
    arm_m = robot.wheel_positions_m - np.array([body.com_x_m, body.com_y_m])
    spread_m = float(np.sqrt((arm_m**2).sum(axis=1).mean()))
    return {
        "to_twist": np.linalg.pinv(velocity_matrix(robot.wheel_positions_m)),
        "arm_ratio": arm_m / spread_m,
        "spread_m": spread_m,
        "relaxation_m": body.relaxation_length_m,
    }


@njit
def _move(params: Array, vector: Array, dt: float, inputs: Inputs) -> Array:
    wheel_speed_mps, steer_rad, grade_rad, roll_rad, disturbance = inputs
    contact, p, n = params[0], vector.view(EFFECTS)[0], wheel_speed_mps.shape[0]
    body, out = contact.body, np.zeros(n, TRUTH)
    u, pace, mean_wheel_speed, heading = _no_slip(contact, p, dt, wheel_speed_mps, steer_rad)
    weight = body.mass_kg * GRAVITY_MPS2
    load = 1.0 + p.payload_ratio
    pressed = load / (1.0 + body.load_ratio * p.payload_ratio)
    mass = body.mass_kg * load
    spin_kg = max(body.yaw_inertia_kgm2 / contact.spread_m**2, LIGHTEST_KG) * load
    rolling = (body.rolling_ratio + p.rolling_resistance_ratio) * (1.0 + p.payload_ratio) * weight
    gravity = GRAVITY_MPS2 * body.effective_ratio
    ground, sigma, damping = body.soft_ratio, max(contact.relaxation_m, SHORTEST_M), DEFLECTION_DAMPING_S
    by_sigma, by_dt, by_spread = 1.0 / sigma, 1.0 / dt, 1.0 / contact.spread_m
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
        resists = (rolling + p.slip_resistance_ratio * size * weight) / fast + p.viscous_drag_nspm
        w, resists_by_mass = v_w * by_spread, resists * by_mass
        pushed[0] = changing[0, k] + gravity * math.sin(grade_rad[k]) - w * v_y + resists_by_mass * v_x
        pushed[1] = changing[1, k] + gravity * math.sin(roll_rad[k]) + w * v_x + resists_by_mass * v_y
        pushed[2] = changing[2, k] + resists * by_spin * v_w
        soft = max(softness(ground, max(1.5 * size - 0.5 * size_before, 0.0)), STIFFEST_GROUND)
        more = p.force_slip_ratio
        if p.shear_slip_ratio != 0.0:
            traction = load * math.sqrt(f[0] * f[0] + f[1] * f[1])
            more += p.shear_slip_ratio * shear_softness(traction, body.grip_ratio)
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
        row = out[k]
        row.speed_x_mps = u[0, k] - lost[0] + w * body.com_y_m
        row.speed_y_mps = u[1, k] - lost[1] - w * body.com_x_m
        row.yaw_rate_radps = w
        row.force_n = load * weight * f[0]
        row.slip_ratio = (pressed * soft + load * more) * f[0]
        row.current_a = load * weight * (heading[0, k] * f[0] + heading[1, k] * f[1] + heading[2, k] * f[2])
    spun, radius_m = slopes(mean_wheel_speed, dt), body.radius_m
    for k in range(n):
        torque = (out[k].current_a + body.rotating_kg * spun[k]) * radius_m * (1.0 + p.wheel_radius_ratio)
        speed = mean_wheel_speed[k]
        direction = speed / math.sqrt(speed * speed + ROLLING_MPS * ROLLING_MPS)
        out[k].current_a = (torque + body.friction_nm * direction) / body.nm_per_a
    return out


@inner
def _no_slip(
    contact: Any, p: Any, dt: float, wheel_speed_mps: Array, steer_rad: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the twist without slip, the wheel speeds' root mean square and mean, and the pull of tractions.

    (3, n), (n,), (n,), and (3, n): what a traction in each direction of the twist pulls along the wheels.
    """
    n = wheel_speed_mps.shape[0]
    scale = 1.0 + p.wheel_radius_ratio
    right, left = 1.0 + 0.5 * p.one_sided_radius_ratio, 1.0 - 0.5 * p.one_sided_radius_ratio
    u, heading, angle = np.zeros((3, n)), np.zeros((3, n)), np.empty((3, n))
    pace, mean_wheel_speed = np.empty(n), np.empty(n)
    offsets = (p.steering_offset_1_rad, p.steering_offset_2_rad, p.steering_offset_3_rad)
    scales = (p.wheel_scale_1_ratio, p.wheel_scale_2_ratio, p.wheel_scale_3_ratio)
    for i in range(3):
        angle[i] = steered(steer_rad[:, i] + offsets[i], p.steering_delay_s, p.steering_backlash_rad, dt)
    for k in range(n):
        square, total = 0.0, 0.0
        for i in range(3):
            wheel_speed = wheel_speed_mps[k, i] * scale * (right if i == 2 else left) * (1.0 + scales[i])
            square += wheel_speed * wheel_speed
            total += wheel_speed
            cos, sin = math.cos(angle[i, k]), math.sin(angle[i, k])
            for j in range(3):
                gain = contact.to_twist[j, 2 * i] * cos + contact.to_twist[j, 2 * i + 1] * sin
                u[j, k] += wheel_speed * gain
            heading[0, k] += cos / 3.0
            heading[1, k] += sin / 3.0
            heading[2, k] += (contact.arm_ratio[i, 0] * sin - contact.arm_ratio[i, 1] * cos) / 3.0
        u[0, k] -= u[2, k] * contact.body.com_y_m
        u[1, k] += u[2, k] * contact.body.com_x_m
        u[2, k] *= contact.spread_m
        pace[k], mean_wheel_speed[k] = math.sqrt(square / 3.0), total / 3.0
    return u, pace, mean_wheel_speed, heading


SWERVE = Drive(CONTACT, _numbers, _move)
