"""Sensor faults in the closed loop, a row for each fault, duration, situation and seed.

A drive with a fault is compared with two others in the same place: the clean one, by the same controller
without the fault, and the plain one, by the commands of the kinematics, which no sensor fault touches.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipelines.drive.drive import ALL
from pipelines.learn.parallel import parallel
from pipelines.live.pilot import LivePilot
from pipelines.live.terrain_source import KnownTerrain
from pipelines.report import (
    NOT_KNOWN,
    Column,
    Figure,
    Line,
    Mark,
    Pairs,
    Panel,
    Part,
    Progress,
    Report,
    Result,
    Section,
    Strip,
    Table,
    Text,
    described,
    plural,
    silent,
)
from pipelines.report.versions import versions
from terrain.control.fault_drives import (
    CleanDrive,
    Driven,
    FaultCase,
    FaultLoop,
    FaultRow,
    Place,
    References,
    clean_drive,
    drive_case,
    drive_references,
    evaluate_case,
)
from terrain.control.fault_evaluation import BARS, LIMITS, Limits, bar_texts
from terrain.control.fault_situations import STOP, make_fault_situation
from terrain.control.learned_table import learned_table
from terrain.control.pilot_settings import PilotSettings
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.errors import ConfigError
from terrain.robots import Robot, SwerveRobot, as_drive, load_robot
from terrain.simulation.faults.catalogue import fault_catalogue, select_faults
from terrain.simulation.faults.fault import SensorFault
from terrain.simulation.slip_sweep import learning_runs
from terrain.slip_learning.learn import learn_terrain, terrain_runs
from terrain.terramechanics.soil import load_soil

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.drive.drive import Settings

DELAY_S = PilotSettings().delay_s
"""From a sample to the wheel."""

LEARNING_SEED = 5000
"""Of the simulated runs that targets are learned from; seeds of drives are far below."""

SHORT_BARS: Mapping[str, str] = dict(
    zip(BARS, ("ok", "on", "slip", "peak", "stop", "back", "over", "finite"), strict=True)
)
"""Names of the bars in the cells of tables."""

FIGURES = {
    "ok_total_s": "OK while acting, s",
    "ok_longest_s": "longest, s",
    "not_ok_s": "held back, s",
    "slip_error_ratio": "error of slip",
    "slip_peak_ratio": "peak of slip",
    "plain_slip_peak_ratio": "plain's",
    "stop_ratio": "stop, of plain's",
    "recovery_s": "recovery, s",
    "overspeed_s": "above desired, s",
    "n_exceptions": "exceptions",
    "n_not_finite": "not finite",
}
"""Figures in the table of all rows, and their headings."""

MET = "met"
SHOWN_FAULTS = 8
"""Faults with unmet bars that the answer's table has."""

BEFORE_S = 1.0
"""Shown before the fault."""

FASTEST_MPS = 10.0
"""Estimates of the speed beyond this, as a fault may cause, are not drawn."""


class BarCount(NamedTuple):
    """A bar over all rows: what it asks for, and how many rows meet it, do not, and are not judged by it."""

    text: str
    n_met: int
    n_unmet: int
    n_not_judged: int


@dataclass(frozen=True, eq=False, repr=False)
class FaultsResult(Result):
    """Sensor faults in the closed loop."""

    robot: str = described("that was driven")
    table: str = described("name of its target slips")
    seeds: tuple[int, ...] = described("of the drives")
    delay_s: float = described("from a sample to the wheel", "s")
    limits: Limits = described("of the figures")
    abouts: Mapping[str, str] = described("what each fault does, by its name")
    clean: tuple[CleanDrive, ...] = described("drives without a fault")
    rows: tuple[FaultRow, ...] = described("drives with one")
    drawn: tuple[Figure, ...] = ()

    @property
    def n_met(self) -> int:
        """Number of rows that meet all bars."""
        return sum(not row.unmet for row in self.rows)

    @property
    def bars(self) -> dict[str, BarCount]:
        """Each bar by name, over all rows."""
        counted = {}
        for name, text in bar_texts(self.limits).items():
            found = [row.bars[name] for row in self.rows]
            counted[name] = BarCount(text, found.count(True), found.count(False), found.count(None))
        return counted

    def as_json(self) -> dict[str, Any]:
        """Return the described fields, with the counts by bar."""
        from pipelines.report.json_file import as_json

        counts = {"bars": self.bars, "n_rows": len(self.rows), "n_met": self.n_met}
        return {**super().as_json(), **as_json(counts)}

    def to_pandas(self) -> pd.DataFrame:
        """Return the drives with a fault, a row each."""
        import pandas as pd

        return pd.DataFrame([row.as_json() for row in self.rows])


