"""A run in the order of time, as its robot's sensors gave it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from terrain.logs.replay import SENSORS
from terrain.logs.replay import replay as replay_log
from terrain.records import Reading, RunLog, Sample


class NamedReadings(dict[str, Reading]):
    """Readings by stream, and the names of their columns.

    Parameters
    ----------
    readings : by stream
    channels : of each stream, in the order of the columns
    """

    def __init__(self, readings: Mapping[str, Reading], channels: Mapping[str, tuple[str, ...]]) -> None:
        super().__init__(readings)
        self.channels = channels


def replay(run: RunLog, rate_hz: float = 50.0) -> Iterator[Sample]:
    """Yield the samples of a run, step by step, as :func:`terrain.logs.replay.replay` does.

    Parameters
    ----------
    run : with at least one sensor
    rate_hz : of the steps

    Yields
    ------
    Sample
        whose readings name their columns, so that an :class:`~pipelines.live.observer.Observer` takes them

    Raises
    ------
    ConfigError, DataError
        if the rate is not above zero, or no sensor has a sample.

    Examples
    --------
    >>> from terrain.records import Stream
    >>> run = RunLog("a", "agrimaro", {"imu": Stream([0.0, 0.01], [[0.1], [0.2]], ("gyro_z_radps",))})
    >>> next(replay(run)).readings.channels
    {'imu': ('gyro_z_radps',)}
    """
    channels = {name: run.streams[name].channels for name in SENSORS if name in run.streams}
    for sample in replay_log(run, rate_hz):
        yield sample._replace(readings=NamedReadings(sample.readings, channels))
