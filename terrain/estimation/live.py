"""Live estimation of a robot's motion and slip, sample by sample, by any filter or observer.

The chain of a whole log, :func:`~terrain.estimation.feed.measurement_table` with ``causal=True`` and
:func:`~terrain.estimation.filter.run_filter`, or :func:`~terrain.estimation.models.observer.rows_of` and
:func:`~terrain.estimation.models.observer.observe`, with the same numbers, on memory of a fixed size.  Each sample of
the wheels is a tick, whose estimate is known at once (:attr:`Live.latest`).  For what comes up to a quarter of a second
late the estimator goes back to the tick before it, and takes all that has come since once more, in order: the same
numbers as if nothing had been late.  Where the wheels give nothing, a filter's ticks go on by the caller's time.

**One clock**: stamps of samples, ``now_s`` and the stamps of estimates are all of it, whatever it counts from.  Where
streams or the caller have clocks of their own, :class:`~terrain.estimation.clocks.Clocks` brings their stamps onto the
caller's time first; then ``now_s`` is the time that it returns.

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
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from terrain.estimation import feed
from terrain.estimation.clocks import NEVER, REWIND_S, readable
from terrain.estimation.filter import Filter
from terrain.estimation.models.choice import OBSERVERS, make_observer, suitable_filter
from terrain.estimation.models.observer import Feed, Observer, ObserverFeed, ObserverStatus
from terrain.estimation.models.swerve import make_filter
from terrain.estimation.models.swerve_live import SETTINGS, swerve_live
from terrain.estimation.wheel_slip import STALE_AFTER_S
from terrain.extension import Correction
from terrain.logs.schema import WHEELS_CHANNELS
from terrain.records import Array, Reading
from terrain.robots import Robot

#: Default channels of each stream of a swerve robot.
CHANNELS: Mapping[str, tuple[str, ...]] = {"wheels": WHEELS_CHANNELS, **feed.STREAMS}
#: States that are of a sensor, and stay what they are while the robot does anything.
BIASES = ("gyro_bias_radps", "accel_bias_x_mps2", "accel_bias_y_mps2")
N_TICKS = 64  #: Most ticks that are remembered; at 200 Hz a little more than :data:`REWIND_S`.
N_STEPS = 1024  #: Most steps whose samples are remembered, where no tick says that they are old.
LATE_PERIODS = 1.5  #: So many periods without wheels make a tick without them.

_JUST_BEFORE_S = 1e-6
_MOTION = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2")


class LiveEstimate(NamedTuple):
    """What is believed at one tick; arrays are the caller's to keep, and NaN where something is not known."""

    time_s: float  #: of the tick: the stamp of the wheels, or of a tick without them the caller's time
    mean: Array  #: (d,) states and their standard deviations, in the order of :attr:`Live.states`
    std: Array
    slip_ratio: Array  #: (wheels,) NaN where unknown or where the wheel stands
    slip_std: Array
    slip_stale: bool  #: whether the speed over ground was not measured lately
    reference_age_s: float  #: time since it was; infinite before the first time
    #: what was measured, in the order of :data:`~terrain.estimation.feed.ROWS`, or of the rows of an observer
    rows: Array
    speed_x_mps: float  #: of the states, by name
    speed_y_mps: float
    yaw_rate_radps: float
    accel_x_mps2: float
    accel_y_mps2: float
    motor_radps: Array  #: (wheels,) of this sample of the wheels
    current_a: Array
    wheel_speed_mps: Array  #: (wheels,) circumferential speeds of that sample
    #: (k,) of the sensors of a swerve robot, as :class:`~terrain.estimation.health.Health`, in the order of
    #: :func:`~terrain.estimation.health.sensors_of`; of others (0,)
    health: Array
    slip: Array = np.empty(0)  #: of an observer, in the order of its slips, which may be angles
    status: ObserverStatus = ObserverStatus.OK  #: of the estimates of an observer
    reason: str = ""  #: why slip is not known, in a sentence; empty where it is


