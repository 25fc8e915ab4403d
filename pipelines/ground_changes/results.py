"""Results of ``terrain find-changes``."""

from __future__ import annotations

from dataclasses import dataclass

from terrain.classify.response_change import GroundChange
from terrain.measured_slip.steps import SlipStep


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


@dataclass(frozen=True, slots=True)
class FoundChanges:
    """Changes of all runs; ratios are NaN where no run has a step of slip.

    Parameters
    ----------
    robot : by name
    n_calibration_runs, threshold, false_alarm_ratio : what the detector was calibrated with
    runs : that were watched
    n_steps : runs whose slip changes, as measured from outside
    found_ratio : of these, the share whose change was found
    delay_median_s, delay_p90_s : of the alarms behind the middle of the crossing
    n_without_step, n_alarms_without_step : runs without such a change, and how many of them gave an alarm
    skipped : a sentence for each run that could not be read
    """

    robot: str
    n_calibration_runs: int
    threshold: float
    false_alarm_ratio: float
    runs: tuple[WatchedRun, ...]
    n_steps: int
    found_ratio: float
    delay_median_s: float
    delay_p90_s: float
    n_without_step: int
    n_alarms_without_step: int
    skipped: tuple[str, ...]
