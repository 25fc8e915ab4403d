"""Wheel encoders and motor currents."""

from __future__ import annotations

import numpy as np

from terrain.logs.schema import WHEELS_CHANNELS
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.sensors.motion import (
    Motion,
)
from terrain.simulation.sensors.sensor import Sensor

STANDSTILL_RADPS = 1e-3
"""Motor rate below which the Hall sensors count no step."""


def add_rate_noise(rate: Array, noise: Array, standstill: float) -> Array:
    """Return measured rates: an encoder that counts no step, at rates up to ``standstill``, has no noise."""
    return np.asarray(rate + noise * (np.abs(rate) > standstill))


class WheelSensor(Sensor):
    """Motor rates after the motor driver's low-pass on quantised Hall steps, and motor currents.

    Of the robot's effects it applies motor_drift, current_offset and the scales of the encoders.
    """

    def __init__(self, motion: Motion, robot: Robot, rng: np.random.Generator) -> None:
        motors, sensors = robot.equipment.motors, robot.equipment.sensors
        super().__init__(motion, WHEELS_CHANNELS, *motion.at(sensors.wheels_rate_hz))
        n = len(self.rows)
        scales = np.array([1.0 + robot.effects.get(f"wheel_scale_{i}_ratio", 0.0) for i in (1, 2, 3)])
        self._reduction = motors.reduction_ratio / scales
        self._per_amp_nm = motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio
        self._motor_noise = sensors.motor_std_radps * rng.standard_normal((n, 3))
        self._current_noise = sensors.current_std_a * rng.standard_normal((n, 3))
        self._warm = 1.0 + robot.effects.get("motor_drift_ratio", 0.0) * self.time_s[:, None] / 60.0
        self._offset_a = robot.effects.get("current_offset_a", 0.0)
        self._reported, self._torque = motion.wheel("reported_radps"), motion.wheel("torque_nm")

    def _write(self, new: slice, rows: Array) -> None:
        motor = self._reported[rows] * self._reduction
        self.values[new, :3] = add_rate_noise(motor, self._motor_noise[new], STANDSTILL_RADPS)
        current = self._torque[rows] / self._per_amp_nm * self._warm[new] + self._offset_a
        self.values[new, 3:] = current + self._current_noise[new]
