"""``terrain learn-slip`` of swerve robots: slip curves from motor currents, and the targets that follow."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipelines.report import (
    Band,
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
    Strip,
    Text,
    described,
    enumerated,
    format_value,
    frame,
    interval,
    plural,
    sections,
    silent,
    table,
)
from pipelines.slip.shown import file_name, first_rows
from terrain.control.learned_table import DIGITS, FALLBACK, learned_table
from terrain.control.slip_table import DRIVE_STATES, CurveEntry, SlipTable
from terrain.errors import DataError
from terrain.logs.digest import data_digest
from terrain.records import RunLog, SlipTarget, TargetStatus
from terrain.robots import Robot
from terrain.slip_learning.curve import N_BOOTSTRAP
from terrain.slip_learning.learn import FILTER, LearnedTerrain, TerrainRun, learn_terrains
from terrain.slip_learning.peak import PeakStatus

if TYPE_CHECKING:
    import pandas as pd

SLIP, TARGET = ".3f", "+.3f"

LAW_NAMES = {"janosi": "Janosi and Hanamoto", "magic": "Magic Formula"}
"""Of the laws of thrust over slip."""

LARGEST_THRUST_RATIO = 1.3
"""Thrust over load up to which curves are drawn."""


class RunRow(NamedTuple):
    """One run on one terrain; its fields are keys of ``--json``.

    Parameters
    ----------
    run_id, terrain : of the run
    n_samples, n_bins : of slip and thrust over load
    slip_range : of its bins; None without any
    mass_kg, mass_std_kg, resistance_ratio, resistance_std : by its force balance; NaN where not known
    left_out : number of samples that do not meet each condition of their use
    """

    run_id: str
    terrain: str
    n_samples: int
    n_bins: int
    slip_range: tuple[float, float] | None
    mass_kg: float
    mass_std_kg: float
    resistance_ratio: float
    resistance_std: float
    left_out: Mapping[str, int]


class TargetRow(NamedTuple):
    """A target slip; ``slip_std`` is NaN where it is not known."""

    slip_ratio: float
    slip_std: float
    status: TargetStatus
    source: str


@dataclass(frozen=True, slots=True)
class TerrainRow:
    """One terrain.

    Parameters
    ----------
    status : whether its targets are learned
    reason : why they are not, or empty
    n_runs, n_samples : on it
    slip_range : slips that two runs or more reach; None without any
    targets : by drive state
    curve : as in the table; None where none was learned
    scores : mean log likelihood of a left-out run, by law; empty where no curve was learned
    """

    status: TargetStatus
    reason: str
    n_runs: int
    n_samples: int
    slip_range: tuple[float, float] | None
    targets: Mapping[str, TargetRow]
    curve: CurveEntry | None
    scores: Mapping[str, float]

    def as_json(self) -> dict[str, Any]:
        """Return the keys of ``--json``; those of a curve are there only where one was learned."""
        curve = self.curve
        row = {
            "status": self.status,
            "reason": self.reason or None,
            "n_runs": self.n_runs,
            "n_samples": self.n_samples,
            "slip_range": self.slip_range,
            "peak_slip": curve and curve.peak_slip_ratio,
            "peak_slip_ci": curve and curve.peak_interval_ratio,
            "peak_status": curve and curve.peak_status,
            "targets": self.targets,
        }
        if curve is None:
            return row
        return row | {
            "law": curve.law,
            "parameters": curve.parameters,
            "resistance_ratio": curve.resistance_ratio,
            "resistance_std": curve.resistance_std,
            "balance_slip": curve.balance_slip_ratio,
            "working_slip": curve.working_slip_ratio,
            "peak_based_slip": curve.peak_based_slip_ratio,
            "traction_efficiency": curve.traction_efficiency_ratio,
            "energy_jpm": {state: getattr(curve, f"{state}_energy_jpm") for state in DRIVE_STATES},
            "scores": self.scores,
        }


@dataclass(frozen=True)
class LearnSlipResult(Result):
    """Slip curves and target slips of a swerve robot."""

    table: Path | None = described("file that was written")
    robot: str = described("of the runs")
    filter: str = described("by which slip was estimated")
    seed: int = described("of the bootstrap")
    dataset: str = described("name of the data")
    data_digest: str = described("of the runs that were used")
    n_runs: int = described("used")
    n_unlabelled: int = described("left out because they have no label")
    runs: tuple[RunRow, ...] = described("each on each of its terrains")
    terrains: Mapping[str, TerrainRow] = described("by name")
    fallback: Mapping[str, float] = described("target slip by drive state for a terrain without an entry")
    figures: tuple[str, ...] = described("files that were written")
    skipped: tuple[str, ...] = described("a sentence for each run that was skipped")
    pictures: Mapping[str, Figure] = field(default_factory=dict)

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a terrain and drive state."""
        return frame(
            {"terrain": terrain, "state": state, "n_runs": row.n_runs, **target._asdict()}
            for terrain, row in self.terrains.items()
            for state, target in row.targets.items()
        )


