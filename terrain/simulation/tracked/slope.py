"""An even slope: grade, roll and pull of gravity of a body that stands on it at a heading.

Positions and headings are those in the plane of the slope.  With its angle s and the heading q of uphill, a
body at the heading h has ``sin(grade) = sin s cos(h - q)``, uphill positive, and, as ZYX angles,
``sin(roll) = -sin s sin(h - q) / cos(grade)``, left side up positive; then ``cos(roll) cos(grade) = cos s``,
Yamauchi (29).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit


class Slope(NamedTuple):
    """An even slope, level by default.

    Parameters
    ----------
    angle_rad : against the horizontal
    uphill_rad : heading of uphill in the plane of the slope
    """

    angle_rad: float = 0.0
    uphill_rad: float = 0.0


LEVEL = Slope()
"""No slope."""


@njit(cache=True)
def tilt_at(angle_rad: float, uphill_rad: float, yaw_rad: float) -> tuple[float, float]:
    """Return grade and roll of a body on a slope.

    Examples
    --------
    >>> grade, roll = tilt_at(0.2, 0.0, 0.0)
    >>> round(grade, 6), abs(round(roll, 6))
    (0.2, 0.0)
    >>> grade, roll = tilt_at(0.2, math.pi / 2, 0.0)  # uphill is to the left: the left side is up
    >>> abs(round(grade, 6)), round(roll, 6)
    (0.0, 0.2)
    """
    grade = math.asin(math.sin(angle_rad) * math.cos(yaw_rad - uphill_rad))
    side = -math.sin(angle_rad) * math.sin(yaw_rad - uphill_rad) / math.cos(grade)
    return grade, math.asin(min(max(side, -1.0), 1.0))
