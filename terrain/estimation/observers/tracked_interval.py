"""The adaptive observer over the interval between two fixes, by the implicit midpoint rule.

With the efficiencies ``n = (n_L, n_R)``, pose z, error ``e = z - z^`` and the regressor ``z' = M n`` of a
tracked vehicle (Tazzari et al. (5); columns are left and right here)::

    M = [ cos(theta) v_L / 2     cos(theta) v_R / 2 ]
        [ sin(theta) v_L / 2     sin(theta) v_R / 2 ]
        [ -v_L / (2 d)           v_R / (2 d)        ]

the observer (8) is ``z^' = M n^ + L e``, ``n^' = Lambda M' e``.  Let W be the integral of M over the
interval, h its length, and dz the difference of the fixes; with ``e_m = (e_0 + e_1) / 2`` and ``n_m`` so::

    z^_1 = z^_0 + W n_m + h L e_m                      n^_1 = n^_0 + Lambda W' e_m
    A e_m = e_0 + (dz - W n^_0) / 2                    A = I + h L / 2 + W Lambda W' / 4

A is symmetric and at least I: the step exists for any gains and any interval.

**It never makes errors larger.**  With the true efficiency constant, ``dz = W n``, and ``n~ = n^ - n``::

    e_1 - e_0 = -W n~_m - h L e_m                      n~_1 - n~_0 = Lambda W' e_m
    V = (e'e + n~' Lambda^-1 n~) / 2
    V_1 - V_0 = e_m'(e_1 - e_0) + n~_m' Lambda^-1 (n~_1 - n~_0)
              = -e_m' W n~_m - h e_m' L e_m + n~_m' W' e_m  =  -h e_m' L e_m  <=  0

exactly, as a quadratic form changes by its gradient at the midpoint; no step size enters.  V is corrected:
the paper's, above (13), has ``e' L^-1 e``, whose cross terms cancel for L = I only.  A projection of n^ onto
limits that contain n lowers V further where Lambda is diagonal.  Where Lambda changes from interval to
interval (normalised gain), V is that of the interval.

Errors ``x = (z_true - z^, n - n^)`` with noise w of a fix, interpolated as the fixes are, follow
``x_1 = F x_0 + G w_m``::

    F = [ 2 A^-1 - I          A^-1 W                        ]      G = [ -2 (I - A^-1)        ]
        [ -Lambda W' A^-1     I - Lambda W' A^-1 W / 2      ]          [ -Lambda W' A^-1      ]

Where h L is large, the interval is cut into equal parts with the same mean regressor: V falls in each.
"""

from __future__ import annotations

import math

import numpy as np

from terrain.kernels import njit
from terrain.records import Array

PART = 0.25
"""Largest product of a part's length and a rate of the error system: the rule is then right to 0.5 %."""

MAX_PARTS = 64


@njit
def inverse_3(a: Array) -> Array:
    """Return the inverse of a symmetric positive definite matrix (3, 3), by its cofactors."""
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    c11 = a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2]
    c12 = a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]
    c22 = a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]
    det = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    inverse: Array = np.array([[c00, c01, c02], [c01, c11, c12], [c02, c12, c22]]) / det
    return inverse


@njit
def normalised_gain(travel: Array, span_s: float, gain_ps: Array, least: float) -> Array:
    """Return the adaptation gain (2, 2) that damps the error system critically at every speed.

    ``Lambda = (M' L^-2 M + r I)^-1 / 4`` with the mean regressor ``M = W / h``: for ``L = l I`` this is
    ``(l^2 / 4) (M'M)^-1``, and position and heading with gains of their own are both critically damped.

    Parameters
    ----------
    travel : (3, 2) W
    span_s : h
    gain_ps : (3,) diagonal of L
    least : r, which keeps the gain finite where a track stands

    Examples
    --------
    >>> travel = np.array([[0.03, 0.03], [0.0, 0.0], [-0.06, 0.06]])
    >>> normalised_gain(travel, 0.1, np.array([2.0, 2.0, 2.0]), 0.0).round(3)
    array([[3.472, 2.083], [2.083, 3.472]])
    """
    m = travel / span_s
    a = b = c = 0.0
    for i in range(3):
        weight = 1.0 / (gain_ps[i] * gain_ps[i])
        a += weight * m[i, 0] * m[i, 0]
        b += weight * m[i, 0] * m[i, 1]
        c += weight * m[i, 1] * m[i, 1]
    a, c = a + least, c + least
    gain: Array = 0.25 / (a * c - b * b) * np.array([[c, -b], [-b, a]])
    return gain


