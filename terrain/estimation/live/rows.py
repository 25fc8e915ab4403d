"""The compiled part of live estimation: from samples that just came to the rows of one tick.

What ``cleaning``, ``camera``, ``resampling`` and ``measurements`` of :mod:`terrain.estimation` do to a whole
log, sample by sample, on memory of a fixed size: a queue a stream for what came and is not due, a line a row
for the low-pass and the leaps.  The plain form is theirs; tests hold the two equal.
"""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, float64, int64, njit, types, void

from terrain.constants import GRAVITY_MPS2
from terrain.estimation.measurements.cleaning import BELIEVED_S, MIN_CONFIDENCE_RATIO, OFF_CLOCK_S
from terrain.estimation.measurements.resampling import TICK_S
from terrain.estimation.measurements.table import (
    GNSS_SPEED_STD_MPS,
    GNSS_STD_M,
    LATE_S,
    ROWS_OF_DRIVE,
    STANDING_S,
    STANDING_SPEED_MPS,
)
from terrain.estimation.wheel_slip import UNMEASURED_AFTER_S
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import QUATERNION_TOLERANCE
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS, STEERING_CHANNELS
from terrain.records import Array

ROWS = ROWS_OF_DRIVE["swerve"]
STREAMS = {
    "steering": STEERING_CHANNELS,
    "imu": IMU_CHANNELS,
    "odometry": CAMERA_CHANNELS,
    "gnss": GNSS_CHANNELS,
}
"""Channels of each stream but the wheels, in the order in which the kernels know streams and channels."""

KINDS = (
    "stamp does not increase",
    "off the clock",
    "not finite",
    "frozen",
    "low confidence",
    "no rotation",
    "leap",
    "waited too long",
)
"""What is counted of each stream."""

WHEEL_KINDS = ("not finite", "beyond the motors")
"""What is counted of the wheels."""

QUEUE = 1024
"""Samples of a stream that wait for the wheels; five seconds of a camera."""

LIMITS = ("time_constant_s", "gap_s", "age_s", "once", "leap", "leap_per_s")
"""What is fixed of each row: the columns of ``limits``."""

N_LINE, N_YAW, N_GNSS = 8, 10, 3
"""Length of a row's line in memory, of what the yaw rows are referred to, of what GNSS remembers."""

_STEERING, _IMU, _ODOMETRY, _GNSS = range(4)
_STAMP, _OFF_CLOCK, _NOT_FINITE, _FROZEN, _UNSURE, _NO_ROTATION, _LEAP, _WAITED = range(8)
_TAU, _GAP, _AGE, _ONCE, _LEAST, _PER_S = range(6)
_VALUE, _INSTANT, _CAME, _SMOOTH, _GIVEN, _LAST, _LAST_INSTANT, _SINCE = range(8)
_ACCEL_X, _GYRO_Z, _IMU_YAW, _STEER = 3, 5, 6, 7
_CAMERA, _CAMERA_YAW, _POSITION = 10, 13, 14
_MOVED, _CLOCK_0, _IMU_SUM, _IMU_N, _IMU_MEAN, _SEEN_SUM, _SEEN_N, _SEEN_MEAN, _STARTED, _OFFSET = range(10)
_STAMP_COLUMN, _FINITE_COLUMN, _FIRST_COLUMN = 0, 1, 2  # of a queue
_FIX_STD, _FLOAT_STD = GNSS_STD_M[True], GNSS_STD_M[False]

# Places in `params`
PARAMS = (
    *("reduction_ratio", "wildest_radps", "wheel_radius_m", "initial_yaw_rad"),
    *("gyro_bias_z_radps", "accel_bias_x_mps2", "accel_bias_y_mps2"),
    *("accel_scale_x_ratio", "accel_scale_y_ratio", "zero_1_rad", "zero_2_rad", "zero_3_rad"),
)
"""What the kernels need of the robot, in order."""
(
    *(_REDUCTION, _WILDEST, _RADIUS, _YAW_0, _GYRO_BIAS, _BIAS_X, _BIAS_Y, _SCALE_X, _SCALE_Y, _ZERO),
    _ZERO_2,
    _ZERO_3,
) = range(len(PARAMS))

