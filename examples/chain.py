"""The whole chain on measured runs: slip, target slip by ground, and the commands that the pilot would have given.

TERRAIN_DATA=DIR python examples/chain.py robotino|warthog|husky|marmotte [--data FOLDER] [--out FOLDER] [--all]

With --data the robot may be any, by name or its YAML file.  Without --all some 120 runs of each data set are taken.
"""

import argparse
import os
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import terrain
from pipelines.live.pilot import LivePilot, pilot_classifier
from pipelines.report.figure import Figure, Line, Panel, Points
from pipelines.report.numbers import enumerated, format_value
from pipelines.report.tree import Column, Report, Table, Text, sections
from terrain.control.robot_control import PilotSettings
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.switching import KnownTerrain
from terrain.errors import DoubtfulRunWarning, TerrainError
from terrain.files.atomic import ensure_writable
from terrain.kinematics.logged_wheels import with_desired_twist
from terrain.logs.replay import SENSORS
from terrain.records import Array, Label, RunLog
from terrain.robots import Robot, load_robot
from terrain.slip_learning.measured import MeasuredSlip, measured_slip

DATA = {
    "robotino": ("robotino/one_surface",),
    "warthog": ("drive_warthog_terrains", "drive_recordings"),
    "husky": ("drive_recordings", "drive_husky"),
    "marmotte": ("drive_marmotte",),
}
"""What was measured of each robot, in ``$TERRAIN_DATA``."""
GROUND = {"drive_marmotte": "snow"}  #: That those who published runs name, and their log does not

N_RUNS, N_REPLAYED = 120, 6
LEAST_MPS = 0.03  #: Of the fastest wheel of a run that is replayed
SLIP = ".3f"


@dataclass
class Answer:
    """What the chain finds, in sentences, tables and pictures, and what it cannot know."""

    lead: list[str] = field(default_factory=list)
    parts: list[Any] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)


