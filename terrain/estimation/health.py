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

from terrain.estimation.feed import (
    ACCEL,
    FIRST_CAMERA,
    FIRST_SIGNAL,
    FIRST_SPEED,
    FIRST_WHEEL,
    GYRO,
    IMU_YAW,
    SEEN,
    SEEN_TURN,
    SEEN_YAW,
    TILT,
    is_moving,
    places_among,
    repeats,
)
from terrain.estimation.filter import FilterModel
from terrain.kernels import filled, njit, record
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

#: Sensors beside wheels and steering, ``tilt`` is the IMU's pitch and roll: the signal that tells when each was taken
#: last, the first and last one whose jumps count, and which channels of those that may freeze are its own.
_OTHERS: dict[str, tuple[int, int, int, tuple[int, ...]]] = {
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
#: Sensors that are judged.
SENSORS = (*(f"wheel_{i}" for i in (1, 2, 3)), *(f"steer_{i}" for i in (1, 2, 3)), *_OTHERS)
#: Those that slip control is built on: the camera's yaw turns its speed into the body's axes.
SLIP_SENSORS = tuple(name for name in SENSORS if name not in ("imu_yaw", "camera_yaw_rate"))

LOST_AFTER_S, WHEELS_LOST_S, GATED_AFTER_S, JUMPING_S, LATE_PERIODS = 0.25, 0.1, 0.1, 0.03, 3.0
N_STUCK = 4  #: Repetitions of all that the wheels measure, from which on they are frozen.
AT_REST_MPS = 0.1  #: A robot that is faster is not at rest, whatever its wheels measure.
BIAS_RADPS = 0.05  #: A gyro's bias beyond this, five times what is usual, is a gyro that is broken.
#: Memory of camera against accelerometer, and the difference that is none of noise and vibration.
COMPARED_S, DISAGREES_MPS = 0.4, 0.25
N_COLUMNS = 16  #: So many channels of the wheels are compared with those of the sample before.

_FIRST = SENSORS.index("gyro")
_GYRO, _ACCEL, _SEEN = (SENSORS.index(name) for name in ("gyro", "accel", "camera_speed"))
_SIGNALS = np.array([signals for *signals, _ in _OTHERS.values()])
_CHANNELS = np.array([(sensor, c) for sensor, (*_, own) in enumerate(_OTHERS.values(), _FIRST) for c in own])
_MOTION = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
_BIASES = ("accel_bias_x_mps2", "accel_bias_y_mps2", "gyro_bias_radps")
_FRESH, _LATE, _REOPENED, _GATED, _DISAGREES, _STEPPED, _FROZEN, _LOST = (each.value for each in Health)

#: What is constant: places of motion and biases among the states and of the sensors in the filter, -1 where there is
#: none; periods of the sensors, and of the ticks.
MONITOR = record(
    dict.fromkeys(("motion_places", "bias_places"), (int, 3))
    | {"places": (int, len(SENSORS)), "period_s": (float, len(SENSORS)), "tick_s": float}
)
#: What is remembered: health at the last tick, how long each sensor has been gated; difference of camera and
#: accelerometer along and across, the camera's last speeds and their instant; the sample of the wheels, and how often
#: it repeated itself.
MEMORY = record(
    {"health": (np.int8, len(SENSORS)), "gated_s": (float, len(SENSORS)), "seen_s": float, "n_repeated": int}
    | {"apart_mps": (float, 2), "seen_mps": (float, 2), "wheels": (float, N_COLUMNS)}
)


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
        self._settings = filled(
            MONITOR,
            motion_places=places_among(_MOTION, model.states),
            bias_places=places_among(_BIASES, model.states),
            places=places_among(SENSORS, model.sensor_names),
            period_s=1.0 / np.array(rates_hz),
            tick_s=1.0 / sensors.wheels_rate_hz,
        )
        self.memory = filled(MEMORY, np.nan, health=Health.LOST.value, gated_s=0.0)
        self.health = self.memory["health"][0]
        self._wheels = np.zeros(N_COLUMNS)

    def judge(
        self, time_s: float, wheels: Array, rates: Array, rows: Array, feed: Array, state: Array
    ) -> None:
        """Judge the sensors at a tick, by the sample (c,) of the wheels and the rates (3,) of the motors in it.

        ``rows`` and ``feed`` are of :mod:`terrain.estimation.feed`, ``state`` is that of the filter after the tick.
        """
        n = min(wheels.size, N_COLUMNS)
        self._wheels[:n] = wheels[:n]
        _judge(time_s, self._wheels, rates, rows, feed, state, self._settings, self.memory)

    @property
    def names(self) -> dict[str, str]:
        """Health of each sensor by name, in small letters."""
        return {name: Health(health).name.lower() for name, health in zip(SENSORS, self.health, strict=True)}


@njit(error_model="numpy")
def _judge(
    time_s: float, wheels: Array, rates: Array, rows: Array, feed: Any, state: Any, settings: Any, memory: Any
) -> None:
    """Write the health of the sensors at a tick."""
    row, feed, state, settings, memory = rows[0], feed[0], state[0], settings[0], memory[0]
    same, health = True, memory.health
    for c in range(N_COLUMNS):
        same &= wheels[c] == memory.wheels[c]
        memory.wheels[c] = wheels[c]
    memory.n_repeated = memory.n_repeated + 1 if same else 0
    bias, motion = np.zeros(3), np.empty(3)
    for i in range(3):
        if settings.bias_places[i] >= 0:
            bias[i] = state.x[settings.bias_places[i]]
        motion[i] = state.x[settings.motion_places[i]]

    # camera against accelerometer
    apart, step_s = memory.apart_mps, time_s - memory.seen_s
    seen_x, seen_y = row[FIRST_SIGNAL + SEEN], row[FIRST_SIGNAL + SEEN + 1]
    along, across = row[FIRST_SIGNAL + ACCEL], row[FIRST_SIGNAL + ACCEL + 1]
    if step_s > 0.0 and step_s < COMPARED_S and not math.isnan(seen_x + seen_y + along + across):
        keep = math.exp(-step_s / COMPARED_S)
        along, across = along - bias[0] + motion[2] * motion[1], across - bias[1] - motion[2] * motion[0]
        apart[0] = apart[0] * keep + seen_x - memory.seen_mps[0] - along * step_s
        apart[1] = apart[1] * keep + seen_y - memory.seen_mps[1] - across * step_s
    if not math.isnan(seen_x + seen_y):
        if math.isnan(apart[0]):
            apart[0], apart[1] = 0.0, 0.0
        memory.seen_mps[0], memory.seen_mps[1], memory.seen_s = seen_x, seen_y, time_s

    # what came of each sensor, and what the filter made of it
    for i in range(health.size):
        received_s, jumped_s = feed.received_s[i // 3 % 2, i % 3], np.inf
        if i >= _FIRST:
            received_s = feed.lines[_SIGNALS[i - _FIRST, 0]].came_s
            for k in range(_SIGNALS[i - _FIRST, 1], _SIGNALS[i - _FIRST, 2] + 1):
                for since_s in (feed.lines[k].jumping_s, feed.lines[k].jumped_s):
                    if since_s < jumped_s:  # False for NaN
                        jumped_s = since_s
        use = state.use[settings.places[i]] if settings.places[i] >= 0 else ABSENT
        age_s, status = time_s - received_s, _FRESH
        if time_s - jumped_s > JUMPING_S:
            status = _STEPPED
        elif not age_s <= (WHEELS_LOST_S if i < 3 else LOST_AFTER_S):
            status = _LOST
        elif age_s > LATE_PERIODS * settings.period_s[i]:
            status = _LATE
        if use == GATED:
            memory.gated_s[i] += settings.tick_s
            if memory.gated_s[i] > GATED_AFTER_S or health[i] >= _GATED:
                status = max(status, _GATED)  # it has to be used before it is sound again
        elif use != ABSENT:
            memory.gated_s[i] = 0.0
            if use == REOPENED:
                status = max(status, _REOPENED)
        health[i] = status
    if abs(apart[0]) > DISAGREES_MPS or abs(apart[1]) > DISAGREES_MPS:
        health[_ACCEL], health[_SEEN] = max(health[_ACCEL], _DISAGREES), max(health[_SEEN], _DISAGREES)
    if abs(bias[2]) > BIAS_RADPS:
        health[_GYRO] = max(health[_GYRO], _DISAGREES)
    if is_moving(feed):
        for n in range(_CHANNELS.shape[0]):
            if repeats(feed, _CHANNELS[n, 1]):
                health[_CHANNELS[n, 0]] = _FROZEN

    # a wheel whose rate repeats itself, or all that the wheels measure: zeros may be those of a robot at rest
    for i in range(3):
        stuck = math.isnan(row[i]) and math.isfinite(rates[i]) and repeats(feed, FIRST_WHEEL + i)
        moves = rates[i] != 0.0 or math.hypot(motion[0], motion[1]) > AT_REST_MPS
        if stuck or (memory.n_repeated >= N_STUCK and moves):
            health[i] = _FROZEN
