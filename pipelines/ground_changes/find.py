"""``terrain find-changes``: watch runs as a robot would, and judge the alarms by an outside measurement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipelines.ground_changes.results import FoundChanges, WatchedRun
from pipelines.ground_changes.settings import FindChangesSettings
from pipelines.reporting.progress import Progress, silent
from terrain.classify.response_change import DetectorSettings, calibrate, changes_of
from terrain.errors import DataError
from terrain.measured_slip.measure import one_robot
from terrain.measured_slip.slips import wheel_speeds
from terrain.measured_slip.steps import SlipStep, slip_step
from terrain.measured_slip.travelled import outside_source
from terrain.records import Array, RunLog
from terrain.robots import Robot, load_robot


def find_changes(
    runs: Sequence[RunLog],
    quiet: Sequence[RunLog],
    settings: FindChangesSettings,
    skipped: Sequence[str] = (),
    progress: Progress = silent,
) -> FoundChanges:
    """Calibrate a detector on runs on one ground each, and watch others with it.

    Parameters
    ----------
    runs : to watch
    quiet : on one ground each
    settings : of the command
    skipped : a sentence for each run that could not be read

    Raises
    ------
    DataError
        if runs are of several robots, lack wheel speeds or currents, or none is long enough to calibrate on.
    """
    robot = one_robot([*runs, *quiet], None if settings.robot is None else load_robot(settings.robot))
    several = [run.run_id for run in quiet if len(run.terrains) > 1]
    if several:
        raise DataError(
            f"--calibrate: run {several[0]} is labelled with several terrains; one each is needed"
        )
    known = {run.run_id for run in quiet}
    shared = [run.run_id for run in runs if run.run_id in known]
    if shared:
        raise DataError(f"run {shared[0]} is watched and calibrated on; one or the other is needed")
    detector = calibrate((response_log(run, robot) for run in quiet), settings.false_alarms)
    watched = []
    for done, run in enumerate(runs, start=1):
        watched.append(_watch(run, robot, detector))
        progress("watch", done, len(runs))
    with_step = [run for run in watched if run.step is not None]
    without = [run for run in watched if run.judged and run.step is None]
    delays = np.array([run.delay_s for run in with_step if run.found])
    return FoundChanges(
        robot=robot.name,
        n_calibration_runs=detector.n_runs,
        threshold=detector.threshold,
        false_alarm_ratio=detector.false_alarm_ratio,
        runs=tuple(watched),
        n_steps=len(with_step),
        found_ratio=float(np.mean([run.found for run in with_step])) if with_step else float("nan"),
        delay_median_s=float(np.median(delays)) if delays.size else float("nan"),
        delay_p90_s=float(np.quantile(delays, 0.9)) if delays.size else float("nan"),
        n_without_step=len(without),
        n_alarms_without_step=sum(bool(run.changes) for run in without),
        skipped=tuple(skipped),
    )


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


def _watch(run: RunLog, robot: Robot, detector: DetectorSettings) -> WatchedRun:
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
    delay_s = _delay(inside, step)
    early = int((alarms < step.time_s - step.crossing_s).sum())
    return WatchedRun(run.run_id, changes, judged, step, bool(inside.size), delay_s, early)


def _delay(alarms: Array, step: SlipStep) -> float:
    return float(alarms[0] - step.time_s) if alarms.size else float("nan")
