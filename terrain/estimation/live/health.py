"""Health of each sensor at a tick: whether what it measures can be built on, and if not, why.

::

    frozen      it repeats itself to the last bit while the robot moves
    stepped     its value leapt as no robot moves, and has not leapt back
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

import numpy as np
from numba import njit

from terrain.estimation.measurements.derived import is_moving
from terrain.estimation.measurements.frozen import (
    OF_CAMERA,
    OF_IMU,
    OF_SPEED,
    OF_WHEELS,
    REPEATED_CAMERA,
    REPEATED_IMU,
    REPEATED_SPEED,
    REPEATED_WHEELS,
    repeats,
)
from terrain.estimation.measurements.sample_hold import CAME, LEAPT_SINCE, SINCE
from terrain.estimation.measurements.samples import ACCEL_X, CAMERA, CAMERA_YAW, GYRO_Z, IMU_YAW, TILT
from terrain.records import ABSENT, GATED, REOPENED, Array


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

SENSORS = (
    *(f"wheel_{i}" for i in (1, 2, 3)),
    *(f"steer_{i}" for i in (1, 2, 3)),
    *("gyro", "accel", "tilt", "imu_yaw"),
    *("camera_speed", "camera_yaw_rate", "camera_yaw"),
)
"""Sensors that are judged; ``tilt`` is the IMU's pitch and roll."""

SLIP_SENSORS = tuple(name for name in SENSORS if name not in ("imu_yaw", "camera_yaw_rate"))
"""Those that slip control is built on: the camera's yaw turns its speed into the body's axes."""

LOST_AFTER_S, WHEELS_LOST_S, GATED_AFTER_S, LEAPING_S, LATE_PERIODS = 0.25, 0.1, 0.1, 0.03, 3.0
N_STUCK = 4
"""Repetitions of all that the wheels measure, from which on they are frozen."""

AT_REST_MPS = 0.1
"""A robot that is faster is not at rest, whatever its wheels measure."""

BIAS_RADPS = 0.05
"""A gyro's bias beyond this, five times what is usual, is a gyro that is broken."""

COMPARED_S, DISAGREES_MPS = 0.4, 0.25
"""Memory of camera against accelerometer, and the difference that is none of noise and vibration."""

N_COMPARED = 5
"""Length of the memory: difference along and across, camera's last speeds, and their instant."""

_W, _STEER, _GYRO, _ACCEL, _TILT, _YAW, _SEEN, _SEEN_TURN, _SEEN_YAW = 0, 3, 6, 7, 8, 9, 10, 11, 12
_FROM_ROW = (
    *((_GYRO, GYRO_Z), (_ACCEL, ACCEL_X), (_TILT, ACCEL_X), (_YAW, IMU_YAW)),
    *((_SEEN, CAMERA), (_SEEN_TURN, CAMERA + 2), (_SEEN_YAW, CAMERA_YAW)),
)


def health_memory() -> tuple[Array, Array]:
    """Return the memory before the first tick: how long each sensor (13,) has been gated, and (5,) above."""
    return np.zeros(len(SENSORS)), np.full(N_COMPARED, np.nan)


@njit(cache=True, error_model="numpy")
def _compare(time_s: float, z: Array, bias_mps2: Array, motion: Array, memory: Array) -> bool:
    """Say whether camera and accelerometer disagree; ``motion`` is the speed (2,) and the yaw rate."""
    step_s = time_s - memory[4]
    seen_x, seen_y = z[CAMERA], z[CAMERA + 1]
    known = (
        step_s > 0.0 and step_s < COMPARED_S and not math.isnan(seen_x + seen_y + z[ACCEL_X] + z[ACCEL_X + 1])
    )
    if known:
        keep = math.exp(-step_s / COMPARED_S)
        along = z[ACCEL_X] - bias_mps2[0] + motion[2] * motion[1]
        across = z[ACCEL_X + 1] - bias_mps2[1] - motion[2] * motion[0]
        memory[0] = memory[0] * keep + seen_x - memory[2] - along * step_s
        memory[1] = memory[1] * keep + seen_y - memory[3] - across * step_s
    if not math.isnan(seen_x + seen_y):
        if math.isnan(memory[0]):
            memory[0], memory[1] = 0.0, 0.0
        memory[2], memory[3], memory[4] = seen_x, seen_y, time_s
    return bool(abs(memory[0]) > DISAGREES_MPS or abs(memory[1]) > DISAGREES_MPS)


