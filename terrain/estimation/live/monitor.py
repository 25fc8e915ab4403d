"""The health of a live estimator's sensors, tick by tick."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import float64, int8, int64, njit, types, void

from terrain.estimation.ekf.model import FilterModel
from terrain.estimation.ekf.state import in_one
from terrain.estimation.live.health import SENSORS, Health, count_repeated, find_stuck, health_memory, judge
from terrain.records import Array
from terrain.robots import Robot

_MOTION = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
_BIASES = ("accel_bias_x_mps2", "accel_bias_y_mps2", "gyro_bias_radps")


class RowMemory(NamedTuple):
    """Memory of the rows that the health is judged by: arrays that the estimator moves."""

    lines: Array
    received_s: Array
    frozen: Array
    derived: Array


class HealthArrays(NamedTuple):
    """What :func:`judge_tick` is given beside a tick; the rest is as of :func:`judge`.

    Parameters
    ----------
    motion_places, bias_places : (3,) among the states; of a bias that is none of them -1, and 0 is taken
    wheels_before, n_repeated : (c,) sample of the tick before, and how often it repeated itself
    """

    motion_places: Array
    bias_places: Array
    places: Array
    period_s: Array
    lines: Array
    received_s: Array
    frozen: Array
    derived: Array
    wheels_before: Array
    n_repeated: Array
    gated_s: Array
    compared: Array
    health: Array


_V, _M, _I = float64[::1], float64[:, ::1], int64[::1]
_IN = types.Array(float64, 1, "A", readonly=True)

HEALTH_ARRAYS = types.NamedTuple(
    (_I, _I, _I, _V, _M, _M, float64[:, :, ::1], _V, _V, _V, _V, _V, int8[::1]), HealthArrays
)
"""Their type in compiled code."""


class HealthMonitor:
    """Judges the sensors at each tick of a live estimator.

    Parameters
    ----------
    robot : gives the periods of the sensors
    model : the filter
    rows : memory of the rows
    n_columns : channels of the wheels' stream

    Attributes
    ----------
    buffer : all that it remembers
    arrays : what :func:`judge_tick` is given of it
    health : (13,) of the last tick
    """

    def __init__(self, robot: Robot, model: FilterModel, rows: RowMemory, n_columns: int) -> None:
        sensors, camera = robot.sensors, robot.completed.camera
        rates_hz = [sensors.wheels_rate_hz] * 3 + [sensors.steering_rate_hz] * 3 + [sensors.imu_rate_hz] * 4
        rates_hz += [camera.rate_hz] * 3 + [sensors.wheels_rate_hz]
        period_s = 1.0 / np.array(rates_hz)
        names = list(model.sensor_names)
        places = np.array([names.index(sensor) if sensor in names else -1 for sensor in SENSORS])
        states = list(model.states)
        motion = np.array([states.index(state) for state in _MOTION])
        biases = np.array([states.index(state) if state in states else -1 for state in _BIASES])
        fresh = (*health_memory(), np.full(n_columns, np.nan), np.zeros(1))
        self.buffer, views = in_one(fresh)
        gated_s, compared, wheels, n_repeated = views
        self.health = np.full(len(SENSORS), Health.LOST.value, dtype=np.int8)
        remembered = wheels, n_repeated, gated_s, compared, self.health
        self.arrays = HealthArrays(motion, biases, places, period_s, *rows, *remembered)

    @property
    def names(self) -> dict[str, str]:
        """Health of each sensor by name, in small letters."""
        return {
            name: Health(status).name.lower()
            for name, status in zip(SENSORS, self.health.tolist(), strict=True)
        }


@njit(void(float64, _IN, _IN, _V, _V, int8[::1], HEALTH_ARRAYS), cache=True, error_model="numpy")
def judge_tick(
    time_s: float, wheels: Array, motor_radps: Array, z: Array, mean: Array, use: Array, of: HealthArrays
) -> None:
    """Write the health (13,) of the sensors at a tick, by the sample of the wheels and the filter's state."""
    count_repeated(wheels, of.wheels_before, of.n_repeated)
    stuck, bias, motion = np.empty(3, np.bool_), np.empty(3), np.empty(3)
    for i in range(3):
        bias[i] = mean[of.bias_places[i]] if of.bias_places[i] >= 0 else 0.0
        motion[i] = mean[of.motion_places[i]]
    find_stuck(z, motor_radps, of.n_repeated[0], math.hypot(motion[0], motion[1]), of.frozen, stuck)
    judge(
        *(time_s, use, of.places, of.period_s, of.lines, of.received_s, of.frozen, stuck, of.derived),
        *(z, bias, motion, of.gated_s, of.compared, of.health),
    )
