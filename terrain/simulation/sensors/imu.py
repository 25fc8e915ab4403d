"""An inertial measurement unit: angular rates, specific force and fused attitude.

A sample is ``scale x + bias + noise`` of each quantity ``x`` (:func:`imu_values`).  The plants differ in the
errors that they draw (:class:`ImuErrors`): the dynamic plant draws biases anew for each power-on and lets
those of the gyro walk (:func:`draw_imu_errors`); the planar one adds coloured vibration while the robot moves
(:mod:`terrain.simulation.planar.streams`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

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


class ImuCalibration(NamedTuple):
    """Scales (3,) of the accelerometer, and biases (3,) of accelerometer and gyro, by axis."""

    accel_scale_ratio: Array
    accel_bias_mps2: Array
    gyro_bias_radps: Array


def described_calibration(sensors: Sensors) -> ImuCalibration:
    """Return the scales and biases of a robot's description."""
    patterns = ("accel_scale_{}_ratio", "accel_bias_{}_mps2", "gyro_bias_{}_radps")
    return ImuCalibration(
        *(np.array([getattr(sensors, pattern.format(axis)) for axis in "xyz"]) for pattern in patterns)
    )


class ImuErrors(NamedTuple):
    """What an IMU adds to n samples.

    Parameters
    ----------
    accel_scale_ratio : (3,) factor on the specific force
    yaw_scale_ratio : factor on yaw rate and fused yaw
    rate_bias_radps, rate_noise_radps : (n, 3) of the gyro
    accel_bias_mps2 : (3,) of the accelerometer
    accel_noise_mps2 : (n, 3)
    tilt_bias_rad : (2,) of the fused roll and pitch
    tilt_noise_rad : (n, 2)
    yaw_bias_rad : (n,) of the fused yaw, which sums the errors of the yaw rate
    yaw_noise_rad : (n,)
    """

    accel_scale_ratio: Array
    yaw_scale_ratio: float
    rate_bias_radps: Array
    rate_noise_radps: Array
    accel_bias_mps2: Array
    accel_noise_mps2: Array
    tilt_bias_rad: Array
    tilt_noise_rad: Array
    yaw_bias_rad: Array
    yaw_noise_rad: Array


def draw_imu_errors(
    sensors: Sensors, n: int, rng: np.random.Generator, gyro_scale_ratio: float = 0.0
) -> ImuErrors:
    """Return the errors of one power-on: biases drawn about those described, the gyro's as random walks.

    Parameters
    ----------
    sensors : scales, biases and noise
    n : number of samples
    rng : source of all that is drawn
    gyro_scale_ratio : relative error of the yaw gyro's scale
    """
    scale, accel_bias, gyro_bias = described_calibration(sensors)
    accel_bias = accel_bias + sensors.accel_bias_std_mps2 * rng.standard_normal(3)
    gyro_bias = gyro_bias + sensors.gyro_bias_std_radps * rng.standard_normal(3)
    period_s = 1 / sensors.imu_rate_hz
    walk = sensors.gyro_walk_radps * math.sqrt(period_s) * rng.standard_normal((n, 3)).cumsum(axis=0)
    bias = gyro_bias + walk
    accel_noise = sensors.accel_std_mps2 * rng.standard_normal((n, 3))
    gyro_noise = sensors.gyro_std_radps * rng.standard_normal((n, 3))
    mounting = sensors.tilt_std_rad * rng.standard_normal(2)
    tilt_noise = TILT_NOISE_RAD * rng.standard_normal((n, 2))
    drift = np.concatenate([[0.0], np.cumsum(bias[1:, 2]) * period_s])
    yaw_noise = sensors.yaw_std_rad * rng.standard_normal(n)
    return ImuErrors(
        accel_scale_ratio=scale,
        yaw_scale_ratio=1.0 + gyro_scale_ratio,
        rate_bias_radps=bias,
        rate_noise_radps=gyro_noise,
        accel_bias_mps2=accel_bias,
        accel_noise_mps2=accel_noise,
        tilt_bias_rad=mounting,
        tilt_noise_rad=tilt_noise,
        yaw_bias_rad=drift,
        yaw_noise_rad=yaw_noise,
    )


def imu_values(
    errors: ImuErrors, which: slice, force_mps2: Array, rate_radps: Array, tilt_rad: Array, yaw_rad: Array
) -> Array:
    """Return the values (k, 9) of the samples ``which``, in the order of ``IMU_CHANNELS``.

    Parameters
    ----------
    errors : of all n samples
    which : k of the n samples
    force_mps2, rate_radps : (k, 3) specific force and body rates, behind the sensor's own low-pass
    tilt_rad : (k, 2) roll and pitch
    yaw_rad : (k,) from the start of the run
    """
    values = np.empty((len(yaw_rad), 9))
    values[:, :3] = rate_radps * [1.0, 1.0, errors.yaw_scale_ratio] + errors.rate_bias_radps[which]
    values[:, :3] += errors.rate_noise_radps[which]
    values[:, 3:6] = errors.accel_scale_ratio * force_mps2 + errors.accel_bias_mps2
    values[:, 3:6] += errors.accel_noise_mps2[which]
    values[:, 6:8] = tilt_rad + errors.tilt_bias_rad + errors.tilt_noise_rad[which]
    yaw = errors.yaw_scale_ratio * yaw_rad + errors.yaw_bias_rad[which] + errors.yaw_noise_rad[which]
    values[:, 8] = wrapped(yaw)
    return values