def run(settings: Settings, progress: Progress) -> FaultsResult:
    """Drive each fault in each situation, and evaluate what the controller makes of it.

    Raises
    ------
    ConfigError
        if a fault, a situation or a terrain is unknown, or the robot is no swerve robot with all sections.
    TerrainError
        if the robot or the table cannot be read.
    """
    robot = checked_robot(settings)
    if settings.table is not None:
        table = load_slip_table(settings.table, robot.name)
    else:
        table = learn_table(robot, list(dict.fromkeys(p.terrain for p in places_of(settings))), progress)
    return drive_faults(settings, robot, table, progress)


def checked_robot(settings: Settings) -> Robot:
    """Return the robot, once all that is named is known to exist.

    Raises
    ------
    ConfigError
        if a fault, a situation or a terrain is unknown, or the robot is no swerve robot with all sections.
    TerrainError
        if its description cannot be read.
    """
    robot = as_drive(
        SwerveRobot,
        load_robot(settings.robot),
        "robot {name}: drive {drive!r} has no pilot, only 'swerve' has",
    )
    robot.require(*robot.sections)
    chosen = {fault.name for fault in _chosen_faults(settings, robot)}
    drawn = {fault.name for fault in select_faults(fault_catalogue(robot), settings.draw)}
    if settings.draw and not drawn <= chosen:
        raise ConfigError(
            f"--draw has {min(drawn - chosen)!r}, which is not among the faults that are driven"
        )
    for place in places_of(settings):
        make_fault_situation(place.situation, robot, place.terrain, place.seed)
    return robot


def _chosen_faults(settings: Settings, robot: Robot) -> Sequence[SensorFault]:
    return select_faults(fault_catalogue(robot), () if settings.faults == (ALL,) else settings.faults)


def learn_table(robot: Robot, terrains: Sequence[str], progress: Progress) -> SlipTable:
    """Return target slips learned from simulated runs on terrains, as ``terrain learn-slip`` learns them."""
    learned = []
    for done, terrain in enumerate(terrains, start=1):
        measured = [
            one for log in learning_runs(robot, terrain, LEARNING_SEED) for one in terrain_runs(log, robot)
        ]
        learned.append(learn_terrain(load_soil(terrain).name, measured, LEARNING_SEED))
        progress("learn targets", done, len(terrains))
    return learned_table(learned, robot, "learned")


def places_of(settings: Settings) -> list[Place]:
    """Return every situation on its terrains at each seed."""
    terrains = [name.strip() for name in settings.terrain.split(",")]
    return [
        Place(situation, terrain, seed)
        for seed in settings.all_seeds
        for situation in settings.situations
        for terrain in (settings.stop_terrains if situation == STOP else terrains)
    ]


def drive_faults(
    settings: Settings, robot: Robot, table: SlipTable, progress: Progress = silent
) -> FaultsResult:
    """Drive each fault in each situation with a robot and its table, and evaluate the drives.

    Parameters
    ----------
    settings : what is driven
    robot, table : that is driven, and its target slips
    progress : of the drives
    """
    chosen, places, loop = _chosen_faults(settings, robot), places_of(settings), fault_loop(robot, table)
    references: dict[Place, References] = {}
    made = parallel(
        drive_references, (loop,), [(place,) for place in places], min(settings.n_jobs, len(places))
    )
    for place, found in zip(places, made, strict=True):
        references[place] = found
        progress("drive without faults", len(references), len(places))
    cases = [
        FaultCase(fault.name, duration_s, *place)
        for fault in chosen
        for place in places
        for duration_s in sorted(settings.durations_s)
    ]
    tasks = [(case, references[Place(*case[2:])]) for case in cases]
    rows: list[FaultRow] = []
    for row in parallel(evaluate_case, (loop,), tasks, min(settings.n_jobs, len(tasks))):
        rows.append(row)
        progress("drive with faults", len(rows), len(cases))
    drawn: list[Figure] = []
    worst = drawn_cases(settings, rows) if settings.out is not None or settings.draw else []
    for case in worst:
        drawn.append(fault_figure(case, drive_case(loop, case), references[Place(*case[2:])]))
        progress("draw", len(drawn), len(worst))
    return FaultsResult(
        robot=robot.name,
        table=table.name,
        seeds=tuple(settings.all_seeds),
        delay_s=DELAY_S,
        limits=LIMITS,
        abouts={fault.name: fault.about for fault in chosen},
        clean=tuple(clean_drive(place, found) for place, found in references.items()),
        rows=tuple(rows),
        drawn=tuple(drawn),
    )


