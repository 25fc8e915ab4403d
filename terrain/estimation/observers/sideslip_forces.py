"""Dynamics of a car-like robot that observers of sideslip share: (3) of Deremetz et al. 2017, corrected.

With w = v_G sin b, the lateral velocity of the centre of mass, and the slope's roll a::

    r' = (L_R C_R b_R - L_F C_F b_F cos d) / I_z
    w' = -(C_F b_F cos d + C_R b_R) / m - g sin a - u r

Line 1 is the moment of side forces F = -C b, stable for C > 0 ((1) prints F = C b).  Line 2 prints the sign
of the forces and of u r (v cos b_R yaw') reversed: it then has an unstable eigenvalue for either sign of C.
"""

from __future__ import annotations

import math

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.estimation.observers.sideslip_pose import AHEAD, N_SHARED
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import BicycleRobot

MASS, INERTIA, BEHIND, C_LOW, C_HIGH_F, C_HIGH_R, EXCITED, PRINTED = range(N_SHARED, N_SHARED + 8)
"""Places of the dynamics in parameters; ``PRINTED`` is 1 with line 2 as it is printed."""
N_DYNAMIC = N_SHARED + 8

DYNAMIC_STATES: tuple[str, ...] = (
    *("position_x_m", "position_y_m", "yaw_rad", "yaw_rate_radps", "speed_y_mps"),
    *("cornering_front_npr", "cornering_rear_npr"),
)
"""States of the observers that know the dynamics."""

C_LOW_NPR = 1000.0
"""Least cornering stiffness of an axle: at a slip of 0.5 rad it carries 500 N."""
C_HIGH_RATIO = 2.0
"""Largest cornering stiffness over the nominal one."""


def set_dynamics(params: Array, robot: BicycleRobot, excited_mps2: float, as_printed: bool) -> None:
    """Set the dynamics in parameters in place.

    Parameters
    ----------
    params : of at least N_DYNAMIC
    robot : car-like
    excited_mps2 : lateral specific force from which cornering stiffness is adapted
    as_printed : line 2 as the paper prints it
    """
    params[[MASS, INERTIA, BEHIND]] = robot.mass_kg, robot.yaw_inertia_kgm2, robot.com_behind_front_m
    params[C_LOW] = C_LOW_NPR
    params[C_HIGH_F] = C_HIGH_RATIO * robot.front_cornering_npr
    params[C_HIGH_R] = C_HIGH_RATIO * robot.rear_cornering_npr
    params[EXCITED], params[PRINTED] = excited_mps2, float(as_printed)


@njit
def rates(
    params: Array, speed: float, steer: float, roll: float, rate: float, slips: Array, stiffness: Array
) -> tuple[float, float]:
    """Return r' and w' of slip angles and cornering stiffness (2,) of front and rear."""
    front, rear = stiffness[0] * slips[0] * math.cos(steer), stiffness[1] * slips[1]
    turning = (params[AHEAD] * rear - params[BEHIND] * front) / params[INERTIA]
    push = (front + rear) / params[MASS] + speed * rate
    gravity = GRAVITY_MPS2 * math.sin(roll)
    return turning, (push if params[PRINTED] == 1.0 else -push) - gravity


@njit
def rates_by_force(params: Array, steer: float) -> Array:
    """Return the derivative (2, 2) of r' and w' by C b of front and rear."""
    by = np.empty((2, 2))
    sign = 1.0 if params[PRINTED] == 1.0 else -1.0
    by[0, 0], by[0, 1] = -params[BEHIND] * math.cos(steer) / params[INERTIA], params[AHEAD] / params[INERTIA]
    by[1, 0], by[1, 1] = sign * math.cos(steer) / params[MASS], sign / params[MASS]
    return by


@njit
def inverted(matrix: Array) -> Array:
    """Return the inverse of a matrix (2, 2)."""
    det = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    inverse = np.empty((2, 2))
    inverse[0, 0], inverse[1, 1] = matrix[1, 1] / det, matrix[0, 0] / det
    inverse[0, 1], inverse[1, 0] = -matrix[0, 1] / det, -matrix[1, 0] / det
    return inverse


@njit
def is_excited(params: Array, speed: float, roll: float, rate: float) -> bool:
    """Return whether side forces are large enough to show a cornering stiffness."""
    return bool(abs(speed * rate + GRAVITY_MPS2 * math.sin(roll)) > params[EXCITED])
