"""Wheels of logs: their circumferential speeds by the rates of their motors, and the true slip of simulated ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.wheels import rolled_twist, rolling_matrix
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS, TWIST
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot
from terrain.slip import traction_slip


def sensor_channels(robot: Robot) -> Mapping[str, tuple[str, ...]]:
    """Return the channels of each stream that the sensors of a robot give, as it is simulated with a receiver.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> channels = sensor_channels(load_robot("husky"))
    >>> list(channels), channels["wheels"]
    (['wheels', 'imu', 'odometry', 'gnss'], ('speed_left_mps', 'speed_right_mps', 'current_left_a', 'current_right_a'))
    """
    currents = tuple(f"current_{wheel}_a" for wheel in robot.logged_wheels)
    streams = {"wheels": (*robot.rate_channels, *currents)}
    streams |= {"steering": robot.steer_channels} if robot.steered else {}
    streams["imu"] = IMU_CHANNELS
    if robot.describes("camera"):
        streams["odometry"] = CAMERA_CHANNELS if robot.drive == "swerve" else TWIST[:2]
    return streams if robot.drive == "swerve" else streams | {"gnss": GNSS_CHANNELS}


def with_wheel_speeds(run: RunLog, robot: Robot) -> RunLog:
    """Return a run whose stream ``wheels`` has wheel speeds (``speed_1_mps``) beside its motor rates.

    Wheel speeds that are there already are made anew; a run without motor rates comes back as it is.

    Rates of a robot whose description has no motors are those of its wheels.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> rates = Stream(np.arange(2.0), np.full((2, 3), 50.0), [f"motor_{i}_radps" for i in (1, 2, 3)])
    >>> run = with_wheel_speeds(RunLog("a", "agrimaro", {"wheels": rates}), load_robot("agrimaro"))
    >>> run.streams["wheels"].channel("speed_1_mps")
    array([1., 1.])
    """
    wheels = run.streams.get("wheels")
    found = None if wheels is None else wheel_speeds_from(wheels.channels, robot)
    if wheels is None or found is None:
        return run
    channels, compute = found
    speeds = Stream(wheels.time_s, compute(wheels.values), channels)
    return replace(run, streams=dict(run.streams) | {"wheels": speeds})


def with_desired_twist(run: RunLog, robot: Robot) -> RunLog:
    """Return a run whose stream ``commands`` has a twist: that of its commanded wheel rates, rolling without slip.

    A run that has one, or without commanded rates of all wheels, comes back as it is, as does one of a robot that
    steers its wheels.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> rates = Stream(np.arange(2.0), np.full((2, 2), 10.0), ["wheel_left_radps", "wheel_right_radps"])
    >>> run = with_desired_twist(RunLog("a", "husky", {"commands": rates}), load_robot("husky"))
    >>> run.streams["commands"].columns(TWIST)[0].round(3)
    array([1.65, 0.  , 0.  ])
    """
    commands, rates = run.streams.get("commands"), [f"wheel_{wheel}_radps" for wheel in robot.wheels]
    if commands is None or robot.steered_wheels or not set(rates) <= set(commands.channels):
        return run
    if set(TWIST) & set(commands.channels):
        return run
    speeds = robot.wheel_radius_m * commands.columns(rates)
    twist = rolled_twist(robot, speeds, np.zeros_like(speeds))
    desired = Stream(commands.time_s, np.hstack([commands.values, twist]), (*commands.channels, *TWIST))
    return replace(run, streams=dict(run.streams) | {"commands": desired})


def wheel_speeds_from(
    channels: Sequence[str], robot: Robot
) -> tuple[tuple[str, ...], Callable[[Array], Array]] | None:
    """Return the channels of wheels with their speeds, and what computes these values (n, c) of those measured.

    Speeds that are measured are left out, and come from the rates; None where there are no motor rates.
    """
    motors = [f"motor_{wheel}_radps" for wheel in robot.wheels]
    if not set(motors) <= set(channels):
        return None
    speeds = tuple(f"speed_{wheel}_mps" for wheel in robot.wheels)
    at = [channels.index(motor) for motor in motors]
    others = [i for i, channel in enumerate(channels) if channel not in speeds]
    ratio, radius_m = robot.reduction_ratio, robot.wheel_radius_m

    def with_speeds(values: Array) -> Array:
        return np.hstack([values[:, others], values[:, at] / ratio * radius_m])

    return (*(channels[i] for i in others), *speeds), with_speeds


def speed_columns(channels: Sequence[str], robot: Robot | None) -> tuple[list[int], float]:
    """Return the columns of wheels that tell how fast they turn, and what makes them speeds in m/s."""
    columns = [i for i, name in enumerate(channels) if name.startswith("speed_")]
    if columns or robot is None:
        return columns, 1.0
    motors = [i for i, name in enumerate(channels) if name.startswith("motor_")]
    return motors, robot.wheel_radius_m / robot.reduction_ratio


def wheel_and_ground_speed(truth: Stream, robot: Robot) -> tuple[Array, Array]:
    """Return the true wheel speed, by the nominal radius, and speed over ground along each wheel, (n, wheels)."""
    directions = truth.columns(f"steer_{wheel}_rad" for wheel in robot.wheels) + robot.wheel_directions_rad
    rolling = rolling_matrix(robot.wheel_positions_m, directions, robot.roller_angles_rad)
    along = np.einsum("nij,nj->ni", rolling, truth.columns(TWIST))
    return truth.columns(f"wheel_{wheel}_radps" for wheel in robot.wheels) * robot.wheel_radius_m, along


def true_slip(truth: Stream, wheels: Sequence[str]) -> Array:
    """Return the slip ratio (n, wheels) that a simulation recorded, positive in traction.

    The recorded one is signed along the wheel's own x axis; here its sign is that of traction in both
    directions (:func:`terrain.slip.traction_slip`).  It is that of the wheels' true radii, up to 2 where a
    wheel turns against the motion, and NaN where wheel and robot are at rest; one that is never defined has no channel.
    """
    recorded = np.full((len(truth), len(wheels)), np.nan)
    for i, wheel in enumerate(wheels):
        if f"slip_{wheel}_ratio" in truth.channels:
            recorded[:, i] = truth.channel(f"slip_{wheel}_ratio")
    return traction_slip(recorded, truth.columns(f"wheel_{w}_radps" for w in wheels))