class Tick(NamedTuple):
    """A tick that is done: its stamp, and the sample of the wheels (c,), None where they gave none."""

    time_s: float
    wheels: Array | None


class Live:
    """What takes the samples of a robot as they come: a queue a stream, ticks, and the rewind for what is late.

    Attributes
    ----------
    latest : the last estimate; None before the first tick
    too_late : tick at which samples came last that were too late to be taken, and by how much
    name : of the filter or observer
    states : name of each state, in the order of ``mean`` and ``std``

    Parameters
    ----------
    model : the filter or observer, before its first step
    source : its feed
    robot : corrected
    channels : names of the columns of each stream
    correction : of :func:`terrain.extension.correct_live`
    """

    latest: LiveEstimate | None

    def __init__(
        self,
        model: Observer,
        source: Feed,
        robot: Robot,
        channels: Mapping[str, tuple[str, ...]],
        correction: Correction | None = None,
    ) -> None:
        self.model, self.name, self.states = model, model.name, model.states
        self._feed, self._robot, self._correction = source, robot, correction
        self._queues, self._period_s = dict(source.queues), source.period_s
        self._channels = {name: channels[name] for name in (*self._queues, "wheels")}
        currents = [f"current_{wheel}_a" for wheel in robot.wheels]
        self._current_columns = feed.places_among(currents, channels["wheels"])
        self._motion_places = feed.places_among(_MOTION, self.states).tolist()
        self._logged = np.isin(robot.wheels, robot.logged_wheels)
        self._slips_of_wheels = model.slips == tuple(f"slip_{wheel}_ratio" for wheel in robot.logged_wheels)
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

    def _estimate(self, tick: Tick, leapt: Tick | None) -> LiveEstimate:
        """Do a tick: take the samples that are due, and return what is known then.

        The tick before it may be one that ``leapt``: it was not believed, and is right, as the next one shows.
        """
        model, source, robot = self.model, self._feed, self._robot
        if leapt is not None:
            self._measure(leapt)
        dt_s = 0.0 if source.last_s == -math.inf else tick.time_s - source.last_s
        row = self._measure(tick)
        output = model.step(row, dt_s)
        by_wheel = np.full(
            (4, len(robot.wheels)), math.nan
        )  # speed, rate of the motor, slip and its deviation
        by_wheel[:2, self._logged] = source.speeds_mps, source.motor_radps
        if self._slips_of_wheels:
            by_wheel[2:, self._logged] = output.slip, output.slip_std
        age_s, wheels = model.reference_age_s, self._no_wheels if tick.wheels is None else tick.wheels
        return LiveEstimate(
            time_s=tick.time_s,
            mean=output.mean,
            std=output.std,
            slip_ratio=by_wheel[2],
            slip_std=by_wheel[3],
            slip_stale=age_s > STALE_AFTER_S,
            reference_age_s=age_s,
            rows=row,
            **self._motion_of(output.mean),
            motor_radps=by_wheel[1],
            current_a=np.append(wheels, np.nan)[self._current_columns],
            wheel_speed_mps=by_wheel[0],
            health=model.health,
            slip=output.slip,
            status=ObserverStatus(output.status),
            reason=model.reason,
        )

    def _measure(self, tick: Tick) -> Array:
        due = {name: queue.take(tick.time_s) for name, queue in self._queues.items()}
        return self._feed.tick(tick.time_s, tick.wheels, due)

    def _motion_of(self, mean: Array) -> dict[str, Any]:
        """Return speeds, yaw rate and accelerations of a state, or by the observer; NaN of what is not known."""
        motion = [math.nan if place < 0 else float(mean[place]) for place in self._motion_places]
        if self._motion_places[3] < 0:
            motion[3:] = self.model.accel_mps2, motion[2] * motion[0]
        return dict(zip(_MOTION, motion, strict=True))

    def _snapshot(self) -> tuple[Any, Any]:
        """Return all that is remembered."""
        return self._feed.snapshot(), self.model.snapshot()

    @property
    def filter(self) -> Filter | None:
        """What of it may be kept over a restart; None of an observer, which starts from its first samples."""
        return self.model.kept

    @property
    def health(self) -> dict[str, str]:
        """Health of each sensor at the last tick, by name; empty where none is judged."""
        return self.model.health_names

    def at(self, now_s: float) -> LiveEstimate | None:
        """Return the last estimate, its means predicted to a time where the model can; None before the first tick.

        ``now_s`` is by the clock of the stamps.  ``time_s`` of what is returned stays the stamp of the last tick, and
        all that was measured, the deviations and the ages are those of it.
        """
        seen = self.latest
        if seen is None or not 1e-3 < now_s - seen.time_s < SETTINGS.max_gap_s:
            return seen
        mean = self.model.ahead(seen.mean, now_s - seen.time_s)
        if mean is None:
            return seen
        return seen._replace(mean=mean, **self._motion_of(mean))

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind, and by what a filter did not believe."""
        return dict(self._counted + Counter(self._feed.counts) + Counter(self.model.dropped))

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
        if self._period_s > 0.0 and now_s is not None and self._last_s > -math.inf:
            reached_s = ticks[-1].time_s if ticks else self._last_s
            if LATE_PERIODS * self._period_s < now_s - reached_s < SETTINGS.max_gap_s:
                ticks.append(Tick(now_s, None))
                self._counted["ticks without wheels"] += 1
        settled: list[Any] = []
        for tick in ticks:
            follows, leapt = self._feed.follows(tick.time_s), self._leapt
            self._leapt = tick if follows == 0 and tick.time_s > self._last_s else None
            if follows == 0:
                continue
            if follows < 0:  # what was not settled before has settled
                settled += self._unsettled
                self._unsettled.clear()
                self._newest_s.clear()
                self._settled_s, leapt = -math.inf, None
                self._feed.begin()
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
        self._feed.restore(memory[0])
        self.model.restore(memory[1])
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
    correction: Correction | None = None,
    initial_yaw_rad: float | None = None,
) -> Live:
    """Return a filter of :data:`LIVE_FILTERS`, or an observer, of a corrected robot before its first sample.

    Parameters
    ----------
    channels : of each stream that is measured, in the order of the columns of its readings
    correction : of :func:`terrain.extension.correct_live`
    initial_yaw_rad : of a filter of a swerve robot, heading of the start in the world; without it the GNSS is not used

    Raises
    ------
    ConfigError
        if filter, robot and channels do not fit, the robot is not corrected, or a number is out of its range.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> estimator = make_live_filter("vio15", load_robot("agrimaro"), CHANNELS)
    >>> wheels = Reading(np.array([0.0]), np.array([[20.0, 20.0, 20.0, 1.0, 1.0, 1.0]]))
    >>> _ = estimator.step({"wheels": wheels})
    >>> estimator.latest.wheel_speed_mps, estimator.latest.slip_stale
    (array([0.4, 0.4, 0.4]), True)
    """
    model: Observer
    source: Feed
    if name in OBSERVERS:
        model = make_observer(name, robot)
        terms = () if correction is None else correction.axle_terms
        source = ObserverFeed(robot, model.rows, channels, terms)
    else:
        model, source = swerve_live(name, robot, channels, initial_yaw_rad)
    return Live(model, source, robot, channels, correction)


def live_estimator(
    robot: Robot, channels: Mapping[str, tuple[str, ...]], correction: Correction | None = None
) -> Live:
    """Return the filter that suits a corrected robot and what is measured of it (:func:`~.choice.suitable_filter`)."""
    return make_live_filter(suitable_filter(robot, channels), robot, channels, correction)


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
    states = make_filter(name, robot).states
    return {"estimator": states, "slip": tuple(f"slip_{wheel}_ratio" for wheel in robot.wheels)}


def estimated_values(stream: str, estimate: LiveEstimate) -> Array:
    """Return a row of one of :data:`ESTIMATED`, in the order of :func:`estimated_channels`."""
    return estimate.slip if stream == "slip" else estimate.mean
