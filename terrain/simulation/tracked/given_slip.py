r"""Slip that is given in place of a soil: what papers assume, with numbers that an estimator has to find.

With the belts' speeds :math:`v_l, v_r`, the grade g along the motion and the roll h,

.. math::
    \alpha &= a_0 + a_1 g, \qquad v_i' = \eta_i (1 - \alpha)\, v_i, \\
    D &= k\,(v_r' - v_l'), \qquad u_r = D\,\frac{a}{a + b}, \quad u_l = -D\,\frac{b}{a + b}, \\
    V_x &= \tfrac12 (v_r' - u_r + v_l' - u_l), \quad
    w = \frac{v_r' - v_l' - D}{2 d}, \quad V_y = -|V_x|\, c\, h,

with :math:`a = |v_r'|^{1-n}`, :math:`b = |v_l'|^{1-n}` for :math:`n \le 1` and
:math:`a = |v_l'|^{n-1}, b = |v_r'|^{n-1}` beyond: Tazzari (5), Yamauchi (22) and (26), and Endo's law
(Yamauchi (27)) written without its singular points.  k is how much of the difference is lost in turning.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit

from terrain.records import Array


class GivenSlip(NamedTuple):
    """Slip of the two tracks; none by default.

    Parameters
    ----------
    eta_left_ratio, eta_right_ratio : ground speed over belt speed
    slip_ratio : a_0, of straight motion on the level, positive in traction
    grade_slip_ratio : a_1, a rad of grade along the motion
    side_slip_ratio : c, slip angle a rad of roll
    turning_loss_ratio : k
    turning_exponent : n of Endo's law
    """

    eta_left_ratio: float = 1.0
    eta_right_ratio: float = 1.0
    slip_ratio: float = 0.0
    grade_slip_ratio: float = 0.0
    side_slip_ratio: float = 0.0
    turning_loss_ratio: float = 0.0
    turning_exponent: float = 1.0


@njit(cache=True)
def slipped_twist(
    given: Array, half_track_m: float, left_mps: float, right_mps: float, grade_rad: float, roll_rad: float
) -> tuple[float, float, float]:
    """Return V_x, V_y and w.

    Parameters
    ----------
    given : the numbers of a :class:`GivenSlip` in their order
    half_track_m : d
    left_mps, right_mps : speeds of the belts
    grade_rad, roll_rad : of the body, uphill and left side up positive

    Examples
    --------
    >>> import numpy as np
    >>> slipped_twist(np.array(GivenSlip(0.9, 0.9)), 0.5, 1.0, 1.0, 0.0, 0.0)
    (0.9, -0.0, 0.0)
    """
    ahead = left_mps + right_mps
    along = grade_rad * (1.0 if ahead > 0.0 else -1.0 if ahead < 0.0 else 0.0)
    kept = 1.0 - given[2] - given[3] * along
    left, right = given[0] * kept * left_mps, given[1] * kept * right_mps
    lost, power = given[5] * (right - left), given[6]
    if power <= 1.0:
        a, b = math.pow(abs(right), 1.0 - power), math.pow(abs(left), 1.0 - power)
    else:
        a, b = math.pow(abs(left), power - 1.0), math.pow(abs(right), power - 1.0)
    share = a / (a + b) if a + b > 0.0 else 0.5
    left, right = left + lost * (1.0 - share), right - lost * share
    v_x = 0.5 * (left + right)
    return v_x, -abs(v_x) * given[4] * roll_rad, (right - left) / (2.0 * half_track_m)