def learn_curves(
    runs: Sequence[RunLog],
    robot: Robot,
    *,
    seed: int = 0,
    name: str = "learned",
    skip_faulty: bool = False,
    progress: Progress = silent,
) -> tuple[SlipTable, LearnSlipResult]:
    """Learn slip curves and target slips.

    Parameters
    ----------
    runs : labelled logs of the robot, with motor currents
    robot : a swerve robot
    seed : of the bootstrap
    name : of the table
    skip_faulty : leave out runs that lack something, in place of refusing them
    progress : gets the number of runs and terrains done

    Raises
    ------
    ConfigError
        if the robot lacks a section.
    DataError
        if no run has a label, or one is another robot's or lacks currents or attitude.
    """
    robot.require(*robot.sections)
    labelled = [run for run in runs if run.labels]
    if not labelled:
        raise DataError(f"none of {len(runs)} runs has a label: curves are learned by terrain")
    used, measured, learned, faulty = learn_terrains(
        labelled, robot, seed, skip_faulty=skip_faulty, progress=progress
    )
    table = learned_table(learned, robot, name=name)
    result = LearnSlipResult(
        table=None,
        robot=robot.name,
        filter=FILTER,
        seed=seed,
        dataset="",
        data_digest=data_digest(used),
        n_runs=len(used),
        n_unlabelled=len(runs) - len(labelled),
        runs=tuple(_run_row(run) for run in measured),
        terrains={entry.terrain: _terrain_row(entry, table) for entry in learned},
        fallback={state: table.targets[FALLBACK][state].slip_ratio for state in DRIVE_STATES},
        figures=(),
        skipped=tuple(faulty),
        pictures=curve_figures(learned, robot.name),
    )
    return table, result


def _run_row(run: TerrainRun) -> RunRow:
    mass_kg, mass_std_kg, ratio, std = run.balance
    slips = run.bins.slip_ratio
    return RunRow(
        run.run_id,
        run.terrain,
        run.n_samples,
        len(slips),
        _rounded(float(slips.min()), float(slips.max())) if len(slips) else None,
        round(mass_kg, 1),
        round(mass_std_kg, 1),
        round(ratio, DIGITS),
        round(std, DIGITS),
        run.left_out,
    )


def _terrain_row(learned: LearnedTerrain, table: SlipTable) -> TerrainRow:
    entry = table.curves.get(learned.terrain)
    scores = learned.curve.scores if entry is not None and learned.curve is not None else {}
    return TerrainRow(
        learned.status,
        learned.reason,
        len(learned.runs_with_bins),
        sum(run.n_samples for run in learned.runs),
        None if math.isnan(learned.slip_range[0]) else _rounded(*learned.slip_range),
        {state: target_row(target) for state, target in table.targets[learned.terrain].items()},
        entry,
        {law: round(score, 3) for law, score in scores.items()},
    )


def target_row(target: SlipTarget) -> TargetRow:
    """Return the row of a target."""
    return TargetRow(target.slip_ratio, target.slip_std, target.status, target.source)


def _rounded(low: float, high: float) -> tuple[float, float]:
    return round(low, DIGITS), round(high, DIGITS)


def log_curves(result: LearnSlipResult) -> str:
    """Log table, rows and figures with MLflow; return the id of the run there.

    Raises
    ------
    TerrainError
        if the tracking folder cannot be written or the server cannot be reached.
    """
    from pipelines.data.tracking import code_commit, log_learning
    from pipelines.report.drawing import figure_png
    from pipelines.report.json_file import as_json

    assert result.table is not None
    return log_learning(
        result.table.stem,
        {
            "robot": result.robot,
            "filter": result.filter,
            "n_bootstrap": N_BOOTSTRAP,
            "dataset": result.dataset,
            "n_runs": result.n_runs,
        },
        _metrics(result.terrains),
        {
            "data_digest": result.data_digest,
            "commit": code_commit(),
            "seed": str(result.seed),
            "kind": "slip table",
        },
        {
            result.table.name: result.table.read_text(encoding="utf-8"),
            "learn_slip.json": {"terrains": as_json(result.terrains)},
        },
        {f"figures/{name}.png": figure_png(figure) for name, figure in result.pictures.items()},
    )


