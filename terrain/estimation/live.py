"""Live estimation of a robot's motion and slip, sample by sample, by any filter or observer.

The chain of a whole log, :func:`~terrain.estimation.feed.measurement_table` with ``causal=True`` and
:func:`~terrain.estimation.filter.run_filter`, or :func:`~terrain.estimation.models.observer.rows_of` and
:func:`~terrain.estimation.models.observer.observe`, with the same numbers, on memory of a fixed size.  Each sample of
the wheels is a tick, whose estimate is known at once (:attr:`Live.latest`).  For what comes up to a quarter of a second
late the estimator goes back to the tick before it, and takes all that has come since once more, in order: the same
numbers as if nothing had been late.  Where the wheels give nothing, a filter's ticks go on by the caller's time.

An estimate **settles** when every stream that comes has reached its tick, or when nothing that is later is taken
any more: from then on it does not change.  :meth:`Live.step` returns those that have settled, so that windows are
made of the same numbers over a bad link as over a good one.

What differs from the batch is what has to look ahead there: a camera or IMU that repeats itself is left out from the
first repetition on (the batch leaves repetitions shorter than ``FROZEN_S`` in); of stamps out of order the one goes
that the next sample shows to be wrong (the batch keeps the longest rise), and a stamp of the wheels that is ahead by
less than ``max_gap_s`` is taken, and those up to it are not; periods are those of the robot's description (the batch
takes the log's medians); positions count from the first of all, also where a better one comes later.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation import feed as rows
from terrain.estimation.clocks import REWIND_S, numbers
from terrain.estimation.feed import (
    GNSS_LATENCY_S,
    GNSS_PERIOD_S,
    GNSS_ROWS,
    OFF_CLOCK_S,
    ROWS,
    STREAMS,
    TICK_S,
    Due,
    SampleQueue,
    check_channels,
    places_among,
)
from terrain.estimation.filter import GATE_PROBABILITY, REOPEN_AFTER_S, Filter, FilterSettings, Noise
from terrain.estimation.health import HealthMonitor
from terrain.estimation.models.choice import OBSERVERS, make_observer
from terrain.estimation.models.observer import Observer, ObserverFeed, ObserverStatus
from terrain.estimation.models.skid import (
    Motion,
    make_skid_filter,
    motion_at,
    motion_memory,
    skid_noise,
    within_bounds,
)
from terrain.estimation.models.swerve import Schedule, default_noise, make_filter
from terrain.estimation.wheel_slip import STALE_AFTER_S, SlipOfInstant
from terrain.extension import Correction, RegionMonitor, check_corrected
from terrain.logs.schema import ESTIMATOR_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array, Reading
from terrain.robots import Robot

SETTINGS = FilterSettings(GATE_PROBABILITY, REOPEN_AFTER_S)  #: Those of the batch.
#: Default channels of each stream of a swerve robot.
CHANNELS: Mapping[str, tuple[str, ...]] = {"wheels": WHEELS_CHANNELS, **STREAMS}
#: States that are of a sensor, and stay what they are while the robot does anything.
BIASES = ("gyro_bias_radps", "accel_bias_x_mps2", "accel_bias_y_mps2")
N_TICKS = 64  #: Most ticks that are remembered; at 200 Hz a little more than :data:`REWIND_S`.
N_STEPS = 1024  #: Most steps whose samples are remembered, where no tick says that they are old.
LATE_PERIODS = 1.5  #: So many periods without wheels make a tick without them.

_JUST_BEFORE_S = 1e-6
_MOTION = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2")

Samples = tuple[list[float], Array, Array]  #: Stamps, twice, and values of a stream.


class LiveEstimate(NamedTuple):
    """What is believed at one tick; arrays are the caller's to keep, and NaN where something is not known."""

    time_s: float  #: stamp of the wheels
    mean: Array  #: (d,) states and their standard deviations, in the order of :attr:`LiveFilter.states`
    std: Array
    slip_ratio: Array  #: (wheels,) NaN where unknown or where the wheel stands
    slip_std: Array
    slip_stale: bool  #: whether the speed over ground was not measured lately
    reference_age_s: float  #: time since it was; infinite before the first time
    rows: Array  #: (32,) what was measured, in the order of :data:`~terrain.estimation.feed.ROWS`
    speed_x_mps: float  #: of the states, by name; of a robot that skids the speed is that of its wheels
    speed_y_mps: float
    yaw_rate_radps: float
    accel_x_mps2: float
    accel_y_mps2: float
    motor_radps: Array  #: (wheels,) of this sample of the wheels
    current_a: Array
    wheel_speed_mps: Array  #: (wheels,) circumferential speeds of that sample
    #: (13,) of the sensors of a swerve robot, as :class:`~terrain.estimation.health.Health`, in the order of
    #: :data:`~terrain.estimation.health.SENSORS`; of others (0,)
    health: Array
    motion: Motion = Motion.UNKNOWN  #: what is known of the motion of a robot that skids; UNKNOWN of others
    stuck_since_s: float = math.nan  #: when the robot became stuck; NaN where it is not


