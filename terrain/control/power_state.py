"""Whether a wheel is in traction, braking or rolling steadily, by the power that moves its share of the body.

(8.6) of Danzi, AgriMaRo thesis: ``Power_state = a v`` with acceleration and speed along the wheel, which is
W for each kg and has no need of a sign of its own: with and against the motion are positive and negative
whichever way the wheel rolls.
"""

from __future__ import annotations

import math

from numba import njit, types

TRACTION, BRAKING, STEADY = range(3)
"""Places of the states in ``slip_table.DRIVE_STATES``."""

UNKNOWN = -1
"""State of a wheel whose speed or acceleration is not known."""

POWER_THRESHOLD_WPKG = 0.1
"""Assumed, the thesis prints none: 0.1 m/s^2 at 1 m/s, which is what counts as a steady speed elsewhere
(``terrain.estimation.slip_figures.STEADY_CHANGE_MPS``), and over five times what an accelerometer's bias
makes of it."""


@njit(types.int64(types.float64, types.float64, types.float64), cache=True)
def power_state(accel_mps2: float, speed_mps: float, threshold_wpkg: float) -> int:
    """Return :data:`TRACTION`, :data:`BRAKING`, :data:`STEADY` (at the threshold too), or :data:`UNKNOWN`.

    Examples
    --------
    >>> [power_state(*wheel, 0.1) for wheel in ((1.0, 0.5), (-1.0, -0.5), (1.0, -0.5), (0.1, 1.0))]
    [0, 0, 1, 2]
    """
    power_wpkg = accel_mps2 * speed_mps
    if math.isnan(power_wpkg):
        return UNKNOWN
    if power_wpkg > threshold_wpkg:
        return TRACTION
    return BRAKING if power_wpkg < -threshold_wpkg else STEADY
