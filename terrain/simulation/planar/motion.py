"""What a body on wheels does: motion by its kind of drive, and what a side hill and the ground add to it.

**Slip along a robot's heading**, of skid-steer and of car-like robots.  With ``f = (m dv/dt + F) / (m g)``
and ``F`` what slope and resistances ask for, ``v = u - |u| c f`` is a low-pass of ``u - |u| c F / (m g)``
with the time constant ``|u| c / g``, stepped exactly for what runs straight from sample to sample; of
car-like robots, which are fast, the time constant does, too.

**Skid-steer robots**: slip along the heading is a low-pass, turning a matter of the two sides.  Turning slip
takes of the difference of the sides by how tight the turn is, turn drag of the mean by the yaw rate; in fast
arcs the track acts narrower.  With friction against lateral motion, ``m (dv_y/dt + w v) = -K v_y``, it slips
to the outside of a turn: ``T dv_y/dt + v_y = -c v w``, ``c = T = m/K``; the two are parameters of their own.

**Swerve robots**: all wheels slip as one contact with the ground, by a twist of three parts.  The parts are
the speeds of the centre of mass along and across, and the yaw rate times the root mean square distance ``r``
of the wheels from it.  Without slip they would be ``u``; slip takes ``l`` of each::

    v = u - l,                  dl/dt = a - N f,          a = du/dt + g sin th + w x v + R v
    f = (z + d dz/dt) / s,      sigma dz/dt = l - |u| c z

with the traction ``f`` over the weight, ``N = (g, g, m g r^2 / I)``, the tilt ``th`` of each axis, a
resistance ``R`` over the mass, the contact's relaxation length ``sigma``, its damping ``d``, the ground's
slip ``s`` per traction, and by how much a load and effects change it, ``c``; where nothing changes
``l = |u| c s f``.  The three parts meet in ``R``, ``s``, ``c`` and ``w x v`` alone, and each is stepped
exactly for an ``a`` that runs straight from sample to sample.

**Car-like robots**: the linear single-track model, stepped exactly, at rest and fast alike.  With the lateral
speed ``c`` of the centre of mass, ``a`` ahead of the rear axle and ``b`` behind the front one, ``L = a + b``,
the yaw rate ``w``, the speed ``v`` and the steering angle ``d``::

    m (dc/dt + v w) = F_f + F_r - m g sin(ph),      I dw/dt = b F_f - a F_r
    F_f = -C_f (c + b w - v tan d) / |v|,           F_r = -C_r (c - a w) / |v|

as Rajamani, Vehicle Dynamics and Control, has it, with ``tan d`` in place of ``d``, so that at low speed it
is the kinematic bicycle, and ``|v|``, so that it drives backward.  Where nothing changes::

    w = (v tan d - |v| K g sin ph) / (L + K v |v|),     K = m (a / C_f - b / C_r) / L
    v_y = -|v| m b / (L C_r) (v w + g sin ph)           at the rear axle

``x = (c, w)`` follows that, ``dx/dt = A (x - s)``, exactly for an ``s`` that runs straight from sample to
sample and an ``A`` of the step's mean speed.  Understeer is ``K`` more, by a front axle that yields;
``L + K v |v|`` is kept above a tenth of ``L``: there, near the speed at which a car spins, the linear model
ends, and a front axle that yields enough takes its place.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.effects import EFFECTS, SLIDING_RADPS
from terrain.kernels import njit
from terrain.records import Array
from terrain.simulation.contact import DEFLECTION_DAMPING_S, shear_softness, softness
from terrain.simulation.planar.model import (
    AMPS,
    AX,
    FORCE,
    N_TRUTH,
    SLIP,
    SWERVE_WHEELS,
    TURNING_AMPS,
    VX,
    VY,
    Planar,
    W,
    delayed,
    lagged,
    play,
    slopes,
)
from terrain.simulation.planar.omni import STIFFEST, STIFFEST_GROUND, move_omni

STANDSTILL_MPS = 0.05
"""Speed over which a resistance takes its full size: it opposes motion and does not push a robot at rest."""

MAX_SLIP = 0.9
"""Slip that forces take at the most, of either sign; assumed: a straight thrust curve has no end of its
own."""

SHORTEST_S, FALLS_MOST = 1e-6, -0.9
"""Shorter time constants are none; one that falls faster than the second, in s/s, is taken as even."""

ENDO_POWER = 0.5
"""Exponent n of the turning slip; assumed, Endo et al. fitted one to each ground, and ``turning_slip_power``
does on tracks."""

ROLLING_MPS = 0.02
"""Speed over which a resistance takes its full size, as in the dynamic simulation: it opposes motion and
does not push a robot at rest."""

SHORTEST_M, LIGHTEST_KG = 1e-3, 1e-3
"""Relaxation length of a contact that has none, and what a body without yaw inertia weighs at its wheels."""

SLOW_MPS = 0.01
"""Speed below which tyres damp a sideways motion as at it: in less than a millisecond."""

LEAST_RATIO = 0.1
"""The effective wheelbase over the wheelbase at the least, and what is left of an axle's compliance."""

