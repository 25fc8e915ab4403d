"""``terrain learn-slip``: from labelled runs to slip curves, and to the table that control reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.data.datasets import data_digest
from pipelines.reporting.json_file import as_json
from pipelines.reporting.progress import Progress, silent
from pipelines.slip.results import LearnSlipResult, TerrainRow, run_row, terrain_row
from pipelines.slip.settings import LearnSlipSettings
from terrain.control.learned_table import FALLBACK, learned_table
from terrain.control.slip_table import DRIVE_STATES, write_slip_table
from terrain.errors import ConfigError, DataError
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.records import RunLog
from terrain.robots import Robot, SwerveRobot, as_drive, load_robot
from terrain.slip_learning.curve import N_BOOTSTRAP
from terrain.slip_learning.learn import FILTER, LearnedTerrain, TerrainRun, learn_terrain, terrain_runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE_FILE = "slip.html"


def learn_slip(
    runs: Sequence[RunLog],
    settings: LearnSlipSettings,
    skipped: Sequence[str] = (),
    progress: Progress = silent,
) -> LearnSlipResult:
    """Learn the table, write it, draw the curves and log all of it with MLflow.

    Parameters
    ----------
    runs : labelled logs of the robot, with motor currents
    settings : of the command; the table that is there is replaced at once, when all is done
    skipped : a sentence for each run that could not be read
    progress : gets the number of runs and terrains done

    Raises
    ------
    ConfigError
        if the robot is no swerve robot or lacks a section, or ``out`` is a folder.
    DataError
        if no run has a label, or one is another robot's or lacks currents or attitude and ``repair`` is not
        set.
    TerrainError
        if a folder cannot be written.
    """
    from pipelines.models.tracking import ensure_tracking
    from pipelines.slip.figures import curve_figures
    from pipelines.slip.page import slip_page

    robot = _swerve_robot(settings.robot)
    _check_places(settings)
    ensure_tracking()
    labelled = [run for run in runs if run.labels]
    if not labelled:
        raise DataError(f"none of {len(runs)} runs has a label: curves are learned by terrain")
    used, measured, faulty = _measured(labelled, robot, settings.repair, progress)
    learned = _learned(measured, settings.seed, progress)
    table = learned_table(learned, robot, name=settings.out.stem)
    rows = {entry.terrain: terrain_row(entry, table) for entry in learned}
    figures = curve_figures(learned, robot.name)
    write_slip_table(table, settings.out)
    files: list[str] = []
    if settings.figures is not None:
        files = _write_figures(figures, settings.figures)
        page = settings.figures / PAGE_FILE
        atomic_write(page, slip_page(rows, figures, table, len(used)))
        files.append(str(page))
    digest = data_digest(used)
    return LearnSlipResult(
        table=settings.out,
        robot=robot.name,
        filter=FILTER,
        seed=settings.seed,
        dataset=settings.dataset,
        data_digest=digest,
        n_runs=len(used),
        n_unlabelled=len(runs) - len(labelled),
        runs=tuple(run_row(run) for run in measured),
        terrains=rows,
        fallback={state: table.targets[FALLBACK][state].slip_ratio for state in DRIVE_STATES},
        figures=tuple(files),
        skipped=(*skipped, *faulty),
        tracking_run_id=_log(settings, robot, rows, figures, digest, len(used)),
    )


def _swerve_robot(name: str) -> Robot:
    refusal = "robot {name} has the drive {drive!r}: slip curves are learned for 'swerve' alone"
    robot = as_drive(SwerveRobot, load_robot(name), refusal)
    robot.require(*robot.sections)
    return robot


def _check_places(settings: LearnSlipSettings) -> None:
    if settings.out.is_dir():
        raise ConfigError(f"{settings.out}: is a folder; --out names the file of the table")
    ensure_writable(settings.out.parent)
    if settings.figures is not None:
        ensure_writable(settings.figures)


def _measured(
    runs: Sequence[RunLog], robot: Robot, skip_faulty: bool, progress: Progress
) -> tuple[list[RunLog], list[TerrainRun], list[str]]:
    """Return the runs that were used, their measurements, and a sentence for each faulty run."""
    used: list[RunLog] = []
    measured: list[TerrainRun] = []
    faulty: list[str] = []
    for done, run in enumerate(runs, start=1):
        try:
            measured += terrain_runs(run, robot)
            used.append(run)
        except DataError as error:
            if not skip_faulty:
                raise
            faulty.append(f"run skipped: {error}")
        progress("filter", done, len(runs))
    if not used:
        raise DataError("no run has what slip curves are learned from: labels, currents and attitude")
    return used, measured, faulty


def _learned(measured: Sequence[TerrainRun], seed: int, progress: Progress) -> list[LearnedTerrain]:
    terrains = sorted({run.terrain for run in measured})
    learned = []
    for done, terrain in enumerate(terrains, start=1):
        learned.append(learn_terrain(terrain, [run for run in measured if run.terrain == terrain], seed))
        progress("learn", done, len(terrains))
    return learned


def _log(
    settings: LearnSlipSettings,
    robot: Robot,
    rows: Mapping[str, TerrainRow],
    figures: Mapping[str, Figure],
    digest: str,
    n_runs: int,
) -> str:
    """Log table, rows and figures with MLflow; return the id of the run there."""
    from pipelines.models.tracking import code_commit, log_learning

    out = settings.out
    return log_learning(
        out.stem,
        {
            "robot": robot.name,
            "filter": FILTER,
            "n_bootstrap": N_BOOTSTRAP,
            "dataset": settings.dataset,
            "n_runs": n_runs,
        },
        _metrics(rows),
        {"data_digest": digest, "commit": code_commit(), "seed": str(settings.seed), "kind": "slip table"},
        {out.name: out.read_text(encoding="utf-8")},
        {"learn_slip.json": {"terrains": as_json(rows)}},
        figures,
    )


def _metrics(rows: Mapping[str, TerrainRow]) -> dict[str, float]:
    """Return the figures of each terrain that are known, by names that MLflow accepts."""
    keys = ("n_runs", "peak_slip", "resistance_ratio", "balance_slip", "traction_efficiency")
    metrics: dict[str, float] = {}
    for terrain, row in rows.items():
        name, found = _accepted(terrain, " "), row.as_json()
        metrics |= {f"{name}.{key}": float(found[key]) for key in keys if found.get(key) is not None}
        for state in DRIVE_STATES:
            metrics[f"{name}.target_{state}"] = row.targets[state].slip_ratio
    return metrics


def _accepted(name: str, also: str = "") -> str:
    """Return a name with other characters than letters, digits and a few signs replaced."""
    return "".join(letter if letter.isalnum() or letter in "_-." + also else "_" for letter in name)


def _write_figures(figures: Mapping[str, Figure], folder: Path) -> list[str]:
    from pipelines.reporting.drawing import png_bytes, svg_text

    files = []
    for name, figure in figures.items():
        for ending, content in ((".png", png_bytes(figure)), (".svg", svg_text(figure))):
            path = folder / f"{_accepted(name)}{ending}"
            atomic_write(path, content)
            files.append(str(path))
    return files
