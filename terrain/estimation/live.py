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
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation import feed
from terrain.estimation.clocks import NEVER, REWIND_S, SampleQueue, check_channels, readable
from terrain.estimation.filter import GATE_PROBABILITY, REOPEN_AFTER_S, Filter, FilterSettings
from terrain.estimation.health import HealthMonitor
from terrain.estimation.models.choice import OBSERVERS, make_observer, suitable_filter
from terrain.estimation.models.observer import Observer, ObserverFeed, ObserverStatus
from terrain.estimation.models.swerve import make_filter, scheduled
from terrain.estimation.wheel_slip import STALE_AFTER_S, WheelSlip
from terrain.extension import Correction, RegionMonitor, check_corrected
from terrain.logs.schema import ESTIMATOR_CHANNELS, WHEELS_CHANNELS
from terrain.records import Array, Reading
from terrain.robots import Robot

SETTINGS = FilterSettings(GATE_PROBABILITY, REOPEN_AFTER_S)  #: Those of the batch.
#: Default channels of each stream of a swerve robot.
CHANNELS: Mapping[str, tuple[str, ...]] = {"wheels": WHEELS_CHANNELS, **feed.STREAMS}
#: States that are of a sensor, and stay what they are while the robot does anything.
BIASES = ("gyro_bias_radps", "accel_bias_x_mps2", "accel_bias_y_mps2")
N_TICKS = 64  #: Most ticks that are remembered; at 200 Hz a little more than :data:`REWIND_S`.
N_STEPS = 1024  #: Most steps whose samples are remembered, where no tick says that they are old.
LATE_PERIODS = 1.5  #: So many periods without wheels make a tick without them.

_JUST_BEFORE_S = 1e-6
_MOTION = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2")
#: A block of samples of each stream where none came.
_NOTHING = {
    name: (np.empty(0), np.empty(0, np.bool_), np.empty((0, len(names))))
    for name, names in feed.STREAMS.items()
}


class LiveEstimate(NamedTuple):
    """What is believed at one tick; arrays are the caller's to keep, and NaN where something is not known."""

    time_s: float  #: stamp of the wheels
    mean: Array  #: (d,) states and their standard deviations, in the order of :attr:`LiveFilter.states`
    std: Array
    slip_ratio: Array  #: (wheels,) NaN where unknown or where the wheel stands
    slip_std: Array
    slip_stale: bool  #: whether the speed over ground was not measured lately
    reference_age_s: float  #: time since it was; infinite before the first time
    #: (32,) what was measured, in the order of :data:`~terrain.estimation.feed.ROWS`; (0,) of an observer
    rows: Array
    speed_x_mps: float  #: of the states, by name
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
    slip: Array = np.empty(0)  #: of an observer, in the order of its slips, which may be angles
    status: ObserverStatus = ObserverStatus.OK  #: of the estimates of an observer
    reason: str = ""  #: why slip is not known, in a sentence; empty where it is


