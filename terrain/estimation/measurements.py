"""From the streams of a run log to the rows that a filter measures, on one clock and with one delay.

The clock is that of the wheels, whose rates come behind the driver's low-pass.  A ground speed that is ahead
of them makes the slip of a start look negative (Danzi, AgriMaRo thesis, 7.2.2), so every other signal goes
through a low-pass too, and its own lag and the filter's together are the encoders'.  In order:

1. samples that cannot be true are left out and counted (:func:`_clean`);
2. known latencies are taken off the stamps;
3. calibration, gravity and the camera's axes are taken off, angles are unwrapped;
4. :func:`low_pass`, at each sensor's own rate;
5. at each tick the last sample at or before it, unless it is too old (:func:`_held`); the low-pass runs on to
   the tick with that sample as its input, which leaves no delay of the holding.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numba import njit
from scipy.signal import lfilter

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError, DataError
from terrain.estimation.camera import CHANNELS as CAMERA_CHANNELS
from terrain.estimation.camera import body_motion, unwrapped
from terrain.logs.samples import longest_rise
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS
from terrain.records import Array, RunLog, Stream, read_only
from terrain.robots import Camera, Robot, Steering

FROZEN_S = 0.25
"""Noise that repeats exactly for so long is none: 50 samples of the camera, 25 of the IMU."""

MIN_CONFIDENCE_RATIO = 0.34
"""The camera tells 0, 1/3, 2/3 or 1; at 1/3 (low) and below it has lost its features."""

MAX_AGE_PERIODS = 1.5
"""A value is held until the next one is due and half a period more, of the slower of sensor and clock."""

GAP_PERIODS = 5.0
"""After a longer gap the low-pass starts anew: what it remembers is not the past of what comes."""

WILD_FACTOR = 2.0
"""No wheel turns so many times faster than its motor can drive it."""

OFF_CLOCK_S = 1.0
"""A sample that is further from every tick is of no use to anyone: its clock leapt."""

LATE_S = 0.5
"""A camera whose first sample comes later than this after the clock's may have missed a turn."""

STANDING_S = 1.0
"""Longest stretch, before the wheels turn, over which the heading at the start is averaged."""

STANDING_SPEED_MPS = 0.05
"""Rim speed under which a wheel counts as standing (thesis 7.2.1)."""

GNSS_LATENCY_S = 0.1
"""Age of a position when it arrives; assumed, as in the simulated receiver."""

GNSS_STD_M = {True: 0.02, False: 0.5}
"""Position's standard deviation with a fix (RTK, thesis 5.1.1) and with a float solution (assumed)."""

GNSS_SPEED_STD_MPS = 0.03
"""Of the Doppler speed; assumed, as in the simulated receiver."""

LEAPS: dict[str, tuple[float, float]] = {
    "accel_x_mps2": (20.0, 1000.0),
    "accel_y_mps2": (20.0, 1000.0),
    "gyro_z_radps": (0.5, 20.0),
    "imu_yaw_rad": (0.1, 4.0),
    **dict.fromkeys((f"steer_{i}_rad" for i in (1, 2, 3)), (0.1, 5.0)),
    "camera_speed_x_mps": (0.1, 5.0),
    "camera_speed_y_mps": (0.1, 5.0),
    "camera_yaw_rate_radps": (0.2, 20.0),
    "camera_yaw_rad": (0.1, 4.0),
}
"""What a sensor's noise may do between two samples and, a second, what a robot may: half a g, two thirds of a
turn, twice the fastest steering; an accelerometer on rough ground sees several g."""

BELIEVED_S = 0.1
"""A value that has leapt and stays is believed after this long: it is left to the filter's gate."""

CAMERA_ROWS = ("camera_speed_x_mps", "camera_speed_y_mps", "camera_yaw_rate_radps", "camera_yaw_rad")
GNSS_ROWS = ("gnss_position_x_m", "gnss_position_y_m", "gnss_speed_x_mps", "gnss_speed_y_mps")
ROWS_OF_DRIVE: dict[str, tuple[str, ...]] = {
    "swerve": (
        *(f"wheel_{i}_radps" for i in (1, 2, 3)),
        "accel_x_mps2",
        "accel_y_mps2",
        "gyro_z_radps",
        "imu_yaw_rad",
        *(f"steer_{i}_rad" for i in (1, 2, 3)),
        *CAMERA_ROWS,
        *GNSS_ROWS,
    ),
    "skid_steer": ("wheel_left_mps", "wheel_right_mps", "gyro_z_radps", *GNSS_ROWS),
}
"""Rows of a table, of a swerve robot in the order of (6.3).

Positions and GNSS speeds are in the world frame, east and north from where the antenna first was; yaw counts
from east once the heading at the start is given; all else is in body axes."""

