r"""Motion of omni robots in the planar plant: each wheel pulls along its drive direction, rollers resist across it.

Wheel i at :math:`p_i` carries the share :math:`n_i` of the weight W, turns with the circumferential speed :math:`u_i`,
and with the twist V of the centre of mass its own centre moves by :math:`D_i V` along the direction that it drives and
by :math:`E_i V` across it.  Over the root mean square speed U of the wheels or, where that is larger, of their centres,
so that slip does not depend on speed, the forces on it are

.. math::
    F_i = n_i W C \frac{u_i - D_i V}{U}, \qquad G_i = -r\, n_i W \frac{E_i V}{U} .

C is the traction over the load of the ground at the root mean square slip of the wheels, over that slip, and r the
friction of the rollers over the load; steady motion depends on :math:`\rho = r / C` alone, the force that it takes on
r and C.  Rolling resistance :math:`R_i` opposes the motion along each wheel.  With the masses M and gravity P of a
slope

.. math:: M \dot V = \sum_i D_i^T (F_i - R_i) + E_i^T G_i + P + M\,(w v_y, -w v_x, 0) .

A contact follows within :math:`U / (C g)`, some milliseconds: steps are implicit in V, which is stable at rest, too,
and without inertia, resistance and slope is :func:`steady_twist`: the balance that is linear in V,

.. math:: \sum_i n_i \left(D_i^T D_i + \rho\,E_i^T E_i\right) V = \sum_i n_i D_i^T u_i .

Without roller friction the wheels drive what they roll; with ever more of it the body stands.  A common factor
:math:`1 - \kappa` on V stands for an effective radius, or a scale of what measures V, that is off: it slips alike in
all directions, and no log of both distinguishes the two.

What is assumed: three wheels at even angles whose loads follow from the centre of mass and do not shift; one C and r
for all wheels; friction of the rollers that grows with the speed across over U; in steady motion a contact that is
linear in its slip, and no other resistance.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.effects import EFFECTS
from terrain.kernels import inner, njit, numbers, record
from terrain.kinematics.wheels import rolling_matrix
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.contact import softness
from terrain.simulation.planar.model import BODY, TRUTH, Drive, Ground, Inputs, slopes

# Speed below which slip is no more over the speed itself, and over which a resistance takes its full size; assumed:
# a fifth of the slowest measured drive.
ROLLING_MPS = 0.02
# Slip per traction that an effect leaves of the ground's own at the least, and that of the stiffest.
STIFFEST, STIFFEST_GROUND = 0.1, 1e-6
SUBSTEPS = (
    4  # implicit steps within one of the simulation, so that their lag, half of each, is about a millisecond
)

ROLLERS = record(
    {"body": BODY, "wheel_load_ratio": (float, 3), **numbers("wheel_distance_m roller_ratio")}
    | dict.fromkeys(("along", "across", "to_rolled"), (float, (3, 3)))
)
"""``along`` and ``across`` (wheels, 3) give the speed of each wheel's centre along and across its direction for a twist
of the centre of mass, ``to_rolled`` (3, wheels) the twist of the body without slip."""


def _numbers(robot: Robot, ground: Ground) -> dict[str, Any]:
    body, direction = robot.completed.body, robot.wheel_directions_rad
    arm_m = robot.wheel_positions_m - np.array([body.com_x_m, body.com_y_m])
    moments = np.vstack([np.ones(len(arm_m)), arm_m.T])
    return {
        "along": rolling_matrix(arm_m, direction),
        "across": rolling_matrix(arm_m, direction + np.pi / 2),
        "to_rolled": np.linalg.pinv(rolling_matrix(robot.wheel_positions_m, direction)),
        "wheel_load_ratio": np.linalg.pinv(moments) @ np.array([1.0, 0.0, 0.0]),
        "wheel_distance_m": float(np.hypot(*robot.wheel_positions_m[0])),
        "roller_ratio": ground.roller_ratio,
    }


@njit
def _move(params: Array, vector: Array, dt: float, inputs: Inputs) -> Array:
    """Return motion and net traction along x; the current is the sum of the magnitudes of :func:`currents_of`."""
    wheel_speed_mps, _steer_rad, grade_rad, roll_rad, disturbance = inputs
    rollers, p, n = params[0], vector.view(EFFECTS)[0], wheel_speed_mps.shape[0]
    body, out = rollers.body, np.zeros(n, TRUTH)
    along, across, load = _placed(rollers, p)
    com_x, com_y = body.com_x_m + p.load_shift_x_m, body.com_y_m + p.load_shift_y_m
    friction = rollers.roller_ratio + p.roller_friction_ratio
    twist, before = np.zeros(3), np.zeros(3)
    matrix, pushed = np.empty((3, 3)), np.empty(3)
    mass = body.mass_kg * (1.0 + p.payload_ratio)
    inertia = mass, mass, body.yaw_inertia_kgm2 * (1.0 + p.payload_ratio)
    weight, gravity = mass * GRAVITY_MPS2, GRAVITY_MPS2 * body.effective_ratio
    step, size = dt / SUBSTEPS, 0.0
    for k in range(n):
        slope = (-mass * gravity * math.sin(grade_rad[k]), -mass * gravity * math.sin(roll_rad[k]), 0.0)
        u = wheel_speed_mps[k] * (1.0 + p.wheel_radius_ratio)
        last = wheel_speed_mps[max(k - 1, 0)] * (1.0 + p.wheel_radius_ratio)
        started_x, started_y = before[0], before[1]
        for part in range(SUBSTEPS):
            wheels = last + (u - last) * ((part + 1) / SUBSTEPS)
            speed = _fastest(along, wheels, before)
            stiff = _stiffness(body, p, size) * weight / speed
            resists = friction * weight / speed
            w = before[2]
            turning = (mass * w * before[1], -mass * w * before[0], 0.0)
            for a in range(3):
                pushed[a] = inertia[a] / step * before[a] + turning[a] + slope[a]
                for b in range(3):
                    matrix[a, b] = inertia[a] / step if a == b else 0.0
            for i in range(body.n_wheels):
                v = _dot(along[i], before)
                share = load[i]
                drag = share * body.rolling_ratio * weight / math.sqrt(v * v + ROLLING_MPS * ROLLING_MPS)
                for a in range(3):
                    pushed[a] += share * stiff * wheels[i] * along[i, a]
                    for b in range(3):
                        matrix[a, b] += (share * stiff + drag) * along[i, a] * along[i, b]
                        matrix[a, b] += share * resists * across[i, a] * across[i, b]
            _solve(matrix, pushed, twist)
            slip = 0.0
            for i in range(body.n_wheels):
                slip += (wheels[i] - _dot(along[i], twist)) ** 2
            size = min(math.sqrt(slip / body.n_wheels) / speed, 1.0)
            before[:] = twist
        row = out[k]
        row.speed_x_mps, row.speed_y_mps = twist[0] + twist[2] * com_y, twist[1] - twist[2] * com_x
        row.yaw_rate_radps = twist[2]
        row.force_n = (
            mass * ((twist[0] - started_x) / dt - twist[2] * 0.5 * (twist[1] + started_y)) - slope[0]
        )
    currents_a = currents_of(params, vector, dt, wheel_speed_mps, out)
    for k in range(n):
        for i in range(body.n_wheels):
            out[k].current_a += abs(currents_a[k, i])
        # what the ground adds to the motion takes no force
        if disturbance.shape[0] > 0:
            out[k].speed_x_mps *= 1.0 - disturbance[k, 0]
            out[k].speed_y_mps *= 1.0 - disturbance[k, 0]
        u = wheel_speed_mps[k] * (1.0 + p.wheel_radius_ratio)
        out[k].slip_ratio = _body_slip(rollers, u, out[k].speed_x_mps, out[k].speed_y_mps)
    return out


@njit
def currents_of(params: Array, vector: Array, dt: float, wheel_speed_mps: Array, truth: Array) -> Array:
    """Return the current (n, wheels) of each motor along a motion: traction, its own inertia and friction.

    Parameters
    ----------
    params : (1,) of :data:`ROLLERS`
    vector, dt, wheel_speed_mps : as :func:`~terrain.simulation.planar.motion.move` takes them
    truth : (n,) of the motion, without disturbance
    """
    rollers, p, (n, wheels) = params[0], vector.view(EFFECTS)[0], wheel_speed_mps.shape
    body, out = rollers.body, np.empty((n, wheels))
    weight = body.mass_kg * (1.0 + p.payload_ratio) * GRAVITY_MPS2
    radius_m, twist = body.radius_m * (1.0 + p.wheel_radius_ratio), np.empty(3)
    along, _, load = _placed(rollers, p)
    com_x, com_y = body.com_x_m + p.load_shift_x_m, body.com_y_m + p.load_shift_y_m
    spun = np.empty((n, wheels))
    for i in range(wheels):
        spun[:, i] = slopes(wheel_speed_mps[:, i].copy(), dt)
    for k in range(n):
        u, w = wheel_speed_mps[k] * (1.0 + p.wheel_radius_ratio), truth[k].yaw_rate_radps
        twist[0], twist[1] = truth[k].speed_x_mps - w * com_y, truth[k].speed_y_mps + w * com_x
        twist[2] = w
        speed, slip = _fastest(along, u, twist), 0.0
        for i in range(wheels):
            slip += (u[i] - _dot(along[i], twist)) ** 2
        size = min(math.sqrt(slip / wheels) / speed, 1.0)
        stiff = _stiffness(body, p, size) * weight / speed
        for i in range(wheels):
            pull = load[i] * stiff * (u[i] - _dot(along[i], twist))
            torque = (pull + body.rotating_kg / wheels * spun[k, i]) * radius_m
            direction = u[i] / math.sqrt(u[i] * u[i] + ROLLING_MPS * ROLLING_MPS)
            out[k, i] = (torque + body.friction_nm / wheels * direction) / body.nm_per_a
    return out


@inner
def _placed(rollers: Any, p: Any) -> tuple[Array, Array, Array]:
    """Return ``along`` and ``across`` (wheels, 3) and the loads (wheels,) with wheels and load as p has them.

    With the distance d of the wheels, the directions along and across them and out to them, and the centre of mass c,
    ``D_i`` ends in ``d - c x along``, ``E_i`` in ``-c x across``, and wheel i of three carries
    ``(1 + 2 c . out / d) / 3``; one that would carry less than nothing carries nothing, and the others then do not
    balance about c.
    """
    along, across, load = rollers.along.copy(), rollers.across.copy(), rollers.wheel_load_ratio.copy()
    shift_x, shift_y = p.load_shift_x_m, p.load_shift_y_m
    distance = rollers.wheel_distance_m * (1.0 + p.wheel_distance_ratio)
    if shift_x == 0.0 and shift_y == 0.0 and p.wheel_distance_ratio == 0.0:
        return along, across, load
    com_x, com_y, total = rollers.body.com_x_m + shift_x, rollers.body.com_y_m + shift_y, 0.0
    for i in range(rollers.body.n_wheels):
        out = com_x * along[i, 1] - com_y * along[i, 0]
        along[i, 2] = distance - out
        across[i, 2] = -(com_x * across[i, 1] - com_y * across[i, 0])
        load[i] = max(1.0 + 2.0 * out / distance, 0.0) / rollers.body.n_wheels
        total += load[i]
    return along, across, load / total


@inner
def _stiffness(body: Any, p: Any, slip_ratio: float) -> float:
    """Return traction over load and slip of the ground, with the effect that makes it softer."""
    soft = max(softness(body.soft_ratio, slip_ratio), STIFFEST_GROUND)
    return float(1.0 / max(soft + p.force_slip_ratio, STIFFEST * soft))


@inner
def _fastest(along: Array, wheel_speed_mps: Array, twist: Array) -> float:
    """Return the speed U that slip is over: of wheels (wheels,) or their centres, never below a minimum."""
    of_wheels, of_centres, n = 0.0, 0.0, wheel_speed_mps.shape[0]
    for i in range(n):
        of_wheels += wheel_speed_mps[i] ** 2
        of_centres += _dot(along[i], twist) ** 2
    return math.sqrt(max(of_wheels, of_centres) / n + ROLLING_MPS * ROLLING_MPS)


@inner
def _dot(row: Array, twist: Array) -> float:
    product: float = row[0] * twist[0] + row[1] * twist[1] + row[2] * twist[2]
    return product


@inner
def _solve(matrix: Array, pushed: Array, out: Array) -> None:
    """Solve a symmetric positive system of three in place of ``out``, by Cramer's rule."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    p0, p1, p2 = d * f - e * e, c * e - b * f, b * e - c * d
    by = 1.0 / (a * p0 + b * p1 + c * p2)
    q1, q2, r2 = a * f - c * c, b * c - a * e, a * d - b * b
    x, y, z = pushed[0], pushed[1], pushed[2]
    out[0] = (p0 * x + p1 * y + p2 * z) * by
    out[1] = (p1 * x + q1 * y + q2 * z) * by
    out[2] = (p2 * x + q2 * y + r2 * z) * by


