"""Absolute encoders of the steering."""

from __future__ import annotations

import math

import numpy as np

from terrain.angles import wrapped
from terrain.logs.schema import STEERING_CHANNELS
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.sensors.motion import (
    N_RECORD,
    Motion,
)
from terrain.simulation.sensors.sensor import Sensor


class SteeringSensor(Sensor):
    """Absolute encoders: whole steps a turn (Gray code errs by one at most), the zero not taken off.

    The third one sits below the hinge of its leg, and does not see it swing; none sees what the linkage to
    its wheel does (:func:`terrain.simulation.dynamic.plant.record_width`).
    """

    def __init__(self, motion: Motion, robot: Robot, rng: np.random.Generator) -> None:
        steering, sensors = robot.equipment.steering, robot.equipment.sensors
        super().__init__(motion, STEERING_CHANNELS, *motion.at(sensors.steering_rate_hz))
        self._zeros = np.array([steering.zero_1_rad, steering.zero_2_rad, steering.zero_3_rad])
        self._step_rad = 2 * math.pi / sensors.steering_steps_ratio
        self._noise = sensors.steering_std_rad * rng.standard_normal((len(self.rows), 3))
        self._steer, self._leg = motion.wheel("steer_rad"), motion.body("leg_rad")

    def _write(self, new: slice, rows: Array) -> None:
        if self.motion.record.shape[1] > N_RECORD:
            steer = self.motion.record[rows, N_RECORD:]
        else:
            steer = self._steer[rows]
            steer[:, 2] -= self._leg[rows]
        angle = steer + self._zeros + self._noise[new]
        angle = np.floor(angle / self._step_rad) * self._step_rad + self._step_rad / 2
        self.values[new] = wrapped(angle)
