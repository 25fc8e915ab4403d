"""What is known of the sensors of a robot by its samples as they arrive, whatever filter takes them.

A speed over ground changes by what the accelerometer or the wheels show: what neither of those that are known
shows of a sample's change is a jump; what the accelerometer does not is summed up.  Both are judged by what is
usual while the robot moves, which its first seconds show.  Wheels are compared with each other, as the feed does:
where all of them turn evenly, their rates may be rounded; but all that is measured of them, their currents, does
not repeat.  Those of a robot that skids turn it as the gyro measures (:class:`TurnComparison`).  Of what measures the
motion over ground, and comes, none is gated but all, where the filter believes none of it.  A sensor of which nothing
has come yet is not judged: what a robot does not have is not missed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.estimation.feed import FIRST_WHEEL, LIVELY, LONGER, MOVING_MPS, REPEATED, REST_SEEN_MPS, SIGNALS
from terrain.estimation.health import (
    AT_REST_MPS,
    COMPARED_S,
    DISAGREES_MPS,
    LATE_PERIODS,
    LOST_AFTER_S,
    Evidence,
    Health,
    Sensor,
)
from terrain.estimation.live import LiveEstimate
from terrain.records import Array, Reading
from terrain.robots import Robot

FOLLOWING = 1.6  #: Samples that are so many periods apart follow each other.
LOST_PERIODS = 2.5  #: Of a sensor that is slower, so many of its periods make it lost.
REPEATED_S, N_REPEATED = 0.15, 2  #: Least time and number of repetitions of a sensor that is frozen.
BELIEVED_S = 5.0  #: A value that has jumped and stays is believed after this long.
#: So many samples have to stay where they jumped to: one alone is an outlier, which the filter gates.
N_JUMPED = 2
SPEED_JUMP_MPS, POSITION_JUMP_M = 0.15, 0.5  #: Least jump beyond what accelerometer and wheels show.
#: A jump over the median change of a speed, and over the deviation of a position; the median at first, and how many
#: samples move it.  An IMU that is shaken shows the change of a speed to as much.
JUMPS, JUMP_STD, SCATTER_MPS, N_SCATTER = 5.0, 4.5, 0.12, 25.0
#: Steps for which the accelerometer's integral is remembered: samples come late by a quarter of a second.
N_GAINED = 32
#: The median change of a speed of a robot that stands, and after which time it does; a speed that is no more than the
#: last is none.
REST_SCATTER_MPS, RESTS_S, NONE_MPS = 0.04, 0.5, 2.0 * REST_SEEN_MPS
SIGNED_MPS = 0.1  #: A robot that is slower may drive in either direction.
#: Gyro against wheels: memories of what they are apart by, and of the wheels' turn, which the body follows later; of
#: what is usual.  Further apart than the last number, than so many times its median, and than a part of the turn is a
#: gyro or a side that measures something else: the median is 0.005 rad/s on smooth ground, and 0.03 on rough one.
TURNS_S, FOLLOWS_S, USUAL_S, TURN_JUMPS, TURN_RATIO, TURN_RADPS = (0.1, 0.5), 0.5, 5.0, 7.0, 2.0, 0.06
OUTLIER_RADPS = 0.25  #: One sample that is further apart moves a memory by no more than this would.
_SPEEDS = ("camera_speed", "lidar_speed", "gnss_speed")
_REFERENCES = ("odometry", "lidar", "pose", "gnss")


class _Run:
    """How long values have repeated themselves to the last bit, and for how long they do by nature."""

    def __init__(self, most_s: float) -> None:
        self.most_s = most_s  #: as long as a run that was called frozen may count
        self.value: list[float] = []
        self.stamp_s = self.changed_s = math.nan
        self.longest_s, self.n_same, self.varies, self.was_frozen = 0.0, 0, False, False

    def take(self, stamp_s: float, value: list[float], moves: bool) -> None:
        """Take a sample."""
        if value == self.value:
            self.n_same += 1
        else:
            if moves and self.n_same:
                run_s = self.stamp_s - self.changed_s
                self.longest_s = max(self.longest_s, min(run_s, self.most_s) if self.was_frozen else run_s)
            self.varies |= bool(self.value)
            self.changed_s, self.n_same, self.was_frozen = stamp_s, 0, False
        self.value, self.stamp_s = value, stamp_s

    @property
    def is_long(self) -> bool:
        """Whether it repeats itself for longer than it ever did; what has never changed shows nothing."""
        long_s = max(REPEATED_S, LONGER * self.longest_s)
        return self.varies and self.n_same >= N_REPEATED and self.stamp_s - self.changed_s >= long_s


class _Seen:
    """What is remembered of a sensor."""

    def __init__(self, sensor: Sensor, channels: list[str]) -> None:
        self.sensor, self.is_reference = sensor, sensor.stream in _REFERENCES
        self.columns = [channels.index(name) for name in sensor.channels if name in channels]
        self.run = _Run(math.inf if sensor.stream == "wheels" else REPEATED_S)
        self.value, self.shown = np.empty(0), np.zeros(2)
        self.came_s, self.jumped_s, self.period_s, self.apart = math.nan, math.nan, 0.0, 0.0
        self.scatter = self.usual = SCATTER_MPS
        self.jumped, self.n_after, self.limit = np.zeros(1), 0, math.inf  # of one at rest
        self.jump, self.jump_per_s = math.inf, 0.0  # how far it may jump at once, and a second
        if sensor.name in _SPEEDS:
            self.jump = SPEED_JUMP_MPS
        elif sensor.name in ("pose", "gnss_position"):
            self.jump = POSITION_JUMP_M
        elif signal := SIGNALS.get(sensor.channels[0]):
            self.jump, self.jump_per_s = signal.jump, signal.jump_per_s


class TurnComparison(NamedTuple):
    """Gyro against the wheels of a robot that skids.

    They are apart by ``a = w - k (u_r - u_l) / B``, with the part k of the wheels' turn that is left by the filter.
    """

    apart_radps: Array = np.full(2, math.nan)  #: behind each memory
    scatter_radps: Array = np.full(2, TURN_RADPS / TURN_JUMPS)
    usual_radps: float = math.nan
    wheels_radps: float = math.nan  #: low-passed
    known_s: float = 0.0
    apart_s: float = 0.0  #: for which they have been apart as they are not by nature

    def after(self, gyro_radps: float, wheels_radps: float, dt_s: float) -> TurnComparison:
        """Return what is known after a step; an unknown rate shows nothing."""
        apart = gyro_radps - wheels_radps
        if not math.isfinite(apart):
            return self
        if math.isnan(self.usual_radps) or self.apart_s > BELIEVED_S:
            usual = apart if abs(wheels_radps) < TURN_RADPS else 0.0  # tight turns show nothing of it
            return TurnComparison(np.full(2, apart), self.scatter_radps, usual, wheels_radps)
        late, slow = (-math.expm1(-dt_s / time_s) for time_s in (FOLLOWS_S, USUAL_S))
        gap = np.clip(apart - self.apart_radps, -OUTLIER_RADPS, OUTLIER_RADPS)
        memories = self.apart_radps - np.expm1(-dt_s / np.array(TURNS_S)) * gap
        behind = self.wheels_radps + late * (wheels_radps - self.wheels_radps)
        beyond, known_s = np.abs(memories - self.usual_radps), self.known_s + dt_s
        scatter = self.scatter_radps * np.exp(slow * np.sign(beyond - self.scatter_radps))
        both = min(abs(wheels_radps), abs(gyro_radps)) if wheels_radps * gyro_radps > 0.0 else 0.0
        turning = abs(wheels_radps - behind) + TURN_RATIO * both
        limit = np.maximum(TURN_JUMPS * self.scatter_radps, TURN_RADPS) + turning
        if (beyond > limit).any() or (self.apart_s and beyond[0] > 0.5 * limit[0]):
            return TurnComparison(memories, scatter, self.usual_radps, behind, known_s, self.apart_s + dt_s)
        if turning > TURN_RADPS:
            return TurnComparison(memories, self.scatter_radps, self.usual_radps, behind, known_s)
        usual = self.usual_radps + max(slow, dt_s / known_s) * (float(memories[0]) - self.usual_radps)
        return TurnComparison(memories, scatter, usual, behind, known_s)


class StreamEvidence:
    """What is known of each sensor by its samples as they arrive, and the estimate before them.

    ``channels`` of each stream are in the order of the columns of its readings, ``states`` those of the filter: its
    delays count.

    Examples
    --------
    >>> from terrain.estimation.health import HealthMonitor, sensors_of
    >>> from terrain.robots import load_robot
    >>> channels = {"wheels": ("speed_left_mps", "speed_right_mps")}
    >>> sensors = sensors_of(load_robot("husky"), channels)
    >>> monitor, source = HealthMonitor(sensors), StreamEvidence(load_robot("husky"), channels, sensors)
    >>> wheels = Reading(np.array([0.0]), np.array([[0.5, 0.6]]))
    >>> monitor.judge(source.at(0.0, 0.02, {"wheels": wheels}, None))
    [0, 0]
    >>> monitor.judge(source.at(0.2, 0.2, {}, None))
    [7, 7]
    """

    def __init__(
        self,
        robot: Robot,
        channels: Mapping[str, Sequence[str]],
        sensors: Sequence[Sensor],
        states: Sequence[str] = (),
    ) -> None:
        self._widths = {stream: len(names) for stream, names in channels.items()}
        self._seen = [_Seen(sensor, list(channels[sensor.stream])) for sensor in sensors]
        self._gyro = next((seen for seen in self._seen if seen.sensor.name == "gyro"), None)
        self._n_rates, self._all_wheels = len(robot.rate_channels), _Run(REPEATED_S)
        self._travelled_m, self._ahead, self._sideways, self._rested_s = 0.0, 1.0, robot.sideways, 0.0
        delays = {"gnss": "gnss_delay_s", **dict.fromkeys(("odometry", "lidar"), "pose_delay_s")}
        self._delays = {stream: states.index(name) for stream, name in delays.items() if name in states}
        self._delay_s = dict.fromkeys(self._delays, 0.0)
        self._turns, self._track_m = TurnComparison(), robot.track_m if robot.skids else math.nan
        self._rates_radps: list[float] = []
        self._turn_loss = states.index("turn_loss_ratio") if "turn_loss_ratio" in states else None
        self._gained_mps = 0.0
        self._gained: deque[tuple[float, float, float]] = deque(maxlen=N_GAINED)

    def at(
        self, now_s: float, dt_s: float, readings: Mapping[str, Reading], motion: LiveEstimate | None
    ) -> list[Evidence]:
        """Take what arrived at a step, and the estimate before it; return what is known of each sensor."""
        age_s, moves, is_fast = 0.0, False, False
        if motion is not None and now_s - motion.time_s > LOST_AFTER_S:
            self._gained.clear()
            motion = None  # it waits for the wheels, and shows nothing
        if motion is not None:
            age_s = motion.reference_age_s + max(now_s - motion.time_s, 0.0)
            fastest_mps = float(np.nan_to_num(np.abs(motion.wheel_speed_mps)).max())
            is_fast = abs(motion.speed_x_mps) > AT_REST_MPS
            moves = fastest_mps > MOVING_MPS or is_fast
            self._rested_s = 0.0 if moves else self._rested_s + dt_s
            self._travelled_m += fastest_mps * dt_s
            self._remember_gain(now_s, dt_s, motion)
            self._compare_turns(dt_s, readings, motion)
            for stream, place in self._delays.items():
                self._delay_s[stream] = float(motion.mean[place])
            if abs(motion.speed_x_mps) > SIGNED_MPS:
                self._ahead = math.copysign(1.0, motion.speed_x_mps)
        if (rows := self._values(self._seen[0], readings)) is not None:
            for stamp_s, row in zip(readings["wheels"].time_s.tolist(), rows.tolist(), strict=True):
                self._all_wheels.take(stamp_s, [value for value in row if value == value], moves)
        for seen in self._seen:
            if (values := self._values(seen, readings)) is not None:
                stamps = readings[seen.sensor.stream].time_s.tolist()
                for stamp_s, row in zip(stamps, values[:, seen.columns], strict=True):
                    if stamp_s != seen.run.stamp_s and np.isfinite(row[:2]).all():
                        self._take(seen, now_s, stamp_s, row, moves)
        evidence = [self._judge(seen, now_s, moves, is_fast) for seen in self._seen]
        judged = [(one.health, seen) for one, seen in zip(evidence, self._seen, strict=True)]
        sound = [seen for health, seen in judged if seen.is_reference and health <= Health.LATE]
        periods_s = [seen.period_s for seen in sound if seen.period_s]
        gated = max(LOST_AFTER_S, LOST_PERIODS * min(periods_s, default=math.inf)) < age_s < math.inf
        apart = any(health == Health.DISAGREES and seen.sensor.name in _SPEEDS for health, seen in judged)
        for place, seen in enumerate(self._seen):
            if gated and seen.is_reference:
                evidence[place] = evidence[place]._replace(is_gated=True)
            if apart and seen.sensor.name == "accel":
                evidence[place] = evidence[place]._replace(disagrees=True)
        return evidence

    def mask(self, readings: dict[str, Reading], health: Sequence[int]) -> None:
        """Replace what sensors gave that are frozen or stepped by NaN: a filter must not learn from it."""
        for seen, status in zip(self._seen, health, strict=True):
            values = self._values(seen, readings) if status in (Health.FROZEN, Health.STEPPED) else None
            if values is not None:
                values, stream = values.copy(), seen.sensor.stream
                values[:, seen.columns] = math.nan
                readings[stream] = readings[stream]._replace(values=values)

    def _values(self, seen: _Seen, readings: Mapping[str, Reading]) -> Array | None:
        """Return what came of a sensor's stream; None of nothing, or of another number of columns."""
        reading = readings.get(seen.sensor.stream)
        fits = reading is not None and reading.values.shape[1:] == (self._widths[seen.sensor.stream],)
        return reading.values if reading is not None and fits else None

    def _remember_gain(self, now_s: float, dt_s: float, motion: LiveEstimate) -> None:
        """Remember by how much the speed ahead has grown by the accelerometer, and that of the wheels; NaN of neither.

        Of a robot that drives sideways neither is a speed ahead.
        """
        known = motion.wheel_speed_mps[np.isfinite(motion.wheel_speed_mps)]
        wheels_mps = float(known.mean()) if known.size and not self._sideways else math.nan
        gained_mps = math.nan
        if math.isfinite(motion.accel_x_mps2) and not self._sideways:
            gained_mps = self._gained_mps = self._gained_mps + motion.accel_x_mps2 * dt_s
        self._gained.append((now_s, gained_mps, wheels_mps))

    def _compare_turns(self, dt_s: float, readings: Mapping[str, Reading], motion: LiveEstimate) -> None:
        """Compare the middle one of the gyro's last rates with the turn that the wheels of a robot that skids make."""
        values = None if self._gyro is None else self._values(self._gyro, readings)
        if self._gyro is not None and values is not None and len(values):
            left, right = motion.wheel_speed_mps[[0, -1]].tolist()
            loss = 0.0 if self._turn_loss is None else float(motion.mean[self._turn_loss])
            turn_radps = (1.0 - loss) * (right - left) / self._track_m
            self._rates_radps = [*self._rates_radps[-2:], float(values[-1, self._gyro.columns[0]])]
            self._turns = self._turns.after(float(np.median(self._rates_radps)), turn_radps, dt_s)

    def _take(self, seen: _Seen, now_s: float, stamp_s: float, row: Array, moves: bool) -> None:
        """Remember a sample, and by how much it differs from what the one before lets expect."""
        sensor, run = seen.sensor, seen.run
        is_speed = sensor.name in _SPEEDS
        if sensor.name == "gnss_speed":
            row = np.array([*row, math.copysign(math.hypot(*row), self._ahead)])
        shown = np.array([self._travelled_m])
        if is_speed:  # at the sample's own instant, which may be a while ago
            gained = np.array(self._gained).reshape(-1, 3).T
            at_s = stamp_s - self._delay_s.get(sensor.stream, 0.0)
            shown = np.array(
                [np.interp(at_s, gained[0], one) if one.size else math.nan for one in gained[1:]]
            )
        before, n_same, passed_s = seen.value, run.n_same, stamp_s - run.stamp_s
        run.take(stamp_s, row[:2].tolist(), moves)
        if run.n_same >= N_REPEATED:  # it measures nothing: what it changes by then is no jump
            seen.jumped, seen.apart = np.zeros(1), 0.0
        elif 0.0 < passed_s < FOLLOWING * max(seen.period_s, 0.05) and n_same < N_REPEATED:
            change, by = row - before, shown - seen.shown
            limit, rests = seen.jump + seen.jump_per_s * passed_s, False
            if is_speed:
                by_accel, by_wheels = (change[-1] - by).tolist()
                known = [one for one in (by_accel, by_wheels) if math.isfinite(one)]
                change = np.array([min(known, key=abs) if known else change[-1]])
                if not known:  # what a robot can do
                    limit += SIGNALS["camera_speed_x_mps"].jump_per_s * passed_s
                rests = self._rested_s > RESTS_S
                limit = max(limit, JUMPS * (REST_SCATTER_MPS if rests else seen.scatter))
                gap = min(max(by_accel, -limit), limit) if math.isfinite(by_accel) else 0.0
                seen.apart = seen.apart * math.exp(-passed_s / COMPARED_S) + gap
                if moves:  # at rest nothing shakes
                    seen.scatter = _median(seen.scatter, abs(float(change[0])))
                    seen.usual = _median(seen.usual, abs(seen.apart))
            elif seen.is_reference:
                change = change[:2]
                limit += float(by[0]) + JUMP_STD * math.hypot(*np.nan_to_num([*before[2:], *row[2:]]))
            _sum_jumps(seen, stamp_s, change, limit, rests)
            if rests and abs(row[-1]) <= NONE_MPS:  # as it should be
                seen.jumped = np.zeros(1)
        if passed_s > 0.0:
            seen.period_s += (min(passed_s, 1.0) - seen.period_s) * (0.1 if seen.period_s else 1.0)
        seen.value, seen.came_s, seen.shown = row, now_s, shown

    def _judge(self, seen: _Seen, now_s: float, moves: bool, is_fast: bool) -> Evidence:
        """Return what is known of a sensor; of one that is silent nothing else."""
        sensor, run, whole = seen.sensor, seen.run, self._all_wheels
        age_s = now_s - seen.came_s
        lost_s = max(sensor.lost_s, LOST_PERIODS * seen.period_s)
        ages_s = age_s, LATE_PERIODS * seen.period_s or math.inf, lost_s
        if not age_s <= lost_s:
            return Evidence(*ages_s)
        if sensor.stream == "wheels":
            others, turns = (
                [one for one in self._seen[: self._n_rates] if one is not seen],
                bool(seen.value.any()),
            )
            is_long = run.is_long and run.n_same >= REPEATED[FIRST_WHEEL] and moves and turns
            is_long &= any(one.run.n_same <= LIVELY for one in others)
            # where it turns as evenly as another it is not
            run.was_frozen &= not any(one.value.any() and one.run.n_same > LIVELY for one in others)
            whole.was_frozen |= whole.is_long and len(whole.value) > self._n_rates
            is_long |= whole.was_frozen and (is_fast or (moves and turns))
        else:  # a steering angle that may not stay is seen not to follow its command
            is_long = run.is_long and moves and sensor.stream != "steering"
        run.was_frozen |= is_long  # at rest, too, until it changes
        is_frozen = run.was_frozen and run.n_same > 0
        has_jumped = bool(seen.jumped.any()) and seen.n_after >= N_JUMPED - 1
        disagrees = abs(seen.apart) > max(DISAGREES_MPS, JUMPS * seen.usual)
        disagrees |= self._turns.apart_s > 0.0 and (sensor.name == "gyro" or sensor.stream == "wheels")
        return Evidence(*ages_s, is_frozen, has_jumped, disagrees)


def _sum_jumps(seen: _Seen, stamp_s: float, change: Array, limit: float, rests: bool) -> None:
    """Sum up the jumps of a sensor, until it has jumped back or is believed.

    One that jumps on and on is no sensor that jumped: what it is compared with is wrong.
    """
    seen.n_after += 1
    if math.hypot(*change.tolist()) > limit:
        goes_on = seen.jumped.any() and seen.n_after == 1 and float(change @ seen.jumped) > 0.0
        seen.jumped = np.zeros(1) if goes_on else seen.jumped + change
        seen.jumped_s, seen.n_after, seen.limit = stamp_s, 0, limit if rests else math.inf
    if math.hypot(*seen.jumped.tolist()) <= min(limit, seen.limit) or stamp_s - seen.jumped_s > BELIEVED_S:
        seen.jumped = np.zeros(1)


def _median(before: float, size: float) -> float:
    """Return the median of sizes, moved towards one more: outliers move it no more than others."""
    return before * math.exp(math.copysign(1.0 / N_SCATTER, size - before))