class Tick(NamedTuple):
    """A tick that is done: its stamp, and the sample of the wheels (c,), None where they gave none."""

    time_s: float
    wheels: Array | None


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
    latest: Any
    _ticks_without_wheels = False  #: whether time goes on where the wheels give nothing

    def __init__(
        self,
        channels: Mapping[str, tuple[str, ...]],
        queues: Mapping[str, SampleQueue],
        period_s: float,
        correction: Correction | None,
    ) -> None:
        self._channels = {name: channels[name] for name in (*queues, "wheels")}
        self._queues, self._correction, self._period_s = dict(queues), correction, period_s
        self._no_wheels = np.full(len(channels["wheels"]), np.nan)
        self._counted: Counter[str] = Counter()
        #: ticks, each with what was remembered after it; the first is none. What came of each stream at a step
        self._ticks: deque[tuple[Tick, Any]] = deque(maxlen=N_TICKS)
        self._came: deque[tuple[float, dict[str, tuple[list[float], Reading]]]] = deque(maxlen=N_STEPS)
        self._leapt: Tick | None = None  # not believed yet: its stamp is far ahead
        self._unsettled: deque[Any] = deque()
        self._settled_s, self._newest_s = -math.inf, dict[str, float]()
        self.latest, self.too_late = None, NEVER
        self._add(Tick(-math.inf, None))

    @abstractmethod
    def _follows(self, time_s: float) -> int:
        """Return what a stamp of the wheels is: 1 taken, -1 of a clock set back, 0 not taken, and counted."""

    @abstractmethod
    def _forget(self) -> None:
        """Begin anew after a clock was set back."""

    @abstractmethod
    def _estimate(self, tick: Tick, leapt: Tick | None) -> Any:
        """Do a tick: take the samples that are due, and return what is known then.

        The tick before it may be one that ``leapt``: it was not believed, and is right, as the next one shows.
        """

    @abstractmethod
    def _snapshot(self) -> Any:
        """Return all that is remembered."""

    @abstractmethod
    def _restore(self, memory: Any) -> None:
        """Go back to a snapshot."""

    @property
    def health(self) -> dict[str, str]:
        """Health of each sensor at the last tick, by name; empty where none is judged."""
        return {}

    def at(self, now_s: float) -> LiveEstimate | None:
        """Return what is believed at a time: the last estimate; None before the first tick."""
        latest: LiveEstimate | None = self.latest
        return latest

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind, and by what the filter did not believe."""
        counts = dict(self._counted)
        for name, queue in self._queues.items():
            counts |= {f"{name}: {kind}": n for kind, n in queue.counts.items()}
        return counts

    @property
    def _last_s(self) -> float:
        """Stamp of the last tick; minus infinity before the first."""
        return self._ticks[-1][0].time_s if self._ticks else -math.inf

    def _add(self, tick: Tick) -> None:
        taken_s = [queue.taken_s for queue in self._queues.values()]
        self._ticks.append((tick, (self._snapshot(), taken_s)))

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
        came: dict[str, tuple[list[float], Reading]] = {}
        last_s, late_s, ticks = self._last_s, math.inf, list[Tick]()
        for name in self._channels if isinstance(readings, Mapping) else ():
            reading = self._read(name, readings[name]) if readings.get(name) is not None else None
            if reading is None:
                continue
            stamps = reading.time_s.tolist()
            came[name] = stamps, reading
            if stamps[-1] <= last_s + feed.OFF_CLOCK_S or last_s == -math.inf:  # else its clock jumped
                self._newest_s[name] = max(stamps[-1], self._newest_s.get(name, -math.inf))
            is_late = min(stamps) <= last_s + feed.TICK_S
            if name == "wheels":
                ticks = [Tick(*tick) for tick in zip(stamps, reading.values, strict=True)]
                known = (tick.time_s for tick, _ in reversed(self._ticks) if tick.wheels is not None)
                is_late = stamps[0] <= last_s and next(known, -math.inf) < stamps[0]
            before_s = self._late(name, stamps) if is_late else math.inf
            late_s = min(late_s, before_s)
            if name != "wheels" and before_s == math.inf:
                self._queues[name].push(*reading)
        if came:
            self._came.append((max(stamps[-1] for stamps, _ in came.values()), came))
            while self._came and not self._came[0][0] > last_s - 2.0 * REWIND_S:
                self._came.popleft()
        if late_s < math.inf:
            ticks = self._go_back(late_s, ticks)
        if self._ticks_without_wheels and now_s is not None and self._last_s > -math.inf:
            reached_s = ticks[-1].time_s if ticks else self._last_s
            if LATE_PERIODS * self._period_s < now_s - reached_s < SETTINGS.max_gap_s:
                ticks.append(Tick(now_s, None))
                self._counted["ticks without wheels"] += 1
        settled: list[Any] = []
        for tick in ticks:
            follows, leapt = self._follows(tick.time_s), self._leapt
            self._leapt = tick if follows == 0 and tick.time_s > self._last_s else None
            if follows == 0:
                continue
            if follows < 0:  # what was not settled before has settled
                settled += self._unsettled
                self._unsettled.clear()
                self._newest_s.clear()
                self._settled_s, leapt = -math.inf, None
                self._forget()
                for queue in self._queues.values():
                    queue.waiting.clear()
                    queue.taken_s = -math.inf
            if leapt is not None and not self._last_s < leapt.time_s < tick.time_s:
                leapt = None
            self.latest = self._estimate(tick, leapt)
            if follows < 0:
                self._ticks.clear()
                self._came.clear()
            self._add(tick)
            if tick.wheels is not None and tick.time_s > self._settled_s:
                self._unsettled.append(self.latest)
        return settled + self.settle()

    def settle(self, *, all_of_them: bool = False) -> list[Any]:
        """Return the estimates that have settled since the last call, or all that are there, at a log's end."""
        if not self._unsettled:
            return []
        last_s, first_s, reached_s = self._last_s, self._unsettled[0].time_s, math.inf
        for name in self._channels:
            newest_s = self._newest_s.setdefault(name, first_s - _JUST_BEFORE_S)
            if newest_s > last_s - REWIND_S:  # one that stopped, or does not begin, is waited for no longer
                reached_s = min(reached_s, newest_s)
        reached_s = math.inf if all_of_them else max(reached_s, last_s - REWIND_S)
        settled = []
        while self._unsettled and self._unsettled[0].time_s <= reached_s + feed.TICK_S:
            settled.append(self._unsettled.popleft())
            self._settled_s = settled[-1].time_s
        return settled

    def _read(self, name: str, given: Any) -> Reading | None:
        """Return what came of a stream, without stamps that are no numbers; None of nothing.

        Samples of the wheels whose values do not fit are unknown.
        """
        reading, n_columns = readable(given), len(self._channels[name])
        if reading is None or reading.values.shape[1] != n_columns:
            self._counted[f"{name}: unreadable"] += 1
            if reading is None or name != "wheels":
                return None
            reading = Reading(reading.time_s, np.full((reading.time_s.size, n_columns), np.nan))
        elif self._correction is not None:
            reading = Reading(*self._correction(name, self._channels[name], *reading))
        if not math.isfinite(sum(reading.time_s.tolist())):
            finite = np.isfinite(reading.time_s)
            self._counted[f"{name}: stamp does not increase"] += int((~finite).sum())
            reading = Reading(reading.time_s[finite], reading.values[finite])
        return reading if reading.time_s.size else None

    def _late(self, name: str, stamps: list[float]) -> float:
        """Return the instant to go back to for late samples, infinite where there is none that is new, or in reach."""
        last_s = self._last_s
        known = {stamp_s for _, came in self._came if name in came for stamp_s in came[name][0]}
        late_s = min(
            (at_s for at_s in stamps if at_s <= last_s + feed.TICK_S and at_s not in known), default=math.inf
        )
        if late_s == math.inf:
            return math.inf
        if not late_s - feed.TICK_S > max(self._ticks[0][0].time_s, last_s - REWIND_S):
            self.too_late = last_s, last_s - late_s
            return math.inf
        self._counted["came late"] += 1
        return late_s

    def _go_back(self, late_s: float, ticks: list[Tick]) -> list[Tick]:
        """Put the memory back before an instant; return the ticks to be done again, with new ones."""
        done = [] if self._leapt is None else [self._leapt]
        self._leapt = None
        while self._last_s >= late_s - feed.TICK_S:
            done.append(self._ticks.pop()[0])
        memory, taken_s = self._ticks[-1][1]
        self._restore(memory)
        for (name, queue), before_s in zip(self._queues.items(), taken_s, strict=True):
            queue.taken_s = before_s
            queue.waiting.clear()
            later = [
                came[name][1] for _, came in self._came if name in came and max(came[name][0]) > before_s
            ]
            if later:
                time_s, values = (np.concatenate(parts) for parts in zip(*later, strict=True))
                _, first = np.unique(time_s, return_index=True)
                first = first[time_s[first] > before_s]
                queue.push(time_s[first], values[first])
        first_s = min((tick.time_s for tick in done), default=math.inf)
        while self._unsettled and self._unsettled[-1].time_s >= first_s:
            self._unsettled.pop()
        measured = {tick.time_s: tick for tick in (*ticks, *done) if tick.wheels is not None}
        reached_s = max(measured, default=-math.inf) + LATE_PERIODS * self._period_s  # none was due before
        spare = [tick for tick in done if tick.wheels is None and tick.time_s > reached_s]
        return sorted([*measured.values(), *spare], key=lambda tick: tick.time_s)


