r"""Distance of an omni robot's wheels from its middle, by how it turns against what its wheels roll.

Wheels at the distance d that roll :math:`\varphi_i` without slip turn the body by
:math:`\psi = \sum_i r \varphi_i / (3 d)`.  Over runs on one surface the slope of the turn measured from
outside over that of the described distance is :math:`(1 - s)\,d_0 / d`, with the slip s of turning, which a
robot that is commanded not to turn hardly shows.  Where s is not known, :math:`d_0` over the slope is the
distance of wheels that turn the body without slip: an upper bound, but for what else turns it.  Intervals are
those of draws of runs; how far surfaces differ says what else there is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_rows, percentile_interval
from terrain.measured_slip.slips import MeasuredSlip
from terrain.robots.omni import OmniRobot

MIN_CORRELATION = 0.8
"""Of the turns of runs; below, something else turns the robot, as sliding over soft ground."""

N_DRAWS = 1000


class DistanceBound(NamedTuple):
    """Distance of wheels that turn without slip, its 95 % interval over runs, and how well turns agree."""

    distance_m: float
    interval_m: tuple[float, float]
    correlation: float
    n_runs: int

    @property
    def sentence(self) -> str:
        """The distance, in words."""
        low_m, high_m = self.interval_m
        return (
            f"turns are those of wheels {self.distance_m:.4f} m from the middle that turn without slip "
            f"({low_m:.4f} to {high_m:.4f}, {self.n_runs} runs)."
        )


def distance_bound(
    runs: Sequence[MeasuredSlip], robot: OmniRobot, rng: np.random.Generator
) -> DistanceBound | None:
    """Return the bound that runs on one surface give; None where their turns do not follow the wheels.

    Parameters
    ----------
    runs : measured, on a surface where wheels slip little
    robot : with the distance as described
    rng : draws runs
    """
    turns = []
    for run in runs:
        known = np.isfinite(run.twist[:, 2]) & np.isfinite(run.rolled_twist[:, 2])
        if known.any():
            turns.append((run.rolled_twist[known, 2].mean(), run.twist[known, 2].mean()))
    if len(turns) < 3:
        return None
    rolled, seen = np.array(turns).T
    spread = float(np.sqrt((rolled @ rolled) * (seen @ seen)))
    correlation = float(rolled @ seen) / spread if spread > 0.0 else 0.0
    if correlation < MIN_CORRELATION:
        return None
    rows = bootstrap_rows(len(turns), N_DRAWS, rng)
    described_m = robot.wheel_distance_m
    draws = described_m * (rolled[rows] ** 2).sum(axis=1) / (rolled[rows] * seen[rows]).sum(axis=1)
    found_m = described_m * float(rolled @ rolled) / float(rolled @ seen)
    return DistanceBound(found_m, percentile_interval(draws), correlation, len(turns))
