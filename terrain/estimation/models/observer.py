"""Observers of slip: one row of measurements in, what is known of the slip out; and what a row is made of.

A row holds what was measured at a tick of the wheels, NaN where a sensor gave nothing; it may be late,
wrong or absent, and what comes out is never infinite.  A whole log (:func:`rows_of`, :func:`observe`), a run sample by
sample (:class:`~terrain.estimation.live.Live`) and a simulated robot call the same step.

Most observers are a :class:`~terrain.estimation.filter.FilterModel` and what its inputs are:
:class:`FilterObserver`.

A tick is a sample of the wheels.  Of the IMU a row has the means of the samples since the tick before, or
the last one for up to :data:`HELD_S`; of the steering the last one.  A fix, a pose or a position of
satellites with the compass beside it, is in the row of the first tick after it, moved along its heading by
the speed times its age.  Samples that are not later than those before them are left out and counted; values
that are not finite are unknown.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.estimation.clocks import CLOCK_SET_S, Due, SampleQueue, check_channels
from terrain.estimation.feed import FIX_STD_M, FLOAT_STD_M, TICK_S, places_among
from terrain.estimation.filter import Filter, FilterModel, FilterSettings
from terrain.extension import rolling_axle
from terrain.learned_term import Factor, LearnedTerm
from terrain.records import GATED, REOPENED, USED, Array, RunLog
from terrain.robots import BicycleRobot, Robot
from terrain.status import StatusCode

LONGEST_STEP_S = 1.0
"""A longer time since the step before is no step: a robot may have done anything."""


INERTIAL_ROWS = ("yaw_rate_radps", "roll_rad", "pitch_rad", "accel_y_mps2", "accel_x_mps2")
"""Yaw rate of the gyro; roll (left side up positive) and pitch (nose up negative); specific force to the left and
ahead."""

PLACE_ROWS = ("position_x_m", "position_y_m", "yaw_rad")
"""Position and heading of the body's origin in a fixed right-handed frame, from poses, or satellites and a compass,
brought to the time of the tick."""

FIX_ROWS: Mapping[str, tuple[str, ...]] = {
    "gnss": ("gnss_x_m", "gnss_y_m", "gnss_std_m", "gnss_speed_x_mps", "gnss_speed_y_mps"),
    "pose": ("pose_x_m", "pose_y_m", "pose_yaw_rad"),
    "compass": ("compass_rad",),
    "camera": ("camera_x_mps", "camera_y_mps"),
}
"""What sensors of the motion over ground measured as they did, each with ``<sensor>_age_s``, the time from the stamp to
the tick: the antenna's position, its standard deviation and velocity in the world, a pose, a compass, and the body's
velocity by a camera or a lidar."""

HELD_S = 0.1
"""How long the last sample of IMU and steering stands for one that is missing: ten of an IMU's."""

TOGETHER_S = 0.06
"""A compass belongs to a position that is no further from it in time: half a period of 10 Hz, and more."""

LATE_S = 0.3
"""A fix that is older when its tick comes is left out: it would have to be moved along an unknown path."""

INACCURATE_M = 0.2
"""Standard deviation of a satellite fix from which on it is no fix: a float solution has half a metre."""

CLOCK_SET_SAMPLES = 10
"""So many samples in a row, a second behind the newest, are of a clock that was set back."""

CHANNELS: Mapping[str, tuple[str, ...]] = {
    "imu": ("gyro_z_radps", "roll_rad", "pitch_rad", "accel_y_mps2", "accel_x_mps2"),
    "pose": ("position_x_m", "position_y_m", "yaw_rad"),
    "gnss": (
        *("position_x_m", "position_y_m", "std_position_m"),
        *("velocity_x_mps", "velocity_y_mps", "fix_ratio"),
    ),
    "compass": ("yaw_rad",),
    "odometry": ("speed_x_mps", "speed_y_mps"),
    "lidar": ("speed_x_mps", "speed_y_mps"),
}
"""Channels that are read of each stream beside wheels and steering; those that a log lacks are unknown."""

