r"""Steady motion of a body on omni wheels whose rollers do not turn freely.

Wheel i with the share :math:`n_i` of the weight drives along :math:`d_i` with the circumferential speed u_i
and is rolled across, along :math:`e_i`, with the speed of its centre :math:`p_i'`.  Traction grows with the
slip speed, roller friction with the speed across, both in proportion to the load and over one speed:

.. math:: F_i = n_i \left( c\,(u_i - d_i \cdot p_i')\,d_i - c\,\rho\,(e_i \cdot p_i')\,e_i \right)

so that slip does not depend on the speed, as measured runs show.  In steady motion forces and moment are in
balance, which is linear in the twist V: with the rows :math:`D_i = (d_i, p_i \times d_i)` and E_i alike,

.. math:: \sum_i n_i \left(D_i^T D_i + \rho\,E_i^T E_i\right) V = \sum_i n_i D_i^T u_i .

Without roller friction the wheels drive what they roll; with ever more of it the body stands.  A common
factor :math:`1 - \kappa` on V stands for an effective radius, or a scale of what measures V, that is off: it
slips alike in all directions, and no log of both distinguishes the two.

What is assumed: a contact that is linear in its slip, no other resistance, one rho for all wheels.
"""

from __future__ import annotations

import numpy as np

from terrain.kinematics.omni import rolling_matrix
from terrain.records import Array


def steady_twist(
    wheel_speed_mps: Array,
    positions_m: Array,
    direction_rad: Array,
    load_ratio: Array,
    roller_ratio: float,
    scale_error: float = 0.0,
) -> Array:
    """Return the twist (n, 3) of a body whose wheels turn at steady speeds (n, wheels).

    Parameters
    ----------
    wheel_speed_mps : (n, wheels) circumferential
    positions_m, direction_rad : (wheels, 2) and (wheels,) of the wheels
    load_ratio : (wheels,) shares of the weight, summing to 1
    roller_ratio : rho, friction of the rollers over the stiffness of traction; 0 is free
    scale_error : kappa

    Examples
    --------
    A wheel that rolls across entirely, and carries most of the weight, brakes the more:

    >>> from terrain.kinematics.omni import inverse, wheels_on_circle
    >>> place = wheels_on_circle(0.125, np.radians([60.0, 180.0, 300.0]))
    >>> ahead, left = (inverse(*place, np.array(v)) for v in ([0.1, 0, 0], [0, 0.1, 0]))
    >>> load = np.array([0.25, 0.5, 0.25])
    >>> steady_twist(np.array([ahead, left]), *place, load, 0.8)[:, :2].diagonal().round(4)
    array([0.0429, 0.0652])
    """
    along = rolling_matrix(positions_m, direction_rad)
    across = rolling_matrix(positions_m, np.asarray(direction_rad) + np.pi / 2)
    balance = (along * load_ratio[:, None]).T @ along
    balance = balance + roller_ratio * (across * load_ratio[:, None]).T @ across
    driven = np.asarray(wheel_speed_mps) @ (along * load_ratio[:, None])
    return np.asarray((1.0 - scale_error) * np.linalg.solve(balance, driven.T).T)
