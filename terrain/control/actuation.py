"""Whether wheels and steering do what they were commanded; else a sensor lies, or a motor does not follow.

A motor's rate follows its command within 0.4 s.  So it lies between the least and the largest command of
that time, and what is outside by more than a tolerance for a while either measures something else or does not
follow; and the same with steering angles.  A rate that repeats itself to the last bit, as that of a motor
that stands, has less than half of that time; one that approaches its command, as that of a motor under
load, has more.  Of three measured values the middle one counts, not a spike.
"""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, float64, int64, njit, types, void

from terrain.entry_point import entry_point
from terrain.records import Array, Reading

N_KEPT = 32
_OFF, _ON, _SMOOTH, _SLOW, _LAST, _BEFORE, _STILL = range(7)
WINDOW_S, PERSISTS_S, SETTLED_S, SMOOTH_S = 0.4, 0.06, 0.1, 0.04
"""Time within which a command is followed; for which a deviation has to last; for which there must be none
for it to be over; low-pass of what is measured, against the ripple of the Hall steps."""

STILL_S = 0.18
"""Time within which a motor changes its rate where the command has; a loaded one takes 0.12 s to start."""

SLOW_S, APPROACH = 0.2, 0.02
"""A second low-pass, and how far the first is ahead of it, in m/s or rad, where a command is approached."""

SPEED_MPS, SPEED_RATIO, STEER_RAD = 0.05, 0.06, 0.06
"""Tolerances: of a wheel's speed, a constant and a part of the command, and of a steering angle."""


_V, _M = float64[::1], float64[:, ::1]
_IN = types.Array(float64, 1, "A", readonly=True)


def actuation_memory() -> tuple[Array, Array]:
    """Return the memory before the first step.

    Commands (32, 7) by time; and (7, 6): how long each is off and on, measured values behind two low-passes,
    the two values before, and for how long it has repeated itself.
    """
    lasting = np.full((7, 6), np.nan)
    lasting[_OFF], lasting[_ON], lasting[_STILL] = 0.0, SETTLED_S, 0.0
    return np.full((N_KEPT, 7), np.nan), lasting


@njit(cache=True, error_model="numpy")
def _middle(i: int, measured: float, step_s: float, lasting: Array) -> float:
    """Take a value; return the middle one of the last three, or this one where there are fewer."""
    last, before = lasting[_LAST, i], lasting[_BEFORE, i]
    lasting[_STILL, i] = lasting[_STILL, i] + step_s if measured == last else 0.0
    lasting[_LAST, i], lasting[_BEFORE, i] = measured, last
    if math.isnan(measured + last + before):
        return measured
    return float(max(min(measured, last), min(max(measured, last), before)))


@njit(cache=True, error_model="numpy")
def _low_passed(i: int, value: float, step_s: float, lasting: Array) -> tuple[float, float]:
    """Put a value behind both low-passes; an unknown one leaves nothing there."""
    for row, memory_s in ((_SMOOTH, SMOOTH_S), (_SLOW, SLOW_S)):
        before = lasting[row, i]
        unknown = math.isnan(before + value)
        lasting[row, i] = value if unknown else before + (value - before) * -math.expm1(-step_s / memory_s)
    return lasting[_SMOOTH, i], lasting[_SLOW, i]


@njit(
    void(float64, float64, int64, _V, _IN, float64, _IN, _M, _M, boolean[::1]),
    cache=True,
    error_model="numpy",
)
def follow(
    now_s: float,
    step_s: float,
    slot: int,
    command: Array,
    rates: Array,
    mps_per_radps: float,
    steer_rad: Array,
    kept: Array,
    lasting: Array,
    off: Array,
) -> None:
    """Write which (6,) of three wheel speeds and three steering angles are off their commands.

    Parameters
    ----------
    now_s, step_s : time, and since the step before
    slot : place in ``kept`` of this step: the number of the step modulo :data:`N_KEPT`
    command : (6,) speeds in m/s and angles in rad that were in force until now; NaN for none
    rates, mps_per_radps : of the motors, first of (c,), NaN where unknown, and the speed of a wheel by them
    steer_rad : (3,) measured, NaN where unknown
    kept, lasting : as :func:`actuation_memory` returns them; changed
    off : (6,) is written
    """
    kept[slot, 0] = now_s
    kept[slot, 1:] = command
    for i in range(6):
        low, high = math.inf, -math.inf
        measured = rates[i] * mps_per_radps if i < 3 else steer_rad[i - 3]
        middle = _middle(i, measured, step_s, lasting)
        window_s = STILL_S if i < 3 and lasting[_STILL, i] >= STILL_S else WINDOW_S
        for k in range(N_KEPT):
            if kept[k, 0] >= now_s - window_s and not math.isnan(kept[k, 1 + i]):
                low, high = min(low, kept[k, 1 + i]), max(high, kept[k, 1 + i])
        slack = STEER_RAD if i >= 3 else SPEED_MPS + SPEED_RATIO * max(abs(low), abs(high))
        smooth, slow = _low_passed(i, middle, step_s, lasting)
        known = low <= high and not math.isnan(smooth)
        if known and (smooth < low - slack and smooth > slow + APPROACH):
            continue
        if known and (smooth > high + slack and smooth < slow - APPROACH):
            continue
        if known and not low - slack <= smooth <= high + slack:
            lasting[_OFF, i] += step_s
            lasting[_ON, i] = 0.0
        else:
            lasting[_OFF, i] = 0.0
            lasting[_ON, i] += step_s
        if lasting[_OFF, i] >= PERSISTS_S:
            off[i] = True
        elif lasting[_ON, i] >= SETTLED_S:
            off[i] = False


_follow = entry_point(follow)
_UNKNOWN = np.full(3, math.nan)


class Actuation:
    """Wheels and steering of a robot against their commands, step by step.

    Parameters
    ----------
    mps_per_radps : speed of a wheel by the rate of its motor

    Attributes
    ----------
    off : (6,) wheels and steering angles that are off their commands
    """

    def __init__(self, mps_per_radps: float) -> None:
        self._mps_per_radps = mps_per_radps
        self._command = np.full(6, math.nan)
        self._kept, self._lasting = actuation_memory()
        self._slot = 0
        self.off = np.zeros(6, dtype=np.bool_)

    def commanded(self, wheel_mps: Array, steer_rad: Array) -> None:
        """Take the commands (3,), (3,) that are in force from now on."""
        self._command[:3], self._command[3:] = wheel_mps, steer_rad

    def measured(self, now_s: float, step_s: float, wheels: Reading | None, steer_rad: Array | None) -> None:
        """Compare the rates, first columns of the wheels, and steering angles (3,) with the commands."""
        self._slot = (self._slot + 1) % N_KEPT
        rates = _UNKNOWN if wheels is None else wheels.values[-1]
        steer_rad = _UNKNOWN if steer_rad is None else steer_rad
        _follow(
            *(now_s, step_s, self._slot, self._command, rates, self._mps_per_radps, steer_rad),
            *(self._kept, self._lasting, self.off),
        )