_TICK_S = 1e-9
"""Stamps that differ by less are the same instant, written by two clocks' arithmetic."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementTable:
    """What a filter measures at each tick of its clock; NaN where a sensor gave nothing.

    Parameters
    ----------
    time_s : (n,) stamps of the wheels stream
    rows : name of each of the m measurements
    z : (n, m)
    gnss_variance : (n, 4) of :data:`GNSS_ROWS`, in their units squared; NaN where they are
    dropped : samples left out, as counts by stream and kind (``"imu: frozen"``)
    """

    time_s: Array
    rows: tuple[str, ...]
    z: Array
    gnss_variance: Array
    dropped: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("time_s", "z", "gnss_variance"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        object.__setattr__(self, "rows", tuple(self.rows))
        object.__setattr__(self, "dropped", MappingProxyType(dict(self.dropped)))
        n = self.time_s.size
        for name, shape in {"z": (n, len(self.rows)), "gnss_variance": (n, len(GNSS_ROWS))}.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, {shape} is needed")

    def at(self, time_s: Array) -> MeasurementTable:
        """Return the table of some of its own instants, as a filter's track has them that left rows out."""
        if np.array_equal(time_s, self.time_s):
            return self
        rows = np.searchsorted(self.time_s, time_s)
        return MeasurementTable(
            self.time_s[rows], self.rows, self.z[rows], self.gnss_variance[rows], self.dropped
        )

    def columns(self, names: Iterable[str]) -> Array:
        """Return the measurements (n, len(names)) in the order of a model's rows.

        Raises
        ------
        DataError
            if the table has no such row.
        """
        try:
            return self.z[:, [self.rows.index(name) for name in names]]
        except ValueError:
            lacking = next(name for name in names if name not in self.rows)
            raise DataError(
                f"there is no measurement {lacking!r}; this robot gives {', '.join(self.rows)}"
            ) from None


