"""The true slip of a simulated run, from its stream ``truth``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terrain.kinematics.wheel_velocity import TWIST, wheel_frame_velocities
from terrain.records import Array, Stream
from terrain.robots import Robot
from terrain.slip import traction_slip


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


def true_slip(truth: Stream, wheels: Sequence[str]) -> Array:
    """Return the slip ratio (n, wheels) that a simulation recorded, positive in traction.

    The recorded one is signed along the wheel's own x axis; here its sign is that of traction in both
    directions (:func:`terrain.slip.traction_slip`).  It is that of the wheels' true radii, up to 2 where a
    wheel turns against the motion, and NaN where wheel and robot are at rest.

    Parameters
    ----------
    truth : stream as ``terrain.simulation`` writes it; a slip that is never defined has no channel
    wheels : their names
    """
    recorded = np.full((len(truth), len(wheels)), np.nan)
    for i, wheel in enumerate(wheels):
        if f"slip_{wheel}_ratio" in truth.channels:
            recorded[:, i] = truth.channel(f"slip_{wheel}_ratio")
    return traction_slip(recorded, np.column_stack([truth.channel(f"wheel_{w}_radps") for w in wheels]))


def _of_wheels(truth: Stream, robot: Robot, pattern: str) -> Array:
    return np.column_stack([truth.channel(pattern.format(wheel)) for wheel in robot.wheels])