def fault_loop(robot: Robot, table: SlipTable) -> FaultLoop:
    """Return the loop of a swerve robot with its pilot, which knows the terrain."""
    return FaultLoop(robot, partial(_new_pilot, robot, table), DELAY_S)


def _new_pilot(robot: Robot, table: SlipTable, controller: str) -> LivePilot:
    settings = PilotSettings(controller=controller, delay_s=DELAY_S)
    return LivePilot(robot, table, KnownTerrain(), settings)


def drawn_cases(settings: Settings, rows: Sequence[FaultRow]) -> list[FaultCase]:
    """Return the drives that are drawn, of the first seed.

    With ``settings.draw`` those of these faults, for the longest time that was driven; else of each kind the
    drive with the most unmet bars.
    """
    longest_s = max(row.case.duration_s for row in rows)
    first = [row for row in rows if row.case.seed == settings.first_seed]
    if settings.draw:
        return [
            row.case
            for row in first
            if {row.case.fault, row.kind} & set(settings.draw) and row.case.duration_s == longest_s
        ]
    worst: dict[str, FaultRow] = {}
    for row in first:
        if row.unmet and len(row.unmet) > len(worst[row.kind].unmet if row.kind in worst else ()):
            worst[row.kind] = row
    return [row.case for row in worst.values()]


def fault_figure(case: FaultCase, driven: Driven, references: References) -> Figure:
    """Return the figure of a drive with a fault: speeds, slip and status over time.

    Parameters
    ----------
    case : what was driven
    driven : with the fault
    references : of the same place
    """
    drive, plain, start_s = driven.drive, references.plain, references.start_s
    time_s, last_s = drive.time_s, float(drive.time_s[-1])
    acts = Strip([(start_s, min(start_s + case.duration_s, last_s), "the fault acts")])
    estimated = np.where(np.abs(driven.speed_mps) < FASTEST_MPS, driven.speed_mps, math.nan)
    shown_s = max(start_s - BEFORE_S, 0.0), last_s
    speeds: list[Mark] = [
        acts,
        Line("desired", time_s, drive.desired_mps, 6, dashed=True),
        Line("commanded", time_s, drive.commanded_mps, 2),
        Line("over ground, true", time_s, drive.speed_mps, 0),
        Line("over ground, estimated", time_s, estimated, 1),
    ]
    slips: list[Mark] = [
        acts,
        Line("true, plain commands", plain.time_s, plain.body_slip_ratio, 6, dashed=True),
        Line("true, of the robot", time_s, drive.body_slip_ratio, 3),
        Line("true, largest of the wheels", time_s, drive.true_slip_ratio, 0),
        Line("estimated", time_s, drive.slip_ratio, 1),
    ]
    return Figure(
        f"{case.fault}, {duration_text(case.duration_s)}: {case.situation} on {case.terrain}, seed {case.seed}",
        [
            Panel(speeds, "speed [m/s]", x_range=shown_s, y_range=(-0.5, 2.0)),
            Panel(slips, "slip ratio", x_range=shown_s, y_range=(-1.1, 1.1)),
            Panel([acts, Line("", time_s, drive.ok.astype(float), 2)], "status is OK", x_range=shown_s),
        ],
        x_label="time [s]",
    )


def duration_text(duration_s: float) -> str:
    """Return a duration as it is shown.

    Examples
    --------
    >>> duration_text(3.0), duration_text(math.inf)
    ('3 s', 'for good')
    """
    return f"{duration_s:g} s" if math.isfinite(duration_s) else "for good"


