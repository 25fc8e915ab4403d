"""Sensor faults in the closed loop, a row for each fault, duration, situation and seed.

A drive with a fault is compared with two others in the same place: the clean one, by the same controller
without the fault, and the plain one, by the commands of the kinematics, which no sensor fault touches.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from pipelines.drive.drive import ALL, Settings
from pipelines.learn.parallel import parallel
from pipelines.live.pilot import LivePilot
from pipelines.report.figure import Figure, Line, Panel, Strip
from pipelines.report.numbers import NOT_KNOWN, plural
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.tree import Column, Pairs, Report, Table, sections
from pipelines.report.versions import versions
from terrain.control.fault_drives import (
    BARS,
    LIMITS,
    STOP,
    BarCount,
    FaultCase,
    FaultLoop,
    FaultRow,
    Limits,
    Place,
    References,
    clean_drive,
    count_bars,
    drive_case,
    drive_references,
    evaluate_case,
    make_fault_situation,
)
from terrain.control.learned_table import simulated_table
from terrain.control.robot_control import PilotSettings
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.switching import KnownTerrain
from terrain.errors import ConfigError
from terrain.robots import Robot, load_robot
from terrain.simulation.assumed import with_assumed
from terrain.simulation.faults import fault_catalogue, select_faults

DELAY_S = PilotSettings().delay_s  #: From a sample to the wheel
LEARNING_SEED = 5000  #: Of the simulated runs that targets are learned from; seeds of drives are far below

MET = "met"
SHOWN_FAULTS = 8  #: Faults with unmet bars that the answer's table has
BEFORE_S = 1.0  #: Shown before the fault
FASTEST_MPS = 10.0  #: Estimates of the speed beyond this, as a fault may cause, are not drawn


class FaultsResult(Result, eq=False):
    """Sensor faults in the closed loop."""

    robot: str = described("that was driven")
    table: str = described("name of its target slips")
    seeds: tuple[int, ...] = described("of the drives")
    delay_s: float = described("from a sample to the wheel", "s")
    limits: Limits = described("of the figures")
    abouts: Mapping[str, str] = described("what each fault does, by its name")
    clean: tuple[Mapping[str, Any], ...] = described("drives without a fault")
    rows: tuple[FaultRow, ...] = described("drives with one")
    bars: Mapping[str, BarCount] = described("each bar over all rows")
    n_rows: int = described("drives with a fault")
    n_met: int = described("those of them that meet all bars")
    drawn: tuple[Figure, ...] = ()

    def records(self) -> Iterable[Any]:
        """Return the drives with a fault, a row each."""
        return self.rows


def run(settings: Settings, progress: Progress) -> FaultsResult:
    """Drive each fault in each situation, with the robot and the table of the settings."""
    robot = with_assumed(load_robot(settings.robot))
    slips = None if settings.table is None else load_slip_table(settings.table, robot.name)
    return drive_faults(settings, robot, slips, progress)


def drive_faults(
    settings: Settings, robot: Robot, slips: SlipTable | None, progress: Progress = silent
) -> FaultsResult:
    """Drive each fault of the settings in each situation with a robot, and evaluate the drives.

    Without a table one is learned in simulation.  ``ConfigError`` is raised before anything is driven, if a fault,
    a situation or a terrain is unknown.
    """
    catalogue, terrains = fault_catalogue(robot), [name.strip() for name in settings.terrain.split(",")]
    chosen = select_faults(catalogue, () if settings.faults == (ALL,) else settings.faults)
    abouts = {fault.name: fault.about for fault in chosen}
    others = [each.name for each in select_faults(catalogue, settings.draw) if each.name not in abouts]
    if settings.draw and others:
        raise ConfigError(f"--draw has {min(others)!r}, which is not among the faults that are driven")
    places = [
        Place(situation, terrain, seed)
        for seed in settings.all_seeds
        for situation in settings.situations
        for terrain in (settings.stop_terrains if situation == STOP else terrains)
    ]
    for situation, terrain, seed in places:
        make_fault_situation(situation, robot, terrain, seed)
    if slips is None:
        driven = list(dict.fromkeys(place.terrain for place in places))
        slips = simulated_table(robot, driven, LEARNING_SEED, partial(progress, "learn targets"))
    loop = fault_loop(robot, slips)
    of_places = [(place,) for place in places]
    made = parallel(drive_references, (loop,), of_places, settings.jobs, "drive without faults", progress)
    references: dict[Place, References] = dict(zip(places, made, strict=True))
    cases = [
        FaultCase(fault.name, duration_s, *place)
        for fault in chosen
        for place in places
        for duration_s in sorted(settings.durations_s)
    ]

    def of_cases(function: Callable[..., Any], cases: Sequence[FaultCase], task: str) -> list[Any]:
        each = [(case, references[Place(*case[2:])]) for case in cases]
        return list(parallel(function, (loop,), each, settings.jobs, task, progress)) if each else []

    rows: list[FaultRow] = of_cases(evaluate_case, cases, "drive with faults")
    shown = drawn_cases(rows, settings.draw) if settings.out is not None or settings.draw else []
    return FaultsResult(
        robot=robot.name,
        table=slips.name,
        seeds=tuple(settings.all_seeds),
        delay_s=DELAY_S,
        limits=LIMITS,
        abouts=abouts,
        clean=tuple(clean_drive(place, each) for place, each in references.items()),
        rows=tuple(rows),
        bars=count_bars([row.bars for row in rows]),
        n_rows=len(rows),
        n_met=sum(not row.unmet for row in rows),
        drawn=tuple(of_cases(fault_figure, shown, "draw")),
    )


def drawn_cases(rows: Sequence[FaultRow], draw: Sequence[str] = ()) -> list[FaultCase]:
    """Return the drives that are drawn, of the first seed: of each kind that with the most unmet bars.

    With faults or kinds of them to draw: theirs, for the longest time that was driven.
    """
    longest_s = max(row.case.duration_s for row in rows)
    first_seed = min(row.case.seed for row in rows)
    first = [row for row in rows if row.case.seed == first_seed]
    if draw:
        drawn = [row.case for row in first if {row.case.fault, row.kind} & set(draw)]
        return [case for case in drawn if case.duration_s == longest_s]
    worst: dict[str, FaultRow] = {}
    for row in first:
        if row.unmet and len(row.unmet) > len(worst[row.kind].unmet if row.kind in worst else ()):
            worst[row.kind] = row
    return [row.case for row in worst.values()]


def fault_loop(robot: Robot, slips: SlipTable) -> FaultLoop:
    """Return the loop of a robot with its pilot, which knows the terrain."""
    return FaultLoop(robot, partial(_new_pilot, robot, slips), DELAY_S)


def _new_pilot(robot: Robot, slips: SlipTable, controller: str) -> LivePilot:
    return LivePilot(robot, slips, KnownTerrain(), PilotSettings(controller=controller))


def fault_figure(loop: FaultLoop, case: FaultCase, references: References) -> Figure:
    """Drive with a fault, and draw it beside the drives of the same place: speeds, slip, status over time."""
    (drive, pilot), plain, start_s = drive_case(loop, case), references.plain, references.start_s
    time_s, last_s = drive.time_s, float(drive.time_s[-1])
    acts = Strip([(start_s, min(start_s + case.duration_s, last_s), "the fault acts")])
    speed_mps = np.array(pilot.speed_mps)
    estimated = np.where(np.abs(speed_mps) < FASTEST_MPS, speed_mps, math.nan)
    shown_s = max(start_s - BEFORE_S, 0.0), last_s
    speeds = (
        Line("desired", time_s, drive.desired_mps, 6, dashed=True),
        Line("commanded", time_s, drive.commanded_mps, 2),
        Line("over ground, true", time_s, drive.speed_mps, 0),
        Line("over ground, estimated", time_s, estimated, 1),
    )
    slips = (
        Line("true, plain commands", plain.time_s, plain.body_slip_ratio, 6, dashed=True),
        Line("true, of the robot", time_s, drive.body_slip_ratio, 3),
        Line("true, largest of the wheels", time_s, drive.true_slip_ratio, 0),
        Line("estimated", time_s, drive.slip_ratio, 1),
    )
    panels = (
        Panel((acts, *speeds), "speed [m/s]", x_range=shown_s, y_range=(-0.5, 2.0)),
        Panel((acts, *slips), "slip ratio", x_range=shown_s, y_range=(-1.1, 1.1)),
        Panel((acts, Line("", time_s, drive.ok.astype(float), 2)), "status is OK", x_range=shown_s),
    )
    title = f"{case.fault}, {duration_text(case.duration_s)}: {_place(case)}, seed {case.seed}"
    return Figure(title, panels, x_label="time [s]")


def duration_text(duration_s: float) -> str:
    """Return a duration as it is shown, as ``3 s``."""
    return f"{duration_s:g} s" if math.isfinite(duration_s) else "for good"


def _place(at: FaultCase | Mapping[str, Any]) -> str:
    fields = at._asdict() if isinstance(at, FaultCase) else at
    return f"{fields['situation']} on {fields['terrain']}"


CLEAN = (
    *(Column("", of=_place), Column("seed", of="seed"), Column("error of slip", of="slip_error_ratio")),
    *(Column("not OK", of="not_ok_s", unit="s"), Column("peak of slip", of="slip_peak_ratio")),
    *(Column("plain's", of="plain_slip_peak_ratio"), Column("stop", of="stop_m", unit="m")),
    Column("plain's", of="plain_stop_m", unit="m"),
)

DRIVES = (
    *(Column("fault", of="case.fault"), Column("situation", of=lambda row: _place(row.case))),
    *(Column("seed", of="case.seed"), Column("for", of=lambda row: duration_text(row.case.duration_s))),
    Column("OK while acting, s", of="figures.ok_total_s"),
    Column("longest, s", of="figures.ok_longest_s"),
    Column("held back, s", of="figures.not_ok_s"),
    Column("error of slip", of="figures.slip_error_ratio"),
    Column("peak of slip", of="figures.slip_peak_ratio"),
    Column("plain's", of="figures.plain_slip_peak_ratio"),
    Column("stop, of plain's", of="figures.stop_ratio"),
    Column("recovery, s", of="figures.recovery_s"),
    Column("above desired, s", of="figures.overspeed_s"),
    Column("exceptions", of="figures.n_exceptions"),
    Column("not finite", of="figures.n_not_finite"),
    Column("bars unmet", of=lambda row: bars_text([row])),
    Column("sensors named", of=lambda row: _named([row])),
)


BY_FAULT = (
    "Bars that are not met, over durations and seeds; in brackets how many of the drives, where it is not all. "
    "Faults are dead (the stream carries no information), lying (a wrong one), tolerable (it still carries the "
    "motion: the controller has to go on) or degraded (it may do either)."
)
FROM_THE_FAULT = "All figures count from when a fault would begin."
MODELS = (
    "Robot and terrain are models. A fault changes what arrives at the controller; the sensors and the motion are "
    "those of the drive without it, until the commands differ."
)


def report(result: FaultsResult) -> Report:
    """Return how many drives meet all bars, the bars and faults that are not met, and behind it every drive."""
    headings = list(dict.fromkeys(map(_place, result.clean)))
    by_fault: dict[str, list[FaultRow]] = defaultdict(list)
    for row in result.rows:
        by_fault[row.case.fault].append(row)
    n_unmet = {name: sum(len(row.unmet) for row in rows) for name, rows in by_fault.items()}
    worst = sorted((name for name in n_unmet if n_unmet[name]), key=lambda name: -n_unmet[name])
    answer = f"{result.n_met} of {result.n_rows} drives with a sensor fault meet all bars"
    if worst:
        more = f" and {len(worst) - SHOWN_FAULTS} more" if len(worst) > SHOWN_FAULTS else ""
        answer += f"; not met with {', '.join(worst[:SHOWN_FAULTS])}{more}"
    bars = [(name, bar.n_met, bar.n_unmet, bar.n_not_judged, bar.text) for name, bar in result.bars.items()]
    overview = []
    for name, rows in by_fault.items():
        at = [[row for row in rows if _place(row.case) == heading] for heading in headings]
        overview.append((name, result.abouts[name], rows[0].nature, *map(bars_text, at), _named(rows)))
    heads: list[Column | str] = [
        "fault",
        Column("what it does", long=True),
        "nature",
        *headings,
        "sensors named",
    ]
    provenance = [("seeds", ", ".join(map(str, result.seeds))), ("versions", versions())]
    return Report(
        title=f"{result.robot}: sensor faults in the closed loop",
        answer=f"{answer}.",
        lead=(
            f"{plural(len(result.abouts), 'fault')} · {' · '.join(headings)} · "
            f"{plural(len(result.seeds), 'seed')} · delay {1000 * result.delay_s:g} ms · table {result.table}"
        ),
        picture=result.drawn[0] if result.drawn else None,
        parts=[Table(("bar", "met", "unmet", "not judged", Column("what it asks for", long=True)), bars)],
        details=sections(
            ("Bars met and not met, by fault", [Table(heads, overview, note=BY_FAULT)]),
            ("Without a fault", [Table(CLEAN, result.clean, note=FROM_THE_FAULT)]),
            ("Some drives", result.drawn[1:]),
            ("All drives", [Table(DRIVES, result.rows)]),
            ("Where these numbers come from", [MODELS, Pairs(provenance)]),
        ),
    )


def bars_text(rows: Sequence[FaultRow]) -> str:
    """Return the bars that rows do not meet."""
    unmet = [row for row in rows if row.unmet]
    if not unmet:
        return MET if rows else NOT_KNOWN
    text = " ".join(name for name in BARS if any(name in row.unmet for row in unmet))
    return text if len(unmet) == len(rows) else f"{text} ({len(unmet)} of {len(rows)})"


def _named(rows: Sequence[FaultRow]) -> str:
    """Return the sensors that were named in any row, each with its statuses."""
    named: dict[str, set[str]] = defaultdict(set)
    for row in rows:
        for sensor, statuses in (row.sensors_named or {}).items():
            named[sensor].update(statuses.split(", "))
    return "; ".join(f"{sensor}: {', '.join(sorted(named[sensor]))}" for sensor in sorted(named))
