"""Drive state of a wheel (traction, braking or steady) from the power per mass that accelerates the body.

(8.6) of Danzi, AgriMaRo thesis: ``Power_state = a v`` with acceleration a and speed v along the wheel, in
W/kg.  The product is positive while the wheel speeds up and negative while it slows down, in either direction
of rolling.
"""

from __future__ import annotations

import math

from numba import njit, types

from terrain.status import StatusCode


class DriveState(StatusCode):
    """Drive state of a wheel or of the robot; from 0 on, its place in ``slip_table.DRIVE_STATES``.

    ``UNKNOWN`` is that of a wheel whose speed or acceleration is not known.
    """

    UNKNOWN = -1
    TRACTION = 0
    BRAKING = 1
    STEADY = 2


POWER_THRESHOLD_WPKG = 0.1
"""Assumed, as the thesis specifies none: 0.1 m/s^2 at 1 m/s, the threshold of a steady speed elsewhere
(``terrain.estimation.slip_figures.STEADY_CHANGE_MPS``), and more than five times the effect of an
accelerometer's bias."""


@njit(types.int64(types.float64, types.float64, types.float64), cache=True)
def power_state(accel_mps2: float, speed_mps: float, threshold_wpkg: float) -> int:
    """Return the number of the :class:`DriveState` of a wheel; at the threshold it is steady.

    Examples
    --------
    >>> [power_state(*wheel, 0.1) for wheel in ((1.0, 0.5), (-1.0, -0.5), (1.0, -0.5), (0.1, 1.0))]
    [0, 0, 1, 2]
    """
    power_wpkg = accel_mps2 * speed_mps
    if math.isnan(power_wpkg):
        return DriveState.UNKNOWN.value
    if power_wpkg > threshold_wpkg:
        return DriveState.TRACTION.value
    return DriveState.BRAKING.value if power_wpkg < -threshold_wpkg else DriveState.STEADY.value
