"""``terrain learn-slip`` of robots whose slip was measured from outside: steady targets by surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipelines.report import (
    Figure,
    Line,
    Mark,
    Panel,
    Part,
    Points,
    Progress,
    Report,
    Result,
    Shown,
    Text,
    described,
    enumerated,
    format_value,
    frame,
    plural,
    sections,
    silent,
    table,
)
from pipelines.slip.curves import SLIP, TARGET, TargetRow, target_of, target_row
from terrain.control.measured_table import MIN_RUNS, measured_table, reason_of
from terrain.control.slip_table import DRIVE_STATES, SlipTable
from terrain.control.transfer import Transfer, transfers
from terrain.errors import DataError
from terrain.logs.digest import data_digest
from terrain.measured_slip.measure import Measured, measure
from terrain.measured_slip.operating import OperatingPoints, operating_points
from terrain.measured_slip.surfaces import SurfaceSlip, surface_slip
from terrain.records import Array, RunLog, TargetStatus
from terrain.robots import Robot

if TYPE_CHECKING:
    import pandas as pd

WINDOW_S, SHORT_WINDOW_S = 2.0, 0.5
"""Windows; short ones where the outside measurement does not cover longer ones, as a lidar's twist."""


class SurfaceTargets(NamedTuple):
    """What was learned of a surface.

    Parameters
    ----------
    slip : as measured
    current_a, thrust_ratio : medians over runs, and their quartiles; NaN where unknown
    targets : by drive state
    reason : why there are no more
    """

    slip: SurfaceSlip
    current_a: tuple[float, float, float]
    thrust_ratio: tuple[float, float, float]
    targets: dict[str, TargetRow]
    reason: str