def measurement_table(
    run: RunLog,
    robot: Robot,
    *,
    time_constant_s: float | None = None,
    ema_alpha: float | None = None,
    initial_yaw_rad: float = 0.0,
    gnss_latency_s: float = GNSS_LATENCY_S,
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

    Raises
    ------
    DataError
        if there are no wheels to give the clock.
    ConfigError
        if a time constant or an alpha is out of range, or a section of the description is missing.

    Notes
    -----
    With latencies taken off, a row holds what the sensor said of that instant, which arrives only later: a
    live filter has to wait for the longest latency.

    A yaw row is ``initial_yaw_rad`` on average while the robot stands at the start, or at its first sample.
    A camera that starts late takes the IMU's yaw of that instant instead, and after a loss the turn nearest
    to it.  The origin of positions is the first with a fix, or the first of all where no fix ever comes.

    A sensor slower than the clock gives each of its samples once, so that no filter counts it several times.

    A simulated camera or IMU without noise looks frozen where nothing changes: give it noise.
    """
    _check(time_constant_s, ema_alpha, gnss_latency_s)
    if robot.drive == "swerve":
        robot.has("motors", "steering", "sensors", *(["camera"] if "odometry" in run.streams else []))
    sensors, camera = robot.sensors, robot.camera
    encoder_s = sensors.encoder_time_constant_s if sensors else 0.0
    smooth_s = 0.0 if ema_alpha is not None else time_constant_s
    lag_s = encoder_s if smooth_s is None else smooth_s
    rows = ROWS_OF_DRIVE[robot.drive]
    dropped: Counter[str] = Counter()
    z: dict[str, Array] = {}
    variance: dict[str, Array] = {}

    wheels = _clean(run, "wheels", _wheel_channels(run, robot), dropped)
    if wheels is None:
        raise DataError(f"run {run.run_id}: the stream 'wheels', which gives the clock, is empty")
    clock = wheels.time_s
    rates = wheels.values / (robot.motors.reduction_ratio if robot.motors else 1.0)
    if robot.motors is not None:
        wild = np.abs(rates) > WILD_FACTOR * robot.motors.speed_max_radps
        dropped["wheels: beyond the motors"] += int(wild.any(axis=1).sum())
        rates = np.where(wild, np.nan, rates)
    z |= dict(zip(rows, rates.T, strict=False))

    imu = _clean(run, "imu", IMU_CHANNELS, dropped, frozen=IMU_CHANNELS[:6])
    if imu is not None:
        time_s = imu.time_s - (sensors.imu_latency_s if sensors else 0.0)
        told = _without_leaps("imu", time_s, _imu_rows(imu, robot), dropped)
        z |= _on_clock(clock, time_s, told, lag_s)

    steering = _clean(run, "steering", [f"angle_{i}_rad" for i in robot.wheels], dropped)
    if steering is not None and robot.steering is not None:
        told = _steering_rows(steering, robot.steering)
        told = _without_leaps("steering", steering.time_s, told, dropped)
        z |= _on_clock(clock, steering.time_s, told, lag_s)

    odometry = _clean(run, "odometry", CAMERA_CHANNELS, dropped, frozen=CAMERA_CHANNELS[3:13])
    if odometry is not None and camera is not None:
        own_s = max(encoder_s - camera.time_constant_s, 0.0) if smooth_s is None else smooth_s
        time_s = odometry.time_s - camera.latency_s
        told = _without_leaps("odometry", time_s, _camera_rows(odometry, camera, dropped), dropped)
        taken = _on_clock(clock, time_s, told, own_s)
        z |= taken if ema_alpha is None else {row: _ema(value, ema_alpha) for row, value in taken.items()}

    gnss = _clean(run, "gnss", GNSS_CHANNELS, dropped)
    if gnss is not None:
        told, variance_of_told = _gnss_rows(gnss)
        z |= _on_clock(clock, gnss.time_s - gnss_latency_s, told, lag_s)
        variance |= _on_clock(clock, gnss.time_s - gnss_latency_s, variance_of_told, 0.0)

    unknown = np.full(clock.size, np.nan)
    table = {row: z.get(row, unknown) for row in rows}
    if robot.drive == "swerve":
        rim_mps = np.column_stack([table[row] for row in rows[:3]]) * robot.wheel_radius_m
        _refer_yaw(table, clock, rim_mps, initial_yaw_rad)
    return MeasurementTable(
        clock,
        rows,
        np.column_stack(list(table.values())),
        np.column_stack([variance.get(row, unknown) for row in GNSS_ROWS]),
        {kind: n for kind, n in dropped.items() if n},
    )


def low_pass(time_s: Array, value: Array, time_constant_s: float, gap_s: float) -> Array:
    """Return a signal (n,) behind a first-order low-pass, exact if it runs straight from sample to sample.

    Parameters
    ----------
    time_s : (n,) strictly increasing, in any steps
    value : (n,) finite
    time_constant_s : tau; 0 gives the signal back
    gap_s : the filter starts anew at the first sample, and after every longer step

    Notes
    -----
    ``tau y' + y = x`` over a step dt from x_0 to x_1, with ``a = exp(-dt/tau)`` and m the slope::

        y_1 = x_1 - tau m + a (y_0 - x_0 + tau m)

    so that a ramp is delayed by tau at any rate.  (The usual ``y_1 = a y_0 + (1 - a) x_1`` falls short of it
    by half a step: 10 ms at 50 Hz.)

    Examples
    --------
    >>> time_s = np.array([0.0, 0.1, 0.3, 0.9])
    >>> (2.0 * time_s - low_pass(time_s, 2.0 * time_s, 0.05, 1.0)).round(4)  # on its way to 2.0 * 0.05
    array([0.    , 0.0865, 0.0998, 0.1   ])
    """
    return _low_pass(time_s, value, time_constant_s, gap_s) if time_constant_s > 0 else value


@njit(cache=True)
def _low_pass(time_s: Array, value: Array, time_constant_s: float, gap_s: float) -> Array:
    out = np.empty_like(value)
    for k in range(value.size):
        step_s = time_s[k] - time_s[k - 1]
        if k == 0 or step_s > gap_s:
            out[k] = value[k]
            continue
        lead = time_constant_s * (value[k] - value[k - 1]) / step_s
        out[k] = value[k] - lead + np.exp(-step_s / time_constant_s) * (out[k - 1] - value[k - 1] + lead)
    return out


def _check(time_constant_s: float | None, ema_alpha: float | None, gnss_latency_s: float) -> None:
    if time_constant_s is not None and not 0 <= time_constant_s < np.inf:
        raise ConfigError(f"time_constant_s is {time_constant_s:g}, a time from zero up is wanted")
    if ema_alpha is not None and not 0 <= ema_alpha < 1:
        raise ConfigError(f"ema_alpha is {ema_alpha:g}, a share from 0 to below 1 is wanted")
    if ema_alpha is not None and time_constant_s is not None:
        raise ConfigError("give time_constant_s or ema_alpha, not both: one of them smooths the camera")
    if not 0 <= gnss_latency_s < np.inf:
        raise ConfigError(f"gnss_latency_s is {gnss_latency_s:g}, a time from zero up is wanted")


def _wheel_channels(run: RunLog, robot: Robot) -> list[str]:
    pattern = "motor_{}_radps" if robot.drive == "swerve" else "speed_{}_mps"
    channels = [pattern.format(wheel) for wheel in robot.wheels]
    if "wheels" not in run.streams:
        raise DataError(f"run {run.run_id}: there is no stream 'wheels', which gives the clock")
    lacking = [channel for channel in channels if channel not in run.streams["wheels"].channels]
    if lacking:
        raise DataError(
            f"run {run.run_id}: the stream 'wheels' has no channel {lacking[0]!r}, which the robot "
            f"{robot.name} should have"
        )
    return channels


def _clean(
    run: RunLog, name: str, channels: Sequence[str], dropped: Counter[str], frozen: Sequence[str] = ()
) -> Stream | None:
    """Return the channels named of a stream without what cannot be true, or None where nothing is left.

    Stamps increase strictly, numbers are finite or NaN, channels that the log lacks are NaN.  A camera or IMU
    all of whose noisy channels (``frozen``) repeat is left out from the first repetition on.
    """
    stream = run.streams.get(name)
    if stream is None:
        return None
    clock_s = run.streams["wheels"].time_s if "wheels" in run.streams else stream.time_s
    known_s = clock_s[np.isfinite(clock_s)]
    present = [channel for channel in channels if channel in stream.channels]
    values = np.full((len(stream), len(channels)), np.nan)
    for channel in present:
        values[:, channels.index(channel)] = stream.channel(channel)
    kept = _increasing(stream.time_s)
    dropped[f"{name}: stamp does not increase"] += len(stream) - len(kept)
    time_s, values = stream.time_s[kept], values[kept]
    if known_s.size:
        off = (time_s < known_s.min() - OFF_CLOCK_S) | (time_s > known_s.max() + OFF_CLOCK_S)
        dropped[f"{name}: off the clock"] += int(off.sum())
    there = [channels.index(channel) for channel in present]
    finite = np.isfinite(values[:, there]).all(axis=1)
    dropped[f"{name}: not finite"] += int((~finite).sum())
    values[~np.isfinite(values)] = np.nan
    kept = np.ones(len(time_s), dtype=bool)
    noisy = [channels.index(channel) for channel in frozen if channel in present]
    if noisy and finite.any():
        kept[finite] = ~_frozen(time_s[finite], values[finite][:, noisy])
        dropped[f"{name}: frozen"] += int((~kept).sum())
    if "confidence_ratio" in present:
        unsure = kept & (values[:, channels.index("confidence_ratio")] < MIN_CONFIDENCE_RATIO)
        dropped[f"{name}: low confidence"] += int(unsure.sum())
        kept &= ~unsure
    return Stream(time_s[kept], values[kept], tuple(channels)) if kept.any() else None


def _increasing(time_s: Array) -> Array:
    """Return the most rows whose stamps are finite and increase: one far ahead costs itself only."""
    rows = np.flatnonzero(np.isfinite(time_s))
    return rows if (np.diff(time_s[rows]) > 0).all() else rows[longest_rise(time_s[rows])]


def _frozen(time_s: Array, values: Array) -> Array:
    """Return which rows (n,) repeat the one before, in stretches of at least :data:`FROZEN_S`."""
    same = np.zeros(len(time_s), dtype=bool)
    same[1:] = (values[1:] == values[:-1]).all(axis=1)
    first = np.flatnonzero(~same)
    last = np.append(first[1:], len(time_s)) - 1
    lasting = np.repeat(time_s[last] - time_s[first] >= FROZEN_S - _TICK_S, last - first + 1)
    return np.asarray(same & lasting)


def _imu_rows(imu: Stream, robot: Robot) -> dict[str, Array]:
    """Calibrated yaw rate, acceleration of the body without gravity, and yaw.

    A sample is ``scale * truth + bias``.  The specific force at rest is g times the world's vertical in body
    axes, ``g (-sin pitch, sin roll cos pitch, cos roll cos pitch)``: with the nose up (pitch negative) it
    points forward too, with the left side up (roll positive) to the left.
    """
    sensors = robot.sensors
    rate = imu.channel("gyro_z_radps") - (sensors.gyro_bias_z_radps if sensors else 0.0)
    if sensors is None or robot.drive != "swerve":
        return {"gyro_z_radps": rate}
    force_x = (imu.channel("accel_x_mps2") - sensors.accel_bias_x_mps2) / sensors.accel_scale_x_ratio
    force_y = (imu.channel("accel_y_mps2") - sensors.accel_bias_y_mps2) / sensors.accel_scale_y_ratio
    roll, pitch = imu.channel("roll_rad"), imu.channel("pitch_rad")
    return {
        "accel_x_mps2": force_x + GRAVITY_MPS2 * np.sin(pitch),
        "accel_y_mps2": force_y - GRAVITY_MPS2 * np.sin(roll) * np.cos(pitch),
        "gyro_z_radps": rate,
        "imu_yaw_rad": unwrapped(imu.channel("yaw_rad")),
    }


def _steering_rows(steering: Stream, described: Steering) -> dict[str, Array]:
    """Steering angles without their zeros; the first one lies within half a turn."""
    zeros_rad = (described.zero_1_rad, described.zero_2_rad, described.zero_3_rad)
    wrapped = np.pi - np.mod(np.pi - (steering.values - zeros_rad), 2 * np.pi)
    return {f"steer_{i + 1}_rad": unwrapped(wrapped[:, i]) for i in range(3)}


def _camera_rows(odometry: Stream, camera: Camera, dropped: Counter[str]) -> dict[str, Array]:
    seen = body_motion(odometry, camera)
    lost = np.isfinite(odometry.values[:, 3:7]).all(axis=1) & np.isnan(seen.yaw_rad)
    dropped["odometry: no rotation"] += int(lost.sum())
    columns = (seen.speed_mps[:, 0], seen.speed_mps[:, 1], seen.yaw_rate_radps, seen.yaw_rad)
    return dict(zip(CAMERA_ROWS, columns, strict=True))


def _gnss_rows(gnss: Stream) -> tuple[dict[str, Array], dict[str, Array]]:
    """Positions from the first fixed one, speeds, and the variances of both; NaN together."""
    values = np.array(gnss.values[:, :4])
    values[np.isnan(values[:, :2]).any(axis=1), :2] = np.nan
    fixed = gnss.channel("fix_ratio") >= 0.5
    placed = np.isfinite(values[:, 0])
    origin = placed & fixed if (placed & fixed).any() else placed
    if origin.any():
        values[:, :2] -= values[origin.argmax(), :2]
    std = gnss.channel("std_position_m")
    std = np.where(std > 0, std, np.where(fixed, GNSS_STD_M[True], GNSS_STD_M[False]))
    variance = np.column_stack([std, std, *[np.full(std.size, GNSS_SPEED_STD_MPS)] * 2]) ** 2
    variance[np.isnan(values)] = np.nan
    return dict(zip(GNSS_ROWS, values.T, strict=True)), dict(zip(GNSS_ROWS, variance.T, strict=True))


def _without_leaps(
    stream: str, time_s: Array, signals: dict[str, Array], dropped: Counter[str]
) -> dict[str, Array]:
    """Take out what no robot does from one sample to the next, before a low-pass smears it over many.

    A camera that finds its place again shows speeds of several m/s for some samples; a spike is one sample.
    """
    leaping = np.zeros(time_s.size, dtype=bool)
    kept = dict(signals)
    for row, (least, per_second) in LEAPS.items():
        if row in signals:
            leaps = _leaps(time_s, signals[row], least, per_second)
            kept[row] = np.where(leaps, np.nan, signals[row])
            leaping |= leaps
    dropped[f"{stream}: leap"] += int(leaping.sum())
    return kept


@njit(cache=True)
def _leaps(time_s: Array, value: Array, least: float, per_second: float) -> Array:
    """Mark samples (n,) that are further from the last one kept than a robot gets, for at most BELIEVED_S."""
    leaps = np.zeros(value.size, dtype=np.bool_)
    last, last_s, since_s = np.nan, np.nan, np.nan
    for k in range(value.size):
        if np.isnan(value[k]):
            continue
        if abs(value[k] - last) > least + per_second * (time_s[k] - last_s):
            if np.isnan(since_s):
                since_s = time_s[k]
            if time_s[k] - since_s < BELIEVED_S:
                leaps[k] = True
                continue
        last, last_s, since_s = value[k], time_s[k], np.nan
    return leaps


def _on_clock(
    clock: Array, time_s: Array, signals: Mapping[str, Array], time_constant_s: float
) -> dict[str, Array]:
    """Return each signal behind the low-pass, at the ticks of the clock."""
    period_s = float(np.median(np.diff(time_s))) if time_s.size > 1 else np.nan
    rows = {}
    for row, signal in signals.items():
        known = np.isfinite(signal)
        stamps, values = time_s[known], signal[known]
        held = _held(clock, stamps, period_s)
        taken = held[held >= 0]
        at_tick = values[taken]
        if time_constant_s > 0:
            behind = low_pass(stamps, values, time_constant_s, GAP_PERIODS * period_s)[taken] - at_tick
            at_tick = at_tick + behind * np.exp((stamps[taken] - clock[held >= 0]) / time_constant_s)
        rows[row] = np.full(clock.size, np.nan)
        rows[row][held >= 0] = at_tick
    return rows


def _held(clock: Array, time_s: Array, period_s: float) -> Array:
    """Return which sample (n,) each tick takes: the last at or before it, or -1 where that is too old."""
    tick_s = float(np.median(np.diff(clock))) if clock.size > 1 else np.nan
    held = np.searchsorted(time_s, clock + _TICK_S, side="right") - 1
    taken = held >= 0
    age_s = clock[taken] - time_s[held[taken]]
    taken[taken] = age_s <= MAX_AGE_PERIODS * np.fmax(period_s, tick_s) + _TICK_S
    if period_s > MAX_AGE_PERIODS * tick_s:
        taken[1:] &= held[1:] != held[:-1]
    return np.where(taken, held, -1)


def _ema(value: Array, alpha: float) -> Array:
    """Smooth the known values (n,) one after the other, whatever the time between them (7.8)."""
    out = np.array(value)
    known = np.isfinite(value)
    if known.any():
        start = [alpha * value[known][0]]
        out[known] = lfilter([1.0 - alpha], [1.0, -alpha], value[known], zi=start)[0]
    return out


def _refer_yaw(table: dict[str, Array], clock: Array, rim_mps: Array, initial_yaw_rad: float) -> None:
    """Count the yaw rows of a table from the start, and keep the camera's on the turn that the IMU is on."""
    moving = (np.abs(rim_mps) > STANDING_SPEED_MPS).any(axis=1) | (clock > clock[0] + STANDING_S)
    standing = ~np.logical_or.accumulate(moving)
    for row in ("imu_yaw_rad", "camera_yaw_rad"):
        known = np.isfinite(table[row])
        if known.any():
            first = known & standing if (known & standing).any() else np.arange(clock.size) == known.argmax()
            table[row] = table[row] - table[row][first].mean() + initial_yaw_rad
    imu, camera = table["imu_yaw_rad"], table["camera_yaw_rad"]
    both = np.isfinite(imu) & np.isfinite(camera)
    start = int(np.isfinite(camera).argmax())
    if both[start] and clock[start] > clock[0] + LATE_S:
        camera = camera + imu[start] - initial_yaw_rad
    turns = np.round(np.where(both, imu - camera, 0.0) / (2 * np.pi))
    table["camera_yaw_rad"] = camera + 2 * np.pi * turns
