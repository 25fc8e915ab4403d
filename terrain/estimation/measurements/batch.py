"""The measurements of a whole run log: one clock, one delay.

The clock is that of the wheels, whose rates pass the low-pass of the motor driver.  A ground speed that
is ahead of them makes the slip of a start look negative (Danzi, AgriMaRo thesis, 7.2.2), so every other
signal goes through a low-pass too, and its own lag and the filter's together are the encoders'.  In order:

1. samples that cannot be true are left out and counted (:mod:`~terrain.estimation.measurements.cleaning`);
2. known latencies are subtracted from the stamps;
3. calibration, gravity and the camera's axes are removed, angles are unwrapped
   (:mod:`~terrain.estimation.measurements.samples`);
4. leaps are left out, then a low-pass, at each sensor's own rate;
5. at each tick the last sample at or before it, unless it is too old; the low-pass runs on to the tick with
   that sample as its input, which leaves no delay of the holding
   (:mod:`~terrain.estimation.measurements.sample_hold`).

Steps 3 to 5 are those of the live chain (:mod:`terrain.estimation.live.rows`), looped.  What looks ahead is
the cleaning, the median periods and, unless ``causal``, latencies, the yaw at the start and the origin of
positions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.errors import ConfigError, DataError
from terrain.estimation.measurements.cleaning import clean_stream
from terrain.estimation.measurements.derived import derived_memory, is_moving
from terrain.estimation.measurements.frozen import frozen_memory
from terrain.estimation.measurements.resampling import ema, median_step_s
from terrain.estimation.measurements.sample_hold import TICK_S
from terrain.estimation.measurements.samples import (
    LEAPT,
    N_FATES,
    NO_ROTATION,
    ROWS,
    STREAMS,
    limits_of_rows,
    params_of,
    row_memory,
    rows_at_tick,
    take_sample,
    wheel_rates,
)
from terrain.estimation.measurements.skid_rows import with_skid_rows
from terrain.estimation.measurements.table import (
    CAMERA_ROWS,
    GNSS_LATENCY_S,
    GNSS_ROWS,
    ROWS_OF_DRIVE,
    MeasurementTable,
)
from terrain.estimation.measurements.yaw import average_yaw, refer_yaw, yaw_memory
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot


class _Samples(NamedTuple):
    """Samples by stream, in the order of :data:`STREAMS`: arrival, instant of measurement, values."""

    came_s: tuple[Array, ...]
    instant_s: tuple[Array, ...]
    values: tuple[Array, ...]


def measurement_table(
    run: RunLog,
    robot: Robot,
    *,
    time_constant_s: float | None = None,
    ema_alpha: float | None = None,
    initial_yaw_rad: float = 0.0,
    gnss_latency_s: float = GNSS_LATENCY_S,
    causal: bool = False,
) -> MeasurementTable:
    """Return the measurements of a run, ready for a filter.

    Parameters
    ----------
    run : with the stream ``wheels``; ``steering``, ``imu``, ``odometry`` and ``gnss`` are optional, whole or
        in parts, and give NaN where they are missing
    robot : a swerve robot needs its motors, steering and sensors described, and its camera with odometry
    time_constant_s : of the low-pass on all but the wheels; 0 for none.  By default what each sensor lacks to
        the encoders' ``encoder_time_constant_s`` ((6.12) and (7.8) with a time constant for their alpha)
    ema_alpha : for the thesis' own smoothing in place of the low-pass: ``z = a z_prev + (1 - a) z_raw`` a
        tick on the camera's rows (7.8), at 0.2 a delay of a quarter of a tick; the other rows stay raw
    initial_yaw_rad : heading of the start in the world frame, to which all yaw rows are referred
    gnss_latency_s : age of a position when it arrives
    causal : whether a tick takes only what had arrived by then, as a live filter has to; cleaning looks ahead
        all the same

    Raises
    ------
    DataError
        if there are no wheels to give the clock.
    ConfigError
        if a time constant or an alpha is out of range, or a section of the description is missing.

    Notes
    -----
    With latencies subtracted, a row holds what the sensor measured at that instant, which arrives only later.
    ``causal``, it holds the last that had arrived, at most a latency and a period old: the low-pass runs on
    from the sample's own instant to the tick.

    A yaw row is ``initial_yaw_rad`` on average while the robot is at rest at the start, or at its first
    sample; ``causal``, the average is that of the ticks so far.  The origin of positions is the first with a
    fix, or the first of all where no fix ever comes, or if ``causal``.

    A robot that skids has a last row more, the gyro at rest, and its gyro is the mean since the last tick.

    A sensor slower than the clock gives each of its samples once, so that no filter counts it several times.

    A simulated camera or IMU without noise looks frozen where nothing changes: give it noise.
    """
    _check(time_constant_s, ema_alpha, gnss_latency_s)
    if robot.steered:
        robot.require("motors", "steering", "sensors", *(["camera"] if "odometry" in run.streams else []))
    dropped: Counter[str] = Counter()
    wheels = clean_stream(run, "wheels", _wheel_channels(run, robot), dropped)
    if wheels is None:
        raise DataError(f"run {run.run_id}: the stream 'wheels', which gives the clock, is empty")
    streams = _clean_streams(run, robot, dropped)
    clock = np.array(wheels.time_s)
    limits = _limits(streams, robot, clock, 0.0 if ema_alpha is not None else time_constant_s)
    samples = _samples_of(streams, _latencies_s(robot, gnss_latency_s), causal)
    motor_radps = np.array(wheels.values) if robot.steered else np.full((clock.size, 3), np.nan)
    params = params_of(robot, initial_yaw_rad)
    origin_m = _gnss_origin(streams["gnss"]) if "gnss" in streams and not causal else np.full(2, np.nan)
    z, variance, counts = _rows(clock, motor_radps, samples, params, limits, origin_m)
    dropped += counts  # a Counter, so that zeros fall out
    if ema_alpha is not None:
        for row in CAMERA_ROWS:
            z[:, ROWS.index(row)] = ema(z[:, ROWS.index(row)], ema_alpha)
    if robot.steered:
        _refer_yaw(clock, z, params, yaw_memory(), causal)
    rows = ROWS_OF_DRIVE[robot.drive]
    columns = dict(zip(ROWS, z.T, strict=True))
    if not robot.steered:  # their wheels report speeds
        columns |= dict(zip(rows, wheels.values.T, strict=False))
    table = np.column_stack([columns[row] for row in rows])
    found = MeasurementTable(clock, rows, table, variance, dropped)
    return found if robot.steered else with_skid_rows(found, run, robot, time_constant_s)


def _rows(
    clock: Array, motor_radps: Array, samples: _Samples, params: Array, limits: Array, origin_m: Array
) -> tuple[Array, Array, Counter[str]]:
    """Return the rows (n, 29), the variances (n, 4) of the GNSS rows, and what was left out."""
    n = clock.size
    z, variance = np.empty((n, len(ROWS))), np.empty((n, len(GNSS_ROWS)))
    counts = np.zeros((len(STREAMS) + 1, N_FATES), np.int64)  # the last row is of the wheels
    lines, turns, gnss = row_memory()
    gnss[:2] = origin_m
    memory = (lines, turns, gnss, derived_memory(), frozen_memory())
    _fill_rows(clock, motor_radps, *samples, params, limits, *memory, z, variance, counts)
    dropped = Counter({"wheels: beyond the motors": int(counts[-1, 0])})
    for number, name in enumerate(STREAMS):
        dropped[f"{name}: leap"] = int(counts[number, LEAPT])
        dropped[f"{name}: no rotation"] = int(counts[number, NO_ROTATION])
    return z, variance, dropped


def _check(time_constant_s: float | None, ema_alpha: float | None, gnss_latency_s: float) -> None:
    if time_constant_s is not None and not 0 <= time_constant_s < np.inf:
        raise ConfigError(f"time_constant_s is {time_constant_s:g}, a time from zero up is required")
    if ema_alpha is not None and not 0 <= ema_alpha < 1:
        raise ConfigError(f"ema_alpha is {ema_alpha:g}, a number from 0 to below 1 is required")
    if ema_alpha is not None and time_constant_s is not None:
        raise ConfigError("give time_constant_s or ema_alpha, not both: one of them smooths the camera")
    if not 0 <= gnss_latency_s < np.inf:
        raise ConfigError(f"gnss_latency_s is {gnss_latency_s:g}, a time from zero up is required")


def _wheel_channels(run: RunLog, robot: Robot) -> list[str]:
    channels = list(robot.rate_channels)
    if "wheels" not in run.streams:
        raise DataError(f"run {run.run_id}: there is no stream 'wheels', which gives the clock")
    lacking = [channel for channel in channels if channel not in run.streams["wheels"].channels]
    if lacking:
        raise DataError(
            f"run {run.run_id}: the stream 'wheels' has no channel {lacking[0]!r}, which the robot "
            f"{robot.name} should have"
        )
    return channels


def _clean_streams(run: RunLog, robot: Robot, dropped: Counter[str]) -> dict[str, Stream]:
    """Return the streams that the robot's rows are measured by, cleaned."""
    steering_channels = [f"angle_{wheel}_rad" for wheel in robot.wheels]
    found = {
        "imu": clean_stream(run, "imu", IMU_CHANNELS, dropped, frozen=IMU_CHANNELS[:6]),
        "steering": clean_stream(run, "steering", steering_channels, dropped),
        "odometry": clean_stream(run, "odometry", CAMERA_CHANNELS, dropped, frozen=CAMERA_CHANNELS[3:13]),
        "gnss": clean_stream(run, "gnss", GNSS_CHANNELS, dropped),
    }
    has = {"steering": robot.describes("steering"), "odometry": robot.describes("camera")}
    return {name: stream for name, stream in found.items() if stream is not None and has.get(name, True)}


