r"""Motion of an omni robot: each wheel pulls along its drive direction, and its rollers resist across it.

Wheel i at :math:`p_i` carries the share :math:`n_i` of the weight W, turns with the circumferential speed
:math:`u_i`, and with the twist V of the centre of mass its own centre moves by :math:`D_i V` along the
direction that it drives and by :math:`E_i V` across it.  The forces on it are those of
:func:`steady_twist`, over the root mean square speed U of the wheels or, where that
is larger, of their centres,

.. math::
    F_i = n_i W C \frac{u_i - D_i V}{U}, \qquad G_i = -r\, n_i W \frac{E_i V}{U},

so that slip does not depend on speed.  C is the traction over the load of the ground at the root mean square
slip of the wheels, over that slip, and r the friction of the rollers over the load; steady motion depends on
:math:`\rho = r / C` alone, the force that it takes on r and C.  Rolling resistance
:math:`R_i` opposes the motion along each wheel.  With the masses M and gravity P of a slope

.. math:: M \dot V = \sum_i D_i^T (F_i - R_i) + E_i^T G_i + P + M\,(w v_y, -w v_x, 0) .

A contact follows within :math:`U / (C g)`, some milliseconds: steps are implicit in V, which is stable at
rest, too, and without inertia, resistance and slope is
:func:`steady_twist`.

What is assumed: three wheels at even angles whose loads follow from the centre of mass and do not shift; one
C and r for all wheels; friction of the rollers that grows with the speed across over U.

**Steady motion.** Wheel i with the share :math:`n_i` of the weight drives along :math:`d_i` with the
circumferential speed u_i and is rolled across, along :math:`e_i`, with the speed of its centre :math:`p_i'`.
Traction grows with the slip speed, roller friction with the speed across, both in proportion to the load and
over one speed:

.. math:: F_i = n_i \left( c\,(u_i - d_i \cdot p_i')\,d_i - c\,\rho\,(e_i \cdot p_i')\,e_i \right)

so that slip does not depend on the speed, as measured runs show.  In steady motion forces and moment are in
balance, which is linear in the twist V: with the rows :math:`D_i = (d_i, p_i \times d_i)` and E_i alike,

.. math:: \sum_i n_i \left(D_i^T D_i + \rho\,E_i^T E_i\right) V = \sum_i n_i D_i^T u_i .

Without roller friction the wheels drive what they roll; with ever more of it the body stands.  A common
factor :math:`1 - \kappa` on V stands for an effective radius, or a scale of what measures V, that is off: it
slips alike in all directions, and no log of both distinguishes the two.

What is assumed: a contact that is linear in its slip, no other resistance, one rho for all wheels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.effects import EFFECTS
from terrain.kernels import njit
from terrain.kinematics.wheels import rolling_matrix
from terrain.records import Array
from terrain.simulation.contact import softness
from terrain.simulation.planar.model import AMPS, FORCE, N_TRUTH, SLIP, VX, VY, Planar, W, slopes

ROLLING_MPS = 0.02
"""Speed below which slip is no more over the speed itself, and over which a resistance takes its full size;
assumed: a fifth of the slowest measured drive."""

STIFFEST, STIFFEST_GROUND = 0.1, 1e-6
"""Slip per traction that an effect leaves of the ground's own at the least, and that of the stiffest."""

SUBSTEPS = 4
"""Implicit steps within one of the simulation, so that their lag, half of each, is about a millisecond."""


