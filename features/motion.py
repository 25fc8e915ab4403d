"""How a robot moves in a window, and stretches of a run that differ from the rest of it.

Only what is measured of the driving counts for motion, nothing that the terrain shakes or loads.  A stretch, of a stuck
robot, another ground or a loose sensor, is sought in the vibration of each IMU channel per wheel speed, in windows of
steady motion.  A change of speed moves it too, though less than the vibration itself; a stretch says where to look, not
what is there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from features.windows import WindowRule, cut_windows, left_right, wheel_speeds, wheel_stream
from terrain.classify.changes import change_points
from terrain.classify.limits import Motion
from terrain.errors import ConfigError, DataError
from terrain.logs.schema import signal_set_of
from terrain.records import Array, RunLog, Windows

#: Why there is no :class:`~terrain.classify.limits.Motion`.
NO_MOTION = "the windows hold no wheel speed, so that how the robot moved is not known"
MIN_SIDE_SPEED_MPS = 1e-6  #: Sides that are slower together stand: their ratio is not defined

MIN_SPEED_MPS, MIN_VIBRATION = 0.05, 1e-4  #: Speed and vibration are not taken for less under a logarithm.


def window_motion(windows: Windows) -> Motion | None:
    """Return how the robot moved in each window; None where no wheel speed is measured.

    Examples
    --------
    >>> wheels = np.array([[[0.5, 0.5], [0.5, 0.5]], [[-0.2, -0.2], [0.2, 0.2]]])
    >>> channels = {"wheels": ("speed_left_mps", "speed_right_mps")}
    >>> windows = Windows({"wheels": wheels}, channels, {"wheels": 1.0}, 2.0, np.zeros(2), *[np.zeros(2)] * 2)
    >>> [each.tolist() for each in window_motion(windows)]
    [[0.5, 0.2], [nan, nan], [0.0, 1.0]]
    """
    stream = wheel_stream(windows.channels)
    if stream is None:
        return None
    speed_mps = np.abs(wheel_speeds(windows.values, windows.channels)).mean(axis=2).max(axis=1)
    yaw_rate_radps, turn_ratio = np.full((2, len(windows)), np.nan)
    for name, names in windows.channels.items():
        if "gyro_z_radps" in names:
            yaw_rate_radps = np.abs(windows.values[name][:, names.index("gyro_z_radps")].mean(axis=1))
            break
    sides = left_right(windows.channels[stream], "speed")
    if sides is not None:
        left, right = (windows.values[stream][:, side].mean(axis=1) for side in sides)
        together = np.abs(left) + np.abs(right)
        np.divide(np.abs(right - left), together, out=turn_ratio, where=together > MIN_SIDE_SPEED_MPS)
    return Motion(speed_mps, yaw_rate_radps, turn_ratio)


def fastest_wheel(windows: Windows) -> Array:
    """Return the speed (n, samples) in m/s of the faster wheel at each sample; NaN (n, 1) where none is measured."""
    if wheel_stream(windows.channels) is None:
        return np.full((len(windows), 1), np.nan)
    return np.asarray(np.abs(wheel_speeds(windows.values, windows.channels)).max(axis=1))


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
    columns = [
        np.log(values[:, i].std(axis=1) + MIN_VIBRATION)
        for stream, values in windows.values.items()
        for i, name in enumerate(windows.channels[stream])
        if signal_set_of(stream, name) == "imu"
    ]
    if not len(windows) or not columns:
        return ()
    speed_mps = np.abs(wheel_speeds(windows.values, windows.channels)).mean(axis=2).max(axis=1)
    vibration, speed = np.stack(columns, axis=1), np.log(np.maximum(speed_mps, MIN_SPEED_MPS))
    basis = np.stack([np.ones_like(speed), speed - speed.mean()], axis=1)
    beside = (
        vibration - basis @ np.linalg.lstsq(basis, vibration, rcond=None)[0]
    )  # what speed does not explain
    start_s = windows.start_s
    return tuple(
        OddStretch(
            float(start_s[first]),
            float(start_s[end - 1] + windows.length_s),
            shift,
            float(np.median(speed_mps[first:end])),
            float(np.median(speed_mps)),
        )
        for first, end, shift in change_points(beside)
    )
