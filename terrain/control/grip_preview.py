"""Speed and steering ahead of bends, by the grip that the estimated cornering stiffness shows.

An axle under the load N carries |F| = f N.  With the cornering stiffness C_0 that the tyre has at small slip,
the force that saturates at the grip mu is, as in :mod:`terrain.simulation.bicycle.plant`::

    f = mu (1 - exp(-q / mu)),   q = C_0 |b| / N

The secant stiffness -F/b falls below C_0 the more of the grip is used.  f is known from speed, yaw rate and
roll, b from an observer of sideslip: a scalar Kalman filter on mu weighs each tick by how much it shows,
df/dmu = 1 - exp(-q/mu) (1 + q/mu), which is nothing at small slip.  What is used is the mean less one
standard deviation.  Ahead, the side force of a speed v in curvature c on a roll a is m (v^2 c + g sin a)::

    v(s)^2 <= (part mu g cos a - g sin a sgn c) / |c|          v^2 <= v(s)^2 + 2 b (s - s_0)

with the braking b.  The sideslip expected ahead, b = -F / C with the adapted C, is steered before it comes.

Future work of Deremetz et al., ICRA 2017, section VII: "parts of the adapted dynamic parameters" in the
prediction.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.control.paths import CURVATURE, GRID_M, ROLL
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots.bicycle import BicycleRobot


class GripSettings(NamedTuple):
    """What is assumed of grip, and how much of it is used.

    Parameters
    ----------
    grip_ratio, grip_std : at first
    grip_walk : change within a second, one standard deviation
    used_part : of the grip that the side force ahead may take
    braking_mps2 : below the drive's acceleration
    stiffness_std_ratio : of C_0, the nominal stiffness
    correlation_s : for which errors of an estimated slip last
    """

    grip_ratio: float = 0.6
    grip_std: float = 0.15
    grip_walk: float = 0.02
    used_part: float = 0.75
    braking_mps2: float = 1.0
    stiffness_std_ratio: float = 0.2
    correlation_s: float = 0.3


GRIP, VARIANCE = 0, 1
(AHEAD, BEHIND, MASS, C_FRONT, C_REAR, WALK, PART, BRAKING, C_STD, CORRELATION) = range(10)
_LEAST_GRIP, _MOST_GRIP = 0.05, 1.5
_SHOWS = 0.1
"""Part of the load below which a side force shows nothing of the grip."""
_LOOK_M = 0.5


def grip_params(robot: BicycleRobot, settings: GripSettings) -> tuple[Array, Array]:
    """Return the parameters (10,) and the first memory (2,): grip and its variance.

    Raises
    ------
    ConfigError
        if a setting is not above zero, or the part used above 1.
    """
    bad = [f"{name} is {value:g}" for name, value in settings._asdict().items() if not 0 < value < math.inf]
    if bad or settings.used_part > 1.0:
        raise ConfigError(f"{', '.join(bad) or 'used_part is above 1'}; see GripSettings")
    params = [robot.com_ahead_m, robot.com_behind_front_m, robot.mass_kg]
    params += [robot.front_cornering_npr, robot.rear_cornering_npr]
    params += [settings.grip_walk, settings.used_part, settings.braking_mps2]
    params += [settings.stiffness_std_ratio, settings.correlation_s]
    return np.array(params), np.array([settings.grip_ratio, settings.grip_std**2])


@njit(cache=True)
def grip_step(
    params: Array, memory: Array, force_mps2: float, slips: Array, slip_std: Array, dt_s: float
) -> Array:
    """Return the next grip and its variance; compiled, the memory is not changed.

    Parameters
    ----------
    params, memory : of :func:`grip_params`
    force_mps2 : lateral specific force, u r + g sin a
    slips, slip_std : (2,) as estimated; NaN shows nothing
    dt_s : since the step before

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> params, memory = grip_params(load_robot("adap2e"), GripSettings())
    >>> slips, std = np.array([-0.3, -0.3]), np.full(2, 0.01)
    >>> for _ in range(200):  # half of g although the slip is large: that is all the grip there is
    ...     memory = grip_step(params, memory, 4.9, slips, std, 0.02)
    >>> round(float(memory[GRIP]), 2)
    0.51
    """
    after = memory.copy()
    if not (0.0 < dt_s < 1.0 and abs(force_mps2) < 50.0):
        return after
    after[VARIANCE] = min(memory[VARIANCE] + params[WALK] ** 2 * dt_s, 0.25)
    used = abs(force_mps2) / GRAVITY_MPS2
    if used < _SHOWS:
        return after
    base = params[AHEAD] + params[BEHIND]
    for i in range(2):
        load = params[MASS] * GRAVITY_MPS2 * (params[AHEAD] if i == 0 else params[BEHIND]) / base
        if not (abs(slips[i]) < 1.5 and slip_std[i] < 1.0) or slips[i] * force_mps2 > 0.0:
            continue
        slope, mu = params[C_FRONT + i] / load, after[GRIP]
        q = slope * abs(slips[i])
        left = math.exp(-q / mu)
        shown = 1.0 - left * (1.0 + q / mu)
        noise = 0.02**2 + left**2 * ((slope * slip_std[i]) ** 2 + (params[C_STD] * q) ** 2)
        noise *= max(1.0, 2.0 * params[CORRELATION] / dt_s)
        gain = after[VARIANCE] * shown / (shown * shown * after[VARIANCE] + noise)
        after[GRIP] = min(max(mu + gain * (used - mu * (1.0 - left)), _LEAST_GRIP), _MOST_GRIP)
        after[VARIANCE] *= 1.0 - gain * shown
    return after


@njit(cache=True)
def _roll_at(rows: Array, i: int, roll_rad: float) -> float:
    """Return the roll of a row of a path; where it is not known, what is measured now."""
    return roll_rad if math.isnan(rows[i, ROLL]) else rows[i, ROLL]


@njit(cache=True)
def preview_speed(params: Array, memory: Array, rows: Array, distance_m: float, roll_rad: float) -> float:
    """Return the fastest speed at a distance along a path; infinite where nothing limits it; compiled.

    Examples
    --------
    >>> from terrain.control.paths import path_from_curvature
    >>> from terrain.robots import load_robot
    >>> params, memory = grip_params(load_robot("adap2e"), GripSettings(grip_ratio=0.5, grip_std=1e-6))
    >>> bend = path_from_curvature(np.array([0.0, 20.0, 20.1, 40.0]), np.array([0.0, 0.0, 0.1, 0.1])).rows
    >>> [round(preview_speed(params, memory, bend, s, 0.0), 2) for s in (10.0, 20.0, 25.0)]
    [7.6, 6.15, 6.06]
    """
    grip = max(memory[GRIP] - math.sqrt(memory[VARIANCE]), _LEAST_GRIP)
    first = min(max(int(distance_m / GRID_M), 0), rows.shape[0] - 1)
    least, step = math.inf, int(_LOOK_M / GRID_M)
    for i in range(first, rows.shape[0], step):
        ahead = (i - first) * GRID_M
        if 2.0 * params[BRAKING] * ahead > least:
            break
        curvature, roll = rows[i, CURVATURE], _roll_at(rows, i, roll_rad)
        pull = GRAVITY_MPS2 * math.sin(roll) * (1.0 if curvature > 0.0 else -1.0)
        room = params[PART] * grip * GRAVITY_MPS2 * math.cos(roll) - max(pull, 0.0)
        square = max(room, 0.25) / max(abs(curvature), 1e-6)
        least = min(least, square + 2.0 * params[BRAKING] * ahead)
    return math.sqrt(least)


@njit(cache=True)
def expected_slips(
    params: Array, rows: Array, distance_m: float, roll_rad: float, speed_mps: float, stiffness: Array
) -> Array:
    """Return the slip angles (2,) of steady cornering at a distance, by an estimated stiffness; compiled."""
    i = min(max(int(distance_m / GRID_M), 0), rows.shape[0] - 1)
    force = speed_mps**2 * rows[i, CURVATURE] + GRAVITY_MPS2 * math.sin(_roll_at(rows, i, roll_rad))
    base, slips = params[AHEAD] + params[BEHIND], np.zeros(2)
    slips[0] = -params[MASS] * params[AHEAD] / base * force / stiffness[0]
    slips[1] = -params[MASS] * params[BEHIND] / base * force / stiffness[1]
    return np.minimum(np.maximum(slips, -0.2), 0.2)
