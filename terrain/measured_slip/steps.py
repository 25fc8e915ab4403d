"""The instant at which the slip of a run changes, as measured from outside: it drives onto other ground.

Slip over short windows is fitted by two levels, one before an instant and one after it, least squares over
all instants.  A robot crosses a border wheel by wheel, so that its slip changes over the time in which it
travels the distance of its wheels; the instant is the middle of that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.measured_slip.slips import MeasuredSlip, measured_slip
from terrain.records import RunLog
from terrain.robots import Robot

WINDOW_S, STRIDE_S = 0.5, 0.1

SETTLING_S = 0.4
"""Windows that begin earlier have the start in them."""

MIN_WINDOWS = 5
"""On each side of the instant."""

MIN_STEP, MIN_CLEAR = 0.06, 1.5
"""Least difference of the levels, and over the scatter about them: twice the spread of the slip of a run on
one ground, and clearer than its noise over 0.5 s."""


class SlipStep(NamedTuple):
    """A change of slip: its instant, the slip before and after, and the time it takes the robot to cross."""

    time_s: float
    before: float
    after: float
    crossing_s: float


def slip_step(run: RunLog, robot: Robot, delay_s: float = 0.0) -> SlipStep | None:
    """Return when the slip of a run changes; None where it does not, as measured from outside.

    Parameters
    ----------
    run, robot, delay_s : as :func:`~terrain.measured_slip.slips.measured_slip` takes them
    """
    return step_of(measured_slip(run, robot, window_s=WINDOW_S, stride_s=STRIDE_S, delay_s=delay_s), robot)


def step_of(found: MeasuredSlip, robot: Robot) -> SlipStep | None:
    """Return when the slip of short windows changes; None where it does not."""
    known = np.isfinite(found.body_slip) & (found.start_s >= found.start_s[0] + SETTLING_S)
    slip, time_s = found.body_slip[known], found.time_s[known]
    n = slip.size
    if n < 2 * MIN_WINDOWS:
        return None
    at = np.arange(MIN_WINDOWS, n - MIN_WINDOWS + 1)
    sums = np.cumsum(slip)
    before, after = sums[at - 1] / at, (sums[-1] - sums[at - 1]) / (n - at)
    best = int(np.argmax(at * (n - at) / n * (after - before) ** 2))
    j, one, other = int(at[best]), float(before[best]), float(after[best])
    scatter = float(np.sqrt(np.mean(np.concatenate([slip[:j] - one, slip[j:] - other]) ** 2)))
    if abs(other - one) < max(MIN_STEP, MIN_CLEAR * scatter):
        return None
    speed_mps = float(np.median(np.linalg.norm(found.twist[known, :2], axis=1)))
    extent_m = 2.0 * float(np.linalg.norm(robot.wheel_positions_m, axis=1).max())
    return SlipStep(float(time_s[j - 1] + time_s[j]) / 2, one, other, extent_m / max(speed_mps, 1e-3))
