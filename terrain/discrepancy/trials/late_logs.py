"""Logs whose stamps are late: of a whole logger, or of one sensor."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from terrain.records import RunLog

WHEELS_LOGGER = ("wheels", "steering")
"""Streams that one logger stamps; the others are those of :data:`terrain.effects.OTHER_LOGGER`."""

LOGGER_LATE_S = (0.15, 0.4)
"""Range of the delay of a whole logger: wheels of measured robots are 0.26 to 0.28 s late."""

SENSOR_LATE_S = (0.1, 0.3)
"""Range of the delay of one sensor: a measured lidar is 0.16 s late."""


def with_late_streams(runs: Sequence[RunLog], names: Collection[str], late_s: float) -> tuple[RunLog, ...]:
    """Return runs in which some streams, where a run has them, are stamped later than they were sampled.

    Examples
    --------
    >>> from terrain.records import Stream
    >>> run = RunLog("a", "husky", {"imu": Stream([0.0, 1.0], [[0.0], [1.0]], ("gyro_z_radps",))})
    >>> with_late_streams([run], ("imu",), 0.25)[0].streams["imu"].time_s
    array([0.25, 1.25])
    """
    return tuple(
        replace(
            run,
            streams={
                name: replace(stream, time_s=stream.time_s + late_s) if name in names else stream
                for name, stream in run.streams.items()
            },
        )
        for run in runs
    )
