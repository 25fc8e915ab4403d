"""What ``terrain import`` and ``terrain inspect`` print."""

from __future__ import annotations

import math
from collections import Counter

from rich.console import Console
from rich.table import Column, Table

from pipelines.reporting.numbers import format_counts
from pipelines.reporting.terminal import print_lines
from pipelines.runs.duplicates import sentences
from pipelines.runs.results import Imported, Inspection
from pipelines.runs.verdicts import doubt_sentences, doubts_of
from terrain.logs.clock import ClockEstimate
from terrain.logs.plausibility import worst

COLUMNS = {
    "run": "left",
    "stream": "left",
    "rate Hz": "right",
    "length s": "right",
    "gaps": "right",
    "longest s": "right",
    "missing": "right",
    "stuck": "left",
    "clock of the wheels against the IMU": "left",
}


def print_import(result: Imported, console: Console) -> None:
    """Print what was skipped, how many runs were written, and what was dropped."""
    print_lines(console, (f"skipped: {sentence}" for sentence in result.skipped))
    counts = f", {format_counts(result.dropped)}" if result.dropped else ""
    print_lines(console, doubt_sentences(result.doubts))
    print_lines(console, [f"{result.n_runs} runs written to {result.out}{counts}"])
    print_lines(console, sentences(result.duplicates))


def print_inspection(result: Inspection, console: Console) -> None:
    """Print a row per stream, the clock beside the wheels."""
    columns = [Column(name, justify=side, overflow="fold") for name, side in COLUMNS.items()]  # type: ignore[arg-type]
    table = Table(*columns, title=f"{result.n_runs} runs, digest {result.digest[:12]}")
    for run in result.runs:
        for name, stream in run.streams.items():
            table.add_row(
                run.run_id,
                name,
                f"{stream.rate_hz:.2f}",
                f"{stream.duration_s:.2f}",
                str(stream.n_gaps),
                f"{stream.longest_gap_s:.2f}" if stream.n_gaps else "",
                str(sum(channel.n_nonfinite for channel in stream.channels.values())),
                ", ".join(stream.stuck),
                _clock_text(run.clock) if name == "wheels" else "",
            )
    console.print(table)
    for run in result.runs:
        if run.dropped:
            console.print(f"{run.run_id}: dropped {format_counts(run.dropped)}")
        print_lines(
            console,
            (
                f"{run.run_id}: {odd.start_s:g} to {odd.end_s:g} s differs from the rest of the run by "
                f"{odd.shift:.1f} times its scatter (vibration at its speed; {odd.speed_mps:.2f} m/s, "
                f"the run {odd.run_speed_mps:.2f}): a stuck robot, another ground?"
                for odd in run.odd_stretches
            ),
        )
    print_lines(console, doubt_sentences(doubts_of({run.run_id: run.plausibility for run in result.runs})))
    levels = Counter(str(worst(run.plausibility)) for run in result.runs)
    console.print(f"plausibility of the runs: {format_counts(levels)}")
    for sentence in result.skipped:
        console.print(sentence)
    print_lines(console, sentences(result.duplicates))


def _clock_text(clock: ClockEstimate | None) -> str:
    if clock is None:
        return "no gyro, no speeds of a left and a right wheel, or an unknown robot"
    if math.isnan(clock.offset_s):
        return str(clock.status)
    text = f"{clock.status}: offset {clock.offset_s:+.3f} ± {clock.offset_std_s:.3f} s"
    if not math.isnan(clock.rate):
        text += f", rate {100 * clock.rate:+.2f} ± {100 * clock.rate_std:.2f} %"
    return text
