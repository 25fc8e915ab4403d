"""Replay of a log: step by step, the samples of each sensor since the previous step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from terrain.errors import ConfigError, DataError
from terrain.logs.samples import longest_rise
from terrain.logs.schema import TWIST
from terrain.records import Array, Reading, RunLog, Sample

SENSORS: tuple[str, ...] = ("wheels", "steering", "imu", "odometry", "gnss", "compass", "pose", "lidar")
"""Streams that a robot's sensors write; the others are commands, truth and what was made of them."""


MAX_STEPS = 20_000_000  #: Of a replay: 111 hours at 50 Hz

_SLACK_S = 1e-9  # stamps that differ by less are the same instant, written by two clocks' arithmetic


class NamedReadings(dict[str, Reading]):
    """Readings by stream, and of each stream the channels in the order of the columns."""

    def __init__(self, readings: Mapping[str, Reading], channels: Mapping[str, tuple[str, ...]]) -> None:
        super().__init__(readings)
        self.channels = channels


def replay(run: RunLog, rate_hz: float = 50.0) -> Iterator[Sample]:
    """Yield what a controller would have been given at each of its steps, from the first stamp of the wheels on.

    Without wheels the first stamp of any sensor is taken.  A sample has the readings stamped after the step before and
    up to this one, in the order of the log, and all channels of it, which they name; the last twist desired by then,
    zeros for what of it the log does not have; the label there.  A stamp is taken for the instant at which a sample
    came.  One that is out of order, or no number, came with the next one in order.

    Raises
    ------
    ConfigError
        if the rate is not above zero.
    DataError
        if no sensor (:data:`SENSORS`) has a sample, or the stamps are too far apart.

    Examples
    --------
    >>> from terrain.records import Stream
    >>> imu = Stream([0.0, 0.01, 0.02, 0.03], np.zeros((4, 1)), ("gyro_z_radps",))
    >>> [sample.readings["imu"].time_s.tolist() for sample in replay(RunLog("a", "agrimaro", {"imu": imu}))]
    [[0.0], [0.01, 0.02], [0.03]]
    """
    if not 0 < rate_hz < np.inf:
        raise ConfigError(f"rate_hz is {rate_hz:g}, a rate above zero is required")
    came: dict[
        str, Array
    ] = {}  # when each sample came: by its stamp, or with the next in order, or with the last
    for name in SENSORS:
        time_s = run.streams[name].time_s if name in run.streams else np.empty(0)
        known = np.flatnonzero(np.isfinite(time_s))
        rising = known[longest_rise(time_s[known])]
        if rising.size:
            in_order = np.full(time_s.size, time_s[rising[-1]])
            in_order[rising] = time_s[rising]
            came[name] = np.minimum.accumulate(in_order[::-1])[::-1]
    if not came:
        raise DataError(f"run {run.run_id}: there is no sensor to replay, none of {', '.join(SENSORS)}")
    span_s = max(c[-1] for c in came.values()) - min(c[0] for c in came.values())
    if span_s * rate_hz > MAX_STEPS:
        raise DataError(
            f"run {run.run_id}: has stamps {span_s / 3600:.1f} h apart, its clock was set; at most "
            f"{MAX_STEPS / rate_hz / 3600:.1f} h are replayed at {rate_hz:g} Hz"
        )
    return _steps(run, came, 1.0 / rate_hz)


def _steps(run: RunLog, came: dict[str, Array], step_s: float) -> Iterator[Sample]:
    start_s = float(came["wheels"][0] if "wheels" in came else min(c[0] for c in came.values()))
    end_s = float(max(c[-1] for c in came.values()))
    ticks = start_s + step_s * np.arange(np.ceil((end_s - start_s - _SLACK_S) / step_s) + 1)
    ends = {name: np.searchsorted(c, ticks + _SLACK_S, side="right") for name, c in came.items()}
    twists, commands = np.zeros((ticks.size, 3)), run.streams.get("commands")
    if commands is not None and len(commands):
        last = np.searchsorted(commands.time_s, ticks + _SLACK_S, side="right") - 1
        for i, name in enumerate(TWIST):
            if name in commands.channels:  # commands of robots that cannot drive sideways have two
                twists[last >= 0, i] = commands.channel(name)[last[last >= 0]]
    channels = {name: run.streams[name].channels for name in came}
    for k, tick_s in enumerate(ticks.tolist()):
        readings = {}
        for name, end in ends.items():
            part = slice(end[k - 1] if k else 0, end[k])
            if part.start < part.stop:
                stream = run.streams[name]
                readings[name] = Reading(stream.time_s[part], stream.values[part])
        terrain = next((label.terrain for label in run.labels if label.start_s <= tick_s < label.end_s), "")
        yield Sample(tick_s, twists[k], NamedReadings(readings, channels), terrain)
