"""What observers take at a tick: the samples of all streams, brought to the ticks of the wheels.

A tick is a sample of the wheels.  Of the IMU a row has the means of the samples since the tick before, or
the last one for up to :data:`HELD_S`; of the steering the last one.  A fix, a pose or a position of
satellites with the compass beside it, is in the row of the first tick after it, moved along its heading by
the speed times its age.  Samples that are not later than those before them are left out and counted; values
that are not finite are unknown.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np

from terrain.errors import ConfigError, DataError
from terrain.estimation.feed import TICK_S
from terrain.records import Array, RunLog
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
    rows : as given
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
            stream: [
                (k, channels[stream].index(name)) for k, name in enumerate(names) if name in channels[stream]
            ]
            for stream, names in CHANNELS.items()
            if stream in channels
        }
        self.rows = rows
        self._pending: dict[str, list[tuple[float, list[float]]]] = {name: [] for name in self._places}
        self._last_s = dict.fromkeys(self._places, -math.inf)
        self._held: dict[str, list[tuple[float, float]]] = {}
        self._heading = (-math.inf, math.nan)
        self._n_behind: dict[str, int] = {}
        self._tick_s = -math.inf
        self.dropped: Counter[str] = Counter()

    def push(self, stream: str, time_s: Array, values: Array) -> None:
        """Take samples (k,) and (k, channels) of a stream beside the wheels; others are not looked at."""
        if stream not in self._places:
            return
        for stamp_s, sample in zip(time_s.tolist(), values.tolist(), strict=True):
            if not math.isfinite(stamp_s) or not stamp_s > self._last_s[stream]:
                self._behind(stream, stamp_s)
                continue
            self._last_s[stream] = stamp_s
            known = [math.nan] * len(CHANNELS[stream])
            for k, column in self._places[stream]:
                known[k] = sample[column] if math.isfinite(sample[column]) else math.nan
            waiting = self._pending[stream]
            waiting.append((stamp_s, known))
            if waiting[0][0] < stamp_s - WAITING_S:
                self.dropped[f"{stream}: no wheels came"] += 1
                del waiting[0]

    def tick(self, time_s: float, wheels: Array) -> Array | None:
        """Return the row (m,) at a sample of the wheels; None where that is not later than the one before."""
        if not math.isfinite(time_s) or not time_s > self._tick_s:
            self._behind("wheels", time_s)
            return None
        self._tick_s, self._n_behind["wheels"] = time_s, 0
        row = dict.fromkeys(ROWS, math.nan)
        for column, name in self._speeds:
            row[name] = float(wheels[column])
        row["steer_front_rad"] = self._last("steering", time_s)[0]
        row |= zip(_IMU_ROWS, self._mean("imu", time_s), strict=True)
        speeds = [row[name] for _, name in self._speeds]
        row |= self._fix(time_s, sum(speeds) / len(speeds))
        return np.array([row[name] for name in self.rows])

    def _behind(self, stream: str, stamp_s: float) -> None:
        """Count a sample that is not later than the one before; many in a row are a clock that was set."""
        self.dropped[f"{stream}: not later than the sample before"] += 1
        self._n_behind[stream] = self._n_behind.get(stream, 0) + 1 if math.isfinite(stamp_s) else 0
        before_s = self._tick_s if stream == "wheels" else self._last_s[stream]
        if self._n_behind[stream] < CLOCK_SET_SAMPLES or before_s - stamp_s < CLOCK_SET_S:
            return
        self.dropped["time: clock set"] += 1
        self._tick_s, self._last_s = -math.inf, dict.fromkeys(self._places, -math.inf)
        self._pending, self._held = {name: [] for name in self._places}, {}
        self._n_behind = {}

    def _taken(self, stream: str, time_s: float) -> list[tuple[float, list[float]]]:
        """Take the samples that came by a time out of those that wait."""
        waiting = self._pending.get(stream, [])
        n = next((k for k, (stamp_s, _) in enumerate(waiting) if stamp_s > time_s + TICK_S), len(waiting))
        taken = waiting[:n]
        del waiting[:n]
        return taken

    def _last(self, stream: str, time_s: float) -> list[float]:
        for stamp_s, known in self._taken(stream, time_s):
            if not math.isnan(known[0]):
                self._held[stream] = [(stamp_s, known[0])]
        return self._standing(stream, time_s)

    def _mean(self, stream: str, time_s: float) -> list[float]:
        """Return the mean of what is known of each channel since the tick before; else the last known."""
        taken = self._taken(stream, time_s)
        means = self._standing(stream, time_s)
        held = self._held.setdefault(stream, [(-math.inf, math.nan)] * len(CHANNELS[stream]))
        for k in range(len(means)):
            known = [(stamp_s, sample[k]) for stamp_s, sample in taken if not math.isnan(sample[k])]
            if known:
                held[k] = known[-1]
                means[k] = sum(value for _, value in known) / len(known)
        return means

    def _standing(self, stream: str, time_s: float) -> list[float]:
        """Return the last sample of each channel while it stands for one that is missing."""
        held = self._held.get(stream, [(-math.inf, math.nan)] * len(CHANNELS[stream]))
        return [value if time_s - stamp_s <= HELD_S else math.nan for stamp_s, value in held]

    def _known(self, stream: str, time_s: float) -> tuple[float, list[float]] | None:
        """Return the last sample since the tick before that is known, accurate and not late; None without."""
        found = None
        for stamp_s, known in self._taken(stream, time_s):
            needed = known[:2] if stream == "gnss" else known
            if any(math.isnan(value) for value in needed):
                continue
            if time_s - stamp_s > LATE_S:
                self.dropped[f"{stream}: late"] += 1
            elif stream == "gnss" and known[2] > INACCURATE_M:
                self.dropped["gnss: inaccurate"] += 1
            else:
                found = (stamp_s, known)
        return found

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


def feed_of(run: RunLog, robot: Robot, rows: tuple[str, ...]) -> RowFeed:
    """Return the feed for a whole run, by the channels that it has."""
    return RowFeed(robot, rows, {name: stream.channels for name, stream in run.streams.items()})


def rows_of(run: RunLog, feed: RowFeed) -> tuple[Array, Array]:
    """Return the times (n,) and rows (n, m) of all ticks of a run; as :func:`ticks`."""
    found = list(ticks(run, feed))
    rows = np.array([row for _, row in found]).reshape(len(found), len(feed.rows))
    return np.array([time_s for time_s, _ in found]), rows


def ticks(run: RunLog, feed: RowFeed) -> Iterator[tuple[float, Array]]:
    """Yield time and row of each tick of a whole run, as they would come live.

    Raises
    ------
    DataError
        if the run has no wheels.
    """
    if "wheels" not in run.streams or len(run.streams["wheels"]) == 0:
        raise DataError(f"{run.run_id}: it has no stream wheels")
    wheels = run.streams["wheels"]
    others = {name: run.streams[name] for name in CHANNELS if name in run.streams}
    due_s = wheels.time_s + TICK_S
    edges = {name: np.searchsorted(stream.time_s, due_s, side="right") for name, stream in others.items()}
    before = dict.fromkeys(others, 0)
    for k, time_s in enumerate(wheels.time_s.tolist()):
        for name, stream in others.items():
            new = slice(before[name], int(edges[name][k]))
            if new.start < new.stop:
                feed.push(name, stream.time_s[new], stream.values[new])
                before[name] = new.stop
        row = feed.tick(time_s, wheels.values[k])
        if row is not None:
            yield time_s, row