def _latencies_s(robot: Robot, gnss_latency_s: float) -> dict[str, float]:
    return {
        "imu": robot.completed.sensors.imu_latency_s,
        "odometry": robot.completed.camera.latency_s,
        "gnss": gnss_latency_s,
    }


def _samples_of(streams: Mapping[str, Stream], latency_s: Mapping[str, float], causal: bool) -> _Samples:
    came_s, instant_s, values = [], [], []
    for name, channels in STREAMS.items():
        stream = streams.get(name)
        stamps = np.array(stream.time_s) if stream is not None else np.empty(0)
        instant_s.append(stamps - latency_s.get(name, 0.0))
        came_s.append(stamps if causal else instant_s[-1])
        values.append(np.array(stream.values) if stream is not None else np.empty((0, len(channels))))
    return _Samples(tuple(came_s), tuple(instant_s), tuple(values))


def _limits(
    streams: Mapping[str, Stream], robot: Robot, clock: Array, time_constant_s: float | None
) -> Array:
    """Return the limits (29, 7) of the rows, by the median periods of the log."""
    lag_s = dict.fromkeys(STREAMS, robot.encoder_lag_s if time_constant_s is None else time_constant_s)
    if robot.describes("camera") and time_constant_s is None:
        lag_s["odometry"] = max(robot.encoder_lag_s - robot.camera.time_constant_s, 0.0)
    period_s = {name: median_step_s(stream.time_s) for name, stream in streams.items()}
    judged = ROWS if robot.steered else ("gyro_z_radps",)
    return limits_of_rows(lag_s, period_s, median_step_s(clock), judged)


