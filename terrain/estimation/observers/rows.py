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
from terrain.estimation.measurements.sample_hold import TICK_S
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

CHANNELS: Mapping[str, tuple[str, ...]] = {
    "steering": ("angle_front_rad",),
    "imu": ("gyro_z_radps", "roll_rad", "pitch_rad", "accel_y_mps2"),
    "pose": ("position_x_m", "position_y_m", "yaw_rad"),
    "gnss": ("position_x_m", "position_y_m"),
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
        self._rows = rows
        self._pending: dict[str, list[tuple[float, list[float]]]] = {name: [] for name in self._places}
        self._last_s = dict.fromkeys(self._places, -math.inf)
        self._held: dict[str, tuple[float, list[float]]] = {}
        self._tick_s = -math.inf
        self.dropped: Counter[str] = Counter()

    def push(self, stream: str, time_s: Array, values: Array) -> None:
        """Take samples (k,) and (k, channels) of a stream beside the wheels; others are not looked at."""
        if stream not in self._places:
            return
        for stamp_s, sample in zip(time_s.tolist(), values.tolist(), strict=True):
            if not stamp_s > self._last_s[stream]:
                self.dropped[f"{stream}: not later than the sample before"] += 1
                continue
            self._last_s[stream] = stamp_s
            known = [math.nan] * len(CHANNELS[stream])
            for k, column in self._places[stream]:
                known[k] = sample[column] if math.isfinite(sample[column]) else math.nan
            self._pending[stream].append((stamp_s, known))

    def tick(self, time_s: float, wheels: Array) -> Array | None:
        """Return the row (m,) at a sample of the wheels; None where that is not later than the one before."""
        if not time_s > self._tick_s or not math.isfinite(time_s):
            self.dropped["wheels: not later than the sample before"] += 1
            return None
        self._tick_s = time_s
        row = dict.fromkeys(ROWS, math.nan)
        for column, name in self._speeds:
            row[name] = float(wheels[column])
        row["steer_front_rad"] = self._last("steering", time_s)[0]
        row |= zip(_IMU_ROWS, self._mean("imu", time_s), strict=True)
        speeds = [row[name] for _, name in self._speeds]
        row |= self._fix(time_s, sum(speeds) / len(speeds))
        return np.array([row[name] for name in self._rows])

    def _taken(self, stream: str, time_s: float) -> list[tuple[float, list[float]]]:
        """Take the samples that came by a time out of those that wait."""
        waiting = self._pending.get(stream, [])
        n = next((k for k, (stamp_s, _) in enumerate(waiting) if stamp_s > time_s + TICK_S), len(waiting))
        taken = waiting[:n]
        del waiting[:n]
        return taken

    def _last(self, stream: str, time_s: float) -> list[float]:
        if taken := self._taken(stream, time_s):
            self._held[stream] = taken[-1]
        return self._standing(stream, time_s)

    def _mean(self, stream: str, time_s: float) -> list[float]:
        if taken := self._taken(stream, time_s):
            self._held[stream] = taken[-1]
            return [sum(column) / len(taken) for column in zip(*(known for _, known in taken), strict=True)]
        return self._standing(stream, time_s)

    def _standing(self, stream: str, time_s: float) -> list[float]:
        """Return the last sample while it stands for one that is missing."""
        stamp_s, known = self._held.get(stream, (-math.inf, []))
        return known if time_s - stamp_s <= HELD_S else [math.nan] * len(CHANNELS[stream])

    def _fix(self, time_s: float, speed_mps: float) -> dict[str, float]:
        """Return position and heading of the last fix since the tick before, brought to this one."""
        poses, fixes, headings = (self._taken(name, time_s) for name in ("pose", "gnss", "compass"))
        if headings:
            self._held["compass"] = headings[-1]
        x = y = math.nan
        stamp_s, yaw = self._held.get("compass", (-math.inf, [math.nan]))
        if poses:
            stamp_s, (x, y, heading) = poses[-1]
            yaw = [heading]
        elif fixes:
            if abs(fixes[-1][0] - stamp_s) > TOGETHER_S:
                yaw = [math.nan]
            stamp_s, (x, y) = fixes[-1]
        elif not headings:
            return {}
        moved = speed_mps * (time_s - stamp_s)
        if math.isfinite(moved) and math.isfinite(yaw[0]):
            x, y = x + moved * math.cos(yaw[0]), y + moved * math.sin(yaw[0])
        return {"position_x_m": x, "position_y_m": y, "yaw_rad": yaw[0]}


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
