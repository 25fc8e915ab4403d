"""From the streams of a run log to the rows that a filter measures, on one clock and with one delay.

The clock is that of the wheels, whose rates come behind the driver's low-pass.  A ground speed that is ahead
of them makes the slip of a start look negative (Danzi, AgriMaRo thesis, 7.2.2), so every other signal goes
through a low-pass too, and its own lag and the filter's together are the encoders'.  In order:

1. samples that cannot be true are left out and counted (``terrain.estimation.measurements.cleaning``);
2. known latencies are taken off the stamps;
3. calibration, gravity and the camera's axes are taken off, angles are unwrapped;
4. a low-pass, at each sensor's own rate;
5. at each tick the last sample at or before it, unless it is too old; the low-pass runs on to the tick with
   that sample as its input, which leaves no delay of the holding
   (``terrain.estimation.measurements.resampling``).
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from terrain.angles import unwrapped, wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError, DataError
from terrain.estimation.measurements.cleaning import clean_stream, without_leaps
from terrain.estimation.measurements.resampling import ema, on_clock
from terrain.estimation.measurements.table import (
    CAMERA_ROWS,
    GNSS_LATENCY_S,
    GNSS_ROWS,
    GNSS_SPEED_STD_MPS,
    GNSS_STD_M,
    LATE_S,
    ROWS_OF_DRIVE,
    STANDING_S,
    STANDING_SPEED_MPS,
    WILD_FACTOR,
    MeasurementTable,
)
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import body_motion
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS
from terrain.records import Array, RunLog, Stream
from terrain.robots import Camera, Robot, Sensors


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
    With latencies taken off, a row holds what the sensor said of that instant, which arrives only later.
    ``causal``, it holds the last that had arrived, at most a latency and a period old: the low-pass runs on
    from the sample's own instant to the tick.

    A yaw row is ``initial_yaw_rad`` on average while the robot stands at the start, or at its first sample;
    ``causal``, the average is that of the ticks so far.  A camera that starts late takes the IMU's yaw of
    that instant instead, and after a loss the turn nearest to it.  The origin of positions is the first with
    a fix, or the first of all where no fix ever comes, or if ``causal``.

    A sensor slower than the clock gives each of its samples once, so that no filter counts it several times.

    A simulated camera or IMU without noise looks frozen where nothing changes: give it noise.
    """
    _check(time_constant_s, ema_alpha, gnss_latency_s)
    if robot.steered:
        robot.require("motors", "steering", "sensors", *(["camera"] if "odometry" in run.streams else []))
    sensors = robot.completed.sensors
    encoder_s = robot.encoder_lag_s
    smooth_s = 0.0 if ema_alpha is not None else time_constant_s
    lag_s = encoder_s if smooth_s is None else smooth_s
    rows = ROWS_OF_DRIVE[robot.drive]
    dropped: Counter[str] = Counter()
    z: dict[str, Array] = {}
    variance: dict[str, Array] = {}

    wheels = clean_stream(run, "wheels", _wheel_channels(run, robot), dropped)
    if wheels is None:
        raise DataError(f"run {run.run_id}: the stream 'wheels', which gives the clock, is empty")
    clock = wheels.time_s
    rates = wheels.values
    if robot.steered:  # the others' rows are wheel speeds
        rates = wheels.values / robot.motors.reduction_ratio
        wild = np.abs(rates) > WILD_FACTOR * robot.motors.speed_max_radps
        dropped["wheels: beyond the motors"] += int(wild.any(axis=1).sum())
        rates = np.where(wild, np.nan, rates)
    z |= dict(zip(rows, rates.T, strict=False))

    def at_ticks(stream: Stream, time_s: Array, told: dict[str, Array], behind_s: float) -> dict[str, Array]:
        return on_clock(clock, time_s, told, behind_s, stream.time_s if causal else time_s)

    imu = clean_stream(run, "imu", IMU_CHANNELS, dropped, frozen=IMU_CHANNELS[:6])
    if imu is not None:
        time_s = imu.time_s - sensors.imu_latency_s
        told = {row: values for row, values in _imu_rows(imu, sensors).items() if row in rows}
        told = without_leaps("imu", time_s, told, dropped)
        z |= at_ticks(imu, time_s, told, lag_s)

    steering = clean_stream(run, "steering", [f"angle_{i}_rad" for i in robot.wheels], dropped)
    if steering is not None and robot.describes("steering"):
        told = _steering_rows(steering, robot)
        told = without_leaps("steering", steering.time_s, told, dropped)
        z |= at_ticks(steering, steering.time_s, told, lag_s)

    odometry = clean_stream(run, "odometry", CAMERA_CHANNELS, dropped, frozen=CAMERA_CHANNELS[3:13])
    if odometry is not None and robot.describes("camera"):
        camera = robot.camera
        own_s = max(encoder_s - camera.time_constant_s, 0.0) if smooth_s is None else smooth_s
        time_s = odometry.time_s - camera.latency_s
        told = without_leaps("odometry", time_s, _camera_rows(odometry, camera, dropped), dropped)
        taken = at_ticks(odometry, time_s, told, own_s)
        z |= taken if ema_alpha is None else {row: ema(value, ema_alpha) for row, value in taken.items()}

    gnss = clean_stream(run, "gnss", GNSS_CHANNELS, dropped)
    if gnss is not None:
        told, variance_of_told = _gnss_rows(gnss, causal)
        z |= at_ticks(gnss, gnss.time_s - gnss_latency_s, told, lag_s)
        variance |= at_ticks(gnss, gnss.time_s - gnss_latency_s, variance_of_told, 0.0)

    unknown = np.full(clock.size, np.nan)
    table = {row: z.get(row, unknown) for row in rows}
    if robot.steered:
        wheel_speed_mps = robot.wheel_speeds_mps(np.column_stack([table[row] for row in robot.wheel_rows]))
        _refer_yaw(table, clock, wheel_speed_mps, initial_yaw_rad, causal)
    return MeasurementTable(
        clock,
        rows,
        np.column_stack(list(table.values())),
        np.column_stack([variance.get(row, unknown) for row in GNSS_ROWS]),
        {kind: n for kind, n in dropped.items() if n},
    )


