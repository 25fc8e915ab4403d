"""Which twists of a swerve robot saturate no motor: ``|p_i'| <= r w_max`` of every wheel, (2.6)-(2.10).

The admissible region is convex, but no polyhedron: each wheel bounds it by a cylinder.

Source: Danzi, AgriMaRo thesis, 2.3.  Corrected: (2.6)-(2.9) have ``y' + x_i g'`` and ``x' - y_i g'`` with
each wheel's own position.
"""

from __future__ import annotations

import numpy as np

from terrain.kinematics.arguments import above_zero, broadcast, finite_numbers, wheel_positions
from terrain.kinematics.swerve import wheel_velocities
from terrain.records import Array


def admissible_scale(positions_m: Array, radius_m: float, twist: Array, speed_max_radps: float) -> Array:
    """Return the largest k (...), at most 1, with which ``k * twist`` saturates no wheel, (2.10).

    Raises
    ------
    ConfigError
        as :func:`inverse` does, and for a limit that is not above zero.

    Examples
    --------
    >>> admissible_scale([[-0.5, 0.0], [0.5, 0.0]], 0.2, [[4.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 10.0)
    array([0.5, 1. ])
    """
    limit_mps = above_zero("radius_m", radius_m) * above_zero("speed_max_radps", speed_max_radps)
    velocity = wheel_velocities(positions_m, twist)
    fastest_mps = np.hypot(velocity[..., 0], velocity[..., 1]).max(axis=-1)
    return np.asarray(limit_mps / np.maximum(fastest_mps, limit_mps))


def scaled(positions_m: Array, radius_m: float, twist: Array, speed_max_radps: float) -> Array:
    """Return the twist (..., 3) in its own direction, shortened until no wheel saturates.

    The direction is kept, so the centre of rotation and the path are: the robot is slower on the same curve.

    Raises
    ------
    ConfigError
        as :func:`admissible_scale` does.

    Examples
    --------
    >>> scaled([[-0.5, 0.0], [0.5, 0.0]], 0.2, [2.4, 0.0, 3.6], 10.0)
    array([1.6, 0. , 2.4])
    """
    scale = admissible_scale(positions_m, radius_m, twist, speed_max_radps)
    return np.asarray(np.asarray(twist, dtype=np.float64) * scale[..., None])


def admissible_yaw_rate(
    positions_m: Array, radius_m: float, speed_x_mps: Array, speed_y_mps: Array, speed_max_radps: float
) -> tuple[Array, Array]:
    """Return the lowest and the highest yaw rate (...) that saturate no wheel at a given translation.

    The boundary of the admissible region: with v_max = r w_max, (2.6) corrected asks of every wheel
    ``(x_i^2 + y_i^2) g'^2 + 2 (x_i v_y - y_i v_x) g' + v_x^2 + v_y^2 - v_max^2 <= 0``, an interval of g'.
    Figure 2.8 and its dimensionless twist (2.11) come of positions in half wheelbases, radius and limit 1.

    Parameters
    ----------
    positions_m : (wheels, 2)
    radius_m : of the wheels
    speed_x_mps, speed_y_mps : (...) broadcast against each other
    speed_max_radps : limit of the wheels

    Returns
    -------
    low_radps, high_radps : (...); NaN where no yaw rate is admissible

    Raises
    ------
    ConfigError
        for shapes that do not fit, values that are not finite, a radius or limit that is not above zero.

    Examples
    --------
    >>> xi = 1.5  # track over half the wheelbase
    >>> admissible_yaw_rate([[-1, 0], [1, 0], [0, -xi]], 1.0, [0.0, 0.7], 0.0, 1.0)
    (array([-0.66666667, -0.71414284]), array([0.66666667, 0.2       ]))
    """
    positions = wheel_positions(positions_m)
    limit_mps = above_zero("radius_m", radius_m) * above_zero("speed_max_radps", speed_max_radps)
    x_mps, y_mps = broadcast(
        speed_x_mps=finite_numbers("speed_x_mps", speed_x_mps),
        speed_y_mps=finite_numbers("speed_y_mps", speed_y_mps),
    )
    x, y = positions.T
    square = x * x + y * y
    across = x * y_mps[..., None] - y * x_mps[..., None]
    away = x * x_mps[..., None] + y * y_mps[..., None]
    # across^2 + away^2 = square * speed^2 turns the discriminant into one that cancels nothing
    inside = square * limit_mps**2 - away**2
    # a wheel at the origin does not feel the yaw rate: it bounds the translation alone
    free = np.where(np.hypot(x_mps, y_mps) <= limit_mps, np.inf, np.nan)[..., None]
    root = np.sqrt(np.where(inside >= 0, inside, np.nan))
    pivot = np.where(square > 0, square, 1.0)
    low = np.where(square > 0, (-across - root) / pivot, -free).max(axis=-1)
    high = np.where(square > 0, (-across + root) / pivot, free).min(axis=-1)
    return np.where(low <= high, low, np.nan), np.where(low <= high, high, np.nan)