_V, _M, _I, _IM = float64[::1], float64[:, ::1], int64[::1], int64[:, ::1]
_VECTOR_IN = types.Array(float64, 1, "A", readonly=True)
_MATRIX_IN = types.Array(float64, 2, "A", readonly=True)
_inline = njit(cache=True, error_model="numpy")


@_inline
def _drop_first(queue: Array, n_gone: int, n: int) -> None:
    for k in range(n_gone, n):
        for c in range(queue.shape[1]):
            queue[k - n_gone, c] = queue[k, c]


@njit(
    void(int64, _VECTOR_IN, _MATRIX_IN, _I, _M, _I, _V, _IM),
    cache=True,
    error_model="numpy",
)
def push(
    stream: int,
    time_s: Array,
    values: Array,
    columns: Array,
    queue: Array,
    n_queued: Array,
    last_s: Array,
    counts: Array,
) -> None:
    """Queue samples by stamp; of two that are not in order the one goes that makes the others so.

    ``columns`` says where each channel stands in ``values``, -1 where it does not; a queue holds the stamp,
    whether all channels that are there are finite, and the channels, infinite ones as NaN.
    """
    for k in range(time_s.size):
        n, stamp_s = n_queued[stream], time_s[k]
        before_s = queue[n - 1, _STAMP_COLUMN] if n > 0 else last_s[stream]
        if not (math.isfinite(stamp_s) and stamp_s > before_s):
            counts[stream, _STAMP] += 1
            earlier_s = queue[n - 2, _STAMP_COLUMN] if n > 1 else last_s[stream]
            if n == 0 or stamp_s == before_s or not stamp_s > earlier_s or stamp_s == np.inf:
                continue
            n -= 1  # the one before was the one ahead
        if n == queue.shape[0]:
            half = n // 2
            counts[stream, _WAITED] += half
            _drop_first(queue, half, n)
            n -= half
        finite = True
        for c in range(columns.size):
            value = values[k, columns[c]] if columns[c] >= 0 else np.nan
            finite &= columns[c] < 0 or math.isfinite(value)
            queue[n, _FIRST_COLUMN + c] = value if math.isfinite(value) else np.nan
        queue[n, _STAMP_COLUMN], queue[n, _FINITE_COLUMN] = stamp_s, finite
        counts[stream, _NOT_FINITE] += not finite
        n_queued[stream] = n + 1


@_inline
def _wrapped(angle_rad: float) -> float:
    return np.pi - (np.pi - angle_rad) % (2 * np.pi)


@_inline
def _unwrapped(angle_rad: float, memory: Array) -> float:
    """Return the angle on the turn that it went on to; ``memory`` holds the last one and its turns."""
    if math.isnan(angle_rad):
        return np.nan
    step = angle_rad - memory[0]
    if math.isnan(step):
        memory[1] = 0.0
    elif abs(step) >= np.pi:
        short = (step + np.pi) % (2 * np.pi) - np.pi
        if short == -np.pi and step > 0:
            short = np.pi
        memory[1] += short - step
    memory[0] = angle_rad
    return float(angle_rad + memory[1])


@_inline
def _take(row: int, value: float, instant_s: float, came_s: float, lines: Array, limits: Array) -> bool:
    """Put a value behind the low-pass of its row; return True, and do not, where it leapt."""
    if math.isnan(value):
        return False
    line, limit = lines[row], limits[row]
    if abs(value - line[_LAST]) > limit[_LEAST] + limit[_PER_S] * (instant_s - line[_LAST_INSTANT]):
        if math.isnan(line[_SINCE]):
            line[_SINCE] = instant_s
        if instant_s - line[_SINCE] < BELIEVED_S:
            return True
    line[_LAST], line[_LAST_INSTANT], line[_SINCE] = value, instant_s, np.nan
    step_s = instant_s - line[_INSTANT]
    smooth, tau_s = value, limit[_TAU]
    if tau_s > 0.0 and step_s <= limit[_GAP]:
        lead = tau_s * (value - line[_VALUE]) / step_s
        smooth = value - lead + math.exp(-step_s / tau_s) * (line[_SMOOTH] - line[_VALUE] + lead)
    line[_VALUE], line[_INSTANT], line[_CAME], line[_SMOOTH] = value, instant_s, came_s, smooth
    line[_GIVEN] = 0.0
    return False