def _check(time_constant_s: float | None, ema_alpha: float | None, gnss_latency_s: float) -> None:
    if time_constant_s is not None and not 0 <= time_constant_s < np.inf:
        raise ConfigError(f"time_constant_s is {time_constant_s:g}, a time from zero up is required")
    if ema_alpha is not None and not 0 <= ema_alpha < 1:
        raise ConfigError(f"ema_alpha is {ema_alpha:g}, a share from 0 to below 1 is required")
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


def _imu_rows(imu: Stream, sensors: Sensors) -> dict[str, Array]:
    """Calibrated yaw rate, acceleration of the body without gravity, and yaw.

    A sample is ``scale * truth + bias``.  The specific force at rest is g times the world's vertical in body
    axes, ``g (-sin pitch, sin roll cos pitch, cos roll cos pitch)``: with the nose up (pitch negative) it
    points forward too, with the left side up (roll positive) to the left.
    """
    force_x = (imu.channel("accel_x_mps2") - sensors.accel_bias_x_mps2) / sensors.accel_scale_x_ratio
    force_y = (imu.channel("accel_y_mps2") - sensors.accel_bias_y_mps2) / sensors.accel_scale_y_ratio
    roll, pitch = imu.channel("roll_rad"), imu.channel("pitch_rad")
    return {
        "accel_x_mps2": force_x + GRAVITY_MPS2 * np.sin(pitch),
        "accel_y_mps2": force_y - GRAVITY_MPS2 * np.sin(roll) * np.cos(pitch),
        "gyro_z_radps": imu.channel("gyro_z_radps") - sensors.gyro_bias_z_radps,
        "imu_yaw_rad": unwrapped(imu.channel("yaw_rad")),
    }


def _steering_rows(steering: Stream, robot: Robot) -> dict[str, Array]:
    """Steering angles without their zeros; the first one lies within half a turn."""
    angles = wrapped(steering.values - robot.steering_zeros_rad)
    return {row: unwrapped(angles[:, i]) for i, row in enumerate(robot.steer_rows)}


def _camera_rows(odometry: Stream, camera: Camera, dropped: Counter[str]) -> dict[str, Array]:
    seen = body_motion(odometry, camera)
    lost = np.isfinite(odometry.values[:, 3:7]).all(axis=1) & np.isnan(seen.yaw_rad)
    dropped["odometry: no rotation"] += int(lost.sum())
    columns = (seen.speed_mps[:, 0], seen.speed_mps[:, 1], seen.yaw_rate_radps, seen.yaw_rad)
    return dict(zip(CAMERA_ROWS, columns, strict=True))


def _gnss_rows(gnss: Stream, causal: bool) -> tuple[dict[str, Array], dict[str, Array]]:
    """Positions from the first (fixed) one, speeds, and the variances of both; NaN together."""
    values = np.array(gnss.values[:, :4])
    values[np.isnan(values[:, :2]).any(axis=1), :2] = np.nan
    fixed = gnss.channel("fix_ratio") >= 0.5
    placed = np.isfinite(values[:, 0])
    origin = placed & fixed if (placed & fixed).any() and not causal else placed
    if origin.any():
        values[:, :2] -= values[origin.argmax(), :2]
    std = gnss.channel("std_position_m")
    std = np.where(std > 0, std, np.where(fixed, GNSS_STD_M[True], GNSS_STD_M[False]))
    variance = np.column_stack([std, std, *[np.full(std.size, GNSS_SPEED_STD_MPS)] * 2]) ** 2
    variance[np.isnan(values)] = np.nan
    return dict(zip(GNSS_ROWS, values.T, strict=True)), dict(zip(GNSS_ROWS, variance.T, strict=True))


def _refer_yaw(
    table: dict[str, Array], clock: Array, wheel_speed_mps: Array, initial_yaw_rad: float, causal: bool
) -> None:
    """Count the yaw rows of a table from the start, and keep the camera's on the turn that the IMU is on."""
    moving = (np.abs(wheel_speed_mps) > STANDING_SPEED_MPS).any(axis=1) | (clock > clock[0] + STANDING_S)
    standing = ~np.logical_or.accumulate(moving)
    for row in ("imu_yaw_rad", "camera_yaw_rad"):
        known = np.isfinite(table[row])
        if known.any():
            first = known & standing if (known & standing).any() else np.arange(clock.size) == known.argmax()
            reference = table[row][first].mean()
            if causal:
                so_far = np.maximum(np.cumsum(first), 1)
                reference = np.cumsum(np.where(first, table[row], 0.0)) / so_far
            table[row] = table[row] - reference + initial_yaw_rad
    imu, camera = table["imu_yaw_rad"], table["camera_yaw_rad"]
    both = np.isfinite(imu) & np.isfinite(camera)
    start = int(np.isfinite(camera).argmax())
    if both[start] and clock[start] > clock[0] + LATE_S:
        camera = camera + imu[start] - initial_yaw_rad
    turns = np.round(np.where(both, imu - camera, 0.0) / (2 * np.pi))
    table["camera_yaw_rad"] = camera + 2 * np.pi * turns