def report(result: FaultsResult) -> Report:
    """Return how many drives meet all bars, the bars and faults that are not met, and behind it every drive."""
    n, n_rows = len(result.seeds), len(result.rows)
    places = list(dict.fromkeys((one.situation, one.terrain) for one in result.clean))
    headings = [f"{situation} on {terrain}" for situation, terrain in places]
    by_fault: dict[str, list[FaultRow]] = defaultdict(list)
    for row in result.rows:
        by_fault[row.case.fault].append(row)
    n_unmet = {name: sum(len(row.unmet) for row in rows) for name, rows in by_fault.items()}
    worst = sorted((name for name in n_unmet if n_unmet[name]), key=lambda name: -n_unmet[name])
    answer = f"{result.n_met} of {n_rows} drives with a sensor fault meet all bars"
    if worst:
        more = f" and {len(worst) - SHOWN_FAULTS} more" if len(worst) > SHOWN_FAULTS else ""
        answer += f"; not met with {', '.join(worst[:SHOWN_FAULTS])}{more}"
    bars = [
        (SHORT_BARS[name], bar.n_met, bar.n_unmet, bar.n_not_judged, bar.text)
        for name, bar in result.bars.items()
    ]
    overview = []
    for name, rows in by_fault.items():
        at = [[row for row in rows if (row.case.situation, row.case.terrain) == place] for place in places]
        overview.append((name, result.abouts[name], rows[0].nature, *map(bars_text, at), _named(rows)))
    clean = [
        (
            *(f"{one.situation} on {one.terrain}", one.seed, one.slip_error_ratio, one.not_ok_s),
            *(one.slip_peak_ratio, one.plain_slip_peak_ratio, one.stop_m, one.plain_stop_m),
        )
        for one in result.clean
    ]
    drives = [
        (
            *(row.case.fault, f"{row.case.situation} on {row.case.terrain}", row.case.seed),
            duration_text(row.case.duration_s),
            *(getattr(row.figures, name) for name in FIGURES),
            *(_short(row.unmet) or MET, _named([row])),
        )
        for row in result.rows
    ]
    sections: dict[str, list[Part]] = {
        "Bars met and not met, by fault": [
            Table(
                ("fault", Column("what it does", long=True), "nature", *headings, "sensors named"),
                overview,
                note="Bars that are not met, over durations and seeds; in brackets how many of the drives, where "
                "it is not all. Faults are dead (the stream carries no information), lying (a wrong one), "
                "tolerable (it still carries the motion: the controller has to go on) or degraded (it may do "
                "either).",
            )
        ],
        "Without a fault": [
            Table(
                (
                    *("", "seed", "error of slip", Column("not OK", unit="s"), "peak of slip", "plain's"),
                    *(Column("stop", unit="m"), Column("plain's", unit="m")),
                ),
                clean,
                note="All figures count from when a fault would begin.",
            )
        ],
        "Some drives": [*result.drawn[1:]],
        "All drives": [
            Table(
                ("fault", "situation", "seed", "for", *FIGURES.values(), "bars unmet", "sensors named"),
                drives,
            )
        ],
        "Where these numbers come from": [
            Text(
                "Robot and terrain are models. A fault changes what arrives at the controller; the sensors and "
                "the motion are those of the drive without it, until the commands differ."
            ),
            Pairs(
                [
                    ("seeds", ", ".join(map(str, result.seeds))),
                    ("versions", ", ".join(f"{name} {number}" for name, number in versions().items())),
                ]
            ),
        ],
    }
    return Report(
        title=f"{result.robot}: sensor faults in the closed loop",
        answer=f"{answer}.",
        lead=(
            f"{plural(len(result.abouts), 'fault')} · {' · '.join(headings)} · {plural(n, 'seed')} · "
            f"delay {1000 * result.delay_s:g} ms · table {result.table}"
        ),
        picture=result.drawn[0] if result.drawn else None,
        parts=[Table(("bar", "met", "unmet", "not judged", Column("what it asks for", long=True)), bars)],
        details=[Section(title, parts) for title, parts in sections.items() if parts],
    )


def bars_text(rows: Sequence[FaultRow]) -> str:
    """Return the bars that rows do not meet, by their short names."""
    unmet = [row for row in rows if row.unmet]
    if not unmet:
        return MET if rows else NOT_KNOWN
    text = _short(name for name in SHORT_BARS if any(name in row.unmet for row in unmet))
    return text if len(unmet) == len(rows) else f"{text} ({len(unmet)} of {len(rows)})"


def _short(names: Iterable[str]) -> str:
    return " ".join(SHORT_BARS[name] for name in names)


def _named(rows: Sequence[FaultRow]) -> str:
    """Return the sensors that were named in any row, those with the same statuses together."""
    named: dict[str, set[str]] = defaultdict(set)
    for row in rows:
        for sensor, statuses in (row.blamed or {}).items():
            named[sensor].update(statuses.split(", "))
    together: dict[str, list[str]] = defaultdict(list)
    for sensor in sorted(named):
        together[", ".join(sorted(named[sensor]))].append(sensor)
    return "; ".join(f"{', '.join(sensors)}: {statuses}" for statuses, sensors in together.items())
