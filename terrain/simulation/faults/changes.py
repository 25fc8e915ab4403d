"""What faults do to the readings of one stream: values, stamps, shapes, and when they arrive.

A :data:`Change` is given arrays of its own, which it may write to, and returns what arrives of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import to_body, to_camera
from terrain.records import Array, Reading, Sample
from terrain.simulation.faults.fault import Action, Memory, StreamMemory, joined

EVERY = 10
"""Of the faults of single samples, one in so many samples has one."""

_SLACK_S = 1e-9  # stamps and steps that differ by less are the same instant
_QUATERNION = slice(
    CAMERA_CHANNELS.index("quaternion_x_ratio"), CAMERA_CHANNELS.index("quaternion_w_ratio") + 1
)
_VELOCITY = slice(CAMERA_CHANNELS.index("velocity_x_mps"), CAMERA_CHANNELS.index("velocity_z_mps") + 1)

Change = Callable[[Reading, StreamMemory], Reading | None]
"""From what a stream gave at a step to what arrives of it; None for nothing."""


def on(streams: Sequence[str], change: Change) -> Action:
    """Return the action that changes the readings of streams, and nothing else."""

    def act(sample: Sample, memory: Memory) -> Sample:
        readings = {}
        for name, reading in sample.readings.items():
            given: Reading | None = reading
            if name in streams:
                given = change(Reading(reading.time_s.copy(), reading.values.copy()), memory[name])
                memory[name].n_samples += len(reading.time_s)
            if given is not None:
                readings[name] = given
        return sample._replace(readings=readings)

    return act


def lost(reading: Reading, memory: StreamMemory) -> None:
    """Let nothing arrive."""


def frozen(columns: Sequence[int] | slice = slice(None)) -> Change:
    """Repeat the last values before the fault; stamps go on."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        last = _last_values(reading, memory)
        reading.values[:, columns] = last[columns]
        return reading

    return change


def offset(columns: Sequence[int], amount: float) -> Change:
    """Add a number to channels."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        reading.values[:, columns] += amount
        return reading

    return change


def scaled(columns: Sequence[int], factor: float) -> Change:
    """Multiply channels by a number."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        reading.values[:, columns] *= factor
        return reading

    return change


def filled(value: float) -> Change:
    """Replace all values by one."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        reading.values[:] = value
        return reading

    return change


def filled_at_times(value: float) -> Change:
    """Replace all values of each tenth sample by one."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        reading.values[_chosen(reading, memory)] = value
        return reading

    return change


def noisy(std: Array) -> Change:
    """Add white noise with standard deviations (c,) to the channels."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        reading.values[:] += std * memory.rng.standard_normal(reading.values.shape)
        return reading

    return change


def shifted_stamps(offset_s: float) -> Change:
    """Add a time to all stamps; a time that is not finite takes their place."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        return reading._replace(time_s=reading.time_s + offset_s)

    return change


def shifted_at_times(offset_s: float) -> Change:
    """Add a time to the stamp of each tenth sample."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        reading.time_s[_chosen(reading, memory)] += offset_s
        return reading

    return change


def duplicated(reading: Reading, memory: StreamMemory) -> Reading:
    """Let each sample arrive twice."""
    return Reading(np.repeat(reading.time_s, 2), np.repeat(reading.values, 2, axis=0))


def as_text(reading: Reading, memory: StreamMemory) -> Reading:
    """Give words in place of the values."""
    return reading._replace(values=np.full(reading.values.shape, "unknown"))


def as_nothing(reading: Reading, memory: StreamMemory) -> Reading:
    """Give None in place of stamps and values."""
    return Reading(None, None)  # type: ignore[arg-type]


def as_ragged(reading: Reading, memory: StreamMemory) -> Reading:
    """Give a list whose rows have different lengths."""
    rows = [[0.0] * (1 + k) for k in range(len(reading.time_s) + 1)]
    return reading._replace(values=rows)  # type: ignore[arg-type]


def of_other_width(n_columns: int) -> Change:
    """Give the samples of another robot, with that number of columns; those that are added are 0."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        values = np.zeros((len(reading.time_s), n_columns))
        kept = min(n_columns, reading.values.shape[1])
        values[:, :kept] = reading.values[:, :kept]
        return reading._replace(values=values)

    return change


