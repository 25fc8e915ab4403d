"""A log through the live chain, as it would come from the robot: terrain, belief and target slip as they are found."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from threading import Event
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from features.windows import label_windows
from pipelines.data.datasets import load
from pipelines.data.inspect import Settings as InspectSettings
from pipelines.data.settings import ReadSettings
from pipelines.live.chain import Chain
from pipelines.live.model import TerrainModel, training_words
from pipelines.live.pilot import LivePilot
from pipelines.live.session import chain_of
from pipelines.live.windows import needs_filter
from pipelines.report.figure import Figure, Line, Panel, Strip
from pipelines.report.numbers import format_counts, format_value, plain_line, plural
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.tree import Column, Part, Report, Table, Text, sections
from pipelines.serve.serve import Settings, loaded, stopping
from terrain.control.robot_control import PilotSettings, check_table
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.discrepancy.runs import in_order
from terrain.discrepancy.watch import BLOCK_S, WORDS, Alarm, Watch, clock_text, read_watched
from terrain.errors import ConfigError, DataError
from terrain.estimation.live import CHANNELS
from terrain.kinematics.logged_wheels import with_desired_twist
from terrain.logs.replay import SENSORS, replay
from terrain.records import RunLog
from terrain.robots import Robot, load_robot, robot_named

if TYPE_CHECKING:
    import pandas as pd

UNNEEDED = "confidence_ratio"
"""Channel that the pilot does without: other cameras than AgriMaRo's do not give it."""

UNKNOWN = "unknown"

SLIP, PERCENT = ".3f", ".1%"

MAX_STRIPS = 8  #: Runs in the picture


class ObservedWindow(NamedTuple):
    """A window as the live chain saw it."""

    #: start_s, end_s: on the clock of the run
    start_s: float
    end_s: float
    #: terrain, probability: output of the model; empty and NaN where it refused the window
    terrain: str
    probability: float
    refused: str  #: why it did
    believed: str  #: terrain that was believed from then on; empty while it was unknown
    target_ratio: float  #: target slip in traction of the believed terrain
    label: str | None  #: of the run, where one covers the whole window

    def __str__(self) -> str:
        named = f"{self.terrain} {format_value(self.probability, '.0%')}" if self.terrain else UNKNOWN
        return (
            f"{self.end_s:.2f} s  {f'refused: {self.refused}' if self.refused else named}  "
            f"believed {self.believed or UNKNOWN}  target slip {format_value(self.target_ratio, SLIP)}"
        )


@dataclass(frozen=True)
class Replayed:
    """Figures of one run, and of all."""

    n_windows: int = described("windows that were cut")
    accuracy: float | None = described(
        "windows classified rightly, of those whose label is a class of the model", "1"
    )
    n_judged: int = described("number of those windows")
    duration_s: float = described("length of what was replayed", "s")
    elapsed_s: float = described("how long that took", "s")
    times_real_time: float = described("their ratio", "1")
    interrupted: bool = described("the replay was stopped before its end")


def replayed(
    windows: Sequence[ObservedWindow],
    model: TerrainModel | None,
    duration_s: float,
    elapsed_s: float,
    *,
    interrupted: bool,
) -> dict[str, Any]:
    """Return the figures of windows, of which those are judged whose label is a class of the model."""
    classes = () if model is None else model.info.classes
    right = [each.terrain == each.label for each in windows if not each.refused and each.label in classes]
    return {
        "n_windows": len(windows),
        "accuracy": float(np.mean(right)) if right else None,
        "n_judged": len(right),
        "duration_s": duration_s,
        "elapsed_s": elapsed_s,
        "times_real_time": duration_s / elapsed_s if elapsed_s else math.nan,
        "interrupted": interrupted,
    }


@dataclass(frozen=True)
class ReplayedRun(Replayed):
    """One run."""

    run_id: str = described("name of the run")
    robot: str = described("whose it is")
    chain: str = described("pilot, or observer of a robot without one")
    n_steps: int = described("steps of the chain")
    n_refused: int = described("windows without an output")
    terrains: Mapping[str, float] = described("fraction of the windows with an output, by terrain", "1")
    believed: Mapping[str, float] = described("fraction of steps by believed terrain; empty for unknown", "1")
    dropped: Mapping[str, int] = described("what the chain did not use, as counts by kind")
    windows: tuple[ObservedWindow, ...] = described("each window as the chain saw it")


