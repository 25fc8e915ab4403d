"""From logged wheels, steering and tilt to what the other sensors of the log should show.

Lags, clocks and offsets that stand between the inputs and their records are corrected first; from there on a replay is
the motion and the sensors of a simulated run.  Sensors without noise have bias, scale, mounting, latency and their
logger's clock.
"""

from __future__ import annotations

import math

import numpy as np

from terrain.effects import EFFECTS
from terrain.kernels import njit
from terrain.kinematics.wheels import point_velocity
from terrain.records import Array
from terrain.simulation.planar.model import delayed, slopes
from terrain.simulation.planar.motion import Planar, move


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
    wheel_speed_mps, steer_rad, grade_rad, roll_rad : (n, wheels), (n, wheels), (n,), (n,) as measured: the lag of the
        encoders, the clock and the offsets of the tilt are corrected here
    """
    wheel_speed, grade, roll = corrected_inputs(planar, vector, dt, wheel_speed_mps, grade_rad, roll_rad)
    return sense(planar, vector, dt, move(planar, vector, dt, wheel_speed, steer_rad, grade, roll))


def corrected_inputs(
    planar: Planar, vector: Array, dt: float, wheel_speed_mps: Array, grade_rad: Array, roll_rad: Array
) -> tuple[Array, Array, Array]:
    """Return true wheel speeds, grade and roll from the measured ones; see :func:`replay`."""
    corrected: tuple[Array, Array, Array] = _corrected(
        planar.body, vector, dt, wheel_speed_mps, grade_rad, roll_rad
    )
    return corrected


@njit
def _corrected(
    params: Array, vector: Array, dt: float, wheel_speed_mps: Array, grade_rad: Array, roll_rad: Array
) -> tuple[Array, Array, Array]:
    body, p = params[0], vector.view(EFFECTS)[0]
    wheel_speed, grade, roll = wheel_speed_mps, grade_rad - p.pitch_offset_rad, roll_rad - p.roll_offset_rad
    lag = body.encoder_lag_s + p.encoder_lag_s
    if lag != 0.0:
        wheel_speed = wheel_speed_mps.copy()
        for i in range(wheel_speed.shape[1]):
            wheel_speed[:, i] += lag * slopes(wheel_speed_mps[:, i].copy(), dt)
    late = (p.clock_offset_s + body.imu_latency_s + p.imu_latency_s) / dt
    if late != 0.0 or p.clock_rate_ratio != 0.0:
        grade = delayed(grade, -late, -p.clock_rate_ratio)
        roll = delayed(roll, -late, -p.clock_rate_ratio)
    return wheel_speed, grade, roll


def sense(planar: Planar, vector: Array, dt: float, truth: Array) -> Array:
    """Return the channels (n, len(CHANNELS)) that sensors without noise measure.

    Parameters
    ----------
    planar, vector, dt : as :func:`move` takes them
    truth : (n,) that it returns
    """
    return np.asarray(_sense(planar.body, vector, dt, truth))


@njit
def _sense(params: Array, vector: Array, dt: float, truth: Array) -> Array:
    body, p, n = params[0], vector.view(EFFECTS)[0], truth.shape[0]
    out = np.empty((n, 7))
    lever_x, lever_y = body.lever_x_m + p.lever_x_m, body.lever_y_m + p.lever_y_m
    scale = 1.0 + p.camera_scale_ratio if body.seen_from_above else 1.0
    cos, sin = scale * math.cos(p.camera_yaw_rad), scale * math.sin(p.camera_yaw_rad)
    for k in range(n):
        row = truth[k]
        w = row.yaw_rate_radps
        v_x, v_y = point_velocity(row.speed_x_mps, row.speed_y_mps, w, lever_x, lever_y)
        out[k, 0] = (1.0 + p.gyro_scale_ratio) * w + p.gyro_bias_radps
        out[k, 1] = cos * v_x - sin * v_y
        out[k, 2] = sin * v_x + cos * v_y
        out[k, 3] = row.accel_x_mps2 + p.accel_bias_mps2
        warm = (1.0 + p.motor_constant_ratio) * (1.0 + p.motor_drift_ratio * k * dt / 60.0)
        out[k, 4] = row.current_a * warm + body.n_wheels * p.current_offset_a
        out[k, 5] = row.turning_current_a * warm
        out[k, 6] = w
    offset, rate = p.clock_offset_s / dt, p.clock_rate_ratio
    camera = (body.latency_s + p.camera_latency_s) / dt
    imu = (body.imu_latency_s + p.imu_latency_s + body.imu_lag_s) / dt
    for c in (0, 1, 2, 3, 6):
        late = offset + (imu if c in (0, 3) else camera)
        if late != 0.0 or rate != 0.0:
            out[:, c] = delayed(out[:, c].copy(), late, rate)
    return out
