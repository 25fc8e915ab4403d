"""Stretches of a run that differ from the rest of it: a stuck robot, another ground, a loose sensor.

What is compared is the vibration of each IMU channel per wheel speed, in windows of steady motion.  A change
of speed moves it too, though less than the vibration itself; a stretch says where to look, not what is
there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from features.windows import WindowRule, cut_windows, wheel_speeds
from terrain.classify.changes import change_points
from terrain.errors import ConfigError, DataError
from terrain.logs.schema import signal_set_of
from terrain.records import Array, RunLog, Windows

MIN_SPEED_MPS = 0.05
MIN_VIBRATION = 1e-4


class OddStretch(NamedTuple):
    """A stretch, by how many times the scatter it differs, and the median speeds in it and in the run."""

    start_s: float
    end_s: float
    shift: float
    speed_mps: float
    run_speed_mps: float


def odd_stretches(run: RunLog) -> tuple[OddStretch, ...]:
    """Return the stretches of a run that stand out; none where it has no wheel speed or IMU."""
    try:
        windows = cut_windows([run], WindowRule(), skip_short=True).windows
    except (ConfigError, DataError):
        return ()
    if not len(windows):
        return ()
    speed_mps = np.abs(wheel_speeds(windows.values, windows.channels)).mean(axis=2).max(axis=1)
    values = _vibration(windows, speed_mps)
    if not values.shape[1]:
        return ()
    start_s = windows.start_s
    return tuple(
        OddStretch(
            float(start_s[first]),
            float(start_s[end - 1] + windows.length_s),
            shift,
            float(np.median(speed_mps[first:end])),
            float(np.median(speed_mps)),
        )
        for first, end, shift in change_points(values)
    )


def _vibration(windows: Windows, speed_mps: Array) -> Array:
    """Return the vibration of each IMU channel (n, channels) beside what its speed explains.

    It is the logarithm of the standard deviation less its straight line over the logarithm of the speed.
    """
    columns = [
        np.log(values[:, i].std(axis=1) + MIN_VIBRATION)
        for stream, values in windows.values.items()
        for i, name in enumerate(windows.channels[stream])
        if signal_set_of(stream, name) == "imu"
    ]
    if not columns:
        return np.empty((len(windows), 0))
    vibration = np.stack(columns, axis=1)
    speed = np.log(np.maximum(speed_mps, MIN_SPEED_MPS))
    basis = np.stack([np.ones_like(speed), speed - speed.mean()], axis=1)
    return np.asarray(vibration - basis @ np.linalg.lstsq(basis, vibration, rcond=None)[0])