@njit(cache=True, error_model="numpy")
def _own(time_s: float, i: int, period_s: float, lines: Array, received_s: Array) -> int:
    """Return the health of a sensor by what came of it alone."""
    age_s, leaping_s = 0.0, -np.inf
    if i < _GYRO:
        age_s = time_s - received_s[i // 3, i % 3]
    for sensor, row in _FROM_ROW:
        if sensor == i:
            age_s = time_s - lines[row, CAME]
            if i != _TILT:
                leaping_s = time_s - min(_or_inf(lines[row, SINCE]), _or_inf(lines[row, LEAPT_SINCE]))
            if i == _SEEN:  # across too
                leaping_s = max(leaping_s, time_s - _or_inf(lines[row + 1, LEAPT_SINCE]))
    if i == _TILT:
        leaping_s = time_s - min(_or_inf(lines[TILT, LEAPT_SINCE]), _or_inf(lines[TILT + 1, LEAPT_SINCE]))
    if not age_s <= (WHEELS_LOST_S if i < _STEER else LOST_AFTER_S) and not leaping_s > LEAPING_S:
        return Health.LOST.value
    if leaping_s > LEAPING_S:
        return Health.STEPPED.value
    return Health.LATE.value if age_s > LATE_PERIODS * period_s else Health.FRESH.value


@njit(cache=True, error_model="numpy")
def _or_inf(since_s: float) -> float:
    return np.inf if math.isnan(since_s) else since_s


@njit(cache=True, error_model="numpy")
def _by_filter(use: int, before: int, step_s: float, gated_s: Array, i: int) -> int:
    """Return the health of a sensor by what the filter made of it; what was lost has to be used first."""
    if use == GATED:
        gated_s[i] += step_s
        if gated_s[i] > GATED_AFTER_S or before >= Health.GATED.value:
            return Health.GATED.value
    elif use != ABSENT:
        gated_s[i] = 0.0
    return Health.REOPENED.value if use == REOPENED else Health.FRESH.value


@njit(cache=True, error_model="numpy")
def judge(
    time_s: float,
    use: Array,
    places: Array,
    period_s: Array,
    lines: Array,
    received_s: Array,
    frozen: Array,
    stuck: Array,
    derived: Array,
    z: Array,
    bias: Array,
    motion: Array,
    gated_s: Array,
    compared: Array,
    health: Array,
) -> None:
    """Write the health (13,) of the sensors at a tick.

    ``use`` (k,) is what the filter made of its sensors, ``places`` (13,) where each stands in it, -1 where it
    does not; ``period_s`` (14,) are the sensors' periods and that of the ticks; ``bias`` (3,) those of the
    accelerometer and the gyro; ``stuck`` (3,) the wheels whose samples repeat themselves.
    """
    disagrees = _compare(time_s, z, bias, motion, compared)
    for i in range(health.size):
        status, place = _own(time_s, i, period_s[i], lines, received_s), places[i]
        if place >= 0:
            step_s = period_s[len(SENSORS)]
            status = max(status, _by_filter(use[place], health[i], step_s, gated_s, i))
        health[i] = status
    if disagrees:
        health[_ACCEL] = max(health[_ACCEL], Health.DISAGREES.value)
        health[_SEEN] = max(health[_SEEN], Health.DISAGREES.value)
    if abs(bias[2]) > BIAS_RADPS:
        health[_GYRO] = max(health[_GYRO], Health.DISAGREES.value)
    if is_moving(derived):
        _find_frozen(frozen, health)
    for i in range(3):
        if stuck[i]:
            health[_W + i] = Health.FROZEN.value


@njit(cache=True, error_model="numpy")
def _find_frozen(frozen: Array, health: Array) -> None:
    """Mark the sensors of frozen channels, of wheels aside."""
    for c in range(9):  # rates, forces, roll, pitch, yaw
        sensor = (-1, -1, _GYRO, _ACCEL, _ACCEL, -1, _TILT, _TILT, _YAW)[c]
        if sensor >= 0 and repeats(frozen[OF_IMU], c, REPEATED_IMU[c]):
            health[sensor] = Health.FROZEN.value
    for c in range(3, 12):  # quaternion, velocity, turning about the vertical
        sensor = _SEEN_YAW if c < 7 else (_SEEN if c < 10 else _SEEN_TURN)
        if c not in (8, 10) and repeats(frozen[OF_CAMERA], c, REPEATED_CAMERA[c]):
            health[sensor] = Health.FROZEN.value
    for c in range(2):
        if repeats(frozen[OF_SPEED], c, REPEATED_SPEED[c]):
            health[_SEEN] = Health.FROZEN.value


@njit(cache=True, error_model="numpy")
def find_stuck(
    z: Array, motor_radps: Array, n_repeated: float, speed_mps: float, frozen: Array, stuck: Array
) -> None:
    """Write which (3,) wheels are frozen: their rate repeats itself, or the whole sample does.

    A sample of zeros may be that of a robot at rest: it is frozen where the robot has a speed.
    """
    for i in range(3):
        left_out = math.isnan(z[i]) and math.isfinite(motor_radps[i])
        stuck[i] = left_out and repeats(frozen[OF_WHEELS], i, REPEATED_WHEELS[i])
        stuck[i] |= n_repeated >= N_STUCK and (motor_radps[i] != 0.0 or speed_mps > AT_REST_MPS)


@njit(cache=True, error_model="numpy")
def count_repeated(wheels: Array, before: Array, n_repeated: Array) -> None:
    """Count how often all that the wheels measure repeats itself to the last bit: currents too."""
    same = True
    for c in range(wheels.size):
        same &= wheels[c] == before[c]
        before[c] = wheels[c]
    n_repeated[0] = n_repeated[0] + 1.0 if same else 0.0