@njit
def move_omni(
    planar: Planar,
    vector: Array,
    dt: float,
    wheel_speed_mps: Array,
    grade_rad: Array,
    roll_rad: Array,
    disturbance: Array,
) -> Array:
    """Return motion and net traction along x; arguments are those of ``planar.motion.move``.

    Slip is that of the body, against the twist that the wheels would roll; the current is the sum of the
    magnitudes of the motors' (:func:`currents_of`).
    """
    p, n = vector.view(EFFECTS)[0], wheel_speed_mps.shape[0]
    out = np.zeros((n, N_TRUTH))
    along, across, load = placed(planar, p)
    com_x, com_y = planar.com_x_m + p.load_shift_x_m, planar.com_y_m + p.load_shift_y_m
    rollers = planar.roller_ratio + p.roller_friction_ratio
    twist, before = np.zeros(3), np.zeros(3)
    matrix, pushed = np.empty((3, 3)), np.empty(3)
    mass = planar.mass_kg * (1.0 + p.payload_ratio)
    inertia = mass, mass, planar.yaw_inertia_kgm2 * (1.0 + p.payload_ratio)
    weight, gravity = mass * GRAVITY_MPS2, GRAVITY_MPS2 * planar.effective_ratio
    step, size = dt / SUBSTEPS, 0.0
    for k in range(n):
        slope = (-mass * gravity * math.sin(grade_rad[k]), -mass * gravity * math.sin(roll_rad[k]), 0.0)
        u = wheel_speed_mps[k] * (1.0 + p.wheel_radius_ratio)
        last = wheel_speed_mps[max(k - 1, 0)] * (1.0 + p.wheel_radius_ratio)
        started_x, started_y = before[0], before[1]
        for part in range(SUBSTEPS):
            rolled = last + (u - last) * ((part + 1) / SUBSTEPS)
            speed = fastest(along, rolled, before)
            stiff = stiffness(planar, p, size) * weight / speed
            resists = rollers * weight / speed
            w = before[2]
            turning = (mass * w * before[1], -mass * w * before[0], 0.0)
            for a in range(3):
                pushed[a] = inertia[a] / step * before[a] + turning[a] + slope[a]
                for b in range(3):
                    matrix[a, b] = inertia[a] / step if a == b else 0.0
            for i in range(planar.n_wheels):
                v = dot(along[i], before)
                share = load[i]
                drag = share * planar.rolling_ratio * weight / math.sqrt(v * v + ROLLING_MPS * ROLLING_MPS)
                for a in range(3):
                    pushed[a] += share * stiff * rolled[i] * along[i, a]
                    for b in range(3):
                        matrix[a, b] += (share * stiff + drag) * along[i, a] * along[i, b]
                        matrix[a, b] += share * resists * across[i, a] * across[i, b]
            solve3(matrix, pushed, twist)
            slip = 0.0
            for i in range(planar.n_wheels):
                slip += (rolled[i] - dot(along[i], twist)) ** 2
            size = min(math.sqrt(slip / planar.n_wheels) / speed, 1.0)
            before[:] = twist
        v_x, v_y = twist[0] + twist[2] * com_y, twist[1] - twist[2] * com_x
        out[k, VX], out[k, VY], out[k, W] = v_x, v_y, twist[2]
        out[k, FORCE] = (
            mass * ((twist[0] - started_x) / dt - twist[2] * 0.5 * (twist[1] + started_y)) - slope[0]
        )
    out[:, AMPS] = np.abs(currents_of(planar, vector, dt, wheel_speed_mps, out)).sum(axis=1)
    for k in range(n):  # what the ground adds to the motion takes no force
        if disturbance.shape[0] > 0:
            out[k, VX] *= 1.0 - disturbance[k, 0]
            out[k, VY] *= 1.0 - disturbance[k, 0]
        u = wheel_speed_mps[k] * (1.0 + p.wheel_radius_ratio)
        out[k, SLIP] = _body_slip(planar, u, out[k, VX], out[k, VY])
    return out


@njit
def currents_of(planar: Planar, vector: Array, dt: float, wheel_speed_mps: Array, truth: Array) -> Array:
    """Return the current (n, wheels) of each motor along a motion: traction, its own inertia and friction.

    Parameters
    ----------
    planar, vector, dt, wheel_speed_mps : as :func:`move_omni` takes them
    truth : (n, N_TRUTH) of the motion, without disturbance
    """
    p, (n, wheels) = vector.view(EFFECTS)[0], wheel_speed_mps.shape
    out = np.empty((n, wheels))
    weight = planar.mass_kg * (1.0 + p.payload_ratio) * GRAVITY_MPS2
    radius_m, twist = planar.radius_m * (1.0 + p.wheel_radius_ratio), np.empty(3)
    along, _, load = placed(planar, p)
    com_x, com_y = planar.com_x_m + p.load_shift_x_m, planar.com_y_m + p.load_shift_y_m
    spun = np.empty((n, wheels))
    for i in range(wheels):
        spun[:, i] = slopes(wheel_speed_mps[:, i].copy(), dt)
    for k in range(n):
        u = wheel_speed_mps[k] * (1.0 + p.wheel_radius_ratio)
        twist[0] = truth[k, VX] - truth[k, W] * com_y
        twist[1] = truth[k, VY] + truth[k, W] * com_x
        twist[2] = truth[k, W]
        speed, slip = fastest(along, u, twist), 0.0
        for i in range(wheels):
            slip += (u[i] - dot(along[i], twist)) ** 2
        size = min(math.sqrt(slip / wheels) / speed, 1.0)
        stiff = stiffness(planar, p, size) * weight / speed
        for i in range(wheels):
            pull = load[i] * stiff * (u[i] - dot(along[i], twist))
            torque = (pull + planar.rotating_kg / wheels * spun[k, i]) * radius_m
            direction = u[i] / math.sqrt(u[i] * u[i] + ROLLING_MPS * ROLLING_MPS)
            out[k, i] = (torque + planar.friction_nm / wheels * direction) / planar.nm_per_a
    return out


