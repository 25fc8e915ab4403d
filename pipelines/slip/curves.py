"""``terrain learn-slip`` of swerve robots: slip curves from motor currents, and the targets that follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipelines.report.figure import Band, Figure, Mark, Panel, Points
from pipelines.report.numbers import enumerated, format_value, plural
from pipelines.report.results import Progress, as_json, described
from pipelines.report.tree import Column, Part, Report, Table, Text, sections
from pipelines.slip.shown import file_name, first_rows, named, within_one_session
from pipelines.slip.table import SLIP, TARGET, TARGETS, LearnedSlipTable, fields_of, law_marks
from terrain.control.learned_table import learned_table, run_row, terrain_row
from terrain.control.slip_table import DRIVE_STATES
from terrain.errors import DataError
from terrain.logs.run_folders import data_digest
from terrain.records import RunLog, TargetStatus
from terrain.robots import Robot
from terrain.slip_learning.curve import N_BOOTSTRAP, PeakStatus
from terrain.slip_learning.learn import FILTER, LearnedTerrain, learn_terrains

LAW_NAMES = {"janosi": "Janosi and Hanamoto", "magic": "Magic Formula"}  #: Of the laws of thrust over slip
LARGEST_THRUST_RATIO = 1.3  #: Thrust over load up to which curves are drawn


class LearnedCurves(LearnedSlipTable, eq=False, kw_only=True):
    """Slip curves and target slips of a swerve robot."""

    filter: str = described("by which slip was estimated", default=FILTER)
    n_unlabelled: int = described("left out because they have no label")
    runs: tuple[Mapping[str, Any], ...] = described("each on each of its terrains")
    terrains: Mapping[str, Mapping[str, Any]] = described("by name")

    def as_json(self) -> Any:
        """Return the fields, and by drive state the target slip for a terrain without an entry."""
        fallback = {state: target.slip_ratio for state, target in self.targets[self.fallback].items()}
        return super().as_json() | {"fallback": fallback}


def learn_curves(
    runs: Sequence[RunLog], robot: Robot, seed: int, name: str, repair: bool, progress: Progress
) -> LearnedCurves:
    """Learn slip curves and target slips, as :func:`pipelines.slip.learn_slip.learn_slip_table`."""
    robot.require(*robot.sections)
    labelled = [run for run in runs if run.labels]
    if not labelled:
        raise DataError(f"none of {len(runs)} runs has a label: curves are learned by terrain")
    used, measured, learned, faulty = learn_terrains(
        labelled, robot, seed, skip_faulty=repair, progress=progress
    )
    slips = learned_table(learned, robot, name=name)
    return LearnedCurves(
        **fields_of(slips),
        seed=seed,
        data_digest=data_digest(used),
        n_runs=len(used),
        n_unlabelled=len(runs) - len(labelled),
        runs=tuple(run_row(run) for run in measured),
        terrains={entry.terrain: terrain_row(entry, slips) for entry in learned},
        skipped=tuple(faulty),
        pictures=curve_figures(learned, robot.name),
    )


def log_curves(result: LearnedCurves) -> str:
    """Log table, rows and figures with MLflow; return the id of the run there."""
    from pipelines.data.tracking import code_commit, log_run, mlflow_store
    from pipelines.report.drawing import figure_png

    assert result.table is not None
    params = {key: getattr(result, key) for key in ("robot", "filter", "dataset", "n_runs")}
    tags = {"data_digest": result.data_digest, "seed": str(result.seed)}
    tags |= {"commit": code_commit(), "kind": "slip table"}
    files = {
        result.table.name: result.table.read_bytes(),
        "learn_slip.json": {"terrains": as_json(result.terrains)},
        **{f"figures/{name}.png": figure_png(figure) for name, figure in result.pictures.items()},
    }
    params["n_bootstrap"] = N_BOOTSTRAP
    keys = ("n_runs", "peak_slip", "resistance_ratio", "balance_slip", "traction_efficiency")
    metrics: dict[str, float] = {}  # those of each terrain that are known, by names that MLflow accepts
    for terrain, row in result.terrains.items():
        name = file_name(terrain, " ")
        metrics |= {f"{name}.{key}": float(row[key]) for key in keys if row.get(key) is not None}
        metrics |= {f"{name}.target_{state}": row["targets"][state]["slip_ratio"] for state in DRIVE_STATES}
    with mlflow_store(create=True) as mlflow:
        run_id = log_run(mlflow, result.table.stem, params, metrics, tags, files)
        mlflow.MlflowClient().set_terminated(run_id)
    return run_id


TERRAINS = (
    Column("terrain", of="terrain"),
    Column("status", of="status"),
    Column("sessions", of="n_sessions"),
    Column("runs", of="n_runs"),
    Column("peak", SLIP, of="peak_slip"),
    Column("kind", of="peak_status"),
    Column("90 %", SLIP, of="peak_slip_ci"),
    *TARGETS,
)

CURVES = (
    Column("terrain", of="terrain"),
    Column("slips", ".2f", of="slip_range"),
    Column("law", of="law"),
    Column("resistance over load", SLIP, of="resistance_ratio"),
    Column("efficiency in traction", ".2f", of="traction_efficiency"),
    Column("energy in traction", ".0f", "J/m", of="energy_jpm.traction"),
)

RUNS = (
    Column("run", of="run_id", long=True),
    Column("terrain", of="terrain"),
    Column("samples", of="n_samples"),
    Column("bins", of="n_bins"),
    Column("slips", SLIP, of="slip_range"),
    Column("mass", ".1f", "kg", of="mass_kg"),
    Column("resistance over load", SLIP, of="resistance_ratio"),
)


def report(result: LearnedCurves) -> Report:
    """Return curve and targets a terrain, and why some are not learned."""
    rows = named(result.terrains)
    assumed = [row for row in rows if row["status"] is not TargetStatus.ESTIMATED]
    learned = [
        f"{format_value(row['targets']['traction']['slip_ratio'], SLIP)} on {row['terrain']}"
        for row in rows
        if row not in assumed
    ]
    one = {row["terrain"]: row["n_sessions"] == 1 for row in rows if row not in assumed}
    first, all_terrains = first_rows(rows, TERRAINS, f"target slip of {result.robot}")
    parts: list[Part] = [first]
    parts += [
        Text(
            f"{row['terrain']} is {row['status'].value}: {row['reason']}; its numbers are assumed "
            f"({row['targets']['traction']['source']})",
            "note",
        )
        for row in assumed
    ]
    if result.n_unlabelled:
        parts.append(Text(f"Runs without a label, left out: {result.n_unlabelled}."))
    fallback = ", ".join(
        f"{state} {format_value(target.slip_ratio, TARGET)}"
        for state, target in result.targets[result.fallback].items()
    )
    reading = (
        "Traction is the lesser of nine tenths of the peak slip and the slip with the net traction of a start; "
        "steady is where thrust balances the resistance. Where no peak lies within the observed slips (no_peak), "
        "the slip at 95 % of the largest net traction observed stands in its place. Intervals are of the mean curve, "
        "over sessions or, of one session, over its runs. For a terrain without an entry: "
        f"{fallback}."
    )
    return Report(
        f"Target slips of {result.robot}",
        f"{within_one_session(one)}Target slips of {result.robot} are learned on {len(rows) - len(assumed)} of "
        f"{len(rows)} terrains, from "
        f"{plural(result.n_runs, 'run')}{': in traction ' + enumerated(learned) if learned else ''}.",
        result.pictures.get("all_terrains"),
        parts,
        sections(
            all_terrains,
            ("How to read this", [reading]),
            ("Curves", [Table(CURVES, rows)]),
            ("Runs", [Table(RUNS, result.runs)]),
            ("Left out", result.skipped),
        ),
        result.next_step,
    )


def curve_figures(learned: Sequence[LearnedTerrain], robot: str) -> dict[str, Figure]:
    """Return a figure a terrain, by its name, and ``all_terrains`` with all of them."""
    caption = (
        "Bins of each run with one standard deviation, the law with its 90 % band over sessions, the 90 % interval "
        "of the peak slip, the resistance, and the targets."
    )
    figures, panels = {}, []
    for entry in learned:
        headline = f"{entry.status}, {entry.reason}"
        if (curve := entry.curve) is not None:
            kind = "peak" if curve.peak.status is PeakStatus.PEAK else "no peak, 95 %"
            headline = (
                f"{LAW_NAMES[curve.law]}, {kind} at {format_value(curve.peak.slip_ratio, SLIP)} "
                f"({format_value(curve.peak_interval, SLIP)}), {curve.n_runs} runs"
                f"{f', {entry.reason}' if entry.reason else ''}"
            )
        panel = curve_panel(entry)
        panels.append(replace(panel, title=f"{entry.terrain}: {headline}"))
        title = f"{entry.terrain}, {robot}: {headline}"
        figures[entry.terrain] = Figure(title, (panel,), caption, x_label="slip ratio")
    if learned:
        figures["all_terrains"] = Figure(f"slip curves of {robot}", panels, caption, x_label="slip ratio")
    return figures


def curve_panel(entry: LearnedTerrain) -> Panel:
    """Return bins of the runs on one terrain, and its law with peak, resistance and targets."""
    marks: list[Mark] = []
    shown = [0.1, 0.0]
    if entry.runs_with_bins:
        slip, thrust, std = (
            np.concatenate([getattr(run.bins, name) for run in entry.runs_with_bins])
            for name in ("slip_ratio", "traction_ratio", "traction_std")
        )
        marks.append(Points("bins of each run, ± 1 std", slip, thrust, thrust - std, thrust + std, 6))
        shown += thrust.tolist()
    if (curve := entry.curve) is not None:
        slips, low, high = curve.band
        law, ratio = curve.thrust_ratio, curve.resistance_ratio
        points = [("peak of net traction, or 95 % of it", curve.peak.slip_ratio, 1)]
        if (targets := entry.targets) is not None:
            points.append(("target, traction", targets["traction"].slip_ratio, 2))
            points.append(("target, steady", targets["steady"].slip_ratio, 3))
        marks += law_marks(law, curve.slip_range, curve.peak_interval, ratio)
        marks.append(Band("90 %", slips, low, high, 0))
        for label, at, colour in points:
            marks.append(Points(label, np.array([at]), law(np.array([at])), colour=colour))
        shown += [ratio, float(high.max())]
    least, most = min(shown), min(max(shown), LARGEST_THRUST_RATIO)
    margins = (least - 0.08 * (most - least), most + 0.12 * (most - least))
    return Panel(marks, "thrust over load", x_range=(-0.03, 1.0), y_range=margins)