@_inline
def _at_tick(row: int, time_s: float, lines: Array, limits: Array) -> float:
    """Return a row's value at a tick, the low-pass run on to it; NaN where too old or given before."""
    line, limit = lines[row], limits[row]
    given = limit[_ONCE] > 0.0 and line[_GIVEN] > 0.0
    line[_GIVEN] = 1.0
    if given or not time_s - line[_CAME] <= limit[_AGE] + TICK_S:
        return np.nan
    behind = line[_SMOOTH] - line[_VALUE]
    if limit[_TAU] > 0.0:
        behind *= math.exp((line[_INSTANT] - time_s) / limit[_TAU])
    return float(line[_VALUE] + behind)


@_inline
def _repeats(sample: Array, first: int, last: int, before: Array) -> bool:
    """Say whether channels are those of the sample before to the last bit, and keep them."""
    same, n_known = True, 0
    for c in range(first, last):
        value = sample[_FIRST_COLUMN + c]
        if not math.isnan(value):
            n_known += 1
            same &= value == before[c]
        before[c] = value
    return same and n_known > 0


@_inline
def _steering(sample: Array, came_s: float, params: Array, turns: Array, lines: Array, limits: Array) -> bool:
    leapt = False
    for i in range(3):
        angle = _wrapped(sample[_FIRST_COLUMN + i] - params[_ZERO + i])
        leapt |= _take(_STEER + i, _unwrapped(angle, turns[i]), came_s, came_s, lines, limits)
    return leapt


@_inline
def _imu(
    sample: Array,
    instant_s: float,
    came_s: float,
    params: Array,
    turns: Array,
    lines: Array,
    limits: Array,
) -> bool:
    """Yaw rate, acceleration without gravity, yaw: calibrated as in ``measurements``."""
    gyro_z, force_x, force_y = (
        sample[_FIRST_COLUMN + 2],
        sample[_FIRST_COLUMN + 3],
        sample[_FIRST_COLUMN + 4],
    )
    roll, pitch, yaw = sample[_FIRST_COLUMN + 6], sample[_FIRST_COLUMN + 7], sample[_FIRST_COLUMN + 8]
    accel_x = (force_x - params[_BIAS_X]) / params[_SCALE_X] + GRAVITY_MPS2 * math.sin(pitch)
    level_y = GRAVITY_MPS2 * math.sin(roll) * math.cos(pitch)
    accel_y = (force_y - params[_BIAS_Y]) / params[_SCALE_Y] - level_y
    leapt = _take(_ACCEL_X, accel_x, instant_s, came_s, lines, limits)
    leapt |= _take(_ACCEL_X + 1, accel_y, instant_s, came_s, lines, limits)
    leapt |= _take(_GYRO_Z, gyro_z - params[_GYRO_BIAS], instant_s, came_s, lines, limits)
    leapt |= _take(_IMU_YAW, _unwrapped(yaw, turns[3]), instant_s, came_s, lines, limits)
    return bool(leapt)