@njit
def n_parts(travel: Array, span_s: float, gain_ps: Array, adaptation: Array) -> int:
    """Return into how many parts an interval is cut."""
    coupling = 0.0
    for i in range(3):
        for j in range(2):
            for k in range(2):
                coupling += travel[i, j] * adaptation[j, k] * travel[i, k]
    fastest = max(span_s * float(gain_ps.max()), math.sqrt(max(coupling, 0.0)))
    return max(1, min(MAX_PARTS, math.ceil(fastest / PART - 1e-9)))


@njit
def observe_interval(
    travel: Array,
    span_s: float,
    gain_ps: Array,
    adaptation: Array,
    error: Array,
    eta: Array,
    moved: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the errors and efficiencies at the end of an interval, and how their errors propagate.

    Parameters
    ----------
    travel : (3, 2) W, of the left and the right track
    span_s : h
    gain_ps : (3,) diagonal of L
    adaptation : (2, 2) Lambda
    error : (3,) e at the start, measured pose less estimated
    eta : (2,) efficiencies of the left and the right track at the start
    moved : (3,) dz

    Returns
    -------
    error : (3,) at the end
    eta : (2,) at the end
    errors_map : (5, 5) F
    start_map, end_map : (5, 3) how the noise of the fix at the start, and of that at the end, enters

    Examples
    --------
    >>> travel = np.array([[0.03, 0.03], [0.0, 0.0], [-0.06, 0.06]])  # 0.6 m/s for 0.1 s, d = 0.5 m
    >>> moved = travel @ np.array([0.8, 0.8])
    >>> error, eta, *_ = observe_interval(travel, 0.1, np.ones(3), np.eye(2), np.zeros(3), np.ones(2), moved)
    >>> error.round(4), eta.round(5)
    (array([-0.0114,  0.    ,  0.    ]), array([0.99983, 0.99983]))
    """
    n = n_parts(travel, span_s, gain_ps, adaptation)
    w, h, dz = travel / n, span_s / n, moved / n
    k = adaptation @ w.T
    a = 0.25 * (w @ k)
    for i in range(3):
        a[i, i] += 1.0 + 0.5 * h * gain_ps[i]
    inverse = inverse_3(a)
    part_map, noise_map = np.zeros((5, 5)), np.zeros((5, 3))
    gain, ahead = k @ inverse, inverse @ w
    part_map[:3, :3], part_map[:3, 3:] = 2.0 * inverse, ahead
    part_map[3:, :3], part_map[3:, 3:] = -gain, -0.5 * (gain @ w)
    noise_map[:3, :], noise_map[3:, :] = 2.0 * inverse, -gain
    for i in range(3):
        part_map[i, i] -= 1.0
        noise_map[i, i] -= 2.0
    part_map[3, 3] += 1.0
    part_map[4, 4] += 1.0
    whole, from_start, from_end = np.eye(5), np.zeros((5, 3)), np.zeros((5, 3))
    for j in range(n):
        middle = inverse @ (error + 0.5 * (dz - w @ eta))
        error = 2.0 * middle - error
        eta = eta + k @ middle
        later = (j + 0.5) / n
        from_start = part_map @ from_start + (1.0 - later) * noise_map
        from_end = part_map @ from_end + later * noise_map
        whole = part_map @ whole
    return error, eta, whole, from_start, from_end
