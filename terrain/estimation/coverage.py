"""Whether a filter's uncertainty can be believed on a simulated run: NEES by group of states, and of slip."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri

from terrain.estimation.consistency import consistency_report
from terrain.estimation.estimate import Estimate
from terrain.estimation.reference import lagged_slip_at

COVERAGE_PROBABILITY = 0.95
"""Of the interval of a slip ratio whose coverage is counted."""

_STDS = float(ndtri(0.5 + 0.5 * COVERAGE_PROBABILITY))


def nees_by_group(estimate: Estimate) -> dict[str, float]:
    """Return the mean NEES of a run, a state, of each group of states; empty without a truth.

    Parameters
    ----------
    estimate : of a simulated run

    Returns
    -------
    dict
        by the name of the states without axis, number and unit: ``position``, ``yaw``, ``speed``,
        ``yaw_rate``, ``accel``, ``steer``, ``gyro_bias``, ``slip_speed``, as the filter has them.  1 is
        consistent, over 1 the filter states too small a variance.

    Examples
    --------
    >>> from terrain.estimation.estimate import estimate_run
    >>> from terrain.robots import load_robot
    >>> from terrain.simulation.run import simulate_run
    >>> robot = load_robot("agrimaro")
    >>> run = simulate_run(robot, "grass", "straight", 0, duration_s=5.0)
    >>> list(nees_by_group(estimate_run(run, robot, "encoder12")))[:3]
    ['position', 'yaw', 'speed']
    """
    states = consistency_report(estimate.track, estimate.truth).states
    return {group.name: group.mean_per_dof for group in states if group.name != "all"}


def slip_coverage(estimate: Estimate, between_s: tuple[float, float] = (-math.inf, math.inf)) -> float:
    """Return the ratio of slips of a run whose 95 % interval contains the true slip; NaN where none is known.

    The interval is the estimate with 1.96 stated standard deviations on either side.  The truth comes behind
    the low-pass of the encoders, as the filter's inputs do.

    Parameters
    ----------
    estimate : of a simulated run
    between_s : only the slips in this time
    """
    if "truth" not in estimate.run.streams:
        return math.nan
    true = lagged_slip_at(estimate.run, estimate.robot, estimate.slip.time_s)
    error = np.abs(estimate.slip.slip_ratio - true)
    known = np.isfinite(error) & np.isfinite(estimate.slip.slip_std)
    known &= ((estimate.slip.time_s >= between_s[0]) & (estimate.slip.time_s <= between_s[1]))[:, None]
    inside = error[known] <= _STDS * estimate.slip.slip_std[known]
    return float(inside.mean()) if inside.size else math.nan