@dataclass(frozen=True)
class MeasuredTargets(Result):
    """Targets of a robot by slip that was measured from outside."""

    table: Path | None = described("file that was written")
    robot: str = described("of the runs")
    dataset: str = described("name of the data")
    data_digest: str = described("of the runs that have a slip")
    seed: int = described("of the bootstrap")
    window_s: float = described("length of windows", "s")
    n_runs: int = described("with a slip, in whatever motion; those of each surface are in steady motion")
    surfaces: Mapping[str, SurfaceTargets] = described("by name")
    transfers: tuple[Transfer, ...] = described("from session to session")
    figures: tuple[str, ...] = described("files")
    skipped: tuple[str, ...] = described("a sentence for each run that was not used")
    pictures: Mapping[str, Figure] = field(default_factory=dict)

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a surface and drive state."""
        return frame(
            {"terrain": name, "state": state, "n_runs": row.slip.n_runs, **target._asdict()}
            for name, row in self.surfaces.items()
            for state, target in row.targets.items()
        )


def learn_steady(
    runs: Sequence[RunLog],
    robot: Robot,
    *,
    seed: int = 0,
    name: str = "learned",
    progress: Progress = silent,
) -> tuple[SlipTable, MeasuredTargets]:
    """Learn the steady targets of each surface.

    Parameters
    ----------
    runs : of the robot, labelled with one terrain each; others are named and left out
    robot : whose slip was measured from outside
    seed : of delays and bootstrap
    name : of the table

    Raises
    ------
    DataError
        if no run has a label, a run is another robot's, or none has a slip that was measured from outside.
    """
    labelled = [run for run in runs if len(run.terrains) == 1]
    if not labelled:
        raise DataError(f"none of {len(runs)} runs has a label: target slips are learned by terrain")
    others = sorted({run.robot for run in labelled} - {robot.name})
    if others:
        raise DataError(f"runs are of the robot {others[0]!r}: a table is learned for one, {robot.name!r}")
    window_s, found = _measured(labelled, robot, seed, progress)
    rng = np.random.default_rng(seed)
    places: dict[str, list[int]] = {}
    for i, run in enumerate(found.runs):
        places.setdefault(run.terrains[0], []).append(i)
    slips = {each: surface_slip(each, [found.slips[i] for i in places[each]], rng) for each in sorted(places)}
    table = measured_table(list(slips.values()), robot, name)
    points = {
        each: operating_points([found.runs[i] for i in here], [found.slips[i] for i in here], robot)
        for each, here in sorted(places.items())
    }
    surfaces = {
        each: SurfaceTargets(
            slip,
            _quartiles(points[each].current_a),
            _quartiles(points[each].thrust_ratio),
            {state: target_row(table.targets[each][state]) for state in DRIVE_STATES},
            reason_of(slip),
        )
        for each, slip in slips.items()
    }
    result = MeasuredTargets(
        table=None,
        robot=robot.name,
        dataset="",
        data_digest=data_digest(found.runs),
        seed=seed,
        window_s=window_s,
        n_runs=len(found.runs),
        surfaces=surfaces,
        transfers=tuple(transfers(found.runs, found.slips, rng)),
        figures=(),
        skipped=(*_not_labelled(runs), *found.failed),
        pictures={"operating_points": operating_figure(robot.name, surfaces, points)},
    )
    return table, result


def _not_labelled(runs: Sequence[RunLog]) -> list[str]:
    """Return a sentence for each run that is not on one terrain by its labels."""
    return [
        f"run {run.run_id}: is on {len(run.terrains)} terrains: {', '.join(run.terrains)}"
        if run.terrains
        else f"run {run.run_id}: has no label"
        for run in runs
        if len(run.terrains) != 1
    ]


def _measured(runs: Sequence[RunLog], robot: Robot, seed: int, progress: Progress) -> tuple[float, Measured]:
    """Return slips over the longer windows, or over short ones where no longer one is covered."""
    first = ""
    for window_s in (WINDOW_S, SHORT_WINDOW_S):
        found = measure(runs, robot, window_s=window_s, stride_s=window_s / 2, seed=seed, progress=progress)
        if any(np.isfinite(slip.body_slip[slip.steady]).any() for slip in found.slips):
            return window_s, found
        first = first or (found.failed[0] if found.failed else "no window is driven steadily")
    raise DataError(f"none of {len(runs)} runs has a slip; the first for this: {first}")


def _quartiles(values: Array) -> tuple[float, float, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return float("nan"), float("nan"), float("nan")
    low, middle, high = np.quantile(known, [0.25, 0.5, 0.75])
    return float(middle), float(low), float(high)


SURFACES = (
    Shown("terrain", lambda named: named[0]),
    Shown("runs", lambda named: named[1].slip.n_runs),
    Shown("slip", lambda named: named[1].slip.slip_ratio, SLIP),
    Shown("95 %", lambda named: named[1].slip.interval, SLIP),
    Shown("current", lambda named: named[1].current_a[0], ".2f", "A"),
    Shown("thrust over load", lambda named: named[1].thrust_ratio[0], ".2f"),
    *(Shown(each, target_of(each), TARGET) for each in DRIVE_STATES),
    Shown("assumed", lambda named: enumerated(_assumed(named[1]))),
)

TRANSFERS = (
    Shown("terrain", "terrain"),
    Shown("learned in", lambda row: row.learned or "(none)"),
    Shown("driven in", lambda row: row.driven or "(none)"),
    Shown("runs", lambda row: f"{row.n_learned}, {row.n_driven}"),
    Shown("target", "slip_learned", SLIP),
    Shown("shown", "slip_driven", SLIP),
    Shown("off by", "difference", TARGET),
    Shown("95 %", "interval", TARGET),
)

STEADY = (
    "Steady is the median over runs of the slip in steady motion, where thrust balances resistance; its interval "
    "is over runs. What is assumed was not measured."
)
INDEPENDENT = (
    "The interval of a surface treats runs as independent; runs of one session are less so than it takes them to "
    "be, and a new session is off by what this shows. No interval is given with a session of fewer than "
    f"{MIN_RUNS} runs."
)


def _assumed(row: SurfaceTargets) -> list[str]:
    return [state for state in DRIVE_STATES if row.targets[state].status is not TargetStatus.ESTIMATED]


def report(result: MeasuredTargets) -> Report:
    """Return the operating point and the targets of each surface, and what a session costs another."""
    n_steady = sum(row.slip.n_runs for row in result.surfaces.values())
    known = [(name, row.slip.slip_ratio) for name, row in result.surfaces.items()]
    slips = enumerated([f"{format_value(slip, SLIP)} on {name}" for name, slip in known if np.isfinite(slip)])
    parts: list[Part] = [
        table(
            result.surfaces.items(), SURFACES, f"target slip of {result.robot}, measured from outside", STEADY
        )
    ]
    if result.transfers:
        parts.append(table(result.transfers, TRANSFERS, "a target of one session in another", INDEPENDENT))
    if result.skipped:
        parts.append(
            Text(f"{plural(len(result.skipped), 'run')} not used; the first: {result.skipped[0]}", "note")
        )
    steady = f"{n_steady} of {result.n_runs} runs have steady motion"
    return Report(
        f"Target slips of {result.robot}, measured from outside",
        f"In steady motion {result.robot} slips by {slips}; {steady}." if slips else f"{steady}.",
        result.pictures.get("operating_points"),
        parts,
        sections(
            ("Reasons", [f"{name}: {row.reason}" for name, row in result.surfaces.items()]),
            ("Not used", result.skipped),
        ),
        f"terrain drive --robot {result.robot} --terrain {next(iter(result.surfaces), 'TERRAIN')} "
        f"--table {result.table or 'FILE'}",
        f"{plural(result.n_runs, 'run')}, windows of {result.window_s:g} s",
    )


def operating_figure(
    robot: str, surfaces: Mapping[str, SurfaceTargets], points: Mapping[str, OperatingPoints]
) -> Figure:
    """Show thrust over load, or current, or the surface alone, over the slip of each run."""
    values, label = _heights(points)
    marks: list[Mark] = []
    for number, (name, row) in enumerate(surfaces.items()):
        height = values[name]
        label_of = f"{name}, {row.slip.n_runs} runs"
        marks.append(Points(label_of, points[name].slip_ratio, height, colour=number % 7))
        known = height[np.isfinite(height)]
        if known.size and np.isfinite(row.slip.interval).all():
            marks.append(
                Line(f"{name}, 95 %", list(row.slip.interval), [float(np.median(known))] * 2, number % 7)
            )
    return Figure(
        f"Steady slip of {robot}, measured from outside",
        (Panel(tuple(marks), label),),
        "A run a point: its median slip in steady motion. Lines are the median of a surface over its 95 % "
        "interval over runs. Points of one surface differ in how the robot was driven and are no curve.",
        x_label="slip ratio of the body, median of a run",
    )


def _heights(points: Mapping[str, OperatingPoints]) -> tuple[dict[str, Array], str]:
    """Return what is drawn over slip, by surface, and its name; places of surfaces without any current."""
    for name, label in (
        ("thrust_ratio", "thrust of a wheel over its load"),
        ("current_a", "mean current of a wheel [A]"),
    ):
        values = {surface: np.asarray(getattr(each, name)) for surface, each in points.items()}
        if any(np.isfinite(each).any() for each in values.values()):
            return values, label
    places = enumerate(points.items())
    return {name: np.full(each.slip_ratio.size, float(i)) for i, (name, each) in places}, "surface"
