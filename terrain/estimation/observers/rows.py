"""Names of what observers take at a tick."""

from __future__ import annotations

ROWS: tuple[str, ...] = (
    *("speed_left_mps", "speed_right_mps", "speed_rear_mps", "steer_front_rad"),
    *("position_x_m", "position_y_m", "yaw_rad"),
    *("yaw_rate_radps", "roll_rad", "pitch_rad", "accel_y_mps2"),
)
"""Circumferential speeds of the tracks, and of a car's rear axle; its steering angle; position and heading of
the body's origin in a fixed right-handed frame, from poses, or satellites and a compass, brought to the time
of the tick; yaw rate of the gyro; roll (left side up positive) and pitch (nose up negative); specific force
to the left."""
