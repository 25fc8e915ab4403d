"""Whether wheels and steering do what they were commanded; else a sensor lies, or a motor does not follow.

A motor's rate follows its command within 0.4 s.  So it lies between the least and the largest command of
that time, and what is outside by more than a tolerance for a while either measures something else or does not
follow; and the same with steering angles.  A rate that repeats itself to the last bit, as that of a motor
that stands, has less than half of that time; one that approaches its command, as that of a motor under
load, has more.  Of three measured values the middle one counts, not a spike.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from terrain.records import Array, Reading

N_COMMANDS = 32
"""Of the last steps, which are compared."""

WINDOW_S, PERSISTS_S, SETTLED_S, SMOOTH_S = 0.4, 0.06, 0.1, 0.04
"""Time within which a command is followed; for which a deviation has to last; for which there must be none
for it to be over; low-pass of what is measured, against the ripple of the Hall steps."""

STILL_S = 0.18
"""Time within which a motor changes its rate where the command has; a loaded one takes 0.12 s to start."""

SLOW_S, APPROACH = 0.2, 0.02
"""A second low-pass, and how far the first is ahead of it, in m/s or rad, where a command is approached."""

SPEED_MPS, SPEED_RATIO, STEER_RAD = 0.05, 0.06, 0.06
"""Tolerances: of a wheel's speed, a constant and a part of the command, and of a steering angle."""


class Follower:
    """A wheel's speed, or a steering angle, against its command: whether it ``is_off``.

    The tolerance is a constant and a ratio of the command; a value that repeats itself has to change as the
    command does within ``still_s``.
    """

    def __init__(self, tolerance: float, ratio: float = 0.0, still_s: float = math.inf) -> None:
        self._tolerance, self._ratio, self._still_s = tolerance, ratio, still_s
        self._commands: deque[tuple[float, float]] = deque(maxlen=N_COMMANDS)
        self._last = self._before = self._smooth = self._slow = math.nan
        self._repeated_s, self._off_s, self._on_s = 0.0, 0.0, SETTLED_S
        self.is_off = False

    def update(self, now_s: float, step_s: float, command: float, measured: float) -> None:
        """Take the command that was in force until now, and what is measured; NaN for none."""
        self._commands.append((now_s, command))
        middle = self._middle(measured, step_s)
        self._smooth = _low_passed(self._smooth, middle, step_s / SMOOTH_S)
        self._slow = _low_passed(self._slow, middle, step_s / SLOW_S)
        smooth, since_s = self._smooth, now_s - (STILL_S if self._repeated_s >= self._still_s else WINDOW_S)
        commands = [value for time_s, value in self._commands if time_s >= since_s and not math.isnan(value)]
        deviates = False
        if commands and not math.isnan(smooth):
            low, high = min(commands), max(commands)
            slack = self._tolerance + self._ratio * max(abs(low), abs(high))
            below, above = smooth < low - slack, smooth > high + slack
            if (below and smooth > self._slow + APPROACH) or (above and smooth < self._slow - APPROACH):
                return
            deviates = below or above
        self._off_s = self._off_s + step_s if deviates else 0.0
        self._on_s = 0.0 if deviates else self._on_s + step_s
        if self._off_s >= PERSISTS_S:
            self.is_off = True
        elif self._on_s >= SETTLED_S:
            self.is_off = False

    def _middle(self, measured: float, step_s: float) -> float:
        """Return the middle one of the last three values, or this one where there are fewer."""
        last, before = self._last, self._before
        self._repeated_s = self._repeated_s + step_s if measured == last else 0.0
        self._last, self._before = measured, last
        if math.isnan(measured + last + before):
            return measured
        return max(min(measured, last), min(max(measured, last), before))


def _low_passed(before: float, value: float, step_ratio: float) -> float:
    """Return a value behind a low-pass; an unknown one leaves nothing there."""
    return value if math.isnan(before + value) else before + (value - before) * -math.expm1(-step_ratio)


class Actuation:
    """Wheels and steering of a robot against their commands, step by step: which (6,) are ``off``.

    ``mps_per_radps`` is the speed of a wheel by the rate of its motor.
    """

    def __init__(self, mps_per_radps: float) -> None:
        self._mps_per_radps = mps_per_radps
        self._command = [math.nan] * 6
        self._followers = [Follower(SPEED_MPS, SPEED_RATIO, STILL_S) for _ in range(3)]
        self._followers += [Follower(STEER_RAD) for _ in range(3)]
        self.off = np.zeros(6, dtype=np.bool_)

    def commanded(self, wheel_mps: Array, steer_rad: Array) -> None:
        """Take the commands (3,), (3,) that are in force from now on."""
        self._command = [*wheel_mps.tolist(), *steer_rad.tolist()]

    def measured(self, now_s: float, step_s: float, wheels: Reading | None, steer_rad: Array | None) -> None:
        """Compare the rates, first columns of the wheels, and steering angles (3,) with the commands."""
        unknown = [math.nan] * 3
        rates = unknown if wheels is None else wheels.values[-1, :3].tolist()
        angles = unknown if steer_rad is None else steer_rad.tolist()
        measured = [*(rate * self._mps_per_radps for rate in rates), *angles]
        for follower, command, value in zip(self._followers, self._command, measured, strict=True):
            follower.update(now_s, step_s, command, value)
        self.off = np.array([follower.is_off for follower in self._followers])
