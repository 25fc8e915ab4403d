"""Absolute encoders of the steering."""

from __future__ import annotations

import math

import numpy as np

from terrain.angles import wrapped
from terrain.logs.schema import STEERING_CHANNELS
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.sensors.motion import N_RECORD, Motion
from terrain.simulation.sensors.sensor import Sensor


def encoder_angle(steer_rad: Array, zeros_rad: Array, noise_rad: Array | float, step_rad: float) -> Array:
    """Return the angles (n, wheels) that absolute encoders report.

    Parameters
    ----------
    steer_rad : (n, wheels) angles of the steering
    zeros_rad : (wheels,) angles that encoders report at 0
    noise_rad : (n, wheels), or one number
    step_rad : of the encoder; 0 does not quantise
    """
    angle = steer_rad + zeros_rad + noise_rad
    if step_rad > 0.0:
        angle = np.floor(angle / step_rad) * step_rad + step_rad / 2
    return np.asarray(wrapped(angle))


class SteeringSensor(Sensor):
    """Absolute encoders: whole steps a turn (Gray code errs by one at most), with their zero offset.

    The third one sits below the hinge of its leg and does not measure its swing; none measures the linkage to
    its wheel (:func:`terrain.simulation.dynamic.plant.record_width`).
    """

    def __init__(self, motion: Motion, robot: Robot, rng: np.random.Generator) -> None:
        sensors = robot.sensors
        super().__init__(motion, STEERING_CHANNELS, *motion.at(sensors.steering_rate_hz))
        self._zeros = robot.steering_zeros_rad
        self._step_rad = 2 * math.pi / sensors.steering_steps_ratio
        self._noise = sensors.steering_std_rad * rng.standard_normal((len(self.rows), 3))
        self._steer, self._leg = motion.wheel("steer_rad"), motion.body("leg_rad")

    def _write(self, new: slice, rows: Array) -> None:
        if self.motion.record.shape[1] > N_RECORD:
            steer = self.motion.record[rows, N_RECORD:]
        else:
            steer = self._steer[rows]
            steer[:, 2] -= self._leg[rows]
        self.values[new] = encoder_angle(steer, self._zeros, self._noise[new], self._step_rad)
