"""What a testbed adds to the traction of its side force, by symmetry.

A locked wheel that is dragged along its axle looks the same from ahead and from behind: its traction is 0.
What is measured there is the instrument's, as of a mount that bends under the side force::

    Fx_measured = Fx + x Fy,   x = sum(Fx_measured Fy) / sum(Fy^2) over such trials
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.records import Array
from terrain.soil_identification.trials import Trials

MIN_ANGLE_DEG, MAX_SLIP = 89.0, -0.99
MIN_TRIALS = 2


class Coupling(NamedTuple):
    """Part of the side force that is measured as traction; its scatter over trials, and their number.

    ``ratio`` and ``std_ratio`` are NaN without :data:`MIN_TRIALS` trials of a locked wheel along its axle.
    """

    ratio: float
    std_ratio: float
    n_trials: int

    @property
    def text(self) -> str:
        """By how much the measured traction is corrected, or that it is not, in words."""
        if math.isnan(self.ratio):
            return "traction as measured, no trials of a locked wheel along its axle"
        return (
            f"traction less {self.ratio:.3f} ± {self.std_ratio:.3f} of the side force, what {self.n_trials} trials "
            "of a locked wheel along its axle show"
        )


def calibration_rows(trials: Trials) -> Array:
    """Return which trials (n,) are of a locked wheel that is dragged along its axle."""
    return (np.abs(trials.angle_setting) > MIN_ANGLE_DEG) & (trials.slip_ratio < MAX_SLIP)


def side_coupling(trials: Trials) -> Coupling:
    """Return the coupling that the trials of a locked wheel along its axle show.

    Parameters
    ----------
    trials : single ones
    """
    own = trials.chosen(calibration_rows(trials))
    if len(own) < MIN_TRIALS:
        return Coupling(np.nan, np.nan, len(own))
    ratio = float((own.pull_n * own.side_n).sum() / (own.side_n**2).sum())
    return Coupling(ratio, float(np.std(own.pull_n / own.side_n, ddof=1)), len(own))


def without_coupling(trials: Trials, coupling: Coupling) -> Trials:
    """Return trials with their traction corrected, less those that the coupling was found from.

    Without a coupling they are returned as they are.

    Parameters
    ----------
    trials : single ones, of the same testbed
    coupling : of the testbed
    """
    if np.isnan(coupling.ratio):
        return trials
    corrected = replace(trials, pull_n=trials.pull_n - coupling.ratio * trials.side_n)
    return corrected.chosen(~calibration_rows(trials))
