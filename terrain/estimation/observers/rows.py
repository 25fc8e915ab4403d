"""What observers take at a tick: the samples of all streams, brought to the ticks of the wheels; and observers live.

A tick is a sample of the wheels.  Of the IMU a row has the means of the samples since the tick before, or
the last one for up to :data:`HELD_S`; of the steering the last one.  A fix, a pose or a position of
satellites with the compass beside it, is in the row of the first tick after it, moved along its heading by
the speed times its age.  Samples that are not later than those before them are left out and counted; values
that are not finite are unknown.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from terrain.errors import ConfigError, DataError
from terrain.estimation.feed import TICK_S
from terrain.estimation.observers.observer import Observer, ObserverStatus
from terrain.extension import Correction
from terrain.records import Array, Reading, RunLog
from terrain.robots import Robot

ROWS: tuple[str, ...] = (
    *("speed_left_mps", "speed_right_mps", "speed_rear_mps", "steer_front_rad"),
    *("position_x_m", "position_y_m", "yaw_rad"),
    *("yaw_rate_radps", "roll_rad", "pitch_rad", "accel_y_mps2"),
)
"""Circumferential speeds of the tracks, and of a car's rear axle; its steering angle; position and heading of
the body's origin in a fixed right-handed frame, from poses, or satellites and a compass, brought to the time
of the tick; yaw rate of the gyro; roll (left side up positive) and pitch (nose up negative); specific force
to the left."""

HELD_S = 0.1
"""How long the last sample of IMU and steering stands for one that is missing: ten of an IMU's."""

TOGETHER_S = 0.06
"""A compass belongs to a position that is no further from it in time: half a period of 10 Hz, and more."""

LATE_S = 0.3
"""A fix that is older when its tick comes is left out: it would have to be moved along an unknown path."""

INACCURATE_M = 0.2
"""Standard deviation of a satellite fix from which on it is no fix: a float solution has half a metre."""

WAITING_S = 2.0
"""So long samples wait for a tick of the wheels."""

CLOCK_SET_SAMPLES, CLOCK_SET_S = 10, 1.0
"""So many samples in a row, so far behind the newest, are of a clock that was set back: all begins anew."""

CHANNELS: Mapping[str, tuple[str, ...]] = {
    "steering": ("angle_front_rad",),
    "imu": ("gyro_z_radps", "roll_rad", "pitch_rad", "accel_y_mps2"),
    "pose": ("position_x_m", "position_y_m", "yaw_rad"),
    "gnss": ("position_x_m", "position_y_m", "std_position_m"),
    "compass": ("yaw_rad",),
}
"""Channels that are read of each stream beside the wheels; those that a log lacks are unknown."""

_IMU_ROWS = ("yaw_rate_radps", "roll_rad", "pitch_rad", "accel_y_mps2")


