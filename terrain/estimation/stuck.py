"""Whether a skid-steer robot moves, as its wheels and its gyro show it: at rest, moving, stuck, or unknown.

Sides that turn against each other at a difference D turn a robot of the track B_0 with D / B_0 where nothing
slips, usually with half of it, and where the robot is stuck not at all.  With w the yaw rate of the filter, b
the gyro's bias of standard deviation s, and means over the last second (low-passes)::

    stuck     |w| + 2 s < r |D| / B_0      with r = :data:`STUCK_RATIO`, for :data:`STUCK_AFTER_S`
    moving    |w| - 2 s > r |D| / B_0      and :data:`MOVING_RADPS`

of sides that turn against each other (``|v| <= |D| / 4``).  At rest are wheels that stand for a second on a
robot that does not turn; and whatever its wheels do, one that turns faster than any bias moves.  The rule
sees nothing else, and says so: a robot that drives straight turns its wheels whether or not the ground stays
below it, and is *unknown*.  So are wheels of a short turn, a yaw rate within two standard deviations of the
limit, and all of it without a gyro.

What else might show it does not, on the measured runs of a Husky on snow, ice, loam and asphalt: wheels that
spin in snow shake the body as travel does (its acceleration scatters by 0.2 to 8 m/s^2, driving by 0.4 to 8),
and their currents (1 to 20 A) are those of driving too.  Nothing is read from either.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numba import boolean, float64, int64

from terrain.estimation.feed import REST_S, STANDING_MPS, TICK_S
from terrain.kernels import njit
from terrain.records import Array

MEAN_S = 1.0
"""Time constant of the means: longer than a wheel's measurement is late (0.3 s), shorter than a turn."""

STUCK_RATIO = 0.1
"""A robot that turns with less than a tenth of D / B_0: firm ground and ice have 0.5 to 0.7, snow 0.3."""

STUCK_AFTER_S = 2.0
"""A turn has to have failed for so long: clocks of two loggers may be 1.3 s apart (BorealTC, SNOW_14)."""

LEAST_TURN_RADPS = 0.1
"""Wheels that would turn the robot slower show nothing: a tenth of it is a gyro's bias."""

MOVING_RADPS = 0.03
"""A robot that turns faster moves, whatever its wheels do: what is left of a bias is not so large."""

OPPOSED_RATIO = 0.25
"""Largest mean of the sides over their difference of wheels that turn on the spot."""

FASTEST_MPS = 50.0
"""A wheel that is read as faster is not read."""

UNKNOWN_AFTER_S = 0.5
"""Without wheels or gyro for longer, nothing is known."""


class Motion(IntEnum):
    """What is known of a robot's motion."""

    UNKNOWN = 0
    AT_REST = 1
    MOVING = 2
    STUCK = 3


@dataclass(frozen=True, slots=True)
class StuckInterval:
    """A time in which a robot was stuck, on the clock of its wheels."""

    start_s: float
    end_s: float


_LAST, _MEAN, _DIFFERENCE, _TURN, _SINCE, _STANDING, _START, _STATUS = range(8)
_UNKNOWN, _AT_REST, _MOVING, _STUCK = (int(motion) for motion in Motion)


def motion_memory() -> Array:
    """Return the memory (8,) of :func:`motion_at` before the first sample."""
    memory = np.full(8, np.nan)
    memory[_STATUS] = _UNKNOWN
    return memory


