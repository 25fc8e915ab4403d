"""The stream of true quantities that goes with a simulated run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terrain.records import Array, Stream
from terrain.simulation.sensors.motion import Motion

TRUTH_HZ = 100.0
"""Rate of the stream: a compromise with the size of files."""

BODY_TRUTH = (
    *("position_x_m", "position_y_m", "yaw_rad", "roll_rad", "pitch_rad"),
    *("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2"),
)
"""Channels of the body."""

_WHEEL_TRUTH = (
    *("wheel_radps", "steer_rad", "slip_ratio", "slip_angle_rad", "normal_n", "traction_n", "torque_nm"),
    *("sinkage_m", "side_n"),
)

GYRO_BIAS = "gyro_bias_z_radps"
"""Channel of the true bias of the yaw gyro."""


def wheel_channels(quantity: str, wheels: Sequence[str]) -> tuple[str, ...]:
    """Return the channels of one quantity of all wheels.

    Examples
    --------
    >>> wheel_channels("slip_ratio", ("left", "right"))
    ('slip_left_ratio', 'slip_right_ratio')
    """
    name, _, unit = quantity.rpartition("_")
    return tuple(f"{name}_{wheel}_{unit}" for wheel in wheels)


def truth_stream(motion: Motion, gyro_bias_radps: Array, gyro_time_s: Array) -> Stream:
    """Return the recorded motion at :data:`TRUTH_HZ`; a slip that is never defined has no channel."""
    time_s, rows = motion.at(TRUTH_HZ)
    tilt = dict(zip(("roll_rad", "pitch_rad"), motion.tilt_rad.T, strict=True))
    columns = {name: tilt[name] if name in tilt else motion.body(name) for name in BODY_TRUTH}
    for quantity in _WHEEL_TRUTH:
        columns |= zip(wheel_channels(quantity, "123"), motion.wheel(quantity).T, strict=True)
    kept = {name: column[rows] for name, column in columns.items() if np.isfinite(column[rows]).any()}
    kept[GYRO_BIAS] = np.interp(time_s, gyro_time_s, gyro_bias_radps)
    return Stream(time_s, np.column_stack(list(kept.values())), tuple(kept))
