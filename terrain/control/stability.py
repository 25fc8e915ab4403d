"""Stability of a slip controller on a robot: its sampled loop, linearised, over the range of operation.

Small changes about steady rolling of a driven wheel that carries its part m of the robot's mass, with rate w,
ground speed v, ``V = max(w r, v)``, slip s, the slip k that the contact has built up over its relaxation length,
torque T, the PI loop of the motor driver (q its integral, e its estimate of w, g its gains) and y, the estimated
slip that the controller uses::

    s = (r (1 - s_0) w - v) / V  (traction)   or   (r w - (1 + s_0) v) / V  (braking)
    k' = (s - k) V / sigma                    thrust F = c (k + damping k')
    J w' = T - r F,   m v' = F                T' = (g_P (u - e) + q - T) / tau_T,  q' = g_I (u - e)
    e' = (w - e) / tau_e                      y' = (s - y) / tau_encoder

The controller gives its output u once in a sample time, after a delay (whole samples, rounded up), and
between samples u is held; so the loop is a matrix from one sample to the next, and it is stable where all
eigenvalues are inside the unit circle.  One eigenvalue is always 1 and is removed: w, v and u can shift
together without a change of slip, which is not observable in slip.  This mode is the drift of a robot whose
target is not the balance slip, and no oscillation.

The range: V from the low speed of the controller to the largest of the motors, traction and braking, and
slopes of the thrust over slip from almost zero (a wheel that slides) to twice that of tiles.  By the first
equation one rad/s changes the slip by r / V, which the controller's normalised error makes up for: its gain is
K_P at any speed.  For AgriMaRo with a delay of 0.05 s and K_P alone, the loop is unstable from K_P = 1.53 on.  Of
the thesis' printed form, whose error is the slip, the gain is K_P r / V and is largest at the lowest speed: it
is unstable from K_P = 0.38 rad/s on at 0.05 m/s, from 3.8 at 0.5 m/s and from 15 at 2 m/s.

The body's friction with the ground, the limits of torque and output, and the falling branch beyond the peak
of a thrust curve are not modelled.  Encoders and speed over ground are assumed to have the same low-pass,
as the slip ratio requires (thesis 7.2.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy.linalg import expm

from terrain.constants import GRAVITY_MPS2
from terrain.control.pid import LOW_SPEED_MPS, Gains
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.plants.dynamic import DEFLECTION_DAMPING_S
from terrain.simulation.sensors import STEP_S

SAMPLE_TIME_S = 0.02  #: Sample time of the commands, assumed: the thesis specifies none.
DELAY_S = 0.05  #: From the time of a measurement to the command computed from it; assumed.
LONGEST_DELAY_S = 1.0

N_SPEEDS = 24
SLIPS = (-0.2, 0.2)  #: Braking has the full gain, traction 1 - s times as much.
#: Rise of the thrust with slip, in loads: turf at its balance slip has 0.6, tiles have 15.
SLOPES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
LARGEST_FACTOR = 1e3  #: A larger gain margin is given as infinite.


def gain_margin(robot: Robot, gains: Gains, delay_s: float = DELAY_S) -> float:
    """Return the factor of :func:`check_stable`, below 1 where the loop is unstable."""
    return _margin(robot, gains, delay_s)[0]


def check_stable(robot: Robot, gains: Gains, delay_s: float = DELAY_S) -> float:
    """Return the factor on all gains at which the loop becomes unstable somewhere in the robot's range of operation.

    It is above 1, and infinite for none; ``ConfigError`` is raised if the loop is unstable at some speed, or the delay
    is not accepted.  The delay is from measurement to command, beside the encoders' low-pass; below the
    low speed the controller is inactive.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> robot = load_robot("agrimaro")
    >>> round(check_stable(robot, Gains(0.5, 0.5, limit=5.0)), 1)
    3.0
    >>> check_stable(robot, Gains(2.0, 0.0, limit=5.0))
    Traceback (most recent call last):
    terrain.errors.ConfigError: robot agrimaro: slip control (kp 2, ki 0) with a delay of 0.05 s is
    unstable from 0.05 to 2 m/s; it is stable up to 0.76 times these gains
    """
    margin, unstable = _margin(robot, gains, delay_s)
    if unstable:
        raise ConfigError(
            f"robot {robot.name}: slip control (kp {gains.kp:g}, ki {gains.ki:g}) "
            f"with a delay of {delay_s:g} s is unstable from {min(unstable):.3g} to {max(unstable):.3g} m/s; "
            f"it is stable up to {margin:.2g} times these gains"
        )
    return margin


def _margin(robot: Robot, gains: Gains, delay_s: float) -> tuple[float, list[float]]:
    """Return the factor on the gains up to which the loop is stable, and speeds at which it is not as it is."""
    robot.require("body", "motors", "sensors")
    fastest_mps = robot.wheel_radius_m * robot.motors.speed_max_radps
    speeds_mps = np.geomspace(LOW_SPEED_MPS, fastest_mps, N_SPEEDS).tolist()
    places = list(product(speeds_mps, SLIPS, SLOPES))
    without, loops = (
        loop_matrices(robot, one, delay_s, places) for one in (gains._replace(kp=0.0, ki=0.0), gains)
    )

    def radii(factor: float) -> Array:  # with all gains scaled: the matrix is linear in them
        return np.asarray(np.abs(np.linalg.eigvals(without + factor * (loops - without))).max(axis=1))

    margin, high = 1 / LARGEST_FACTOR, LARGEST_FACTOR
    if radii(high).max() < 1.0:
        margin = math.inf
    while high / margin > 1.003:
        middle = math.sqrt(margin * high)
        margin, high = (middle, high) if radii(middle).max() < 1.0 else (margin, middle)
    return margin, [place[0] for place, radius in zip(places, radii(1.0), strict=True) if radius >= 1.0]


def loop_matrices(
    robot: Robot, gains: Gains, delay_s: float, places: Sequence[tuple[float, float, float]]
) -> Array:
    """Return the closed loops (k, n, n) of ``pid_step`` and the plant from one sample to the next; without the drift.

    Parameters
    ----------
    robot, gains, delay_s : as :func:`check_stable` takes them
    places : (k) of V in m/s, the larger of wheel circumferential speed and ground speed; slip s_0; slope c in
        loads
    """
    if not 0 <= delay_s <= LONGEST_DELAY_S:
        raise ConfigError(f"delay_s is {delay_s!r}, 0 to {LONGEST_DELAY_S:g} s is required")
    dt_s, radius_m = SAMPLE_TIME_S, robot.wheel_radius_m
    n_delayed = math.ceil(delay_s / dt_s - 1e-9)
    body, motors, sensors, part_kg = (
        robot.body,
        robot.motors,
        robot.sensors,
        robot.mass_kg / len(robot.logged_wheels),
    )
    rate, speed, contact, torque, q, estimate, measured, command = np.eye(8)  # w, v, k, T, q, e, y, u
    lags_s = motors.torque_time_constant_s, motors.speed_estimate_time_constant_s
    torque_s, estimate_s = (max(lag_s, STEP_S) for lag_s in lags_s)  # as in the simulator
    encoder_s = max(sensors.encoder_time_constant_s, STEP_S)
    systems = []  # (8, 8) of the plant; the last row, of the command, is 0
    for speed_mps, slip_ratio, slope_ratio in places:
        by_wheel, by_robot = (1 - slip_ratio, 1.0) if slip_ratio > 0 else (1.0, 1 + slip_ratio)
        slip = (radius_m * by_wheel * rate - by_robot * speed) / speed_mps
        build_up = (slip - contact) * speed_mps / body.relaxation_length_m
        thrust = slope_ratio * part_kg * GRAVITY_MPS2 * (contact + DEFLECTION_DAMPING_S * build_up)
        speed_error = command - estimate
        rows = (
            (torque - radius_m * thrust) / body.wheel_inertia_kgm2,
            thrust / part_kg,
            build_up,
            (motors.speed_gain_nmspr * speed_error + q - torque) / torque_s,
            motors.speed_integral_nmpr * speed_error,
            (rate - estimate) / estimate_s,
            (slip - measured) / encoder_s,
            np.zeros(8),
        )
        systems.append(rows)
    plants = expm(np.array(systems) * dt_s)
    *_, measured_slip, integral = np.eye(8)
    loops = []
    for (speed_mps, slip_ratio, _), plant in zip(places, plants, strict=True):
        error = -measured_slip * (speed_mps / radius_m)
        controller = np.array([integral + gains.ki * dt_s * error])
        output = gains.kp * error + controller[0]
        loop = closed_loop(plant[:-1, :-1], plant[:-1, -1], controller, output, n_delayed)
        rolls = radius_m * (1 - slip_ratio) if slip_ratio > 0 else radius_m / (1 + slip_ratio)
        # The speeds of wheel and robot, the estimate and commands shift together.
        together = np.array([1.0, rolls, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, *np.ones(n_delayed)])
        # The loop on the complement of the direction that it maps to itself: its other eigenvalues.
        across = np.linalg.svd(together[None])[2][1:]
        loops.append(across @ loop @ across.T)
    return np.array(loops)


def closed_loop(keep: Array, drive: Array, controller: Array, output: Array, n_delayed: int) -> Array:
    """Return a sampled loop: plant, controller, and delayed commands.

    Parameters
    ----------
    keep, drive : (n, n) and (n,) of the plant, from sample to sample, and by its command
    controller : (m, n + m) next states of the controller, by those of plant and controller
    output : (n + m,) of the controller
    n_delayed : samples until the plant has it
    """
    n, known = len(keep), len(output)
    size = known + n_delayed
    loop, applied = np.zeros((size, size)), np.zeros(size)
    loop[:n, :n] = keep
    loop[n:known, :known] = controller
    applied[:known] = output
    if n_delayed:
        loop[known] = applied
        loop[known + 1 :] = np.eye(size)[known:-1]
        applied = np.eye(size)[-1]
    loop[:n] += np.outer(drive, applied)
    return loop