@njit(
    int64(float64, float64, float64, boolean, float64, float64, float64, float64[::1]),
    error_model="numpy",
)
def motion_at(
    time_s: float,
    left_mps: float,
    right_mps: float,
    has_gyro: bool,
    yaw_rate_radps: float,
    bias_std_radps: float,
    track_m: float,
    memory: Array,
) -> int:
    """Return the :class:`Motion` at one instant.

    Parameters
    ----------
    time_s : of the wheels
    left_mps, right_mps : measured speeds of the sides, NaN where there is none
    has_gyro : whether the gyro was measured
    yaw_rate_radps, bias_std_radps : of the filter
    track_m : B_0, the described track
    memory : (8,) of :func:`motion_memory`, which is moved
    """
    step_s = time_s - memory[_LAST]
    if not (has_gyro and abs(left_mps) <= FASTEST_MPS and abs(right_mps) <= FASTEST_MPS):
        if not 0.0 < step_s <= UNKNOWN_AFTER_S:
            memory[:] = np.nan
            memory[_STATUS] = _UNKNOWN
        return int(memory[_STATUS])
    mean, difference = 0.5 * (left_mps + right_mps), right_mps - left_mps
    if not 0.0 < step_s <= MEAN_S:
        memory[_MEAN], memory[_DIFFERENCE], memory[_TURN] = mean, difference, yaw_rate_radps
        memory[_START], memory[_SINCE], memory[_STANDING] = time_s, np.nan, np.nan
    else:
        gain = 1.0 - math.exp(-step_s / MEAN_S)
        memory[_MEAN] += gain * (mean - memory[_MEAN])
        memory[_DIFFERENCE] += gain * (difference - memory[_DIFFERENCE])
        memory[_TURN] += gain * (yaw_rate_radps - memory[_TURN])
    memory[_LAST] = time_s
    ideal = abs(memory[_DIFFERENCE]) / track_m
    opposed = abs(memory[_MEAN]) <= OPPOSED_RATIO * abs(memory[_DIFFERENCE])
    turns = opposed and ideal >= LEAST_TURN_RADPS and abs(difference) >= LEAST_TURN_RADPS * track_m
    turn, limit, doubt = abs(memory[_TURN]), STUCK_RATIO * ideal, 2.0 * bias_std_radps
    if not (turns and turn + doubt < limit):
        memory[_SINCE] = np.nan
    elif math.isnan(memory[_SINCE]):
        memory[_SINCE] = time_s
    if not (abs(left_mps) < STANDING_MPS and abs(right_mps) < STANDING_MPS):
        memory[_STANDING] = np.nan
    elif math.isnan(memory[_STANDING]):
        memory[_STANDING] = time_s
    status = _UNKNOWN
    if time_s - memory[_STANDING] >= REST_S - TICK_S and turn - doubt <= MOVING_RADPS:
        status = _AT_REST
    elif time_s - memory[_SINCE] >= STUCK_AFTER_S - TICK_S and time_s - memory[_START] >= MEAN_S:
        status = _STUCK
    elif turn - doubt > MOVING_RADPS and not (turns and turn - doubt <= limit):
        status = _MOVING
    memory[_STATUS] = status
    return status


def motion_track(
    time_s: Array,
    wheels_and_gyro: Array,
    yaw_rate_radps: Array,
    bias_std_radps: Array,
    track_m: float,
) -> Array:
    """Return the :class:`Motion` (n,) of a whole log; :func:`motion_at` looped.

    Parameters
    ----------
    time_s : (n,) stamps of the wheels
    wheels_and_gyro : (n, 3) left and right speed and gyro, NaN where there is none
    yaw_rate_radps, bias_std_radps : (n,) of the filter
    track_m : the described track

    Examples
    --------
    >>> time_s = np.arange(0.0, 6.0, 0.1)
    >>> spinning, still = np.tile([-0.15, 0.15, 0.0], (60, 1)), np.zeros(60)
    >>> found = motion_track(time_s, spinning, still, still + 0.002, 0.57)
    >>> stuck_intervals(time_s, found)
    (StuckInterval(start_s=0.0, end_s=5.9),)
    """
    arrays = (np.array(v, dtype=np.float64) for v in (time_s, wheels_and_gyro))
    found: Array = _motion_track(*arrays, np.array(yaw_rate_radps), np.array(bias_std_radps), track_m)
    return found


@njit
def _motion_track(
    time_s: Array, measured: Array, yaw_rate_radps: Array, bias_std_radps: Array, track_m: float
) -> Array:
    memory, out = np.full(8, np.nan), np.empty(time_s.size, np.int64)
    memory[_STATUS] = _UNKNOWN
    for n in range(time_s.size):
        left_mps, right_mps, gyro_radps = measured[n]
        has_gyro = not math.isnan(gyro_radps)
        out[n] = motion_at(
            time_s[n],
            left_mps,
            right_mps,
            has_gyro,
            yaw_rate_radps[n],
            bias_std_radps[n],
            track_m,
            memory,
        )
    return out


def stuck_intervals(time_s: Array, motion: Array) -> tuple[StuckInterval, ...]:
    """Return the times in which a robot was stuck.

    Parameters
    ----------
    time_s, motion : (n,) as of :func:`motion_track`

    Notes
    -----
    A robot is called stuck :data:`STUCK_AFTER_S` after it became so; the interval starts where it did.
    """
    stuck = np.concatenate([[False], motion == Motion.STUCK, [False]])
    first, after = np.flatnonzero(stuck[1:] & ~stuck[:-1]), np.flatnonzero(stuck[:-1] & ~stuck[1:])
    begins = np.maximum(time_s[first] - STUCK_AFTER_S, time_s[:1])
    return tuple(
        StuckInterval(start, end)
        for start, end in zip(begins.tolist(), time_s[after - 1].tolist(), strict=True)
    )


def motion_seconds(time_s: Array, motion: Array) -> dict[str, float]:
    """Return the time spent in each :class:`Motion`, by its name in small letters, in seconds."""
    steps_s = np.diff(time_s, append=time_s[-1:])
    return {kind.name.lower(): float(steps_s[motion == kind].sum()) for kind in Motion}
