"""The definition of slip: the ratio and the angle of a wheel.

With the wheel circumferential speed ``w r`` and the speed v of the wheel's centre along the wheel (Danzi,
AgriMaRo thesis, (7.3) to (7.7))::

    v = (v_x - g' y_i) cos d_i + (v_y + g' x_i) sin d_i
    s = (w r - v) / max(|w r|, |v|)

Of a wheel with rollers the ground holds the component along the axis of the roller that touches it alone, at an angle
g from d_i: what slides is ``w r cos g`` less the velocity v_g of the centre along that axis; across it the roller turns
freely.  So v is ``v_g / cos g``, the speed at which the wheel would roll without slip
(:func:`terrain.kinematics.wheels.rolling_matrix`), and s the same along the axis.  Along the wheel a mecanum robot that
drives sideways without slip would slip by 1.  Simulated truth, filters, windows and curves have this slip alike.

(7.1) and (7.2), the two regimes of the SAE, are this for v > 0 only; the larger absolute value is safe
everywhere.  The sign of s is that of the slip speed **along the wheel's own x axis**: positive in traction
and negative in braking where the wheel rolls forward, and the reverse where it rolls backward, be it that the
robot backs or that its steering stands beyond 90 degrees.  ``s * sign(v)`` is positive in traction for both
rolling directions.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from terrain.errors import ConfigError
from terrain.records import Array

#: With wheel speed and ground speed both lower the slip is noise over noise (thesis 7.2.1).
MIN_SPEED_MPS = 0.05


def slip_ratio(
    wheel_speed_mps: Any,
    ground_speed_mps: Any,
    min_speed_mps: float = MIN_SPEED_MPS,
    stationary: float = float("nan"),
) -> Array:
    """Return the slip ratio, positive in traction of a wheel that rolls forward; within [-1, 1].

    Parameters
    ----------
    wheel_speed_mps, ground_speed_mps : of a wheel's circumference, and its centre along it; they broadcast
    min_speed_mps : with both slower the wheel is stationary
    stationary : slip of a stationary wheel: NaN in analysis, where it has none; 0 for a controller (7.2.1)

    Raises
    ------
    ConfigError
        if the least speed is not above zero.

    Notes
    -----
    (7.7), clipped: a wheel that turns against its travel would have up to 2.  Where one speed is unknown
    the slip is NaN, stationary or not.

    Examples
    --------
    >>> slip_ratio([1.0, 0.8, -1.0, 1.0, 0.01], [0.8, 1.0, -0.8, -0.5, 0.0])
    array([ 0.2, -0.2, -0.2,  1. ,  nan])
    """
    if not 0 < min_speed_mps < np.inf:
        raise ConfigError(f"min_speed_mps is {min_speed_mps:g}, a speed above zero is required")
    speeds = np.asarray(wheel_speed_mps, float), np.asarray(ground_speed_mps, float)
    wheel_speed, ground = np.broadcast_arrays(*speeds)
    fastest = np.maximum(np.abs(wheel_speed), np.abs(ground))
    known = np.isfinite(fastest)
    slip = np.where(known & (fastest < min_speed_mps), stationary, np.nan)
    moving = known & (fastest >= min_speed_mps)
    np.divide(wheel_speed - ground, fastest, out=slip, where=moving)
    return np.clip(slip, -1.0, 1.0)


def traction_slip(slip_ratio: Array, wheel_radps: Array) -> Array:
    """Return slip that is positive in traction in both directions, from slip signed along the wheel.

    The sign is that of the speed over ground: the sign of the wheel's rate, but opposite where the magnitude
    of slip is above 1, as the wheel then turns against the motion; a locked wheel only brakes.

    Examples
    --------
    >>> traction_slip(np.array([0.2, -0.2, -1.1, 1.0]), np.array([5.0, -5.0, -1.0, 0.0]))
    array([ 0.2,  0.2, -1.1, -1. ])
    """
    direction = np.where(np.abs(slip_ratio) > 1.0, -np.sign(wheel_radps), np.sign(wheel_radps))
    return np.asarray(slip_ratio * np.where(wheel_radps == 0.0, -np.sign(slip_ratio), direction))


def slip_angle(forward_mps: Any, left_mps: Any, min_speed_mps: float = MIN_SPEED_MPS) -> Array:
    """Return the angle in rad from a wheel's plane to where its centre goes; positive to the wheel's left.

    Parameters
    ----------
    forward_mps, left_mps : velocity of the wheel's centre in the wheel's axes, arrays that broadcast
    min_speed_mps : NaN when the centre is slower

    Notes
    -----
    ``atan2(v_y, |v_x|)``: within a quarter turn; the side force opposes it for both rolling directions.

    Examples
    --------
    >>> slip_angle([1.0, -1.0, 0.0], [0.1, 0.1, -0.02]).round(4)
    array([0.0997, 0.0997,    nan])
    """
    forward, left = np.broadcast_arrays(np.asarray(forward_mps, float), np.asarray(left_mps, float))
    moving = np.hypot(forward, left) >= min_speed_mps
    return np.where(moving, np.arctan2(left, np.abs(forward)), np.nan)