STEEPEST_RAD = 1.3
"""Steering angle at the most, where its tangent is 3.6."""


@njit
def move(
    planar: Planar,
    vector: Array,
    dt: float,
    wheel_speed_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
    disturbance: Array,
) -> Array:
    """Return what the body does, (n, len(TRUTH)).

    Parameters
    ----------
    planar, vector : the simulation, and its parameters in the order of ``effects.PARAMETERS``
    dt : step in s
    wheel_speed_mps : (n, wheels) wheel rates times the nominal radius
    steer_rad : (n, wheels) angles as encoders without error show them; not looked at without steering
    grade_rad, roll_rad : (n,) true tilt
    disturbance : (n, 3) what the ground adds to speeds (shares of ``|u|``, along and across) and yaw rate
        (rad/s), or none: (0, 3)
    """
    p = vector.view(EFFECTS)[0]
    if planar.omni:
        out: Array = move_omni(planar, vector, dt, wheel_speed_mps, grade_rad, roll_rad, disturbance)
    elif planar.bicycle:
        out = move_bicycle(planar, p, dt, wheel_speed_mps, steer_rad, grade_rad, roll_rad, disturbance)
    elif planar.n_wheels == SWERVE_WHEELS:
        out = move_swerve(planar, p, dt, wheel_speed_mps, steer_rad, grade_rad, roll_rad, disturbance)
    else:
        out = move_skid(planar, p, dt, wheel_speed_mps, grade_rad, disturbance)
    for k in range(out.shape[0]):
        fast = math.sqrt(out[k, VX] * out[k, VX] + out[k, VY] * out[k, VY])
        if not planar.omni:
            out[k, VY] -= p.side_hill_slip_ratio * planar.effective_ratio * roll_rad[k] * fast
        if disturbance.shape[0] > 0:
            out[k, VY] += fast * disturbance[k, 1]
            out[k, W] += disturbance[k, 2]
    accel = slopes(out[:, VX].copy(), dt)
    for k in range(out.shape[0]):
        out[k, AX] = accel[k] - out[k, W] * out[k, VY] + GRAVITY_MPS2 * math.sin(grade_rad[k])
    return out


@njit
def direction(speed_mps: float) -> float:
    """Return the direction of a motion, -1 to 1, and 0 at rest.

    Examples
    --------
    >>> round(direction(0.5), 3), direction(0.0)
    (0.995, 0.0)
    """
    return speed_mps / math.sqrt(speed_mps * speed_mps + STANDSTILL_MPS * STANDSTILL_MPS)


@njit
def _kept(before_s: float, after_s: float, dt: float) -> float:
    """Return what a step leaves of an offset where the time constant runs straight: ``v' = -v / tau``."""
    change = math.log(after_s / before_s)
    if abs(change) < 1e-3:
        return math.exp(-2.0 * dt / (before_s + after_s))
    return math.exp(-dt * change / (after_s - before_s))


@njit
def slip_along(
    planar: Planar, p: Any, dt: float, u: Array, scrub_n: Array, grade_rad: Array, disturbance: Array
) -> tuple[Array, Array, Array]:
    """Return speed over ground, resistance with the slope, and slip (n,).

    Parameters
    ----------
    u, scrub_n : (n,) speed without slip, and what resists in turns
    planar, p, dt, grade_rad, disturbance : as :func:`move` has them
    """
    n = u.size
    weight = planar.mass_kg * GRAVITY_MPS2
    mass = planar.mass_kg * (1.0 + p.payload_ratio)
    carried = weight * (1.0 + planar.load_ratio * p.payload_ratio)
    rolling = (planar.rolling_ratio + p.rolling_resistance_ratio) * (1.0 + p.payload_ratio) * weight
    speed, rest, slips, ground = np.zeros(n), np.zeros(n), np.zeros(n), planar.soft_ratio
    target_before, tau_before, force_ratio, slip = 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        v = speed[k - 1] + u[k] - u[k - 1] if k > 0 else u[0]  # without the lag of a step
        smooth = math.sqrt(v * v + STANDSTILL_MPS * STANDSTILL_MPS)
        force = mass * GRAVITY_MPS2 * planar.effective_ratio * math.sin(grade_rad[k]) + rolling * v / smooth
        force += p.viscous_drag_nspm * v + p.slip_resistance_ratio * abs(slip) * weight * v / smooth
        force += scrub_n[k]
        rest[k] = force
        compliance = softness(ground, abs(slip)) + p.force_slip_ratio
        if p.shear_slip_ratio != 0.0:
            compliance += p.shear_slip_ratio * shear_softness(force_ratio, planar.grip_ratio)
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


