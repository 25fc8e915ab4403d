"""A simulated IMU on a bench, held still in six positions in turn (Danzi, AgriMaRo thesis, 3.3.3)."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.records import RunLog
from terrain.robots import Robot
from terrain.simulation.sensors import imu_samples

TURN_S = 1.5
"""Time by hand from one position to the next; assumed."""

CROOKED_RAD = 0.03
"""Standard deviation of how far a position is from its axis; assumed."""

POSITIONS = (
    # turns about body axes that bring one axis up after the other: z, -z, x, -x, y, -y
    (0.0, 0.0),
    (math.pi, 0.0),
    (0.0, -math.pi / 2),
    (0.0, math.pi / 2),
    (math.pi / 2, 0.0),
    (-math.pi / 2, 0.0),
)
"""Roll and pitch of the six positions."""


def six_positions_log(
    robot: Robot, seed: int | np.random.SeedSequence, *, hold_s: float = 5.0, run_id: str = "bench"
) -> RunLog:
    """Return the log of an IMU alone, held still in six positions and turned by hand between them.

    Parameters
    ----------
    robot : with all sections
    seed : of everything that is drawn; the same seed gives the same log
    hold_s : time in each position
    run_id : name of the run

    Returns
    -------
    RunLog
        the stream imu with the channels of a driven run, without labels.

    Raises
    ------
    ConfigError
        if ``hold_s`` is not above zero, or a section of the robot's description is missing.

    Notes
    -----
    As in a driven run, each power-on has biases of its own about those of the description.  At rest the
    specific force is ``g`` times the vertical in body axes; what the hand accelerates is left out.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> run = six_positions_log(load_robot("agrimaro"), seed=0, hold_s=2.0)
    >>> sorted(run.streams), len(run.streams["imu"])
    (['imu'], 1950)
    """
    if not 0 < hold_s < math.inf:
        raise ConfigError(f"hold_s is {hold_s!r}, a time above zero is required")
    sensors = robot.equipment.sensors
    rng = np.random.default_rng(seed)
    crooked = CROOKED_RAD * rng.standard_normal((len(POSITIONS), 2))
    heading = rng.uniform(-math.pi, math.pi, len(POSITIONS))
    held = Rotation.from_euler("ZYX", np.column_stack([heading, (np.array(POSITIONS) + crooked)[:, ::-1]]))
    begin_s = np.arange(len(POSITIONS)) * (hold_s + TURN_S)
    knots_s = np.column_stack([begin_s, begin_s + hold_s]).ravel()
    attitude = Slerp(knots_s, held[np.repeat(np.arange(len(POSITIONS)), 2)])
    period_s = 1 / sensors.imu_rate_hz
    n = round(knots_s[-1] / period_s)
    time_s = np.arange(n) * period_s
    now, soon = attitude(time_s), attitude(np.minimum(time_s + period_s, knots_s[-1]))
    force = now.inv().apply([0.0, 0.0, GRAVITY_MPS2])
    rate = (now.inv() * soon).as_rotvec() / period_s
    turned = now.as_matrix()
    roll, pitch = (
        np.arctan2(turned[:, 2, 1], turned[:, 2, 2]),
        -np.arcsin(np.clip(turned[:, 2, 0], -1.0, 1.0)),
    )
    yaw = np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    tilt = np.column_stack([roll, pitch])
    imu = imu_samples(sensors, time_s, force, rate, tilt, np.unwrap(yaw) - yaw[0], rng)
    return RunLog(run_id, robot.name, {"imu": imu}, source="simulated, six positions on a bench")
