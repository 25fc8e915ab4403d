"""Stability of the adaptive observer of tracked vehicles: Lyapunov function, excitation, disturbances.

Errors ``x = (e, n~)``, ``e = z - z^`` and ``n~ = n^ - n``, follow (10) of Tazzari et al. with signs of (8)::

    e' = -L e - M n~ + d_e        n~' = Lambda M' e + d_n

**Remark 1 as a number.**  With ``l_1 = l_2``, constant speeds and a constant turning rate Omega the system
does not depend on time in axes that turn with the body (the norm of x is the same there)::

    A = [ -L - Omega J    -M_b ]      J = [ 0 -1 0 ]
        [ Lambda M_b'       0  ]          [ 1  0 0 ]      M_b = M at theta = 0
                                          [ 0  0 0 ]

Of ``(A + b I)'P + P (A + b I) = -I`` with b below the slowest rate of A follows, for ``V = x'P x``,
``V' = -2 b V - |x|^2 + 2 x'P d``, and with the largest and smallest eigenvalue p and q of P and
``r = b + 1 / (2 p)``::

    |x(t)| <= sqrt(p / q) exp(-r t) |x(0)| + sqrt(p / q) / r sup |d|

b is chosen for the smallest factor of the disturbance.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from terrain.errors import ConfigError
from terrain.records import Array
from terrain.slip import MIN_SPEED_MPS


class ErrorBound(NamedTuple):
    """``|x(t)| <= overshoot exp(-rate t) |x(0)| + disturbance sup |d|``; metre, radian and ratio count alike.

    Parameters
    ----------
    overshoot_ratio : factor of the error at the start
    rate_ps : 1/s
    disturbance_s : factor of the largest disturbance
    """

    overshoot_ratio: float
    rate_ps: float
    disturbance_s: float


def regressor(yaw_rad: float, left_mps: float, right_mps: float, half_track_m: float) -> Array:
    """Return M (3, 2) of (8), columns left and right: rate of the pose per efficiency.

    Examples
    --------
    >>> regressor(0.0, 0.4, 0.6, 0.5)
    array([[ 0.2,  0.3],
           [ 0. ,  0. ],
           [-0.4,  0.6]])
    """
    cos, sin, half = 0.5 * math.cos(yaw_rad), 0.5 * math.sin(yaw_rad), 0.5 / half_track_m
    return np.asarray([[cos, cos], [sin, sin], [-half, half]] * np.array([left_mps, right_mps]))


def error_matrix(regressor_body: Array, gain_ps: Array, adaptation: Array, yaw_rate_radps: float) -> Array:
    """Return A (5, 5) in axes that turn with the body.

    Parameters
    ----------
    regressor_body : (3, 2) M_b
    gain_ps : (3,) diagonal of L, the first two equal
    adaptation : (2, 2) Lambda
    yaw_rate_radps : Omega

    Raises
    ------
    ConfigError
        if the gains along x and y differ: the system then depends on the heading.
    """
    if gain_ps[0] != gain_ps[1]:
        raise ConfigError(
            f"observation gains along x and y are {gain_ps[0]:g} and {gain_ps[1]:g}, equal ones are required"
        )
    a = np.zeros((5, 5))
    a[:3, :3] = -np.diag(gain_ps)
    a[0, 1], a[1, 0] = yaw_rate_radps, -yaw_rate_radps
    a[:3, 3:], a[3:, :3] = -regressor_body, adaptation @ regressor_body.T
    return a


def disturbance_bound(a: Array) -> ErrorBound:
    """Return Remark 1's bound for the error matrix A (5, 5).

    Raises
    ------
    ConfigError
        if A is not stable: a track stands, say.

    Examples
    --------
    >>> a = error_matrix(regressor(0.0, 0.6, 0.6, 0.5), np.ones(3), np.eye(2), 0.0)
    >>> bound = disturbance_bound(a)
    >>> [round(number, 2) for number in bound]
    [3.18, 0.13, 24.32]
    """
    slowest = -float(np.linalg.eigvals(a).real.max())
    if slowest <= 1e-12:
        raise ConfigError("the error system does not converge: a track stands, or a gain is zero")
    return min(
        (_bound_at(a, ratio * slowest) for ratio in np.arange(0.0, 0.96, 0.05)),
        key=lambda bound: bound.disturbance_s,
    )


def _bound_at(a: Array, rate_ps: float) -> ErrorBound:
    shifted = a + rate_ps * np.eye(len(a))
    eigenvalues = np.linalg.eigvalsh(solve_continuous_lyapunov(shifted.T, -np.eye(len(a))))
    overshoot = math.sqrt(eigenvalues[-1] / eigenvalues[0])
    rate = rate_ps + 0.5 / float(eigenvalues[-1])
    return ErrorBound(overshoot, float(rate), float(overshoot / rate))


def measured_efficiency(
    forward_mps: Any,
    yaw_rate_radps: Any,
    left_mps: Any,
    right_mps: Any,
    half_track_m: float,
    min_speed_mps: float = MIN_SPEED_MPS,
) -> Array:
    """Return the efficiency of the left and the right track, (..., 2), from speeds that are measured.

    (4) and (15): ``n_R = (V_G + d Omega) / v_R``, ``n_L = (V_G - d Omega) / v_L``; NaN of a track that is
    slower than ``min_speed_mps``.

    Parameters
    ----------
    forward_mps : speed over ground along the body, from satellites
    yaw_rate_radps : of a gyro
    left_mps, right_mps : circumferential speeds of the tracks
    half_track_m : d
    min_speed_mps : of a track

    Examples
    --------
    >>> measured_efficiency(0.46, 0.04, [0.4, 0.0], 0.6, half_track_m=0.5)
    array([[1.1, 0.8], [nan, 0.8]])
    """
    forward, turn, left, right = np.broadcast_arrays(
        *(np.asarray(v, float) for v in (forward_mps, yaw_rate_radps, left_mps, right_mps))
    )
    tracks = np.stack([left, right], axis=-1)
    ground = np.stack([forward - half_track_m * turn, forward + half_track_m * turn], axis=-1)
    efficiency = np.full(tracks.shape, np.nan)
    np.divide(ground, tracks, out=efficiency, where=np.abs(tracks) >= min_speed_mps)
    return efficiency
