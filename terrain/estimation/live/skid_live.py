"""Live estimation of a skid-steer robot's motion, sample by sample.

The chain of :func:`~terrain.estimation.measurements.skid_rows.with_skid_rows`,
:func:`~terrain.estimation.ekf.filter.run_filter` and :func:`~terrain.estimation.stuck.motion_track`, with the
same numbers to the last bit, on memory of a fixed size.  Each sample of the wheels is a tick, whose estimate
is returned at once.  What differs from the batch is what has to look ahead there, as
:mod:`terrain.estimation.live.estimator` lists it: repetitions of the IMU, stamps out of order, periods of
the robot's description in place of the log's, and an IMU's latency, which delays what a tick knows.

Slip is not estimated: nothing sees the ground go by.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.errors import ConfigError
from terrain.estimation.ekf.model import GATE_PROBABILITY, REOPEN_AFTER_S, FilterModel, FilterSettings, Noise
from terrain.estimation.ekf.resident import ResidentFilter
from terrain.estimation.filters.skid import make_skid_filter, skid_noise, within_bounds
from terrain.estimation.live.rows import KINDS, QUEUE, drop_first, push, refused_as
from terrain.estimation.measurements.cleaning import OFF_CLOCK_S
from terrain.estimation.measurements.sample_hold import TICK_S
from terrain.estimation.measurements.samples import IMU
from terrain.estimation.measurements.skid_rows import (
    gyro_at,
    gyro_limits,
    gyro_memory,
    rest_at,
    rest_memory,
    take_gyro,
)
from terrain.estimation.stuck import STUCK_AFTER_S, Motion, motion_at, motion_memory
from terrain.extension import Correction, check_corrected
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import Array, Reading
from terrain.robots import Robot, SkidSteerRobot, as_drive

SETTINGS = FilterSettings(GATE_PROBABILITY, REOPEN_AFTER_S)
"""Those of the batch."""

_STAMP, _FIRST_CHANNEL = 0, 2  # columns of a queue
_GYRO_Z = _FIRST_CHANNEL + IMU_CHANNELS.index("gyro_z_radps")
_OFF_CLOCK, _FROZEN, _LEAP = (KINDS.index(kind) for kind in ("off the clock", "frozen", "leap"))


class LiveSkidEstimate(NamedTuple):
    """What is believed at one tick; arrays are the caller's to keep.

    Parameters
    ----------
    time_s : stamp of the wheels
    mean, std : (8,) states and their standard deviations, in the order of :attr:`LiveSkidEstimator.states`
    speed_mps, yaw_rate_radps : of the states, by name; the speed is that of the wheels
    motion : what is known of the robot's motion
    stuck_since_s : when the robot became stuck; NaN where it is not
    wheel_speed_mps : (2,) measured speeds of the sides, left and right; NaN where there is none
    rows : (4,) what was measured, in the order of the filter's rows; NaN where nothing was
    """

    time_s: float
    mean: Array
    std: Array
    speed_mps: float
    yaw_rate_radps: float
    motion: Motion
    stuck_since_s: float
    wheel_speed_mps: Array
    rows: Array


class LiveSkidEstimator:
    """Motion of a skid-steer robot from samples as they come, and whether it is stuck.

    Parameters
    ----------
    robot : a skid-steer robot, corrected
    channels : names of the columns of the readings of ``wheels`` and ``imu``, in their order; by default the
        speeds of the sides, and the channels of the schema
    settings : when a measurement or a stamp is not believed
    noise : in place of the physical
    wheels_period_s, imu_period_s : of the sensors; by default as the robot's description has them
    correction : takes the effects of an extended robot off what arrives, see
        :func:`terrain.extension.correct_live`

    Raises
    ------
    ConfigError
        if the robot is of another drive or not corrected, a channel that is needed is not named, or a period
        is not above zero.
    DataError
        if the noise does not fit the filter.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> estimator = LiveSkidEstimator(load_robot("husky"))
    >>> estimate, = estimator.step({"wheels": Reading(np.array([0.0]), np.array([[0.4, 0.4]]))})
    >>> round(estimate.speed_mps, 2), estimate.motion.name
    (0.4, 'UNKNOWN')
    """

    def __init__(
        self,
        robot: Robot,
        channels: Mapping[str, tuple[str, ...]] | None = None,
        settings: FilterSettings = SETTINGS,
        *,
        noise: Noise | None = None,
        wheels_period_s: float | None = None,
        imu_period_s: float | None = None,
        correction: Correction | None = None,
    ) -> None:
        check_corrected(robot)
        robot = as_drive(
            SkidSteerRobot,
            robot,
            "robot {name} has the drive {drive!r}: this live estimator is for 'skid_steer'",
        )
        sensors = robot.completed.sensors
        wheels_period_s = 1.0 / sensors.wheels_rate_hz if wheels_period_s is None else wheels_period_s
        imu_period_s = 1.0 / sensors.imu_rate_hz if imu_period_s is None else imu_period_s
        for name, value in (("wheels_period_s", wheels_period_s), ("imu_period_s", imu_period_s)):
            if not 0.0 < value < math.inf:
                raise ConfigError(f"{name} is {value}, seconds above zero are required")
        self._robot, self._correction = robot, correction
        self._channels = (
            {"wheels": robot.rate_channels, "imu": IMU_CHANNELS} if channels is None else channels
        )
        wheels, imu = self._channels.get("wheels", ()), self._channels.get("imu", ())
        for stream, known, needed in (
            ("wheels", wheels, robot.rate_channels),
            ("imu", imu, ("gyro_z_radps",) if imu else ()),
        ):
            if lacking := [name for name in needed if name not in known]:
                raise ConfigError(
                    f"channels of {stream!r} are {list(known)}: {lacking[0]!r} must be among them"
                )
        self._sides = np.array([wheels.index(name) for name in robot.rate_channels])
        self._imu_columns = np.array([imu.index(name) if name in imu else -1 for name in IMU_CHANNELS])
        self._model = make_skid_filter(robot)
        noise = skid_noise(robot) if noise is None else noise
        self._filter = ResidentFilter(self._model, noise, settings)
        self._variances = self._filter.cov.reshape(-1)[:: len(self._model.states) + 1]
        self._at = [self._model.states.index(s) for s in ("speed_mps", "yaw_rate_radps", "gyro_bias_radps")]
        self._unreadable: dict[str, int] = {}
        self._counts = np.zeros((IMU + 1, len(KINDS)), np.int64)
        self._n_queued, self._last_s = np.zeros(IMU + 1, np.int64), np.full(IMU + 1, -np.inf)
        self._queue = (
            np.zeros((QUEUE, _FIRST_CHANNEL + len(IMU_CHANNELS))),
            self._n_queued,
            self._last_s,
            self._counts,
        )
        self._gyro = (
            np.full((2, 16), np.nan),
            *gyro_memory(),
            gyro_limits(robot.encoder_lag_s, imu_period_s, wheels_period_s),
            np.array([sensors.imu_latency_s, sensors.gyro_bias_z_radps]),
        )
        self._rest, self._motion = rest_memory(), motion_memory()
        self._stuck_since_s = math.nan

    @property
    def model(self) -> FilterModel:
        """The filter."""
        return self._model

    @property
    def name(self) -> str:
        """Name of the filter."""
        return self._model.name

    @property
    def states(self) -> tuple[str, ...]:
        """Name of each state, in the order of ``mean`` and ``std``."""
        return self._model.states

    @property
    def resident(self) -> ResidentFilter:
        """The filter's memory."""
        return self._filter

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind, and by what the filter did not believe."""
        counts = {f"imu: {kind}": n for kind, n in zip(KINDS, self._counts[IMU].tolist(), strict=True)}
        counts |= {f"{name}: unreadable": n for name, n in self._unreadable.items()}
        return {kind: n for kind, n in (counts | dict(self._filter.dropped)).items() if n}

    def step(self, readings: Mapping[str, Reading]) -> list[LiveSkidEstimate]:
        """Take in what arrived, and return an estimate for each sample of the wheels that was taken.

        Parameters
        ----------
        readings : by stream; any may be missing, late, repeated or wrong, and other streams are not looked at

        Returns
        -------
        list of LiveSkidEstimate
            in order of time, unless the clock of the wheels was set back.  A stamp that leaps by more than
            ``settings.max_gap_s`` is accepted, and reported, when the next one follows it.
        """
        imu = self._arrays("imu", readings)
        if imu is not None:
            push(IMU, *imu, self._imu_columns, *self._queue)
        wheels = self._arrays("wheels", readings)
        if wheels is None:
            return []
        ticks = zip(wheels[0].tolist(), wheels[1], strict=True)
        estimates = (self._tick(time_s, values[self._sides]) for time_s, values in ticks)
        return [estimate for estimate in estimates if estimate is not None]

    def _arrays(self, name: str, readings: Mapping[str, Reading]) -> tuple[Array, Array] | None:
        """Return stamps and values; values that do not fit are unknown, stamps that do not are nothing."""
        if not isinstance(readings, Mapping) or readings.get(name) is None or name not in self._channels:
            return None
        n_columns = len(self._channels[name])
        try:
            time_s = np.asarray(readings[name][0], dtype=np.float64)
            values = np.asarray(readings[name][1], dtype=np.float64)
        except (TypeError, ValueError, LookupError, OverflowError):
            self._unreadable[name] = self._unreadable.get(name, 0) + 1
            return None
        if time_s.ndim == 1 and values.shape == (time_s.size, n_columns):
            if self._correction is None:
                return time_s, values
            return self._correction(name, self._channels[name], time_s, values)
        self._unreadable[name] = self._unreadable.get(name, 0) + max(time_s.size, 1)
        if name == "wheels" and time_s.ndim == 1:
            return time_s, np.full((time_s.size, n_columns), np.nan)
        return None

    def _tick(self, time_s: float, wheel_speed_mps: Array) -> LiveSkidEstimate | None:
        resident = self._filter
        follows = resident.follows(time_s)
        if follows == 0:
            resident.step(time_s, np.full(len(self._model.rows), np.nan))  # to count it, and remember a leap
            return None
        wheel_speed_mps = np.where(np.isfinite(wheel_speed_mps), wheel_speed_mps, np.nan)
        left_mps, right_mps = wheel_speed_mps.tolist()
        gyro_radps = _gyro_of_tick(time_s, follows < 0, *self._queue, *self._gyro)
        rest_radps = rest_at(time_s, left_mps, right_mps, gyro_radps, self._rest)
        rows = np.array([left_mps, right_mps, gyro_radps, rest_radps])
        resident.step(time_s, rows)
        mean = within_bounds(resident.mean, self._robot.track_m)
        std = np.sqrt(self._variances)
        speed, turn, bias = self._at
        status = motion_at(
            time_s,
            left_mps,
            right_mps,
            not math.isnan(gyro_radps),
            mean[turn],
            std[bias],
            self._robot.track_m,
            self._motion,
        )
        if status != Motion.STUCK:
            self._stuck_since_s = math.nan
        elif math.isnan(self._stuck_since_s):
            self._stuck_since_s = time_s - STUCK_AFTER_S
        return LiveSkidEstimate(
            time_s,
            mean,
            std,
            mean.item(speed),
            mean.item(turn),
            Motion(status),
            self._stuck_since_s,
            wheel_speed_mps,
            rows,
        )


@njit(cache=True, error_model="numpy")
def _gyro_of_tick(
    time_s: float,
    set_back: bool,
    queue: Array,
    n_queued: Array,
    last_s: Array,
    counts: Array,
    before: Array,
    line: Array,
    sums: Array,
    limits: Array,
    latency_and_bias: Array,
) -> float:
    """Take from the queue what came by a tick of the wheels; return the gyro's row."""
    if set_back:
        n_queued[:] = 0
        last_s[:] = -np.inf
        line[:] = np.nan
        before[:] = np.nan
        sums[:] = 0.0
    latency_s, bias_radps = latency_and_bias
    n, n_due = n_queued[IMU], 0
    while n_due < n and queue[n_due, _STAMP] <= time_s + TICK_S:
        stamped = queue[n_due]
        n_due += 1
        came_s = stamped[_STAMP]
        last_s[IMU] = came_s
        if refused_as(IMU, stamped, before) >= 0:
            counts[IMU, _FROZEN] += 1
        elif take_gyro(stamped[_GYRO_Z] - bias_radps, came_s - latency_s, came_s, line, sums, limits):
            counts[IMU, _LEAP] += 1
    while n > n_due and queue[n - 1, _STAMP] > time_s + OFF_CLOCK_S:
        counts[IMU, _OFF_CLOCK] += 1
        n -= 1
    drop_first(queue, n_due, n)
    n_queued[IMU] = n - n_due
    return float(gyro_at(time_s, line, sums, limits))
