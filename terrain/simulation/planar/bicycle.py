"""Motion of car-like robots in the planar plant: the linear single-track model, at rest and fast alike.

With the lateral speed ``c`` of the centre of mass, ``a`` ahead of the rear axle and ``b`` behind the front one,
``L = a + b``, the yaw rate ``w``, the speed ``v`` and the steering angle ``d``::

    m (dc/dt + v w) = F_f + F_r - m g sin(ph),      I dw/dt = b F_f - a F_r
    F_f = -C_f (c + b w - v tan d) / |v|,           F_r = -C_r (c - a w) / |v|

as Rajamani, Vehicle Dynamics and Control, has it, with ``tan d`` in place of ``d``, so that at low speed it is the
kinematic bicycle, and ``|v|``, so that it drives backward.  Where nothing changes::

    w = (v tan d - |v| K g sin ph) / (L + K v |v|),     K = m (a / C_f - b / C_r) / L
    v_y = -|v| m b / (L C_r) (v w + g sin ph)           at the rear axle

``x = (c, w)`` follows that, ``dx/dt = A (x - s)``, exactly for an ``s`` that runs straight from sample to sample and
an ``A`` of the step's mean speed.  Understeer is ``K`` more, by a front axle that yields; ``L + K v |v|`` is kept above
a tenth of ``L``: there, near the speed at which a car spins, the linear model ends, and a front axle that yields enough
takes its place.  Slip along is that of :mod:`~terrain.simulation.planar.skid`; there are no currents.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.effects import EFFECTS
from terrain.kernels import inner, njit, numbers, record
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.planar.model import BODY, TRUTH, Drive, Ground, Inputs, decayed, slopes, steered
from terrain.simulation.planar.skid import slip_along

SLOW_MPS = 0.01  # speed below which tyres damp a sideways motion as at it: in less than a millisecond
LEAST_RATIO = (
    0.1  # the effective wheelbase over the wheelbase at the least, and what is left of an axle's compliance
)
STEEPEST_RAD = 1.3  # steering angle at the most, where its tangent is 3.6

_AXLES = "wheelbase_m com_ahead_m front_cornering_npr rear_cornering_npr yaw_inertia_kgm2"
AXLES = record({"body": BODY} | numbers(_AXLES))


def _numbers(robot: Robot, ground: Ground) -> dict[str, Any]:
    return {name: getattr(robot, name) for name in _AXLES.split()}


@njit
def _move(params: Array, vector: Array, dt: float, inputs: Inputs) -> Array:
    """Return motion and traction: the last wheel is the rear one, the first angle that of the front wheel."""
    wheel_speed_mps, steer_rad, grade_rad, roll_rad, disturbance = inputs
    body, p, n = params[0].body, vector.view(EFFECTS)[0], wheel_speed_mps.shape[0]
    out = np.zeros(n, TRUTH)
    u = wheel_speed_mps[:, -1] * (1.0 + p.wheel_radius_ratio)
    speed, rest, slip = slip_along(body, p, dt, u, np.zeros(n), grade_rad, disturbance, True)
    accel = slopes(speed, dt)
    mass = body.mass_kg * (1.0 + p.payload_ratio)
    for k in range(n):
        out[k].force_n = mass * accel[k] + rest[k]
        out[k].speed_x_mps, out[k].slip_ratio = speed[k], slip[k]
    angle = steer_rad[:, 0] + p.steering_offset_front_rad
    _turn(params[0], p, dt, steered(angle, p.steering_delay_s, p.steering_backlash_rad, dt), roll_rad, out)
    return out


@inner
def _turn(car: Any, p: Any, dt: float, steer: Array, roll_rad: Array, out: Array) -> None:
    """Fill in yaw rate and lateral speed of the rear axle of a body that drives at its ``speed_x_mps``."""
    nominal = car.body.mass_kg
    mass = nominal * (1.0 + p.payload_ratio)
    inertia = car.yaw_inertia_kgm2 * (1.0 + p.payload_ratio)
    wheelbase, a = car.wheelbase_m, car.com_ahead_m
    b = wheelbase - a
    soft = 1.0 / (1.0 + p.cornering_stiffness_ratio)
    front = soft / car.front_cornering_npr  # compliance of the axles
    rear = soft / car.rear_cornering_npr
    front = max(front + p.understeer_s2pm * wheelbase / (nominal * a), LEAST_RATIO * front)
    gravity = GRAVITY_MPS2 * car.body.effective_ratio
    c = w = c_before = w_before = 0.0  # of the body, and the steady ones of the sample before
    for k in range(out.shape[0]):
        v = out[k].speed_x_mps
        fast = abs(v)
        yields = _front(mass, wheelbase, a, front, rear, v)
        understeer = mass * (a * yields - b * rear) / wheelbase
        down = gravity * math.sin(roll_rad[k])
        angle = min(max(steer[k], -STEEPEST_RAD), STEEPEST_RAD)
        w_now = (v * math.tan(angle) - fast * understeer * down) / (wheelbase + understeer * v * fast)
        y_now = -fast * mass * b * rear / wheelbase * (v * w_now + down)
        c_now = y_now + a * w_now
        middle = 0.5 * (v + out[k - 1].speed_x_mps) if k > 0 else 0.0
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
        out[k].speed_y_mps, out[k].yaw_rate_radps = c - a * w, w


@inner
def _front(mass: float, wheelbase: float, a: float, front: float, rear: float, v: float) -> float:
    """Return the compliance of the front axle at a speed: one with which the body does not spin."""
    fast = v * abs(v)
    least = -(1.0 - LEAST_RATIO) * wheelbase / fast if fast != 0.0 else 0.0
    understeer = mass * (a * front - (wheelbase - a) * rear) / wheelbase
    if fast * understeer < fast * least:
        return (least * wheelbase / mass + (wheelbase - a) * rear) / a
    return front


BICYCLE = Drive(AXLES, _numbers, _move)
