"""Signs of motor currents: of the torque, as this package has them, of the power, or none.

A current of this package is positive where its torque drives the robot forward.  Motor drivers log that, or a
magnitude, or a current that is positive where it drives the wheel in either direction and negative where the
wheel is braked: the sign of the power.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from terrain.records import Array

MIN_MOVING_RADPS = 0.05
"""Slower wheels stand."""

MIN_CURRENT_A = 1.0
"""Smaller currents show no sign."""

SENSE_S = 0.5
"""A wheel that stands turns, if at all, as it does within so long of that: it starts, or has just stopped."""

NO_SIGN = "currents without a sign"
POWER_SIGN = "currents turned from the sign of the power"


def current_sign(current_a: Array, speed_radps: Array) -> str:
    """Return how a current is signed, where not by direction: as a magnitude, or as the power; else empty.

    Parameters
    ----------
    current_a : (n, sides) motor currents
    speed_radps : (n, sides) of their wheels

    Examples
    --------
    >>> speed = np.array([[1.0], [1.0], [-1.0], [-1.0]])
    >>> current_sign(np.array([[5.0], [4.0], [5.0], [6.0]]), speed)
    'currents without a sign'
    >>> current_sign(np.array([[5.0], [-4.0], [5.0], [6.0]]), speed)
    'currents turned from the sign of the power'
    >>> current_sign(np.array([[5.0], [4.0], [-5.0], [-6.0]]), speed)
    ''
    """
    backward = (speed_radps <= -MIN_MOVING_RADPS) & (np.abs(current_a) >= MIN_CURRENT_A)
    if not (current_a <= -MIN_CURRENT_A).any():
        return NO_SIGN
    return POWER_SIGN if backward.any() and np.mean(current_a[backward] > 0) > 0.5 else ""


def with_sign_of_torque(current_a: Array, speed_radps: Array, period_s: float) -> Array:
    """Return a held current (n,) that has the sign of the power, with that of the torque instead.

    NaN where the current is of a wheel that stands for longer: what it pushes against is not to be seen.

    Examples
    --------
    >>> with_sign_of_torque(np.array([5.0, 5.0, -2.0, 6.0]), np.array([1.0, 1.0, 1.0, -1.0]), 0.05).tolist()
    [5.0, 5.0, -2.0, -6.0]
    """
    sense = np.where(np.abs(speed_radps) >= MIN_MOVING_RADPS, np.sign(speed_radps), 0.0)
    width = 2 * round(SENSE_S / period_s) + 1
    most, least = maximum_filter1d(speed_radps, width), minimum_filter1d(speed_radps, width)
    fastest = np.where(most > -least, most, least)
    nearby = np.where(np.abs(fastest) >= MIN_MOVING_RADPS, np.sign(fastest), np.nan)
    sense = np.where(sense == 0.0, nearby, sense)
    sense = np.where(np.isnan(sense) & (np.abs(current_a) < MIN_CURRENT_A), 1.0, sense)
    new = np.maximum.accumulate(
        np.where(np.diff(current_a, prepend=np.nan) != 0.0, np.arange(current_a.size), 0)
    )
    return np.asarray(current_a * sense[new])