class LiveFilter(Live):
    """Motion and slip from samples as they come.

    Parameters
    ----------
    robot : a swerve robot with motors, steering and sensors, and a camera for vio12 and vio15; corrected
    filter_name : one of :data:`~terrain.estimation.estimate.FILTERS`
    channels : names of the columns of the streams that are read, in their order; those of the schema
    initial_yaw_rad : heading of the start in the world; without it the GNSS is not used
    rate_hz : of ``wheels`` and ``imu``, where they are not those of the robot's description
    correction : of :func:`terrain.extension.correct_live`

    Raises
    ------
    ConfigError
        if filter, robot and channels do not fit, the robot is not corrected, or a number is out of its range.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> estimator = LiveFilter(load_robot("agrimaro"))
    >>> wheels = Reading(np.array([0.0]), np.array([[20.0, 20.0, 20.0, 1.0, 1.0, 1.0]]))
    >>> _ = estimator.step({"wheels": wheels})
    >>> estimator.latest.wheel_speed_mps, estimator.latest.slip_stale
    (array([0.4, 0.4, 0.4]), True)
    """

    _ticks_without_wheels = True
    filter: Filter
    latest: LiveEstimate | None

    def __init__(
        self,
        robot: Robot,
        filter_name: str = "vio15",
        channels: Mapping[str, tuple[str, ...]] | None = None,
        *,
        initial_yaw_rad: float | None = None,
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
        self._robot, channels = robot, CHANNELS if channels is None else channels
        has_gnss = initial_yaw_rad is not None and "gnss" in channels
        self.model = make_filter(filter_name, robot, with_gnss=has_gnss)
        robot.require("motors", "steering", "sensors")
        self.name, self.states, self.filter = self.model.name, self.model.states, Filter(self.model, SETTINGS)
        sensors, camera = robot.completed.sensors, robot.completed.camera
        rates = {
            "wheels": sensors.wheels_rate_hz,
            "imu": sensors.imu_rate_hz,
            "gnss": 1.0 / feed.GNSS_PERIOD_S,
        }
        rates |= {"steering": sensors.steering_rate_hz, "odometry": camera.rate_hz, **(rate_hz or {})}
        period_s = {stream: 1.0 / rate for stream, rate in rates.items() if rate > 0.0}
        self._settings = feed.feed_settings(robot, period_s, yaw_rad, is_causal=True, is_live=True)
        self._feed, self._rows = feed.new_feed(), np.full((1, feed.N_NUMBERS), np.nan)
        self._monitor = HealthMonitor(robot, self.model)
        self._slip, self._region = WheelSlip(robot, self.states), RegionMonitor(robot)
        memories = [self.filter.state, self._feed, self._monitor.memory]
        self._memories = [memory.view(np.uint8) for memory in memories]  # bytes are copied at once
        self._row_places = [feed.ROWS.index(row) for row in self.model.rows]
        self._motion_places = feed.places_among(_MOTION, self.states).tolist()
        check_channels("wheels", robot.rate_channels, channels.get("wheels", ()))
        has = {"gnss": has_gnss, "odometry": robot.describes("camera")}
        queues = {
            name: SampleQueue(feed.places_among(feed.STREAMS[name], channels[name]))
            for name in feed.STREAMS
            if channels.get(name) and has.get(name, True)
        }
        self._rate_columns = feed.places_among(robot.rate_channels, channels["wheels"])
        self._current_columns = feed.places_among(
            [f"current_{wheel}_a" for wheel in robot.wheels], channels["wheels"]
        )
        super().__init__(channels, queues, period_s["wheels"], correction)

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind, and by what the filter did not believe."""
        counts = super().dropped | self.filter.dropped | feed.counts_of(self._feed, self._queues)
        counts["wheels: not finite"] = int(self._feed["wheels_not_finite"][0])
        counts["wheels: beyond the motors"] = int(self._feed["wheels_beyond"][0])
        return {kind: n for kind, n in counts.items() if n}

    @property
    def health(self) -> dict[str, str]:
        """Health of each sensor at the last tick, by name."""
        return self._monitor.names

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
        if follows == 0:  # to count it, and remember a jump
            self.filter.step(time_s, np.full(len(self.model.rows), np.nan))
        return follows

    def _forget(self) -> None:
        feed.forget_times(self._feed)

    def _snapshot(self) -> list[Array]:
        return [memory.copy() for memory in self._memories]

    def _restore(self, memory: list[Array]) -> None:
        for one, snapshot in zip(self._memories, memory, strict=True):
            one[:] = snapshot

    def _measure(self, tick: Tick) -> Array:
        """Write the row of a tick; return the rates of the motors, or the speeds of the sides, NaN where unknown."""
        blocks = []
        for name, nothing in _NOTHING.items():
            due = self._queues[name].take(tick.time_s) if name in self._queues else []
            blocks.append(tuple(map(np.array, zip(*due, strict=True))) if due else nothing)
        stamps, are_whole, samples = zip(*blocks, strict=True)
        rates = (self._no_wheels if tick.wheels is None else tick.wheels)[self._rate_columns]
        unknown = ~np.isfinite(rates)
        rates[unknown] = np.nan
        self._feed["wheels_not_finite"] += tick.wheels is not None and unknown.any()
        clock = np.array([tick.time_s])
        feed.run_feed(clock, rates[None], stamps, samples, are_whole, self._settings, self._feed, self._rows)
        return rates

    def _estimate(self, tick: Tick, leapt: Tick | None) -> LiveEstimate:
        filter_, robot, row, time_s = self.filter, self._robot, self._rows[0], tick.time_s
        if leapt is not None:
            self._measure(leapt)
        rates, wheels = self._measure(tick), self._no_wheels if tick.wheels is None else tick.wheels
        now = scheduled(self.model, self._rows[:, : len(feed.ROWS)], self._rows[:, len(feed.ROWS) :])
        filter_.step(time_s, row[self._row_places], *(None if part is None else part[0] for part in now))
        self._monitor.judge(time_s, wheels, rates, self._rows, self._feed, filter_.state)
        mean, std = filter_.mean.copy(), np.sqrt(filter_.cov.diagonal())
        age_s = filter_.reference_age_s
        wheel_speed_mps = robot.wheel_speeds_mps(rates / robot.reduction_ratio)
        speeds, ages_s = robot.wheel_speeds_mps(self._rows[:, : len(robot.wheels)]), np.array([age_s])
        unmeasured_s = time_s - self._feed["received_s"].min(axis=1)
        slips = self._slip(mean[None], filter_.cov[None], speeds, ages_s, unmeasured_s)
        slip_ratio, slip_std = (part[0] for part in slips)
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
            row[: len(feed.ROWS)].copy(),
            v_x,
            v_y,
            turn,
            a_x,
            a_y,
            rates,
            np.append(wheels, np.nan)[self._current_columns],
            wheel_speed_mps,
            self._monitor.health.copy(),
            reason=self._reason(slip_ratio, age_s),
        )

    def _reason(self, slip_ratio: Array, age_s: float) -> str:
        """Return why no slip is known, in a sentence; empty where one is."""
        if np.isfinite(slip_ratio).any():
            return ""
        if age_s == math.inf:
            return "no speed over ground has come yet"
        return (
            "the wheels stand"
            if age_s <= STALE_AFTER_S
            else f"the last speed over ground is {age_s:.1f} s old"
        )


class LiveObserver(Live):
    """An observer, before its first step, of a corrected robot; columns of each stream are ``channels``.

    ``ConfigError`` if the wheels have no speed that the observer takes.
    """

    filter: None = None
    latest: LiveEstimate | None

    def __init__(
        self,
        observer: Observer,
        robot: Robot,
        channels: Mapping[str, tuple[str, ...]],
        correction: Correction | None = None,
    ) -> None:
        terms = () if correction is None else correction.axle_terms
        self.observer, self._feed = observer, ObserverFeed(robot, observer.rows, channels, terms)
        self.name, self.states, self._robot = observer.name, observer.states, robot
        currents = [f"current_{wheel}_a" for wheel in robot.wheels]
        self._current_columns = feed.places_among(currents, channels["wheels"])
        self._motion_places = feed.places_among(_MOTION, observer.states).tolist()
        self._logged = np.isin(robot.wheels, robot.logged_wheels)
        ratios = tuple(f"slip_{wheel}_ratio" for wheel in robot.logged_wheels)
        self._slips_of_wheels = observer.slips == ratios
        super().__init__(channels, self._feed.queues, 0.0, correction)

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind."""
        return dict(Counter(super().dropped) + self._feed.dropped)

    def _follows(self, time_s: float) -> int:
        return self._feed.follows(time_s)

    def _forget(self) -> None:
        self._feed.begin()

    def _snapshot(self) -> tuple[Any, Any]:
        return self._feed.snapshot(), self.observer.snapshot()

    def _restore(self, memory: tuple[Any, Any]) -> None:
        for one, snapshot in zip((self._feed, self.observer), memory, strict=True):
            one.restore(snapshot)

    def _estimate(self, tick: Tick, leapt: Tick | None) -> LiveEstimate:
        observer, robot = self.observer, self._robot
        due = {name: queue.take(tick.time_s) for name, queue in self._queues.items()}
        dt_s = 0.0 if self._feed.last_s == -math.inf else tick.time_s - self._feed.last_s
        wheels = self._no_wheels if tick.wheels is None else tick.wheels
        output = observer.step(self._feed.tick(tick.time_s, wheels, due), dt_s)
        v_x, v_y, turn = (
            math.nan if place < 0 else float(output.mean[place]) for place in self._motion_places[:3]
        )
        by_wheel = np.full((3, len(robot.wheels)), math.nan)  # speed, slip and its deviation
        by_wheel[0, self._logged] = self._feed.speeds_mps
        if self._slips_of_wheels:
            by_wheel[1:, self._logged] = output.slip, output.slip_std
        age_s = observer.reference_age_s
        return LiveEstimate(
            tick.time_s,
            output.mean,
            output.std,
            by_wheel[1],
            by_wheel[2],
            age_s > STALE_AFTER_S,
            age_s,
            np.empty(0),
            v_x,
            v_y,
            turn,
            observer.accel_mps2,
            turn * v_x,
            by_wheel[0] / self._feed.mps_per_rate if robot.by_motor else by_wheel[0] * math.nan,
            np.append(wheels, np.nan)[self._current_columns],
            by_wheel[0],
            np.empty(0, np.int8),
            slip=output.slip,
            status=ObserverStatus(output.status),
            reason=observer.reason,
        )


Estimator = LiveFilter | LiveObserver

#: Filters and observers that run sample by sample, by drive, without a file of their own; the first is used where
#: none is named.
LIVE_FILTERS: Mapping[str, tuple[str, ...]] = {
    "swerve": ("vio15", "vio12", "encoder12", "slip"),
    "tracked": ("slip", "tracked", "slip-learning", "gyrodometry", "encoder-odometry"),
    "bicycle": ("sideslip-multi", "sideslip-dynamic", "sideslip-kinematic", "slip"),
    **dict.fromkeys(("skid_steer", "tricycle", "omni", "mecanum"), ("slip",)),
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
    return LiveFilter(robot, name, channels, correction=correction)


def live_estimator(
    robot: Robot, channels: Mapping[str, tuple[str, ...]], correction: Correction | None = None
) -> Estimator:
    """Return the filter that suits a corrected robot and what is measured of it (:func:`~.choice.suitable_filter`)."""
    return make_live_filter(suitable_filter(robot, channels), robot, channels, {}, correction)


def estimated_channels(name: str, robot: Robot) -> dict[str, tuple[str, ...]]:
    """Return the channels of the streams :data:`ESTIMATED` that a filter or an observer of a robot gives.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> estimated_channels("vio12", load_robot("agrimaro"))["slip"]
    ('slip_1_ratio', 'slip_2_ratio', 'slip_3_ratio')
    """
    if name in OBSERVERS:
        observer = make_observer(name, robot)
        return {"estimator": observer.states, "slip": observer.slips}
    return {"estimator": ESTIMATOR_CHANNELS, "slip": tuple(f"slip_{wheel}_ratio" for wheel in robot.wheels)}


def estimated_values(stream: str, estimate: LiveEstimate) -> Array:
    """Return a row of one of :data:`ESTIMATED`, in the order of :func:`estimated_channels`."""
    if estimate.rows.size == 0:  # of an observer
        return estimate.slip if stream == "slip" else estimate.mean
    if stream == "slip":
        return estimate.slip_ratio
    return np.array([getattr(estimate, channel) for channel in ESTIMATOR_CHANNELS])