STREAM_OF_FIX = {
    "gnss": ("gnss",),
    "pose": ("pose",),
    "compass": ("compass",),
    "camera": ("odometry", "lidar"),
}
"""Streams of each sensor of :data:`FIX_ROWS`; the first that is measured counts, and no lidar beside its own poses."""


class ObserverStatus(StatusCode):
    """What the estimates of an observer are worth at a tick."""

    OK = 0
    """Estimates follow measurements."""
    STARTING = 1
    """Nothing that estimates need was measured yet."""
    STANDING = 2
    """The robot stands; slip is as it was, and does not drift."""
    PREDICTED = 3
    """No fix for a while: slip is as it was, the pose is dead reckoning."""
    REJECTED = 4
    """A measurement that cannot be, a jump or a flip, was left out."""
    RESET = 5
    """The pose began anew where measurements persistently are; slip is as it was."""
    UNEXCITED = 6
    """A part of the slip is not observable in this motion, a stopped track say, and is as it was."""
    PUSHED = 7
    """The robot turns though its tracks stand."""
    BAD_INPUT = 8
    """Speeds or time are not numbers that can be; estimates are as they were."""
    STUCK = 9
    """The wheels turn the robot on the spot, and it does not turn."""


class ObserverOutput(NamedTuple):
    """What an observer knows at a tick."""

    mean: Array  #: (d,) estimates and one standard deviation of each, in the order of :attr:`Observer.states`
    std: Array
    slip: Array  #: (k,) in the order of :attr:`Observer.slips`; NaN where it is not observed
    slip_std: Array
    status: int  #: number of an :class:`ObserverStatus`