class Tick(NamedTuple):
    """A tick that is done: its stamp, and the sample of the wheels (c,), None where they gave none."""

    time_s: float
    wheels: Array | None


class _History:
    """The last ticks with a snapshot of all that was remembered after each, and the last samples of each stream.

    The first tick is none: what was remembered before any.
    """

    def __init__(self, snapshot: Callable[[], Any], restore: Callable[[Any], None]) -> None:
        self._snapshot, self._restore = snapshot, restore
        self._ticks: deque[tuple[Tick, Any]] = deque(maxlen=N_TICKS)
        self._samples: deque[tuple[float, dict[str, Samples]]] = deque(maxlen=N_STEPS)
        self.add_tick(Tick(-math.inf, None))

    def add_samples(self, came: dict[str, Samples], now_s: float) -> None:
        """Remember what came of each stream at a step, and drop what is old."""
        samples = self._samples
        samples.append((max([stamps[-1] for stamps, _, _ in came.values()]), came))
        while samples and not samples[0][0] > now_s - 2.0 * REWIND_S:
            samples.popleft()

    def add_tick(self, tick: Tick) -> None:
        """Remember a tick that was just done."""
        self._ticks.append((tick, self._snapshot()))

    def stamps(self, stream: str) -> set[float]:
        """Return the stamps of a stream that came."""
        return {stamp_s for _, came in self._samples if stream in came for stamp_s in came[stream][0]}

    @property
    def last_s(self) -> float:
        """Stamp of the last tick; minus infinity before the first."""
        return self._ticks[-1][0].time_s if self._ticks else -math.inf

    @property
    def last_measured_s(self) -> float:
        """Stamp of the last tick at which the wheels gave a sample."""
        return next((tick.time_s for tick, _ in reversed(self._ticks) if tick.wheels is not None), -math.inf)

    def reaches(self, time_s: float) -> bool:
        """Say whether it is possible to go back before an instant."""
        return bool(self._ticks) and time_s - TICK_S > max(self._ticks[0][0].time_s, self.last_s - REWIND_S)

    def go_back(self, time_s: float) -> list[Tick]:
        """Go back to what was remembered at the last tick before an instant; return the ticks after it."""
        later: list[Tick] = []
        while self.last_s >= time_s - TICK_S:
            later.append(self._ticks.pop()[0])
        self._restore(self._ticks[-1][1])
        return later[::-1]

    def since(self, stream: str, time_s: float) -> tuple[Array, Array] | None:
        """Return the samples of a stream that are stamped after an instant, in order, each stamp once."""
        steps = [came[stream] for _, came in self._samples if stream in came]
        blocks = [(at_s, values) for stamps, at_s, values in steps if max(stamps) > time_s]
        if not blocks:
            return None
        stamps, values = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        later = np.flatnonzero(stamps > time_s)
        _, first = np.unique(stamps[later], return_index=True)
        return stamps[later][first], values[later][first]

    def clear(self) -> None:
        """Drop all: the clock was set back."""
        self._ticks.clear()
        self._samples.clear()


