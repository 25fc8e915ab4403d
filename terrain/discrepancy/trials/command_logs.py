"""Logs of the DRIVE layout from those of the planar simulation: 20 Hz, a lidar, no currents and no tilt.

DRIVE: Baril et al., ICRA 2024; see :mod:`terrain.logs.drive`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from terrain.discrepancy.trials.limits import Sensing
from terrain.effects import GYRO, HEADING, SPEED_X, SPEED_Y
from terrain.logs.lidar_twist import CHANNELS as TWIST_CHANNELS
from terrain.records import Array, RunLog, Stream
from terrain.simulation.planar.noise import Scatter

RATE_HZ = 20.0
"""Of all streams."""

CUTOFF_HZ = 0.4 * RATE_HZ
"""Above which such a log holds nothing of the motion."""


def sensing_of(scatter: Scatter | None = None) -> Sensing:
    """Return what such logs hold, of runs with a scatter."""
    return Sensing((GYRO, SPEED_X, SPEED_Y, HEADING), CUTOFF_HZ, scatter, tilt=False)


def with_lidar(run: RunLog) -> RunLog:
    """Return a skid-steer robot's run whose speeds over ground and heading rate are those of one lidar."""
    seen, heading = run.streams["odometry"], run.streams["lidar"]
    values = np.column_stack([seen.values, heading.values])
    streams = {name: stream for name, stream in run.streams.items() if name != "odometry"}
    return replace(run, streams={**streams, "lidar": Stream(seen.time_s, values, TWIST_CHANNELS)})


def as_command_log(run: RunLog) -> RunLog:
    """Return a skid-steer robot's run as the DRIVE layout holds it.

    Parameters
    ----------
    run : of the planar simulation, with a heading
    """
    full = with_lidar(run).streams
    wheels = tuple(name for name in full["wheels"].channels if name.startswith("speed_"))
    imu = ("gyro_z_radps", *(f"accel_{axis}_mps2" for axis in "xyz"))
    kept = {"wheels": wheels, "imu": imu, "lidar": TWIST_CHANNELS}
    end_s = min(full[name].time_s[-1] for name in kept)
    time_s = np.arange(1, int(end_s * RATE_HZ)) / RATE_HZ
    streams = {}
    for name, channels in kept.items():
        columns = [_averaged(full[name].time_s, full[name].channel(c), time_s) for c in channels]
        streams[name] = Stream(time_s - time_s[0], np.column_stack(columns), channels)
    return replace(run, streams=streams)


def _averaged(stamps_s: Array, values: Array, time_s: Array) -> Array:
    """Return the mean of a signal over a period around each instant, so that nothing quick is aliased."""
    steps = np.diff(stamps_s) * (values[1:] + values[:-1]) / 2.0
    integral = np.concatenate([[0.0], np.cumsum(steps)])
    half_s = 0.5 / RATE_HZ
    ends = [np.interp(time_s + side * half_s, stamps_s, integral) for side in (1.0, -1.0)]
    return np.asarray((ends[0] - ends[1]) * RATE_HZ)
