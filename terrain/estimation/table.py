"""The measurements of a whole run log: one clock, one delay.

Samples that cannot be true are left out and counted, known latencies are subtracted from the stamps, and
:mod:`terrain.estimation.feed` is looped over what is left.  What looks ahead is the cleaning, the median periods
and, unless ``causal``, latencies, the yaw at the start and the origin of positions.
"""

from __future__ import annotations

import cmath
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from terrain.errors import ConfigError, DataError
from terrain.estimation import feed
from terrain.estimation.feed import (
    CAMERA_ROWS,
    GNSS_LATENCY_S,
    GNSS_ROWS,
    GNSS_SPEED_STD_MPS,
    MIN_CONFIDENCE_RATIO,
    ROWS,
    ROWS_OF_DRIVE,
    STREAMS,
    TICK_S,
)
from terrain.kinematics.wheels import no_slip_twist, point_velocity
from terrain.logs.samples import longest_rise
from terrain.records import Array, RunLog, Stream, read_only
from terrain.robots import Robot

FROZEN_S = 0.25
"""Noise that repeats exactly for so long is none: 50 samples of the camera, 25 of the IMU."""

OFF_CLOCK_S = 1.0
"""A sample that is further from every tick is of no use to anyone: its clock jumped."""

HEADING_SPEED_MPS = 0.2
"""Slower, a course is noise."""

MAX_HEADING_STD_RAD = 0.05
"""A heading that is known no better is not known: at 1 m/s it would be 5 cm/s of sideways speed."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementTable:
    """What a filter measures at each tick of its clock; NaN where a sensor gave nothing.

    Parameters
    ----------
    time_s : (n,) stamps of the wheels stream
    rows : name of each of the m measurements
    z : (n, m)
    gnss_variance : (n, 4) of :data:`~terrain.estimation.feed.GNSS_ROWS`, in their units squared; NaN where they are
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
    lag_s = dict.fromkeys(STREAMS, robot.encoder_lag_s if time_constant_s is None else time_constant_s)
    if robot.describes("camera") and time_constant_s is None:
        lag_s["odometry"] = max(robot.encoder_lag_s - robot.camera.time_constant_s, 0.0)
    if ema_alpha is not None:
        lag_s = dict.fromkeys(STREAMS, 0.0)
    period_s = {name: median_step_s(stream.time_s) for name, stream in streams.items()}
    latency_s = latencies_s(robot, gnss_latency_s)
    settings = feed.feed_settings(robot, initial_yaw_rad, latency_s, lag_s, period_s, median_step_s(clock))
    memory = feed.new_feed()
    if "gnss" in streams and not causal:
        memory["gnss_origin_m"] = _gnss_origin(streams["gnss"])
    came_s, instant_s, values = [], [], []
    for (name, channels), age_s in zip(STREAMS.items(), latency_s, strict=True):
        stream = streams.get(name)
        stamps = np.empty(0) if stream is None else np.array(stream.time_s)
        instant_s.append(stamps - age_s)
        came_s.append(stamps if causal else instant_s[-1])
        values.append(np.empty((0, len(channels))) if stream is None else np.array(stream.values))
    rows = np.zeros(clock.size, feed.ROW)
    samples = tuple(came_s), tuple(instant_s), tuple(values)
    feed.run_feed(clock, np.array(wheels.values), *samples, settings, memory, rows)
    counts = {"wheels: beyond the motors": int(memory["wheels_beyond"][0])}
    for number, name in enumerate(STREAMS):
        counts[f"{name}: jump"] = int(memory["jump"][0, number])
        counts[f"{name}: no rotation"] = int(memory["no_rotation"][0, number])
    dropped += Counter(counts)  # a Counter, so that zeros fall out
    z = feed.measurements(rows)
    if ema_alpha is not None:
        for row in CAMERA_ROWS:
            z[:, ROWS.index(row)] = ema(z[:, ROWS.index(row)], ema_alpha)
    if robot.steered:
        feed.refer_all(clock, causal, settings, memory, rows)
    names = ROWS_OF_DRIVE[robot.drive]
    return MeasurementTable(
        clock, names, z[:, [ROWS.index(name) for name in names]], rows["gnss_variance"], dropped
    )


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
    steering = [f"angle_{wheel}_rad" for wheel in robot.wheels]
    has = {"steering": robot.describes("steering"), "odometry": robot.describes("camera")}
    found = {}
    for name, channels in STREAMS.items():
        names = steering if name == "steering" else channels
        frozen = channels[feed.NOISY[name]] if name in feed.NOISY else ()
        stream = clean_stream(run, name, names, dropped, frozen)
        if stream is not None and has.get(name, True):
            found[name] = stream
    return found


