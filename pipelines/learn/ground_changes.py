"""Changes of the ground, found sample by sample from what wheels answer, and judged by an outside measurement."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from pipelines.learn.parallel import parallel
from pipelines.report.numbers import format_value, plural
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.tree import Column, Report, Table, Text, sections
from terrain.records import RunLog
from terrain.robots import load_robot
from terrain.slip_learning.ground_changes import MAX_DELAY_S, WatchedRun, quiet_detector, watch
from terrain.slip_learning.measured import one_robot

MAX_ROWS = 12


class ChangesResult(Result):
    """Changes of all runs; ratios are NaN where no run has a step of slip."""

    robot: str = described("robot by name")
    n_calibration_runs: int = described("runs on one ground that the detector was calibrated with")
    threshold: float = described("of the detector")
    false_alarm_ratio: float = described(
        "calibration runs with an alarm when held out of the calibration", "1"
    )
    false_alarm_interval: tuple[float, float] = described("of that, 95 % over runs or sessions", "1")
    false_alarms_a_minute: float = described("the same in the time of these runs", "1/min")
    runs: tuple[WatchedRun, ...] = described("what was found in each run")
    n_steps: int = described("runs whose slip changes, as measured from outside")
    found_ratio: float = described("those among them whose change was found", "1")
    n_early: int = described("alarms before the change in runs that have one, which are false")
    delay_median_s: float = described("of the alarms behind the change", "s")
    delay_p90_s: float = described("nine tenths of the delays are below", "s")
    n_without_step: int = described("runs without such a change")
    n_alarms_without_step: int = described("those among them with an alarm")
    skipped: tuple[str, ...] = described("a sentence for each run that could not be read", default=())

    def records(self) -> Iterable[Any]:
        """Return a row a change."""
        return ({"run_id": run.run_id, **each._asdict()} for run in self.runs for each in run.changes)


def find_changes(
    runs: Sequence[RunLog],
    quiet: Sequence[RunLog],
    robot: str | None = None,
    false_alarms: float = 0.02,
    progress: Progress = silent,
) -> ChangesResult:
    """Calibrate a detector on runs on one ground each, and watch others with it.

    Parameters
    ----------
    runs : to watch
    quiet : on one ground each
    robot : name or YAML file; that of the runs by default
    false_alarms : probability of an alarm in a run on one ground
    progress : called as runs are watched

    Raises
    ------
    DataError
        if runs are of several robots, lack wheel speeds or currents, or none is long enough to calibrate on.
    """
    described_robot = one_robot([*runs, *quiet], None if robot is None else load_robot(robot))
    detector = quiet_detector(quiet, runs, described_robot, false_alarms)
    each = [(run, described_robot, detector) for run in runs]
    watched = [*parallel(watch, (), each, 1, "watch", progress)]
    with_step = [run for run in watched if run.step is not None]
    without = [run for run in watched if run.judged and run.step is None]
    delays = np.array([run.delay_s for run in with_step if run.found])
    return ChangesResult.of(
        detector,
        robot=described_robot.name,
        n_calibration_runs=detector.n_runs,
        runs=tuple(watched),
        n_steps=len(with_step),
        found_ratio=float(np.mean([run.found for run in with_step])) if with_step else float("nan"),
        n_early=sum(run.n_early for run in with_step),
        delay_median_s=float(np.median(delays)) if delays.size else float("nan"),
        delay_p90_s=float(np.quantile(delays, 0.9)) if delays.size else float("nan"),
        n_without_step=len(without),
        n_alarms_without_step=sum(bool(run.changes) for run in without),
    )


def report(result: ChangesResult) -> Report:
    """Return the alarms of each run, and how many changes were found how fast."""
    n_alarms, n_runs = sum(len(run.changes) for run in result.runs), len(result.runs)
    answer = f"{plural(n_alarms, 'change')} of the ground in {plural(n_runs, 'run')} of {result.robot}"
    notes = []
    if result.n_steps:
        steps, found = plural(result.n_steps, "change"), format_value(result.found_ratio, ".1%")
        answer += f"; of {steps} that a measurement from outside shows, {found} found"
        notes.append(
            f"alarms come {format_value(result.delay_median_s, '+.2f', 's')} after the change in the median, "
            f"{format_value(result.delay_p90_s, '+.2f', 's')} at nine tenths; a change is found where one comes at "
            f"most {MAX_DELAY_S:g} s after it; {plural(result.n_early, 'alarm')} before it are false"
        )
    if result.n_without_step:
        notes.append(
            f"slip does not change clearly in {result.n_without_step} runs; {result.n_alarms_without_step} of them "
            "have an alarm: false, unless single wheels changed the ground"
        )
    columns = (
        Column("run", of="run_id"),
        Column(
            "alarms", "", "s", of=lambda run: ", ".join(f"{c.alarm_s:.2f}" for c in run.changes) or "none"
        ),
        Column("slip measured from outside", of=_slip_words),
        Column("changes at", ".2f", "s", of="step.time_s"),
        Column("delay", "+.2f", "s", of="delay_s"),
        Column("early", of="n_early"),
    )
    more = f"{n_runs - MAX_ROWS} runs more: --details" if n_runs > MAX_ROWS else ""
    return Report(
        title=f"Changes of the ground under {result.robot}",
        answer=f"{answer}.",
        lead=(
            f"threshold {format_value(result.threshold, '.1f')}; of {result.n_calibration_runs} runs on one ground "
            f"{format_value(result.false_alarm_ratio, '.1%')} have an alarm when held out of the calibration "
            f"({format_value(result.false_alarm_interval, '.1%')}, 95 %; "
            f"{format_value(result.false_alarms_a_minute, '.2f')} a minute)"
        ),
        parts=[
            Table(columns, result.runs[:MAX_ROWS], note=more),
            *(Text(text, "note") for text in (*notes, *result.skipped)),
        ],
        details=sections(("All runs", [Table(columns, result.runs)] if more else [])),
        next_step="terrain label runs/ --run ID --from S --to S --terrain NAME",
    )


def _slip_words(run: WatchedRun) -> str:
    if run.step is None:
        return "no change" if run.judged else "not measured"
    return f"{run.step.before:.2f} to {run.step.after:.2f}"
