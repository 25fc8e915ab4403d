"""``terrain learn-slip`` of robots whose slip was measured from outside: steady targets by surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipelines.report.figure import Figure, Line, Mark, Panel, Points
from pipelines.report.numbers import enumerated, format_value, plural
from pipelines.report.results import Progress, described
from pipelines.report.tree import Column, Part, Report, Table, Text, sections
from pipelines.slip.shown import known_columns, named, within_one_session
from pipelines.slip.table import SLIP, TARGET, TARGETS, LearnedSlipTable, fields_of
from terrain.control.learned_table import MIN_RUNS, Transfer, learn_surfaces
from terrain.errors import DataError
from terrain.logs.run_folders import data_digest
from terrain.records import RunLog, TargetStatus
from terrain.robots import Robot
from terrain.slip_learning.measured import OperatingPoints, measure_steady
from terrain.slip_learning.sessions import IntervalOf


class SteadyTargets(LearnedSlipTable, eq=False, kw_only=True):
    """Targets of a robot by slip that was measured from outside.

    Runs that are counted have a slip, in whatever motion; those of each surface are in steady motion.
    """

    window_s: float = described("length of windows", "s")
    surfaces: Mapping[str, Mapping[str, Any]] = described(
        "by name: slip as measured, median over runs of current and thrust over load with their quartiles, "
        "targets, and why there are no more"
    )
    transfers: tuple[Transfer, ...] = described("from session to session")


def learn_steady(
    runs: Sequence[RunLog], robot: Robot, seed: int, name: str, progress: Progress
) -> SteadyTargets:
    """Learn the steady targets of each surface, as :func:`pipelines.slip.learn_slip.learn_slip_table`.

    Runs that are not labelled with one terrain each are named and left out.
    """
    labelled = [run for run in runs if len(run.terrains) == 1]
    if not labelled:
        raise DataError(
            f"none of {len(runs)} runs has a label: target slips are learned by terrain (set by terrain label)"
        )
    others = sorted({run.robot for run in labelled} - {robot.name})
    if others:
        raise DataError(f"runs are of the robot {others[0]!r}: a table is learned for one, {robot.name!r}")
    window_s, found = measure_steady(labelled, robot, seed, progress)
    table, surfaces, points, transfers = learn_surfaces(found, robot, name, seed)
    not_labelled = [
        f"run {run.run_id}: is on {len(run.terrains)} terrains: {', '.join(run.terrains)}"
        if run.terrains
        else f"run {run.run_id}: has no label"
        for run in runs
        if len(run.terrains) != 1
    ]
    return SteadyTargets(
        **fields_of(table),
        seed=seed,
        data_digest=data_digest(found.runs),
        n_runs=len(found.runs),
        skipped=(*not_labelled, *found.failed),
        pictures={"operating_points": operating_figure(robot.name, surfaces, points)},
        window_s=window_s,
        surfaces=surfaces,
        transfers=transfers,
    )


def _assumed(row: Mapping[str, Any]) -> str:
    targets = row["targets"].items()
    return enumerated([state for state, each in targets if each["status"] is not TargetStatus.ESTIMATED])


SURFACES = (
    Column("terrain", of="terrain"),
    Column("sessions", of="slip.n_sessions"),
    Column("runs", of="slip.n_runs"),
    Column("slip", SLIP, of="slip.slip_ratio"),
    Column("interval", SLIP, of="slip.interval"),
    Column("current", ".2f", "A", of=lambda row: row["current_a"][0]),
    Column("thrust over load", ".2f", of=lambda row: row["thrust_ratio"][0]),
    *TARGETS,
    Column("assumed", of=_assumed),
)

TRANSFERS = (
    Column("terrain", of="terrain"),
    Column("learned in", of=lambda row: row.learned or "(none)"),
    Column("driven in", of=lambda row: row.driven or "(none)"),
    Column("runs", of=lambda row: f"{row.n_learned}, {row.n_driven}"),
    Column("target", SLIP, of="slip_learned"),
    Column("shown", SLIP, of="slip_driven"),
    Column("off by", TARGET, of="difference"),
    Column("95 %", TARGET, of="interval"),
)

STEADY = (
    "Steady is the mean over sessions of the median over runs of the slip in steady motion, where thrust balances "
    "resistance. Its interval is, with 95 %, of a new session (pooled: sessions taken to differ alike on all "
    "surfaces), the range of two sessions, which contains a third in one case of three, or over the runs of one. "
    "What is assumed was not measured."
)
INDEPENDENT = (
    "How far one session is from another; the interval is over the runs of the two. None is given with a session of "
    f"fewer than {MIN_RUNS} runs."
)


def report(result: SteadyTargets) -> Report:
    """Return the operating point and the targets of each surface, and what a session costs another."""
    rows = named(result.surfaces)
    n_steady = sum(row["slip"].n_runs for row in rows)
    slips = [
        f"{format_value(row['slip'].slip_ratio, SLIP)} on {row['terrain']}"
        for row in rows
        if np.isfinite(row["slip"].slip_ratio)
    ]
    one = {
        row["terrain"]: row["slip"].interval_of is IntervalOf.ONE_SESSION
        for row in rows
        if row["slip"].n_sessions
    }
    title = f"target slip of {result.robot}, measured from outside"
    parts: list[Part] = [Table(known_columns(SURFACES, rows), rows, title, STEADY)]
    if result.transfers:
        parts.append(Table(TRANSFERS, result.transfers, "a target of one session in another", INDEPENDENT))
    if result.skipped:
        not_used = plural(len(result.skipped), "run")
        parts.append(Text(f"{not_used} not used; the first: {result.skipped[0]}", "note"))
    steady = f"{n_steady} of {result.n_runs} runs have steady motion"
    return Report(
        f"Target slips of {result.robot}, measured from outside",
        f"{within_one_session(one)}In steady motion {result.robot} slips by {enumerated(slips)}; {steady}."
        if slips
        else f"{steady}.",
        result.pictures.get("operating_points"),
        parts,
        sections(
            ("Reasons", [f"{row['terrain']}: {row['reason']}" for row in rows]), ("Not used", result.skipped)
        ),
        result.next_step,
        f"{plural(result.n_runs, 'run')}, windows of {result.window_s:g} s",
    )


def operating_figure(
    robot: str, surfaces: Mapping[str, Mapping[str, Any]], points: Mapping[str, OperatingPoints]
) -> Figure:
    """Show thrust over load, or current, or the surface alone, over the slip of each run."""
    shown = {
        "thrust of a wheel over its load": [each.thrust_ratio for each in points.values()],
        "mean current of a wheel [A]": [each.current_a for each in points.values()],
        "surface": [np.full(each.slip_ratio.size, float(k)) for k, each in enumerate(points.values())],
    }
    label = next(name for name, values in shown.items() if np.isfinite(np.concatenate(values)).any())
    marks: list[Mark] = []
    for number, (terrain, height) in enumerate(zip(points, shown[label], strict=True)):
        slip = surfaces[terrain]["slip"]
        at, colour = points[terrain].slip_ratio, number % 7
        marks.append(Points(f"{terrain}, {slip.n_runs} runs", at, height, colour=colour))
        known = height[np.isfinite(height)]
        if known.size and np.isfinite(slip.interval).all():
            middle = [float(np.median(known))] * 2
            marks.append(Line(f"{terrain}, interval", list(slip.interval), middle, colour))
    return Figure(
        f"Steady slip of {robot}, measured from outside",
        (Panel(marks, label),),
        "A run a point: its median slip in steady motion. Lines are the median of a surface over the interval of "
        "its slip. Points of one surface differ in how the robot was driven and are no curve.",
        x_label="slip ratio of the body, median of a run",
    )