def _metrics(rows: Mapping[str, TerrainRow]) -> dict[str, float]:
    """Return the figures of each terrain that are known, by names that MLflow accepts."""
    keys = ("n_runs", "peak_slip", "resistance_ratio", "balance_slip", "traction_efficiency")
    metrics: dict[str, float] = {}
    for terrain, row in rows.items():
        name, found = file_name(terrain, " "), row.as_json()
        metrics |= {f"{name}.{key}": float(found[key]) for key in keys if found.get(key) is not None}
        for state in DRIVE_STATES:
            metrics[f"{name}.target_{state}"] = row.targets[state].slip_ratio
    return metrics


def _of_curve(name: str) -> Callable[[tuple[str, TerrainRow]], Any]:
    return lambda named: named[1].curve and getattr(named[1].curve, name)


def target_of(state: str) -> Callable[[tuple[str, Any]], float]:
    """Return what gives the target slip of a drive state, of a terrain and its row."""
    return lambda named: named[1].targets[state].slip_ratio


TERRAINS = (
    Shown("terrain", lambda named: named[0]),
    Shown("status", lambda named: named[1].status),
    Shown("runs", lambda named: named[1].n_runs),
    Shown("peak", _of_curve("peak_slip_ratio"), SLIP),
    Shown("kind", _of_curve("peak_status")),
    Shown("90 %", _of_curve("peak_interval_ratio"), SLIP),
    *(Shown(each, target_of(each), TARGET) for each in DRIVE_STATES),
)

CURVES = (
    *(Shown("terrain", lambda named: named[0]), Shown("slips", lambda named: named[1].slip_range, ".2f")),
    *(Shown("law", _of_curve("law")), Shown("resistance over load", _of_curve("resistance_ratio"), SLIP)),
    Shown("efficiency in traction", _of_curve("traction_efficiency_ratio"), ".2f"),
    Shown("energy in traction", _of_curve("traction_energy_jpm"), ".0f", "J/m"),
)

RUNS = (
    *(Shown("run", "run_id", long=True), Shown("terrain", "terrain"), Shown("samples", "n_samples")),
    *(Shown("bins", "n_bins"), Shown("slips", "slip_range", SLIP), Shown("mass", "mass_kg", ".1f", "kg")),
    Shown("resistance over load", "resistance_ratio", SLIP),
)


def report(result: LearnSlipResult) -> Report:
    """Return curve and targets a terrain, and why some are not learned."""
    assumed = {n: row for n, row in result.terrains.items() if row.status is not TargetStatus.ESTIMATED}
    learned = enumerated(
        [
            f"{format_value(row.targets['traction'].slip_ratio, SLIP)} on {name}"
            for name, row in result.terrains.items()
            if name not in assumed
        ]
    )
    first, all_terrains = first_rows(
        list(result.terrains.items()), TERRAINS, f"target slip of {result.robot}"
    )
    parts: list[Part] = [first]
    parts += [
        Text(
            f"{terrain} is {row.status.value}: {row.reason}; its numbers are assumed "
            f"({row.targets['traction'].source})",
            "note",
        )
        for terrain, row in assumed.items()
    ]
    if result.n_unlabelled:
        parts.append(Text(f"Runs without a label, left out: {result.n_unlabelled}."))
    fallback = ", ".join(f"{state} {format_value(slip, TARGET)}" for state, slip in result.fallback.items())
    reading = (
        "Traction is the lesser of nine tenths of the peak slip and the slip with the net traction of a start; "
        "steady is where thrust balances the resistance. Where no peak lies within the observed slips (no_peak), "
        "the slip at 95 % of the largest net traction observed stands in its place. For a terrain without an "
        f"entry: {fallback}."
    )
    n_learned = len(result.terrains) - len(assumed)
    return Report(
        f"Target slips of {result.robot}",
        f"Target slips of {result.robot} are learned on {n_learned} of {len(result.terrains)} terrains, from "
        f"{plural(result.n_runs, 'run')}{': in traction ' + learned if learned else ''}.",
        result.pictures.get("all_terrains"),
        parts,
        sections(
            all_terrains,
            ("How to read this", [reading]),
            ("Curves", [table(result.terrains.items(), CURVES)]),
            ("Runs", [table(result.runs, RUNS)]),
            ("Left out", result.skipped),
        ),
        f"terrain drive --robot {result.robot} --terrain {next(iter(result.terrains), 'TERRAIN')} "
        f"--table {result.table or 'FILE'}",
    )


