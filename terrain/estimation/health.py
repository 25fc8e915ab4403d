"""Health of each sensor at a tick: whether what it measures can be built on, and if not, why.

::

    frozen      it repeats itself to the last bit while the robot moves
    stepped     its value jumped as no robot moves, and has not jumped back
    lost        nothing of it was taken for a quarter of a second, of a wheel for a tenth
    gated       for a tenth of a second it has disagreed with the filter beyond its gate
    disagrees   camera and accelerometer measure different changes of the speed
    reopened    the filter has just believed it again: a wheel that slips anew, a yaw that was set
    late        what it measured last is older than three of its periods
    fresh       none of these

Camera against accelerometer: ``m <- m exp(-dt / 0.4 s) + dv_camera - (a - b + coriolis) dt``, which a step of
the speed moves by its size, and an error e of the acceleration (a pitch that is wrong by e / g) by 0.4 s
times e.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any

import numpy as np

from terrain.estimation.feed import FIRST_CAMERA, FIRST_SPEED, FIRST_WHEEL, is_moving, repeats
from terrain.estimation.filter import FilterModel
from terrain.kernels import filled, inner, njit, record
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

#: Sensors that are judged; ``tilt`` is the IMU's pitch and roll.
SENSORS = (
    *(f"wheel_{i}" for i in (1, 2, 3)),
    *(f"steer_{i}" for i in (1, 2, 3)),
    *("gyro", "accel", "tilt", "imu_yaw"),
    *("camera_speed", "camera_yaw_rate", "camera_yaw"),
)
#: Those that slip control is built on: the camera's yaw turns its speed into the body's axes.
SLIP_SENSORS = tuple(name for name in SENSORS if name not in ("imu_yaw", "camera_yaw_rate"))

LOST_AFTER_S, WHEELS_LOST_S, GATED_AFTER_S, JUMPING_S, LATE_PERIODS = 0.25, 0.1, 0.1, 0.03, 3.0
N_STUCK = 4  #: Repetitions of all that the wheels measure, from which on they are frozen.
AT_REST_MPS = 0.1  #: A robot that is faster is not at rest, whatever its wheels measure.
BIAS_RADPS = 0.05  #: A gyro's bias beyond this, five times what is usual, is a gyro that is broken.
#: Memory of camera against accelerometer, and the difference that is none of noise and vibration.
COMPARED_S, DISAGREES_MPS = 0.4, 0.25
N_COLUMNS = 16  #: So many channels of the wheels are compared with those of the sample before.

_MOTION = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
_BIASES = ("accel_bias_x_mps2", "accel_bias_y_mps2", "gyro_bias_radps")
_WHEEL, _STEER, _GYRO, _ACCEL, _TILT, _YAW, _SEEN, _SEEN_TURN, _SEEN_YAW = (
    0,
    3,
    *range(6, 13),
)  # among SENSORS

#: What is constant: places of motion and biases among the states and of the sensors in the filter, -1 where there is
#: none; periods of the sensors, and of the ticks.
MONITOR = record(
    {
        **dict.fromkeys(("motion_places", "bias_places"), (int, 3)),
        "places": (int, len(SENSORS)),
        "period_s": (float, len(SENSORS)),
        "tick_s": float,
    }
)
#: What is remembered: health at the last tick, how long each sensor has been gated; difference of camera and
#: accelerometer along and across, the camera's last speeds and their instant; the sample of the wheels, and how often
#: it repeated itself.
MEMORY = record(
    {
        "health": (np.int8, len(SENSORS)),
        "gated_s": (float, len(SENSORS)),
        "apart_mps": (float, 2),
        "seen_mps": (float, 2),
        "seen_s": float,
        "wheels": (float, N_COLUMNS),
        "n_repeated": int,
    }
)

_inner = inner(error_model="numpy")


class HealthMonitor:
    """Judges the sensors at each tick of a live estimator by a filter of a robot, which gives their periods.

    Attributes
    ----------
    memory : all that it remembers
    health : (13,) of the last tick
    """

    def __init__(self, robot: Robot, model: FilterModel) -> None:
        sensors, camera = robot.sensors, robot.completed.camera
        rates_hz = [sensors.wheels_rate_hz] * 3 + [sensors.steering_rate_hz] * 3
        rates_hz += [sensors.imu_rate_hz] * 4 + [camera.rate_hz] * 3

        def places(names: tuple[str, ...], among: tuple[str, ...]) -> list[int]:
            return [among.index(name) if name in among else -1 for name in names]

        self._settings = filled(
            MONITOR,
            motion_places=places(_MOTION, model.states),
            bias_places=places(_BIASES, model.states),
            places=places(SENSORS, model.sensor_names),
            period_s=1.0 / np.array(rates_hz),
            tick_s=1.0 / sensors.wheels_rate_hz,
        )
        self.memory = filled(MEMORY, np.nan, health=Health.LOST.value, gated_s=0.0)
        self.health = self.memory["health"][0]
        self._wheels = np.zeros(N_COLUMNS)

    def judge(
        self, time_s: float, wheels: Array, rates: Array, row: Array, feed: Array, state: Array
    ) -> None:
        """Judge the sensors at a tick, by the sample (c,) of the wheels and the rates (3,) of the motors in it.

        ``row`` and ``feed`` are of :mod:`terrain.estimation.feed`, ``state`` is that of the filter after the tick.
        """
        n = min(wheels.size, N_COLUMNS)
        self._wheels[:n] = wheels[:n]
        _judge(time_s, self._wheels, rates, row, feed, state, self._settings, self.memory)

    @property
    def names(self) -> dict[str, str]:
        """Health of each sensor by name, in small letters."""
        health = (Health(status).name.lower() for status in self.health.tolist())
        return dict(zip(SENSORS, health, strict=True))


@_inner
def _compare(time_s: float, row: Any, bias_mps2: Array, motion: Array, memory: Any) -> bool:
    """Say whether camera and accelerometer disagree; ``motion`` is the speed (2,) and the yaw rate."""
    step_s, apart = time_s - memory.seen_s, memory.apart_mps
    seen_x, seen_y = row.camera_speed_mps[0], row.camera_speed_mps[1]
    accel_x, accel_y = row.accel_mps2[0], row.accel_mps2[1]
    known = step_s > 0.0 and step_s < COMPARED_S and not math.isnan(seen_x + seen_y + accel_x + accel_y)
    if known:
        keep = math.exp(-step_s / COMPARED_S)
        along = accel_x - bias_mps2[0] + motion[2] * motion[1]
        across = accel_y - bias_mps2[1] - motion[2] * motion[0]
        apart[0] = apart[0] * keep + seen_x - memory.seen_mps[0] - along * step_s
        apart[1] = apart[1] * keep + seen_y - memory.seen_mps[1] - across * step_s
    if not math.isnan(seen_x + seen_y):
        if math.isnan(apart[0]):
            apart[0], apart[1] = 0.0, 0.0
        memory.seen_mps[0], memory.seen_mps[1], memory.seen_s = seen_x, seen_y, time_s
    return bool(abs(apart[0]) > DISAGREES_MPS or abs(apart[1]) > DISAGREES_MPS)


@_inner
def _or_infinite(since_s: float) -> float:
    return np.inf if math.isnan(since_s) else since_s


@_inner
def _received(line: Any, sensor: int, received_s: Array, jumped_s: Array) -> None:
    """Write when a signal of a sensor was taken last, and since when it has jumped and not jumped back."""
    received_s[sensor] = line.came_s
    jumped_s[sensor] = min(_or_infinite(line.jumping_s), _or_infinite(line.jumped_s))


@_inner
def _when_received(feed: Any, received_s: Array, jumped_s: Array) -> None:
    """Write when each sensor (13,) was taken last, and since when its value has jumped, infinite where it has not."""
    jumped_s[:] = np.inf
    for i in range(3):
        received_s[_WHEEL + i], received_s[_STEER + i] = feed.rate_received_s[i], feed.steer_received_s[i]
    _received(feed.gyro_z_radps, _GYRO, received_s, jumped_s)
    _received(feed.accel_mps2[0], _ACCEL, received_s, jumped_s)
    _received(feed.imu_yaw_rad, _YAW, received_s, jumped_s)
    _received(feed.camera_speed_mps[0], _SEEN, received_s, jumped_s)
    _received(feed.camera_yaw_rate_radps, _SEEN_TURN, received_s, jumped_s)
    _received(feed.camera_yaw_rad, _SEEN_YAW, received_s, jumped_s)
    received_s[_TILT] = feed.accel_mps2[0].came_s
    jumped_s[_TILT] = min(_or_infinite(feed.tilt_rad[0].jumped_s), _or_infinite(feed.tilt_rad[1].jumped_s))
    jumped_s[_SEEN] = min(jumped_s[_SEEN], _or_infinite(feed.camera_speed_mps[1].jumped_s))


@_inner
def _status(i: int, age_s: float, jumping_s: float, use: int, settings: Any, memory: Any) -> int:
    """Return the health of a sensor by what came of it, and by what the filter made of it.

    What was gated or worse has to be used first: only then is it sound again.
    """
    status = Health.FRESH.value
    if jumping_s > JUMPING_S:
        status = Health.STEPPED.value
    elif not age_s <= (WHEELS_LOST_S if i < _STEER else LOST_AFTER_S):
        status = Health.LOST.value
    elif age_s > LATE_PERIODS * settings.period_s[i]:
        status = Health.LATE.value
    if use == GATED:
        memory.gated_s[i] += settings.tick_s
        if memory.gated_s[i] > GATED_AFTER_S or memory.health[i] >= Health.GATED.value:
            return max(status, Health.GATED.value)
    elif use != ABSENT:
        memory.gated_s[i] = 0.0
    return max(status, Health.REOPENED.value) if use == REOPENED else status


@_inner
def _mark_frozen(feed: Any, health: Array) -> None:
    """Mark the sensors of frozen channels, of wheels aside."""
    for c in range(9):  # rates, forces, roll, pitch, yaw
        sensor = (-1, -1, _GYRO, _ACCEL, _ACCEL, -1, _TILT, _TILT, _YAW)[c]
        if sensor >= 0 and repeats(feed, c):
            health[sensor] = Health.FROZEN.value
    for c in range(3, 12):  # quaternion, velocity, turning about the vertical
        sensor = _SEEN_YAW if c < 7 else (_SEEN if c < 10 else _SEEN_TURN)
        if c not in (8, 10) and repeats(feed, FIRST_CAMERA + c):
            health[sensor] = Health.FROZEN.value
    for c in range(2):
        if repeats(feed, FIRST_SPEED + c):
            health[_SEEN] = Health.FROZEN.value


@_inner
def _mark_stuck(rates: Array, speed_mps: float, row: Any, feed: Any, memory: Any) -> None:
    """Mark the wheels that are frozen: their rate repeats itself, or all that the wheels measure does.

    A sample of zeros may be that of a robot at rest: it is frozen where the robot has a speed.
    """
    for i in range(3):
        left_out = math.isnan(row.wheel_radps[i]) and math.isfinite(rates[i])
        stuck = left_out and repeats(feed, FIRST_WHEEL + i)
        stuck |= memory.n_repeated >= N_STUCK and (rates[i] != 0.0 or speed_mps > AT_REST_MPS)
        if stuck:
            memory.health[_WHEEL + i] = Health.FROZEN.value


@njit(error_model="numpy")
def _judge(
    time_s: float, wheels: Array, rates: Array, row: Any, feed: Any, state: Any, settings: Any, memory: Any
) -> None:
    """Write the health of the sensors at a tick."""
    row, feed, state, settings, memory = row[0], feed[0], state[0], settings[0], memory[0]
    same, health = True, memory.health
    for c in range(N_COLUMNS):
        same &= wheels[c] == memory.wheels[c]
        memory.wheels[c] = wheels[c]
    memory.n_repeated = memory.n_repeated + 1 if same else 0
    bias, motion = np.empty(3), np.empty(3)
    for i in range(3):
        place = settings.bias_places[i]
        bias[i] = state.x[place] if place >= 0 else 0.0
        motion[i] = state.x[settings.motion_places[i]]
    disagrees = _compare(time_s, row, bias, motion, memory)
    received_s, jumped_s = np.empty(health.size), np.empty(health.size)
    _when_received(feed, received_s, jumped_s)
    for i in range(health.size):
        use = state.use[settings.places[i]] if settings.places[i] >= 0 else ABSENT
        age_s, jumping_s = time_s - received_s[i], time_s - jumped_s[i]
        health[i] = _status(i, age_s, jumping_s, use, settings, memory)
    if disagrees:
        health[_ACCEL] = max(health[_ACCEL], Health.DISAGREES.value)
        health[_SEEN] = max(health[_SEEN], Health.DISAGREES.value)
    if abs(bias[2]) > BIAS_RADPS:
        health[_GYRO] = max(health[_GYRO], Health.DISAGREES.value)
    if is_moving(feed):
        _mark_frozen(feed, health)
    _mark_stuck(rates, math.hypot(motion[0], motion[1]), row, feed, memory)