class RowFeed:
    """Rows of an observer from samples as they come.

    Parameters
    ----------
    robot : tracked or car-like
    rows : those of :data:`ROWS` that the observer takes
    channels : names of the columns of each stream

    Attributes
    ----------
    dropped : samples left out, as counts by stream and kind: not later than the one before (ten in a row that
        are a second behind are a clock that was set: all begins anew), late or inaccurate fixes, and what
        waited in vain for the wheels

    Raises
    ------
    ConfigError
        if the wheels have no speed that the observer takes.
    """

    def __init__(self, robot: Robot, rows: tuple[str, ...], channels: Mapping[str, tuple[str, ...]]) -> None:
        wheels = channels.get("wheels", ())
        if lacking := [name for name in robot.rate_channels if name not in wheels]:
            raise ConfigError(f"channels of 'wheels' are {list(wheels)}: {lacking[0]!r} must be among them")
        self._speeds = [(wheels.index(name), name) for name in robot.rate_channels]
        self._places = {
            stream: [channels[stream].index(name) if name in channels[stream] else None for name in names]
            for stream, names in CHANNELS.items()
            if stream in channels
        }
        self._rows = rows
        self._heading = (-math.inf, math.nan)
        self.dropped: Counter[str] = Counter()
        self._begin()

    def _begin(self) -> None:
        self._pending: dict[str, list[tuple[float, list[float]]]] = {name: [] for name in self._places}
        self._last_s = dict.fromkeys((*self._places, "wheels"), -math.inf)
        self._held = {name: [(-math.inf, math.nan)] * len(names) for name, names in CHANNELS.items()}
        self._n_behind: Counter[str] = Counter()

    def push(self, stream: str, time_s: Array, values: Array) -> None:
        """Take samples (k,) and (k, channels) of a stream beside the wheels; others are not looked at."""
        if stream not in self._places:
            return
        for stamp_s, sample in zip(time_s.tolist(), values.tolist(), strict=True):
            if not self._follows(stream, stamp_s):
                continue
            known = [math.nan if place is None else sample[place] for place in self._places[stream]]
            waiting = self._pending[stream]
            waiting.append((stamp_s, [value if math.isfinite(value) else math.nan for value in known]))
            if waiting[0][0] < stamp_s - WAITING_S:
                self.dropped[f"{stream}: no wheels came"] += 1
                del waiting[0]

    def tick(self, time_s: float, wheels: Array) -> Array | None:
        """Return the row (m,) at a sample of the wheels; None where that is not later than the one before."""
        if not self._follows("wheels", time_s):
            return None
        self._n_behind["wheels"] = 0
        row = dict.fromkeys(ROWS, math.nan)
        row |= {name: float(wheels[column]) for column, name in self._speeds}
        row["steer_front_rad"] = self._means("steering", time_s, last=True)[0]
        row |= zip(_IMU_ROWS, self._means("imu", time_s), strict=True)
        speeds = [row[name] for _, name in self._speeds]
        row |= self._fix(time_s, sum(speeds) / len(speeds))
        return np.array([row[name] for name in self._rows])

    def _follows(self, stream: str, stamp_s: float) -> bool:
        """Return whether a sample is later than the one before; count it where it is not.

        Many in a row that are far behind are a clock that was set.
        """
        before_s = self._last_s[stream]
        if math.isfinite(stamp_s) and stamp_s > before_s:
            self._last_s[stream] = stamp_s
            return True
        self.dropped[f"{stream}: not later than the sample before"] += 1
        self._n_behind[stream] = self._n_behind[stream] + 1 if math.isfinite(stamp_s) else 0
        if self._n_behind[stream] >= CLOCK_SET_SAMPLES and before_s - stamp_s >= CLOCK_SET_S:
            self.dropped["time: clock set"] += 1
            self._begin()
        return False

    def _taken(self, stream: str, time_s: float) -> list[tuple[float, list[float]]]:
        """Take the samples that came by a time out of those that wait."""
        waiting = self._pending.get(stream, [])
        n = next((k for k, (stamp_s, _) in enumerate(waiting) if stamp_s > time_s + TICK_S), len(waiting))
        taken = waiting[:n]
        del waiting[:n]
        return taken

    def _means(self, stream: str, time_s: float, *, last: bool = False) -> list[float]:
        """Return mean, or last, of what is known of each channel since the tick before; else the last known, held."""
        taken, held = self._taken(stream, time_s), self._held[stream]
        means = []
        for k in range(len(held)):
            known = [(stamp_s, sample[k]) for stamp_s, sample in taken if not math.isnan(sample[k])]
            if known:
                held[k] = known[-1]
            stamp_s, value = held[k]
            if known and not last:
                value = sum(value for _, value in known) / len(known)
            means.append(value if time_s - stamp_s <= HELD_S or (known and not last) else math.nan)
        return means

    def _known(self, stream: str, time_s: float) -> tuple[float, list[float]] | None:
        """Return the last sample since the tick before that is known, accurate and not late; None without."""
        last = None
        for stamp_s, sample in self._taken(stream, time_s):
            needed = sample[:2] if stream == "gnss" else sample
            if any(math.isnan(value) for value in needed):
                continue
            if time_s - stamp_s > LATE_S:
                self.dropped[f"{stream}: late"] += 1
            elif stream == "gnss" and sample[2] > INACCURATE_M:
                self.dropped["gnss: inaccurate"] += 1
            else:
                last = (stamp_s, sample)
        return last

    def _fix(self, time_s: float, speed_mps: float) -> dict[str, float]:
        """Return position and heading of the last fix since the tick before, brought to this one."""
        pose, fix, heading = (self._known(name, time_s) for name in ("pose", "gnss", "compass"))
        if heading is not None:
            self._heading = (heading[0], heading[1][0])
        if pose is not None:
            stamp_s, (x, y, yaw) = pose
        elif fix is not None:
            stamp_s, (x, y, _) = fix
            yaw = self._heading[1] if abs(stamp_s - self._heading[0]) <= TOGETHER_S else math.nan
        elif heading is not None:
            return {"yaw_rad": heading[1][0]}
        else:
            return {}
        moved = speed_mps * (time_s - stamp_s)
        if math.isfinite(moved) and math.isfinite(yaw):
            x, y = x + moved * math.cos(yaw), y + moved * math.sin(yaw)
        return {"position_x_m": x, "position_y_m": y, "yaw_rad": yaw}


