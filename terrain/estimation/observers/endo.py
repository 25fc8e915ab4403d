r"""Endo's law: how two tracks share the slip of a turn (Yamauchi et al. (27), of Endo et al. 2007).

With the speeds v of the tracks, their slip speeds :math:`u = v \alpha` (what a track moves faster than the
ground under it), half the distance d of the tracks and the yaw rate w, (7) and (27) are

.. math::
    u_r - u_l = D = v_r - v_l - 2 d w, \qquad
    \alpha_l / \alpha_r = -\mathrm{sgn}(v_r v_l) |v_r / v_l|^n .

**Corrected**: (27) is singular where a track stops.  Written in slip speeds the signs cancel, and

.. math::
    u_r = D \frac{a}{a + b}, \quad u_l = -D \frac{b}{a + b}, \qquad
    a = |v_r|^{1 - n},\; b = |v_l|^{1 - n} \;(n \le 1), \quad
    a = |v_l|^{n - 1},\; b = |v_r|^{n - 1} \;(n > 1),

regular for all speeds that are not both 0.  The speed of the body needs only

.. math::
    V_x = \frac{v_r + v_l}{2} - \frac{D}{2} \kappa, \qquad
    \kappa = \frac{a - b}{a + b} = \tanh\left(\frac{1 - n}{2} \ln \left|\frac{v_r}{v_l}\right|\right),

which is one expression for all n, and bounded; its derivative by n is
:math:`-\frac{1}{2} \ln|v_r / v_l| (1 - \kappa^2)`.
"""

from __future__ import annotations

import math

from terrain.kernels import njit


@njit
def slip_imbalance(speed_left_mps: float, speed_right_mps: float, exponent: float) -> tuple[float, float]:
    """Return kappa, the right track's part of the slip less the left one's, and its derivative by n.

    It is within [-1, 1]: 1 where the left track stands and n < 1, so that the right one takes all of the
    slip; 0 for n = 1 and for equal speeds, stopped tracks included.

    Examples
    --------
    >>> slip_imbalance(0.0, 0.1, 0.85)[0], slip_imbalance(0.1, 0.0, 0.85)[0], slip_imbalance(0.0, 0.1, 1.0)[0]
    (1.0, -1.0, 0.0)
    >>> round(slip_imbalance(0.05, 0.1, 0.85)[0], 4)
    0.0519
    """
    left, right = abs(speed_left_mps), abs(speed_right_mps)
    if left == right:
        return 0.0, 0.0
    if left == 0.0 or right == 0.0:  # the limit, which has no slope: one track takes all of it
        return (0.0 if exponent == 1.0 else math.copysign(1.0, (1.0 - exponent) * (right - left))), 0.0
    log = math.log(right) - math.log(left)
    kappa = math.tanh(0.5 * (1.0 - exponent) * log)
    return kappa, -0.5 * log * (1.0 - kappa * kappa)


@njit
def endo_slip_speeds(
    speed_left_mps: float, speed_right_mps: float, yaw_rate_radps: float, half_track_m: float, exponent: float
) -> tuple[float, float]:
    """Return the slip speeds u_l and u_r of the tracks in m/s; 0 where both stand.

    Parameters
    ----------
    speed_left_mps, speed_right_mps : of the belts
    yaw_rate_radps : of the body
    half_track_m : d
    exponent : n, 0 or above

    Notes
    -----
    (27), in the form without its singular points.  A robot that turns on standing tracks is pushed: the law
    does not hold, and no slip is returned.

    Examples
    --------
    >>> [round(u, 4) for u in endo_slip_speeds(-0.02, 0.12, 0.25, 0.2, 0.85)]
    [-0.0173, 0.0227]
    """
    if speed_left_mps == 0.0 and speed_right_mps == 0.0:
        return 0.0, 0.0
    kappa = slip_imbalance(speed_left_mps, speed_right_mps, exponent)[0]
    difference = speed_right_mps - speed_left_mps - 2.0 * half_track_m * yaw_rate_radps
    return -0.5 * difference * (1.0 - kappa), 0.5 * difference * (1.0 + kappa)