@_inline
def _odometry(
    sample: Array, instant_s: float, came_s: float, turns: Array, lines: Array, limits: Array, counts: Array
) -> bool:
    """Speed of the camera point, yaw rate and yaw: ``camera.body_motion`` of one sample."""
    first = _FIRST_COLUMN + 3
    # the camera's axes renamed to the body's: (-z, -x, y), of vectors and of the quaternion's vector alike
    x, y, z, w = -sample[first + 2], -sample[first], sample[first + 1], sample[first + 3]
    v_x, v_y, v_z = -sample[first + 6], -sample[first + 4], sample[first + 5]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not abs(norm - 1.0) <= QUATERNION_TOLERANCE:
        counts[_ODOMETRY, _NO_ROTATION] += not math.isnan(norm)
        return False
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    r_00, r_11 = x * x - y * y - z * z + w * w, -x * x + y * y - z * z + w * w
    r_01, r_10 = 2.0 * (x * y - z * w), 2.0 * (x * y + z * w)
    r_20, r_21 = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w)
    yaw = _unwrapped(math.atan2(r_10, r_00), turns[4])
    if math.isnan(turns[4, 2]):
        turns[4, 2] = yaw
    speed_x = r_00 * v_x + r_10 * v_y + r_20 * v_z
    speed_y = r_01 * v_x + r_11 * v_y + r_21 * v_z
    leapt = _take(_CAMERA, speed_x, instant_s, came_s, lines, limits)
    leapt |= _take(_CAMERA + 1, speed_y, instant_s, came_s, lines, limits)
    leapt |= _take(_CAMERA + 2, sample[first + 8], instant_s, came_s, lines, limits)
    leapt |= _take(_CAMERA_YAW, yaw - turns[4, 2], instant_s, came_s, lines, limits)
    return bool(leapt)


@_inline
def _gnss(sample: Array, instant_s: float, came_s: float, lines: Array, limits: Array, gnss: Array) -> None:
    """Position from the first one, and speed; ``gnss`` keeps the origin and the position's variance."""
    east, north = sample[_FIRST_COLUMN], sample[_FIRST_COLUMN + 1]
    std = sample[_FIRST_COLUMN + 4]
    if not std > 0.0:
        std = _FIX_STD if sample[_FIRST_COLUMN + 5] >= 0.5 else _FLOAT_STD
    if not (math.isnan(east) or math.isnan(north)):
        if math.isnan(gnss[0]):
            gnss[0], gnss[1] = east, north
        gnss[2] = std * std
        _take(_POSITION, east - gnss[0], instant_s, came_s, lines, limits)
        _take(_POSITION + 1, north - gnss[1], instant_s, came_s, lines, limits)
    _take(_POSITION + 2, sample[_FIRST_COLUMN + 2], instant_s, came_s, lines, limits)
    _take(_POSITION + 3, sample[_FIRST_COLUMN + 3], instant_s, came_s, lines, limits)


@_inline
def _refer_yaw(time_s: float, z: Array, params: Array, yaw: Array) -> None:
    """Count the yaw rows from the start, and keep the camera's on the turn that the IMU is on."""
    initial = params[_YAW_0]
    if math.isnan(yaw[_CLOCK_0]):
        yaw[_CLOCK_0] = time_s
    if time_s > yaw[_CLOCK_0] + STANDING_S:
        yaw[_MOVED] = 1.0
    for i in range(3):
        if abs(z[i] * params[_RADIUS]) > STANDING_SPEED_MPS:
            yaw[_MOVED] = 1.0
    for row, at in ((_IMU_YAW, _IMU_SUM), (_CAMERA_YAW, _SEEN_SUM)):
        if math.isnan(z[row]):
            continue
        if yaw[_MOVED] == 0.0 or yaw[at + 1] == 0.0:
            yaw[at] += z[row]
            yaw[at + 1] += 1.0
            yaw[at + 2] = yaw[at] / yaw[at + 1]
        z[row] = z[row] - yaw[at + 2] + initial
    imu, seen = z[_IMU_YAW], z[_CAMERA_YAW]
    if math.isnan(seen):
        return
    if yaw[_STARTED] == 0.0:
        yaw[_STARTED] = 1.0
        if not math.isnan(imu) and time_s > yaw[_CLOCK_0] + LATE_S:
            yaw[_OFFSET] = imu - initial
    seen += yaw[_OFFSET]
    if not math.isnan(imu):
        seen += 2 * np.pi * np.rint((imu - seen) / (2 * np.pi))
    z[_CAMERA_YAW] = seen


