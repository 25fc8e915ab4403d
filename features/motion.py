"""How a robot moves in a window: speed, yaw rate, and how far its two sides differ.

Only what is measured of the driving counts here, nothing that the terrain shakes or loads.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from features.cross_channel import left_right
from features.windows import wheel_speeds
from terrain.classify.coverage import Motion
from terrain.logs.schema import signal_set_of
from terrain.records import Array, Windows

__all__ = ["NO_MOTION", "Motion", "fastest_wheel", "wheel_stream", "window_motion"]

NO_MOTION = "the windows hold no wheel speed, so that how the robot moved is not known"
"""Why there is no :class:`Motion`."""

MIN_SIDE_SPEED_MPS = 1e-6  #: Sides that are slower together stand: their ratio is not defined


def window_motion(windows: Windows) -> Motion | None:
    """Return how the robot moved in each window; None where no wheel speed is measured.

    Examples
    --------
    >>> wheels = np.array([[[0.5, 0.5], [0.5, 0.5]], [[-0.2, -0.2], [0.2, 0.2]]])
    >>> channels = {"wheels": ("speed_left_mps", "speed_right_mps")}
    >>> windows = Windows({"wheels": wheels}, channels, {"wheels": 1.0}, 2.0, np.zeros(2), *[np.zeros(2)] * 2)
    >>> motion = window_motion(windows)
    >>> motion.speed_mps.tolist(), motion.turn_ratio.tolist(), motion.yaw_rate_radps.tolist()
    ([0.5, 0.2], [0.0, 1.0], [nan, nan])
    """
    stream = wheel_stream(windows.channels)
    if stream is None:
        return None
    speed = wheel_speeds(windows.values, windows.channels)
    unknown = np.full(len(windows), np.nan)
    return Motion(
        np.abs(speed).mean(axis=2).max(axis=1),
        _yaw_rate(windows, unknown),
        _turn_ratio(windows.values[stream], windows.channels[stream], unknown),
    )


def fastest_wheel(windows: Windows) -> Array:
    """Return the speed (n, samples) in m/s of the faster wheel at each sample; NaN (n, 1) where none is measured."""
    if wheel_stream(windows.channels) is None:
        return np.full((len(windows), 1), np.nan)
    return np.asarray(np.abs(wheel_speeds(windows.values, windows.channels)).max(axis=1))


def wheel_stream(channels: Mapping[str, tuple[str, ...]]) -> str | None:
    """Return the stream that measures wheel speeds; None where none does, so that there is no motion.

    Examples
    --------
    >>> wheel_stream({"imu": ("gyro_z_radps",), "wheels": ("speed_left_mps",)})
    'wheels'
    """
    for stream, names in channels.items():
        if any(signal_set_of(stream, name) == "wheels" for name in names):
            return stream
    return None


def _yaw_rate(windows: Windows, unknown: Array) -> Array:
    for stream, names in windows.channels.items():
        if "gyro_z_radps" in names:
            mean = windows.values[stream][:, names.index("gyro_z_radps")].mean(axis=1)
            return np.asarray(np.abs(mean))
    return unknown


def _turn_ratio(values: Array, channels: tuple[str, ...], unknown: Array) -> Array:
    sides = left_right(channels, "speed")
    if sides is None:
        return unknown
    left, right = (values[:, side].mean(axis=1) for side in sides)
    together = np.abs(left) + np.abs(right)
    ratio = unknown.copy()
    np.divide(np.abs(right - left), together, out=ratio, where=together > MIN_SIDE_SPEED_MPS)
    return ratio