class Live(ABC):
    """What takes the samples of a robot as they come: a queue a stream, ticks, and the rewind for what is late.

    Attributes
    ----------
    latest : the last estimate; None before the first tick
    too_late : tick at which samples came last that were too late to be taken, and by how much
    filter : what is known of it may be kept over a restart; None of an observer, which starts from its first samples
    """

    filter: Filter | None
    name: str  #: of the filter or observer
    states: tuple[str, ...]  #: name of each state, in the order of ``mean`` and ``std``
    health: Mapping[str, str] = MappingProxyType(
        {}
    )  #: of each sensor at the last tick; empty where none is judged
    latest: Any
    _ticks_without_wheels = False  #: whether time goes on where the wheels give nothing

    def __init__(
        self,
        channels: Mapping[str, tuple[str, ...]],
        queues: Mapping[str, SampleQueue],
        period_s: float,
        correction: Correction | None,
    ) -> None:
        self._channels, self._queues, self._correction = channels, dict(queues), correction
        self._n_columns = {name: len(channels[name]) for name in ("wheels", *queues)}
        self._no_wheels, self._period_s = np.full(len(channels["wheels"]), np.nan), period_s
        self._history = _History(self._snapshot, self._restore)
        self.latest = None
        self._unsettled: deque[Any] = deque()
        self._settled_s = -math.inf
        self._newest_s: dict[str, float] = {}
        self._counted: Counter[str] = Counter()
        self._leapt: Tick | None = None  # not believed yet: its stamp is far ahead
        self.too_late = -math.inf, math.nan

    @abstractmethod
    def _follows(self, time_s: float) -> int:
        """Return what a stamp of the wheels is: 1 taken, -1 of a clock set back, 0 not taken, and counted."""

    @abstractmethod
    def _forget(self) -> None:
        """Begin anew after a clock was set back."""

    @abstractmethod
    def _last_taken_s(self, name: str) -> float:
        """Return the stamp of the last sample of a stream that was taken out of its queue."""

    @abstractmethod
    def _estimate(self, time_s: float, wheels: Array, due: Mapping[str, Due]) -> Any:
        """Do a tick: take the samples that are due, and return what is known then."""

    @abstractmethod
    def _snapshot(self) -> Any:
        """Return all that is remembered."""

    @abstractmethod
    def _restore(self, memory: Any) -> None:
        """Go back to a snapshot."""

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind, and by what the filter did not believe."""
        counts = dict(self._counted)
        for name, queue in self._queues.items():
            counts |= {f"{name}: {kind}": n for kind, n in queue.counts.items()}
        return counts

    def step(self, readings: Mapping[str, Reading], now_s: float | None = None) -> list[Any]:
        """Take in what arrived, and return the estimates at samples of the wheels that have settled.

        They are in order of time, unless the clock of the wheels was set back.  A stamp that jumps by more than
        ``settings.max_gap_s`` is accepted, and reported, when the next one follows it.

        Parameters
        ----------
        readings : by stream; any may be missing, late, repeated or wrong, and other streams are not looked at
        now_s : the time by the clock of the stamps: a tick where the wheels have given nothing for one and a
            half of their periods
        """
        if not isinstance(readings, Mapping):
            readings = {}
        history, last_s, late_s = self._history, self._history.last_s, math.inf
        came: dict[str, Samples] = {}
        ticks = []
        for name in (*self._queues, "wheels"):
            taken = self._taken(name, readings, came)
            if taken is None:
                continue
            stamps, time_s, values = taken
            if name != "wheels":
                late = (
                    self._late(name, stamps, last_s)
                    if stamps and min(stamps) <= last_s + TICK_S
                    else math.inf
                )
                late_s = min(late_s, late)
                if late == math.inf:
                    self._queues[name].push(time_s, values, self._last_taken_s(name))
                continue
            ticks = [Tick(*tick) for tick in zip(stamps, values, strict=True)]
            if ticks and stamps[0] <= last_s and history.last_measured_s < stamps[0]:
                late_s = min(late_s, self._late("wheels", stamps, last_s))
        if came:
            history.add_samples(came, last_s)
            for name, (stamps, _, _) in came.items():
                if stamps[-1] <= last_s + OFF_CLOCK_S or last_s == -math.inf:  # else its clock jumped
                    self._newest_s[name] = max(stamps[-1], self._newest_s.get(name, -math.inf))
        if late_s < math.inf:
            ticks = self._go_back(late_s, ticks)
        if self._ticks_without_wheels and now_s is not None and history.last_s > -math.inf:
            reached_s = ticks[-1].time_s if ticks else history.last_s
            if LATE_PERIODS * self._period_s < now_s - reached_s < SETTINGS.max_gap_s:
                ticks.append(Tick(now_s, None))
                self._counted["ticks without wheels"] += 1
        settled: list[Any] = []
        for tick in ticks:
            estimate = self._tick(tick, settled)
            if estimate is not None:
                self.latest = estimate
                if tick.wheels is not None and tick.time_s > self._settled_s:
                    self._unsettled.append(estimate)
        return settled + self.settle()

    def settle(self, *, all_of_them: bool = False) -> list[Any]:
        """Return the estimates that have settled since the last call, or all that are there, at a log's end."""
        if not self._unsettled:
            return []
        last_s, first_s, reached_s = self._history.last_s, self._unsettled[0].time_s, math.inf
        for name in self._n_columns:
            newest_s = self._newest_s.setdefault(name, first_s - _JUST_BEFORE_S)
            if newest_s > last_s - REWIND_S:  # one that stopped, or does not begin, is waited for no longer
                reached_s = min(reached_s, newest_s)
        reached_s = math.inf if all_of_them else max(reached_s, last_s - REWIND_S)
        settled = []
        while self._unsettled and self._unsettled[0].time_s <= reached_s + TICK_S:
            settled.append(self._unsettled.popleft())
            self._settled_s = settled[-1].time_s
        return settled

    def _taken(self, name: str, readings: Mapping[str, Reading], came: dict[str, Samples]) -> Samples | None:
        """Return what came of a stream, noted where it has stamps to go back to; None where nothing did.

        Values that do not fit are unknown, stamps that do not are nothing.
        """
        reading = readings.get(name)
        if reading is None or name not in self._n_columns:
            return None
        try:
            time_s, values = numbers(reading[0]), numbers(reading[1])
        except (TypeError, ValueError, LookupError):
            time_s = values = None
        if time_s is None or values is None:
            self._counted[f"{name}: unreadable"] += 1
            return None
        if time_s.ndim != 1 or values.shape != (time_s.size, self._n_columns[name]):
            self._counted[f"{name}: unreadable"] += max(time_s.size, 1)
            if name != "wheels" or time_s.ndim != 1:
                return None
            values = np.full((time_s.size, self._n_columns[name]), np.nan)
        elif self._correction is not None:
            time_s, values = self._correction(name, self._channels[name], time_s, values)
        stamps: list[float] = time_s.tolist()
        taken = stamps, time_s, values
        if stamps and math.isfinite(sum(stamps)):
            came[name] = taken
        return taken

    def _late(self, name: str, stamps: list[float], last_s: float) -> float:
        """Return the instant to go back to for late samples, infinite where there is none that is new."""
        known = self._history.stamps(name)
        late_s = min(
            (at_s for at_s in stamps if at_s <= last_s + TICK_S and at_s not in known), default=math.inf
        )
        if late_s == math.inf:
            return math.inf
        if not self._history.reaches(late_s):
            self.too_late = last_s, last_s - late_s
            return math.inf
        self._counted["came late"] += 1
        return late_s

    def _go_back(self, late_s: float, ticks: list[Tick]) -> list[Tick]:
        """Put the memory back before an instant; return the ticks to be done again, with new ones."""
        done = self._history.go_back(late_s)
        for name, queue in self._queues.items():
            queue.waiting.clear()
            later = self._history.since(name, self._last_taken_s(name))
            if later is not None:
                queue.push(*later, self._last_taken_s(name))
        first_s = done[0].time_s if done else math.inf
        while self._unsettled and self._unsettled[-1].time_s >= first_s:
            self._unsettled.pop()
        measured = {tick.time_s: tick for tick in (*ticks, *done) if tick.wheels is not None}
        reached_s = max(measured, default=-math.inf) + LATE_PERIODS * self._period_s  # none was due before
        spare = [tick for tick in done if tick.wheels is None and tick.time_s > reached_s]
        return sorted([*measured.values(), *spare], key=lambda tick: tick.time_s)

    def _tick(self, tick: Tick, settled: list[Any]) -> Any:
        """Do a tick; what was not settled before a clock was set back has settled."""
        follows, leapt = self._follows(tick.time_s), self._leapt
        self._leapt = None
        if follows == 0:
            self._leapt = tick if math.isfinite(tick.time_s) else None
            return None
        if follows < 0:
            settled += self._unsettled
            self._unsettled.clear()
            self._newest_s.clear()
            self._settled_s = -math.inf
            self._forget()
            for queue in self._queues.values():
                queue.waiting.clear()
        elif (
            leapt is not None
            and self._history.last_s < leapt.time_s < tick.time_s
            and leapt.wheels is not None
        ):
            self._pass(leapt.time_s, leapt.wheels, self._due(leapt.time_s))
        due = self._due(tick.time_s)
        wheels = self._no_wheels if tick.wheels is None else tick.wheels
        estimate = self._estimate(tick.time_s, wheels, due)
        if follows < 0:
            self._history.clear()
        self._history.add_tick(tick)
        return estimate

    def _due(self, time_s: float) -> dict[str, Due]:
        return {name: queue.take(time_s) for name, queue in self._queues.items()}

    def _pass(self, time_s: float, wheels: Array, due: Mapping[str, Due]) -> Any:  # noqa: B027
        """Take what was measured up to a stamp that leapt, and was no tick: the next one has shown it to be right."""