@njit
def move_skid(
    planar: Planar, p: Any, dt: float, wheel_speed_mps: Array, grade_rad: Array, disturbance: Array
) -> Array:
    """Return motion, traction and currents; arguments are those of :func:`move`."""
    n = wheel_speed_mps.shape[0]
    out = np.zeros((n, N_TRUTH))
    mass = planar.mass_kg * (1.0 + p.payload_ratio)
    scrub = (planar.scrub_ratio + p.scrub_ratio) * (planar.mass_kg * GRAVITY_MPS2)
    radius_m = planar.radius_m * (1.0 + p.wheel_radius_ratio)
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
        moment = planar.yaw_inertia_kgm2 * (1.0 + p.payload_ratio) * spin[k]
        force = 2.0 * moment / planar.track_m + scrub * tight[k] * direction(difference[k])
        out[k, TURNING_AMPS] = force * radius_m / planar.nm_per_a
    if p.turn_side_slip_s != 0.0:
        out[:, VY] = lagged(-p.turn_side_slip_s * speed * turn, p.side_slip_build_up_s, dt)
    return out


@njit
def _differed(planar: Planar, p: Any, dt: float, wheel_speed_mps: Array) -> tuple[Array, Array, Array, Array]:
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
            share = 1.0 - ENDO_POWER - (p.turning_slip_power_ratio if planar.tracked else 0.0)
            a, b = abs(v_r) ** share, abs(v_l) ** share
            u[k] -= 0.5 * lost * (a - b) / (a + b)
        difference[k] = dv
        turn[k] = (dv - lost) / (planar.track_m * (1.0 + p.effective_track_ratio))
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


@njit
def move_swerve(
    planar: Planar,
    p: Any,
    dt: float,
    wheel_speed_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
    disturbance: Array,
) -> Array:
    """Return motion, traction and current; arguments are those of :func:`move`."""
    n = wheel_speed_mps.shape[0]
    out = np.zeros((n, N_TRUTH))
    u, pace, mean_wheel_speed, heading = _rolled(planar, p, dt, wheel_speed_mps, steer_rad)
    weight = planar.mass_kg * GRAVITY_MPS2
    load = 1.0 + p.payload_ratio
    pressed = load / (1.0 + planar.load_ratio * p.payload_ratio)
    mass = planar.mass_kg * load
    spin_kg = max(planar.yaw_inertia_kgm2 / planar.spread_m**2, LIGHTEST_KG) * load
    rolling = (planar.rolling_ratio + p.rolling_resistance_ratio) * (1.0 + p.payload_ratio) * weight
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
        resists = (rolling + p.slip_resistance_ratio * size * weight) / fast + p.viscous_drag_nspm
        w, resists_by_mass = v_w * by_spread, resists * by_mass
        pushed[0] = changing[0, k] + gravity * math.sin(grade_rad[k]) - w * v_y + resists_by_mass * v_x
        pushed[1] = changing[1, k] + gravity * math.sin(roll_rad[k]) + w * v_x + resists_by_mass * v_y
        pushed[2] = changing[2, k] + resists * by_spin * v_w
        soft = max(softness(ground, max(1.5 * size - 0.5 * size_before, 0.0)), STIFFEST_GROUND)
        more = p.force_slip_ratio
        if p.shear_slip_ratio != 0.0:
            traction = load * math.sqrt(f[0] * f[0] + f[1] * f[1])
            more += p.shear_slip_ratio * shear_softness(traction, planar.grip_ratio)
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
        torque = (
            (out[k, AMPS] + planar.rotating_kg * spun[k]) * planar.radius_m * (1.0 + p.wheel_radius_ratio)
        )
        direction = mean_wheel_speed[k] / math.sqrt(
            mean_wheel_speed[k] * mean_wheel_speed[k] + ROLLING_MPS * ROLLING_MPS
        )
        out[k, AMPS] = (torque + planar.friction_nm * direction) / planar.nm_per_a
    return out


@njit
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