def camera_forward(values: Array) -> Array:
    """Return the robot's forward direction (k, 3) in the camera's fixed frame, in which its velocity is.

    Parameters
    ----------
    values : (k, 14) of the camera; without a rotation in them the direction is NaN

    Examples
    --------
    >>> level = np.zeros((1, 14))
    >>> level[0, 6] = 1.0  # the quaternion of no rotation
    >>> camera_forward(level) + 0.0
    array([[ 0.,  0., -1.]])
    """
    quaternion = values[:, _QUATERNION]
    x, y, z = to_body(quaternion[:, :3]).T
    w = quaternion[:, 3]
    ahead = np.column_stack([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)])
    ahead[np.linalg.norm(quaternion, axis=1) < 0.5] = np.nan
    return to_camera(ahead)


def camera_speed_offset(amount_mps: float) -> Change:
    """Add to the camera's forward speed, wherever the robot is heading."""

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        reading.values[:, _VELOCITY] += amount_mps * camera_forward(reading.values)
        return reading

    return change


def camera_speed_frozen(reading: Reading, memory: StreamMemory) -> Reading:
    """Repeat the camera's last forward speed before the fault; all else goes on."""
    last = _last_values(reading, memory)[None, :]
    held_mps = float((last[:, _VELOCITY] * camera_forward(last)).sum())
    forward = camera_forward(reading.values)
    speed_mps = (reading.values[:, _VELOCITY] * forward).sum(axis=1)
    reading.values[:, _VELOCITY] += (held_mps - speed_mps)[:, None] * forward
    return reading


def camera_turned(angle_rad: float) -> Change:
    """Turn the camera's orientation to the left about the vertical; its velocity stays."""
    w, up = math.cos(angle_rad / 2), math.sin(angle_rad / 2)

    def change(reading: Reading, memory: StreamMemory) -> Reading:
        x, y, z, scalar = reading.values[:, _QUATERNION].T.copy()  # y is up
        reading.values[:, _QUATERNION] = np.column_stack(
            [w * x + up * z, w * y + up * scalar, w * z - up * x, w * scalar - up * y]
        )
        return reading

    return change


def late(stream: str, delay_s: float, jitter_s: float = 0.0) -> Action:
    """Deliver each sample a time after its stamp, and up to ``jitter_s`` later by chance; in their order."""

    def act(sample: Sample, memory: Memory) -> Sample:
        remembered = memory[stream]
        readings = dict(sample.readings)
        for row in _rows(readings.pop(stream, None)):
            due_s = float(row.time_s[0]) + delay_s
            due_s += float(remembered.rng.uniform(0.0, jitter_s)) if jitter_s else 0.0
            before_s = remembered.pending[-1][0] if remembered.pending else -math.inf
            remembered.pending.append((max(due_s, before_s), row))
        n_due = sum(due_s <= sample.time_s + _SLACK_S for due_s, _ in remembered.pending)
        if n_due:
            readings[stream] = joined([row for _, row in remembered.pending[:n_due]])
            del remembered.pending[:n_due]
        return sample._replace(readings=readings)

    return act


def out_of_order(stream: str) -> Action:
    """Deliver of each two samples the later one first."""

    def act(sample: Sample, memory: Memory) -> Sample:
        pending = memory[stream].pending
        readings, arrived = dict(sample.readings), []
        for row in _rows(readings.pop(stream, None)):
            if pending:
                arrived += [row, pending.pop()[1]]
            else:
                pending.append((float(row.time_s[0]), row))
        if arrived:
            readings[stream] = joined(arrived)
        return sample._replace(readings=readings)

    return act


def shifted_clock(offset_s: float) -> Action:
    """Shift the clock of the whole robot: all stamps, and that of the step."""

    def act(sample: Sample, memory: Memory) -> Sample:
        readings = {
            name: reading._replace(time_s=reading.time_s + offset_s)
            for name, reading in sample.readings.items()
        }
        return sample._replace(time_s=sample.time_s + offset_s, readings=readings)

    return act


def _last_values(reading: Reading, memory: StreamMemory) -> Array:
    """Return the last values (c,) before the fault; without any, the first during it."""
    if memory.last is None:
        memory.last = reading.values[0].copy()
    return memory.last


def _chosen(reading: Reading, memory: StreamMemory) -> Array:
    """Return which samples (k,) are each tenth of those that the fault has acted on."""
    place = memory.n_samples + np.arange(len(reading.time_s))
    return np.asarray(place % EVERY == EVERY - 1)


def _rows(reading: Reading | None) -> list[Reading]:
    """Return the samples of a reading one by one."""
    if reading is None:
        return []
    return [
        Reading(reading.time_s[i:j].copy(), reading.values[i:j].copy())
        for i, j in pairwise(range(len(reading.time_s) + 1))
    ]
