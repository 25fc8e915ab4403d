"""From logged wheels, steering and tilt to what the other sensors of the log should show.

Lags, clocks and offsets that stand between the inputs and their records are undone first; from there on a
replay is the motion and the sensors of a simulated run.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from terrain.effects import INDEX
from terrain.records import Array
from terrain.simulation.planar.ideal_sensors import sense
from terrain.simulation.planar.model import Planar
from terrain.simulation.planar.motion import move
from terrain.simulation.planar.signals import delayed, slopes

_CLOCK_OFFSET = INDEX["clock_offset_s"]
_CLOCK_RATE = INDEX["clock_rate_ratio"]
_IMU_LATENCY = INDEX["imu_latency_s"]
_LAG = INDEX["encoder_lag_s"]
_PITCH_OFFSET = INDEX["pitch_offset_rad"]
_ROLL_OFFSET = INDEX["roll_offset_rad"]


@njit(cache=True)
def replay(
    planar: Planar,
    p: Array,
    dt: float,
    wheel_speed_mps: Array,
    steer_rad: Array,
    grade_rad: Array,
    roll_rad: Array,
) -> Array:
    """Return the channels (n, len(CHANNELS)) that follow from logged wheels, steering and tilt.

    Parameters
    ----------
    planar, p, dt : as :func:`move` takes them
    wheel_speed_mps, steer_rad, grade_rad, roll_rad : (n, wheels), (n, wheels), (n,), (n,) as measured: the
        lag of the encoders, the clock and the offsets of the tilt are undone here
    """
    wheel_speed, grade, roll = undone(planar, p, dt, wheel_speed_mps, grade_rad, roll_rad)
    truth = move(planar, p, dt, wheel_speed, steer_rad, grade, roll, np.zeros((0, 3)))
    shown: Array = sense(planar, p, dt, truth)
    return shown


@njit(cache=True)
def undone(
    planar: Planar, p: Array, dt: float, wheel_speed_mps: Array, grade_rad: Array, roll_rad: Array
) -> tuple[Array, Array, Array]:
    """Return true wheel speeds, grade and roll from the measured ones; see :func:`replay`."""
    wheel_speed, grade, roll = wheel_speed_mps, grade_rad - p[_PITCH_OFFSET], roll_rad - p[_ROLL_OFFSET]
    lag = planar.encoder_lag_s + p[_LAG]
    if lag != 0.0:
        wheel_speed = wheel_speed_mps.copy()
        for i in range(wheel_speed.shape[1]):
            wheel_speed[:, i] += lag * slopes(wheel_speed_mps[:, i].copy(), dt)
    late = (p[_CLOCK_OFFSET] + planar.imu_latency_s + p[_IMU_LATENCY]) / dt
    if late != 0.0 or p[_CLOCK_RATE] != 0.0:
        grade = delayed(grade, -late, -p[_CLOCK_RATE])
        roll = delayed(roll, -late, -p[_CLOCK_RATE])
    return wheel_speed, grade, roll
