r"""Motion over a step at a constant twist: an arc, without error however far the body turns in it.

.. math::
    \begin{pmatrix} \Delta x \\ \Delta y \end{pmatrix} = \Delta t\, R(\theta + \tfrac{\varphi}{2})\,
    \frac{\sin(\varphi / 2)}{\varphi / 2} \begin{pmatrix} V_x \\ V_y \end{pmatrix}, \qquad
    \varphi = w \Delta t
"""

from __future__ import annotations

import math

from terrain.kernels import njit

_SMALL_RAD = 1e-4  # of half an angle: the series is exact to rounding below


@njit
def arc_displacement(
    yaw_rad: float, velocity_x_mps: float, velocity_y_mps: float, yaw_rate_radps: float, dt_s: float
) -> tuple[float, float]:
    """Return by how much a body moves along x and y of the fixed frame, in m.

    Examples
    --------
    >>> [round(moved, 6) for moved in arc_displacement(0.0, math.pi / 2, 0.0, math.pi / 2, 1.0)]
    [1.0, 1.0]
    """
    half = 0.5 * yaw_rate_radps * dt_s
    chord = 1.0 - half * half / 6.0 if abs(half) < _SMALL_RAD else math.sin(half) / half
    cos, sin = math.cos(yaw_rad + half) * chord * dt_s, math.sin(yaw_rad + half) * chord * dt_s
    return cos * velocity_x_mps - sin * velocity_y_mps, sin * velocity_x_mps + cos * velocity_y_mps