class _WithMemory:
    """What it remembers are its attributes; queues of samples are kept elsewhere."""

    def snapshot(self) -> dict[str, Any]:
        """Return all that is remembered, for :meth:`restore`."""
        return {name: _copy(value) for name, value in vars(self).items() if name != "queues"}

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Go back to a snapshot."""
        for name, value in memory.items():
            own = getattr(self, name)
            if isinstance(own, Filter):
                own.state[:] = value
            else:
                setattr(self, name, _copy(value))


def _copy(value: Any) -> Any:
    if isinstance(value, Filter):
        return value.state.copy()
    return value.copy() if isinstance(value, np.ndarray | dict) else value


class Observer(ABC, _WithMemory):
    """An observer of slip in use.

    Attributes
    ----------
    name : as ``terrain estimate --filter`` has it
    states : name of each estimate, with its unit
    slips : channels of the stream ``slip``: ``slip_<wheel>_ratio`` or, of an angle, ``slip_<wheel>_rad``
    rows : what it takes at a tick
    in_world : whether positions are in the frame of what measures them, and not from where the robot started
    reference_age_s : time since the motion over ground was measured; NaN where an observer does not tell
    accel_mps2 : acceleration ahead, without a sensor's bias; NaN where it is not known
    reason : why slip is not known, in a sentence; empty where it is, or an observer does not tell
    """

    name: str
    states: tuple[str, ...]
    slips: tuple[str, ...]
    rows: tuple[str, ...]
    in_world = False
    reference_age_s, accel_mps2, reason = math.nan, math.nan, ""
    kept: Filter | None = (
        None  #: what may be kept over a restart; None of one that starts from its first samples
    )
    #: of each sensor at the last tick, as :func:`~terrain.estimation.health.sensors_of`; (0,) where none is judged
    health = np.empty(0, np.int8)

    @property
    def health_names(self) -> dict[str, str]:
        """Health of each sensor by name; empty where none is judged."""
        return {}

    @property
    def dropped(self) -> dict[str, int]:
        """What it did not believe, as counts by kind."""
        return {}

    def ahead(self, mean: Array, dt_s: float) -> Array | None:
        """Return a mean (d,) predicted to a later time; None where it is not."""
        return None

    @abstractmethod
    def step(self, row: Array, dt_s: float) -> ObserverOutput:
        """Take a row (m,) that comes a time after the one before, 0 at first; return what is known then."""


def status_of_use(use: Array) -> ObserverStatus:
    """Return what became of sensors (k,) at a tick, as a filter has it: OK, or that one was left out or reopened."""
    if (use == REOPENED).any():
        return ObserverStatus.RESET
    return ObserverStatus.REJECTED if (use == GATED).any() else ObserverStatus.OK


class FilterObserver(Observer):
    """An observer that is a filter: a subclass makes its inputs of a row, and its slips of the state.

    Parameters
    ----------
    model, settings : of the filter

    Attributes
    ----------
    filter : with its state, which is all that is remembered but the inputs of the last tick
    age_s : (k,) time since each sensor was used, infinite before
    """

    def __init__(self, model: FilterModel, settings: FilterSettings) -> None:
        self.filter = Filter(model, settings)
        self.name = model.name
        self.age_s = np.full(len(model.sensors), np.inf)
        self._time_s = 0.0

    def advance(
        self,
        dt_s: float,
        z: Array,
        inputs: Array,
        walk: Array | None = None,
        variance: Array | None = None,
        n_judged: int | None = None,
    ) -> ObserverStatus:
        """Take a tick into the filter; return OK, or REJECTED or RESET where a sensor was left out or reopened.

        Parameters are those of :meth:`terrain.estimation.filter.Filter.step`; the first ``n_judged`` sensors count.
        """
        self._time_s += dt_s
        self.filter.step(self._time_s, z, variance, walk, inputs)
        use = self.filter.use
        self.age_s += dt_s
        self.age_s[(use == USED) | (use == REOPENED)] = 0.0
        return status_of_use(use[:n_judged])

    @property
    def dropped(self) -> dict[str, int]:
        """What the filter did not take."""
        return self.filter.dropped

    def read(self, function: Any, inputs: Array) -> tuple[Array, Array]:
        """Return what a compiled function makes of state and parameters, and one standard deviation of each.

        It returns its values (n,), and their derivatives (n, d) by the state.
        """
        mean, by_x = function(self.filter.mean, np.append(self.filter.model.params, inputs))
        variance = np.einsum("ij,jk,ik->i", by_x, self.filter.cov, by_x)
        return mean, np.sqrt(np.maximum(variance, 0.0))


class Feed(ABC, _WithMemory):
    """Rows of a filter or an observer from the samples of a robot as they come.

    Parameters
    ----------
    robot : whose they are
    channels : names of the columns of each stream; ``ConfigError`` if the wheels have no speed of the robot's
    read : channels that are read of each stream beside the wheels, those that it lacks as NaN

    Attributes
    ----------
    queues : of the streams beside the wheels that are read
    last_s : stamp of the last tick; minus infinity before the first
    speeds_mps, motor_radps : of the logged wheels at the last tick
    period_s : of ticks that go on where the wheels give nothing; 0 for none
    """

    period_s = 0.0

    def __init__(
        self, robot: Robot, channels: Mapping[str, tuple[str, ...]], read: Mapping[str, Sequence[str]]
    ) -> None:
        wheels = channels.get("wheels", ())
        check_channels("wheels", robot.rate_channels, wheels)
        self._robot, self.last_s = robot, -math.inf
        self._rate_columns = places_among(robot.rate_channels, wheels)
        self.speeds_mps = self.motor_radps = np.full(len(robot.rate_channels), math.nan)
        self.queues = {
            stream: SampleQueue(places_among(names, channels[stream]))
            for stream, names in read.items()
            if channels.get(stream)
        }

    @property
    def counts(self) -> dict[str, int]:
        """What was left out, as counts by stream and kind."""
        queued = {
            f"{name}: {kind}": n for name, queue in self.queues.items() for kind, n in queue.counts.items()
        }
        return dict(+(Counter(queued) + self.dropped))

    @property
    @abstractmethod
    def dropped(self) -> Counter[str]:
        """What was left out of what the queues gave, and of the wheels."""

    @abstractmethod
    def begin(self) -> None:
        """Begin anew after a clock was set back."""

    @abstractmethod
    def follows(self, time_s: float) -> int:
        """Return what a stamp of the wheels is: 1 taken, -1 of a clock that was set back, 0 not taken, and counted."""

    @abstractmethod
    def tick(self, time_s: float, wheels: Array | None, due: Mapping[str, Due]) -> Array:
        """Return the row (m,) of a tick, of the samples that came since the last; None of wheels that gave nothing."""


class ObserverFeed(Feed):
    """Rows of an observer: means of the samples since the tick before, and fixes with their age.

    Parameters
    ----------
    robot, channels : of :class:`Feed`
    rows : those that the observer takes
    terms : learned motion of a car-like robot (:attr:`terrain.extension.Correction.axle_terms`)
    """

    def __init__(
        self,
        robot: Robot,
        rows: tuple[str, ...],
        channels: Mapping[str, tuple[str, ...]],
        terms: Sequence[LearnedTerm] = (),
    ) -> None:
        self._terms, self._speeds = tuple(terms), list(map("speed_{}_mps".format, robot.logged_wheels))
        self.mps_per_rate = robot.wheel_radius_m / robot.reduction_ratio if robot.by_motor else 1.0
        self._rows, self._takes_place = rows, "position_x_m" in rows
        self._fixes: dict[str, str] = {}
        for sensor, streams in STREAM_OF_FIX.items():
            measured = [stream for stream in streams if channels.get(stream)]
            if (
                FIX_ROWS[sensor][0] in rows
                and measured
                and not ("lidar" in measured and "pose" in self._fixes)
            ):
                self._fixes[sensor] = measured[0]
        self._channels = {"steering": robot.steer_channels, **CHANNELS}
        read = {"steering", "imu", *self._fixes.values()}
        read |= {"pose", "gnss", "compass"} if self._takes_place else set()
        super().__init__(
            robot, channels, {name: self._channels[name] for name in self._channels if name in read}
        )
        self._dropped: Counter[str] = Counter()
        self.begin()

    @property
    def dropped(self) -> Counter[str]:
        """Wheels not later than the sample before, late or inaccurate fixes, and clocks that were set back."""
        return self._dropped

    def begin(self) -> None:
        """Begin anew: nothing was measured before."""
        self.last_s = -math.inf
        self._lags: list[dict[Factor, Array]] = [{} for _ in self._terms]
        for queue in self.queues.values():
            queue.taken_s = -math.inf
        self._held: dict[tuple[str, int], tuple[float, float]] = {}
        self._heading, self._n_behind = (-math.inf, math.nan), 0

    def follows(self, time_s: float) -> int:
        """Return what a stamp of the wheels is, as :class:`Feed`."""
        before_s = self.last_s
        if before_s < time_s < math.inf:
            self._n_behind = 0
            return 1
        self._n_behind = self._n_behind + 1 if time_s <= before_s - CLOCK_SET_S else 0
        is_set = self._n_behind >= CLOCK_SET_SAMPLES
        self._dropped["time: clock set" if is_set else "wheels: stamp does not increase"] += 1
        return -1 if is_set else 0

    def tick(self, time_s: float, wheels: Array | None, due: Mapping[str, Due]) -> Array:
        """Return the row (m,) at a sample of the wheels, of the samples of other streams that came since the last."""
        assert wheels is not None  # there are no ticks without
        step_s, self.last_s = time_s - self.last_s, time_s
        for name, samples in due.items():
            if not samples and self.queues[name].n_behind >= CLOCK_SET_SAMPLES:  # its own clock was set back
                self._dropped["time: clock set"] += 1
                self.queues[name].taken_s, self.queues[name].n_behind = -math.inf, 0
        row = dict.fromkeys(self._rows, math.nan)
        rates = wheels[self._rate_columns]
        self.speeds_mps = rates * self.mps_per_rate
        speeds = dict(zip(self._speeds, self.speeds_mps.tolist(), strict=True))
        if self._robot.by_motor:
            self.motor_radps = rates
        row |= speeds | dict(zip(INERTIAL_ROWS, self._means("imu", time_s, due), strict=True))
        row |= zip(self._robot.steer_rows, self._means("steering", time_s, due, last=True), strict=True)
        if self._terms and isinstance(self._robot, BicycleRobot):
            # what is remembered before a tick may be gone back to
            self._lags = [{factor: lag.copy() for factor, lag in own.items()} for own in self._lags]
            (name, speed), angle = *speeds.items(), row["steer_front_rad"]
            row[name], row["steer_front_rad"] = rolling_axle(
                self._robot, self._terms, speed, angle, step_s, self._lags
            )
        if self._takes_place:
            mean_mps = sum(speeds.values()) / len(speeds)
            row |= zip(PLACE_ROWS, self._fix(time_s, mean_mps, due), strict=True)
        for sensor, stream in self._fixes.items():
            row |= self._measured(sensor, stream, time_s, due)
        return np.array([row[name] for name in self._rows])

    def _means(self, stream: str, time_s: float, due: Mapping[str, Due], last: bool = False) -> list[float]:
        """Return mean, or last, of what is known of each channel since the tick before; else the last known, held."""
        samples, means = [(stamp_s, sample.tolist()) for stamp_s, _, sample in due.get(stream, ())], []
        for k in range(len(self._channels[stream])):
            known = [(stamp_s, sample[k]) for stamp_s, sample in samples if not math.isnan(sample[k])]
            if known:
                self._held[stream, k] = known[-1]
            stamp_s, value = self._held.get((stream, k), (-math.inf, math.nan))
            if known and not last:
                means.append(sum(value for _, value in known) / len(known))
            else:
                means.append(value if time_s - stamp_s <= HELD_S else math.nan)
        return means

    def _measured(self, sensor: str, stream: str, time_s: float, due: Mapping[str, Due]) -> dict[str, float]:
        """Return the last sample since the tick before of which anything is known, as it was measured, and its age."""
        for stamp_s, _, values in reversed(due.get(stream, ())):
            sample = values.tolist()
            if time_s - stamp_s > LATE_S:
                self._dropped[f"{stream}: late"] += 1
            elif not all(map(math.isnan, sample[:2])) or (sensor == "gnss" and not math.isnan(sample[3])):
                if sensor == "gnss" and not sample[2] > 0.0:
                    sample[2] = FIX_STD_M if sample[5] >= 0.5 else FLOAT_STD_M
                found = dict(zip(FIX_ROWS[sensor], sample, strict=False))
                return found | {f"{sensor}_age_s": time_s - stamp_s}
        return {}

    def _known(self, stream: str, time_s: float, due: Mapping[str, Due]) -> tuple[float, list[float]] | None:
        """Return the last sample since the tick before that is known, accurate and not late; None without."""
        last = None
        for stamp_s, _, values in due.get(stream, ()):
            sample = values.tolist()
            if any(math.isnan(value) for value in (sample[:2] if stream == "gnss" else sample)):
                continue
            if time_s - stamp_s > LATE_S:
                self._dropped[f"{stream}: late"] += 1
            elif stream == "gnss" and sample[2] > INACCURATE_M:
                self._dropped["gnss: inaccurate"] += 1
            else:
                last = (stamp_s, sample)
        return last

    def _fix(self, time_s: float, speed_mps: float, due: Mapping[str, Due]) -> tuple[float, float, float]:
        """Return position and heading of the last fix since the tick before, brought to this one."""
        pose, fix, heading = (self._known(name, time_s, due) for name in ("pose", "gnss", "compass"))
        if heading is not None:
            self._heading = (heading[0], heading[1][0])
        if pose is not None:
            stamp_s, (x, y, yaw) = pose
        elif fix is not None:
            stamp_s, (x, y, *_) = fix
            yaw = self._heading[1] if abs(stamp_s - self._heading[0]) <= TOGETHER_S else math.nan
        else:
            return math.nan, math.nan, math.nan if heading is None else heading[1][0]
        moved = speed_mps * (time_s - stamp_s)
        if math.isfinite(moved) and math.isfinite(yaw):
            x, y = x + moved * math.cos(yaw), y + moved * math.sin(yaw)
        return x, y, yaw


def rows_of(
    run: RunLog, robot: Robot, rows: tuple[str, ...], terms: Sequence[LearnedTerm] = ()
) -> tuple[Array, Array, dict[str, int]]:
    """Return times (n,) and rows (n, m) of all ticks of a run, as they would come live, and what was dropped.

    Raises
    ------
    ConfigError
        if the wheels have no speed that the observer takes.
    DataError
        if the run has no wheels.
    """
    if "wheels" not in run.streams or len(run.streams["wheels"]) == 0:
        raise DataError(f"{run.run_id}: it has no stream wheels")
    feed = ObserverFeed(robot, rows, {name: stream.channels for name, stream in run.streams.items()}, terms)
    wheels, times, found = run.streams["wheels"], [], []
    edges = {
        name: [0, *np.searchsorted(run.streams[name].time_s, wheels.time_s + TICK_S, side="right").tolist()]
        for name in feed.queues
    }
    for k, time_s in enumerate(wheels.time_s.tolist()):
        for name, queue in feed.queues.items():
            stream, new = run.streams[name], slice(*edges[name][k : k + 2])
            if new.start < new.stop:
                queue.push(stream.time_s[new], stream.values[new])
        follows = feed.follows(time_s)
        if follows < 0:
            feed.begin()
        if follows != 0:
            due = {name: queue.take(time_s) for name, queue in feed.queues.items()}
            times.append(time_s)
            found.append(feed.tick(time_s, wheels.values[k], due))
    return np.array(times), np.array(found).reshape(len(found), len(rows)), feed.counts


class ObserverTrack(NamedTuple):
    """Estimates of an observer over a run."""

    time_s: Array  #: (n,)
    states: tuple[str, ...]  #: names of the columns
    slips: tuple[str, ...]
    mean: Array  #: (n, d)
    std: Array
    slip: Array  #: (n, k); NaN where slip is not observed
    slip_std: Array
    status: Array  #: (n,) numbers of :class:`ObserverStatus`

    def state(self, name: str) -> Array:
        """Return the mean (n,) of one state; ``ValueError`` when there is none of that name."""
        return self.mean[:, self.states.index(name)]


def observe(observer: Observer, time_s: Array, rows: Array) -> ObserverTrack:
    """Run an observer over the rows of a whole log.

    Parameters
    ----------
    observer : before its first step
    time_s, rows : (n,) rising stamps of the ticks, and (n, m) of :attr:`Observer.rows`
    """
    steps_s = np.diff(time_s, prepend=time_s[:1]).tolist()
    outputs = [observer.step(row, dt_s) for dt_s, row in zip(steps_s, rows, strict=True)]
    d, k = len(observer.states), len(observer.slips)
    mean, std, slip, slip_std = (
        np.array([output[i] for output in outputs]).reshape(len(time_s), size)
        for i, size in enumerate((d, d, k, k))
    )
    status = np.array([output.status for output in outputs], dtype=np.int64)
    return ObserverTrack(time_s, observer.states, observer.slips, mean, std, slip, slip_std, status)