def _gnss_origin(gnss: Stream) -> Array:
    """Return the first position with a fix, or the first where there is none; NaN without any."""
    position = gnss.values[:, :2]
    known = np.isfinite(position).all(axis=1)
    fixed = known & (gnss.channel("fix_ratio") >= 0.5)
    first = fixed if fixed.any() else known
    return np.asarray(position[first.argmax()]) if first.any() else np.full(2, np.nan)


@njit(cache=True, error_model="numpy")
def _fill_rows(
    clock: Array,
    motor_radps: Array,
    came_s: tuple[Array, ...],
    instant_s: tuple[Array, ...],
    samples: tuple[Array, ...],
    params: Array,
    limits: Array,
    lines: Array,
    turns: Array,
    gnss: Array,
    derived: Array,
    frozen: Array,
    z: Array,
    gnss_variance: Array,
    counts: Array,
) -> None:
    """Write the rows z (n, 29) and variances (n, 4) of each tick, and count what became of the samples."""
    due = np.zeros(len(came_s), np.int64)
    for n in range(clock.size + 1):
        time_s = clock[n] + TICK_S if n < clock.size else np.inf  # what comes after the last tick is counted
        for stream in range(len(came_s)):
            k = due[stream]
            while k < came_s[stream].size and came_s[stream][k] <= time_s:
                fate = take_sample(
                    stream,
                    samples[stream][k],
                    (instant_s[stream][k], came_s[stream][k]),
                    params,
                    turns,
                    lines,
                    limits,
                    (gnss, derived, frozen),
                )
                counts[stream, fate] += 1
                k += 1
            due[stream] = k
        if n < clock.size:
            _, beyond = wheel_rates(motor_radps[n], params, is_moving(derived), frozen, z[n])
            counts[-1, 0] += beyond
            rows_at_tick(clock[n], lines, limits, gnss, params, derived, z[n], gnss_variance[n])


@njit(cache=True, error_model="numpy")
def _refer_yaw(clock: Array, z: Array, params: Array, yaw: Array, causal: bool) -> None:
    """Count the yaw rows from the start: from the averages of all ticks, or of those so far."""
    if not causal:
        for n in range(clock.size):
            average_yaw(clock[n], z[n], params, yaw)
    for n in range(clock.size):
        if causal:
            average_yaw(clock[n], z[n], params, yaw)
        refer_yaw(clock[n], z[n], params, yaw)
