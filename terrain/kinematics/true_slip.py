"""The true slip of a simulated run, from its stream ``truth``."""

from __future__ import annotations

import numpy as np

from terrain.kinematics.wheel_velocity import TWIST, wheel_frame_velocities
from terrain.records import Array, Stream
from terrain.robots import Robot


def wheel_and_ground_speed(truth: Stream, robot: Robot) -> tuple[Array, Array]:
    """Return the true wheel speed and speed over ground along each wheel, both (n, wheels) in m/s.

    Parameters
    ----------
    truth : stream as ``terrain.simulation`` writes it
    robot : gives the nominal radius and the positions of the wheels
    """
    steer = _of_wheels(truth, robot, "steer_{}_rad")
    twist = np.column_stack([truth.channel(name) for name in TWIST])
    along, _ = wheel_frame_velocities(twist, robot.wheel_positions_m, steer)
    return _of_wheels(truth, robot, "wheel_{}_radps") * robot.wheel_radius_m, along


def true_slip(truth: Stream, robot: Robot) -> Array:
    """Return the slip ratio (n, wheels) that the simulation recorded, positive in traction.

    The recorded one is positive along the wheel's own x axis (:mod:`terrain.slip`); here its sign is that of
    traction in either direction of rolling, ``s * sign(v)`` with the speed over ground v along the wheel.  It
    is that of the wheels' true radii, up to 2 where a wheel turns against its direction of travel, and NaN
    where wheel and robot are at rest.

    Parameters
    ----------
    truth : stream as ``terrain.simulation`` writes it; the slip of a wheel that has no channel is NaN
    robot : gives the wheels and their positions
    """
    recorded = np.full((len(truth), len(robot.wheels)), np.nan)
    for i, wheel in enumerate(robot.wheels):
        if f"slip_{wheel}_ratio" in truth.channels:  # a slip that is NaN throughout is not written
            recorded[:, i] = truth.channel(f"slip_{wheel}_ratio")
    _, ground = wheel_and_ground_speed(truth, robot)
    return recorded * np.where(ground < 0.0, -1.0, 1.0)


def _of_wheels(truth: Stream, robot: Robot, pattern: str) -> Array:
    return np.column_stack([truth.channel(pattern.format(wheel)) for wheel in robot.wheels])