@njit
def _rolled(
    planar: Planar, p: Any, dt: float, wheel_speed_mps: Array, steer_rad: Array
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
        angle[i] = steer_rad[:, i] + offsets[i]
        if p.steering_delay_s != 0.0:
            angle[i] = delayed(angle[i], p.steering_delay_s / dt, 0.0)
        if p.steering_backlash_rad > 0.0:
            play(angle[i], p.steering_backlash_rad)
    for k in range(n):
        square, total = 0.0, 0.0
        for i in range(3):
            wheel_speed = wheel_speed_mps[k, i] * scale * (right if i == 2 else left) * (1.0 + scales[i])
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


@njit
def move_bicycle(
    planar: Planar,
    p: Any,
    dt: float,
    wheel_speed_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
    disturbance: Array,
) -> Array:
    """Return motion and traction; arguments are those of :func:`move`.

    The last wheel is the rear one, the first angle that of the front wheel; currents are 0.
    """
    n = wheel_speed_mps.shape[0]
    out = np.zeros((n, N_TRUTH))
    u = wheel_speed_mps[:, -1] * (1.0 + p.wheel_radius_ratio)
    speed, rest, slip = slip_along(planar, p, dt, u, np.zeros(n), grade_rad, disturbance)
    accel = slopes(speed, dt)
    mass = planar.mass_kg * (1.0 + p.payload_ratio)
    for k in range(n):
        out[k, FORCE] = mass * accel[k] + rest[k]
    out[:, VX], out[:, SLIP] = speed, slip
    steer = steer_rad[:, 0] + p.steering_offset_front_rad
    if p.steering_delay_s != 0.0:
        steer = delayed(steer, p.steering_delay_s / dt, 0.0)
    if p.steering_backlash_rad > 0.0:
        play(steer, p.steering_backlash_rad)
    _turn(planar, p, dt, steer, roll_rad, out)
    return out


@njit
def _turn(planar: Planar, p: Any, dt: float, steer: Array, roll_rad: Array, out: Array) -> None:
    """Fill in yaw rate and lateral speed of the rear axle of a body that drives at ``out[:, VX]``."""
    mass = planar.mass_kg * (1.0 + p.payload_ratio)
    inertia = planar.yaw_inertia_kgm2 * (1.0 + p.payload_ratio)
    wheelbase, a = planar.wheelbase_m, planar.com_ahead_m
    b = wheelbase - a
    soft = 1.0 / (1.0 + p.cornering_stiffness_ratio)
    front = soft / planar.front_cornering_npr  # compliance of the axles
    rear = soft / planar.rear_cornering_npr
    front = max(front + p.understeer_s2pm * wheelbase / (planar.mass_kg * a), LEAST_RATIO * front)
    gravity = GRAVITY_MPS2 * planar.effective_ratio
    c = w = c_before = w_before = 0.0  # of the body, and the steady ones of the sample before
    for k in range(out.shape[0]):
        v = out[k, VX]
        fast = abs(v)
        yields = _front(mass, wheelbase, a, front, rear, v)
        understeer = mass * (a * yields - b * rear) / wheelbase
        down = gravity * math.sin(roll_rad[k])
        angle = min(max(steer[k], -STEEPEST_RAD), STEEPEST_RAD)
        w_now = (v * math.tan(angle) - fast * understeer * down) / (wheelbase + understeer * v * fast)
        y_now = -fast * mass * b * rear / wheelbase * (v * w_now + down)
        c_now = y_now + a * w_now
        middle = 0.5 * (v + out[k - 1, VX]) if k > 0 else 0.0
        if middle == 0.0:  # at the start, and at rest
            c, w = c_now, w_now
        else:
            yields = _front(mass, wheelbase, a, front, rear, middle)
            by_speed = 1.0 / max(abs(middle), SLOW_MPS)
            c_f, c_r = by_speed / yields, by_speed / rear
            moment = b * c_f - a * c_r
            cc, cw = -(c_f + c_r) / mass, -moment / mass - middle
            wc, ww = -moment / inertia, -(b * b * c_f + a * a * c_r) / inertia
            determinant = cc * ww - cw * wc
            c_rate, w_rate = (c_now - c_before) / dt, (w_now - w_before) / dt
            c_lag = (ww * c_rate - cw * w_rate) / determinant
            w_lag = (cc * w_rate - wc * c_rate) / determinant
            one, by_a = decayed(0.5 * (cc + ww), determinant, dt)
            c_off, w_off = c - c_before - c_lag, w - w_before - w_lag
            c = c_now + c_lag + one * c_off + by_a * (cc * c_off + cw * w_off)
            w = w_now + w_lag + one * w_off + by_a * (wc * c_off + ww * w_off)
        c_before, w_before = c_now, w_now
        out[k, VY], out[k, W] = c - a * w, w


@njit
def _front(mass: float, wheelbase: float, a: float, front: float, rear: float, v: float) -> float:
    """Return the compliance of the front axle at a speed: one with which the body does not spin."""
    fast = v * abs(v)
    least = -(1.0 - LEAST_RATIO) * wheelbase / fast if fast != 0.0 else 0.0
    understeer = mass * (a * front - (wheelbase - a) * rear) / wheelbase
    if fast * understeer < fast * least:
        return (least * wheelbase / mass + (wheelbase - a) * rear) / a
    return front
