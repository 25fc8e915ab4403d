"""Target slip on each terrain from labelled runs: by slip curves, or by slip measured from outside."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.data.settings import RunsSettings
from pipelines.report.settings import check_file, setting

if TYPE_CHECKING:
    from pipelines.report.results import Progress
    from pipelines.slip.table import LearnedSlipTable
    from terrain.records import RunLog
    from terrain.robots import Robot

EXAMPLE = "terrain learn-slip --data pull/ --robot agrimaro --out table.yaml"
RESULTS = ("pipelines.slip.curves", "pipelines.slip.steady")  #: Modules of the kinds, with their results


class Settings(RunsSettings):
    """Labelled runs of one robot, and what is written."""

    robot: str = setting(..., "Robot by name, or its YAML file; slip of others than swerve is measured.")
    out: Path = setting(..., "YAML file of the table of target slips.")
    figures: Path | None = setting(None, "Folder of pictures; MLflow gets those of swerve anyway.")
    seed: int = setting(0, "Of the bootstrap.", ge=0)


def run(settings: Settings, progress: Progress) -> LearnedSlipTable:
    """Learn the table, write it and its pictures; what a swerve robot shows is logged with MLflow."""
    from pipelines.data.datasets import load
    from pipelines.slip.curves import LearnedCurves, log_curves
    from pipelines.slip.shown import write_figures
    from terrain.files.atomic import ensure_writable
    from terrain.robots import SwerveRobot, load_robot

    robot = load_robot(settings.robot)
    runs, skipped, doubts = load(settings)
    check_file(settings.out, "--out")
    if settings.figures is not None:
        ensure_writable(settings.figures)
    if isinstance(robot, SwerveRobot):
        from pipelines.data.tracking import ensure_tracking

        ensure_tracking()
    table = learn_slip_table(
        runs, robot, seed=settings.seed, name=settings.out.stem, repair=settings.repair, progress=progress
    )
    table.save(settings.out)
    files = () if settings.figures is None else write_figures(table.pictures, settings.figures)
    written = replace(
        table, table=settings.out, dataset=settings.dataset, figures=files, skipped=(*skipped, *table.skipped)
    ).with_doubts(doubts)
    if isinstance(written, LearnedCurves):
        log_curves(written)
    return written


def learn_slip_table(
    runs: Iterable[RunLog],
    robot: Robot,
    *,
    seed: int = 0,
    name: str = "learned",
    repair: bool = False,
    progress: Progress | None = None,
) -> LearnedSlipTable:
    """Learn target slips; nothing is written.

    Parameters
    ----------
    runs : labelled logs, as the estimates of :func:`pipelines.slip.estimate.estimate_runs`: of a swerve robot with
        motor currents, of others with an outside measurement of motion
    robot : whose they are
    seed : of the bootstrap
    name : of the table
    repair : leave out runs that lack something, in place of refusing them
    progress : gets the runs and terrains that are done

    Raises
    ------
    ConfigError
        if the robot lacks a section.
    DataError
        if no run has a label, one is another robot's or lacks currents or attitude, or none has a slip.
    """
    from pipelines.report.results import silent
    from pipelines.slip.curves import learn_curves
    from pipelines.slip.steady import learn_steady
    from terrain.robots import SwerveRobot

    runs, progress = list(runs), progress or silent
    if isinstance(robot, SwerveRobot):
        return learn_curves(runs, robot, seed, name, repair, progress)
    return learn_steady(runs, robot, seed, name, progress)
