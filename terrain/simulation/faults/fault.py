"""A fault of sensors, and the bus that applies it to what a controller is given.

A fault acts on readings, on their stamps, and on when they arrive.  It is a function of a sample and of what
has to be remembered from sample to sample, :class:`Memory`; the motion and the sensors' own arrays are not
touched, so that a drive with a fault differs from one without by what the controller makes of it alone.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from terrain.errors import ConfigError
from terrain.records import Array, Command, Reading, Sample

STREAMS: tuple[str, ...] = ("wheels", "steering", "imu", "odometry")
"""Streams that faults act on; ``odometry`` is the camera's."""


class Nature(Enum):
    """What a fault makes of the streams that it touches, which decides what a controller has to do.

    ``DEAD`` and ``LYING`` streams carry no information or a wrong one: no correction may be based on them.
    With a ``TOLERABLE`` fault the streams still carry the motion, and the controller has to go on.  With a
    ``DEGRADED`` one it may do either.
    """

    DEAD = "dead"
    LYING = "lying"
    TOLERABLE = "tolerable"
    DEGRADED = "degraded"


@dataclass(slots=True)
class StreamMemory:
    """What is remembered of one stream.

    Parameters
    ----------
    rng : of all that is drawn for the stream
    last : (c,) its last values before the fault began; None before the first sample
    n_samples : number of its samples that the fault has acted on
    pending : times at which samples that are held back are due, and the samples, in order
    """

    rng: np.random.Generator
    last: Array | None = None
    n_samples: int = 0
    pending: list[tuple[float, Reading]] = field(default_factory=list)


Memory = dict[str, StreamMemory]
"""What is remembered, by stream."""

Action = Callable[[Sample, Memory], Sample]
"""From what the sensors gave at a step to what arrives."""


@dataclass(frozen=True, slots=True)
class SensorFault:
    """An entry of the catalogue.

    Parameters
    ----------
    name, kind : of the fault, and of the group that it is in
    about : what it does, in one sentence
    streams : that it touches
    nature : what it makes of them
    action : what it does to a sample
    """

    name: str
    kind: str
    about: str
    streams: tuple[str, ...]
    nature: Nature
    action: Action


class FaultyBus:
    """A controller behind a bus with a fault, to be given to ``simulate`` in its place.

    Parameters
    ----------
    controller : gets what arrives
    fault : acts on the samples of the steps from ``start_s`` on and before ``end_s``
    start_s, end_s : on the clock of the steps; an infinite end is for good
    seed : of all that the fault draws, from 0 up

    Raises
    ------
    ConfigError
        if the start is not finite, or the end not after it.

    Examples
    --------
    >>> lost = SensorFault("lost", "loss", "", ("imu",), Nature.DEAD, lambda s, _: s._replace(readings={}))
    >>> arrived = []
    >>> bus = FaultyBus(lambda sample: arrived.append(sorted(sample.readings)), lost, 1.0, 2.0, seed=0)
    >>> for time_s in (0.98, 1.0, 2.0):
    ...     bus(Sample(time_s, np.zeros(3), {"imu": Reading(np.array([time_s]), np.zeros((1, 9)))}))
    >>> arrived
    [['imu'], [], ['imu']]
    """

    def __init__(
        self,
        controller: Callable[[Sample], Command],
        fault: SensorFault,
        start_s: float,
        end_s: float,
        seed: int,
    ) -> None:
        if not (math.isfinite(start_s) and end_s > start_s):
            raise ConfigError(f"fault {fault.name}: acts from {start_s!r} to {end_s!r} s, start before end")
        self._controller, self._fault, self._start_s, self._end_s = controller, fault, start_s, end_s
        drawn = np.random.SeedSequence([seed, zlib.crc32(fault.name.encode())]).spawn(len(STREAMS))
        self._memory = {
            stream: StreamMemory(np.random.default_rng(each))
            for stream, each in zip(STREAMS, drawn, strict=True)
        }

    def __call__(self, sample: Sample) -> Command:
        """Return the controller's command for what arrives of a sample."""
        if sample.time_s < self._start_s:
            for name, memory in self._memory.items():
                if name in sample.readings:
                    memory.last = sample.readings[name].values[-1].copy()
        elif sample.time_s < self._end_s:
            sample = self._fault.action(sample, self._memory)
        else:
            sample = released(sample, self._memory)
        return self._controller(sample)


def released(sample: Sample, memory: Memory) -> Sample:
    """Return a sample with all that was held back before it, which is held back no more."""
    readings = dict(sample.readings)
    for stream, remembered in memory.items():
        if remembered.pending:
            held = [reading for _, reading in remembered.pending]
            readings[stream] = joined([*held, *([readings[stream]] if stream in readings else [])])
            remembered.pending.clear()
    return sample._replace(readings=readings)


def joined(readings: list[Reading]) -> Reading:
    """Return readings, one at least, as one, in their order."""
    return Reading(
        np.concatenate([reading.time_s for reading in readings]),
        np.concatenate([reading.values for reading in readings]),
    )
