"""What a body on wheels does, of every drive: its planar plant, and its motion with what the ground adds to it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.effects import EFFECTS
from terrain.kernels import filled, njit
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.planar.bicycle import BICYCLE
from terrain.simulation.planar.model import Drive, Ground, Inputs, body_numbers, slopes
from terrain.simulation.planar.omni import OMNI
from terrain.simulation.planar.skid import SKID
from terrain.simulation.planar.swerve import SWERVE

DRIVES: Mapping[str, Drive] = {
    "skid_steer": SKID,
    "tracked": SKID,
    "swerve": SWERVE,
    "omni": OMNI,
    "bicycle": BICYCLE,
}
"""By the name of a robot's drive."""

UNDISTURBED = np.zeros((0, 3))  # not read-only: that were another type of array, and kernels compiled twice


class Planar(NamedTuple):
    """The planar plant of a robot on a ground: its drive, and ``params`` (1,) of the drive's record."""

    robot: Robot
    drive: Drive
    params: Array

    @property
    def body(self) -> Array:
        """Numbers that every drive has, (1,) of :data:`~terrain.simulation.planar.model.BODY`."""
        return np.asarray(self.params["body"])


def make_planar(robot: Robot, ground: Ground) -> Planar:
    """Return the planar plant of a robot on a ground; what a description leaves out does not act."""
    drive = DRIVES[robot.drive]
    params = filled(drive.record, body=body_numbers(robot, ground), **drive.numbers(robot, ground))
    return Planar(robot, drive, params)


def move(
    planar: Planar,
    vector: Array,
    dt: float,
    wheel_speed_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
    disturbance: Array = UNDISTURBED,
) -> Array:
    """Return what the body does, (n,) of :data:`~terrain.simulation.planar.model.TRUTH`.

    Parameters
    ----------
    planar, vector : the plant, and its parameters in the order of ``effects.PARAMETERS``
    dt : step in s
    wheel_speed_mps : (n, wheels) wheel rates times the nominal radius
    steer_rad : (n, wheels) angles as encoders without error show them; not looked at without steering
    grade_rad, roll_rad : (n,) true tilt
    disturbance : (n, 3) what the ground adds to speeds (shares of ``|u|``, along and across) and yaw rate (rad/s), or
        none: (0, 3)
    """
    inputs = wheel_speed_mps, steer_rad, grade_rad, roll_rad, disturbance
    truth = planar.drive.move(planar.params, vector, dt, inputs)
    _finish(planar.body, vector, dt, inputs, planar.drive.drifts, truth)
    return truth


@njit
def _finish(params: Array, vector: Array, dt: float, inputs: Inputs, drifts: bool, truth: Array) -> None:
    """Add what side hill and ground do to the motion, and the specific force along x."""
    p, effective_ratio = vector.view(EFFECTS)[0], params[0].effective_ratio
    _, _, grade_rad, roll_rad, disturbance = inputs
    for k in range(truth.shape[0]):
        row = truth[k]
        fast = math.sqrt(row.speed_x_mps * row.speed_x_mps + row.speed_y_mps * row.speed_y_mps)
        if drifts:
            row.speed_y_mps -= p.side_hill_slip_ratio * effective_ratio * roll_rad[k] * fast
        if disturbance.shape[0] > 0:
            row.speed_y_mps += fast * disturbance[k, 1]
            row.yaw_rate_radps += disturbance[k, 2]
    accel = slopes(truth["speed_x_mps"].copy(), dt)
    for k in range(truth.shape[0]):
        row = truth[k]
        row.accel_x_mps2 = accel[k] - row.yaw_rate_radps * row.speed_y_mps
        row.accel_x_mps2 += GRAVITY_MPS2 * math.sin(grade_rad[k])
