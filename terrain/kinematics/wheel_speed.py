"""Wheel circumferential speeds, from the rates that the motor driver reports."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from terrain.records import Array, RunLog, Stream
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
    found = None if wheels is None else wheel_speeds_from(wheels.channels, robot)
    if wheels is None or found is None:
        return run
    channels, compute = found
    return replace(
        run, streams=dict(run.streams) | {"wheels": Stream(wheels.time_s, compute(wheels.values), channels)}
    )


def wheel_speeds_from(
    channels: Sequence[str], robot: Robot
) -> tuple[tuple[str, ...], Callable[[Array], Array]] | None:
    """Return the channels of wheels with their speeds, and what computes these values (n, c) of those measured.

    Parameters
    ----------
    channels : that are measured
    robot : gives reduction ratio and nominal wheel radius

    Returns
    -------
    None where there are no motor rates.  Speeds that are measured are left out, and come from the rates.
    """
    motors = [f"motor_{wheel}_radps" for wheel in robot.wheels]
    if not motors or not set(motors) <= set(channels):
        return None
    speeds = tuple(f"speed_{wheel}_mps" for wheel in robot.wheels)
    at = [channels.index(motor) for motor in motors]
    kept = [i for i, channel in enumerate(channels) if channel not in speeds]
    ratio, radius_m = robot.motors.reduction_ratio, robot.wheel_radius_m

    def with_speeds(values: Array) -> Array:
        return np.hstack([values[:, kept], values[:, at] / ratio * radius_m])

    return (*(channels[i] for i in kept), *speeds), with_speeds


def speed_columns(channels: Sequence[str], robot: Robot | None) -> tuple[list[int], float]:
    """Return the columns of wheels that tell how fast they turn, and what makes them speeds in m/s."""
    columns = [i for i, name in enumerate(channels) if name.startswith("speed_")]
    if columns or robot is None or not robot.describes("motors"):
        return columns, 1.0
    motors = [i for i, name in enumerate(channels) if name.startswith("motor_")]
    return motors, robot.wheel_radius_m / robot.motors.reduction_ratio
