"""Health of the sensors of a robot of any drive by what comes of their streams, whatever filter takes them.

As :mod:`terrain.estimation.health` has it of the filters of swerve robots, of samples as they arrive::

    lost        nothing that is a number came for a quarter of a second, or two and a half of its periods
    frozen      it repeats itself to the last bit on a robot that moves, four times longer than it has before; what has
                never changed, as the pitch of an IMU that measures none, shows nothing
    stepped     its value jumped as no robot moves, and has not jumped back; after some seconds it is believed
    disagrees   speed over ground and accelerometer measure different changes of the speed
    gated       what measures the motion over ground comes, and the filter has believed none of it for as long

A speed over ground changes by what the accelerometer or the wheels show: what neither shows of a sample's change is a
jump; what the accelerometer does not is summed up over :data:`~terrain.estimation.health.COMPARED_S`.  Both are judged
by what is usual while the robot moves, which its first seconds show.  A sensor of which nothing has come yet is not
judged: what a robot does not have is not missed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.estimation.feed import LONGER, MOVING_MPS, SIGNALS
from terrain.estimation.health import (
    AT_REST_MPS,
    COMPARED_S,
    DISAGREES_MPS,
    LOST_AFTER_S,
    WHEELS_LOST_S,
    Health,
)
from terrain.estimation.live import LiveEstimate
from terrain.records import Array, Reading
from terrain.robots import Robot

FOLLOWING = 1.6  #: Samples that are so many periods apart follow each other.
LATE_PERIODS = 2.5  #: Of a sensor that is slower, so many of its periods make it lost.
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
SIGNED_MPS = 0.1  #: A robot that is slower may drive in either direction.
#: Sensors of each stream but the wheels, each with its channels; of a position and a velocity all have to repeat.
SENSORS_OF: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "imu": {"gyro": ("gyro_z_radps",), "accel": ("accel_x_mps2",), "tilt": ("pitch_rad",)},
    "steering": {"steering": ()},
    "odometry": {"camera_speed": ("speed_x_mps",)},
    "lidar": {"lidar_speed": ("speed_x_mps",)},
    "pose": {"pose": ("position_x_m", "position_y_m")},
    "gnss": {
        "gnss_position": ("position_x_m", "position_y_m", "std_position_m"),
        "gnss_speed": ("velocity_x_mps", "velocity_y_mps"),
    },
}
_SPEEDS = ("camera_speed", "lidar_speed", "gnss_speed")
_REFERENCES = ("odometry", "lidar", "pose", "gnss")


class _Sensor(NamedTuple):
    """A sensor: its stream, its columns, how far it may jump at once and a second, and after which time it is lost."""

    name: str
    stream: str
    columns: list[int]
    jump: float
    jump_per_s: float
    lost_s: float


class _Seen:
    """What is remembered of a sensor."""

    __slots__ = (
        *("apart", "came_s", "changed_s", "is_frozen", "jumped", "jumped_s", "longest_s"),
        *("n_after", "n_same", "period_s", "scatter", "shown", "stamp_s", "usual", "value", "varies"),
    )

    def __init__(self) -> None:
        self.value = np.empty(0)
        self.stamp_s = self.came_s = self.changed_s = self.jumped_s = math.nan
        self.period_s = self.longest_s = self.apart = 0.0
        self.shown = np.zeros(2)
        self.scatter = self.usual = SCATTER_MPS
        self.jumped = np.zeros(1)
        self.n_same = self.n_after = 0
        self.is_frozen = self.varies = False


class StreamHealth:
    """Judges the sensors of a robot, step by step.

    ``channels`` of each stream are in the order of the columns of its readings, ``states`` those of the filter: its
    delays count.

    Attributes
    ----------
    names : of the sensors
    health : of each, as :class:`~terrain.estimation.health.Health`

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> judge = StreamHealth(load_robot("husky"), {"wheels": ("speed_left_mps", "speed_right_mps")})
    >>> wheels = Reading(np.array([0.0]), np.array([[0.5, 0.6]]))
    >>> judge.step(0.0, 0.02, {"wheels": wheels}, None), judge.names
    ([0, 0], ('wheel_left', 'wheel_right'))
    >>> judge.step(0.2, 0.2, {}, None)
    [7, 7]
    """

    def __init__(
        self, robot: Robot, channels: Mapping[str, Sequence[str]], states: Sequence[str] = ()
    ) -> None:
        places = {stream: list(names) for stream, names in channels.items()}
        self._widths = {stream: len(names) for stream, names in places.items()}
        self._sensors = [
            _Sensor(f"wheel_{wheel}", "wheels", [places["wheels"].index(rate)], math.inf, 0.0, WHEELS_LOST_S)
            for wheel, rate in zip(robot.logged_wheels, robot.rate_channels, strict=True)
        ]
        for stream, sensors in SENSORS_OF.items():
            for name, own in sensors.items():
                named = own or robot.steer_channels
                named = tuple(name for name in named if name in places.get(stream, ()))
                if named and named[0] == (own or named)[0]:
                    columns = [places[stream].index(channel) for channel in named]
                    self._sensors.append(_Sensor(name, stream, columns, *_jump(name, named[0]), LOST_AFTER_S))
        self.names = tuple(sensor.name for sensor in self._sensors)
        self.health = [int(Health.FRESH)] * len(self.names)
        self._seen = [_Seen() for _ in self.names]
        self._travelled_m, self._ahead, self._sideways = 0.0, 1.0, robot.sideways
        delays = {"gnss": "gnss_delay_s", **dict.fromkeys(("odometry", "lidar"), "pose_delay_s")}
        self._delays = {stream: states.index(name) for stream, name in delays.items() if name in states}
        self._delay_s = dict.fromkeys(self._delays, 0.0)
        self._gained: deque[tuple[float, float, float]] = deque(maxlen=N_GAINED)

    def step(
        self, now_s: float, dt_s: float, readings: Mapping[str, Reading], motion: LiveEstimate | None
    ) -> list[int]:
        """Take what arrived at a step, and the estimate before it; return the health of each sensor."""
        age_s, moves = 0.0, False
        if (
            motion is not None and now_s - motion.time_s > LOST_AFTER_S
        ):  # it waits for the wheels, and shows nothing
            self._gained.clear()
            motion = None
        if motion is not None:
            age_s = motion.reference_age_s + max(now_s - motion.time_s, 0.0)
            fastest_mps = float(np.nan_to_num(np.abs(motion.wheel_speed_mps)).max())
            moves = fastest_mps > MOVING_MPS or abs(motion.speed_x_mps) > AT_REST_MPS
            self._travelled_m += fastest_mps * dt_s
            if not math.isfinite(motion.accel_x_mps2) or self._sideways:
                self._gained.clear()
            else:
                gained_mps = self._gained[-1][1] if self._gained else 0.0
                known = motion.wheel_speed_mps[np.isfinite(motion.wheel_speed_mps)]
                wheels_mps = float(known.mean()) if known.size else math.nan
                self._gained.append((now_s, gained_mps + motion.accel_x_mps2 * dt_s, wheels_mps))
            for stream, place in self._delays.items():
                self._delay_s[stream] = float(motion.mean[place])
            if abs(motion.speed_x_mps) > SIGNED_MPS:
                self._ahead = math.copysign(1.0, motion.speed_x_mps)
        disagrees, period_s = False, math.inf
        for place, (sensor, seen) in enumerate(zip(self._sensors, self._seen, strict=True)):
            if (values := self._values(sensor, readings)) is not None:
                stamps = readings[sensor.stream].time_s.tolist()
                for stamp_s, row in zip(stamps, values[:, sensor.columns], strict=True):
                    if stamp_s != seen.stamp_s and np.isfinite(row[:2]).all():
                        self._take(sensor, seen, now_s, stamp_s, row, moves)
            self.health[place] = health = int(self._judge(sensor, seen, now_s, moves))
            disagrees |= health == Health.DISAGREES
            if sensor.stream in _REFERENCES and health <= Health.LATE and seen.period_s > 0.0:
                period_s = min(period_s, seen.period_s)
        gated = max(LOST_AFTER_S, LATE_PERIODS * period_s) < age_s < math.inf
        for place, sensor in enumerate(self._sensors):
            if gated and sensor.stream in _REFERENCES:
                self.health[place] = max(self.health[place], int(Health.GATED))
            if disagrees and sensor.name == "accel":
                self.health[place] = max(self.health[place], int(Health.DISAGREES))
        return self.health

    def mask(self, readings: dict[str, Reading]) -> None:
        """Replace what sensors gave that are frozen or stepped by NaN: a filter must not learn from it."""
        for sensor, health in zip(self._sensors, self.health, strict=True):
            values = self._values(sensor, readings) if health in (Health.FROZEN, Health.STEPPED) else None
            if values is not None:
                values = values.copy()
                values[:, sensor.columns] = math.nan
                readings[sensor.stream] = readings[sensor.stream]._replace(values=values)

    def _values(self, sensor: _Sensor, readings: Mapping[str, Reading]) -> Array | None:
        """Return what came of a sensor's stream; None of nothing, or of another number of columns."""
        reading = readings.get(sensor.stream)
        fits = reading is not None and reading.values.shape[1:] == (self._widths[sensor.stream],)
        return reading.values if reading is not None and fits else None

    def _take(
        self, sensor: _Sensor, seen: _Seen, now_s: float, stamp_s: float, row: Array, moves: bool
    ) -> None:
        """Remember a sample, and by how much it differs from what the one before lets expect."""
        is_speed = sensor.name in _SPEEDS
        if sensor.name == "gnss_speed":
            row = np.array([*row, math.copysign(math.hypot(*row), self._ahead)])
        shown = np.array([self._travelled_m])
        if is_speed:  # at the sample's own instant, which may be a while ago
            gained = np.array(self._gained).reshape(-1, 3).T
            at_s = stamp_s - self._delay_s.get(sensor.stream, 0.0)
            shown = np.array(
                [np.interp(at_s, gained[0], row) if row.size else math.nan for row in gained[1:]]
            )
        before, passed_s = seen.value, stamp_s - seen.stamp_s
        same = before.size > 0 and bool((row[:2] == before[:2]).all())
        if same and seen.n_same + 1 >= N_REPEATED:  # it measures nothing: what it changes by then is no jump
            seen.jumped, seen.apart = np.zeros(1), 0.0
        elif (
            before.size and 0.0 < passed_s < FOLLOWING * max(seen.period_s, 0.05) and seen.n_same < N_REPEATED
        ):
            change, by = row - before, shown - seen.shown
            limit = sensor.jump + sensor.jump_per_s * passed_s
            if is_speed:
                by_accel, by_wheels = (float(one) for one in np.nan_to_num(change[-1] - by))
                change = np.array([min(by_accel, by_wheels, key=abs)])
                limit = max(limit, JUMPS * seen.scatter)
                bounded = min(max(by_accel, -limit), limit)
                seen.apart = seen.apart * math.exp(-passed_s / COMPARED_S) + bounded
                if moves:  # at rest nothing shakes
                    seen.scatter = _median(seen.scatter, abs(float(change[0])))
                    seen.usual = _median(seen.usual, abs(seen.apart))
            elif sensor.stream in _REFERENCES:
                change = change[:2]
                limit += float(by[0]) + JUMP_STD * math.hypot(*np.nan_to_num([*before[2:], *row[2:]]))
            self._jump(seen, stamp_s, change, limit)
        if before.size and passed_s > 0.0:
            seen.period_s += (min(passed_s, 1.0) - seen.period_s) * (0.1 if seen.period_s else 1.0)
        if not same:
            seen.varies |= before.size > 0
            if moves and seen.n_same:
                seen.longest_s = max(seen.longest_s, min(seen.stamp_s - seen.changed_s, REPEATED_S))
            seen.changed_s = stamp_s
        seen.n_same = seen.n_same + 1 if same else 0
        seen.value, seen.stamp_s, seen.came_s, seen.shown = row, stamp_s, now_s, shown

    @staticmethod
    def _jump(seen: _Seen, stamp_s: float, change: Array, limit: float) -> None:
        """Sum up the jumps of a sensor, until it has jumped back or is believed.

        One that jumps on and on is no sensor that jumped: what it is compared with is wrong.
        """
        seen.n_after += 1
        if math.hypot(*change.tolist()) > limit:
            goes_on = seen.jumped.any() and seen.n_after == 1 and float(change @ seen.jumped) > 0.0
            seen.jumped = np.zeros(1) if goes_on else seen.jumped + change
            seen.jumped_s, seen.n_after = stamp_s, 0
        if math.hypot(*seen.jumped.tolist()) <= limit or stamp_s - seen.jumped_s > BELIEVED_S:
            seen.jumped = np.zeros(1)

    def _judge(self, sensor: _Sensor, seen: _Seen, now_s: float, moves: bool) -> int:
        if math.isnan(seen.came_s):
            return Health.FRESH
        if now_s - seen.came_s > max(sensor.lost_s, LATE_PERIODS * seen.period_s):
            return Health.LOST
        repeated_s = seen.stamp_s - seen.changed_s
        is_long = repeated_s >= max(REPEATED_S, LONGER * seen.longest_s) and seen.n_same >= N_REPEATED
        # a wheel may stand; one that may not is seen not to follow its command
        may_repeat = sensor.stream == "steering" or (sensor.stream == "wheels" and not seen.value.any())
        seen.is_frozen = (
            is_long and seen.varies and not may_repeat and (moves or seen.is_frozen)
        )  # at rest, too, until it changes
        if seen.is_frozen:
            return Health.FROZEN
        if seen.jumped.any() and seen.n_after >= N_JUMPED - 1:
            return Health.STEPPED
        return Health.DISAGREES if abs(seen.apart) > max(DISAGREES_MPS, JUMPS * seen.usual) else Health.FRESH


def _median(before: float, size: float) -> float:
    """Return the median of sizes, moved towards one more: outliers move it no more than others."""
    return before * math.exp(math.copysign(1.0 / N_SCATTER, size - before))


def _jump(name: str, channel: str) -> tuple[float, float]:
    """Return how far a sensor may jump from sample to sample, at once and a second."""
    if name in _SPEEDS:
        return SPEED_JUMP_MPS, 0.0
    if name in ("pose", "gnss_position"):
        return POSITION_JUMP_M, 0.0
    signal = SIGNALS.get(channel)
    return (math.inf, 0.0) if signal is None else (signal.jump, signal.jump_per_s)