def curve_figures(learned: Sequence[LearnedTerrain], robot: str) -> dict[str, Figure]:
    """Return a figure a terrain, by its name, and ``all_terrains`` with all of them."""
    caption = (
        "Bins of each run with one standard deviation, the law with its 90 % band over runs, the 90 % interval "
        "of the peak slip, the resistance, and the targets."
    )
    panels = {entry.terrain: curve_panel(entry) for entry in learned}
    figures = {
        entry.terrain: Figure(
            f"{entry.terrain}, {robot}: {_headline(entry)}",
            (panels[entry.terrain],),
            caption,
            x_label="slip ratio",
        )
        for entry in learned
    }
    if learned:
        titled = tuple(
            replace(panel, title=f"{entry.terrain}: {_headline(entry)}")
            for entry, panel in zip(learned, panels.values(), strict=True)
        )
        figures["all_terrains"] = Figure(f"slip curves of {robot}", titled, caption, x_label="slip ratio")
    return figures


def curve_panel(entry: LearnedTerrain) -> Panel:
    """Return bins of the runs on one terrain, and its law with peak, resistance and targets."""
    bins = [run.bins for run in entry.runs if len(run.bins.slip_ratio)]
    marks: list[Mark] = []
    shown = [0.0]
    if bins:
        slip, thrust, std = (
            np.concatenate([getattr(each, name) for each in bins])
            for name in ("slip_ratio", "traction_ratio", "traction_std")
        )
        marks.append(Points("bins of each run, ± 1 std", slip, thrust, thrust - std, thrust + std, 6))
        shown += thrust.tolist()
    if entry.curve is not None:
        marks += _law_marks(entry)
        shown += [entry.curve.resistance_ratio, float(entry.curve.band.high_ratio.max())]
    low, high = min(shown), min(max([0.1, *shown]), LARGEST_THRUST_RATIO)
    margins = (low - 0.08 * (high - low), high + 0.12 * (high - low))
    return Panel(tuple(marks), "thrust over load", x_range=(-0.03, 1.0), y_range=margins)


def _law_marks(entry: LearnedTerrain) -> list[Mark]:
    curve = entry.curve
    assert curve is not None
    slips, low, high = curve.band
    beyond, peak = np.linspace(curve.slip_range[1], 1.0, 50), np.array([curve.peak.slip_ratio])
    marks: list[Mark] = [
        Strip(((*curve.peak_interval, "peak slip, 90 %"),)),
        Band("90 % over runs", slips, low, high, 0),
        Line("law, within the observed slips", slips, curve.thrust_ratio(slips), 0),
        Line("beyond", beyond, curve.thrust_ratio(beyond), 0, dashed=True),
        Line("resistance", [0.0, 1.0], [curve.resistance_ratio] * 2, 4, dashed=True),
        Points("peak of net traction, or 95 % of it", peak, curve.thrust_ratio(peak), colour=1),
    ]
    if entry.targets is not None:
        for state, colour in (("traction", 2), ("steady", 3)):
            slip = np.array([entry.targets.of(state).slip_ratio])
            marks.append(Points(f"target, {state}", slip, curve.thrust_ratio(slip), colour=colour))
    return marks


def _headline(entry: LearnedTerrain) -> str:
    if entry.curve is None:
        return f"{entry.status}, {entry.reason}"
    curve = entry.curve
    kind = "peak" if curve.peak.status is PeakStatus.PEAK else "no peak, 95 %"
    tail = f", {entry.reason}" if entry.reason else ""
    return (
        f"{LAW_NAMES[curve.law]}, {kind} at {format_value(curve.peak.slip_ratio, SLIP)} "
        f"({interval(*curve.peak_interval, SLIP)}), {curve.n_runs} runs{tail}"
    )