class ImuSensor(Sensor):
    """IMU without magnetometer above the body's origin, at the height of the centre of mass.

    The specific force is acceleration minus gravity: +g on z at rest, ``+g sin`` on x with the nose up.
    Rates are those of the body: turning on an even slope shows no roll rate.  They are central differences of
    the attitude, so the latency is one step at least; in the first row, which has no row before it, the rates
    of roll and pitch are 0.  Of the robot's effects it applies gyro_scale, also to the fused yaw.
    """

    def __init__(self, motion: Motion, robot: Robot, rng: np.random.Generator) -> None:
        sensors, body = robot.equipment.sensors, robot.equipment.body
        stamps = motion.at(sensors.imu_rate_hz, max(sensors.imu_latency_s, STEP_S))
        super().__init__(motion, IMU_CHANNELS, *stamps)
        self._com_height_m = body.com_height_m
        gyro_scale_ratio = robot.effects.get("gyro_scale_ratio", 0.0)
        self._errors = draw_imu_errors(sensors, len(self.rows), rng, gyro_scale_ratio)
        self._up = np.empty((len(motion.record), 3))
        cutoffs_hz = [IMU_BANDWIDTH_HZ[name] for name in ("accel", "accel", "accel", "gyro", "gyro", "gyro")]
        self._low_pass = LowPass([1 / (2 * math.pi * cutoff_hz) for cutoff_hz in cutoffs_hz])
        self._n_up, self._first, self._filtered = 0, 0, np.empty((0, 6))

    @property
    def yaw_bias_radps(self) -> Array:
        """True bias (n,) of its yaw gyro at each stamp."""
        return self._errors.rate_bias_radps[:, 2]

    def _filter(self) -> int:
        motion, up = self.motion, self._up
        new = slice(self._n_up, motion.n_rows)
        roll, pitch = motion.tilt_rad[new].T
        up[new, 0] = -np.sin(pitch)
        up[new, 1] = np.sin(roll) * np.cos(pitch)
        up[new, 2] = np.cos(roll) * np.cos(pitch)
        self._n_up = motion.n_rows
        first = self._first + len(self._filtered)
        end = max(motion.n_rows - 1, min(motion.n_rows, 1))
        force_and_rates = np.empty((end - first, 6))
        _force_and_rates(motion.record, up, first, self._com_height_m, force_and_rates)
        self._first, self._filtered = first, self._low_pass(force_and_rates)
        return end

    def _write(self, new: slice, rows: Array) -> None:
        filtered = self._filtered[rows - self._first]
        yaw = self.motion.record[:, YAW]
        self.values[new] = imu_values(
            self._errors,
            new,
            filtered[:, :3],
            filtered[:, 3:],
            self.motion.tilt_rad[rows],
            yaw[rows] - yaw[0],
        )


def imu_samples(
    sensors: Sensors,
    time_s: Array,
    force_mps2: Array,
    rate_radps: Array,
    tilt_rad: Array,
    yaw_rad: Array,
    rng: np.random.Generator,
) -> Stream:
    """Return the samples of an IMU over a whole motion.

    Parameters
    ----------
    sensors : scales, biases and noise
    time_s : (n,) evenly spaced
    force_mps2, rate_radps, tilt_rad, yaw_rad : as :func:`imu_values` takes them
    rng : source of biases and noise
    """
    errors = draw_imu_errors(sensors, len(time_s), rng)
    values = imu_values(errors, slice(None), force_mps2, rate_radps, tilt_rad, yaw_rad)
    return Stream(time_s, values, IMU_CHANNELS)


@njit(cache=True)
def _force_and_rates(record: Array, up: Array, first: int, height_m: float, out: Array) -> None:
    """Write specific force and body rates (n, 6) of the rows from ``first`` on."""
    for i in range(out.shape[0]):
        k = first + i
        row = record[k]
        x, y, z = up[k, 0], up[k, 1], up[k, 2]
        out[i, 0] = GRAVITY_MPS2 * x + (row[ACCEL_X] + height_m * row[RIDE_PITCH])
        out[i, 1] = GRAVITY_MPS2 * y + (row[ACCEL_Y] - height_m * row[RIDE_ROLL])
        out[i, 2] = GRAVITY_MPS2 * z + row[RIDE_Z]
        out[i, 3], out[i, 4], out[i, 5] = 0.0, 0.0, row[YAW_RATE]
        if k > 0:  # up is constant in the world: d(up)/dt = up x rate
            change_x = (up[k + 1, 0] - up[k - 1, 0]) / (2.0 * STEP_S)
            change_y = (up[k + 1, 1] - up[k - 1, 1]) / (2.0 * STEP_S)
            out[i, 3] = (change_y + row[YAW_RATE] * x) / z
            out[i, 4] = (row[YAW_RATE] * y - change_x) / z
