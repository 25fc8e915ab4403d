"""Live estimation of a swerve robot's motion and slip, sample by sample.

The chain of :func:`~terrain.estimation.measurements.batch.measurement_table` with ``causal=True``,
:func:`~terrain.estimation.ekf.filter.run_filter` and :func:`~terrain.estimation.wheel_slip.wheel_slip`, with
the same numbers, on memory of a fixed size.  Each sample of the wheels is a tick, whose estimate is returned
at once; nothing waits for a sensor that is late.

What differs from the batch is what has to look ahead there:

- a camera or IMU that repeats itself is left out from the first repetition on; the batch spares repetitions
  shorter than ``FROZEN_S``;
- of stamps out of order the one goes that the next sample shows to be wrong; the batch keeps the longest
  rise.  A stamp of the wheels that is ahead by less than ``max_gap_s`` is taken, and those up to it are not;
- periods are those of the robot's description; the batch takes the log's medians;
- positions count from the first of all, also where a better one comes later.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation.ekf.model import GATE_PROBABILITY, REOPEN_AFTER_S, FilterModel, FilterSettings, Noise
from terrain.estimation.ekf.resident import ResidentFilter
from terrain.estimation.filters.swerve import make_filter
from terrain.estimation.filters.swerve_noise import default_noise
from terrain.estimation.live.rows import KINDS, QUEUE, WHEEL_KINDS, push, rows_at
from terrain.estimation.measurements.samples import ROWS, STREAMS, limits_of_rows, params_of, row_memory
from terrain.estimation.measurements.table import GNSS_LATENCY_S, GNSS_ROWS
from terrain.estimation.measurements.yaw import yaw_memory
from terrain.estimation.wheel_slip import STALE_AFTER_S, instant_slip, wheel_speed_scatter_mps
from terrain.extension import Correction, RegionMonitor, check_corrected
from terrain.logs.schema import WHEELS_CHANNELS
from terrain.records import Array, Reading
from terrain.robots import Robot, as_swerve

GNSS_PERIOD_S = 0.1
"""Between two positions; no robot's description tells it."""

SETTINGS = FilterSettings(GATE_PROBABILITY, REOPEN_AFTER_S)
"""Those of the batch."""

CHANNELS: Mapping[str, tuple[str, ...]] = {"wheels": WHEELS_CHANNELS, **STREAMS}
"""Default channels of each stream."""


class LiveEstimate(NamedTuple):
    """What is believed at one tick; arrays are the caller's to keep.

    Parameters
    ----------
    time_s : stamp of the wheels
    mean, std : (d,) states and their standard deviations, in the order of :attr:`LiveEstimator.states`
    slip_ratio, slip_std : (3,) NaN where unknown or where the wheel stands
    slip_stale : whether the speed over ground was not measured lately
    reference_age_s : time since it was; infinite before the first time
    rows : (18,) what was measured, in the order of ``ROWS_OF_DRIVE["swerve"]``; NaN where nothing was
    speed_x_mps, speed_y_mps, yaw_rate_radps, accel_x_mps2, accel_y_mps2 : of the states, by name
    motor_radps, current_a : (3,) of this sample of the wheels
    wheel_speed_mps : (3,) circumferential speeds of that sample
    """

    time_s: float
    mean: Array
    std: Array
    slip_ratio: Array
    slip_std: Array
    slip_stale: bool
    reference_age_s: float
    rows: Array
    speed_x_mps: float
    speed_y_mps: float
    yaw_rate_radps: float
    accel_x_mps2: float
    accel_y_mps2: float
    motor_radps: Array
    current_a: Array
    wheel_speed_mps: Array


