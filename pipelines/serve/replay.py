"""A log through the live chain, as it would come from the robot: terrain, belief and target slip as they are found."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from pipelines.report import (
    Column,
    Figure,
    Panel,
    Progress,
    Report,
    Result,
    Section,
    Strip,
    Table,
    Text,
    described,
    format_counts,
    format_value,
    plural,
    silent,
)

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd

    from pipelines.live.chain import Chain
    from pipelines.live.model import LiveModel
    from pipelines.serve.settings import Settings
    from terrain.control.slip_table import SlipTable
    from terrain.records import RunLog
    from terrain.robots import Robot

LONGEST_SLEEP_S = 0.2
"""A request to end is seen at least so often."""

UNNEEDED = "confidence_ratio"
"""Channel that the pilot does without: other cameras than AgriMaRo's do not give it."""

UNKNOWN = "unknown"

SLIP, PERCENT = ".3f", ".1%"


class ObservedWindow(NamedTuple):
    """A window as the live chain saw it.

    Parameters
    ----------
    start_s, end_s : on the clock of the run
    terrain, probability : output of the model; empty and NaN where it refused the window
    refused : why it did
    believed : terrain that was believed from then on; empty while it was unknown
    target_ratio : target slip in traction of the believed terrain
    label : of the run, where one covers the whole window
    """

    start_s: float
    end_s: float
    terrain: str
    probability: float
    refused: str
    believed: str
    target_ratio: float
    label: str | None

    def __str__(self) -> str:
        named = f"{self.terrain} {format_value(self.probability, '.0%')}" if self.terrain else UNKNOWN
        return (
            f"{self.end_s:.2f} s  {f'refused: {self.refused}' if self.refused else named}  "
            f"believed {self.believed or UNKNOWN}  target slip {format_value(self.target_ratio, SLIP)}"
        )


@dataclass(frozen=True, slots=True)
class ReplayedRun:
    """One run.

    Parameters
    ----------
    chain : ``pilot``, or ``observer`` of a robot without one
    duration_s, elapsed_s, times_real_time : length of what was replayed, how long that took, and their ratio
    terrains : fraction of the windows with an output, by terrain
    believed : fraction of the steps by terrain that was believed; empty for unknown
    accuracy : of the windows whose label is one of the model's classes; None without any
    n_judged : number of those
    dropped : what the chain did not use, as counts by kind
    interrupted : the replay was stopped before its end
    """

    run_id: str
    robot: str
    chain: str
    duration_s: float
    elapsed_s: float
    times_real_time: float
    n_steps: int
    n_windows: int
    n_refused: int
    terrains: Mapping[str, float]
    believed: Mapping[str, float]
    accuracy: float | None
    n_judged: int
    dropped: Mapping[str, int]
    interrupted: bool
    windows: tuple[ObservedWindow, ...]


