"""Standing stretches, found by the log itself, and the gyros' biases (Danzi, AgriMaRo thesis, 3.3.3)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from terrain.calibration.finding import Finding, biases, undetermined
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot

MIN_STANDING_S = 5.0
"""Shorter stops are passed over: the robot still swings, and noise averages out too little."""

BLOCK_S = 0.2
"""Length over which the IMU is judged to be quiet."""

QUIET_FACTOR = 5.0
"""A quiet sensor scatters at most this many times as much as its description says, which may be a poor
guess."""

MAX_BIAS_RADPS = 0.06
"""A steady rate above this is a rotation: the BNO055's zero-rate offset is within 3 deg/s (Bosch data
sheet)."""

STANDING_MPS = 0.01
"""Largest circumferential speed of a standing wheel: a single step of its Hall sensor reads as more after
the low-pass of the motor driver."""

BATCH_S = 1.0
"""Means over batches of this length are as good as independent."""

NO_STANDING = f"no run has a standing stretch of {MIN_STANDING_S:g} s: let the robot stand, switched on"

GYRO, ACCEL = IMU_CHANNELS[:3], IMU_CHANNELS[3:6]


class Stretch(NamedTuple):
    """A stretch of a run, ``[start_s, end_s)``; all of it by default."""

    run: RunLog
    start_s: float = -math.inf
    end_s: float = math.inf

    def of(self, stream: str, channels: Sequence[str]) -> Stream | None:
        """Return the known samples of some channels, None where there are not even two."""
        whole = self.run.streams.get(stream)
        if whole is None or not set(channels) <= set(whole.channels):
            return None
        first, end = np.searchsorted(whole.time_s, [self.start_s, self.end_s])
        values = np.column_stack([whole.channel(channel)[first:end] for channel in channels])
        known = np.isfinite(values).all(axis=1)
        if known.sum() < 2:
            return None
        return Stream(whole.time_s[first:end][known], values[known], tuple(channels))


def standing(run: RunLog, robot: Robot, min_s: float = MIN_STANDING_S) -> list[Stretch]:
    """Return the stretches, of at least ``min_s``, in which nothing moves.

    The wheels stand, where the log has any; the IMU is there, scatters about its noise, turns by no more
    than a bias can, and is not frozen.  What is returned is short of the motion at either end by a block.

    Parameters
    ----------
    run : with the stream ``imu``
    robot : with all sections
    min_s : least length
    """
    _, motors, _, _, sensors = robot.equipment
    imu = Stretch(run).of("imu", GYRO + ACCEL)
    if imu is None:
        return []
    size = max(round(BLOCK_S * imu.rate_hz), 3)
    n = len(imu) // size
    values, time_s = imu.values[: n * size].reshape(n, size, 6), imu.time_s[: n * size].reshape(n, size)
    scatter = values.std(axis=1)
    limit = QUIET_FACTOR * np.repeat([sensors.gyro_std_radps, sensors.accel_std_mps2], 3)
    quiet = ((scatter > 0) & (scatter < limit)).all(axis=1) & (np.ptp(time_s, axis=1) < 1.5 * BLOCK_S)
    quiet &= (np.abs(values[:, :, :3].mean(axis=1)) < MAX_BIAS_RADPS).all(axis=1)
    wheels = Stretch(run).of("wheels", [f"motor_{wheel}_radps" for wheel in robot.wheels])
    if wheels is not None:
        wheel_speed_mps = np.abs(wheels.values).max(axis=1) / motors.reduction_ratio * robot.wheel_radius_m
        moving_s = wheels.time_s[wheel_speed_mps > STANDING_MPS]
        quiet &= np.searchsorted(moving_s, time_s[:, 0]) == np.searchsorted(moving_s, time_s[:, -1])
        quiet &= (time_s[:, 0] >= wheels.time_s[0]) & (time_s[:, -1] <= wheels.time_s[-1] + BLOCK_S)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], quiet.astype(int), [0]]))).reshape(-1, 2)
    # Nearly a block at either end shares its block with a motion; one more is left away for what swings on.
    return [
        Stretch(run, float(time_s[first + 1, 0]), float(time_s[end - 1, 0]))
        for first, end in edges
        if end - first > 2 and (end - first + 2) * BLOCK_S >= min_s
    ]


def batches(stream: Stream, length_s: float = BATCH_S) -> Iterator[Array]:
    """Yield the values (k, channels) of whole consecutive batches of a stream."""
    size = max(round(length_s * stream.rate_hz), 3)
    for first in range(0, len(stream) - size + 1, size):
        yield stream.values[first : first + size]


def gyro_bias(stretches: Sequence[Stretch], robot: Robot) -> list[Finding]:
    """Return the biases of the three gyros and how much they differ from one power-on to the next.

    Parameters
    ----------
    stretches : standing, of any runs; each run is taken for a power-on
    robot : with sensors described

    Notes
    -----
    The error of a mean is that of the means over :data:`BATCH_S`: the colour of the noise, and a bias that
    walks, count as far as they show within a run.
    """
    names = [f"sensors.gyro_bias_{axis}_radps" for axis in "xyz"]
    of_run: dict[str, list[Stream]] = {}
    for stretch in stretches:
        if stream := stretch.of("imu", GYRO):
            of_run.setdefault(stretch.run.run_id, []).append(stream)
    if not of_run:
        return undetermined([*names, "sensors.gyro_bias_std_radps"], NO_STANDING)
    parts = [
        np.array([batch.mean(axis=0) for stream in streams for batch in batches(stream)])
        for streams in of_run.values()
    ]
    found = np.array([part.mean(axis=0) for part in parts])
    variance = np.array([part.var(axis=0, ddof=1) / len(part) for part in parts])
    n = sum(len(stream) for streams in of_run.values() for stream in streams)
    described = robot.equipment.sensors.gyro_bias_std_radps
    std_name = "sensors.gyro_bias_std_radps"
    return biases(names, std_name, found, variance, described, n, "samples", tuple(of_run))