class LiveFilter(Live):
    """Motion and slip from samples as they come.

    Parameters
    ----------
    robot : a swerve robot with motors, steering and sensors, and a camera for vio12 and vio15, or one that
        skids; corrected
    filter_name : one of :data:`~terrain.estimation.estimate.FILTERS` that is the robot's
    channels : names of the columns of the streams that are read, in their order; those of the schema
    settings : when a measurement or a stamp is not believed
    noise : in place of the physical
    initial_yaw_rad : heading of the start in the world; without it the GNSS is not used
    gnss_latency_s : age of a position when it arrives
    rate_hz : of ``wheels`` and ``imu``, where they are not those of the robot's description
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
    >>> estimator = LiveFilter(load_robot("agrimaro"))
    >>> wheels = Reading(np.array([0.0]), np.array([[20.0, 20.0, 20.0, 1.0, 1.0, 1.0]]))
    >>> _ = estimator.step({"wheels": wheels})
    >>> estimator.latest.wheel_speed_mps, estimator.latest.slip_stale
    (array([0.4, 0.4, 0.4]), True)
    >>> skids = LiveFilter(load_robot("husky"), "skid")
    >>> _ = skids.step({"wheels": Reading(np.array([0.0]), np.array([[0.4, 0.4]]))})
    >>> round(skids.latest.speed_x_mps, 2), skids.latest.motion.name
    (0.4, 'UNKNOWN')
    """

    _ticks_without_wheels = True
    filter: Filter
    latest: LiveEstimate | None

    def __init__(
        self,
        robot: Robot,
        filter_name: str = "vio15",
        channels: Mapping[str, tuple[str, ...]] | None = None,
        settings: FilterSettings = SETTINGS,
        *,
        noise: Noise | None = None,
        initial_yaw_rad: float | None = None,
        gnss_latency_s: float = GNSS_LATENCY_S,
        rate_hz: Mapping[str, float] | None = None,
        correction: Correction | None = None,
    ) -> None:
        check_corrected(robot)
        yaw_rad = initial_yaw_rad or 0.0
        if not math.isfinite(yaw_rad):
            raise ConfigError(f"initial_yaw_rad is {initial_yaw_rad}, a finite number is required")
        for stream, rate in (rate_hz or {}).items():
            if not 0.0 < rate < math.inf:
                raise ConfigError(f"rate of {stream!r} is {rate} Hz, a number above zero is required")
        skids = filter_name == "skid"
        if channels is None:
            channels = {**CHANNELS, "wheels": robot.rate_channels} if skids else CHANNELS
        has_gnss = not skids and initial_yaw_rad is not None and "gnss" in channels
        if skids:
            self.model, usual = make_skid_filter(robot), skid_noise(robot)
        else:
            self.model = make_filter(filter_name, robot, with_gnss=has_gnss)
            robot.require("motors", "steering", "sensors")
            usual = default_noise(filter_name, robot, has_gnss)
        states, model_rows = self.model.states, self.model.rows
        is_scheduled = noise is None and bool(self.model.inputs)
        self._schedule = Schedule(self.model, ROWS) if is_scheduled else None
        self._robot, self._skids = robot, skids
        self.filter = Filter(self.model, usual if noise is None else noise, settings)
        sensors = robot.completed.sensors
        rates = {"wheels": sensors.wheels_rate_hz, "imu": sensors.imu_rate_hz, "gnss": 1.0 / GNSS_PERIOD_S}
        rates["steering"] = sensors.steering_rate_hz
        if robot.describes("camera"):
            rates["odometry"] = robot.camera.rate_hz
        period_s = {stream: 1.0 / rate for stream, rate in (rates | dict(rate_hz or {})).items()}
        self._settings = rows.feed_settings(robot, period_s, yaw_rad, gnss_latency_s)
        self._feed, self._row = rows.new_feed(), np.zeros(1, rows.ROW)
        self._numbers = rows.measurements(self._row)
        self._monitor = None if skids else HealthMonitor(robot, self.model)
        self._slip = SlipOfInstant(robot, states)
        self._motion = motion_memory()
        memories = [self.filter.state, self._feed, self._motion]
        memories += [] if self._monitor is None else [self._monitor.memory]
        self._memories = [memory.view(np.uint8) for memory in memories]  # bytes are copied at once
        super().__init__(channels, self._queues_of(channels, has_gnss), period_s["wheels"], correction)
        self._region = RegionMonitor(robot)
        self._row_places = [ROWS.index(row) for row in model_rows]
        self._gnss_places = [k for k, row in enumerate(model_rows) if row in GNSS_ROWS]
        motion = ("speed_mps", "", "yaw_rate_radps", "", "") if skids else _MOTION
        self._motion_places = places_among(motion, states).tolist()
        self.name, self.states = self.model.name, states

    def _queues_of(self, channels: Mapping[str, tuple[str, ...]], has_gnss: bool) -> dict[str, SampleQueue]:
        """Find the columns of the wheels, and return a queue for each stream that is read."""
        needed = {"wheels": self._robot.rate_channels}
        if self._skids and channels.get("imu"):
            needed["imu"] = ("gyro_z_radps",)
        for stream, names in needed.items():
            check_channels(stream, names, channels.get(stream, ()))
        has = {"gnss": has_gnss, "odometry": self._robot.describes("camera")}
        used = ("imu",) if self._skids else tuple(STREAMS)
        wheels = list(channels["wheels"])
        self._rate_columns = [wheels.index(channel) for channel in self._robot.rate_channels]
        self._current_columns = places_among([f"current_{wheel}_a" for wheel in self._robot.wheels], wheels)
        return {
            name: SampleQueue(places_among(STREAMS[name], channels[name]))
            for name in used
            if channels.get(name) and has.get(name, True)
        }

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind, and by what the filter did not believe."""
        counts = super().dropped | self.filter.dropped
        counts["wheels: not finite"] = int(self._feed["wheels_not_finite"][0])
        counts["wheels: beyond the motors"] = int(self._feed["wheels_beyond"][0])
        for stream, name in enumerate(STREAMS):
            if name in self._queues:
                for kind in rows.COUNTS:
                    counts[f"{name}: {kind.replace('_', ' ')}"] = int(self._feed[kind][0, stream])
        return {kind: n for kind, n in counts.items() if n}

    @property
    def health(self) -> dict[str, str]:  # type: ignore[override]
        """Health of each sensor at the last tick, by name; empty where none is judged."""
        return {} if self._monitor is None else self._monitor.names

    def at(self, now_s: float) -> LiveEstimate | None:
        """Return the last estimate, its means predicted to a later time; None before the first tick."""
        seen = self.latest
        if seen is None or not 1e-3 < now_s - seen.time_s < SETTINGS.max_gap_s:
            return seen
        d = len(self.states)
        mean, params = np.empty(d), np.append(self.model.params, np.zeros(len(self.model.inputs)))
        self.model.propagate(seen.mean, now_s - seen.time_s, params, mean, np.zeros((d, d)))
        motion: dict[str, Any] = dict(zip(_MOTION, self._motion_of(mean), strict=True))
        return seen._replace(mean=mean, **motion)

    def _motion_of(self, mean: Array) -> list[float]:
        """Return speeds, yaw rate and accelerations of a state; NaN of what it does not have."""
        return [math.nan if place < 0 else float(mean[place]) for place in self._motion_places]

    def _follows(self, time_s: float) -> int:
        follows = self.filter.follows(time_s)
        if follows == 0:
            self.filter.step(
                time_s, np.full(len(self.model.rows), np.nan)
            )  # to count it, and remember a jump
        return follows

    def _forget(self) -> None:
        rows.forget_times(self._feed)

    def _last_taken_s(self, name: str) -> float:
        return float(self._feed["last_s"][0, list(STREAMS).index(name)])

    def _snapshot(self) -> list[Array]:
        return [memory.copy() for memory in self._memories]

    def _restore(self, memory: list[Array]) -> None:
        for one, snapshot in zip(self._memories, memory, strict=True):
            one[:] = snapshot

    def _pass(self, time_s: float, wheels: Array, due: Mapping[str, Due]) -> Array:
        for stream, name in enumerate(STREAMS):
            for came_s, complete, sample in due.get(name, ()):
                rows.take_live(stream, sample, complete, came_s, self._settings, self._feed)
        rates = wheels[self._rate_columns]
        if wheels is not self._no_wheels:
            self._feed["wheels_not_finite"] += not math.isfinite(sum(rates.tolist()))
        if self._skids:
            rates[~np.isfinite(rates)] = np.nan
        rows.tick_live(time_s, rates, self._settings, self._feed, self._row)
        return rates

    def _estimate(self, time_s: float, wheels: Array, due: Mapping[str, Due]) -> LiveEstimate:
        filter_, robot = self.filter, self._robot
        rates = self._pass(time_s, wheels, due)
        z = self._numbers[:, self._row_places][0]
        variance, walk, inputs = filter_.noise.measurement_variance, None, None
        if self._schedule is not None:
            (variance,), (walk,), (inputs,) = self._schedule(self._numbers, variance)
        if self._gnss_places:
            variance = np.array(variance)
            variance[self._gnss_places] = self._row["gnss_variance"][0]
        filter_.step(time_s, z, variance, walk, inputs)
        if self._monitor is not None:
            self._monitor.judge(time_s, wheels, rates, self._row, self._feed, filter_.state)
        mean, std = filter_.mean.copy(), np.sqrt(filter_.cov.diagonal())
        motion, age_s = Motion.UNKNOWN, filter_.reference_age_s
        slip_ratio = slip_std = motor_radps = np.full(len(robot.wheels), np.nan)
        wheel_speed_mps = rates
        if self._skids:  # nothing sees the ground go by: slip is not known
            mean = within_bounds(mean, robot.track_m)
            left_mps, right_mps = self._row["side_mps"][0].tolist()
            has_gyro = not math.isnan(self._row["gyro_z_radps"][0])
            yaw_rate, bias = (self.states.index(name) for name in ("yaw_rate_radps", "gyro_bias_radps"))
            known = float(mean[yaw_rate]), float(std[bias]), robot.track_m
            motion = motion_at(time_s, left_mps, right_mps, has_gyro, *known, self._motion)
        else:
            motor_radps = rates.copy()
            wheel_speed_mps = robot.wheel_speeds_mps(rates / robot.motors.reduction_ratio)
            slip_ratio, slip_std = self._slip.at(time_s, filter_, self._row, self._feed)
        v_x, v_y, turn, a_x, a_y = self._motion_of(mean)
        if self._region.compares:
            self._region.step(time_s, float(wheel_speed_mps.mean()), turn)
        return LiveEstimate(
            time_s,
            mean,
            std,
            slip_ratio,
            slip_std,
            age_s > STALE_AFTER_S,
            age_s,
            self._numbers[0].copy(),
            v_x,
            v_y,
            turn,
            a_x,
            a_y,
            motor_radps,
            np.append(wheels, np.nan)[self._current_columns],
            wheel_speed_mps,
            np.empty(0, np.int8) if self._monitor is None else self._monitor.health.copy(),
            motion,
            float(self._motion["stuck_since_s"][0]),
        )


class LiveObserverEstimate(NamedTuple):
    """What is known at one tick; arrays are the caller's to keep."""

    time_s: float  #: stamp of the wheels
    mean: Array  #: as of :class:`~terrain.estimation.models.observer.ObserverOutput`
    std: Array
    slip: Array
    slip_std: Array
    status: ObserverStatus  #: of the estimates