@njit(
    void(
        *(float64, boolean, _V, _M, _M, _M, _M, _I, _V, _V, _V, _M),
        *(_M, _M, _M, _V, _V, _M, _V, _V, boolean[::1], _IM, _I),
    ),
    cache=True,
    error_model="numpy",
)
def rows_at(
    time_s: float,
    set_back: bool,
    motor_radps: Array,
    steering: Array,
    imu: Array,
    odometry: Array,
    gnss: Array,
    n_queued: Array,
    last_s: Array,
    latency_s: Array,
    params: Array,
    limits: Array,
    before: Array,
    turns: Array,
    lines: Array,
    yaw: Array,
    gnss_memory: Array,
    received_s: Array,
    z: Array,
    gnss_variance: Array,
    unmeasured: Array,
    counts: Array,
    wheel_counts: Array,
) -> None:
    """Take from the queues what came by a tick of the wheels; write its rows z (18,) and variances (4,).

    ``set_back`` says that the clock was: what is remembered of its other time is forgotten.  ``unmeasured``
    (3,) tells the wheels of which rate or angle was not measured for too long.
    """
    if set_back:
        n_queued[:] = 0
        last_s[:] = -np.inf
        lines[:] = np.nan
        before[:] = np.nan
        received_s[:] = -np.inf
    for stream in range(4):
        queue = (steering, imu, odometry, gnss)[stream]
        n, n_due = n_queued[stream], 0
        while n_due < n and queue[n_due, _STAMP_COLUMN] <= time_s + TICK_S:
            sample = queue[n_due]
            n_due += 1
            came_s = sample[_STAMP_COLUMN]
            instant_s = came_s - latency_s[stream]
            last_s[stream] = came_s
            leapt = False
            if stream == _STEERING:
                leapt = _steering(sample, came_s, params, turns, lines, limits)
            elif stream == _IMU:
                if sample[_FINITE_COLUMN] > 0.0 and _repeats(sample, 0, 6, before[0]):
                    counts[stream, _FROZEN] += 1
                    continue
                leapt = _imu(sample, instant_s, came_s, params, turns, lines, limits)
            elif stream == _ODOMETRY:
                if sample[_FINITE_COLUMN] > 0.0 and _repeats(sample, 3, 13, before[1]):
                    counts[stream, _FROZEN] += 1
                    continue
                if sample[_FIRST_COLUMN + 13] < MIN_CONFIDENCE_RATIO:
                    counts[stream, _UNSURE] += 1
                    continue
                leapt = _odometry(sample, instant_s, came_s, turns, lines, limits, counts)
            else:
                _gnss(sample, instant_s, came_s, lines, limits, gnss_memory)
            counts[stream, _LEAP] += leapt
        while n > n_due and queue[n - 1, _STAMP_COLUMN] > time_s + OFF_CLOCK_S:
            counts[stream, _OFF_CLOCK] += 1
            n -= 1
        _drop_first(queue, n_due, n)
        n_queued[stream] = n - n_due

    finite, wild = True, False
    for i in range(3):
        rate = motor_radps[i] / params[_REDUCTION]
        finite &= math.isfinite(rate)
        too_fast = math.isfinite(rate) and abs(rate) > params[_WILDEST]
        wild |= too_fast
        z[i] = np.nan if too_fast or not math.isfinite(rate) else rate
    wheel_counts[0] += not finite
    wheel_counts[1] += wild
    for row in range(3, z.size):
        z[row] = _at_tick(row, time_s, lines, limits)
    for i in range(2):
        gnss_variance[i] = np.nan if math.isnan(z[_POSITION + i]) else gnss_memory[2]
        gnss_variance[2 + i] = np.nan if math.isnan(z[_POSITION + 2 + i]) else GNSS_SPEED_STD_MPS**2
    for i in range(3):
        unmeasured[i] = False
        for k, row in enumerate((i, _STEER + i)):
            if not math.isnan(z[row]):
                received_s[k, i] = time_s
            unmeasured[i] |= time_s - received_s[k, i] > UNMEASURED_AFTER_S
    _refer_yaw(time_s, z, params, yaw)
