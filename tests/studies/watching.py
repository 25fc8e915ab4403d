"""What ``terrain serve --watch`` says of measured runs that were held out, as they are and with a change written in.

A set is explained without some of its runs, whole sessions where there are several, and these are watched: as they
come, and drawn again and again for hours, which gives the rate of false alarms and the time until a change is noticed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipelines.data.datasets import load_runs
from pipelines.explain.explain import explain, watched_of
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from pipelines.report.tree import Column, Report, Table
from terrain.discrepancy.held_out import quarter, split_runs
from terrain.discrepancy.runs import in_order
from terrain.discrepancy.watch import BLOCK_S, Block, Status, Watch, Watched, blocks_of, simulation_of
from terrain.records import RunLog, Stream

EXAMPLE = "python tests/studies watching --data ~/sets/drive_husky --robot husky"
N_TIMES = 5  #: Orders in which changed runs are drawn
LONGEST_S = 3600.0  #: For so long they are watched


class Settings(BaseSettings):
    """Which set is watched."""

    data: Path = setting(..., "Set of runs, of which some are held out.")
    robot: str = setting(..., "Robot that drove them.")
    terrain: str | None = setting(None, "Use only runs of this label.")
    other: Path | None = setting(None, "Other runs of the robot, watched with the same model.")
    false_alarm_h: float = setting(100.0, "Hours in which one false alarm is asked for.", gt=0.0)
    hours: float = setting(100.0, "For which held-out runs are drawn.", gt=0.0)
    seed: int = setting(0, "Of the split and of the draws.", ge=0)


def scaled(stream: str, starts: tuple[str, ...], factor: float) -> Callable[[RunLog], RunLog]:
    """Return what multiplies the channels of a stream whose names begin with one of some."""

    def change(run: RunLog) -> RunLog:
        if stream not in run.streams:
            return run
        old = run.streams[stream]
        factors = [factor if name.startswith(starts) else 1.0 for name in old.channels]
        return replace(
            run, streams={**run.streams, stream: Stream(old.time_s, old.values * factors, old.channels)}
        )

    return change


def _turning_less(run: RunLog) -> RunLog:
    return scaled("lidar", ("yaw_rate",), 0.7)(scaled("imu", ("gyro_z",), 0.7)(run))


CHANGES: Mapping[str, Callable[[RunLog], RunLog]] = {
    "none": lambda run: run,
    "wheel radius -10 %": scaled("wheels", ("speed_", "motor_"), 1 / 0.9),
    "wheel radius -20 %": scaled("wheels", ("speed_", "motor_"), 1 / 0.8),
    "gyro +10 %": scaled("imu", ("gyro_z",), 1.1),
    "gyro +20 %": scaled("imu", ("gyro_z",), 1.2),
    "turns 30 % less": _turning_less,
    "currents +30 %": scaled("wheels", ("current_",), 1.3),
}
"""Changes that are written into logs; one that changes nothing of a set is left out."""


def _changes(changed: RunLog, run: RunLog) -> bool:
    """Return whether a change is one of a run."""
    pairs = [(stream.values, run.streams[name].values) for name, stream in changed.streams.items()]
    return not all(np.array_equal(new, old, equal_nan=True) for new, old in pairs)


class WatchedRuns(NamedTuple):
    """Some runs as they are, or changed."""

    runs: str  #: session, or which runs
    change: str
    compared_s: float  #: driving that could be compared
    alarms: int  #: in the runs as they come
    alarms_per_h: float  #: drawn again and again
    first_alarm_s: float  #: driving until then, median over draws; infinite without one
    says: str  #: the first alarms


class Watching(Result):
    """What a watch says of one set."""

    data: str = described("name of the set")
    false_alarm_h: float = described("one false alarm is asked for in so many hours", "h")
    n_quiet: int = described("runs behind the deviations")
    rows: tuple[WatchedRuns, ...] = described("runs as they are, and changed")


def watch_blocks(
    watched: Watched,
    by_run: Sequence[Sequence[Block]],
    settings: Settings,
    hours: float,
    seed: int,
    until_first: bool,
) -> tuple[Watch, float]:
    """Return the watch after runs that are drawn for some hours, or until the first alarm, and the driving in s."""
    watch, rng, driven_s = (
        Watch(watched, false_alarm_h=settings.false_alarm_h),
        np.random.default_rng(seed),
        0.0,
    )
    while driven_s < 3600.0 * hours:
        for block in by_run[int(rng.integers(len(by_run)))]:
            watch.take(block)
            driven_s += BLOCK_S
            if until_first and watch.alarms:
                return watch, driven_s
    return watch, driven_s


def watch_runs(
    name: str, change: str, runs: Sequence[RunLog], watched: Watched, settings: Settings
) -> WatchedRuns:
    """Watch some runs, changed."""
    simulation = simulation_of(watched.robot)
    by_run = [blocks_of(CHANGES[change](run), simulation, watched.clock_hz) for run in runs]
    watch = Watch(watched, false_alarm_h=settings.false_alarm_h)
    for block in [block for blocks in by_run for block in blocks]:
        watch.take(block)
    compared_s = BLOCK_S * sum(block.status is Status.AGREES for blocks in by_run for block in blocks)
    by_run = [blocks for blocks in by_run if blocks]
    rate, first, says = np.nan, np.nan, list[str]()
    if change == "none":
        drawn, driven_s = watch_blocks(watched, by_run, settings, settings.hours, settings.seed, False)
        rate = 3600.0 * len(drawn.alarms) / driven_s
    else:
        times = []
        for seed in range(settings.seed, settings.seed + N_TIMES):
            drawn, driven_s = watch_blocks(watched, by_run, settings, LONGEST_S / 3600.0, seed, True)
            times.append(driven_s if drawn.alarms else np.inf)
            says += [alarm.text.rpartition(" since")[0] for alarm in drawn.alarms[:1]]
        first = float(np.median(times))
    says += [alarm.text.rpartition(" since")[0] for alarm in watch.alarms]
    return WatchedRuns(name, change, compared_s, len(watch.alarms), rate, first, "; ".join(says[:2]))


def run(settings: Settings, progress: Progress = silent) -> Watching:
    """Explain a set without some of its runs, and watch these."""
    runs = [
        run
        for run in in_order(load_runs(settings.data, robot=settings.robot))
        if settings.terrain is None or run.terrains == (settings.terrain,)
    ]
    used, held_out = split_runs(runs, quarter(len(runs)), settings.seed)
    found = explain(used, settings.robot, seed=settings.seed)
    progress("explain", 1, 1)
    watched, quiet = watched_of(found, settings.data.name)
    groups: dict[str, list[RunLog]] = {}
    for run in held_out:
        groups.setdefault(run.session or "held out", []).append(run)
    changes = [
        name
        for name in CHANGES
        if name == "none" or any(_changes(CHANGES[name](each), each) for each in held_out)
    ]
    rows = []
    for name, own in groups.items():
        for change in changes:
            rows.append(watch_runs(name, change, own, watched, settings))
            progress("watch", len(rows), len(groups) * len(changes))
    if settings.other is not None:
        others = [run for run in load_runs(settings.other) if run.robot == watched.robot.name]
        rows.append(watch_runs(settings.other.name, "none", in_order(others), watched, settings))
    return Watching(settings.data.name, settings.false_alarm_h, len(quiet), tuple(rows))


def report(result: Watching) -> Report:
    """Return a row for each group of runs and change."""
    quiet = [row for row in result.rows if row.change == "none"]
    heads = (
        *("runs", "change", Column("compared", ".0f", "s"), "alarms", Column("alarms an hour", ".3f")),
        *(Column("first alarm", ".0f", "s"), Column("says", long=True)),
    )
    answer = (
        f"{sum(row.alarms for row in quiet)} alarms in {sum(row.compared_s for row in quiet):.0f} s of driving "
        f"as it is; one in {result.false_alarm_h:g} h is asked for."
    )
    return Report("Watching", answer, parts=[Table(heads, result.rows)])