class LiveObserver(Live):
    """An observer, before its first step, of a corrected robot; columns of each stream are ``channels``.

    ``ConfigError`` if the wheels have no speed that the observer takes.
    """

    filter: None = None
    latest: LiveObserverEstimate | None

    def __init__(
        self,
        observer: Observer,
        robot: Robot,
        channels: Mapping[str, tuple[str, ...]],
        correction: Correction | None = None,
    ) -> None:
        self.observer, self._feed, self._last_s = (
            observer,
            ObserverFeed(robot, observer.rows, channels),
            math.nan,
        )
        self.name, self.states = observer.name, observer.states
        super().__init__(channels, self._feed.queues, 0.0, correction)

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind."""
        return super().dropped | self._feed.dropped

    def _follows(self, time_s: float) -> int:
        return self._feed.follows(time_s)

    def _forget(self) -> None:
        self._feed.begin()
        self._last_s = math.nan

    def _last_taken_s(self, name: str) -> float:
        return self._feed.taken_s[name]

    def _snapshot(self) -> tuple[float, Any, Any]:
        return self._last_s, self._feed.snapshot(), self.observer.snapshot()

    def _restore(self, memory: tuple[float, Any, Any]) -> None:
        self._last_s, of_feed, of_observer = memory
        self._feed.restore(of_feed)
        self.observer.restore(of_observer)

    def _estimate(self, time_s: float, wheels: Array, due: Mapping[str, Due]) -> LiveObserverEstimate:
        dt_s = 0.0 if math.isnan(self._last_s) else time_s - self._last_s
        self._last_s = time_s
        output = self.observer.step(self._feed.tick(time_s, wheels, due), dt_s)
        return LiveObserverEstimate(time_s, *output[:4], ObserverStatus(output.status))


Estimate = LiveEstimate | LiveObserverEstimate
Estimator = LiveFilter | LiveObserver

#: Filters and observers that run sample by sample, by drive, without a file of their own; the first is used where
#: none is named.
LIVE_FILTERS: Mapping[str, tuple[str, ...]] = {
    "swerve": ("vio15", "vio12", "slip14", "encoder12"),
    "skid_steer": ("skid",),
    "tracked": ("skid", "tracked", "slip-learning", "gyrodometry", "encoder-odometry"),
    "bicycle": ("sideslip-multi", "sideslip-dynamic", "sideslip-kinematic"),
}


def make_live_filter(
    name: str,
    robot: Robot,
    channels: Mapping[str, tuple[str, ...]],
    rate_hz: Mapping[str, float],
    correction: Correction | None = None,
) -> Estimator:
    """Return a filter of :data:`LIVE_FILTERS`, or an observer, of a corrected robot before its first sample.

    ``channels`` of each stream that is measured are in the order of the columns of its readings; ``rate_hz`` are of the
    streams where they are not those of the robot's description.  ``ConfigError`` if a channel that is needed is not
    measured.
    """
    if name in OBSERVERS:
        return LiveObserver(make_observer(name, robot), robot, channels, correction)
    return LiveFilter(robot, name, channels, rate_hz=rate_hz if name == "skid" else {}, correction=correction)


def estimated_channels(name: str, robot: Robot) -> dict[str, tuple[str, ...]]:
    """Return the channels of the streams :data:`ESTIMATED` that a filter or an observer of a robot gives.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> estimated_channels("skid", load_robot("husky"))
    {'estimator': ('yaw_rate_radps',), 'slip': ('slip_left_ratio', 'slip_right_ratio')}
    """
    if name in OBSERVERS:
        observer = make_observer(name, robot)
        return {"estimator": observer.states, "slip": observer.slips}
    motion = ("yaw_rate_radps",) if name == "skid" else ESTIMATOR_CHANNELS
    return {"estimator": motion, "slip": tuple(f"slip_{wheel}_ratio" for wheel in robot.wheels)}


def estimated_values(stream: str, estimate: Estimate) -> Array:
    """Return a row of one of :data:`ESTIMATED`, in the order of :func:`estimated_channels`."""
    if isinstance(estimate, LiveObserverEstimate):
        return estimate.slip if stream == "slip" else estimate.mean
    if stream == "slip":
        return estimate.slip_ratio
    motion = [getattr(estimate, channel) for channel in ESTIMATOR_CHANNELS]
    return np.array(motion if math.isfinite(estimate.speed_y_mps) else [estimate.yaw_rate_radps])
