"""Slip of a tracked robot in straight motion: the line (22) over the grade, and the slope (26) over the roll.

``1 - V_x / v`` is linear in the grade along the motion, with the compaction as its intercept, and ``V_y /
|V_x|`` is minus the roll times a constant.  **Corrected** against Yamauchi et al.: uphill is positive, grade
= -pitch in body frames, and gravity keeps its sign in reverse.
"""

from __future__ import annotations

import numpy as np

from terrain.calibration.clustered_fit import LinearFit, fit_runs
from terrain.calibration.track_motion import SlipSamples

LINE = ("compaction_slip_ratio", "grade_slip_ratio")


def fit_straight_slip(samples: SlipSamples) -> LinearFit:
    """Fit the slip ratio of straight motion over the grade.

    Parameters
    ----------
    samples : of straight motion, up or down several slopes

    Raises
    ------
    DataError
        if there are too few runs, or all are on one slope.
    """
    speed = 0.5 * (samples.left_mps + samples.right_mps)
    grade = -np.sign(speed) * samples.pitch_rad
    x = np.column_stack([np.ones(len(grade)), grade])
    return fit_runs(x, 1.0 - samples.forward_mps / speed, samples.run, LINE)


def fit_side_slip(samples: SlipSamples) -> LinearFit:
    """Fit the tangent of the slip angle of straight motion over the roll; there is none on the level.

    Parameters
    ----------
    samples : of straight motion, across several slopes

    Raises
    ------
    DataError
        if there are too few runs, or none has a roll.
    """
    tangent = samples.lateral_mps / np.abs(samples.forward_mps)
    return fit_runs(-samples.roll_rad[:, None], tangent, samples.run, ("side_slip_ratio",))
