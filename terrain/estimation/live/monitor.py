"""The health of a live estimator's sensors, tick by tick."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.estimation.ekf.model import FilterModel
from terrain.estimation.ekf.resident import ResidentFilter
from terrain.estimation.ekf.state import in_one
from terrain.estimation.live.health import SENSORS, Health, find_stuck, health_memory, judge
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
    health : (13,) of the last tick
    """

    def __init__(self, robot: Robot, model: FilterModel, rows: RowMemory, n_columns: int) -> None:
        sensors, camera = robot.sensors, robot.completed.camera
        rates_hz = [sensors.wheels_rate_hz] * 3 + [sensors.steering_rate_hz] * 3 + [sensors.imu_rate_hz] * 4
        rates_hz += [camera.rate_hz] * 3 + [sensors.wheels_rate_hz]
        self._period_s = 1.0 / np.array(rates_hz)
        names = list(model.sensor_names)
        self._places = np.array([names.index(sensor) if sensor in names else -1 for sensor in SENSORS])
        states = list(model.states)
        self._motion_places = np.array([states.index(state) for state in _MOTION])
        known = [i for i, state in enumerate(_BIASES) if state in states]
        self._bias_known = np.array(known, dtype=np.int64)
        self._bias_places = np.array([states.index(_BIASES[i]) for i in known], dtype=np.int64)
        self._bias, self._stuck = np.zeros(3), np.zeros(3, dtype=np.bool_)
        self._rows = rows
        fresh = (*health_memory(), np.full(n_columns, np.nan), np.zeros(1))
        self.buffer, views = in_one(fresh)
        self._gated_s, self._compared, self._wheels, self._n_repeated = views
        self.health = np.full(len(SENSORS), Health.LOST.value, dtype=np.int8)

    @property
    def names(self) -> dict[str, str]:
        """Health of each sensor by name, in small letters."""
        return {
            name: Health(status).name.lower()
            for name, status in zip(SENSORS, self.health.tolist(), strict=True)
        }

    def judge(
        self, time_s: float, wheels: Array, motor_radps: Array, z: Array, resident: ResidentFilter
    ) -> None:
        """Judge the sensors at a tick.

        Parameters
        ----------
        time_s : stamp
        wheels : (c,) sample of the wheels
        motor_radps : (3,) rates in it
        z : (29,) rows
        resident : the filter, after the tick
        """
        same = bool((wheels == self._wheels).all())  # currents too, which no rounding keeps the same
        self._wheels[:] = wheels
        self._n_repeated[0] = self._n_repeated[0] + 1.0 if same else 0.0
        motion = resident.mean[self._motion_places]
        speed_mps = math.hypot(motion[0], motion[1])
        find_stuck(z, motor_radps, self._n_repeated[0], speed_mps, self._rows.frozen, self._stuck)
        self._bias[self._bias_known] = resident.mean[self._bias_places]
        judge(
            time_s,
            resident.use,
            self._places,
            self._period_s,
            self._rows.lines,
            self._rows.received_s,
            self._rows.frozen,
            self._stuck,
            self._rows.derived,
            z,
            self._bias,
            motion,
            self._gated_s,
            self._compared,
            self.health,
        )
