"""The peak of net traction over slip, and its interval by a bootstrap over runs.

Net traction (drawbar pull of a wheel over its load) is f(s) - rho, with the thrust over load f and the
resistance over load rho.  Its peak slip is

- where the largest net traction within the observed slips lies, if that is not within :data:`EDGE_SLIP` of
  their end (:attr:`PeakStatus.PEAK`);
- else the smallest slip with 95 % of the largest net traction within the observed slips
  (:attr:`PeakStatus.NO_PEAK`): on terrain that shears, traction rises monotonically, and more slip gains next
  to nothing.

Its 90 % interval is from a bootstrap over whole runs, so that it contains what differs from run to run,
whether or not a factor describes it; percentiles are taken further out as a few runs demand (expanded
percentile interval; Hesterberg, American Statistician 69 (4), 371-386, 2015).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri, stdtrit

from terrain.records import Array
from terrain.slip_learning.samples import RunBins

INTERVAL = 0.9
"""Probability with which an interval contains the peak slip."""

EDGE_SLIP = 0.03
"""A maximum this near the end of the observed slips may still rise beyond it."""

NEAR_PEAK_RATIO = 0.95
"""Part of the largest net traction that defines the peak slip of a curve without a peak."""

SHAPE_STD_RATIO = 0.02
"""Error of the thrust at one slip against that at another, a peak's slip apart, that all runs share: residue
of low-pass filter and lag.  It moves a flat peak further than a sharp one."""

SYSTEMATIC_SLIP_STD = 0.005
"""Error that all runs of a robot share, which no bootstrap contains: half a percent of rolling radius."""


class PeakStatus(StrEnum):
    """Kind of a peak slip."""

    PEAK = "peak"
    NO_PEAK = "no_peak"


class Peak(NamedTuple):
    """Slip at which net traction is largest or nearly so, and which of the two."""

    slip_ratio: float
    status: PeakStatus


def net_peak(net_ratio: Callable[[Array], Array], low_slip: float, high_slip: float) -> Peak:
    """Return where net traction is largest within a range, or has 95 % of it where it rises to the end.

    Parameters
    ----------
    net_ratio : net traction at each of an array of slips, in any unit of force
    low_slip, high_slip : the range

    Examples
    --------
    >>> net_peak(lambda s: 1 - (s - 0.2) ** 2, 0.0, 0.6)
    Peak(slip_ratio=0.2, status=<PeakStatus.PEAK: 'peak'>)
    >>> net_peak(lambda s: s, 0.0, 0.6)
    Peak(slip_ratio=0.57, status=<PeakStatus.NO_PEAK: 'no_peak'>)
    """
    slips = np.linspace(low_slip, high_slip, max(2, 1 + round((high_slip - low_slip) / 0.0005)))
    net = net_ratio(slips)
    top = int(np.argmax(net))
    if slips[top] < high_slip - EDGE_SLIP and top > 0:
        return Peak(round(float(slips[top]), 6), PeakStatus.PEAK)
    near = net >= NEAR_PEAK_RATIO * net[top] if net[top] > 0 else np.arange(len(net)) >= top
    return Peak(round(float(slips[int(np.argmax(near))]), 6), PeakStatus.NO_PEAK)


def peak_slip_of_kind(
    status: PeakStatus, net_ratio: Callable[[Array], Array], low_slip: float, high_slip: float
) -> float:
    """Return the peak slip by the definition of a given status, of a bootstrap draw for instance."""
    slips = np.linspace(low_slip, high_slip, 1001)
    net = net_ratio(slips)
    top = int(np.argmax(net))
    if status is PeakStatus.PEAK or net[top] <= 0:
        return float(slips[top])
    return float(slips[int(np.argmax(net >= NEAR_PEAK_RATIO * net[top]))])


def peak_interval(
    draws: Array,
    runs: Sequence[RunBins],
    peak: Peak,
    thrust_ratio: Callable[[Array], Array],
    high_slip: float,
) -> tuple[float, float]:
    """Return the 90 % interval of a peak slip.

    Parameters
    ----------
    draws : (m,) peak slips of the bootstrap over runs
    runs : behind the curve
    peak : of the curve
    thrust_ratio : thrust over load of the curve at each of an array of slips
    high_slip : largest slip observed
    """
    shared = math.hypot(SYSTEMATIC_SLIP_STD, _shape_std(thrust_ratio, peak, high_slip))
    return expanded_interval(draws, n_informative_runs(runs, peak, high_slip), peak.slip_ratio, shared)


def _shape_std(thrust_ratio: Callable[[Array], Array], peak: Peak, high_slip: float) -> float:
    """Return how far a tilt of the curve by :data:`SHAPE_STD_RATIO` moves a peak or the slip at 95 %.

    Near a peak ``f = f_0 (1 - a (s - s_0)^2)``, with a by the thrust at two thirds of s_0; the tilt
    is over the peak's slip.  Without a peak, the tilt over the observed slips raises f here against f there.
    """
    slip = peak.slip_ratio
    below, here, third = thrust_ratio(np.array([slip - 1e-3, slip, 2 / 3 * slip]))
    if peak.status is PeakStatus.NO_PEAK:
        slope = max((here - below) / 1e-3, 1e-6)
        moved = SHAPE_STD_RATIO * here * (high_slip - slip) / high_slip / slope
    else:
        moved = SHAPE_STD_RATIO / (2 * max(1.0 - third / here, 1e-4) / (slip / 3) ** 2 * slip)
    return float(min(moved, slip / 2))


def n_informative_runs(runs: Sequence[RunBins], peak: Peak, high_slip: float) -> int:
    """Return how many runs determine a peak, at least 2: with slips beyond it, or in the upper half."""
    beyond = peak.slip_ratio if peak.status is PeakStatus.PEAK else high_slip / 2
    return max(2, sum(bool((run.slip_ratio > beyond).any()) for run in runs))


def expanded_interval(
    draws: Array, n_runs: int, centre: float, shared_std: float = SYSTEMATIC_SLIP_STD
) -> tuple[float, float]:
    """Return the 90 % interval of a slip by its bootstrap draws over ``n_runs`` runs.

    The percentiles are those of the normal law at ``sqrt(n / (n - 1)) t``, the quantile of Student's law with
    n - 1 degrees of freedom; the error that all runs share is added to both sides in squares.
    """
    quantile = math.sqrt(n_runs / (n_runs - 1)) * float(stdtrit(n_runs - 1, 0.5 + INTERVAL / 2))
    tail = float(ndtr(-quantile))
    low, high = np.quantile(draws, [tail, 1 - tail])
    shared = shared_std * float(ndtri(0.5 + INTERVAL / 2))
    low, high = min(float(low), centre), max(float(high), centre)
    return (
        max(centre - math.hypot(centre - low, shared), 0.0),
        min(centre + math.hypot(high - centre, shared), 1.0),
    )
