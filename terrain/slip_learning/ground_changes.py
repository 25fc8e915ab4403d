"""Changes of the ground in runs, found from motor currents, beside what a measurement from outside shows.

Measured from outside, the instant at which the slip of a run changes is that at which it drives onto other ground.
Slip over short windows is fitted by two levels, one before an instant and one after it, least squares over
all instants.  A robot crosses a border wheel by wheel; the instant is the middle of that.  A change is found by an
alarm from that instant on, as far as it is known, up to :data:`MAX_DELAY_S` later; an earlier one is false.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from terrain.classify.changes import DetectorSettings, GroundChange, calibrate, changes_of
from terrain.errors import DataError
from terrain.records import Array, RunLog
from terrain.robots import Robot
from terrain.slip_learning.measured import measured_slip, outside_source, wheel_speeds

WINDOW_S, STRIDE_S = 0.5, 0.1
#: Later alarms are none of the change: three blocks before one, and the crossing's second half
MAX_DELAY_S = 3.0

SETTLING_S = 0.4  #: Windows that begin earlier have the start in them
MIN_WINDOWS = 5  #: On each side of the instant

MIN_STEP, MIN_CLEAR = 0.06, 1.5
"""Least difference of the levels, and over the scatter about them: twice the spread of the slip of a run on
one ground, and clearer than its noise over 0.5 s."""


class SlipStep(NamedTuple):
    """A change of slip: its instant, known to half a window, and the slip before and after."""

    time_s: float
    before: float
    after: float


def slip_step(run: RunLog, robot: Robot) -> SlipStep | None:
    """Return when the slip of a run changes; None where it does not, as measured from outside."""
    found = measured_slip(run, robot, window_s=WINDOW_S, stride_s=STRIDE_S)
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
    scatter = float(np.sqrt(np.mean((slip - np.where(np.arange(n) < j, one, other)) ** 2)))
    if abs(other - one) < max(MIN_STEP, MIN_CLEAR * scatter):
        return None
    return SlipStep(float(time_s[j - 1] + time_s[j]) / 2, one, other)


@dataclass(frozen=True, slots=True)
class WatchedRun:
    """Changes that were found in a run, and what an outside measurement shows."""

    run_id: str  #: of the run
    changes: tuple[GroundChange, ...]  #: as they were found, in order of time
    judged: bool  #: whether the motion was measured from outside
    #: of the slip measured from outside; None where it does not change, or nothing measured it
    step: SlipStep | None
    #: whether an alarm came after the change, and at most :data:`MAX_DELAY_S`; None without a step
    found: bool | None
    delay_s: float  #: of that alarm behind the change; NaN without one
    n_early: int  #: alarms before the change, which are false; all of them where the slip does not change


def quiet_detector(
    quiet: Sequence[RunLog], runs: Sequence[RunLog], robot: Robot, false_alarms: float
) -> DetectorSettings:
    """Return a detector that is calibrated on runs on one ground each.

    Parameters
    ----------
    quiet : on one ground each
    runs : that are to be watched, none of which may be among them
    robot : of all of them
    false_alarms : probability of an alarm in a run on one ground

    Raises
    ------
    DataError
        if runs lack wheel speeds or currents, or none is long enough to calibrate on.
    """
    several = [run.run_id for run in quiet if len(run.terrains) > 1]
    if several:
        raise DataError(f"--changes: run {several[0]} is labelled with several terrains; one each is needed")
    known = {run.run_id for run in quiet}
    shared = [run.run_id for run in runs if run.run_id in known]
    if shared:
        raise DataError(f"run {shared[0]} is watched and calibrated on; one or the other is needed")
    sessions = len({run.session for run in quiet}) > 1
    units = [run.session if sessions else run.run_id for run in quiet]
    return calibrate((response_log(run, robot) for run in quiet), false_alarms, units)


def response_log(run: RunLog, robot: Robot) -> tuple[Array, Array, Array]:
    """Return times (n,), currents (n, wheels) and wheel speeds (n, wheels) of a run.

    Raises
    ------
    DataError
        if it lacks one of them.
    """
    time_s, speeds = wheel_speeds(run, robot)
    wheels = run.streams["wheels"]
    names = [f"current_{wheel}_a" for wheel in robot.wheels]
    if not set(names) <= set(wheels.channels):
        raise DataError(f"run {run.run_id}: has no current of each wheel ({', '.join(names)})")
    return time_s, wheels.columns(names), speeds


def watch(run: RunLog, robot: Robot, detector: DetectorSettings) -> WatchedRun:
    """Return the changes that a detector finds in a run, and how they agree with its measured slip."""
    changes = tuple(changes_of(*response_log(run, robot), detector))
    judged, step = outside_source(run) is not None, None
    if judged:
        try:
            step = slip_step(run, robot)
        except DataError:
            judged = False
    alarms = np.array([change.alarm_s for change in changes])
    if step is None:
        return WatchedRun(run.run_id, changes, judged, None, None, float("nan"), len(changes))
    begin_s = step.time_s - WINDOW_S / 2
    inside = alarms[(alarms >= begin_s) & (alarms <= step.time_s + MAX_DELAY_S)]
    delay_s = float(inside[0] - step.time_s) if inside.size else float("nan")
    early = int((alarms < begin_s).sum())
    return WatchedRun(run.run_id, changes, judged, step, bool(inside.size), delay_s, early)