@njit
def placed(planar: Planar, p: Any) -> tuple[Array, Array, Array]:
    """Return ``along`` and ``across`` (wheels, 3) and the loads (wheels,) with wheels and load as p has them.

    With the distance d of the wheels, the directions along and across them and out to them, and the centre
    of mass c, ``D_i`` ends in ``d - c x along``, ``E_i`` in ``-c x across``, and wheel i of three carries
    ``(1 + 2 c . out / d) / 3``; one that would carry less than nothing carries nothing, and
    the others then do not balance about c.
    """
    along, across, load = planar.along.copy(), planar.across.copy(), planar.wheel_load_ratio.copy()
    shift_x, shift_y = p.load_shift_x_m, p.load_shift_y_m
    distance = planar.wheel_distance_m * (1.0 + p.wheel_distance_ratio)
    if shift_x == 0.0 and shift_y == 0.0 and p.wheel_distance_ratio == 0.0:
        return along, across, load
    com_x, com_y, total = planar.com_x_m + shift_x, planar.com_y_m + shift_y, 0.0
    for i in range(planar.n_wheels):
        along[i, 2] = distance - (com_x * along[i, 1] - com_y * along[i, 0])
        across[i, 2] = -(com_x * across[i, 1] - com_y * across[i, 0])
        out = com_x * along[i, 1] - com_y * along[i, 0]
        load[i] = max(1.0 + 2.0 * out / distance, 0.0) / planar.n_wheels
        total += load[i]
    return along, across, load / total


@njit
def stiffness(planar: Planar, p: Any, slip_ratio: float) -> float:
    """Return traction over load and slip of the ground, with the effect that makes it softer."""
    soft = max(softness(planar.soft_ratio, slip_ratio), STIFFEST_GROUND)
    return float(1.0 / max(soft + p.force_slip_ratio, STIFFEST * soft))


@njit
def fastest(along: Array, wheel_speed_mps: Array, twist: Array) -> float:
    """Return the speed U that slip is over: of wheels (wheels,) or their centres, never below a minimum."""
    rolled, moved, n = 0.0, 0.0, wheel_speed_mps.shape[0]
    for i in range(n):
        rolled += wheel_speed_mps[i] ** 2
        moved += dot(along[i], twist) ** 2
    return math.sqrt(max(rolled, moved) / n + ROLLING_MPS * ROLLING_MPS)


@njit
def dot(row: Array, twist: Array) -> float:
    """Return the product of two rows of three."""
    product: float = row[0] * twist[0] + row[1] * twist[1] + row[2] * twist[2]
    return product


@njit
def solve3(matrix: Array, pushed: Array, out: Array) -> None:
    """Solve a symmetric positive system of three in place of ``out``, by Cramer's rule.

    Examples
    --------
    >>> x = np.empty(3)
    >>> solve3(np.diag(np.array([1.0, 2.0, 4.0])), np.ones(3), x)
    >>> x.tolist()
    [1.0, 0.5, 0.25]
    """
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    p0, p1, p2 = d * f - e * e, c * e - b * f, b * e - c * d
    by = 1.0 / (a * p0 + b * p1 + c * p2)
    q1, q2, r2 = a * f - c * c, b * c - a * e, a * d - b * b
    x, y, z = pushed[0], pushed[1], pushed[2]
    out[0] = (p0 * x + p1 * y + p2 * z) * by
    out[1] = (p1 * x + q1 * y + q2 * z) * by
    out[2] = (p2 * x + q2 * y + r2 * z) * by


@njit
def _body_slip(planar: Planar, wheel_speed_mps: Array, v_x: float, v_y: float) -> float:
    """Return the slip of the body along what the wheels roll; 0 where neither moves, and in place."""
    x, y = 0.0, 0.0
    for i in range(planar.n_wheels):
        x += planar.to_rolled[0, i] * wheel_speed_mps[i]
        y += planar.to_rolled[1, i] * wheel_speed_mps[i]
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
