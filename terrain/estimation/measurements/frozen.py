"""Channels that repeat themselves while the robot moves, and so measure nothing.

A whole stream that repeats itself is left out before (``cleaning``, ``live.rows``).  Here one channel of an
IMU, a camera or the wheels does, beside others that go on: from a number of repetitions on it is NaN, and
with it the rows that it is used for.  A coarse channel repeats itself by nature: what counts as frozen is
four times the longest run that has ended in motion.  Wheels are compared with each other: where all of them
turn evenly, their rates may be rounded.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from terrain.records import Array

N_CHANNELS = 14
"""Most channels of a stream that is judged."""

OF_IMU, OF_CAMERA, OF_WHEELS, OF_SPEED = range(4)
"""Places in the memory; the last is of the camera's speed in the body's axes, along and across."""

REPEATED_IMU = np.array([10.0] * 6 + [15.0] * 3 + [np.inf] * (N_CHANNELS - 9))
"""Repetitions from which on a channel counts as frozen: 0.1 s of a rate, 0.15 s of an attitude."""

REPEATED_CAMERA = np.array([np.inf] * 3 + [20.0] * 4 + [10.0] * 6 + [np.inf])
"""Of the camera, at 200 Hz: 0.1 s of the quaternion, 0.05 s of a velocity; its position is not used."""

REPEATED_SPEED = np.full(2, 10.0)
REPEATED_WHEELS = np.full(3, 5.0)
"""Of the camera's speed in the body's axes, and of the rate of each motor."""

LONGER, LIVELY = 4.0, 2.0
SAME = 1e-12
"""Values that differ by less are the same, turned into other axes and back."""

_LAST, _COUNT, _LONGEST, _BEGAN = range(4)


def frozen_memory() -> Array:
    """Return the memory (4, 4, 14) before the first sample.

    Of each place and channel: last value, number of repetitions, longest run, and whether this one began in
    motion.
    """
    memory = np.zeros((4, 4, N_CHANNELS))
    memory[:, _LAST] = np.nan
    return memory


@njit(cache=True, error_model="numpy")
def repeats(memory: Array, c: int, most: float) -> bool:
    """Say whether a channel has repeated itself for longer than it does by nature."""
    return bool(memory[_COUNT, c] >= max(most, LONGER * memory[_LONGEST, c]))


@njit(cache=True, error_model="numpy")
def still_lives(sample: Array, most: Array, moving: bool, memory: Array) -> Array:
    """Return a sample (c,) with NaN where a channel is frozen, and count its repetitions."""
    found = sample.copy()
    for c in range(sample.size):
        if abs(sample[c] - memory[_LAST, c]) <= SAME:
            memory[_COUNT, c] += 1.0
        elif not np.isnan(sample[c]):
            if moving and memory[_BEGAN, c] > 0.0:
                memory[_LONGEST, c] = max(memory[_LONGEST, c], memory[_COUNT, c])
            memory[_COUNT, c], memory[_BEGAN, c] = 0.0, 1.0 if moving else 0.0
        if not np.isnan(sample[c]):
            memory[_LAST, c] = sample[c]
        if moving and repeats(memory, c, most[c]):
            found[c] = np.nan
    return found


@njit(cache=True, error_model="numpy")
def find_frozen_wheels(motor_radps: Array, moving: bool, memory: Array, frozen: Array) -> None:
    """Write which (3,) motors' rates repeat themselves while that of another one changes."""
    still_lives(motor_radps, REPEATED_WHEELS, moving, memory)
    change = False
    for i in range(3):
        change |= memory[_COUNT, i] <= LIVELY
    for i in range(3):
        frozen[i] = moving and change and repeats(memory, i, REPEATED_WHEELS[i])