class WatchedBlock(NamedTuple):
    """How near each channel is to an alarm, at 1, after a block of a run."""

    run_id: str
    start_s: float  #: on the clock of the run, and of all driving
    driven_s: float
    why: str  #: it could not be compared; empty where it could
    levels: Mapping[str, float]


class ReplayResult(Result, Replayed):
    """All runs, and the same figures over all of them; the accuracy is of runs that were not in training."""

    model: str | None = described("as it was named")
    table_name: str = described("table of target slips")
    runs: tuple[ReplayedRun, ...] = described("terrain, belief and windows of each run")
    training_runs: tuple[str, ...] = described("runs that were in training")
    training_accuracy: float | None = described("as the accuracy, of those; it says nothing of others", "1")
    n_judged_training: int = described("windows of those that were judged")
    skipped: tuple[str, ...] = described("a sentence for each run that could not be read")
    watch: str | None = described("extended robot that the runs were compared with", default=None)
    watch_doubt: str = described("why alarms may come more often than asked for", default="")
    alarms: tuple[Alarm, ...] = described(
        "departures from it, in the order in which they were raised", default=()
    )
    blocks: tuple[WatchedBlock, ...] = described("the comparison, some seconds each", default=())

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a window."""
        import pandas as pd

        rows = [{"run_id": run.run_id, **window._asdict()} for run in self.runs for window in run.windows]
        return pd.DataFrame(rows, columns=["run_id", *ObservedWindow._fields])


def run(settings: Settings, progress: Progress = silent) -> ReplayResult:
    """Replay all runs of a log, one after the other; Ctrl-C and SIGTERM end it with what was found until then.

    A line is printed for each window at which the classified or the believed terrain changes.
    """
    assert settings.replay is not None
    table, model = load_slip_table(settings.table), loaded(settings, settings.model)
    read = {name: getattr(settings, name) for name in ("robot", *ReadSettings.model_fields)}
    logs, skipped, doubts = load(InspectSettings(data=settings.replay, **read), refuse=False)
    robot = None if settings.robot is None else load_robot(settings.robot)
    watch, blocks = None, list[WatchedBlock]()
    if settings.watch is not None:
        logs = in_order(logs)
        watch = Watch(read_watched(settings.watch), None, settings.false_alarm_h)
        robot, name = robot or watch.watched.robot, watch.watched.robot.name
        if others := [each for each in logs if each.robot != name]:
            raise ConfigError(
                f"run {others[0].run_id} is of the robot {others[0].robot!r}, {settings.watch} of {name!r}"
            )
    runs: list[ReplayedRun] = []
    stop = Event()
    with stopping(stop.set):
        for each in logs:
            chain = chain_of_run(each, model, table, robot, watch is not None)
            if isinstance(chain, LivePilot):
                each = with_desired_twist(each, robot_named(each.robot, robot))
            runs.append(replay_run(each, chain, settings, progress, stop, watch, blocks))
            if runs[-1].interrupted:
                break
    trained = {log.run_id for log in logs if model is not None and model.info.trained_on(log)}
    parts = ([run for run in runs if (run.run_id in trained) is known] for known in (False, True))
    figures, of_trained = (
        replayed(
            [window for each in part for window in each.windows],
            model,
            sum(each.duration_s for each in runs),
            sum(each.elapsed_s for each in runs),
            interrupted=any(each.interrupted for each in runs),
        )
        for part in parts
    )
    return ReplayResult(
        **figures | {"n_windows": figures["n_windows"] + of_trained["n_windows"]},
        training_runs=tuple(run.run_id for run in runs if run.run_id in trained),
        training_accuracy=of_trained["accuracy"],
        n_judged_training=of_trained["n_judged"],
        model=settings.model,
        table_name=table.name,
        runs=tuple(runs),
        skipped=tuple(skipped),
        watch=None if settings.watch is None else str(settings.watch),
        watch_doubt="" if watch is None else watch.watched.doubt,
        alarms=() if watch is None else tuple(watch.alarms),
        blocks=tuple(blocks),
    ).with_doubts(doubts)


def chain_of_run(
    run: RunLog,
    model: TerrainModel | None,
    table: SlipTable,
    robot: Robot | None = None,
    watched: bool = False,
) -> Chain:
    """Return the live chain of a run's robot.

    Parameters
    ----------
    run : to be replayed
    model, table : of the chain
    robot : description of the robot of runs that bear its name; the package's by default
    watched : whether it is compared with its model, and needs no other

    Raises
    ------
    ConfigError
        if the robot has no pilot and there is no model.
    DataError
        if the run lacks what the model or the pilot needs, or the table is another robot's.
    """
    channels = {name: stream.channels for name, stream in run.streams.items() if name in SENSORS}
    found: Robot | None = None
    try:
        found = robot_named(run.robot, robot)
    except ConfigError:
        if model is None or needs_filter(model.info, channels):
            raise
    pilot, commands = None, model is None and not watched
    if found is not None and ((found.drive == "swerve" and model is not None) or commands):
        pilot = PilotSettings(follows=False)  # another controller drove when the log was written
        required = CHANNELS if found.drive == "swerve" else {"wheels": found.rate_channels}
        for name in channels.keys() & required.keys():
            if lacking := [each for each in required[name] if each not in (*channels[name], UNNEEDED)]:
                raise DataError(
                    f"run {run.run_id}: stream {name} has no channel {lacking[0]!r} for the pilot"
                )
    try:
        check_table(table, run.robot)
        return chain_of(found, channels, model, table, pilot, watched=watched)
    except (ConfigError, DataError) as error:
        raise DataError(f"run {run.run_id}: {error}") from error


def replay_run(
    run: RunLog,
    chain: Chain,
    settings: Settings,
    progress: Progress = silent,
    stop: Event | None = None,
    watch: Watch | None = None,
    blocks: list[WatchedBlock] | None = None,
) -> ReplayedRun:
    """Send one run through a live chain, each step when it is due.

    Parameters
    ----------
    run : to be replayed
    chain : of its robot, before its first step
    settings : speed and rate of the steps
    progress : of the seconds of the run
    stop : ends it where it is set
    watch, blocks : compares the run with a model, and where its blocks are added
    """
    stop, blocks = stop or Event(), [] if blocks is None else blocks
    driven_s = blocks[-1].driven_s if blocks else 0.0
    if watch is not None:
        watch.begin(run.run_id)
    windows: list[ObservedWindow] = []
    believed: Counter[str] = Counter()
    passed_s, start_s, interrupted = 0.0, math.nan, False
    end_s = max(stream.time_s[-1] for stream in run.streams.values())
    begin_s = perf_counter()
    for sample in replay(run, settings.rate_hz):
        if interrupted := stop.is_set():
            break
        start_s = sample.time_s if math.isnan(start_s) else start_s
        if int(sample.time_s - start_s) > int(passed_s):
            progress(f"replay {run.run_id}, s", int(sample.time_s - start_s), math.ceil(end_s - start_s))
        passed_s = sample.time_s - start_s
        stop.wait(max(begin_s + passed_s / (settings.speed or math.inf) - perf_counter(), 0.0))
        done = chain.take(sample)
        if watch is not None:
            for block in watch.step(sample.readings):
                driven_s += BLOCK_S
                blocks.append(WatchedBlock(run.run_id, block.start_s, driven_s, block.why, watch.levels))
            for sentence in watch.news:
                print(plain_line(f"{run.run_id}  {sentence}"), flush=True)
        belief = chain.belief.terrain
        believed[belief] += 1
        for output in done.windows:
            label = label_windows(run, np.array([output.start_s]), output.end_s - output.start_s)[0] or None
            known = output.start_s, output.end_s, output.terrain, output.probability, output.refused
            window = ObservedWindow(*known, belief, chain.target_ratio, label)
            before = windows[-1] if windows else None
            if before is None or (window.terrain, window.believed) != (before.terrain, before.believed):
                print(plain_line(f"{run.run_id}  {window}"), flush=True)
            windows.append(window)
    elapsed_s = perf_counter() - begin_s
    counts = Counter(window.terrain for window in windows if not window.refused)
    return ReplayedRun(
        **replayed(windows, chain.source.model, passed_s, elapsed_s, interrupted=interrupted),
        run_id=run.run_id,
        robot=run.robot,
        chain=chain.name,
        n_steps=believed.total(),
        n_refused=len(windows) - counts.total(),
        terrains={terrain: n / counts.total() for terrain, n in counts.most_common()},
        believed={terrain: n / believed.total() for terrain, n in believed.most_common()},
        dropped=dict(chain.dropped),
        windows=tuple(windows),
    )


def report(result: ReplayResult) -> Report:
    """Return what was found in the runs and how fast, a row a run, and what the chains did not use."""
    accuracy = ""
    if result.accuracy is not None:
        right = format_value(result.accuracy, PERCENT)
        of = " of runs that were not in training" if result.training_runs else ""
        accuracy = f", {right} of {result.n_judged} with a label{of} classified rightly"
    if result.training_runs:
        trained = len(result.training_runs), result.training_accuracy, result.n_judged_training
        accuracy += f"; {training_words(*trained)}"
    panels = []
    for run in result.runs[:MAX_STRIPS]:
        if run.windows:
            strip = Strip([(w.start_s, w.end_s, w.believed or UNKNOWN) for w in run.windows])
            panels.append(Panel([strip], title=run.run_id))
    unused = [f"{run.run_id}: not used {format_counts(run.dropped)}" for run in result.runs if run.dropped]
    watched = [] if result.watch is None else _watched(result)
    next_step = f"terrain serve --model {result.model}" if result.model else "terrain train --data RUNS"
    picture = Figure("Terrain that was believed", panels, x_label="time in s") if panels else None
    answer = (
        f"{plural(result.n_windows, 'window')} in {format_value(result.duration_s, '.1f', 's')} of driving"
        f"{accuracy}; {format_value(result.times_real_time, '.0f')} times real time."
    )
    if result.watch is not None:
        if result.alarms:
            what = f"--robot {result.runs[0].robot} --model {result.watch} --out OUT"
            next_step = f"terrain explain --data LOG {what}"
        elif not result.model:
            next_step = f"terrain serve --watch {result.watch}"
        compared = sum(not block.why for block in result.blocks)
        answer = (
            f"{plural(len(result.alarms), 'departure')} from {result.watch} in {compared * BLOCK_S:.0f} s of driving "
            f"that could be compared, of {result.duration_s:.0f} s."
        )
    notes = [Text(sentence, "warning") for sentence in result.skipped]
    if result.interrupted:
        notes.insert(0, Text("stopped before the end", "note"))
    return Report(
        "Replay of a log",
        answer,
        picture=picture if result.watch is None else _watch_figure(result),
        parts=[*watched, *([] if result.watch else [Table(COLUMNS, result.runs)]), *notes],
        details=sections(("Not used", unused or ("nothing",))),
        lead=f"model {result.model or 'none'}, table {result.table_name}",
        next_step=next_step,
    )


def _watched(result: ReplayResult) -> list[Part]:
    """Return the departures, and why blocks could not be compared."""
    rows = [
        (
            *(each.run_id, each.text, each.raised_s),
            f"{clock_text(each.over_s)} of {each.over_run_id}" if each.over_run_id else "",
            WORDS[each.channel][0],
        )
        for each in result.alarms
    ]
    heads = ("run", Column("departure", long=True), Column("raised", ".1f", "s"), "over", "channel")
    parts: list[Part] = [Table(heads, rows)] if rows else []
    whys = Counter(block.why for block in result.blocks if block.why)
    parts += [Text(f"{plural(n, 'block')} not compared: {why}", "note") for why, n in whys.most_common(3)]
    return [*parts, Text(result.watch_doubt, "note")] if result.watch_doubt else parts


def _watch_figure(result: ReplayResult) -> Figure | None:
    if not result.blocks:
        return None
    driven_s, panels = np.array([block.driven_s for block in result.blocks]), []
    for channel in result.blocks[0].levels:
        level = np.array([block.levels[channel] for block in result.blocks])
        limit = Line("alarm", driven_s, np.ones(len(level)), dashed=True)
        panels.append(Panel([Line("sum", driven_s, level), limit], title=WORDS[channel][0]))
    caption = (
        "The largest of the channel's sums over the threshold of an alarm, which is held until the sum is 0."
    )
    return Figure("Departure from the model", panels, caption, x_label="driving in s")


def _fractions(found: Mapping[str, float]) -> str:
    return ", ".join(f"{terrain or UNKNOWN} {format_value(ratio, '.0%')}" for terrain, ratio in found.items())


COLUMNS = (
    Column("run", of="run_id"),
    Column("length", ".1f", "s", of="duration_s"),
    Column("windows", of="n_windows"),
    Column("accuracy", PERCENT, of="accuracy"),
    Column("times real time", ".0f", of="times_real_time"),
    Column("terrain", of=lambda run: _fractions(run.terrains)),
    Column("believed", of=lambda run: _fractions(run.believed)),
)
