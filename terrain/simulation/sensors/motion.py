"""What a plant records for its sensors, step by step."""

from __future__ import annotations

import math

import numpy as np

from terrain.records import Array

STEP_S = 0.001
"""Step of the record and of the dynamic plant, whose fastest mode is that of the contact, near 170 rad/s: a
sixth of a radian a step."""

BODY_RECORD = (
    "position_x_m",
    "position_y_m",
    "yaw_rad",
    "speed_x_mps",
    "speed_y_mps",
    "yaw_rate_radps",
    "accel_x_mps2",
    "accel_y_mps2",
    "grade_x_ratio",
    "grade_y_ratio",
    "ride_z_mps2",
    "ride_roll_rad",
    "ride_pitch_rad",
    "ride_roll_radps2",
    "ride_pitch_radps2",
    "path_m",
    "leg_rad",
)

WHEEL_RECORD = (
    "wheel_radps",
    "steer_rad",
    "slip_ratio",
    "slip_angle_rad",
    "normal_n",
    "traction_n",
    "torque_nm",
    "sinkage_m",
    "reported_radps",
    "patch_ratio",
    "side_n",
)
"""What is recorded each step, at the body's origin and at each wheel.  Steering angles are true headings in
the body; traction and side force are those of the contact, along the wheel and to its left, so that it takes
up ``traction (w r - v_along) - side v_across``."""

N_BODY_RECORD = len(BODY_RECORD)

N_RECORD = N_BODY_RECORD + 3 * len(WHEEL_RECORD)

YAW, SPEED_X, YAW_RATE, ACCEL_X, ACCEL_Y, RIDE_Z, RIDE_ROLL, RIDE_PITCH = (
    BODY_RECORD.index(name)
    for name in (
        *("yaw_rad", "speed_x_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2"),
        *("ride_z_mps2", "ride_roll_radps2", "ride_pitch_radps2"),
    )
)
"""Columns of the body's record that kernels read."""


class Motion:
    """What happened in one run, every :data:`STEP_S`, as far as it has happened.

    Parameters
    ----------
    record : (n, N_RECORD) for :func:`terrain.simulation.dynamic.step.advance` to write
    n_rows : rows that are written; all by default

    Attributes
    ----------
    tilt_rad : (n, 2) roll and pitch of the body: the slope and the ride over it
    """

    def __init__(self, record: Array, n_rows: int | None = None) -> None:
        self.record = record
        self.tilt_rad = np.empty((len(record), 2))
        self.n_rows = 0
        self.grow(len(record) if n_rows is None else n_rows)

    def grow(self, n_rows: int) -> None:
        """Take note that so many rows are written."""
        new = slice(self.n_rows, n_rows)
        grade_x, grade_y = self.body("grade_x_ratio")[new], self.body("grade_y_ratio")[new]
        # up is (grade_x, grade_y, 1) = (-sin pitch, sin roll cos pitch, cos roll cos pitch)
        self.tilt_rad[new, 0] = np.arctan(grade_y) + self.body("ride_roll_rad")[new]
        self.tilt_rad[new, 1] = (
            -np.arctan(grade_x / np.hypot(1.0, grade_y)) + self.body("ride_pitch_rad")[new]
        )
        self.n_rows = n_rows

    @property
    def time_s(self) -> Array:
        """Time (n,) of each row."""
        return np.arange(len(self.record)) * STEP_S

    def body(self, name: str) -> Array:
        """One quantity (n,) of the body."""
        return self.record[:, BODY_RECORD.index(name)]

    def wheel(self, name: str) -> Array:
        """One quantity (n, 3) of the wheels."""
        return self.record[:, N_BODY_RECORD + WHEEL_RECORD.index(name) :: len(WHEEL_RECORD)][:, :3]

    def at(self, rate_hz: float, latency_s: float = 0.0) -> tuple[Array, Array]:
        """Stamps (k,) of a sensor of that rate, and the rows (k,) it measures."""
        time_s = np.arange(math.floor(len(self.record) * STEP_S * rate_hz + 1e-6)) / rate_hz
        return time_s, np.maximum(np.round((time_s - latency_s) / STEP_S).astype(int), 0)
