"""Sensors: from what happened, step by step, to what each logger wrote at its own rate.

Each sensor follows the recorded motion at :data:`~terrain.simulation.dynamic.vehicle.STEP_S`, adds what it
does to it (low-pass, latency, bias, noise, quantisation, loss) and writes one stream.  A stamp is the time at
which the sample arrived; what it tells is older by the sensor's latency.

All that is drawn is drawn when a sensor is made.  After that it is told of the motion in blocks of any
length: a run in one block and a run tick by tick give the same bytes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numba import njit

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.kinematics.camera import CHANNELS, to_camera, turned
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS, STEERING_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array, Reading, Stream
from terrain.robots import Robot, Sensors
from terrain.simulation.conditions import Faults
from terrain.simulation.dynamic.vehicle import BODY_RECORD, N_BODY_RECORD, N_RECORD, STEP_S, WHEEL_RECORD

IMU_BANDWIDTH_HZ = {"accel": 62.5, "gyro": 47.0}
"""Bandwidths of the BNO055 in its fusion modes (Bosch data sheet)."""

TILT_NOISE_RAD = 0.001
"""Sample noise of the fused roll and pitch; assumed."""

JUMP_SAMPLES = 4
"""A relocalisation of the camera shows as that many samples of a wrong speed; assumed."""


@dataclass(frozen=True, slots=True)
class Gnss:
    """An RTK receiver with its antenna above the body's origin.

    Fix to 2 cm and 10 Hz: thesis 5.1.1.  A float solution of half a metre, the latency of the radio link, the
    accuracy of the Doppler speed and how long a fix lasts are assumed.
    """

    rate_hz: float = 10.0
    latency_s: float = 0.1
    fix_std_m: float = 0.02
    float_std_m: float = 0.5
    speed_std_mps: float = 0.03
    fix_length_s: float = 60.0
    float_length_s: float = 5.0


class Motion:
    """What happened in one run, every :data:`STEP_S`, as far as it has happened.

    Parameters
    ----------
    record : (n, N_RECORD) for :func:`terrain.simulation.dynamic.vehicle.advance` to write
    n_rows : rows that are written; all by default

    Attributes
    ----------
    tilt_rad : (n, 2) roll and pitch of the body: the slope and the ride over it
    """

    def __init__(self, record: Array, n_rows: int | None = None) -> None:
        self.record = record
        self.tilt_rad = np.empty((len(record), 2))
        self.n_rows = 0
        self.grow(len(record) if n_rows is None else n_rows)

    def grow(self, n_rows: int) -> None:
        """Take note that so many rows are written."""
        new = slice(self.n_rows, n_rows)
        grade_x, grade_y = self.body("grade_x_ratio")[new], self.body("grade_y_ratio")[new]
        # up is (grade_x, grade_y, 1) = (-sin pitch, sin roll cos pitch, cos roll cos pitch)
        self.tilt_rad[new, 0] = np.arctan(grade_y) + self.body("ride_roll_rad")[new]
        self.tilt_rad[new, 1] = (
            -np.arctan(grade_x / np.hypot(1.0, grade_y)) + self.body("ride_pitch_rad")[new]
        )
        self.n_rows = n_rows

    @property
    def time_s(self) -> Array:
        """Time (n,) of each row."""
        return np.arange(len(self.record)) * STEP_S

    def body(self, name: str) -> Array:
        """One quantity (n,) of the body."""
        return self.record[:, BODY_RECORD.index(name)]

    def wheel(self, name: str) -> Array:
        """One quantity (n, 3) of the wheels."""
        return self.record[:, N_BODY_RECORD + WHEEL_RECORD.index(name) :: len(WHEEL_RECORD)][:, :3]

    def at(self, rate_hz: float, latency_s: float = 0.0) -> tuple[Array, Array]:
        """Stamps (k,) of a sensor of that rate, and the rows (k,) it tells of."""
        time_s = np.arange(math.floor(len(self.record) * STEP_S * rate_hz + 1e-6)) / rate_hz
        return time_s, np.maximum(np.round((time_s - latency_s) / STEP_S).astype(int), 0)


class Sensor(ABC):
    """One sensor of one run, and what it wrote so far.

    Parameters
    ----------
    motion : what it is told of; rows may be missing yet
    channels : of its stream
    time_s : (n,) when its samples arrive
    rows : (n,) of the motion that they tell of, none later than the sample
    """

    def __init__(self, motion: Motion, channels: tuple[str, ...], time_s: Array, rows: Array) -> None:
        self.motion, self.channels, self.time_s, self.rows = motion, channels, time_s, rows
        self.values = np.empty((len(time_s), len(channels)))
        self._shown = (time_s.view(), self.values.view())
        for array in self._shown:
            array.flags.writeable = False
        self._n_written = self._n_given = 0

    def stamp(self, offset_s: float, rate_ratio: float) -> None:
        """Stamp by a clock of its own, ``t' = (1 + r) t + T``; samples arrive when they did."""
        self._shown = ((1.0 + rate_ratio) * self.time_s + offset_s, self._shown[1])
        self._shown[0].flags.writeable = False

    def hear(self) -> None:
        """Write the samples that the motion's rows allow by now."""
        told = self._follow()
        new = slice(self._n_written, int(self.rows.searchsorted(told)))
        if new.start < new.stop:
            self._write(new, self.rows[new])
            self._n_written = new.stop

    def arrived(self, time_s: float) -> Reading | None:
        """Return what arrived since this was last asked, up to and with ``time_s``; None if nothing did."""
        new = slice(self._n_given, int(self.time_s.searchsorted(time_s, side="right")))
        self._n_given = new.stop
        return Reading(*(array[new] for array in self._shown)) if new.start < new.stop else None

    def stream(self) -> Stream:
        """Return all that it wrote, once the motion is complete."""
        return Stream(*self._shown, self.channels)

    def _follow(self) -> int:
        """Carry on what has a memory; return up to which row samples can be written."""
        return self.motion.n_rows

    @abstractmethod
    def _write(self, new: slice, rows: Array) -> None:
        """Write samples ``new`` of what the motion's ``rows`` tell."""