class LiveEstimator:
    """Motion and slip from samples as they come.

    Parameters
    ----------
    robot : a swerve robot with motors, steering and sensors, and a camera for vio12 and vio15, corrected
    filter_name : one of :data:`~terrain.estimation.filters.swerve.FILTERS`
    channels : names of the columns of each stream's readings, in their order; by default those of the schema.
        A stream that is not named is not read
    settings : when a measurement or a stamp is not believed
    noise : in place of the physical
    initial_yaw_rad : heading of the start in the world; without it the GNSS is not used
    gnss_latency_s : age of a position when it arrives
    correction : takes the effects of an extended robot off what arrives, see
        :func:`terrain.extension.correct_live`

    Raises
    ------
    ConfigError
        if the filter does not fit the robot, the robot is not corrected, a section of its description is
        missing, the wheels' channels are not among those named, or a number is out of its range.
    DataError
        if the noise does not fit the filter.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> estimator = LiveEstimator(load_robot("agrimaro"))
    >>> wheels = Reading(np.array([0.0]), np.array([[20.0, 20.0, 20.0, 1.0, 1.0, 1.0]]))
    >>> estimate, = estimator.step({"wheels": wheels})
    >>> estimate.wheel_speed_mps, estimate.slip_stale
    (array([0.4, 0.4, 0.4]), True)
    """

    def __init__(
        self,
        robot: Robot,
        filter_name: str = "vio15",
        channels: Mapping[str, tuple[str, ...]] = CHANNELS,
        settings: FilterSettings = SETTINGS,
        *,
        noise: Noise | None = None,
        initial_yaw_rad: float | None = None,
        gnss_latency_s: float = GNSS_LATENCY_S,
        correction: Correction | None = None,
    ) -> None:
        for name, value in (("initial_yaw_rad", initial_yaw_rad or 0.0), ("gnss_latency_s", gnss_latency_s)):
            if not math.isfinite(value):
                raise ConfigError(f"{name} is {value}, a finite number is required")
        if gnss_latency_s < 0:
            raise ConfigError(f"gnss_latency_s is {gnss_latency_s:g}, a time from zero up is required")
        has_gnss = initial_yaw_rad is not None and "gnss" in channels
        check_corrected(robot)
        self._channels, self._correction = channels, correction
        self._model = make_filter(filter_name, robot, with_gnss=has_gnss)
        robot = as_swerve(robot, "robot {name} has the drive {drive!r}: the live estimator is for 'swerve'")
        robot.require("motors", "steering", "sensors")
        noise = default_noise(filter_name, robot, has_gnss) if noise is None else noise
        self._filter = ResidentFilter(self._model, noise, settings)
        self._robot, self._region = robot, RegionMonitor(robot)
        self._unreadable: dict[str, int] = {}
        self._connect(channels, has_gnss)
        self._prepare_rows(initial_yaw_rad or 0.0, gnss_latency_s)
        self._prepare_filter(noise)

    def _connect(self, channels: Mapping[str, tuple[str, ...]], has_gnss: bool) -> None:
        """Find each channel's column, and lay out the queues."""
        known = list(channels.get("wheels", ()))
        lacking = [channel for channel in WHEELS_CHANNELS[:3] if channel not in known]
        if lacking:
            raise ConfigError(f"channels of 'wheels' are {known}: {lacking[0]!r} must be among them")
        read = [name for name in STREAMS if name in channels and (name != "gnss" or has_gnss)]
        if "odometry" in read and not self._robot.describes("camera"):
            read.remove("odometry")
        self._n_columns = {name: len(channels[name]) for name in ("wheels", *read)}
        self._motor_columns = np.array([known.index(channel) for channel in WHEELS_CHANNELS[:3]])
        self._current_columns = np.array([_place(known, channel) for channel in WHEELS_CHANNELS[3:]])
        self._n_queued, self._last_s = np.zeros(len(STREAMS), np.int64), np.full(len(STREAMS), -np.inf)
        self._counts = np.zeros((len(STREAMS), len(KINDS)), np.int64)
        self._wheel_counts = np.zeros(len(WHEEL_KINDS), np.int64)
        self._queues = tuple(np.zeros((QUEUE, 2 + len(names))) for names in STREAMS.values())
        self._inputs = []
        for stream, (name, names) in enumerate(STREAMS.items()):
            if name in read:
                columns = np.array([_place(list(channels[name]), channel) for channel in names])
                fixed = (self._queues[stream], self._n_queued, self._last_s, self._counts)
                self._inputs.append((name, stream, columns, fixed))

    def _prepare_rows(self, initial_yaw_rad: float, gnss_latency_s: float) -> None:
        """Lay out what :func:`rows_at` is given: first what is fixed, then its memory."""
        robot = self._robot
        motors, sensors = robot.motors, robot.sensors
        latency_s = np.zeros(len(STREAMS))
        latency_s[1:] = sensors.imu_latency_s, robot.completed.camera.latency_s, gnss_latency_s
        self._motor_radps, self._z, self._gnss_variance = np.empty(3), np.empty(len(ROWS)), np.empty(4)
        self._unmeasured = np.ones(3, dtype=np.bool_)
        lines, turns, gnss = row_memory()
        self._row_memory = (
            self._motor_radps,
            *self._queues,
            *(self._n_queued, self._last_s, latency_s, params_of(robot, initial_yaw_rad), _limits(robot)),
            *(np.full((2, 16), np.nan), turns, lines, yaw_memory(), gnss, np.full((2, 3), -np.inf)),
            *(self._z, self._gnss_variance),
            *(self._unmeasured, self._counts, self._wheel_counts),
        )
        self._reduction_ratio, self._radius_m = motors.reduction_ratio, robot.wheel_radius_m

    def _prepare_filter(self, noise: Noise) -> None:
        model, robot = self._model, self._robot
        self._columns = np.array([ROWS.index(row) for row in model.rows])
        places = [row for row in model.rows if row in GNSS_ROWS]
        self._variance = np.array(noise.measurement_variance) if places else None
        self._gnss_places = np.array([model.rows.index(row) for row in places], dtype=np.int64)
        self._unknown = np.full(len(model.rows), np.nan)
        named = [f"slip_speed_{i}_mps" for i in robot.wheels]
        steered = [f"steer_{i}_rad" for i in robot.wheels]
        states = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", *steered, *named)
        self._in_state = named[0] in model.states
        at = np.array([_place(list(model.states), state) for state in states])
        self._slip = np.empty((2, len(robot.wheels)))
        self._places_m, self._at = np.array(robot.wheel_positions_m), at
        self._wheel_speed_variance = wheel_speed_scatter_mps(robot) ** 2
        self._motion = [model.states.index(s) for s in LiveEstimate._fields[8:13]]
        self._variances = self._filter.cov.reshape(-1)[:: len(model.states) + 1]

    @property
    def model(self) -> FilterModel:
        """The filter."""
        return self._model

    @property
    def states(self) -> tuple[str, ...]:
        """Name of each state, in the order of ``mean`` and ``std``."""
        return self._model.states

    @property
    def lag_s(self) -> float:
        """Delay of every estimate: each row follows the low-pass of the encoders' rates."""
        return self._robot.sensors.encoder_time_constant_s

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind, and by what the filter did not believe."""
        counts: list[tuple[str, tuple[str, ...], Array]] = [("wheels", WHEEL_KINDS, self._wheel_counts)]
        counts += [(name, KINDS, row) for name, row in zip(STREAMS, self._counts, strict=True)]
        counted = {
            f"{name}: {kind}": n
            for name, kinds, row in counts
            for kind, n in zip(kinds, row.tolist(), strict=True)
        }
        counted |= {f"{name}: unreadable": n for name, n in self._unreadable.items()}
        return {kind: n for kind, n in (counted | dict(self._filter.dropped)).items() if n}

    def step(self, readings: Mapping[str, Reading]) -> list[LiveEstimate]:
        """Take in what arrived, and return an estimate for each sample of the wheels that was taken.

        Parameters
        ----------
        readings : by stream; any may be missing, late, repeated or wrong, and other streams are not looked at

        Returns
        -------
        list of LiveEstimate
            in order of time, unless the clock of the wheels was set back.  A stamp that leaps by more than
            ``settings.max_gap_s`` is accepted, and reported, when the next one follows it.
        """
        for name, stream, columns, fixed in self._inputs:
            reading = readings.get(name)
            if reading is not None:
                arrays = self._arrays(name, reading)
                if arrays is not None:
                    push(stream, *arrays, columns, *fixed)
        wheels = readings.get("wheels")
        arrays = None if wheels is None else self._arrays("wheels", wheels)
        if arrays is None:
            return []
        ticks = zip(arrays[0].tolist(), arrays[1], strict=True)
        estimates = (self._tick(time_s, values) for time_s, values in ticks)
        return [estimate for estimate in estimates if estimate is not None]

    def _arrays(self, name: str, reading: Reading) -> tuple[Array, Array] | None:
        """Return stamps and values; values that do not fit are unknown, stamps that do not are nothing."""
        try:
            time_s = np.asarray(reading[0], dtype=np.float64)
            values = np.asarray(reading[1], dtype=np.float64)
        except (TypeError, ValueError, LookupError):
            self._unreadable[name] = self._unreadable.get(name, 0) + 1
            return None
        if time_s.ndim == 1 and values.shape == (time_s.size, self._n_columns[name]):
            if self._correction is not None:
                return self._correction(name, self._channels[name], time_s, values)
            return time_s, values
        self._unreadable[name] = self._unreadable.get(name, 0) + max(time_s.size, 1)
        if name == "wheels" and time_s.ndim == 1:
            return time_s, np.full((time_s.size, self._n_columns[name]), np.nan)
        return None

    def _tick(self, time_s: float, wheels: Array) -> LiveEstimate | None:
        follows = self._filter.follows(time_s)
        z, resident = self._z, self._filter
        if follows == 0:
            resident.step(time_s, self._unknown)  # for it to count, and to remember a leap
            return None
        motor_radps = wheels[self._motor_columns]
        self._motor_radps[:] = motor_radps
        rows_at(time_s, follows < 0, *self._row_memory)
        if self._variance is not None:
            self._variance[self._gnss_places] = self._gnss_variance
        resident.step(time_s, z[self._columns], self._variance)
        age_s = resident.reference_age_s
        slip = self._slip_at(age_s)
        mean = resident.mean.copy()
        v_x, v_y, turn, a_x, a_y = self._motion
        current_a = wheels[self._current_columns]
        current_a[self._current_columns < 0] = np.nan
        wheel_speed_mps = motor_radps / self._reduction_ratio * self._radius_m
        if self._region.compares:
            self._region.step(time_s, float(wheel_speed_mps.mean()), mean.item(turn))
        return LiveEstimate(
            time_s,
            mean,
            np.sqrt(self._variances),
            slip[0],
            slip[1],
            bool(age_s > STALE_AFTER_S),
            age_s,
            z.copy(),
            mean.item(v_x),
            mean.item(v_y),
            mean.item(turn),
            mean.item(a_x),
            mean.item(a_y),
            motor_radps,
            current_a,
            wheel_speed_mps,
        )

    def _slip_at(self, age_s: float) -> Array:
        """Return ratio and standard deviation (2, wheels) of the slip: ``wheel_slip`` of one tick."""
        if math.isinf(age_s) or (age_s > STALE_AFTER_S and not self._in_state):
            return np.full_like(self._slip, np.nan)
        resident, wheel_speed_mps = self._filter, self._z[:3] * self._radius_m
        slip = np.empty_like(self._slip)
        instant_slip(
            resident.mean,
            resident.cov,
            self._places_m,
            self._at,
            wheel_speed_mps,
            self._wheel_speed_variance,
            slip,
        )
        slip[:, self._unmeasured] = np.nan
        return slip


def _place(names: list[str], name: str) -> int:
    return names.index(name) if name in names else -1


def _limits(robot: Robot) -> Array:
    """Return the limits (18, 6) of the rows, by the described periods."""
    sensors = robot.sensors
    lag_s = dict.fromkeys(STREAMS, sensors.encoder_time_constant_s)
    period_s = {
        "imu": 1.0 / sensors.imu_rate_hz,
        "steering": 1.0 / sensors.steering_rate_hz,
        "gnss": GNSS_PERIOD_S,
    }
    if robot.describes("camera"):
        lag_s["odometry"] = max(sensors.encoder_time_constant_s - robot.camera.time_constant_s, 0.0)
        period_s["odometry"] = 1.0 / robot.camera.rate_hz
    return limits_of_rows(lag_s, period_s, 1.0 / sensors.wheels_rate_hz)
