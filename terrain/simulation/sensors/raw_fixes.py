"""Raw satellite fixes without a filter or a delay, and the compass beside them."""

from __future__ import annotations

import numpy as np

from terrain.angles import wrapped
from terrain.logs.schema import GNSS_CHANNELS
from terrain.records import Array, RunLog, Stream

RAW_HZ, RAW_STD_M, COMPASS_STD_RAD = 10.0, 0.02, 0.0087
"""Rate and noise of raw fixes (Deremetz et al., ICRA 2017, section VI), and of a compass (half a degree,
assumed)."""

SPEED_FACTOR_PS = 1.5
"""Noise of a velocity over that of the position, as the Doppler speed of the other receiver."""


def raw_fixes(
    time_s: Array, pose: Array, velocity_mps: Array, std: tuple[float, float], rng: np.random.Generator
) -> dict[str, Stream]:
    """Return the streams ``gnss`` and ``compass``.

    Parameters
    ----------
    time_s : (n,) stamps
    pose : (n, 3) position of the body's origin and heading
    velocity_mps : (n, 2) of it in the axes of the body
    std : of a position in m, one axis, and of a heading in rad
    rng : source of the noise
    """
    n, (position_m, heading_rad) = len(time_s), std
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    ahead, left = velocity_mps.T
    over_ground = np.column_stack([ahead * cos - left * sin, ahead * sin + left * cos])
    fixes = np.column_stack(
        [
            pose[:, :2] + position_m * rng.standard_normal((n, 2)),
            over_ground + SPEED_FACTOR_PS * position_m * rng.standard_normal((n, 2)),
            np.full(n, position_m),
            np.ones(n),
        ]
    )
    heading = wrapped(pose[:, 2] + heading_rad * rng.standard_normal(n))
    return {
        "gnss": Stream(time_s, fixes, GNSS_CHANNELS),
        "compass": Stream(time_s, heading[:, None], ("yaw_rad",)),
    }


def with_raw_fixes(run: RunLog, rng: np.random.Generator) -> dict[str, Stream]:
    """Return the streams of a simulated run with raw fixes of its truth.

    Parameters
    ----------
    run : with the stream truth
    rng : source of the noise
    """
    truth = run.streams["truth"]
    at_s = np.arange(truth.time_s[0], truth.time_s[-1] + 1e-9, 1.0 / RAW_HZ)
    rows = np.searchsorted(truth.time_s, at_s - 1e-9)
    columns = ("position_x_m", "position_y_m", "yaw_rad", "speed_x_mps", "speed_y_mps")
    pose = np.column_stack([truth.channel(name)[rows] for name in columns])
    std = RAW_STD_M, COMPASS_STD_RAD
    return {**run.streams, **raw_fixes(at_s, pose[:, :3], pose[:, 3:], std, rng)}
