"""Faults written into logs: a sign, a unit, or two channels in each other's place, in all runs.

They are no effects of a robot: the right answer is a sentence about the log.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

from terrain.effects import BOTH, SKIDDING, SWERVE
from terrain.records import RunLog, Stream
from terrain.robots import Robot


class Statement(NamedTuple):
    """What an answer states of a fault of the logs: its kind, the channel or column, and the sentence."""

    kind: str
    channel: str
    sentence: str


class WrittenFault(NamedTuple):
    """A fault of a log.

    Parameters
    ----------
    name : of the fault
    drives : of robots whose logs show it
    stream : that has it
    write : gives the stream with the fault, of a robot
    channel : the channel that is stated has one of these words, in lower case
    words : the kind or the sentence has one of these
    without : words of another channel
    """

    name: str
    drives: tuple[str, ...]
    stream: str
    write: Callable[[Stream, Robot], Stream]
    channel: tuple[str, ...]
    words: tuple[str, ...]
    without: tuple[str, ...] = ()

    def stated_in(self, statements: Iterable[Statement]) -> bool:
        """Return whether one states this fault.

        Examples
        --------
        >>> fault_named("gyro_deg").stated_in([Statement("unit", "gyro", "the gyro is in deg/s")])
        True
        """
        for statement in statements:
            channel, text = statement.channel.lower(), f"{statement.kind} {statement.sentence}".lower()
            own = any(word in channel for word in self.channel) and not any(
                w in channel for w in self.without
            )
            if own and any(word in text for word in self.words):
                return True
        return False


def _scaled(part: str, factor: float) -> Callable[[Stream, Robot], Stream]:
    """Return what multiplies all channels whose name has a part."""

    def write(stream: Stream, _: Robot) -> Stream:
        values = stream.values.copy()
        values[:, [part in name for name in stream.channels]] *= factor
        return replace(stream, values=values)

    return write


def _swapped(*kinds: str) -> Callable[[Stream, Robot], Stream]:
    """Return what puts the channels of the last two wheels in each other's place.

    Of the catalogue's swerve robot the first two always turn alike, unless it drives sideways while it turns:
    their exchange leaves a log as it was.
    """

    def write(stream: Stream, robot: Robot) -> Stream:
        values = stream.values.copy()
        for kind in kinds:
            pair = [kind.format(wheel) for wheel in robot.wheels[-2:]]
            if set(pair) <= set(stream.channels):
                at = [stream.channels.index(name) for name in pair]
                values[:, at] = values[:, at[::-1]]
        return replace(stream, values=values)

    return write


_GYRO = ("gyro", "yaw")
_SKID, _SWERVE, _BOTH = SKIDDING, (SWERVE,), BOTH

FAULTS: tuple[WrittenFault, ...] = (
    WrittenFault("gyro_sign", _BOTH, "imu", _scaled("gyro_z_", -1.0), _GYRO, ("sign", "invert")),
    WrittenFault("gyro_deg", _BOTH, "imu", _scaled("gyro_", 180.0 / math.pi), _GYRO, ("deg",)),
    WrittenFault("wheels_kmh", _SKID, "wheels", _scaled("speed_", 3.6), ("wheel",), ("km/h",)),
    WrittenFault(
        "camera_kmh", _SKID, "odometry", _scaled("speed_", 3.6), ("camera", "ground", "speed_x"), ("km/h",)
    ),
    WrittenFault(
        "wheels_rpm", _SWERVE, "wheels", _scaled("motor_", 30.0 / math.pi), ("wheel", "motor"), ("rpm",)
    ),
    WrittenFault(
        "swapped_currents", _SKID, "wheels", _swapped("current_{}_a"), ("current",), ("swap", "exchange")
    ),
    WrittenFault(
        "swapped_wheels",
        _BOTH,
        "wheels",
        _swapped("speed_{}_mps", "motor_{}_radps"),
        ("wheel", "motor"),
        ("swap", "exchange"),
        ("current",),
    ),
)
"""All of them.  A swap of currents does not show on a swerve robot, of which only their sum is compared."""


def faults_of(drive: str) -> tuple[WrittenFault, ...]:
    """Return the faults that logs of robots of a drive can have."""
    return tuple(fault for fault in FAULTS if drive in fault.drives)


def fault_named(name: str) -> WrittenFault:
    """Return the fault of a name; ``KeyError`` for an unknown one."""
    return {fault.name: fault for fault in FAULTS}[name]


def with_fault(runs: Iterable[RunLog], fault: WrittenFault, robot: Robot) -> tuple[RunLog, ...]:
    """Return runs with a fault written into each log."""
    return tuple(
        replace(run, streams={**run.streams, fault.stream: fault.write(run.streams[fault.stream], robot)})
        for run in runs
    )