def rows_of(run: RunLog, robot: Robot, rows: tuple[str, ...]) -> tuple[Array, Array, dict[str, int]]:
    """Return times (n,) and rows (n, m) of all ticks of a run, as they would come live, and what was dropped.

    Raises
    ------
    ConfigError
        if the wheels have no speed that the observer takes.
    DataError
        if the run has no wheels.
    """
    if "wheels" not in run.streams or len(run.streams["wheels"]) == 0:
        raise DataError(f"{run.run_id}: it has no stream wheels")
    feed = RowFeed(robot, rows, {name: stream.channels for name, stream in run.streams.items()})
    wheels, times, found = run.streams["wheels"], [], []
    others = {name: run.streams[name] for name in CHANNELS if name in run.streams}
    edges = {
        name: np.searchsorted(stream.time_s, wheels.time_s + TICK_S, side="right").tolist()
        for name, stream in others.items()
    }
    before = dict.fromkeys(others, 0)
    for k, time_s in enumerate(wheels.time_s.tolist()):
        for name, stream in others.items():
            new = slice(before[name], edges[name][k])
            if new.start < new.stop:
                feed.push(name, stream.time_s[new], stream.values[new])
                before[name] = new.stop
        row = feed.tick(time_s, wheels.values[k])
        if row is not None:
            times.append(time_s)
            found.append(row)
    return np.array(times), np.array(found).reshape(len(found), len(rows)), dict(feed.dropped)


class LiveObserverEstimate(NamedTuple):
    """What is known at one tick; arrays are the caller's to keep."""

    time_s: float  #: stamp of the wheels
    mean: Array  #: as of :class:`~terrain.estimation.observers.observer.ObserverOutput`
    std: Array
    slip: Array
    slip_std: Array
    status: ObserverStatus  #: of the estimates


class LiveObserver:
    """Slip of a robot from samples as they come; the numbers are those of a whole log.

    Parameters
    ----------
    observer : any, before its first step
    robot : whose it is, corrected
    channels : names of the columns of the readings of each stream
    correction : takes the effects of an extended robot off what arrives, see
        :func:`terrain.extension.correct_live`

    Raises
    ------
    ConfigError
        if the wheels have no speed that the observer takes.
    """

    too_late = -math.inf, math.nan
    """Samples that come late are left out, and counted, one by one."""

    filter: None = None
    """No memory of it is kept over a restart: it starts from its first samples."""

    def __init__(
        self,
        observer: Observer,
        robot: Robot,
        channels: Mapping[str, tuple[str, ...]],
        correction: Correction | None = None,
    ) -> None:
        self.observer, self._channels, self._correction = observer, channels, correction
        self.name, self.states = observer.name, observer.states
        self._feed = RowFeed(robot, observer.rows, channels)
        self._last_s = math.nan
        self.latest: LiveObserverEstimate | None = None

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by stream and kind."""
        return dict(self._feed.dropped)

    def step(self, readings: Mapping[str, Reading]) -> list[LiveObserverEstimate]:
        """Take in what arrived, and return an estimate for each sample of the wheels.

        Parameters
        ----------
        readings : by stream; any may be missing, late, repeated or wrong, and streams without names of
            channels are not looked at
        """
        if not isinstance(readings, Mapping):
            return []
        arrays = {
            name: self._arrays(name, reading) for name, reading in readings.items() if name in self._channels
        }
        wheels = arrays.pop("wheels", None)
        for name, samples in arrays.items():
            if samples is not None:
                self._feed.push(name, *samples)
        estimates = []
        for time_s, sample in () if wheels is None else zip(wheels[0].tolist(), wheels[1], strict=True):
            row = self._feed.tick(time_s, sample)
            if row is not None:
                dt_s = (
                    0.0 if math.isnan(self._last_s) else max(time_s - self._last_s, 0.0)
                )  # a clock may be set
                self._last_s = time_s
                output = self.observer.step(row, dt_s)
                self.latest = LiveObserverEstimate(time_s, *output[:4], ObserverStatus(output.status))
                estimates.append(self.latest)
        return estimates

    def settle(self, *, all_of_them: bool = False) -> list[LiveObserverEstimate]:
        """Return nothing: every estimate has settled when it is returned."""
        return []

    def _arrays(self, name: str, reading: Reading) -> tuple[Array, Array] | None:
        """Return stamps and values; None, counted, where they are no samples of the stream."""
        try:
            time_s, values = (np.asarray(part, dtype=np.float64) for part in reading)
        except (TypeError, ValueError, OverflowError):
            time_s = values = np.empty(0)
        if time_s.ndim != 1 or values.shape != (time_s.size, len(self._channels[name])):
            self._feed.dropped[f"{name}: unreadable"] += 1
            return None
        if self._correction is None:
            return time_s, values
        return self._correction(name, self._channels[name], time_s, values)
