"""Output of sensors without noise along a motion: bias, scale, mounting, latency and their logger's clock."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.effects import INDEX
from terrain.kinematics.wheel_velocity import point_velocity
from terrain.records import Array
from terrain.simulation.planar.model import AMPS, AX, TURNING_AMPS, VX, VY, Planar, W
from terrain.simulation.planar.signals import delayed

_GYRO_BIAS = INDEX["gyro_bias_radps"]
_GYRO_SCALE = INDEX["gyro_scale_ratio"]
_ACCEL_BIAS = INDEX["accel_bias_mps2"]
_LATENCY = INDEX["camera_latency_s"]
_IMU_LATENCY = INDEX["imu_latency_s"]
_CAMERA_YAW = INDEX["camera_yaw_rad"]
_CAMERA_SCALE = INDEX["camera_scale_ratio"]
_LEVER_X = INDEX["lever_x_m"]
_LEVER_Y = INDEX["lever_y_m"]
_CLOCK_OFFSET = INDEX["clock_offset_s"]
_CLOCK_RATE = INDEX["clock_rate_ratio"]
_MOTOR = INDEX["motor_constant_ratio"]
_DRIFT = INDEX["motor_drift_ratio"]
_CURRENT_OFFSET = INDEX["current_offset_a"]


@njit(cache=True)
def sense(planar: Planar, p: Array, dt: float, truth: Array) -> Array:
    """Return the channels (n, len(CHANNELS)) that sensors without noise measure.

    Parameters
    ----------
    planar, p, dt : as :func:`move` takes them
    truth : (n, len(TRUTH)) of :func:`move`
    """
    n = truth.shape[0]
    out = np.empty((n, 7))
    lever_x, lever_y = planar.lever_x_m + p[_LEVER_X], planar.lever_y_m + p[_LEVER_Y]
    scale = 1.0 + p[_CAMERA_SCALE] if planar.omni else 1.0
    cos, sin = scale * math.cos(p[_CAMERA_YAW]), scale * math.sin(p[_CAMERA_YAW])
    for k in range(n):
        w = truth[k, W]
        v_x, v_y = point_velocity(truth[k, VX], truth[k, VY], w, lever_x, lever_y)
        out[k, 0] = (1.0 + p[_GYRO_SCALE]) * w + p[_GYRO_BIAS]
        out[k, 1] = cos * v_x - sin * v_y
        out[k, 2] = sin * v_x + cos * v_y
        out[k, 3] = truth[k, AX] + p[_ACCEL_BIAS]
        warm = (1.0 + p[_MOTOR]) * (1.0 + p[_DRIFT] * k * dt / 60.0)
        out[k, 4] = truth[k, AMPS] * warm + planar.n_wheels * p[_CURRENT_OFFSET]
        out[k, 5] = truth[k, TURNING_AMPS] * warm
        out[k, 6] = w
    offset, rate = p[_CLOCK_OFFSET] / dt, p[_CLOCK_RATE]
    camera = (planar.latency_s + p[_LATENCY]) / dt
    imu = (planar.imu_latency_s + p[_IMU_LATENCY] + planar.imu_lag_s) / dt
    for c in (0, 1, 2, 3, 6):
        late = offset + (imu if c in (0, 3) else camera)
        if late != 0.0 or rate != 0.0:
            out[:, c] = delayed(out[:, c].copy(), late, rate)
    return out