def deal(runs: Sequence[RunLog], n: int) -> tuple[list[RunLog], list[RunLog]]:
    """Return about n runs, as many of each ground, to learn from and held out.

    Held out is the last session of a ground, of one with a single session every third of its runs.
    """
    rng, parts = np.random.default_rng(0), ([], [])  # type: tuple[Any, tuple[list[RunLog], list[RunLog]]]
    grounds = sorted({run.terrains for run in runs})
    for ground in grounds:
        own = [run for run in runs if run.terrains == ground]
        last, several = max(run.session for run in own), len({run.session for run in own}) > 1
        for place, i in enumerate(rng.permutation(len(own))[: n // len(grounds)].tolist()):
            parts[own[i].session == last if several else place % 3 == 2].append(own[i])
    learn, held = (sorted(part, key=lambda run: run.run_id) for part in parts)
    return learn, held


def slips(learn: Sequence[RunLog], held: Sequence[RunLog], robot: Robot, answer: Answer) -> None:
    """Measure slip by windows and by the filter, compare them, and predict it without the outside measurement."""
    runs = [*learn, *held]
    window_s = 2.0 if all("pose" in run.streams for run in runs) else 0.5
    options: dict[str, Any] = {"filter": "pose", "window_s": window_s, "stride_s": window_s / 2}
    currents = [name for name in runs[0].streams["wheels"].channels if name.startswith("current_")]
    measured = terrain.estimate(runs, robot, **options)
    for row in measured.result.surfaces:
        found = format_value(row.slip_ratio, SLIP) if np.isfinite(row.slip_ratio) else "an unknown slip"
        answer.lead.append(f"{found} on {row.terrain or '(no label)'}")
    answer.lead = [f"{robot.name} slips by {enumerated(answer.lead)}"]
    if lacking := measured.result.not_measured:
        answer.unknown.append(f"slip of {len(lacking)} of {len(runs)} runs; the first: {lacking[0]}")
    if "lidar" in measured.result.sources:
        answer.unknown.append("slip within a twist of the lidar, which is the mean over its scans")
    if currents:
        again = {run.session for run in held} - {run.session for run in learn}
        try:
            tracks = terrain.estimate(runs, robot, **options, predict=True, hold_out=tuple(sorted(again)))
            rows = tracks.result.predictions
            first = rows[0]
            answer.lead.append(
                f"without the outside measurement slip of held-out {first.held_out} is off by {first.rms:.3f} rms, "
                f"{format_value(first.coverage, '.0%')} inside its 95 %"
            )
            columns = (
                *(Column(name, of=at) for name, at in (("held out", "held_out"), ("runs", "n_runs"))),
                *(Column("RMS error", SLIP, of="rms"), Column("inside 95 %", ".0%", of="coverage")),
            )
            answer.parts.append(Table(columns, rows, "slip by wheel speeds and currents alone"))
        except TerrainError as error:
            answer.unknown.append(f"slip without the outside measurement: {error}")
        if not any((run.streams["wheels"].columns(currents) < 0.0).any() for run in runs):
            answer.unknown.append("whether a wheel drives or brakes: the currents have no sign")
    else:
        answer.unknown.append("slip without the outside measurement: the log has no motor currents")
    late_s, windows = {name: each.applied_s for name, each in measured.result.delays.items()}, []
    for run in measured.runs:
        windows.append(
            measured_slip(run, robot, window_s=window_s, stride_s=window_s / 2, delay_s=late_s[run.session])
        )
    compare(terrain.estimate(runs, robot, filter="slip").runs, windows, answer)


def compare(filtered: Sequence[RunLog], windows: Sequence[MeasuredSlip], answer: Answer) -> None:
    """Hold the slip of wheels by the filter, its mean over windows of steady motion, against that of the windows."""
    streams, pairs = {run.run_id: run.streams["slip"] for run in filtered}, [np.empty((0, 2))]
    for window in windows:
        own = streams[window.run_id]
        wheels = [f"slip_{wheel}_ratio" for wheel in window.wheels]
        for k in np.flatnonzero(window.steady):
            within = (own.time_s >= window.start_s[k]) & (own.time_s <= window.end_s[k])
            if within.any():
                pairs.append(
                    np.column_stack([window.slip_ratio[k], own.columns(wheels)[within].mean(axis=0)])
                )
    both = np.concatenate(pairs)
    both = both[np.isfinite(both).all(axis=1)]
    off = float(np.median(np.abs(both[:, 0] - both[:, 1]))) if len(both) else np.nan
    text = f"By filter and by windows the slips of wheels differ by {off:.3f} in the median of {len(both)}."
    shown = both[:: max(len(both) // 2000, 1)]
    marks = [Points("a wheel in a window", *shown.T), Line("equal", [-1.0, 1.0], [-1.0, 1.0], 4)]
    panel = Panel(marks, "by the filter", x_range=(-1.0, 1.0), y_range=(-1.0, 1.0))
    answer.figures.append(Figure("Slip of wheels", [panel], text, "by windows"))
    answer.parts.append(Text(text))
    answer.unknown.append(
        "which of filter and windows is right: both use the same measurement from outside and the same wheel radius"
    )


def targets(learn: Sequence[RunLog], held: Sequence[RunLog], robot: Robot, answer: Answer) -> SlipTable:
    """Learn target slips, and hold them against runs held out; the packaged table where none can be learned."""
    try:
        table = terrain.learn_slip(learn, robot)
    except TerrainError as error:
        answer.unknown.append(f"target slips: {error}; the fallback's are aimed for")
        return load_slip_table()
    try:
        shown = terrain.learn_slip(held, robot).surfaces
    except TerrainError as error:
        answer.unknown.append(f"what target slips are worth on runs held out: {error}")
        shown = {}
    rows, assumed = [], list[str]()
    for name, surface in table.surfaces.items():
        slip, steady = surface["slip"], surface["targets"]["steady"]
        there = shown[name]["slip"].slip_ratio if name in shown else np.nan
        rows.append((name, slip.n_sessions, slip.n_runs, steady["slip_ratio"], slip.interval, there))
        if steady["status"] != "estimated":
            assumed.append(name)
            answer.unknown.append(f"target slip on {name}: {surface['reason']}")
    ones = [name for name, surface in table.surfaces.items() if surface["slip"].n_sessions == 1]
    if ones:
        answer.unknown.append(f"slip on another day on {enumerated(ones)}: it was learned in one session")
    numbers = (
        *("ground", "sessions", "runs"),
        *(Column(each, SLIP) for each in ("target", "95 %", "held out")),
    )
    answer.parts.append(Table(numbers, rows, "steady target slips, and the slip of runs held out"))
    off = [abs(row[3] - row[5]) for row in rows if row[0] not in assumed and np.isfinite(row[5])]
    if off:
        answer.lead.append(f"target slips are off by at most {max(off):.3f} on runs held out")
    answer.unknown.append("the peak of thrust, which steady driving does not show: other targets are assumed")
    return table


def classifier(learn: Sequence[RunLog], held: Sequence[RunLog], answer: Answer) -> Any:
    """Return a model of the grounds; None where there is one ground alone, or none can be learned."""
    if len({run.terrains for run in learn}) < 2:
        answer.unknown.append("the ground, live: one alone is not classified, it is taken as labelled")
        return None
    answers = any(name.startswith("current_") for name in learn[0].streams["wheels"].channels)
    try:
        model = terrain.TerrainClassifier("response" if answers else "svm")
        model.fit(terrain.cut_windows(learn, length_s=2.0))
        windows = terrain.cut_windows(held, length_s=2.0)
        right = model.score(windows, windows.terrain)
    except TerrainError as error:
        answer.unknown.append(f"the ground, live, which is taken as labelled: {error}")
        return None
    answer.parts.append(
        Text(f"Of the windows of runs held out {format_value(right, '.0%')} are classified rightly.")
    )
    return model.model_


def speeds(run: RunLog, robot: Robot) -> Array:
    """Return the speed (wheels, n) of each wheel in m/s."""
    return run.streams["wheels"].columns([f"speed_{wheel}_mps" for wheel in robot.wheels]).T


def replayed(
    runs: Sequence[RunLog], robot: Robot, table: SlipTable, model: Any, answer: Answer
) -> list[Array]:
    """Return, a run each, time, what the pilot would have commanded, and what was driven, in rad/s of the wheels."""
    runs = [
        run for run in runs if "commands" in run.streams and np.nanmax(np.abs(speeds(run, robot))) > LEAST_MPS
    ]
    found, rows, limit = [], [], robot.completed.motors.speed_max_radps
    for run in runs[:: max(len(runs) // N_REPLAYED, 1)][:N_REPLAYED]:
        channels = {name: stream.channels for name, stream in run.streams.items() if name in SENSORS}
        source = KnownTerrain() if model is None else pilot_classifier(model, robot, channels=channels)
        pilot = LivePilot(robot, table, source, PilotSettings(follows=False), channels)
        steps = [
            [sample.time_s, *pilot.take(sample).command.wheel_radps]
            for sample in terrain.replay(with_desired_twist(run, robot))
        ]
        (time_s, *commands), wheel_s = np.array(steps).T, run.streams["wheels"].time_s
        driven = (
            np.array([np.interp(time_s, wheel_s, each) for each in speeds(run, robot)]) / robot.wheel_radius_m
        )
        found.append(np.column_stack([time_s, *commands, *driven]))
        size, moved = np.abs(commands), np.abs(driven)
        about = run.run_id, pilot.belief.terrain or "unknown", pilot.target_ratio
        rows.append((*about, size.sum() / moved.sum(), size.max(), moved.max()))
    columns = (
        *("run", "ground believed", Column("target slip", SLIP), Column("commanded over driven", ".2f")),
        *(Column(f"fastest {each}", ".1f", "rad/s") for each in ("command", "wheel")),
    )
    open_loop = "The loop is open: the robot did what another controller commanded."
    if not rows:
        answer.unknown.append("commands: no run that was held out drives and has the stream 'commands'")
        return found
    answer.parts.append(Table(columns, rows, "runs held out through the live chain", open_loop))
    answer.unknown.append("what the commands would have done: in a replay no correction shows its effect")
    within = (
        f", and {'within' if max(row[4] for row in rows) <= limit + 1e-9 else 'NOT within'} the motors' limit"
    )
    if limit == np.inf:
        within = ""
        answer.unknown.append("whether motors can follow: the robot's description names no fastest speed")
    finite = "finite" if np.isfinite(np.concatenate(found)).all() else "NOT finite"
    ratios = [row[3] for row in rows]
    answer.lead.append(
        f"commands of {len(rows)} replayed runs are {finite}{within}, {min(ratios):.2f} to {max(ratios):.2f} of what "
        "was driven"
    )
    most = int(np.argmax([np.abs(each[:, 1 + len(robot.wheels) :]).sum() for each in found]))
    time_s, *series = found[most].T
    panels = []
    for i, wheel in enumerate(robot.wheels):
        lines = (
            Line("commanded", time_s, series[i], 0),
            Line("driven", time_s, series[i + len(robot.wheels)], 1),
        )
        panels.append(Panel(lines, f"wheel {wheel} [rad/s]"))
    title = f"{rows[most][0]}: commands of the pilot, and what was driven"
    answer.figures.insert(0, Figure(title, panels, open_loop, "time in s"))
    return found


def chain(folder: Path, name: str, every: bool = False) -> Report:
    """Return what the chain finds in the runs of a robot in a folder."""
    robot, answer = load_robot(name), Answer()
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always", DoubtfulRunWarning)
        runs = [run for run in terrain.load_runs(folder, robot=name) if run.robot == robot.name]
    names = {run.run_id for run in runs}
    if about := [text for text in (str(each.message) for each in doubts) if text.partition(":")[0] in names]:
        answer.unknown.append(f"whether all is as logged, in {len(about)} doubts; the first: {about[0]}")
    if ground := GROUND.get(folder.name):
        runs = [replace(run, labels=(Label(0.0, run.end_s, ground),)) for run in runs]
        answer.unknown.append(
            f"whether the ground is {ground} throughout: its publishers say so, not the log"
        )
    learn, held = deal(runs, len(runs) * len(runs) if every else N_RUNS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulRunWarning)  # those are stated
        slips(learn, held, robot, answer)
        table = targets(learn, held, robot, answer)
        replayed(held, robot, table, classifier(learn, held, answer), answer)
    return Report(
        f"The whole chain of {robot.name}, {folder.name}",
        f"{'; '.join(answer.lead)}.",
        answer.figures[0],
        [*answer.parts, *[Text(f"Not known: {each.rstrip('.?')}.", "note") for each in answer.unknown]],
        sections(("Pictures", answer.figures[1:])),
        lead=f"{len(learn) + len(held)} of {len(runs)} runs, {len(held)} of them held out whole",
    )


def main(arguments: Sequence[str] | None = None) -> list[Report]:
    """Print the report of each data set, and write their pages."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robot", help=f"one of {', '.join(DATA)}; any with --data")
    parser.add_argument("--data", type=Path, help="folder of runs, in place of those in TERRAIN_DATA")
    parser.add_argument("--out", type=Path, help="folder of the pages")
    parser.add_argument("--all", action="store_true", help="take all runs")
    asked = parser.parse_args(arguments)
    if asked.data is None and (asked.robot not in DATA or "TERRAIN_DATA" not in os.environ):
        parser.error(f"name one of {', '.join(DATA)} with TERRAIN_DATA set, or a folder with --data")
    place = Path(os.environ.get("TERRAIN_DATA", ""))
    reports = []
    for folder in [place / each for each in DATA[asked.robot]] if asked.data is None else [asked.data]:
        reports.append(chain(folder, asked.robot, asked.all))
        print(reports[-1])
        if asked.out is not None:
            ensure_writable(asked.out)
            print(f"page: {reports[-1].save(asked.out / f'{Path(asked.robot).stem}_{folder.name}.html')}")
    return reports


if __name__ == "__main__":
    try:
        main()
    except TerrainError as error:
        sys.exit(f"error: {error}")
