"""A tracking camera: pose and velocity in its own frames."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.kinematics.camera import CHANNELS, to_camera, turned
from terrain.kinematics.wheel_velocity import point_velocity
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.conditions import Faults
from terrain.simulation.sensors.motion import (
    SPEED_X,
    YAW,
    Motion,
)
from terrain.simulation.sensors.sensor import LowPass, Sensor, is_lost

JUMP_SAMPLES = 4
"""Number of samples with a wrong speed at a relocalisation of the camera; assumed."""

YAW_ERROR, VELOCITY_ERROR, RATE_ERROR, N_ERRORS = 0, 1, 4, 7
"""First columns of a camera's errors: of yaw, velocity and rate, both in the camera's axes; and their
number."""


class CameraSensor(Sensor):
    """Tracking camera in its own frames: drifting pose, noisy speed, dropouts and relocalisation jumps.

    Without noise its samples are those of :func:`terrain.kinematics.camera.odometry_stream`; lost samples are
    left out.  Of the robot's effects it applies camera_yaw.
    """

    def __init__(self, motion: Motion, robot: Robot, rng: np.random.Generator, faults: Faults) -> None:
        camera = robot.equipment.camera
        time_s, rows = motion.at(camera.rate_hz, camera.latency_s)
        n = len(rows)
        yaw_noise = camera.yaw_std_rad * rng.standard_normal(n)
        drift = camera.speed_std_mps * rng.standard_normal((n, 2)).cumsum(axis=0) / camera.rate_hz
        position_noise = camera.position_std_m * rng.standard_normal((n, 2))
        speed_noise = camera.speed_std_mps * rng.standard_normal((n, 3))  # in the camera's axes
        lost = is_lost(time_s, faults.camera_lost_s)
        chance = rng.random((n, 2)) * camera.rate_hz
        lengths = rng.exponential(camera.dropout_length_s, n)
        jumps = camera.jump_std_m * rng.standard_normal((n, 2))
        jumped = np.zeros((n, 2))
        if faults.by_chance:
            for i in np.flatnonzero(chance[:, 0] < camera.dropout_rate_hz):
                lost |= (time_s >= time_s[i]) & (time_s < time_s[i] + lengths[i])
            for i in np.flatnonzero(chance[:, 1] < camera.jump_rate_hz):
                jumped[i:] += jumps[i]
                speed_noise[i : i + JUMP_SAMPLES] += (
                    to_camera(np.append(jumps[i], 0.0)) * camera.rate_hz / JUMP_SAMPLES
                )
        rate_noise = camera.yaw_rate_std_radps * rng.standard_normal((n, 3))
        self._drift, self._position_noise, self._jumped = drift[~lost], position_noise[~lost], jumped[~lost]
        self._errors = np.column_stack([yaw_noise, speed_noise, rate_noise])[~lost]
        self._lever_m = np.array([camera.lever_x_m, camera.lever_y_m, camera.lever_z_m])
        self._mounting_rad = robot.effects.get("camera_yaw_rad", 0.0)
        self._yaw_noise_0 = yaw_noise[0] if n else 0.0
        self._low_pass = LowPass([camera.time_constant_s] * 6)
        self._first, self._seen = 0, np.empty((0, 6))
        super().__init__(motion, CHANNELS, time_s[~lost], rows[~lost])

    def _filter(self) -> int:
        motion, first = self.motion, self._first + len(self._seen)
        seen = np.empty((motion.n_rows - first, 6))
        seen[:, :3] = motion.record[first : motion.n_rows, SPEED_X : SPEED_X + 3]
        seen[:, 3:5] = motion.tilt_rad[first : motion.n_rows]
        seen[:, 5] = motion.record[first : motion.n_rows, YAW]
        self._first, self._seen = first, self._low_pass(seen)
        return motion.n_rows

    def _write(self, new: slice, rows: Array) -> None:
        record = self.motion.record
        position = record[rows, :2] + self._drift[new] + self._position_noise[new] + self._jumped[new]
        camera_samples(
            position,
            self._seen[rows - self._first],
            self._errors[new],
            self._lever_m,
            record[0, YAW] + self._yaw_noise_0,
            self.values[new],
        )
        if self._mounting_rad:
            turned(self.values[new], self.channels, self._mounting_rad)


@njit(cache=True)
def camera_samples(
    position_m: Array, motion: Array, errors: Array, lever_m: Array, yaw_0: float, values: Array
) -> None:
    """Write the camera's samples: the quaternion of yaw, pitch and roll in turn, and the vectors it rotates.

    Parameters
    ----------
    position_m : (n, 2) of the body's origin, with its error
    motion : (n, 6) speed x and y of the body's origin, yaw rate, roll, pitch and yaw
    errors : (n, N_ERRORS) of yaw, velocity and rate
    lever_m : (3,) from the body's origin to the camera
    yaw_0 : heading at power-on
    values : (n, 14) is written, in the order of :data:`terrain.kinematics.camera.CHANNELS` and in the axes of
        :func:`terrain.kinematics.camera.to_camera`
    """
    w_0, z_0 = math.cos(-yaw_0 / 2), math.sin(-yaw_0 / 2)
    for i in range(motion.shape[0]):
        turn = motion[i, 2]
        half_roll, half_pitch = motion[i, 3] / 2, motion[i, 4] / 2
        half_yaw = (motion[i, 5] + errors[i, YAW_ERROR] - yaw_0) / 2
        cr, sr = math.cos(half_roll), math.sin(half_roll)
        cp, sp = math.cos(half_pitch), math.sin(half_pitch)
        cy, sy = math.cos(half_yaw), math.sin(half_yaw)
        w = cy * cp * cr + sy * sp * sr
        x = cy * cp * sr - sy * sp * cr
        y = cy * sp * cr + sy * cp * sr
        z = sy * cp * cr - cy * sp * sr
        place = _rotated(w_0, 0.0, 0.0, z_0, position_m[i, 0], position_m[i, 1], 0.0)
        lever = _rotated(w, x, y, z, lever_m[0], lever_m[1], lever_m[2])
        ahead, left = point_velocity(motion[i, 0], motion[i, 1], turn, lever_m[0], lever_m[1])
        velocity = _rotated(w, x, y, z, ahead, left, 0.0)
        row = values[i]
        row[0] = -(place[1] + lever[1] - lever_m[1])
        row[1] = lever[2] - lever_m[2]
        row[2] = -(place[0] + lever[0] - lever_m[0])
        row[3], row[4], row[5], row[6] = -y, z, -x, w
        row[7] = errors[i, VELOCITY_ERROR] - velocity[1]
        row[8] = errors[i, VELOCITY_ERROR + 1] + velocity[2]
        row[9] = errors[i, VELOCITY_ERROR + 2] - velocity[0]
        row[10], row[11] = errors[i, RATE_ERROR], errors[i, RATE_ERROR + 1] + turn
        row[12] = errors[i, RATE_ERROR + 2]
        row[13] = 1.0


@njit(cache=True)
def _rotated(
    w: float, x: float, y: float, z: float, a: float, b: float, c: float
) -> tuple[float, float, float]:
    """Return a vector (a, b, c) rotated by a quaternion."""
    return (
        (x * x - y * y - z * z + w * w) * a + 2 * (x * y - z * w) * b + 2 * (x * z + y * w) * c,
        2 * (x * y + z * w) * a + (-x * x + y * y - z * z + w * w) * b + 2 * (y * z - x * w) * c,
        2 * (x * z - y * w) * a + 2 * (y * z + x * w) * b + (-x * x - y * y + z * z + w * w) * c,
    )
