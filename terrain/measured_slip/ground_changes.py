"""Changes of the ground in runs, found from motor currents, beside what a measurement from outside shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrain.classify.response_change import DetectorSettings, GroundChange, calibrate, changes_of
from terrain.errors import DataError
from terrain.measured_slip.slips import wheel_speeds
from terrain.measured_slip.steps import SlipStep, slip_step
from terrain.measured_slip.travelled import outside_source
from terrain.records import Array, RunLog
from terrain.robots import Robot


@dataclass(frozen=True, slots=True)
class WatchedRun:
    """Changes that were found in a run, and what an outside measurement shows.

    Parameters
    ----------
    run_id : of the run
    changes : as they were found, in order of time
    judged : whether the motion was measured from outside
    step : of the slip measured from outside; None where it does not change, or nothing measured it
    found : whether an alarm came while the robot crossed the border, or as long after; None without a step
    delay_s : of that alarm behind the middle of the crossing; NaN without one
    n_early : alarms before the crossing; all of them where the slip does not change
    """

    run_id: str
    changes: tuple[GroundChange, ...]
    judged: bool
    step: SlipStep | None
    found: bool | None
    delay_s: float
    n_early: int


def quiet_detector(
    quiet: Sequence[RunLog], runs: Sequence[RunLog], robot: Robot, false_alarms: float
) -> DetectorSettings:
    """Return a detector that is calibrated on runs on one ground each.

    Parameters
    ----------
    quiet : on one ground each
    runs : that are to be watched, none of which may be among them
    robot : of all of them
    false_alarms : part of the quiet runs that may give an alarm

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
    return calibrate((response_log(run, robot) for run in quiet), false_alarms)


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
    return time_s, np.column_stack([wheels.channel(name) for name in names]), speeds


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
    inside = alarms[np.abs(alarms - step.time_s) <= step.crossing_s]
    delay_s = float(inside[0] - step.time_s) if inside.size else float("nan")
    early = int((alarms < step.time_s - step.crossing_s).sum())
    return WatchedRun(run.run_id, changes, judged, step, bool(inside.size), delay_s, early)
