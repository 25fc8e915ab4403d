"""Wheel circumferential speeds, from the rates that the motor driver reports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from terrain.records import RunLog, Stream
from terrain.robots import Robot


def with_wheel_speeds(run: RunLog, robot: Robot) -> RunLog:
    """Return a run whose stream ``wheels`` has wheel speeds (``speed_1_mps``) beside its motor rates.

    Wheel speeds that are there already are made anew; a run without motor rates comes back as it is.

    Parameters
    ----------
    run : log
    robot : gives reduction ratio and nominal wheel radius

    Raises
    ------
    ConfigError
        if the run has motor rates and the robot's description no motors.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> rates = Stream(np.arange(2.0), np.full((2, 3), 50.0), [f"motor_{i}_radps" for i in (1, 2, 3)])
    >>> run = with_wheel_speeds(RunLog("a", "agrimaro", {"wheels": rates}), load_robot("agrimaro"))
    >>> run.streams["wheels"].channel("speed_1_mps")
    array([1., 1.])
    """
    wheels = run.streams.get("wheels")
    motors = [f"motor_{wheel}_radps" for wheel in robot.wheels]
    wheel_speeds = tuple(f"speed_{wheel}_mps" for wheel in robot.wheels)
    if wheels is None or not set(motors) <= set(wheels.channels):
        return run
    rate = np.column_stack([wheels.channel(channel) for channel in motors])
    wheel_speed = rate / robot.motors.reduction_ratio * robot.wheel_radius_m
    streams = dict(run.streams)
    kept = [i for i, channel in enumerate(wheels.channels) if channel not in wheel_speeds]
    streams["wheels"] = Stream(
        wheels.time_s,
        np.hstack([wheels.values[:, kept], wheel_speed]),
        (*(wheels.channels[i] for i in kept), *wheel_speeds),
    )
    return replace(run, streams=streams)
