"""Health of each sensor of a robot: whether what it measures can be built on, and if not, why.

::

    frozen      it repeats itself to the last bit while the robot moves, longer than it does by nature
    stepped     its value jumped as no robot moves, and has not jumped back
    lost        nothing of it was taken for a quarter of a second, of a wheel for a tenth, or for some of its periods
    disagrees   it and another sensor measure different motions
    gated       it comes, and the filter has not believed it for a while
    reopened    the filter has just believed it again: a wheel that slips anew, a yaw that was set
    late        what it measured last is older than three of its periods
    fresh       none of these

States, sensors and rules are the same for every drive; what is known of each sensor (:class:`Evidence`) is found where
its samples are judged.  The feed of swerve robots leaves out what is frozen or has jumped by itself, live as in a whole
log: :class:`FeedEvidence` asks it, and the filter.  Of others :class:`StreamEvidence` looks at the samples as they
arrive, and :meth:`StreamEvidence.mask` keeps them from whatever filter takes them.

Speed over ground against accelerometer: ``m <- m exp(-dt / 0.4 s) + dv - a dt``, of a swerve robot with bias and
Coriolis, which a step of the speed moves by its size, and an error e of the acceleration (a pitch that is wrong by
e / g) by 0.4 s times e.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from terrain.estimation.feed import (
    ACCEL,
    FIRST_CAMERA,
    FIRST_SIGNAL,
    FIRST_SPEED,
    FIRST_WHEEL,
    GYRO,
    IMU_YAW,
    LONGER,
    MOVING_MPS,
    REPEATED,
    SEEN,
    SEEN_TURN,
    SEEN_YAW,
    TILT,
    places_among,
)
from terrain.estimation.filter import Filter
from terrain.records import ABSENT, GATED, REOPENED, Array
from terrain.robots import Robot


class Health(IntEnum):
    """What a sensor is, by rising seriousness; up to :data:`SOUND` it is built on."""

    FRESH = 0
    LATE = 1
    REOPENED = 2
    GATED = 3
    DISAGREES = 4
    STEPPED = 5
    FROZEN = 6
    LOST = 7


SOUND = Health.REOPENED

LOST_AFTER_S, WHEELS_LOST_S = 0.25, 0.1
LATE_PERIODS = 3.0
AT_REST_MPS = 0.1  #: A robot that is faster is not at rest, whatever its wheels measure.
N_STUCK = 4  #: Repetitions of all that the wheels measure, from which on they are frozen.
#: Memory of speed against accelerometer, and the difference that is none of noise and vibration.
COMPARED_S, DISAGREES_MPS = 0.4, 0.25


class Sensor(NamedTuple):
    """A sensor: its stream, the channels that it measures by, and after which time without any it is lost."""

    name: str
    stream: str
    channels: tuple[str, ...]
    lost_s: float = LOST_AFTER_S


#: Sensors beside wheels and steering, each with its stream and the channels that it measures by; one is there where its
#: first channel is.  ``tilt`` is the IMU's pitch and roll.
_TABLE: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("gyro", "imu", ("gyro_z_radps",)),
    ("accel", "imu", ("accel_x_mps2",)),
    ("tilt", "imu", ("pitch_rad",)),
    ("imu_yaw", "imu", ("yaw_rad",)),
    ("camera_speed", "odometry", ("speed_x_mps",)),
    ("camera_speed", "odometry", ("velocity_x_mps",)),
    ("camera_yaw_rate", "odometry", ("rate_y_radps",)),
    ("camera_yaw", "odometry", ("quaternion_x_ratio",)),
    ("lidar_speed", "lidar", ("speed_x_mps",)),
    ("pose", "pose", ("position_x_m", "position_y_m")),
    ("gnss_position", "gnss", ("position_x_m", "position_y_m", "std_position_m")),
    ("gnss_speed", "gnss", ("velocity_x_mps", "velocity_y_mps")),
)
#: Sensors that slip control is not built on: the camera's yaw is, which turns its speed into the body's axes.
NOT_OF_SLIP = ("imu_yaw", "camera_yaw_rate")


def sensors_of(robot: Robot, channels: Mapping[str, Sequence[str]]) -> tuple[Sensor, ...]:
    """Return the sensors of a robot that its filter takes, by the channels of each stream.

    Of a swerve robot these are no satellites, of others no yaw of the IMU.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> streams = {"wheels": ("speed_left_mps", "speed_right_mps"), "imu": ("gyro_z_radps", "yaw_rad")}
    >>> [sensor.name for sensor in sensors_of(load_robot("husky"), streams)]
    ['wheel_left', 'wheel_right', 'gyro']
    """
    rates = zip(robot.logged_wheels, robot.rate_channels, strict=True)
    found = [Sensor(f"wheel_{wheel}", "wheels", (rate,), WHEELS_LOST_S) for wheel, rate in rates]
    angles = zip(robot.steered_wheels, robot.steer_channels, strict=True)
    found += [Sensor(f"steer_{wheel}", "steering", (angle,)) for wheel, angle in angles]
    found += [Sensor(*row) for row in _TABLE]
    not_taken = "gnss" if robot.drive == "swerve" else "imu_yaw"
    return tuple(
        one
        for one in found
        if one.channels[0] in channels.get(one.stream, ()) and not one.name.startswith(not_taken)
    )


class Evidence(NamedTuple):
    """What is known of a sensor at a step."""

    age_s: float  #: since anything of it was taken, infinite before; NaN of one that is not judged
    late_s: float  #: ages from which on it is late, and lost
    lost_s: float
    is_frozen: bool = False
    has_jumped: bool = False
    disagrees: bool = False
    is_gated: bool = False
    was_reopened: bool = False

    @property
    def health(self) -> int:
        """The most serious that is known; what is frozen or has jumped is left out, and would look lost."""
        if self.is_frozen or self.has_jumped:
            return Health.FROZEN if self.is_frozen else Health.STEPPED
        if self.age_s > self.lost_s:
            return Health.LOST
        if self.disagrees or self.is_gated:
            return Health.DISAGREES if self.disagrees else Health.GATED
        if self.was_reopened:
            return Health.REOPENED
        return Health.LATE if self.age_s > self.late_s else Health.FRESH


class HealthMonitor:
    """The sensors of a robot, and the health of each by what is known of it; ``first`` is that before anything is.

    Attributes
    ----------
    names : of the sensors
    health : of each at the last step, as :class:`Health`

    Examples
    --------
    >>> monitor = HealthMonitor([Sensor("gyro", "imu", ("gyro_z_radps",))])
    >>> sound = Evidence(age_s=0.0, late_s=0.03, lost_s=0.25)
    >>> [monitor.judge([one]) for one in (sound, sound._replace(age_s=0.3), sound._replace(is_frozen=True))]
    [[0], [7], [6]]
    """

    def __init__(self, sensors: Sequence[Sensor], first: Health = Health.LOST) -> None:
        self.names = tuple(sensor.name for sensor in sensors)
        self.health = [int(first)] * len(sensors)

    @property
    def by_name(self) -> dict[str, str]:
        """Health of each sensor by name, in small letters."""
        return {name: Health(each).name.lower() for name, each in zip(self.names, self.health, strict=True)}

    def judge(self, evidence: Iterable[Evidence]) -> list[int]:
        """Return the health of each sensor by what is known of it."""
        self.health = [int(one.health) for one in evidence]
        return self.health


# -- By the feed and the filter of a swerve robot

GATED_AFTER_S, JUMPING_S = 0.1, 0.03
BIAS_RADPS = 0.05  #: A gyro's bias beyond this, five times what is usual, is a gyro that is broken.

#: Of a sensor the signal that tells when it was taken last, the first and last one whose jumps count, and its channels
#: among those that may freeze.
_SIGNALS: Mapping[str, tuple[int, int, int, tuple[int, ...]]] = {
    "gyro": (GYRO, GYRO, GYRO, (2,)),
    "accel": (ACCEL, ACCEL, ACCEL, (3, 4)),
    "tilt": (ACCEL, TILT, TILT + 1, (6, 7)),
    "imu_yaw": (IMU_YAW, IMU_YAW, IMU_YAW, (8,)),
    "camera_speed": (
        SEEN,
        SEEN,
        SEEN + 1,
        (FIRST_CAMERA + 7, FIRST_CAMERA + 9, FIRST_SPEED, FIRST_SPEED + 1),
    ),
    "camera_yaw_rate": (SEEN_TURN, SEEN_TURN, SEEN_TURN, (FIRST_CAMERA + 11,)),
    "camera_yaw": (SEEN_YAW, SEEN_YAW, SEEN_YAW, tuple(range(FIRST_CAMERA + 3, FIRST_CAMERA + 7))),
}
_MOTION = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
_BIASES = ("accel_bias_x_mps2", "accel_bias_y_mps2", "gyro_bias_radps")


class _Ticks(NamedTuple):
    """What is remembered from tick to tick."""

    gated_s: tuple[float, ...]  #: how long each sensor has been gated
    apart_mps: complex = complex(
        math.nan
    )  #: of camera and accelerometer, along, and across as the imaginary part
    seen_mps: complex = complex(math.nan)  #: the camera's last speeds, and their instant
    seen_s: float = math.nan
    wheels: tuple[float, ...] = ()  #: sample of the wheels, and how often it repeated itself
    n_repeated: int = 0


class FeedEvidence:
    """What is known of each sensor at a tick by the feed of a swerve robot and the filter behind it.

    Attributes
    ----------
    memory : all that it remembers, which is not changed but replaced
    """

    def __init__(self, robot: Robot, filter: Filter, sensors: Sequence[Sensor]) -> None:
        described, camera = robot.completed.sensors, robot.completed.camera
        self._filter, model = filter, filter.model
        rates_hz = {"wheels": described.wheels_rate_hz, "steering": described.steering_rate_hz}
        rates_hz |= {"imu": described.imu_rate_hz, "odometry": camera.rate_hz}
        late_s = [LATE_PERIODS / rates_hz[sensor.stream] for sensor in sensors]
        self._ages_s = list(zip(late_s, (sensor.lost_s for sensor in sensors), strict=True))
        self._names, self._tick_s = [sensor.name for sensor in sensors], 1.0 / described.wheels_rate_hz
        self._signals = [_SIGNALS.get(name) for name in self._names]
        self._uses = places_among(self._names, model.sensor_names).tolist()
        self._motion, self._biases = (
            places_among(names, model.states).tolist() for names in (_MOTION, _BIASES)
        )
        self.memory = _Ticks((0.0,) * len(sensors))

    def at(
        self, time_s: float, wheels: Array, rates: Array, row: Array, feed: Array, before: Sequence[int]
    ) -> list[Evidence]:
        """Return what is known at a tick, by the sample (c,) of the wheels and the rates (3,) of the motors in it.

        ``row`` and ``feed`` are of :mod:`terrain.estimation.feed`; the filter has taken the tick.  ``before`` is the
        health of each sensor: one that was gated, or worse, has to be used before it is sound again.
        """
        memory, one, use = self.memory, feed[0], self._filter.use.tolist()
        mean = self._filter.mean.tolist()
        along, across, turn = (mean[place] for place in self._motion)
        bias = [mean[place] if place >= 0 else 0.0 for place in self._biases]
        seen, accel = (complex(*row[FIRST_SIGNAL + k : FIRST_SIGNAL + k + 2]) for k in (SEEN, ACCEL))
        apart, step_s, accel = memory.apart_mps, time_s - memory.seen_s, accel - complex(*bias[:2])
        if 0.0 < step_s < COMPARED_S and not cmath.isnan(seen + accel):
            gained = (accel - 1j * turn * complex(along, across)) * step_s
            apart = apart * math.exp(-step_s / COMPARED_S) + seen - memory.seen_mps - gained
        if cmath.isnan(seen):
            seen, seen_s = memory.seen_mps, memory.seen_s
        else:
            apart, seen_s = 0j if cmath.isnan(apart) else apart, time_s
        is_apart = max(abs(apart.real), abs(apart.imag)) > DISAGREES_MPS
        disagrees = {"accel": is_apart, "camera_speed": is_apart, "gyro": abs(bias[2]) > BIAS_RADPS}
        lines, channels = one["lines"], one["channels"]
        came_s, received_s = lines["came_s"].tolist(), one["received_s"].tolist()
        jumped = (time_s - np.fmin(lines["jumping_s"], lines["jumped_s"]) > JUMPING_S).tolist()
        repeats = (channels["repeated"] >= np.maximum(REPEATED, LONGER * channels["longest"])).tolist()
        is_moving = any(abs(speed) > MOVING_MPS for speed in one["wheel_once_mps"].tolist())
        any_jumped, any_repeats = True in jumped, is_moving and True in repeats
        rates_radps, row_radps = rates.tolist(), row[:3].tolist()
        sample = tuple(wheels.tolist())
        n_repeated = memory.n_repeated + 1 if sample == memory.wheels else 0
        is_fast = math.hypot(along, across) > AT_REST_MPS
        evidence, gated_s = [], list(memory.gated_s)
        for i, (name, (late_s, lost_s)) in enumerate(zip(self._names, self._ages_s, strict=True)):
            has_jumped, is_frozen = False, False
            if (signals := self._signals[i]) is not None:
                taken, first, last, own = signals
                taken_s = came_s[taken]
                has_jumped = any_jumped and any(jumped[first : last + 1])
                is_frozen = any_repeats and any(repeats[c] for c in own)
            else:
                taken_s = received_s[i // 3][i % 3]
                if i < 3:  # zeros may be those of a robot at rest
                    is_stuck = (
                        math.isnan(row_radps[i])
                        and repeats[FIRST_WHEEL + i]
                        and math.isfinite(rates_radps[i])
                    )
                    is_frozen = is_stuck or (n_repeated >= N_STUCK and (rates_radps[i] != 0.0 or is_fast))
            used = use[self._uses[i]] if self._uses[i] >= 0 else ABSENT
            if used == GATED:
                gated_s[i] += self._tick_s
            elif used != ABSENT:
                gated_s[i] = 0.0
            is_gated = used == GATED and (gated_s[i] > GATED_AFTER_S or before[i] >= Health.GATED)
            age_s = math.inf if math.isnan(taken_s) else time_s - taken_s
            known = is_frozen, has_jumped, disagrees.get(name, False), is_gated, used == REOPENED
            evidence.append(Evidence(age_s, late_s, lost_s, *known))
        self.memory = _Ticks(tuple(gated_s), apart, seen, seen_s, sample, n_repeated)
        return evidence