class WheelSensor(Sensor):
    """Motor rates behind the driver's low-pass on quantised Hall steps, and motor currents.

    Of the robot's effects it knows motor_drift.
    """

    def __init__(self, motion: Motion, robot: Robot, rng: np.random.Generator) -> None:
        motors, sensors = robot.equipment.motors, robot.equipment.sensors
        super().__init__(motion, WHEELS_CHANNELS, *motion.at(sensors.wheels_rate_hz))
        n = len(self.rows)
        self._reduction = motors.reduction_ratio
        self._per_amp_nm = motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio
        self._motor_noise = sensors.motor_std_radps * rng.standard_normal((n, 3))
        self._current_noise = sensors.current_std_a * rng.standard_normal((n, 3))
        self._warm = 1.0 + robot.effects.get("motor_drift_ratio", 0.0) * self.time_s[:, None] / 60.0
        self._reported, self._torque = motion.wheel("reported_radps"), motion.wheel("torque_nm")

    def _write(self, new: slice, rows: Array) -> None:
        motor = self._reported[rows] * self._reduction
        moving = np.abs(motor) > 1e-3  # a Hall sensor that sees no step says nothing but zero
        self.values[new, :3] = motor + self._motor_noise[new] * moving
        current = self._torque[rows] / self._per_amp_nm * self._warm[new]
        self.values[new, 3:] = current + self._current_noise[new]