def latencies_s(robot: Robot, gnss_latency_s: float) -> list[float]:
    """Return the age of a sample of each of the feed's streams when it arrives."""
    return [0.0, robot.completed.sensors.imu_latency_s, robot.completed.camera.latency_s, gnss_latency_s]


def _gnss_origin(gnss: Stream) -> Array:
    """Return the first position with a fix, or the first where there is none; NaN without any."""
    position = gnss.values[:, :2]
    known = np.isfinite(position).all(axis=1)
    fixed = known & (gnss.channel("fix_ratio") >= 0.5)
    first = fixed if fixed.any() else known
    return np.asarray(position[first.argmax()]) if first.any() else np.full(2, np.nan)


def clean_stream(
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
        low_confidence = kept & (values[:, channels.index("confidence_ratio")] < MIN_CONFIDENCE_RATIO)
        dropped[f"{name}: low confidence"] += int(low_confidence.sum())
        kept &= ~low_confidence
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
    lasting = np.repeat(time_s[last] - time_s[first] >= FROZEN_S - TICK_S, last - first + 1)
    return np.asarray(same & lasting)


def median_step_s(time_s: Array) -> float:
    """Return the median step of a clock; NaN of fewer than two stamps."""
    return float(np.median(np.diff(time_s))) if time_s.size > 1 else float("nan")


def ema(value: Array, alpha: float) -> Array:
    """Smooth the finite values (n,) one after the other, whatever the time between them (7.8)."""
    from scipy.signal import lfilter  # half a second of import, which only the thesis' smoothing needs

    out = np.array(value)
    known = np.isfinite(value)
    if known.any():
        start = [alpha * value[known][0]]
        out[known] = lfilter([1.0 - alpha], [1.0, -alpha], value[known], zi=start)[0]
    return out


def gnss_heading(table: MeasurementTable, robot: Robot) -> float:
    """Return the world's heading in rad of what the yaw rows call 0; NaN where the drive does not tell.

    Parameters
    ----------
    table : measurements with yaw rows that are 0 at the start
    robot : a swerve robot

    Notes
    -----
    The rotation that brings the speeds over ground v, by the camera or else by the wheels, onto those of
    the receiver u with the least squared error, both as complex numbers: the angle of
    ``sum u conj(v e^(i yaw))``.  Its standard deviation is ``speed_std / sqrt(sum |v|^2)``.
    """
    yaw = table.columns(["camera_yaw_rad", "imu_yaw_rad"])
    yaw_rad = np.where(np.isfinite(yaw[:, 0]), yaw[:, 0], yaw[:, 1])
    gnss_speed = table.columns(["gnss_speed_x_mps", "gnss_speed_y_mps"]) @ np.array([1.0, 1.0j])
    seen = _speed_over_ground(table, robot) * np.exp(1j * yaw_rad)
    good = np.isfinite(gnss_speed) & np.isfinite(seen) & (np.abs(seen) > HEADING_SPEED_MPS)
    weight = float(np.sum(np.abs(seen[good]) ** 2))
    if weight == 0.0 or GNSS_SPEED_STD_MPS / math.sqrt(weight) > MAX_HEADING_STD_RAD:
        return math.nan
    return cmath.phase(complex(np.sum(gnss_speed[good] * np.conj(seen[good]))))


def _speed_over_ground(table: MeasurementTable, robot: Robot) -> Array:
    """Return the speed (n,) of the origin in body axes, forward + 1j left: the camera's, or the wheels'."""
    rates, steer = table.columns(list(robot.wheel_rows)), table.columns(list(robot.steer_rows))
    twist, _ = no_slip_twist(robot.wheel_positions_m, steer, robot.wheel_radius_m * rates)
    speed = twist[:, 0] + 1j * twist[:, 1]
    if not robot.describes("camera"):
        return np.asarray(speed)
    camera = robot.camera
    x, y, turn = table.columns(["camera_speed_x_mps", "camera_speed_y_mps", "camera_yaw_rate_radps"]).T
    origin_x, origin_y = point_velocity(x, y, turn, -camera.lever_x_m, -camera.lever_y_m)
    by_camera = origin_x + 1j * origin_y
    return np.where(np.isfinite(by_camera), by_camera, speed)
