"""What ``terrain find-changes`` prints."""

from __future__ import annotations

from rich.console import Console

from pipelines.ground_changes.results import FoundChanges, WatchedRun
from pipelines.reporting.numbers import format_known
from pipelines.reporting.terminal import compact_table, number_columns, print_lines, text_column


def print_changes(result: FoundChanges, console: Console) -> None:
    """Print a row a run, and how many changes were found how fast."""
    table = compact_table(
        text_column("run"),
        text_column("alarms s"),
        *number_columns("slip before", "after", "middle s", "delay s", "early"),
        title=f"changes of the ground under {result.robot}, by the currents of its wheels",
    )
    for run in result.runs:
        table.add_row(run.run_id, *_cells(run))
    console.print(table)
    print_lines(console, _lines(result))


def _cells(run: WatchedRun) -> tuple[str, ...]:
    alarms = ", ".join(f"{change.alarm_s:.2f}" for change in run.changes) or "none"
    if run.step is None:
        return alarms, *(("no change" if run.judged else "not measured"), "", "", ""), str(run.n_early)
    return (
        alarms,
        f"{run.step.before:.2f}",
        f"{run.step.after:.2f}",
        f"{run.step.time_s:.2f}",
        format_known(run.delay_s, "{:+.2f}"),
        str(run.n_early),
    )


def _lines(result: FoundChanges) -> list[str]:
    lines = [
        f"threshold {result.threshold:.1f}, exceeded in {100 * result.false_alarm_ratio:.1f} % of "
        f"{result.n_calibration_runs} runs on one ground"
    ]
    if result.n_steps:
        lines.append(
            f"slip changes in {result.n_steps} runs, as measured from outside; found in "
            f"{100 * result.found_ratio:.1f} % of them, {result.delay_median_s:+.2f} s after the middle of "
            f"the crossing in the median, {result.delay_p90_s:+.2f} s at nine tenths"
        )
    if result.n_without_step:
        lines.append(
            f"slip does not change in {result.n_without_step} runs; {result.n_alarms_without_step} of them "
            "have an alarm"
        )
    return [*lines, *result.skipped]