class SteeringSensor(Sensor):
    """Absolute encoders: whole steps a turn (Gray code errs by one at most), the zero not taken off.

    The third one sits below the hinge of its leg, and does not see it swing; none sees what the linkage to
    its wheel does (:func:`terrain.simulation.dynamic.vehicle.record_width`).
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
        yaw = self.motion.record[:, _YAW]
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


class CameraSensor(Sensor):
    """Tracking camera in its own frames: drifting pose, noisy speed, dropouts and relocalisation jumps.

    What it tells without noise is :func:`terrain.kinematics.camera.odometry_stream`; lost samples are none.
    Of the robot's effects it knows camera_yaw.
    """

    def __init__(self, motion: Motion, robot: Robot, rng: np.random.Generator, faults: Faults) -> None:
        camera = robot.equipment.camera
        time_s, rows = motion.at(camera.rate_hz, camera.latency_s)
        n = len(rows)
        yaw_noise = camera.yaw_std_rad * rng.standard_normal(n)
        drift = camera.speed_std_mps * rng.standard_normal((n, 2)).cumsum(axis=0) / camera.rate_hz
        position_noise = camera.position_std_m * rng.standard_normal((n, 2))
        speed_noise = camera.speed_std_mps * rng.standard_normal((n, 3))  # in the camera's axes
        lost = np.zeros(n, dtype=bool)
        chance = rng.random((n, 2)) * camera.rate_hz
        lengths = rng.exponential(camera.dropout_length_s, n)
        jumps = camera.jump_std_m * rng.standard_normal((n, 2))
        moved = np.zeros((n, 2))
        if faults.by_chance:
            for i in np.flatnonzero(chance[:, 0] < camera.dropout_rate_hz):
                lost |= (time_s >= time_s[i]) & (time_s < time_s[i] + lengths[i])
            for i in np.flatnonzero(chance[:, 1] < camera.jump_rate_hz):
                moved[i:] += jumps[i]
                speed_noise[i : i + JUMP_SAMPLES] += (
                    to_camera(np.append(jumps[i], 0.0)) * camera.rate_hz / JUMP_SAMPLES
                )
        for start_s, end_s in faults.camera_lost_s:
            lost |= (time_s >= start_s) & (time_s < end_s)
        rate_noise = camera.yaw_rate_std_radps * rng.standard_normal((n, 3))
        self._noise = np.column_stack(
            [drift, position_noise, moved, yaw_noise, speed_noise, rate_noise],
        )[~lost]
        self._lever_m = np.array([camera.lever_x_m, camera.lever_y_m, camera.lever_z_m])
        self._mounting_rad = robot.effects.get("camera_yaw_rad", 0.0)
        self._yaw_noise_0 = yaw_noise[0] if n else 0.0
        self._low_pass = LowPass([camera.time_constant_s] * 6)
        self._first, self._seen = 0, np.empty((0, 6))
        super().__init__(motion, CHANNELS, time_s[~lost], rows[~lost])

    def _follow(self) -> int:
        motion, first = self.motion, self._first + len(self._seen)
        seen = np.empty((motion.n_rows - first, 6))
        seen[:, :3] = motion.record[first : motion.n_rows, _SPEED_X : _SPEED_X + 3]
        seen[:, 3:5] = motion.tilt_rad[first : motion.n_rows]
        seen[:, 5] = motion.record[first : motion.n_rows, _YAW]
        self._first, self._seen = first, self._low_pass(seen)
        return motion.n_rows

    def _write(self, new: slice, rows: Array) -> None:
        record = self.motion.record
        _pose(
            record[rows, :2],
            self._seen[rows - self._first],
            self._noise[new],
            self._lever_m,
            record[0, _YAW] + self._yaw_noise_0,
            self.values[new],
        )
        if self._mounting_rad:
            turned(self.values[new], self.channels, self._mounting_rad)


class GnssSensor(Sensor):
    """RTK positions and speeds in the world frame, with stretches of float."""

    def __init__(self, motion: Motion, receiver: Gnss, rng: np.random.Generator, faults: Faults) -> None:
        time_s, rows = motion.at(receiver.rate_hz, receiver.latency_s)
        n = len(rows)
        fixed = np.empty(n, dtype=bool)
        state = True
        leave = rng.random(n) * receiver.rate_hz
        for i in range(n):
            length_s = receiver.fix_length_s if state else receiver.float_length_s
            state = state != bool(leave[i] < 1 / length_s)
            fixed[i] = state
        std = np.where(fixed, receiver.fix_std_m, receiver.float_std_m)
        position_noise = std[:, None] * rng.standard_normal((n, 2))
        noise = np.column_stack([position_noise, receiver.speed_std_mps * rng.standard_normal((n, 2))])
        kept = np.ones(n, dtype=bool)
        for start_s, end_s in faults.gnss_lost_s:
            kept &= ~((time_s >= start_s) & (time_s < end_s))
        super().__init__(motion, GNSS_CHANNELS, time_s[kept], rows[kept])
        self._noise, self._quality = noise[kept], np.column_stack([std, fixed])[kept]

    def _write(self, new: slice, rows: Array) -> None:
        record, noise = self.motion.record, self._noise[new]
        yaw, along, across = (record[rows, place] for place in (_YAW, _SPEED_X, _SPEED_X + 1))
        self.values[new, :2] = record[rows, :2] + noise[:, :2]
        self.values[new, 2] = along * np.cos(yaw) - across * np.sin(yaw) + noise[:, 2]
        self.values[new, 3] = along * np.sin(yaw) + across * np.cos(yaw) + noise[:, 3]
        self.values[new, 4:] = self._quality[new]


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


def truth_stream(
    motion: Motion, gyro_bias_radps: Array, gyro_time_s: Array, rate_hz: float = 100.0
) -> Stream:
    """Return what happened, at a rate that files can bear; a slip that no instant has is no channel."""
    time_s, rows = motion.at(rate_hz)
    columns = {
        **{name: motion.body(name) for name in ("position_x_m", "position_y_m", "yaw_rad")},
        "roll_rad": motion.tilt_rad[:, 0],
        "pitch_rad": motion.tilt_rad[:, 1],
        **{
            name: motion.body(name)
            for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2")
        },
    }
    for recorded in (
        "wheel_radps",
        "steer_rad",
        "slip_ratio",
        "slip_angle_rad",
        "normal_n",
        "traction_n",
        "torque_nm",
        "sinkage_m",
        "side_n",
    ):
        quantity, _, unit = recorded.rpartition("_")
        for i in range(3):
            columns[f"{quantity}_{i + 1}_{unit}"] = motion.wheel(recorded)[:, i]
    kept = {name: column[rows] for name, column in columns.items() if np.isfinite(column[rows]).any()}
    kept["gyro_bias_z_radps"] = np.interp(time_s, gyro_time_s, gyro_bias_radps)
    return Stream(time_s, np.column_stack(list(kept.values())), tuple(kept))


class LowPass:
    """First-order low-passes of several quantities, started at rest at the first values they are given.

    Called with values (n, c) at :data:`STEP_S`, they filter them in place and remember where they were.
    """

    def __init__(self, time_constants_s: list[float]) -> None:
        self._keep = np.array([math.exp(-STEP_S / tau) if tau > 0.0 else 0.0 for tau in time_constants_s])
        self._start: Array | None = None
        self._state = np.zeros(len(time_constants_s))

    def __call__(self, values: Array) -> Array:
        """Filter values (n, c) in place, and return them."""
        if len(values):
            self._start = values[0].copy() if self._start is None else self._start
            _low_pass(values, self._keep, self._start, self._state)
        return values


_YAW, _SPEED_X, _TURN, _ACCEL_X, _ACCEL_Y, _RIDE_Z, _RIDE_ROLL, _RIDE_PITCH = (
    BODY_RECORD.index(name)
    for name in (
        *("yaw_rad", "speed_x_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2"),
        *("ride_z_mps2", "ride_roll_radps2", "ride_pitch_radps2"),
    )
)


@njit(cache=True)
def _low_pass(values: Array, keep: Array, start: Array, state: Array) -> None:
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            if keep[j] > 0.0:
                state[j] = keep[j] * state[j] + (1.0 - keep[j]) * (values[i, j] - start[j])
                values[i, j] = state[j] + start[j]


@njit(cache=True)
def _feel(record: Array, up: Array, first: int, height_m: float, felt: Array) -> None:
    """Write specific force and body rates (n, 6) of the rows from ``first`` on."""
    for i in range(felt.shape[0]):
        k = first + i
        row = record[k]
        x, y, z = up[k, 0], up[k, 1], up[k, 2]
        felt[i, 0] = GRAVITY_MPS2 * x + (row[_ACCEL_X] + height_m * row[_RIDE_PITCH])
        felt[i, 1] = GRAVITY_MPS2 * y + (row[_ACCEL_Y] - height_m * row[_RIDE_ROLL])
        felt[i, 2] = GRAVITY_MPS2 * z + row[_RIDE_Z]
        felt[i, 3], felt[i, 4], felt[i, 5] = 0.0, 0.0, row[_TURN]
        if k > 0:  # up stands in the world: d(up)/dt = up x rate
            change_x = (up[k + 1, 0] - up[k - 1, 0]) / (2.0 * STEP_S)
            change_y = (up[k + 1, 1] - up[k - 1, 1]) / (2.0 * STEP_S)
            felt[i, 3] = (change_y + row[_TURN] * x) / z
            felt[i, 4] = (row[_TURN] * y - change_x) / z


@njit(cache=True)
def _pose(position_m: Array, seen: Array, noise: Array, lever_m: Array, yaw_0: float, values: Array) -> None:
    """Write the camera's samples (n, 14): the quaternion of yaw, pitch and roll in turn, and what it turns.

    ``seen`` holds speed x and y, yaw rate, roll, pitch and yaw; ``noise`` drift, position noise and jumps
    (two columns each), yaw, speed and rate noise.  Axes go as in :func:`terrain.kinematics.camera.to_camera`.
    """
    w_0, z_0 = math.cos(-yaw_0 / 2), math.sin(-yaw_0 / 2)
    for i in range(seen.shape[0]):
        turn = seen[i, 2]
        half_roll, half_pitch = seen[i, 3] / 2, seen[i, 4] / 2
        half_yaw = (seen[i, 5] + noise[i, 6] - yaw_0) / 2
        cr, sr = math.cos(half_roll), math.sin(half_roll)
        cp, sp = math.cos(half_pitch), math.sin(half_pitch)
        cy, sy = math.cos(half_yaw), math.sin(half_yaw)
        w = cy * cp * cr + sy * sp * sr
        x = cy * cp * sr - sy * sp * cr
        y = cy * sp * cr + sy * cp * sr
        z = sy * cp * cr - cy * sp * sr
        ground_x = position_m[i, 0] + noise[i, 0] + noise[i, 2] + noise[i, 4]
        ground_y = position_m[i, 1] + noise[i, 1] + noise[i, 3] + noise[i, 5]
        ground = _turned(w_0, 0.0, 0.0, z_0, ground_x, ground_y, 0.0)
        lever = _turned(w, x, y, z, lever_m[0], lever_m[1], lever_m[2])
        velocity = _turned(w, x, y, z, seen[i, 0] - turn * lever_m[1], seen[i, 1] + turn * lever_m[0], 0.0)
        row = values[i]
        row[0] = -(ground[1] + lever[1] - lever_m[1])
        row[1] = lever[2] - lever_m[2]
        row[2] = -(ground[0] + lever[0] - lever_m[0])
        row[3], row[4], row[5], row[6] = -y, z, -x, w
        row[7] = noise[i, 7] - velocity[1]
        row[8] = noise[i, 8] + velocity[2]
        row[9] = noise[i, 9] - velocity[0]
        row[10], row[11], row[12] = noise[i, 10], noise[i, 11] + turn, noise[i, 12]
        row[13] = 1.0


@njit(cache=True)
def _turned(
    w: float, x: float, y: float, z: float, a: float, b: float, c: float
) -> tuple[float, float, float]:
    """Return a vector (a, b, c) turned by a quaternion."""
    return (
        (x * x - y * y - z * z + w * w) * a + 2 * (x * y - z * w) * b + 2 * (x * z + y * w) * c,
        2 * (x * y + z * w) * a + (-x * x + y * y - z * z + w * w) * b + 2 * (y * z - x * w) * c,
        2 * (x * z - y * w) * a + 2 * (y * z + x * w) * b + (-x * x - y * y + z * z + w * w) * c,
    )