@inner
def _body_slip(rollers: Any, wheel_speed_mps: Array, v_x: float, v_y: float) -> float:
    """Return the slip of the body along what the wheels roll; 0 where neither moves, and in place."""
    x, y = 0.0, 0.0
    for i in range(rollers.body.n_wheels):
        x += rollers.to_rolled[0, i] * wheel_speed_mps[i]
        y += rollers.to_rolled[1, i] * wheel_speed_mps[i]
    rolled = math.sqrt(x * x + y * y)
    if rolled < ROLLING_MPS:
        return 0.0
    along = (v_x * x + v_y * y) / rolled
    return (rolled - along) / max(rolled, abs(along))


def steady_twist(
    wheel_speed_mps: Array,
    positions_m: Array,
    direction_rad: Array,
    load_ratio: Array,
    roller_ratio: float,
    scale_error: float = 0.0,
) -> Array:
    """Return the twist (n, 3) of a body whose wheels turn at steady speeds (n, wheels).

    Parameters
    ----------
    wheel_speed_mps : (n, wheels) circumferential
    positions_m, direction_rad : (wheels, 2) and (wheels,) of the wheels
    load_ratio : (wheels,) shares of the weight, summing to 1
    roller_ratio : rho, friction of the rollers over the stiffness of traction; 0 is free
    scale_error : kappa

    Examples
    --------
    A wheel that rolls across entirely, and carries most of the weight, brakes the more:

    >>> from terrain.robots import load_robot
    >>> place = load_robot("robotino").wheel_positions_m, np.radians([150.0, 270.0, 390.0])
    >>> ahead, left, _ = 0.1 * rolling_matrix(*place).T
    >>> load = np.array([0.25, 0.5, 0.25])
    >>> steady_twist(np.array([ahead, left]), *place, load, 0.8)[:, :2].diagonal().round(4)
    array([0.0429, 0.0652])
    """
    along = rolling_matrix(positions_m, direction_rad)
    across = rolling_matrix(positions_m, np.asarray(direction_rad) + np.pi / 2)
    balance = (along * load_ratio[:, None]).T @ along
    balance = balance + roller_ratio * (across * load_ratio[:, None]).T @ across
    driven = np.asarray(wheel_speed_mps) @ (along * load_ratio[:, None])
    return np.asarray((1.0 - scale_error) * np.linalg.solve(balance, driven.T).T)


OMNI = Drive(ROLLERS, _numbers, _move, drifts=False)
