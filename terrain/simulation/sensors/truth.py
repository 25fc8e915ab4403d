"""The stream of true quantities that goes with a simulated run."""

from __future__ import annotations

import numpy as np

from terrain.records import Array, Stream
from terrain.simulation.sensors.motion import (
    Motion,
)


def truth_stream(
    motion: Motion, gyro_bias_radps: Array, gyro_time_s: Array, rate_hz: float = 100.0
) -> Stream:
    """Return what happened, at a rate that files can bear; a slip that no instant has is no channel."""
    time_s, rows = motion.at(rate_hz)
    columns = {
        **{name: motion.body(name) for name in ("position_x_m", "position_y_m", "yaw_rad")},
        "roll_rad": motion.tilt_rad[:, 0],
        "pitch_rad": motion.tilt_rad[:, 1],
        **{
            name: motion.body(name)
            for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2")
        },
    }
    for recorded in (
        "wheel_radps",
        "steer_rad",
        "slip_ratio",
        "slip_angle_rad",
        "normal_n",
        "traction_n",
        "torque_nm",
        "sinkage_m",
        "side_n",
    ):
        quantity, _, unit = recorded.rpartition("_")
        for i in range(3):
            columns[f"{quantity}_{i + 1}_{unit}"] = motion.wheel(recorded)[:, i]
    kept = {name: column[rows] for name, column in columns.items() if np.isfinite(column[rows]).any()}
    kept["gyro_bias_z_radps"] = np.interp(time_s, gyro_time_s, gyro_bias_radps)
    return Stream(time_s, np.column_stack(list(kept.values())), tuple(kept))
