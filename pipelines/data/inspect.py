"""Inspect runs: rates, lengths, gaps, stuck channels, units and signs, and whether two loggers share one clock."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.data.datasets import named_robot, read
from pipelines.data.settings import RunsSettings
from pipelines.report.numbers import format_counts, format_value, plural
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import setting
from pipelines.report.tree import Column, Report, Table, Text, sections

if TYPE_CHECKING:
    import pandas as pd

    from features.motion import OddStretch
    from terrain.logs.clock import ClockEstimate
    from terrain.logs.duplicates import SharedStretch
    from terrain.logs.plausibility import Check, StreamQuality

EXAMPLE = "terrain inspect logs/ --robot husky"


class Settings(RunsSettings):
    """What is inspected."""

    data: Path = setting(..., "Folder to read, or an MCAP file.", option="FOLDER")


@dataclass(frozen=True, slots=True)
class InspectedRun:
    """The quality of the streams of one run.

    ``clock`` is None where the run has no gyro or no speeds of a left and a right wheel, or its robot is
    unknown.  ``odd_stretches`` differ from the rest of the run.  ``plausibility`` has every check.
    """

    run_id: str
    terrains: tuple[str, ...]
    dropped: Mapping[str, int]
    streams: Mapping[str, StreamQuality]
    clock: ClockEstimate | None
    odd_stretches: tuple[OddStretch, ...] = ()
    plausibility: tuple[Check, ...] = ()


class Inspection(Result):
    """The quality of all runs."""

    n_runs: int = described("runs that were read")
    digest: str = described("SHA-256 over the content of all runs")
    skipped: tuple[str, ...] = described("a sentence for each run that could not be read")
    runs: tuple[InspectedRun, ...] = described("streams, clock, odd stretches and checks of each run")
    duplicates: tuple[SharedStretch, ...] = described("stretches that two runs share", default=())
    converted: bool = described("whether they are run folders already", default=False)

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a stream."""
        import pandas as pd

        rows = [_row(run, name) for run in self.runs for name in run.streams]
        return pd.DataFrame(rows, columns=[head.title for head in COLUMNS])


COLUMNS = (
    Column("run"),
    Column("stream"),
    Column("rate", ".2f", "Hz"),
    Column("length", ".2f", "s"),
    Column("gaps"),
    Column("longest", ".2f", "s"),
    Column("missing"),
    Column("stuck"),
)
MAX_ROWS = 12  #: Rows of streams on the first screen: those that need a look come first


def run(settings: Settings, progress: Progress = silent) -> Inspection:
    """Return the quality of the runs under a folder."""
    from features.motion import odd_stretches
    from terrain.errors import ConfigError, DataError
    from terrain.logs.clock import estimate_clock
    from terrain.logs.duplicates import shared_stretches
    from terrain.logs.plausibility import stream_quality
    from terrain.logs.run_folders import data_digest, run_folders
    from terrain.robots import robot_named

    runs, skipped, _, verdicts = read(settings, refuse=False)
    robot = named_robot(settings)
    inspected = []
    for done, each in enumerate(runs, 1):
        try:
            clock = estimate_clock(each, track_m=robot_named(each.robot, robot).track_m)
        except (ConfigError, DataError):
            clock = None
        streams = {name: stream_quality(stream) for name, stream in each.streams.items()}
        about = each.run_id, each.terrains, dict(each.dropped), streams, clock
        inspected.append(InspectedRun(*about, odd_stretches(each), verdicts[each.run_id]))
        progress("inspect", done, len(runs))
    converted = settings.data.is_dir() and bool(run_folders(settings.data))
    found = len(runs), data_digest(runs), tuple(skipped), tuple(inspected)
    return Inspection(*found, shared_stretches(runs), converted)


def report(result: Inspection) -> Report:
    """Return what is odd about the runs first, then rates and gaps of their streams, then their clocks."""
    from terrain.logs.duplicates import sentences
    from terrain.logs.plausibility import doubt_sentences, doubts_of, worst

    doubts = list(doubt_sentences(doubts_of({each.run_id: each.plausibility for each in result.runs})))
    odd = [_odd_sentence(each.run_id, stretch) for each in result.runs for stretch in each.odd_stretches]
    faults = [*result.skipped, *doubts, *sentences(result.duplicates)]
    levels = Counter(str(worst(each.plausibility)) for each in result.runs)
    found = f"{len(faults)} faults" if faults else "no fault"
    rows = [_row(each, name) for each in result.runs for name in each.streams]
    more = "" if len(rows) <= MAX_ROWS else f"of {len(rows)} streams"
    notable = sorted(rows, key=lambda row: (not (row[4] or row[6] or row[7]), row[0]))
    dropped = [
        f"{each.run_id}: dropped {format_counts(each.dropped)}" for each in result.runs if each.dropped
    ]
    clocks = [(each.run_id, _clock_text(each.clock)) for each in result.runs if "wheels" in each.streams]
    return Report(
        "Inspection of runs",
        f"{plural(result.n_runs, 'run')}: {found} found; plausibility {format_counts(levels)}.",
        lead=f"digest {result.digest[:12]}",
        parts=[
            *(Text(each, "warning") for each in faults[:6]),
            Table(COLUMNS, notable[:MAX_ROWS], note=more),
        ],
        details=sections(
            ("All faults", faults),
            ("Stretches unlike the rest of their run", odd),
            ("Streams", [Table(COLUMNS, rows)]),
            ("Clock of the wheels against the IMU", [Table(("run", Column("clock", long=True)), clocks)]),
            ("Dropped", dropped),
        ),
        next_step="terrain estimate --data DIR --out runs/"
        if result.converted
        else "terrain convert DIR --out raw/",
    )


def _row(run: InspectedRun, name: str) -> tuple[Any, ...]:
    stream = run.streams[name]
    missing = sum(stream.n_nonfinite.values())
    longest = stream.longest_gap_s if stream.n_gaps else None
    stuck = ", ".join(stream.stuck)
    return run.run_id, name, stream.rate_hz, stream.duration_s, stream.n_gaps, longest, missing, stuck


def _odd_sentence(run_id: str, odd: OddStretch) -> str:
    return (
        f"{run_id}: {odd.start_s:g} to {odd.end_s:g} s differs from the rest of the run by "
        f"{odd.shift:.1f} times its scatter (vibration at its speed; {odd.speed_mps:.2f} m/s, "
        f"the run {odd.run_speed_mps:.2f}): a stuck robot, another ground?"
    )


def _clock_text(clock: ClockEstimate | None) -> str:
    if clock is None:
        return "no gyro, no speeds of a left and a right wheel, or an unknown robot"
    if math.isnan(clock.offset_s):
        return str(clock.status)
    text = f"{clock.status}: offset {format_value(clock.offset_s, '+.3f')} ± {clock.offset_std_s:.3f} s"
    if not math.isnan(clock.rate):
        text += f", rate {format_value(100 * clock.rate, '+.2f')} ± {100 * clock.rate_std:.2f} %"
    return text
