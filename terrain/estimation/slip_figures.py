"""Slip of a run in a few figures: its mean in steady motion, and the peak of its transients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrain.records import Array, SlipTrack, read_only

STEADY_SPEED_MPS = 0.2
"""Slower, 1 cm/s of error in the speed is over 5 % of slip."""

STEADY_CHANGE_MPS = 0.1
"""Largest change of speed over :data:`STEADY_BEFORE_S` that counts as none: 0.1 m/s^2 asks for a hundredth of
the weight in traction, little beside what rolling on soft ground does."""

STEADY_BEFORE_S, STEADY_AFTER_S = 1.0, 0.25
"""How long the speed has to have been steady, for transients to have died out, and how long it has to remain
so, for the start of a braking not to count before it shows."""


@dataclass(frozen=True, slots=True, eq=False)
class SlipFigures:
    """Slip of a run in a few figures, all ratios; NaN where there was nothing to take them from.

    Parameters
    ----------
    steady : (n,) where the robot drove steadily
    steady_s : for how long
    steady_mean, steady_std : over all wheels then
    peak : largest absolute slip of any wheel while the robot moved and not steadily
    wheel_mean, wheel_std, wheel_peak : (wheels,) the same of each wheel
    """

    steady: Array
    steady_s: float
    steady_mean: float
    steady_std: float
    peak: float
    wheel_mean: Array
    wheel_std: Array
    wheel_peak: Array


def slip_figures(
    slip: SlipTrack, speed_mps: Array, time_s: Array, rolling: Array | None = None
) -> SlipFigures:
    """Return the figures of a run: steady slip, and the peak of its transients.

    Parameters
    ----------
    slip : of a filter; stale samples count as long as they are no NaN
    speed_mps, time_s : (k,) speed of the robot, on any clock
    rolling : (n, wheels) -1 where a wheel rolls backward, else 1: means are of slip positive in traction
        then, so that driving forward and backward does not cancel; without, slip counts as it is

    Notes
    -----
    Steady is faster than :data:`STEADY_SPEED_MPS`, with a speed that stays within :data:`STEADY_CHANGE_MPS`
    from :data:`STEADY_BEFORE_S` before to :data:`STEADY_AFTER_S` after.
    """
    known = np.isfinite(speed_mps)
    speed = np.full(slip.time_s.size, np.nan)
    if known.any():
        speed = np.abs(np.interp(slip.time_s, time_s[known], speed_mps[known], left=np.nan, right=np.nan))
    first = np.searchsorted(slip.time_s, slip.time_s - STEADY_BEFORE_S - 1e-9)
    last = np.searchsorted(slip.time_s, slip.time_s + STEADY_AFTER_S + 1e-9)
    change = np.array([np.ptp(speed[a:b]) for a, b in zip(first, last, strict=True)])
    started = slip.time_s - slip.time_s[:1] >= STEADY_BEFORE_S - 1e-9
    moving = speed > STEADY_SPEED_MPS
    steady = moving & started & (change < STEADY_CHANGE_MPS)
    ratio = slip.slip_ratio if rolling is None else slip.slip_ratio * rolling
    steady_slip, transient_slip = ratio[steady], np.abs(ratio[moving & ~steady])
    wheel_peak = np.array([_of_known(np.max, wheel) for wheel in transient_slip.T])
    return SlipFigures(
        steady=read_only(steady, np.bool_),
        steady_s=float(np.diff(slip.time_s, append=slip.time_s[-1:])[steady].sum()),
        steady_mean=_of_known(np.mean, steady_slip),
        steady_std=_of_known(np.std, steady_slip),
        peak=_of_known(np.max, wheel_peak),
        wheel_mean=read_only([_of_known(np.mean, wheel) for wheel in steady_slip.T]),
        wheel_std=read_only([_of_known(np.std, wheel) for wheel in steady_slip.T]),
        wheel_peak=read_only(wheel_peak),
    )


def _of_known(statistic: Callable[[Array], Any], slip: Array) -> float:
    known = slip[np.isfinite(slip)]
    return float(statistic(known)) if known.size else float("nan")
