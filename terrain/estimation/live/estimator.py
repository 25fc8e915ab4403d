"""Live estimation of a swerve robot's motion and slip, sample by sample.

The chain of :func:`~terrain.estimation.measurements.batch.measurement_table` with ``causal=True``,
:func:`~terrain.estimation.ekf.filter.run_filter` and :func:`~terrain.estimation.wheel_slip.wheel_slip`, with
the same numbers, on memory of a fixed size.  Each sample of the wheels is a tick, whose estimate is returned
at once.  For what comes up to a quarter of a second late the estimator goes back to the tick before it
(:mod:`~terrain.estimation.live.history`).  Where the wheels give nothing, ticks go on by the caller's time.

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
from itertools import pairwise

import numpy as np

from terrain.entry_point import entry_point
from terrain.errors import ConfigError
from terrain.estimation.ekf.model import (
    GATE_PROBABILITY,
    REOPEN_AFTER_S,
    FilterModel,
    FilterSettings,
    Noise,
)
from terrain.estimation.ekf.resident import ResidentFilter
from terrain.estimation.ekf.state import in_one
from terrain.estimation.filters.swerve import make_filter
from terrain.estimation.filters.swerve_noise import default_noise, schedule_arrays
from terrain.estimation.live.clocks import numbers
from terrain.estimation.live.estimate import LiveEstimate, predicted
from terrain.estimation.live.history import History, Samples, Tick
from terrain.estimation.live.monitor import HealthMonitor, RowMemory
from terrain.estimation.live.rows import (
    KINDS,
    QUEUE,
    WHEEL_KINDS,
    RowArrays,
    check_numbers,
    counts_by_kind,
    described_limits,
    places_among,
    push,
)
from terrain.estimation.live.tick import TickOutput, TickPlaces, bound_tick, output_ends, slip_places
from terrain.estimation.measurements.derived import derived_memory
from terrain.estimation.measurements.frozen import frozen_memory
from terrain.estimation.measurements.samples import ROWS, STREAMS, params_of, row_memory
from terrain.estimation.measurements.table import GNSS_LATENCY_S, GNSS_ROWS
from terrain.estimation.measurements.yaw import yaw_memory
from terrain.estimation.wheel_slip import STALE_AFTER_S
from terrain.extension import Correction, RegionMonitor, check_corrected
from terrain.logs.schema import WHEELS_CHANNELS
from terrain.records import Array, Reading
from terrain.robots import Robot, SwerveRobot, as_drive

SETTINGS = FilterSettings(GATE_PROBABILITY, REOPEN_AFTER_S)  # those of the batch

CHANNELS: Mapping[str, tuple[str, ...]] = {"wheels": WHEELS_CHANNELS, **STREAMS}
"""Default channels of each stream."""

_push = entry_point(push)


class LiveEstimator:
    """Motion and slip from samples as they come.

    Parameters
    ----------
    robot : a swerve robot with motors, steering and sensors, and a camera for vio12 and vio15, corrected
    filter_name : one of :data:`~terrain.estimation.filters.swerve.FILTERS`
    channels : names of the columns of the streams that are read, in their order; those of the schema
    settings : when a measurement or a stamp is not believed
    noise : in place of the physical
    initial_yaw_rad : heading of the start in the world; without it the GNSS is not used
    gnss_latency_s : age of a position when it arrives
    correction : of :func:`terrain.extension.correct_live`

    Raises
    ------
    ConfigError
        if filter, robot and channels do not fit, the robot is not corrected, or a number is out of its range.
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
        check_numbers(initial_yaw_rad or 0.0, gnss_latency_s)
        has_gnss = initial_yaw_rad is not None and "gnss" in channels
        check_corrected(robot)
        self._channels, self._correction = channels, correction
        self._model = make_filter(filter_name, robot, with_gnss=has_gnss)
        self.name = self._model.name
        refusal = "robot {name} has the drive {drive!r}: the live estimator is for 'swerve'"
        robot = as_drive(SwerveRobot, robot, refusal)
        robot.require("motors", "steering", "sensors")
        scheduled = noise is None and bool(self._model.inputs)
        noise = default_noise(filter_name, robot, has_gnss) if noise is None else noise
        self._noise = schedule_arrays(self._model, noise, scheduled=scheduled)
        self._filter = ResidentFilter(self._model, noise, settings)
        self._robot, self._region = robot, RegionMonitor(robot)
        self._unreadable: dict[str, int] = {}
        self._connect(channels, has_gnss)
        self._prepare_rows(initial_yaw_rad or 0.0, gnss_latency_s)
        floats, counts = self._filter.buffers
        buffers = floats, self._row_buffer, self._monitor.buffer
        self._history = History(buffers, (counts, self._counts.reshape(-1), self._wheel_counts))
        self._prepare_tick()
        self._latest: LiveEstimate | None = None
        self._counted = {"came late": 0, "ticks without wheels": 0}

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
        self._current_columns = places_among(WHEELS_CHANNELS[3:], known)
        self._n_queued, self._last_s = np.zeros(len(STREAMS), np.int64), np.full(len(STREAMS), -np.inf)
        self._counts = np.zeros((len(STREAMS), len(KINDS)), np.int64)
        self._wheel_counts = np.zeros(len(WHEEL_KINDS), np.int64)
        self._queues = tuple(np.zeros((QUEUE, 2 + len(names))) for names in STREAMS.values())
        self._streams = [
            (name, stream, places_among(names, list(channels[name])), queue)
            for (stream, (name, names)), queue in zip(enumerate(STREAMS.items()), self._queues, strict=True)
            if name in read
        ]

    def _prepare_rows(self, initial_yaw_rad: float, gnss_latency_s: float) -> None:
        """Lay out what :func:`rows_at` is given: first what is fixed, then its memory."""
        robot = self._robot
        sensors = robot.sensors
        latency_s = np.zeros(len(STREAMS))
        latency_s[1:] = sensors.imu_latency_s, robot.completed.camera.latency_s, gnss_latency_s
        lines, turns, gnss = row_memory()
        moved = (
            *(self._last_s, np.full((2, 16), np.nan), turns, lines, yaw_memory(), gnss, derived_memory()),
            *(frozen_memory(), np.full((2, 3), -np.inf)),
        )
        self._row_buffer, views = in_one(moved)
        self._last_s, before, turns, lines, yaw, gnss, derived, frozen, received_s = views
        rows = RowMemory(lines, received_s, frozen, derived)
        self._monitor = HealthMonitor(robot, self._model, rows, self._n_columns["wheels"])
        z, gnss_variance, unmeasured = np.empty(len(ROWS)), np.empty(4), np.ones(3, dtype=np.bool_)
        given = (
            *(np.empty(3), *self._queues, self._n_queued, self._last_s, latency_s),
            *(params_of(robot, initial_yaw_rad), described_limits(robot)),
            *(before, turns, lines, yaw, gnss, derived, frozen, received_s),
            *(z, gnss_variance, unmeasured, self._counts, self._wheel_counts),
        )
        self._rows = RowArrays._make(given)
        self._inputs = [
            (name, stream, columns, (queue, self._n_queued, self._last_s, self._counts))
            for name, stream, columns, queue in self._streams
        ]
        self._period_s = 1.0 / sensors.wheels_rate_hz

    def _prepare_tick(self) -> None:
        """Bind the compiled tick to all that it moves."""
        model, robot = self._model, self._robot
        gnss = [i for i, row in enumerate(model.rows) if row in GNSS_ROWS]
        slip_states, positions_m, variance = slip_places(robot, model.states)
        motion = self._motion = [model.states.index(s) for s in LiveEstimate._fields[8:13]]
        ends = output_ends(len(model.states), len(ROWS))
        places = TickPlaces(
            *(self._motor_columns, self._current_columns, np.array(motion)),
            *(np.array([ROWS.index(row) for row in model.rows]), np.array(gnss, dtype=np.int64), ends),
            slip_states,
            positions_m,
            variance,
            robot.motors.reduction_ratio,
            robot.wheel_radius_m,
        )
        self._run_tick = bound_tick(
            self._filter,
            *(places, self._rows, self._noise, self._filter.arrays, self._monitor.arrays),
            self._history.memory,
        )
        self._written = [slice(*pair) for pair in pairwise(ends.tolist())]
        self._no_wheels = np.full(self._n_columns["wheels"], np.nan)

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
    def resident(self) -> ResidentFilter:
        """The filter's memory."""
        return self._filter

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind, and by what the filter did not believe."""
        counted = counts_by_kind(self._wheel_counts, self._counts) | self._counted
        counted |= {f"{name}: unreadable": n for name, n in self._unreadable.items()}
        return {kind: n for kind, n in (counted | dict(self._filter.dropped)).items() if n}

    @property
    def latest(self) -> LiveEstimate | None:
        """The estimate of the last tick, with all that has come since."""
        return self._latest

    def at(self, now_s: float) -> LiveEstimate | None:
        """Return the last estimate, its means predicted to a later time; None before the first tick."""
        seen = self._latest
        return None if seen is None else predicted(seen, self._model, self._motion, now_s, SETTINGS.max_gap_s)

    @property
    def health(self) -> dict[str, str]:
        """Health of each sensor at the last tick, by name."""
        return self._monitor.names

    def step(self, readings: Mapping[str, Reading], now_s: float | None = None) -> list[LiveEstimate]:
        """Take in what arrived, and return an estimate for each sample of the wheels that was taken.

        Parameters
        ----------
        readings : by stream; any may be missing, late, repeated or wrong, and other streams are not looked at
        now_s : the time by the clock of the stamps: a tick where the wheels have given nothing for one and a
            half of their periods

        Returns
        -------
        list of LiveEstimate
            in order of time, unless the clock of the wheels was set back.  A stamp that leaps by more than
            ``settings.max_gap_s`` is reported when the next one follows; what was late is in :attr:`latest`
        """
        history = self._history
        last_s = history.last_s
        came: dict[str, Samples] = {}
        late_s = self._queue_up(readings, came, last_s)
        taken = self._taken("wheels", readings, came)
        ticks = []
        if taken is not None:
            stamps, _, values = taken
            ticks = [Tick(*tick) for tick in zip(stamps, values, strict=True)]
            if ticks and stamps[0] <= last_s and history.last_measured_s < stamps[0]:
                late_s = min(late_s, self._late("wheels", stamps, last_s))
        if came:
            history.keep_samples(came, last_s)
        if late_s < math.inf:
            ticks = self._go_back(late_s, ticks)
        if now_s is not None and history.last_s > -math.inf:
            reached_s = ticks[-1].time_s if ticks else history.last_s
            if 1.5 * self._period_s < now_s - reached_s < SETTINGS.max_gap_s:
                ticks.append(Tick(now_s, None))
                self._counted["ticks without wheels"] += 1
        found = []
        for tick in ticks:
            estimate = self._tick(tick)
            if estimate is not None:
                self._latest = estimate
                if not tick.time_s <= last_s or estimate.time_s < last_s - SETTINGS.max_gap_s:
                    found.append(estimate)
        return found

    def _queue_up(self, readings: Mapping[str, Reading], came: dict[str, Samples], last_s: float) -> float:
        """Queue the samples of all streams but the wheels; return the instant to go back to, or infinity."""
        late_s = math.inf
        for name, stream, columns, fixed in self._inputs:
            taken = self._taken(name, readings, came)
            if taken is None:
                continue
            stamps, time_s, values = taken
            if stamps and min(stamps) <= last_s and (late := self._late(name, stamps, last_s)) < math.inf:
                late_s = min(late_s, late)
            else:
                _push(stream, time_s, values, columns, *fixed)
        return late_s

    def _taken(self, name: str, readings: Mapping[str, Reading], came: dict[str, Samples]) -> Samples | None:
        """Return what came of a stream, noted where it has stamps to go back to; None where nothing did."""
        reading = readings.get(name)
        arrays = None if reading is None else self._arrays(name, reading)
        if arrays is None:
            return None
        stamps: list[float] = arrays[0].tolist()
        taken = stamps, *arrays
        if stamps and math.isfinite(sum(stamps)):
            came[name] = taken
        return taken

    def _late(self, name: str, stamps: list[float], last_s: float) -> float:
        """Return the instant to go back to for late samples, infinite where there is none that is new."""
        known = self._history.stamps(name)
        late = [stamp_s for stamp_s in stamps if stamp_s <= last_s and stamp_s not in known]
        if not late or not self._history.reaches(min(late)):
            return math.inf
        self._counted["came late"] += 1
        return min(late)

    def _go_back(self, late_s: float, ticks: list[Tick]) -> list[Tick]:
        """Put the memory back before an instant; return the ticks to be done again, with new ones."""
        undone = self._history.back_to(late_s)
        self._n_queued[:] = 0
        for name, stream, columns, fixed in self._inputs:
            later = self._history.since(name, float(self._last_s[stream]))
            if later is not None:
                push(stream, *later, columns, *fixed)
        measured = {tick.time_s: tick for tick in (*ticks, *undone) if tick.wheels is not None}
        reached_s = max(measured, default=-math.inf) + 1.5 * self._period_s  # none was due before
        spare = [tick for tick in undone if tick.wheels is None and tick.time_s > reached_s]
        return sorted([*measured.values(), *spare], key=lambda tick: tick.time_s)

    def _arrays(self, name: str, reading: Reading) -> tuple[Array, Array] | None:
        """Return stamps and values; values that do not fit are unknown, stamps that do not are nothing."""
        try:
            time_s, values = numbers(reading[0]), numbers(reading[1])
        except (TypeError, ValueError, LookupError):
            time_s = values = None
        if time_s is None or values is None:
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

    def _tick(self, tick: Tick) -> LiveEstimate | None:
        time_s, wheels = tick
        written, history = np.empty(self._written[-1].stop), self._history
        taken = self._run_tick(time_s, self._no_wheels if wheels is None else wheels, history.slot, written)
        if taken == 0:
            return None
        out = TickOutput(*[written[part] for part in self._written])
        if taken < 0:
            history.clear()
        history.keep_tick(tick)
        v_x, v_y, turn, a_x, a_y, age_s = out.motion_and_age.tolist()
        if self._region.compares:
            self._region.step(time_s, float(out.wheel_speed_mps.mean()), turn)
        return LiveEstimate(
            time_s,
            out.mean,
            out.std,
            out.slip_ratio,
            out.slip_std,
            age_s > STALE_AFTER_S,
            age_s,
            out.rows,
            v_x,
            v_y,
            turn,
            a_x,
            a_y,
            out.motor_radps,
            out.current_a,
            out.wheel_speed_mps,
            self._monitor.health.copy(),
        )
