"""From logged wheels, steering and tilt to what the other sensors of the log should show.

Lags, clocks and offsets that stand between the inputs and their records are undone first; from there on a
replay is the motion and the sensors of a simulated run.

Sensors without noise have bias, scale, mounting, latency and their logger's clock.
"""

from __future__ import annotations

import math

import numpy as np

from terrain.effects import EFFECTS
from terrain.kernels import njit
from terrain.kinematics.wheels import point_velocity
from terrain.records import Array
from terrain.simulation.planar.model import AMPS, AX, TURNING_AMPS, VX, VY, Planar, W, delayed, slopes
from terrain.simulation.planar.motion import move


@njit
def replay(
    planar: Planar,
    vector: Array,
    dt: float,
    wheel_speed_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
) -> Array:
    """Return the channels (n, len(CHANNELS)) that follow from logged wheels, steering and tilt.

    Parameters
    ----------
    planar, vector, dt : as :func:`move` takes them
    wheel_speed_mps, steer_rad, grade_rad, roll_rad : (n, wheels), (n, wheels), (n,), (n,) as measured: the
        lag of the encoders, the clock and the offsets of the tilt are undone here
    """
    wheel_speed, grade, roll = undone(planar, vector, dt, wheel_speed_mps, grade_rad, roll_rad)
    truth = move(planar, vector, dt, wheel_speed, steer_rad, grade, roll, np.zeros((0, 3)))
    shown: Array = sense(planar, vector, dt, truth)
    return shown


@njit
def undone(
    planar: Planar, vector: Array, dt: float, wheel_speed_mps: Array, grade_rad: Array, roll_rad: Array
) -> tuple[Array, Array, Array]:
    """Return true wheel speeds, grade and roll from the measured ones; see :func:`replay`."""
    p = vector.view(EFFECTS)[0]
    wheel_speed, grade, roll = wheel_speed_mps, grade_rad - p.pitch_offset_rad, roll_rad - p.roll_offset_rad
    lag = planar.encoder_lag_s + p.encoder_lag_s
    if lag != 0.0:
        wheel_speed = wheel_speed_mps.copy()
        for i in range(wheel_speed.shape[1]):
            wheel_speed[:, i] += lag * slopes(wheel_speed_mps[:, i].copy(), dt)
    late = (p.clock_offset_s + planar.imu_latency_s + p.imu_latency_s) / dt
    if late != 0.0 or p.clock_rate_ratio != 0.0:
        grade = delayed(grade, -late, -p.clock_rate_ratio)
        roll = delayed(roll, -late, -p.clock_rate_ratio)
    return wheel_speed, grade, roll


@njit
def sense(planar: Planar, vector: Array, dt: float, truth: Array) -> Array:
    """Return the channels (n, len(CHANNELS)) that sensors without noise measure.

    Parameters
    ----------
    planar, vector, dt : as :func:`move` takes them
    truth : (n, len(TRUTH)) of :func:`move`
    """
    p, n = vector.view(EFFECTS)[0], truth.shape[0]
    out = np.empty((n, 7))
    lever_x, lever_y = planar.lever_x_m + p.lever_x_m, planar.lever_y_m + p.lever_y_m
    scale = 1.0 + p.camera_scale_ratio if planar.omni else 1.0
    cos, sin = scale * math.cos(p.camera_yaw_rad), scale * math.sin(p.camera_yaw_rad)
    for k in range(n):
        w = truth[k, W]
        v_x, v_y = point_velocity(truth[k, VX], truth[k, VY], w, lever_x, lever_y)
        out[k, 0] = (1.0 + p.gyro_scale_ratio) * w + p.gyro_bias_radps
        out[k, 1] = cos * v_x - sin * v_y
        out[k, 2] = sin * v_x + cos * v_y
        out[k, 3] = truth[k, AX] + p.accel_bias_mps2
        warm = (1.0 + p.motor_constant_ratio) * (1.0 + p.motor_drift_ratio * k * dt / 60.0)
        out[k, 4] = truth[k, AMPS] * warm + planar.n_wheels * p.current_offset_a
        out[k, 5] = truth[k, TURNING_AMPS] * warm
        out[k, 6] = w
    offset, rate = p.clock_offset_s / dt, p.clock_rate_ratio
    camera = (planar.latency_s + p.camera_latency_s) / dt
    imu = (planar.imu_latency_s + p.imu_latency_s + planar.imu_lag_s) / dt
    for c in (0, 1, 2, 3, 6):
        late = offset + (imu if c in (0, 3) else camera)
        if late != 0.0 or rate != 0.0:
            out[:, c] = delayed(out[:, c].copy(), late, rate)
    return out