@dataclass(frozen=True)
class ReplayResult(Result):
    """All runs, and the same figures over all of them."""

    model: str | None = described("as it was named")
    table_name: str = described("table of target slips")
    runs: tuple[ReplayedRun, ...] = described("terrain, belief and windows of each run")
    n_windows: int = described("windows that were cut")
    accuracy: float | None = described(
        "fraction of windows with a label that is a class that are classified rightly", "1"
    )
    n_judged: int = described("number of those windows")
    duration_s: float = described("length of what was replayed", "s")
    elapsed_s: float = described("how long that took", "s")
    times_real_time: float = described("their ratio", "1")
    interrupted: bool = described("the replay was stopped before its end")
    skipped: tuple[str, ...] = described("a sentence for each run that could not be read")

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a window."""
        import pandas as pd

        rows = [{"run_id": run.run_id, **window._asdict()} for run in self.runs for window in run.windows]
        return pd.DataFrame(rows, columns=["run_id", *ObservedWindow._fields])


def run(settings: Settings, log: Path, progress: Progress = silent) -> ReplayResult:
    """Replay all runs of a log, one after the other; Ctrl-C and SIGTERM end it with what was found until then.

    A line is printed for each window at which the classified or the believed terrain changes.

    Raises
    ------
    ConfigError, DataError, LogError, ModelError
        if the log, the model or the table cannot be read, or do not fit each other.
    """
    from threading import Event

    from pipelines.data.inspect import Settings as InspectSettings
    from pipelines.data.settings import ReadSettings, load
    from pipelines.learn.load import load_model
    from pipelines.live.over_time import filtered
    from pipelines.report.stopping import stopping
    from terrain.control.slip_table import load_slip_table
    from terrain.robots import load_robot

    table = load_slip_table(settings.table)
    model = None if settings.model is None else filtered(load_model(settings.model), settings.filter_stride_s)
    read = {name: getattr(settings, name) for name in ("robot", *ReadSettings.model_fields)}
    runs, skipped = load(InspectSettings(data=log, **read))
    robot = None if settings.robot is None else load_robot(settings.robot)
    replayed: list[ReplayedRun] = []
    stop = Event()
    with stopping(stop.set):
        for each in runs:
            chain = chain_of(each, model, table, robot)
            classes = () if model is None else model.info.classes
            replayed.append(replay_run(each, chain, settings, classes, progress, _Changes(), stop.is_set))
            if replayed[-1].interrupted:
                break
    duration_s, elapsed_s = (
        sum(getattr(one, name) for one in replayed) for name in ("duration_s", "elapsed_s")
    )
    n_judged = sum(one.n_judged for one in replayed)
    n_right = sum(one.n_judged * (one.accuracy or 0.0) for one in replayed)
    return ReplayResult(
        settings.model,
        table.name,
        tuple(replayed),
        sum(one.n_windows for one in replayed),
        n_right / n_judged if n_judged else None,
        n_judged,
        duration_s,
        elapsed_s,
        duration_s / elapsed_s if elapsed_s else math.nan,
        any(one.interrupted for one in replayed),
        tuple(skipped),
    )


class _Changes:
    """Prints a window where the classified or the believed terrain has changed."""

    def __init__(self) -> None:
        self._last: tuple[str, str] | None = None

    def __call__(self, run_id: str, window: ObservedWindow) -> None:
        from terrain.files.names import printable

        now = window.terrain, window.believed
        if now != self._last:
            print(printable(f"{run_id}  {window}"), flush=True)
        self._last = now


def chain_of(run: RunLog, model: LiveModel | None, table: SlipTable, robot: Robot | None = None) -> Chain:
    """Return the live chain of a run's robot.

    Parameters
    ----------
    run : to be replayed
    model, table : of the chain
    robot : description of the robot of runs that bear its name; the package's by default

    Raises
    ------
    ConfigError
        if the robot has no pilot and there is no model, or the table is another robot's.
    DataError
        if the run lacks what the model or the pilot needs.
    """
    from pipelines.live.observer import Observer
    from pipelines.live.pilot import LivePilot
    from pipelines.live.terrain_source import Classifier
    from pipelines.live.windows import needs_filter
    from terrain.control.pilot_settings import PilotSettings
    from terrain.errors import ConfigError, DataError
    from terrain.estimation.live.estimator import CHANNELS
    from terrain.logs.replay import SENSORS
    from terrain.robots import robot_named

    if table.robot and run.robot != table.robot:
        raise ConfigError(
            f"table {table.name} is for robot {table.robot!r}, run {run.run_id} is of {run.robot!r}"
        )
    channels = {name: stream.channels for name, stream in run.streams.items() if name in SENSORS}
    try:
        described = robot_named(run.robot, robot)
    except ConfigError:
        if model is None or needs_filter(model.info, channels):
            raise
        described = None  # the model needs none
    if described is not None and described.drive == "swerve":
        for name in channels.keys() & CHANNELS.keys():
            lacking = [channel for channel in CHANNELS[name] if channel not in channels[name]]
            if set(lacking) - {UNNEEDED}:
                raise DataError(
                    f"run {run.run_id}: stream {name} has no channel {lacking[0]!r} for the pilot"
                )
        settings = PilotSettings(follows=False)  # another controller drove when the log was written
        return LivePilot(described, table, Classifier(model, described), settings, channels=channels)
    if model is None:
        raise ConfigError(f"run {run.run_id}: robot {run.robot!r} has no pilot: give a model with --model")
    try:
        return Observer(model, table, described, channels)
    except (ConfigError, DataError) as error:
        raise DataError(f"run {run.run_id}: {error}") from error


def replay_run(
    run: RunLog,
    chain: Chain,
    settings: Settings,
    classes: tuple[str, ...] = (),
    progress: Progress = silent,
    observed: Callable[[str, ObservedWindow], None] = lambda run_id, window: None,
    stopped: Callable[[], bool] = lambda: False,
) -> ReplayedRun:
    """Send one run through a live chain, each step when it is due.

    Parameters
    ----------
    run : to be replayed
    chain : of its robot, before its first step
    settings : speed and rate of the steps
    classes : labels by which windows are judged
    progress : of the seconds of the run
    observed : is given each window
    stopped : asked at each step whether it ends there
    """
    from time import perf_counter

    import numpy as np

    from features.windows import label_windows
    from terrain.logs.replay import replay

    windows: list[ObservedWindow] = []
    believed: Counter[str] = Counter()
    passed_s, start_s, interrupted = 0.0, math.nan, False
    end_s = max(stream.time_s[-1] for stream in run.streams.values())
    speed, begin_s = settings.speed_ratio, perf_counter()
    for sample in replay(run, settings.rate_hz):
        interrupted = stopped()
        if interrupted:
            break
        start_s = sample.time_s if math.isnan(start_s) else start_s
        if int(sample.time_s - start_s) > int(passed_s):
            progress(f"replay {run.run_id}, s", int(sample.time_s - start_s), math.ceil(end_s - start_s))
        passed_s = sample.time_s - start_s
        if speed < math.inf:
            _wait(begin_s + passed_s / speed, stopped)
        done = chain.take(sample)
        belief = chain.belief.terrain
        believed[belief] += 1
        for output in done.windows:
            label = label_windows(run, np.array([output.start_s]), output.end_s - output.start_s)[0]
            window = ObservedWindow(
                output.start_s,
                output.end_s,
                output.terrain,
                output.probability,
                output.refused,
                belief,
                chain.target_ratio,
                label or None,
            )
            windows.append(window)
            observed(run.run_id, window)
    elapsed_s = perf_counter() - begin_s
    given = [window for window in windows if not window.refused]
    judged = [window for window in given if window.label in classes]
    counts = Counter(window.terrain for window in given)
    return ReplayedRun(
        run.run_id,
        run.robot,
        chain.name,
        passed_s,
        elapsed_s,
        passed_s / elapsed_s if elapsed_s else math.nan,
        believed.total(),
        len(windows),
        len(windows) - len(given),
        {terrain: n / len(given) for terrain, n in counts.most_common()},
        {terrain: n / believed.total() for terrain, n in believed.most_common()},
        float(np.mean([window.terrain == window.label for window in judged])) if judged else None,
        len(judged),
        dict(chain.dropped),
        interrupted,
        tuple(windows),
    )


def _wait(until_s: float, stopped: Callable[[], bool]) -> None:
    from time import perf_counter, sleep

    while (rest_s := until_s - perf_counter()) > 0.0 and not stopped():
        sleep(min(rest_s, LONGEST_SLEEP_S))


def report(result: ReplayResult) -> Report:
    """Return what was found in the runs and how fast, a row a run, and what the chains did not use."""
    accuracy = (
        f", {format_value(result.accuracy, PERCENT)} of {result.n_judged} with a label classified rightly"
        if result.accuracy is not None
        else ""
    )
    columns = (
        Column("run"),
        Column("length", ".1f", "s"),
        Column("windows"),
        Column("accuracy", PERCENT),
        Column("times real time", ".0f"),
        Column("terrain"),
        Column("believed"),
    )
    rows = [
        (
            run.run_id,
            run.duration_s,
            run.n_windows,
            run.accuracy,
            run.times_real_time,
            _fractions(run.terrains),
            _fractions(run.believed),
        )
        for run in result.runs
    ]
    unused = [f"{run.run_id}: not used {format_counts(run.dropped)}" for run in result.runs if run.dropped]
    notes = [Text(f"skipped: {sentence}", "warning") for sentence in result.skipped]
    if result.interrupted:
        notes.insert(0, Text("stopped before the end", "note"))
    return Report(
        "Replay of a log",
        f"{plural(result.n_windows, 'window')} in {format_value(result.duration_s, '.1f', 's')} of driving{accuracy}; "
        f"{format_value(result.times_real_time, '.0f')} times real time.",
        picture=_picture(result.runs),
        parts=[Table(columns, rows), *notes],
        details=[Section("Not used", [Text(each) for each in unused or ("nothing",)])],
        lead=f"model {result.model or 'none'}, table {result.table_name}",
        next_step=f"terrain serve --model {result.model}" if result.model else "terrain train --data RUNS",
    )


MAX_STRIPS = 8
"""Runs in the picture."""


def _picture(runs: tuple[ReplayedRun, ...]) -> Figure | None:
    """Return the terrain that was believed over time, a strip a run; None where there is no window."""
    panels = [
        Panel([Strip([(w.start_s, w.end_s, w.believed or UNKNOWN) for w in run.windows])], title=run.run_id)
        for run in runs[:MAX_STRIPS]
        if run.windows
    ]
    return Figure("Terrain that was believed", panels, x_label="time in s") if panels else None


def _fractions(found: Mapping[str, float]) -> str:
    return ", ".join(f"{terrain or UNKNOWN} {format_value(ratio, '.0%')}" for terrain, ratio in found.items())
