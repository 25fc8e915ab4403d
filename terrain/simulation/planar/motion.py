"""What a body on wheels does: motion by its kind of drive, and what a side hill and the ground add to it."""

from __future__ import annotations

import math

from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.effects import INDEX
from terrain.records import Array
from terrain.simulation.planar.bicycle import move_bicycle
from terrain.simulation.planar.model import AX, SWERVE_WHEELS, VX, VY, Planar, W
from terrain.simulation.planar.omni import move_omni
from terrain.simulation.planar.signals import slopes
from terrain.simulation.planar.skid_steer import move_skid
from terrain.simulation.planar.swerve import move_swerve

_SIDE_HILL = INDEX["side_hill_slip_ratio"]


@njit(cache=True)
def move(
    planar: Planar,
    p: Array,
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
    planar, p : the simulation, and its parameters in the order of ``effects.PARAMETERS``
    dt : step in s
    wheel_speed_mps : (n, wheels) wheel rates times the nominal radius
    steer_rad : (n, wheels) angles as encoders without error show them; not looked at without steering
    grade_rad, roll_rad : (n,) true tilt
    disturbance : (n, 3) what the ground adds to speeds (shares of ``|u|``, along and across) and yaw rate
        (rad/s), or none: (0, 3)
    """
    if planar.omni:
        out: Array = move_omni(planar, p, dt, wheel_speed_mps, grade_rad, roll_rad, disturbance)
    elif planar.bicycle:
        out = move_bicycle(planar, p, dt, wheel_speed_mps, steer_rad, grade_rad, roll_rad, disturbance)
    elif planar.n_wheels == SWERVE_WHEELS:
        out = move_swerve(planar, p, dt, wheel_speed_mps, steer_rad, grade_rad, roll_rad, disturbance)
    else:
        out = move_skid(planar, p, dt, wheel_speed_mps, grade_rad, disturbance)
    for k in range(out.shape[0]):
        fast = math.sqrt(out[k, VX] * out[k, VX] + out[k, VY] * out[k, VY])
        if not planar.omni:
            out[k, VY] -= p[_SIDE_HILL] * planar.effective_ratio * roll_rad[k] * fast
        if disturbance.shape[0] > 0:
            out[k, VY] += fast * disturbance[k, 1]
            out[k, W] += disturbance[k, 2]
    accel = slopes(out[:, VX].copy(), dt)
    for k in range(out.shape[0]):
        out[k, AX] = accel[k] - out[k, W] * out[k, VY] + GRAVITY_MPS2 * math.sin(grade_rad[k])
    return out
