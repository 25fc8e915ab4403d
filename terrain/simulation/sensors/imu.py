"""An inertial measurement unit: angular rates, specific force and fused attitude."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import Array, Stream
from terrain.robots import Robot, Sensors
from terrain.simulation.sensors.motion import (
    ACCEL_X,
    ACCEL_Y,
    RIDE_PITCH,
    RIDE_ROLL,
    RIDE_Z,
    STEP_S,
    YAW,
    YAW_RATE,
    Motion,
)
from terrain.simulation.sensors.sensor import LowPass, Sensor

IMU_BANDWIDTH_HZ = {"accel": 62.5, "gyro": 47.0}
"""Bandwidths of the BNO055 in its fusion modes (Bosch data sheet)."""

TILT_NOISE_RAD = 0.001
"""Sample noise of the fused roll and pitch; assumed."""


class ImuSensor(Sensor):
    """IMU without magnetometer over the body's origin, as high as the centre of mass.

    The specific force is acceleration minus gravity: +g on z at rest, ``+g sin`` on x with the nose up.
    Rates are those of the body: turning on an even slope rolls nothing.  They come of central differences of
    the attitude, so the latency is one step at least; in the first row, which has none before it, nothing
    rolls or pitches.  Of the robot's effects it knows gyro_scale, which the fused yaw has too.
    """

    def __init__(self, motion: Motion, robot: Robot, rng: np.random.Generator) -> None:
        sensors, body = robot.equipment.sensors, robot.equipment.body
        stamps = motion.at(sensors.imu_rate_hz, max(sensors.imu_latency_s, STEP_S))
        super().__init__(motion, IMU_CHANNELS, *stamps)
        self._com_height_m = body.com_height_m
        self._errors = ImuErrors(sensors, len(self.rows), rng, robot.effects.get("gyro_scale_ratio", 0.0))
        self._up = np.empty((len(motion.record), 3))
        cutoffs_hz = [IMU_BANDWIDTH_HZ[name] for name in ("accel", "accel", "accel", "gyro", "gyro", "gyro")]
        self._low_pass = LowPass([1 / (2 * math.pi * cutoff_hz) for cutoff_hz in cutoffs_hz])
        self._n_up, self._first, self._felt = 0, 0, np.empty((0, 6))

    @property
    def yaw_bias_radps(self) -> Array:
        """True bias (n,) of its yaw gyro at each stamp."""
        return self._errors.bias_radps[:, 2]

    def _follow(self) -> int:
        motion, up = self.motion, self._up
        new = slice(self._n_up, motion.n_rows)
        roll, pitch = motion.tilt_rad[new].T
        up[new, 0] = -np.sin(pitch)
        up[new, 1] = np.sin(roll) * np.cos(pitch)
        up[new, 2] = np.cos(roll) * np.cos(pitch)
        self._n_up = motion.n_rows
        first = self._first + len(self._felt)
        told = max(motion.n_rows - 1, min(motion.n_rows, 1))
        felt = np.empty((told - first, 6))
        _feel(motion.record, up, first, self._com_height_m, felt)
        self._first, self._felt = first, self._low_pass(felt)
        return told

    def _write(self, new: slice, rows: Array) -> None:
        felt = self._felt[rows - self._first]
        yaw = self.motion.record[:, YAW]
        self.values[new] = self._errors.told(
            new, felt[:, :3], felt[:, 3:], self.motion.tilt_rad[rows], yaw[rows] - yaw[0]
        )


class ImuErrors:
    """What an IMU of these sensors adds to ``n`` samples.

    Each power-on has biases of its own about those described; the gyro's walk, and the fused yaw sums them.
    ``gyro_scale_ratio`` is by how much the yaw gyro reads too much.
    """

    def __init__(
        self, sensors: Sensors, n: int, rng: np.random.Generator, gyro_scale_ratio: float = 0.0
    ) -> None:
        self.gyro_scale = 1.0 + gyro_scale_ratio
        self.scale, accel_bias, gyro_bias = (
            np.array([getattr(sensors, pattern.format(axis)) for axis in "xyz"])
            for pattern in ("accel_scale_{}_ratio", "accel_bias_{}_mps2", "gyro_bias_{}_radps")
        )
        self.accel_bias_mps2 = accel_bias + sensors.accel_bias_std_mps2 * rng.standard_normal(3)
        gyro_bias = gyro_bias + sensors.gyro_bias_std_radps * rng.standard_normal(3)
        period_s = 1 / sensors.imu_rate_hz
        walk = sensors.gyro_walk_radps * math.sqrt(period_s) * rng.standard_normal((n, 3)).cumsum(axis=0)
        self.bias_radps = gyro_bias + walk
        self.accel_noise = sensors.accel_std_mps2 * rng.standard_normal((n, 3))
        self.gyro_noise = sensors.gyro_std_radps * rng.standard_normal((n, 3))
        self.mounting_rad = sensors.tilt_std_rad * rng.standard_normal(2)
        self.tilt_noise = TILT_NOISE_RAD * rng.standard_normal((n, 2))
        self.drift_rad = np.concatenate([[0.0], np.cumsum(self.bias_radps[1:, 2]) * period_s])
        self.yaw_noise = sensors.yaw_std_rad * rng.standard_normal(n)

    def told(
        self, which: slice, force_mps2: Array, rate_radps: Array, tilt_rad: Array, yaw_rad: Array
    ) -> Array:
        """Return the values (k, 9) of the samples ``which``, in the order of ``IMU_CHANNELS``.

        Parameters
        ----------
        which : k of the n samples
        force_mps2, rate_radps : (k, 3) specific force and body rates, behind the sensor's own low-pass
        tilt_rad : (k, 2) roll and pitch
        yaw_rad : (k,) counted from the start
        """
        told = np.empty((len(yaw_rad), 9))
        told[:, :3] = (
            rate_radps * [1.0, 1.0, self.gyro_scale] + self.bias_radps[which] + self.gyro_noise[which]
        )
        told[:, 3:6] = self.scale * force_mps2 + self.accel_bias_mps2 + self.accel_noise[which]
        told[:, 6:8] = tilt_rad + self.mounting_rad + self.tilt_noise[which]
        told[:, 8] = wrapped(self.gyro_scale * yaw_rad + self.drift_rad[which] + self.yaw_noise[which])
        return told


def imu_samples(
    sensors: Sensors,
    time_s: Array,
    force_mps2: Array,
    rate_radps: Array,
    tilt_rad: Array,
    yaw_rad: Array,
    rng: np.random.Generator,
) -> tuple[Stream, Array]:
    """Return what an IMU tells of a whole motion (:class:`ImuErrors`), and the bias (n,) of its yaw gyro.

    Parameters
    ----------
    sensors : scales, biases and noise
    time_s : (n,) evenly spaced
    force_mps2, rate_radps, tilt_rad, yaw_rad : as :meth:`ImuErrors.told` takes them
    rng : source of biases and noise
    """
    errors = ImuErrors(sensors, len(time_s), rng)
    values = errors.told(slice(None), force_mps2, rate_radps, tilt_rad, yaw_rad)
    return Stream(time_s, values, IMU_CHANNELS), errors.bias_radps[:, 2]


@njit(cache=True)
def _feel(record: Array, up: Array, first: int, height_m: float, felt: Array) -> None:
    """Write specific force and body rates (n, 6) of the rows from ``first`` on."""
    for i in range(felt.shape[0]):
        k = first + i
        row = record[k]
        x, y, z = up[k, 0], up[k, 1], up[k, 2]
        felt[i, 0] = GRAVITY_MPS2 * x + (row[ACCEL_X] + height_m * row[RIDE_PITCH])
        felt[i, 1] = GRAVITY_MPS2 * y + (row[ACCEL_Y] - height_m * row[RIDE_ROLL])
        felt[i, 2] = GRAVITY_MPS2 * z + row[RIDE_Z]
        felt[i, 3], felt[i, 4], felt[i, 5] = 0.0, 0.0, row[YAW_RATE]
        if k > 0:  # up stands in the world: d(up)/dt = up x rate
            change_x = (up[k + 1, 0] - up[k - 1, 0]) / (2.0 * STEP_S)
            change_y = (up[k + 1, 1] - up[k - 1, 1]) / (2.0 * STEP_S)
            felt[i, 3] = (change_y + row[YAW_RATE] * x) / z
            felt[i, 4] = (row[YAW_RATE] * y - change_x) / z
